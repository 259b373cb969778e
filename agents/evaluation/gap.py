"""The difference between two evaluations of a policy: on the emulator and on the bus, figure by figure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.evaluation.evaluation import Evaluation
from agents.evaluation.scores import Interval, interval
from mechanics.arrays import Floats
from tuning.bootstrap import bootstrap_interval

EMULATOR = "emulator"  # as a side: machines that are drawn for each episode


class Gap(NamedTuple):
    """A figure on two sides, such as emulator and bus.

    first, second: The figure on the first and on the second side.
    difference: Second minus first, with its 95 % interval; by pairs of equal seeds if `paired`.
    paired: Whether both sides ran the same episodes on the same machines.
    medians: (low, value, high) of the quotient of the medians minus 1, second over first, with its 95 % interval; NaN
        if the first one is 0.
    """

    figure: str
    first: Interval
    second: Interval
    difference: Interval
    paired: bool
    medians: tuple[float, float, float]


def compare(first: Evaluation, second: Evaluation) -> list[Gap]:
    """Return the gap of each figure that both evaluations have.

    Raises:
        ValueError: If the evaluations are of different environments.
    """
    if first.environment != second.environment:
        raise ValueError(f"{first.environment} and {second.environment} cannot be compared: they are different tasks")
    paired = first.seeds == second.seeds and _met_the_same(first, second)
    found = []
    for name in first.values:
        if name not in second.values:
            continue
        one, two = np.array(first.values[name]), np.array(second.values[name])
        difference = interval(two - one) if paired else _unpaired(one, two)
        medians = _medians(one, two, paired)
        found.append(Gap(name, first.interval(name), second.interval(name), difference, paired, medians))
    return found


def _met_the_same(first: Evaluation, second: Evaluation) -> bool:
    """Return whether episodes of one seed have the same machine on both sides.

    Emulated machines are drawn by the seed from the configuration; the machines of a bus are fixed.
    """
    if EMULATOR not in (first.side, second.side):
        return True
    return first.side == second.side and first.configuration == second.configuration


def text(gaps: list[Gap], first: str, second: str) -> list[str]:
    """Return the gap as lines of text."""
    lines = []
    for gap in gaps:
        share = f", {gap.difference.mean / abs(gap.first.mean):+.1%}" if gap.first.mean else ""
        low, value, high = gap.medians
        medians = "" if np.isnan(value) else f", {value:+.1%} (95 % of {low:+.1%} to {high:+.1%})"
        lines.append(
            f"gap of {gap.figure}: {first} {gap.first.mean:.4g}, {second} {gap.second.mean:.4g}, difference "
            f"{gap.difference.mean:+.3g} (95 % of {gap.difference.low:+.3g} to {gap.difference.high:+.3g}{share}; "
            f"{'paired by seed' if gap.paired else 'not paired'}); medians {gap.first.median:.4g} and "
            f"{gap.second.median:.4g}{medians}"
        )
    return lines


def _medians(one: Floats, two: Floats, paired: bool) -> tuple[float, float, float]:
    """Return (low, value, high) of the quotient of the medians minus 1; NaN without episodes or for a median of 0."""
    if paired:
        both = np.isfinite(one) & np.isfinite(two)
        one, two = one[both], two[both]
    else:
        one, two = one[np.isfinite(one)], two[np.isfinite(two)]
    if not len(one) or not len(two) or np.median(one) == 0.0:
        return float("nan"), float("nan"), float("nan")
    low, high = bootstrap_interval(_excess_of_medians, one, two, paired=paired)
    return low, float(np.median(two) / np.median(one) - 1.0), high


def _excess_of_medians(one: Floats, two: Floats) -> Floats:
    """Return the quotient of the medians minus 1, draw by draw; draws whose first median is 0 are left out."""
    medians, others = np.median(one, axis=1), np.median(two, axis=1)
    held = medians != 0.0
    return np.asarray(others[held] / medians[held] - 1.0)


def _unpaired(one: Floats, two: Floats) -> Interval:
    """Return the difference of two means with a bootstrap interval."""
    one, two = one[np.isfinite(one)], two[np.isfinite(two)]
    low, high = bootstrap_interval(lambda x, y: y.mean(axis=1) - x.mean(axis=1), one, two, paired=False)
    count = min(len(one), len(two))
    return Interval(float(two.mean() - one.mean()), low, high, float(np.median(two) - np.median(one)), count)
