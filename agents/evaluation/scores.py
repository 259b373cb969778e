"""The figures of an episode, for each environment, from observations, rewards and info; on a bus, too.

Figures that need the emulator say so; all others can be compared between emulator and bus.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from drive_env.envs import environment_of
from drive_env.envs.suite import TASKS
from drive_env.trials.score import TRIP
from mechanics.arrays import Floats
from tuning.bootstrap import bootstrap_interval


class Episode(NamedTuple):
    """An episode of one environment, as recorded.

    seed: Seed of the episode.
    observations: Shape (steps + 1, entries); the last one is the final one.
    actions: Shape (steps, actions).
    rewards: Shape (steps,).
    terms: Reward term -> values, shape (steps,).
    terminated: Whether it ended early, which is a violation.
    fault: Cause of its end; "" if it was not ended early.
    first, last: This environment's info at the beginning and in the last step.
    """

    seed: int
    observations: Floats
    actions: Floats
    rewards: Floats
    terms: Mapping[str, Floats]
    terminated: bool
    fault: str
    first: Mapping[str, Any]
    last: Mapping[str, Any]


class Figure(NamedTuple):
    """A figure of an episode.

    name: Name with unit.
    compute: Computes it from the episode and the environment's configuration.
    lower_is_better: Direction.
    """

    name: str
    compute: Callable[[Episode, Any], float]
    lower_is_better: bool = True


AXIS_ENTRIES = 8  # of an axis in Tracking's observation


def _tracking_axes(episode: Episode) -> Floats:
    """Return the entries of the axes, shape (steps, axes, entries), without the first observation."""
    rows = episode.observations[1:]
    axes = rows.shape[1] // AXIS_ENTRIES
    return rows[:, : axes * AXIS_ENTRIES].reshape(len(rows), axes, AXIS_ENTRIES)


def following_error(episode: Episode, config: Any) -> float:
    """Return the RMS following error of the worst axis [revolutions]."""
    rms = np.sqrt(np.mean(np.square(_tracking_axes(episode)[:, :, 0]), axis=0))
    return float(config.amplitude * rms.max())


def current(episode: Episode, config: Any) -> float:
    """Return the RMS current of the worst axis, share of the current limit."""
    return float(np.sqrt(np.mean(np.square(_tracking_axes(episode)[:, :, 4]), axis=0)).max())


def upright(episode: Episode, config: Any) -> float:
    """Return the episode's duration over its full time."""
    return float(len(episode.rewards) / config.steps)


def pole(episode: Episode, config: Any) -> float:
    """Return the RMS angle of the pendulum [rad]; NaN without one."""
    if config.task.joint is None:
        return float("nan")
    return float(np.sqrt(np.mean(np.square(episode.observations[1:, -2]))))


def _told(name: str) -> Callable[[Episode, Any], float]:
    """Return the function that reads an entry of GainTuning's info at an episode's end; NaN if it is missing."""
    return lambda episode, config: float(np.asarray(episode.last.get(name, np.nan)))


def constraints_kept(episode: Episode, config: Any) -> float:
    """Return 1 if the answer of GainTuning keeps the constraints, else 0; NaN on given drives (machine unknown)."""
    cost = _told("robust_cost")(episode, config)
    return cost if np.isnan(cost) else float(cost < TRIP)


def _mean_term(name: str) -> Callable[[Episode, Any], float]:
    return lambda episode, config: float(np.mean(episode.terms[name]))


def stopped(episode: Episode, config: Any) -> float:
    """Return the share of trials stopped for oscillation or fault; NaN if stops have no cost."""
    if not config.abort_cost or "abort" not in episode.terms:
        return float("nan")
    return float(np.mean(np.asarray(episode.terms["abort"]) < 0.0))


def total(episode: Episode, config: Any) -> float:
    """Return the sum of rewards."""
    return float(np.sum(episode.rewards))


RETURN = Figure("return", total, lower_is_better=False)

# Environment -> its figures; the first one is the score, except as in `figures`.
FIGURES: dict[str, tuple[Figure, ...]] = {
    "ServoDrive/Tracking-v0": (
        Figure("RMS following error [rev]", following_error),
        Figure("RMS current [of the limit]", current),
        Figure("RMS pole angle [rad]", pole),
        Figure("time lasted [of the episode]", upright, lower_is_better=False),
        RETURN,
    ),
    "ServoDrive/GainTuning-v0": (
        Figure("robust cost (emulator)", _told("robust_cost")),
        Figure("constraints kept (emulator) [share]", constraints_kept, lower_is_better=False),
        Figure("J by measured terms", _told("measured")),
        Figure("stopped trials [share]", stopped),
        RETURN,
    ),
    "ServoDrive/GainScheduling-v0": (
        Figure("tracking term [0...1]", _mean_term("tracking"), lower_is_better=False),
        Figure("smoothness term [0...1]", _mean_term("smoothness"), lower_is_better=False),
        RETURN,
    ),
}


def figures(environment: str, config: Any) -> tuple[Figure, ...]:
    """Return the figures of an environment, the score first: if a pole can fall, the time that it stood."""
    found = FIGURES[environment_of(environment)]
    if environment in TASKS:
        steps = TASKS[environment].steps
        score = Figure("score [0...1]", lambda episode, config: total(episode, config) / steps, lower_is_better=False)
        return (score, *found)
    if np.isfinite(getattr(getattr(config, "task", None), "fall", np.inf)):
        found = tuple(sorted(found, key=lambda figure: figure.compute is not upright))
    return found


class Interval(NamedTuple):
    """A mean over episodes with its 95 % confidence interval, and the median."""

    mean: float
    low: float
    high: float
    median: float
    episodes: int


def interval(values: Any) -> Interval:
    """Return mean, percentile bootstrap interval (95 %), median and number of finite values; NaN without any."""
    found = np.asarray(values, float)
    found = found[np.isfinite(found)]
    if not len(found):
        return Interval(float("nan"), float("nan"), float("nan"), float("nan"), 0)
    low, high = bootstrap_interval(lambda x: x.mean(axis=1), found)
    return Interval(float(found.mean()), low, high, float(np.median(found)), len(found))
