"""A tuner that has learnt what gains are worth: networks for hidden J, and a Gaussian process for what they get wrong.

It acts in `ServoDrive/GainTuning-v0`. Of every machine it keeps the context c (what was identified, and what the trial
at the rule's gains showed) and its trials (log gains over the rule's x, what they showed y). Two ensembles of networks
were trained on emulated machines, whose hidden J is known:

    f(c, x)     ln of hidden J over the rule's, of gains that have not been tried
    g(c, x, y)  the same, of gains whose trial showed y

Where a trial shows that f is wrong on this machine, a Gaussian process carries g - f to the gains around it. The next
trial is the candidate with the least f + process, less some of the process's deviation, plus some of the ensemble's
disagreement: curious about this machine, wary of what no training machine was like.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.bundle import Bundle, BundleError
from agents.policy import PolicyError, sigmoid

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of an axis's observation (the class docstring of GainTuning): what was identified, then gains, then two trials.
IDENTIFIED, SHOWN = 4, 16
CLIP = 6.0  # of normalised inputs
WIDE, NEAR = 448, 128  # candidates all over the action's range, and around the incumbent
NEARNESS = 0.2  # standard deviation of the latter


class Ensemble:
    """Networks of two hidden layers that were trained from different beginnings.

    Arrays, with the ensemble's name in front: mean, scale (1/standard deviation), shape (entries,); w0 (networks,
    entries, hidden), b0, w1 (networks, hidden, hidden), b1, w2 (networks, hidden), b2.
    """

    def __init__(self, bundle: Bundle, name: str) -> None:
        try:
            self._mean, self._scale, self._w0, self._b0, self._w1, self._b1, self._w2, self._b2 = (
                np.asarray(bundle.arrays[f"{name}_{part}"], np.float32)
                for part in ("mean", "scale", "w0", "b0", "w1", "b1", "w2", "b2")
            )
        except KeyError as error:
            raise BundleError(f"the agent has no array {error}; it is no surrogate") from None

    def __call__(self, inputs: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation of the networks' outputs for inputs of shape (n, entries)."""
        x = np.clip((inputs - self._mean) * self._scale, -CLIP, CLIP)
        outputs = []
        for w0, b0, w1, b1, w2, b2 in zip(self._w0, self._b0, self._w1, self._b1, self._w2, self._b2, strict=True):
            h = x @ w0 + b0
            h *= sigmoid(h)
            h = h @ w1 + b1
            h *= sigmoid(h)
            outputs.append(h @ w2 + b2)
        found = np.stack(outputs)
        return found.mean(axis=0), found.std(axis=0)


class SurrogatePolicy:
    """Proposes gains for GainTuning: kind "surrogate" of a bundle.

    Settings: gains (their number), step (the action's bound), variance, length, noise (of the Gaussian process, in
    (ln J)^2 and in ln of gains), curiosity (of its deviation), wariness (of the ensemble's disagreement).
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self._unseen, self._seen = Ensemble(bundle, "f"), Ensemble(bundle, "g")
        s = bundle.settings
        self._gains, self._step = int(s["gains"]), float(s["step"])
        self._variance, self._length, self._noise = float(s["variance"]), float(s["length"]), float(s["noise"])
        self._curiosity, self._wariness = float(s["curiosity"]), float(s["wariness"])
        self._entries = IDENTIFIED + 2 * self._gains + 2 * SHOWN  # of an axis
        rng = np.random.default_rng(0)  # the same candidates for ever: a run repeats
        shape = (NEAR, self._gains)
        self._candidates = np.concatenate(
            [
                rng.uniform(-self._step, self._step, (WIDE, self._gains)),
                np.clip(rng.normal(0.0, NEARNESS, shape), -self._step, self._step),
            ]
        ).astype(np.float32)
        self._context: Array = np.zeros((0, IDENTIFIED + SHOWN), np.float32)
        self._tried: Array = np.zeros((0, 0, self._gains), np.float32)  # (machines, trials, gains)
        self._worth: Array = np.zeros((0, 0), np.float32)  # g of the trials
        self._age = np.zeros(0, np.int64)  # trials of each machine

    def reset(self, mask: Mask | None = None) -> None:
        """Forget the machines, all or those of a mask over the lanes."""
        if mask is None or not len(self._age):
            self._age = np.zeros(0, np.int64)
        else:
            self._age[np.repeat(mask, len(self._age) // len(mask))] = 0

    def act(self, observation: ArrayLike) -> Array:
        """Return the change of the log gains to try, in the observation's shape.

        Raises:
            PolicyError: If the observation is of another configuration, or holds what is no number.
        """
        given = np.asarray(observation, np.float32)
        lanes = np.atleast_2d(given)
        axes, rest = divmod(lanes.shape[1] - 1, self._entries)
        if rest or not axes:
            raise PolicyError(
                f"the policy takes {self._entries} entries per axis and one more, not {lanes.shape[1]}; make the "
                f"environment with the agent's configuration: {dict(self.bundle.configuration)}"
            )
        if not np.isfinite(lanes).all():
            raise PolicyError("the observation holds what is no number: the policy was not asked")
        each = lanes[:, :-1].reshape(-1, self._entries)
        self._take(each)
        incumbent = each[:, IDENTIFIED + self._gains : IDENTIFIED + 2 * self._gains]
        action = self._propose(incumbent).reshape(len(lanes), -1)
        return action[0] if given.ndim == 1 else action

    def _take(self, each: Array) -> None:
        """Take note of the trial that was last."""
        count, G = len(each), self._gains
        if len(self._age) != count:
            self._age = np.zeros(count, np.int64)
            self._context = np.zeros((count, IDENTIFIED + SHOWN), np.float32)
            self._tried, self._worth = np.zeros((count, 0, G), np.float32), np.zeros((count, 0), np.float32)
        at = IDENTIFIED + 2 * G
        shown, gains = each[:, at : at + SHOWN], each[:, IDENTIFIED : IDENTIFIED + G]
        fresh = self._age == 0
        self._context[fresh] = np.concatenate([each[:, :IDENTIFIED], shown], axis=1)[fresh]
        worth = self._seen(np.concatenate([self._context, gains, shown], axis=1))[0]
        self._age += 1
        kept = int(self._age.max()) - 1
        self._tried = np.concatenate([self._tried[:, self._tried.shape[1] - kept :], gains[:, None]], axis=1)
        self._worth = np.concatenate([self._worth[:, self._worth.shape[1] - kept :], worth[:, None]], axis=1)
        # A new machine has one trial; that it stands there as often as others have trials does no harm.
        self._tried[fresh] = gains[fresh, None]
        self._worth[fresh] = worth[fresh, None]

    def _propose(self, incumbent: Array) -> Array:
        count, G = incumbent.shape
        candidates = incumbent[:, None] + self._candidates
        predicted, doubt = self._ask(candidates)
        expected = self._ask(self._tried)[0]
        correction, deviation = self._process(candidates, self._worth - expected)
        value = predicted + correction - self._curiosity * deviation + self._wariness * doubt
        best = value.argmin(axis=1)
        chosen = np.asarray(self._candidates[best], np.float32)
        assert chosen.shape == (count, G)
        return chosen

    def _ask(self, gains: Array) -> tuple[Array, Array]:
        """Return f and its disagreement for gains of shape (machines, n, gains)."""
        n = gains.shape[1]
        context = np.repeat(self._context, n, axis=0)
        mean, deviation = self._unseen(np.concatenate([context, gains.reshape(-1, self._gains)], axis=1))
        return mean.reshape(-1, n), deviation.reshape(-1, n)

    def _process(self, candidates: Array, residual: Array) -> tuple[Array, Array]:
        """Return mean and deviation of the process at candidates, given its values at what was tried."""
        tried, trials = self._tried, self._tried.shape[1]

        def covariance(a: Array, b: Array) -> NDArray[np.float64]:
            distance = np.square(a[:, :, None] - b[:, None]).sum(axis=-1)
            return np.asarray(self._variance * np.exp(-0.5 * distance / self._length**2), np.float64)

        known = covariance(tried, tried) + self._noise * np.eye(trials)
        across = covariance(tried, candidates)  # (machines, trials, candidates)
        solved = np.linalg.solve(known, np.concatenate([residual[:, :, None], across], axis=2))
        mean = np.einsum("mtc,mt->mc", across, solved[:, :, 0])
        variance = self._variance - np.einsum("mtc,mtc->mc", across, solved[:, :, 1:])
        return mean.astype(np.float32), np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
