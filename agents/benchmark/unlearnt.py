"""Policies without learning: a task that one of them solves would not be suitable for the suite."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from drive_env.envs import environment_of, make_vector
from drive_env.envs.suite import TASKS
from mechanics.arrays import Floats

AXIS_ENTRIES = 8  # of an axis in Tracking's observation; the first two are the errors of position and speed
PAIRS = ((4.0, 0.5), (6.0, 0.5), (8.0, 1.0), (16.0, 1.0), (16.0, 0.1), (32.0, 0.1), (0.0, 1.0), (0.0, 3.0))
CONSTANTS = (-1.0, -0.5, -0.2, -0.05, 0.05, 0.1, 0.2, 0.5, 1.0)
# Velocity P, velocity I and position P: the best of 141 constant sets of the payload tasks, and others near it.
SETS = ((-0.575, -1.0, 0.05), (-0.41, -0.83, 0.06), (-0.49, -0.78, 0.17), (-0.45, -0.66, -0.07), (-0.25, -0.9, 0.0))
SPEEDS = (0.3, 0.35, 0.4, 0.43, 0.46, 0.5, 0.55, 0.6)  # of the demanded speed
CORNERS = (-2.0 / 3.0, 0.0, 2.0 / 3.0)  # of a tuning's actions, in which each entry is a separate gain

# Action of every entry from the errors of position and speed, shape (machines, entries), and a generator. A tuning has
# no such errors: the position error is +1 and -1 alternately.
Plain = Callable[[Floats, Floats, np.random.Generator], Floats]


def _constant(*values: float) -> Plain:
    return lambda error, speed, rng: np.zeros_like(error) + values


def _steady(speed: float) -> Plain:
    """Return the policy that goes to a share of the demanded speed, and keeps it."""
    return lambda error, slow, rng: np.clip(5.0 * (slow - 1.0 + speed), -1.0, 1.0)


def _pair(proportional: float, derivative: float) -> Plain:
    return lambda error, speed, rng: np.clip(proportional * error + derivative * speed, -1.0, 1.0)


EVERYWHERE: dict[str, Plain] = {
    "zero": lambda error, speed, rng: np.zeros_like(error),
    "random": lambda error, speed, rng: rng.uniform(-1.0, 1.0, error.shape),
    "bang-bang": lambda error, speed, rng: np.sign(error),
    **{f"constant {value:g}": _constant(value) for value in CONSTANTS},
}
# Environment -> name of a policy -> the policy.
POLICIES: dict[str, dict[str, Plain]] = {
    "ServoDrive/Tracking-v0": EVERYWHERE | {f"PD {pair[0]:g}, {pair[1]:g}": _pair(*pair) for pair in PAIRS},
    "ServoDrive/GainScheduling-v0": EVERYWHERE
    | {f"gains {', '.join(f'{one:g}' for one in values)}": _constant(*values) for values in SETS},
    "ServoDrive/GainTuning-v0": EVERYWHERE
    | {
        f"constant {', '.join(f'{value:.2g}' for value in corner)}": _constant(*corner)
        for corner in product(CORNERS, repeat=3)
        if any(corner)
    },
}
# The same for a task, in addition to those of its environment: on a stepper the speed is commanded.
OWN_POLICIES: dict[str, dict[str, Plain]] = {
    "ServoDrive/StepperRun-v1": {f"speed {share:g}": _steady(share) for share in SPEEDS}
}


def unlearnt_scores(name: str, machines: int) -> dict[str, float]:
    """Return the mean scores of policies without learning on a task, on its first machines, by policy.

    Raises:
        ValueError: If a reward is not in 0...1.
    """
    policies = POLICIES[environment_of(name)] | OWN_POLICIES.get(name, {})
    lanes = make_vector(len(policies) * machines, name=name, autoreset_mode="NextStep")
    try:
        entries = lanes.single_action_space.shape[0]  # type: ignore[index]
        seen, _ = lanes.reset(seed=list(range(machines)) * len(policies))  # every policy gets the same machines
        rng = np.random.default_rng(0)
        total, going = np.zeros(lanes.num_envs), np.ones(lanes.num_envs, bool)
        for step in range(TASKS[name].steps):
            errors = _errors(name, seen, entries, step).reshape(2, len(policies), machines, entries)
            action = np.stack([act(*both, rng) for act, *both in zip(policies.values(), *errors, strict=True)])
            seen, reward, terminated, _, _ = lanes.step(action.reshape(-1, entries).astype(np.float32))
            if np.any((reward < 0.0) | (reward > 1.0)):
                raise ValueError(f"a reward of {name} is {reward.min():g} to {reward.max():g}; it must lie in 0...1")
            total += np.where(going, reward, 0.0)
            going &= ~terminated
    finally:
        lanes.close()
    means = total.reshape(len(policies), machines).mean(axis=1) / TASKS[name].steps
    return dict(zip(policies, means.tolist(), strict=True))


def _errors(name: str, seen: Any, entries: int, step: int) -> Floats:
    """Return the errors of position and speed for each entry of the action, (2, environments, entries)."""
    environment = environment_of(name)
    if environment == "ServoDrive/GainTuning-v0":  # a trial has no such errors: alternately
        count = len(next(iter(seen.values()))) if isinstance(seen, dict) else len(seen)
        return np.stack([np.full((count, entries), (-1.0) ** step), np.zeros((count, entries))])
    rows = np.asarray(seen, float)
    if environment == "ServoDrive/GainScheduling-v0":  # of one axis, whose gains are the entries
        both = np.stack([rows[:, 0], rows[:, 4] - rows[:, 3]])
        return np.repeat(both[:, :, None], entries, axis=2)
    axes = rows[:, : AXIS_ENTRIES * entries].reshape(len(rows), entries, AXIS_ENTRIES)
    return np.moveaxis(axes[..., :2], -1, 0)
