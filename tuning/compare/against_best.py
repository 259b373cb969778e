"""Each tuner against the best other tuner of each machine: ratio of their robust costs.

A median over machines hides which tuner is best on which machine. Here a tuner is compared on each machine with the
best of the others, which is chosen afterwards by the result.
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

    rivals: Names of the others.
    machines: Number of machines.
    median: Median over machines of the robust cost over that of the best rival.
    low, high: Ends of its 95 % bootstrap interval over machines.
    better: Number of machines on which the tuner has a lower cost than all rivals.
    """

    tuner: str
    rivals: str
    machines: int
    median: float
    low: float
    high: float
    better: int


def all_rivals(comparison: Comparison) -> tuple[RivalRow, ...]:
    """Compare every tuner with the best of all others on each machine, lowest median first; empty for one tuner."""
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
