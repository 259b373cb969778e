"""The difference between two evaluations of a policy: on the emulator and on the bus, figure by figure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.evaluation import Evaluation
from agents.scores import Interval, interval


class Gap(NamedTuple):
    """A figure on two sides.

    first, second: Means of the two.
    difference: Second less first, with its 95 % interval; paired by seed where both ran the same episodes.
    paired: Whether they did.
    """

    figure: str
    first: Interval
    second: Interval
    difference: Interval
    paired: bool


def compare(first: Evaluation, second: Evaluation) -> list[Gap]:
    """Return the gap of each figure that both have.

    Raises:
        ValueError: If they are of different environments.
    """
    if first.environment != second.environment:
        raise ValueError(f"{first.environment} and {second.environment} have no gap: they are different tasks")
    # Emulated machines are drawn anew for every episode and a bus has its own: their episodes are no pairs.
    paired = first.seeds == second.seeds and "emulator" not in (first.side, second.side)
    found = []
    for name in first.values:
        if name not in second.values:
            continue
        one, two = np.array(first.values[name]), np.array(second.values[name])
        difference = interval(two - one) if paired else _unpaired(one, two)
        found.append(Gap(name, first.interval(name), second.interval(name), difference, paired))
    return found


def text(gaps: list[Gap], first: str, second: str) -> list[str]:
    """Return lines that say it."""
    lines = []
    for gap in gaps:
        share = f", {gap.difference.mean / abs(gap.first.mean):+.1%}" if gap.first.mean else ""
        lines.append(
            f"gap of {gap.figure}: {first} {gap.first.mean:.4g}, {second} {gap.second.mean:.4g}, difference "
            f"{gap.difference.mean:+.3g} (95 % of {gap.difference.low:+.3g} to {gap.difference.high:+.3g}{share}; "
            f"{'paired by seed' if gap.paired else 'not paired'})"
        )
    return lines


def _unpaired(one: np.ndarray, two: np.ndarray, resamples: int = 2000) -> Interval:
    """Return the difference of two means with a bootstrap interval."""
    one, two = one[np.isfinite(one)], two[np.isfinite(two)]
    rng = np.random.default_rng(0)
    means = [x[rng.integers(0, len(x), (resamples, len(x)))].mean(axis=1) for x in (one, two)]
    low, high = np.quantile(means[1] - means[0], (0.025, 0.975))
    count = min(len(one), len(two))
    return Interval(
        float(two.mean() - one.mean()), float(low), float(high), float(np.median(two) - np.median(one)), count
    )
