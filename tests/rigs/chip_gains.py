"""Gains of the servo drives whose set is the chip's, by name, and what they mean."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from drive_env.devices import gains as gains_of_chip


class Gains(NamedTuple):
    """Raw integers of a cascade of PI, PI and P loops, as the chip counts them."""

    torque_p: int
    torque_i: int
    velocity_p: int
    velocity_i: int
    position_p: int


class Bandwidths(NamedTuple):
    """The bandwidths of gains on a motor with a total inertia.

    current_hz, velocity_hz [Hz], velocity_integration_s [s], position_hz [Hz] (k_v / 2 pi).
    """

    current_hz: float
    velocity_hz: float
    velocity_integration_s: float
    position_hz: float


def chip_gains(*device_motor_inertia: Any, **wanted: float) -> Gains:
    """Return `bandwidth_gains` by name."""
    return Gains(*gains_of_chip.bandwidth_gains(*device_motor_inertia, **wanted).tolist())


def bandwidths_from_gains(
    device: Any, motor: Any, inertia: float, gains: Any, *, supply: float | None = None
) -> Bandwidths:
    """Return the bandwidths of a device's gains; the inverse of `bandwidth_gains`. nan for gains that it lacks."""
    two_pi = 2.0 * math.pi
    torque_p, _, velocity_p, velocity_i, position_p = gains_of_chip.as_chip(device, gains)
    return Bandwidths(
        current_hz=torque_p / gains_of_chip._torque_p_scale(device, motor, supply) / two_pi,
        velocity_hz=velocity_p / gains_of_chip._velocity_p_scale(device, motor, inertia) / two_pi,
        velocity_integration_s=65536.0 / device.velocity_rate / velocity_i if velocity_i else math.inf,
        position_hz=position_p / gains_of_chip._POSITION_P_SCALE / two_pi,
    )
