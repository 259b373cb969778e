"""Commissioning of a TMCM-1636 for a motor, from the motor's data alone; a preset that is written goes before it.

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
PEAK = 2.0  # of the rated current, as far as the stage carries it for ever
SPEED = 0.5  # of the rated speed
TORQUE = 0.4  # of the rated torque, for ramps of that inertia
SCALE = 65536  # increments of a revolution, as the factory leaves it
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
    brushed = motor.kind == "dc"
    current = min(PEAK * motor.rated_current, device.nominal_current)
    rpm = max(SPEED * motor.rated_speed * 30.0 / math.pi, 1.0)
    ramp = TORQUE * motor.rated_torque / (ROTORS * motor.inertia) / (2.0 * math.pi)  # rev/s^2
    acceleration = _rounded(ramp) * SCALE
    objects: dict[str, float] = {"Motor Type": 1 if brushed else 3, "Commutation Mode": 3}
    objects["Motor Pole Pairs"] = motor.n_p
    if motor.encoder_direction:
        objects["ABN Encoder Settings.Encoder Direction"] = 1
    if motor.hall_polarity:
        objects["Hall Sensor Settings.Hall Polarity"] = 1
    if motor.hall_direction:
        objects["Hall Sensor Settings.Hall Direction"] = 1
    objects["ABN Encoder Settings.Encoder Steps"] = motor.encoder_counts
    if not brushed:
        objects["ABN Encoder Settings.Encoder Init Mode"] = 1  # use offset
    objects |= {
        "Maximum Current": max(round(current * 10.0) * 100, 1),
        "Torque Mode Settings.Torque_P": gains.torque_p,
        "Torque Mode Settings.Torque_I": gains.torque_i,
        "Velocity Mode Settings.P_Parameter": gains.velocity_p,
        "Velocity Mode Settings.I_Parameter": gains.velocity_i,
        "Position Mode Settings.P_Parameter": gains.position_p,
        "Profile velocity": _rounded(rpm, 3) * SCALE / 60.0,
        "Profile acceleration": acceleration,
        "Profile deceleration": acceleration,
        "Quick stop deceleration": 2.0 * acceleration,
        "Homing acceleration": acceleration,
        "Following error window": WINDOW * SCALE,
        "Position window": 200,
        "Position window time": 2,
    }
    return {name: round(value) for name, value in objects.items()}


def _rounded(value: float, digits: int = 2) -> float:
    """Return a number of a few digits, as people choose it."""
    unit = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return round(value / unit) * unit
