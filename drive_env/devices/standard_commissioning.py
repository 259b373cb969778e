"""Commissioning of any CiA 402 drive for a motor, from the motor's data alone.

Gains are those of our servo cascade; speeds, ramps and windows are class values, each in the unit that the drive's
bindings give it. They are to move any sound machine, not to be good; a file of the device's own presets goes before.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.devices.standard_objects import HOMING_HERE
from drive_env.dictionary.codec import code_of, encode_one
from drive_env.dictionary.position_scale import position_scale
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import Context

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import ObjectDictionary
    from drive_env.motors import Motor

ROTORS = 3.0  # total inertia, in rotors
CURRENT_HZ, VELOCITY_HZ, POSITION_HZ = 1000.0, 20.0, 5.0
PEAK = 2.0  # of the rated current
SPEED, HOMING_SPEED, SLOW_SPEED = 0.5, 0.05, 0.01  # of the rated speed
TORQUE = 0.4  # of the rated torque, for ramps of that inertia
WINDOW, LAG = (
    0.003,
    10.0,
)  # revolutions: of rest at a target; of a following error, since the loops have no feed-forward
WINDOW_TIME = 0.002  # s


def preset(device: Device, motor: Motor) -> dict[str, int]:
    """Return object ("6081:0") -> raw value, in the order of writing.

    Raises:
        ValueError: If a gain leaves the drive's range: the motor does not suit this drive.
    """
    from drive_env.devices.gains import bandwidth_gains

    dictionary = device.new_dictionary()
    found = _scale(device, dictionary, motor)
    context = Context(_increments(device, dictionary, found), device.current_full_scale / 32768.0, device.rated_current)
    values = _values(motor)
    for key, binding in device.bindings.items():
        entry = dictionary.find(key)
        if binding.field not in values or entry.access in ("ro", "const") or _text(key) in found:
            continue
        code = code_of(entry, binding)
        raw = encode_one(code, values[binding.field], code.factor(context))
        found[_text(key)] = max(raw, 1) if values[binding.field] > 0.0 and raw == 0 else raw
    gains = bandwidth_gains(
        device, motor, ROTORS * motor.inertia, current_hz=CURRENT_HZ, velocity_hz=VELOCITY_HZ, position_hz=POSITION_HZ
    )
    found |= {_text(row.key): int(raw) for row, raw in zip(device.gains.rows, gains, strict=True)}
    for index, rated in (
        (cia402.RATED_CURRENT, 1e3 * motor.rated_current),
        (cia402.RATED_TORQUE, 1e3 * motor.rated_torque),
    ):
        if dictionary.has(index) and dictionary.find(index).access not in ("ro", "const"):
            found[_text((index, 0))] = max(round(rated), 1)
    methods = device.allowed_values.get((cia402.HOMING_METHOD, 0), ())
    if methods and dictionary.find(cia402.HOMING_METHOD).default not in methods:
        found[_text((cia402.HOMING_METHOD, 0))] = next((one for one in HOMING_HERE if one in methods), methods[-1])
    return found


def _values(motor: Motor) -> dict[str, float]:
    """Return field of the record -> SI value."""
    brushed = motor.kind == "dc"
    ramp = TORQUE * motor.rated_torque / (ROTORS * motor.inertia)
    return {
        "motor_type": 1.0 if brushed else 3.0,
        "commutation_mode": 3.0,  # by the encoder
        "pole_pairs": motor.n_p,
        "encoder_direction": float(motor.encoder_direction),
        "encoder_steps": motor.encoder_counts,
        "encoder_init_mode": 0.0 if brushed else 1.0,  # use offset
        "hall_polarity": float(motor.hall_polarity),
        "hall_direction": float(motor.hall_direction),
        "i_max": PEAK * motor.rated_current,
        "max_velocity": SPEED * motor.rated_speed,
        "acceleration": ramp,
        "deceleration": ramp,
        "quick_stop_deceleration": 2.0 * ramp,
        "homing_fast": HOMING_SPEED * motor.rated_speed,
        "homing_slow": SLOW_SPEED * motor.rated_speed,
        "homing_acceleration": ramp,
        "following_error_window": LAG * 2.0 * math.pi,
        "position_window": WINDOW * 2.0 * math.pi,
        "position_window_time": WINDOW_TIME,
        "position_min": -math.inf,
        "position_max": math.inf,
        "velocity_limit": 0.0,
    }


def _scale(device: Device, dictionary: ObjectDictionary, motor: Motor) -> dict[str, int]:
    """Return the values that the scale of positions gets, counts of the encoder; {} if the factory's make a scale."""
    scale = position_scale(device.roles)
    if scale is None:
        return {}
    factory = [int(dictionary.find(key).default) for key in scale.keys]
    if all(value > 0 for value in factory):
        return {}
    first = motor.encoder_counts if Role.FEED not in device.roles else round(motor.encoder_counts)
    return {_text(key): round(first) if k == 0 else 1 for k, key in enumerate(scale.keys)}


def _increments(device: Device, dictionary: ObjectDictionary, found: dict[str, int]) -> float:
    scale = position_scale(device.roles)
    if scale is None:
        return 65536.0
    values = [found.get(_text(key), dictionary.find(key).default) for key in scale.keys]
    return float(scale.increments([np.array(float(value)) for value in values]))


def _text(key: tuple[int, int]) -> str:
    return f"{key[0]:04X}:{key[1]}"
