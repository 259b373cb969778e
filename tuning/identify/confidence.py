"""95 % intervals, from random scatter and from systematic errors."""

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
    """Return Student's two-sided quantile of `LEVEL` for degrees of freedom, at least one."""
    return float(stats.t.ppf(0.5 * (1.0 + LEVEL), max(freedom, 1.0)))


def gain_error(device: Device, motor: Motor, *, turns: bool = True) -> float:
    """Return the greatest relative error of all measured currents (95 %): the gain errors of the current sensors.

    No signal of the drive shows it, since it affects all measured currents equally. The two channels of a three-phase
    motor are averaged, so the error has a triangular distribution, unless the field is at rest and one channel carries
    all the current.
    """
    worst = max(abs(device.stage["adc_gain_error_a"].low), abs(device.stage["adc_gain_error_a"].high))
    if motor.kind == "dc" or not turns:
        return LEVEL * worst
    return (1.0 - math.sqrt(1.0 - LEVEL)) * worst


def interval(value: float, scatter: float, systematic: float, unit: str, absolute: float = 0.0) -> Estimate:
    """Return an estimate whose interval combines three independent errors.

    Args:
        value: The value.
        scatter: Half width of the interval by the scatter of the data [unit].
        systematic: Half width of errors proportional to the value, as a share of it.
        unit: Unit of the value.
        absolute: Half width of other errors that repetition does not show [unit].
    """
    half = math.sqrt(scatter**2 + (systematic * value) ** 2 + absolute**2)
    return Estimate(value, value - half, value + half, unit)
