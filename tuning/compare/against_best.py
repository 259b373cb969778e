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


def all_rivals(comparison: Comparison) -> tuple[RivalRow, ...]:
    """Return every tuner against the best of all others on each machine, the best first; nothing of one alone."""
    costs = {one.tuner: np.array([row.robust_cost for row in comparison.of(one.tuner)]) for one in comparison.tuners}
    rows = []
    for name, own in costs.items():
        others = [other for other in costs if other != name]
        if others:
            ratio = own / np.min([costs[other] for other in others], axis=0)
            low, high = bootstrap_interval(lambda drawn: np.median(drawn, axis=1), ratio)
            figures = float(np.median(ratio)), low, high, int(np.sum(ratio < 1.0))
            rows.append(RivalRow(name, ", ".join(others), len(ratio), *figures))
    return tuple(sorted(rows, key=lambda row: row.median))
