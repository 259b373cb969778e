"""Acting with a bundle, only with NumPy: for a controller on a small computer, without torch, Gymnasium or MuJoCo.

`load_policy("agent.npz").act(observation)` takes observations of shape (entries,) or (environments, entries).
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from agents.policies.agent_file import AgentFile, BundleError
from mechanics.arrays import Mask, Singles

ACTOR = "observation"  # the actor's entry of a dict observation

# Kind of a bundle -> class or function that makes its policy.
KINDS: dict[str, str] = {
    "mlp": "agents.policies.policy:MlpPolicy",
    "lstm": "agents.policies.policy:LstmPolicy",
    "surrogate": "agents.tuner.surrogate:SurrogatePolicy",
}


class PolicyError(RuntimeError):
    """A policy got or returned a value that is not a number; the caller must stop the drives."""


def load_policy(path: str | Path) -> Any:
    """Return the policy of a bundle, by its kind.

    Raises:
        BundleError: If the file is not a bundle, or its kind is not known here.
    """
    return policy_of(AgentFile.load(path))


def policy_of(bundle: AgentFile) -> Any:
    """Return the policy of a bundle; BundleError for an unknown kind, or arrays and settings that do not fit it."""
    if bundle.kind not in KINDS:
        raise BundleError(f"an agent of kind {bundle.kind!r} needs a newer drive-env; this one has {', '.join(KINDS)}")
    module, _, name = KINDS[bundle.kind].partition(":")
    try:
        return getattr(importlib.import_module(module), name)(bundle)
    except BundleError:
        raise
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise BundleError(
            f"the agent's arrays and settings do not fit {bundle.kind!r}: {error}; get it again"
        ) from None


# --- pieces -----------------------------------------------------------------------------------------------------------
def sigmoid(x: Singles) -> Singles:
    """Return 1/(1 + exp(-x)), which overflows nowhere in this form."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)), np.float32)


def _elu(x: Singles) -> Singles:
    return np.asarray(np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))), np.float32)


# Names as the settings have them; torch's own defaults (elu's alpha 1, leaky_relu's slope 0.01).
ACTIVATIONS: dict[str, Callable[[Singles], Singles]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0.0)),
    "elu": _elu,
    "leaky_relu": lambda x: np.where(x > 0.0, x, np.float32(0.01) * x),
    "silu": lambda x: x * sigmoid(x),
}


def _clip(x: Singles, low: Singles, high: Singles) -> Singles:
    return np.minimum(np.maximum(x, low), high)


def _squash(x: Singles, low: Singles, high: Singles) -> Singles:
    return np.asarray(low + np.float32(0.5) * (np.tanh(x) + np.float32(1.0)) * (high - low), np.float32)


# Conversion of a network's output to an action: limited to the space's bounds (PPO), or squashed into them (SAC).
OUTPUTS: dict[str, Callable[[Singles, Singles, Singles], Singles]] = {"clip": _clip, "tanh": _squash}


class Ends:
    """Common first and last steps of all networks: checks, normaliser, action bounds.

    Arrays: observation_mean, observation_scale (1/standard deviation), shape (entries,); action_low, action_high, shape
    (actions,). Settings: observation_clip (of the normalised observation; None: no normaliser), output (OUTPUTS).
    """

    def __init__(self, bundle: AgentFile) -> None:
        self.bundle = bundle
        arrays, settings = bundle.arrays, bundle.settings
        clip = settings.get("observation_clip")
        self.mean = np.asarray(arrays["observation_mean"], np.float64)
        self.scale = np.asarray(arrays["observation_scale"], np.float64)
        self.clip = None if clip is None else float(clip)
        self.low, self.high = (np.asarray(arrays[f"action_{end}"], np.float32) for end in ("low", "high"))
        self._output = OUTPUTS[_choice("output", settings["output"], OUTPUTS)]

    def enter(self, observation: ArrayLike) -> Singles:
        """Return normalised observations, shape (environments, entries); PolicyError for another shape or NaN."""
        x = np.asarray(observation)
        if x.shape[-1:] != self.mean.shape or x.ndim > 2:
            raise PolicyError(
                f"the policy takes {len(self.mean)} entries, (entries,) or (environments, entries), not {x.shape}; "
                "check that it is for this environment and configuration"
            )
        if not np.isfinite(x).all():
            wrong = int(np.argwhere(~np.isfinite(x))[0][-1])
            raise PolicyError(f"entry {wrong} of the observation is not a number: the policy was not called")
        if self.clip is not None:
            x = np.minimum(np.maximum((x - self.mean) * self.scale, -self.clip), self.clip)
        return np.atleast_2d(x.astype(np.float32))

    def leave(self, x: Singles, observation: ArrayLike) -> Singles:
        """Return the action of a network's output, in the observation's shape; PolicyError if it is not finite."""
        if not np.isfinite(x).all():
            raise PolicyError("the policy's output is not a number")
        action = self._output(x, self.low, self.high)
        return action[0] if np.ndim(observation) == 1 else action


def _layers(bundle: AgentFile) -> list[tuple[Singles, Singles]]:
    """Return weights (in, out) and biases of the layers, in order."""
    found: list[tuple[Singles, Singles]] = []
    while f"weight_{len(found)}" in bundle.arrays:
        weight, bias = (bundle.arrays[f"{name}_{len(found)}"] for name in ("weight", "bias"))
        found.append((np.ascontiguousarray(weight, np.float32), np.asarray(bias, np.float32)))
    if not found:
        raise BundleError("the agent has no layers: there is no array weight_0")
    return found


def _choice(what: str, name: Any, table: dict[str, Any]) -> str:
    if name not in table:
        raise BundleError(f"the agent's {what} is {name!r}; there are {', '.join(table)}")
    return str(name)


# --- kinds ------------------------------------------------------------------------------------------------------------
class MlpPolicy:
    """A network of fully connected layers.

    Arrays besides those of `Ends`: weight_0 (in, out), bias_0, weight_1, ... Settings: activation (ACTIVATIONS), after
    each layer but the last.
    """

    def __init__(self, bundle: AgentFile) -> None:
        self.bundle = bundle
        self._ends = Ends(bundle)
        *self._hidden, self._last = _layers(bundle)
        self._activation = ACTIVATIONS[_choice("activation", bundle.settings["activation"], ACTIVATIONS)]

    def act(self, observation: ArrayLike) -> Singles:
        """Return the action for one observation, or one for each environment.

        Raises:
            PolicyError: If observation or action is not a number, or the observation has another shape.
        """
        x = self._ends.enter(observation)
        with np.errstate(over="ignore", invalid="ignore"):  # `leave` reports the consequence
            x = self._outputs(x)
        return self._ends.leave(x, observation)

    def _outputs(self, x: Singles) -> Singles:
        for weight, bias in self._hidden:
            x = self._activation(x @ weight + bias)
        return x @ self._last[0] + self._last[1]

    def reset(self, mask: Mask | None = None) -> None:
        """Do nothing: there is no state."""


class LstmPolicy(MlpPolicy):
    """A layer of LSTM cells, then fully connected layers; each environment has its own state.

    Arrays besides those of `MlpPolicy`: lstm_input (entries, 4 cells), lstm_state (cells, 4 cells), lstm_bias (4
    cells), the gates in torch's order: input, forget, cell, output.
    """

    def __init__(self, bundle: AgentFile) -> None:
        super().__init__(bundle)
        self._input, self._recurrent, self._bias = (
            np.ascontiguousarray(bundle.arrays[f"lstm_{name}"], np.float32) for name in ("input", "state", "bias")
        )
        self._state = self._cell = np.zeros((0, len(self._recurrent)), np.float32)

    def act(self, observation: ArrayLike) -> Singles:
        """Return the action for one observation, or one for each environment, and update the state.

        Raises:
            PolicyError: As `MlpPolicy.act`.
        """
        x = self._ends.enter(observation)
        if len(self._state) != len(x):
            self._state = self._cell = np.zeros((len(x), len(self._recurrent)), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            gates = x @ self._input + self._state @ self._recurrent + self._bias
            enter, forget, cell, leave = np.split(gates, 4, axis=1)
            self._cell = sigmoid(forget) * self._cell + sigmoid(enter) * np.tanh(cell)
            x = self._state = sigmoid(leave) * np.tanh(self._cell)
            x = self._outputs(x)
        return self._ends.leave(x, observation)

    def reset(self, mask: Mask | None = None) -> None:
        """Reset the state, in all environments or where the mask is true."""
        keep = np.zeros(len(self._state), bool) if mask is None else ~np.asarray(mask, bool)
        if len(keep) != len(self._state):  # from another number of environments
            keep = np.zeros(len(self._state), bool)
        self._state, self._cell = (np.where(keep[:, None], x, np.float32(0.0)) for x in (self._state, self._cell))


# --- latency ----------------------------------------------------------------------------------------------------------
class Latency(NamedTuple):
    """Time of an action for one observation [s]."""

    median: float
    p99: float
    worst: float

    def __str__(self) -> str:
        return f"median {1e6 * self.median:.0f} µs, p99 {1e6 * self.p99:.0f} µs, worst {1e6 * self.worst:.0f} µs"


def measure_latency(act: Callable[[Singles], Any], entries: int, calls: int = 2000) -> Latency:
    """Return the time of a policy for one observation of `entries` numbers, on this computer in its present state."""
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1.0, 1.0, (64, entries)).astype(np.float32)
    times = np.empty(calls)
    for k in range(-min(calls, 50), calls):  # some unmeasured calls first: caches fill
        start = time.perf_counter()
        act(observations[k % 64])
        times[max(k, 0)] = time.perf_counter() - start
    return Latency(float(np.median(times)), float(np.quantile(times, 0.99)), float(times.max()))
