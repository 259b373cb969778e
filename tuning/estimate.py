"""A value with its 95 % interval, or the reason why it was not identified."""

from __future__ import annotations

import math
from typing import NamedTuple


class Estimate(NamedTuple):
    """A value with its 95 % confidence interval; one that was not identified is nan, with the `reason`."""

    value: float
    low: float
    high: float
    unit: str
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether there is a value."""
        return math.isfinite(self.value)


def interval(low: float, high: float) -> str:
    """Return an interval in words; that of a whole number without doubt is "exact"."""
    return "exact" if low == high else f"{low:.4g} to {high:.4g}"


def refused(unit: str, reason: str) -> Estimate:
    """Return the estimate of what could not be identified."""
    return Estimate(math.nan, math.nan, math.nan, unit, reason)
