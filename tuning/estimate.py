"""A value with its 95 % interval, or the reason why it was not identified."""

from __future__ import annotations

import math
from typing import NamedTuple


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval; nan with the `reason` if it was not identified."""

    value: float
    low: float
    high: float
    unit: str
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether the value was identified."""
        return math.isfinite(self.value)


def interval(low: float, high: float) -> str:
    """Format an interval; one of zero width, as of an identified whole number, is "exact"."""
    return "exact" if low == high else f"{low:.4g} to {high:.4g}"


def refused(unit: str, reason: str) -> Estimate:
    """Return the estimate for a value that could not be identified: nan, with the reason."""
    return Estimate(math.nan, math.nan, math.nan, unit, reason)
