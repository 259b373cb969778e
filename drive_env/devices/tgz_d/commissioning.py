"""Commissioning of a TGZ-D for a motor, from the motor's data alone; a preset that is written goes before it.

The gains are those of a total inertia of three rotors: current loop 1 kHz, velocity loop 20 Hz with T_i = 5/w_v,
position loop 5 Hz. They are to move any sound machine, not to be good.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor

ROTORS = 3.0  # total inertia, in rotors
CURRENT_HZ, VELOCITY_HZ, POSITION_HZ = 1000.0, 20.0, 5.0
PEAK = 2.0  # M-Ipeak over the rated current, as far as the stage carries it for ever
SPEED = 0.5  # of the rated speed
TORQUE = 0.4  # of the rated torque, for ramps of that inertia
DIVISOR = 1000  # of the velocity encoder resolution: velocity units are thousandths of rpm
TURN = 65536  # position units of a revolution, as the factory leaves it
WINDOW = 10  # revolutions: the loops have no feed-forward, and lag v/k_v


def preset(device: Device, motor: Motor) -> dict[str, int]:
    """Return object name -> raw value, in the order of writing.

    Raises:
        ValueError: If a gain leaves the drive's range: the motor does not suit this drive.
    """
    from drive_env.devices.gains import gains_from_bandwidths

    gains = gains_from_bandwidths(
        device, motor, ROTORS * motor.inertia, current_hz=CURRENT_HZ, velocity_hz=VELOCITY_HZ, position_hz=POSITION_HZ
    )
    current = min(PEAK * motor.rated_current, device.nominal_current)
    rpm = max(SPEED * motor.rated_speed * 30.0 / math.pi, 1.0)
    ramp = TORQUE * motor.rated_torque / (ROTORS * motor.inertia) * 30.0 / math.pi  # rpm/s
    acceleration = _rounded(ramp) * DIVISOR
    objects: dict[str, float] = {
        "Pole pairs": motor.n_p,
        "Feedback counts of a turn": motor.encoder_counts,
        "Feedback direction": motor.encoder_direction,
        "M-Ipeak": max(round(current * 10.0) * 100, 1),
        "Current loop P": gains.torque_p,
        "Current loop I": gains.torque_i,
        "Velocity loop P": gains.velocity_p,
        "Velocity loop I": gains.velocity_i,
        "Position loop P": gains.position_p,
        "Velocity encoder resolution.Divisor": DIVISOR,
        "Profile velocity": _rounded(rpm, 3) * DIVISOR,
        "Profile acceleration": acceleration,
        "Profile deceleration": acceleration,
        "Quick stop deceleration": 2.0 * acceleration,
        "Homing speeds.Speed during search for switch": 60 * DIVISOR,
        "Homing speeds.Speed during search for zero": 10 * DIVISOR,
        "Homing acceleration": acceleration,
        "Following error window": WINDOW * TURN,
        "Extension: Position window": 200,
    }
    return {name: round(value) for name, value in objects.items()}


def _rounded(value: float, digits: int = 2) -> float:
    """Return a number of a few digits, as people choose it."""
    unit = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return round(value / unit) * unit
