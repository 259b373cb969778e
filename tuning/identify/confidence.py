"""95 % intervals, from scatter and from systematic errors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from scipy import stats

from tuning.estimate import Estimate

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor

LEVEL = 0.95


def t_quantile(freedom: float) -> float:
    """Return Student's two-sided quantile of `LEVEL` for so many degrees of freedom, at least one."""
    return float(stats.t.ppf(0.5 * (1.0 + LEVEL), max(freedom, 1.0)))


def gain_error(device: Device, motor: Motor, *, turns: bool = True) -> float:
    """Return by what share a measured current may be wrong altogether: the gain errors of the sensors, 95 %.

    No signal of the drive shows it: whatever is measured in amperes has it. The two channels of a three-phase motor
    are averaged, whose error has a triangular distribution, unless its field stands and one of them sees it all.
    """
    worst = max(abs(device.stage["adc_gain_error_a"].low), abs(device.stage["adc_gain_error_a"].high))
    if motor.kind == "dc" or not turns:
        return LEVEL * worst
    return (1.0 - math.sqrt(1.0 - LEVEL)) * worst


def interval(value: float, scatter: float, systematic: float, unit: str, absolute: float = 0.0) -> Estimate:
    """Return an estimate.

    Args:
        value: The value.
        scatter: Half of the interval that the data's scatter leaves [unit].
        systematic: Half of what scales with the value, as a share of it.
        unit: Its unit.
        absolute: Half of what else no repetition shows [unit].
    """
    half = math.sqrt(scatter**2 + (systematic * value) ** 2 + absolute**2)
    return Estimate(value, value - half, value + half, unit)
