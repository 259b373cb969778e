"""Tuners machine by machine: robust cost over that of the best other tuner on the same machine.

A median over machines hides which tuner wins where. Here a tuner is compared with the best of the others on each
machine, chosen with knowledge of the outcome.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tuning.bootstrap import bootstrap_interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tuning.compare.comparison import Comparison


@dataclass(frozen=True)
class RivalRow:
    """A tuner against the best of the others on each machine.

    rivals: Their names. machines: How many there are. median: Of the robust cost over that of the best rival, with
    `low` and `high`, the ends of its 95 % bootstrap interval over machines. better: Machines on which it is below all
    rivals.
    """

    tuner: str
    rivals: str
    machines: int
    median: float
    low: float
    high: float
    better: int


def against_the_best(comparison: Comparison, tuner: str, rivals: Sequence[str]) -> RivalRow:
    """Return a tuner against the best of others on each machine.

    Raises:
        ValueError: If there is no rival, or the tuner is one of them.
    """
    if not rivals or tuner in rivals:
        raise ValueError(f"rivals of {tuner} must be other tuners, at least one, not {', '.join(rivals) or 'none'}")
    own = np.array([row.robust_cost for row in comparison.of(tuner)])
    best = np.min([[row.robust_cost for row in comparison.of(name)] for name in rivals], axis=0)
    ratio = own / best
    low, high = bootstrap_interval(lambda drawn: np.median(drawn, axis=1), ratio)
    return RivalRow(tuner, ", ".join(rivals), len(ratio), float(np.median(ratio)), low, high, int(np.sum(ratio < 1.0)))


def all_rivals(comparison: Comparison) -> tuple[RivalRow, ...]:
    """Return every tuner against all others, the best first; nothing if there is but one."""
    names = [row.tuner for row in comparison.tuners]
    if len(names) < 2:
        return ()
    rows = [against_the_best(comparison, name, [other for other in names if other != name]) for name in names]
    return tuple(sorted(rows, key=lambda row: row.median))
