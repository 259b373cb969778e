"""A learnt tuner: a network predicts the robust cost of gains from all trials of the machine so far.

It acts in `ServoDrive/GainTuning-v0`. For every machine it stores the context c (identified parameters, results of the
trial at the rule's gains, and the dynamics' required Ms) and its trials (log gains over the rule's x_i, results y_i). A
conditional neural process with attention (Kim et al., "Attentive Neural Processes", 2019), trained on emulated machines
whose robust cost is known, predicts for any gains x its logarithm, as a Laplace distribution:

    v_i, p_i, k_i = trial(c, x_i, y_i)                      value, share of the summary, keys
    u   = silu(mean of p_i)                                 what kind of machine this is
    z_h = sum_i softmax_i(q_h(c, x) . k_ih - s_h |x - x_i|^2) v_i        what was seen near x, for each head h
    median, ln scale = worth(c, x, u, z)

The next trial is the candidate with the least median minus a share of the scale. The answer is the trial, the rule's
included, with the least median plus a share of the scale: its own results and those of the other trials count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from agents.policies.agent_file import AgentFile, BundleError
from agents.policies.policy import PolicyError, sigmoid
from drive_env.loops.dynamics import DEFAULT, Dynamics, find_dynamics
from mechanics.arrays import Floats, Mask, Singles

# Of an axis's observation (the class docstring of GainTuning): what was identified, then gains, then two trials.
IDENTIFIED, SHOWN = 4, 16
STOPPED = (4, 9, 14)  # entries of a trial's results: whether its move, its reversal, its probe was stopped
ASKED = 1  # entry with ln of the required Ms
CONTEXT = IDENTIFIED + SHOWN + ASKED
CLIP = 6.0  # of normalised inputs
LEAST, MOST = -3.5, 1.0  # limits of ln of the scale
KEY = 12  # entries of a head's key
WIDE, NEAR = 320, 96  # candidates all over the range, and around the best trial, then around the best candidate
NEARNESS = (0.08, 0.25)  # standard deviations of the latter
NORMALISER = ("context_mean", "context_scale", "shown_mean", "shown_scale", "gains_scale")
LAYERS = ("trial_in", "trial_out", "query", "worth_in", "worth_hidden", "worth_out")
WEIGHTS = ("nearness", *(f"{layer}_{part}" for layer in LAYERS for part in ("weight", "bias")))


def silu(x: Singles) -> Singles:
    """Return x/(1 + exp(-x))."""
    return x * sigmoid(x)


def context_of(identified: Singles, shown: Singles, dynamics: Dynamics) -> Singles:
    """Return the context of machines, (n, 21).

    Args:
        identified: The observation's entries of identified parameters, (n, 4).
        shown: Its entries of the rule's trial, (n, 16).
        dynamics: The required dynamics.
    """
    asked = np.full((len(shown), ASKED), np.log(dynamics.ms))
    return np.concatenate([identified, shown, asked], axis=1, dtype=np.float32)


class Normaliser(NamedTuple):
    """The scaling of inputs: mean and 1/standard deviation, shapes (21,), (16,); 1/reach of gains."""

    context_mean: Singles
    context_scale: Singles
    shown_mean: Singles
    shown_scale: Singles
    gains_scale: Singles

    def context(self, raw: Singles) -> Singles:
        """Return contexts scaled for the networks."""
        return np.asarray(np.clip((raw - self.context_mean) * self.context_scale, -CLIP, CLIP))

    def shown(self, raw: Singles) -> Singles:
        """Scale the results of trials for the networks."""
        return np.asarray(np.clip((raw - self.shown_mean) * self.shown_scale, -CLIP, CLIP))

    def gains(self, raw: Singles) -> Singles:
        """Return log gains over the rule's, scaled for the networks."""
        return raw * self.gains_scale


class Memory(NamedTuple):
    """A network's memory of machines and their trials; heads come second.

    shared: Equal input of every candidate's first layer, (machines, hidden). query: The context's part of queries,
    (machines, heads * KEY). gains: (machines, trials, gains). keys: (machines, heads, trials, KEY). values: (machines,
    1, trials, value). hidden: Entries without a trial, (machines, 1, 1, trials).
    """

    shared: Singles
    query: Singles
    gains: Singles
    keys: Singles
    values: Singles
    hidden: Mask


class EnsembleMember:
    """One member of the ensemble; weights as (in, out), `nearness` is ln of s, (heads,)."""

    def __init__(self, weights: dict[str, Singles]) -> None:
        self._w = weights
        self._near = np.exp(weights["nearness"])[:, None, None]
        self._heads = len(weights["nearness"])
        self._gains = len(weights["query_weight"]) - CONTEXT
        total, keys = len(weights["trial_out_bias"]), self._heads * KEY
        # worth_in takes gains, heads * value, context, summary; trial_out gives value, summary, keys.
        rest = len(weights["worth_in_weight"]) - self._gains - CONTEXT
        self._value = (rest - (total - keys)) // (self._heads - 1)

    def read(self, context: Singles, tried: Singles, showed: Singles, known: Mask) -> Memory:
        """Return the memory of normalised contexts (n, 21) and trials (n, trials, ...), where `known` is true."""
        w, (n, trials), value = self._w, known.shape, self._value
        each = np.concatenate([np.repeat(context[:, None], trials, axis=1), tried, showed], axis=2)
        told = silu(each @ w["trial_in_weight"] + w["trial_in_bias"]) @ w["trial_out_weight"] + w["trial_out_bias"]
        first_key = told.shape[2] - self._heads * KEY
        share = known / known.sum(axis=1, keepdims=True)
        summary = silu(np.einsum("nt,ntu->nu", share.astype(np.float32), told[..., value:first_key]))
        own = self._gains + self._heads * value
        shared = np.concatenate([context, summary], axis=1) @ w["worth_in_weight"][own:] + w["worth_in_bias"]
        query = context @ w["query_weight"][self._gains :] + w["query_bias"]
        keys = told[..., first_key:].reshape(n, trials, self._heads, KEY).transpose(0, 2, 3, 1)
        return Memory(shared, query, tried, keys, told[:, None, :, :value], ~known[:, None, None])

    def ask(self, memory: Memory, gains: Singles) -> tuple[Singles, Singles]:
        """Return median and ln of the scale for normalised gains of shape (machines, n, gains)."""
        w, (count, n, _), heads = self._w, gains.shape, self._heads
        query = (gains @ w["query_weight"][: self._gains] + memory.query[:, None]).reshape(count, n, heads, KEY)
        distance = np.square(gains[:, :, None] - memory.gains[:, None]).sum(axis=-1)
        score = query.transpose(0, 2, 1, 3) @ memory.keys - self._near * distance[:, None]
        score = np.where(memory.hidden, np.float32(-1e9), score)
        score = np.exp(score - score.max(axis=-1, keepdims=True))
        seen = (score / score.sum(axis=-1, keepdims=True)) @ memory.values  # (machines, heads, n, value)
        seen = seen.transpose(0, 2, 1, 3).reshape(count, n, -1)
        into, own = w["worth_in_weight"], self._gains + seen.shape[2]
        h = silu(gains @ into[: self._gains] + seen @ into[self._gains : own] + memory.shared[:, None])
        h = silu(h @ w["worth_hidden_weight"] + w["worth_hidden_bias"])
        told = h @ w["worth_out_weight"] + w["worth_out_bias"]
        return told[..., 0], np.clip(told[..., 1], LEAST, MOST)


class SurrogatePolicy:
    """Proposes gains for GainTuning, and answers: kind "surrogate" of a bundle.

    Arrays: those of NORMALISER, and those of WEIGHTS with the networks in the first dimension. Settings: gains (their
    number), step (change of the log gains that an action of 1 makes), low, high (limits of trials, ln over the rule's,
    for each gain), curiosity and caution (shares of the scale, for trials and for the answer).
    """

    def __init__(self, bundle: AgentFile) -> None:
        self.bundle = bundle
        try:
            self._normal = Normaliser(*(np.asarray(bundle.arrays[name], np.float32) for name in NORMALISER))
            stacked = {name: np.asarray(bundle.arrays[name], np.float32) for name in WEIGHTS}
        except KeyError as error:
            raise BundleError(f"the agent has no array {error}; it is not a surrogate") from None
        count = len(stacked["nearness"])
        self._networks = [EnsembleMember({name: array[k] for name, array in stacked.items()}) for k in range(count)]
        s = bundle.settings
        self._gains, self._step = int(s["gains"]), float(s["step"])
        self._low, self._high = (np.asarray(s[end], np.float32) for end in ("low", "high"))
        self._curiosity, self._caution = float(s["curiosity"]), float(s["caution"])
        self._entries = IDENTIFIED + 2 * self._gains + 2 * SHOWN  # of an axis
        rng = np.random.default_rng(0)  # fixed candidates, so that runs are reproducible
        self._wide = rng.uniform(self._low, self._high, (WIDE, self._gains)).astype(np.float32)
        spread = np.repeat(NEARNESS, NEAR // len(NEARNESS))[:, None]
        self._near = (spread * rng.normal(0.0, 1.0, (NEAR, self._gains))).astype(np.float32)
        self._forget(0)

    def reset(self, mask: Mask | None = None) -> None:
        """Delete what was stored about the machines, of all environments or where the mask is true."""
        if mask is None or not len(self._known):
            self._forget(0)
        else:
            self._known[np.repeat(mask, len(self._known) // len(mask))] = False

    def act(self, observation: ArrayLike) -> Floats:
        """Return the change of the log gains to try, in steps, in the observation's shape.

        Raises:
            PolicyError: If the observation is of another configuration, or holds NaN.
        """
        each, incumbent = self._take(observation)
        memory = self._read()
        median, _ = self._ask(memory, self._tried)
        best = _pick(self._tried, np.where(self._known, median, np.inf))
        wide = np.repeat(self._wide[None], len(each), axis=0)
        chosen = self._least(memory, np.concatenate([wide, self._around(best)], axis=1))
        chosen = self._least(memory, np.concatenate([chosen[:, None], self._around(chosen)], axis=1))
        return self._leave(chosen - incumbent, observation)

    def answer(self, observation: ArrayLike) -> Floats:
        """Return the final choice as an action: the change, in steps, from the incumbent's log gains to a trial's.

        All axes of an environment get the gains of the same trial: of those not stopped, including the rule's, the one
        whose worst axis is best. Called instead of `act` after the last trial, with the same errors.
        """
        _, incumbent = self._take(observation)
        median, scale = self._ask(self._read(), self._tried)
        good = self._known & ~(self._showed[:, :, STOPPED] > 0.0).any(axis=-1)
        value = np.where(good, median + self._caution * scale, np.inf)
        lanes = len(np.atleast_2d(observation))
        of_lanes = value.reshape(lanes, -1, value.shape[1]).max(axis=1)
        chosen = _pick(self._tried, np.repeat(of_lanes, len(value) // lanes, axis=0))
        return self._leave(chosen - incumbent, observation)

    # --- what is remembered: the first trial of every machine is that of the rule's gains -----------------------------
    def _forget(self, count: int) -> None:
        self._context = np.zeros((count, CONTEXT), np.float32)
        self._tried = np.zeros((count, 0, self._gains), np.float32)
        self._showed = np.zeros((count, 0, SHOWN), np.float32)
        self._known = np.zeros((count, 0), bool)

    def _take(self, observation: ArrayLike) -> tuple[Singles, Singles]:
        """Record the last trial; return the axes' observations and their incumbents' gains."""
        given = np.asarray(observation, np.float32)
        lanes = np.atleast_2d(given)
        axes, rest = divmod(lanes.shape[1] - 1, self._entries)
        if rest or not axes:
            raise PolicyError(
                f"the policy takes {self._entries} entries per axis and one more, not {lanes.shape[1]}; make the "
                f"environment with the agent's configuration: {dict(self.bundle.configuration)}"
            )
        if not np.isfinite(lanes).all():
            raise PolicyError("the observation holds NaN: the policy was not called")
        each = lanes[:, :-1].reshape(-1, self._entries)
        if len(self._known) != len(each):
            self._forget(len(each))
        G, at = self._gains, IDENTIFIED + 2 * self._gains
        last, incumbent, shown = each[:, IDENTIFIED : IDENTIFIED + G], each[:, at - G : at], each[:, at : at + SHOWN]
        number = self._known.sum(axis=1)
        fresh = number == 0
        self._context[fresh] = context_of(each[:, :IDENTIFIED], shown, self._asked_for())[fresh]
        if number.max() == self._known.shape[1]:
            room = ((0, 0), (0, 1))
            self._known = np.pad(self._known, room)
            self._tried, self._showed = np.pad(self._tried, (*room, (0, 0))), np.pad(self._showed, (*room, (0, 0)))
        every = np.arange(len(each))
        self._known[every, number], self._tried[every, number], self._showed[every, number] = True, last, shown
        return each, incumbent

    def _asked_for(self) -> Dynamics:
        return find_dynamics(self.bundle.configuration.get("dynamics", DEFAULT))

    # --- what the networks say ----------------------------------------------------------------------------------------
    def _read(self) -> list[Memory]:
        normal = self._normal
        seen = normal.context(self._context), normal.gains(self._tried), normal.shown(self._showed)
        return [network.read(*seen, self._known) for network in self._networks]

    def _ask(self, memory: list[Memory], gains: Singles) -> tuple[Singles, Singles]:
        """Return median and scale for gains of shape (machines, n, gains), with the networks' spread in the scale."""
        normal = self._normal.gains(gains)
        told = [network.ask(one, normal) for network, one in zip(self._networks, memory, strict=True)]
        medians, scales = np.stack([one[0] for one in told]), np.exp([one[1] for one in told])
        return medians.mean(axis=0), scales.mean(axis=0) + medians.std(axis=0)

    def _least(self, memory: list[Memory], candidates: Singles) -> Singles:
        """Return for every machine the candidate to try next, (machines, gains)."""
        median, scale = self._ask(memory, candidates)
        return _pick(candidates, median - self._curiosity * scale)

    def _around(self, gains: Singles) -> Singles:
        """Return candidates around gains of shape (machines, gains), within the range."""
        return np.asarray(np.clip(gains[:, None] + self._near, self._low, self._high))

    def _leave(self, change: Singles, observation: ArrayLike) -> Floats:
        lanes = np.atleast_2d(observation)
        # Not float32: the division by the step and the later product must give the integer that was tried.
        action = np.clip(change.astype(float), -self._step, self._step).reshape(len(lanes), -1) / self._step
        found: Floats = action[0] if np.ndim(observation) == 1 else action
        return found


def _pick(gains: Singles, value: Singles) -> Singles:
    """Return for every machine, of its candidate gains, those with the least value, (machines, gains)."""
    return np.asarray(gains[np.arange(len(gains)), value.argmin(axis=1)], np.float32)
