"""Settings of the phase currents of an open-loop stepper as amplitudes, and back; the torque that an amplitude holds.

A drive makes few different amplitudes of its settings: with `steps` in the device's `gains.toml` (32 for 0...255), a
setting s of 0...S gives (floor(s steps / (S + 1)) + 1) / steps of the largest.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drive_env.devices import Device
from drive_env.devices.gain_set import RUN, STANDBY
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers

RESERVE = 0.5  # of the holding torque, that a load takes: 30 degrees electrical, and half of the torque in reserve
LOAD_SHARE = 0.3  # of the holding torque at rated current, which a standby current withstands


def amplitude(device: Device, setting: ArrayLike) -> Floats:
    """Return the amplitude of the phase currents [A] of settings, at the wider range of the sense voltage."""
    highest, steps = _levels(device)
    level = np.floor(np.asarray(setting, float) * steps / (highest + 1)) + 1.0
    return np.asarray(device.current_full_scale * level / steps)


def setting_of(device: Device, current: ArrayLike) -> Integers:
    """Return the least setting with an amplitude of so much [A] or more; the highest if no setting has that much."""
    highest, steps = _levels(device)
    level = np.ceil(np.asarray(current, float) / device.current_full_scale * steps - 1e-9) - 1.0
    return np.clip(np.ceil(level * (highest + 1) / steps), 1, highest).astype(np.int64)


def rated_setting(device: Device, motor: Motor) -> int:
    """Return the highest setting whose amplitude is not above the motor's rated current; 1 if none is as low."""
    highest, steps = _levels(device)
    level = math.floor(motor.rated_current / device.current_full_scale * steps + 1e-9)
    return int(np.clip(level * (highest + 1) // steps - 1, 1, highest))


def holding_torque(motor: Motor, current: ArrayLike) -> Floats:
    """Return the holding torque [N m] of a current vector of an amplitude [A]; iron saturates."""
    i = np.asarray(current, float)
    return np.asarray(motor.torque_constant * i / np.sqrt(1.0 + motor.saturation * i * i))


def swing_period(motor: Motor) -> float:
    """Return the period of the rotor's free swing in its own field at rated current [s]: no current makes it faster."""
    return 2.0 * math.pi * math.sqrt(motor.inertia / (motor.n_p * float(holding_torque(motor, motor.rated_current))))


def current_for(motor: Motor, torque: ArrayLike) -> Floats:
    """Return the amplitude [A] whose holding torque times `RESERVE` is a torque [N m], at most the rated one."""
    needed = np.asarray(torque, float) / RESERVE / motor.torque_constant
    left = np.maximum(1.0 - motor.saturation * needed * needed, 1e-6)
    return np.minimum(needed / np.sqrt(left), motor.rated_current)


def currents_for(device: Device, motor: Motor, moving: ArrayLike, resting: ArrayLike) -> Integers:
    """Return gains whose run current moves a torque [N m], and whose standby current holds another, (n, count).

    Both withstand `LOAD_SHARE` of the holding torque from outside besides what rests on the axis. The device's other
    gains are 1, at least their lowest: they are no currents.
    """
    rest = current_for(motor, np.abs(resting) + LOAD_SHARE * motor.rated_torque)
    run = np.maximum(current_for(motor, moving), rest)
    return with_currents(device, motor, setting_of(device, run), setting_of(device, rest))


def with_currents(device: Device, motor: Motor, run: ArrayLike, standby: ArrayLike) -> Integers:
    """Return gains with these settings of run and standby current, none above the motor's rated one, (n, count)."""
    known, most = device.gains, rated_setting(device, motor)
    settings = np.broadcast_arrays(*map(np.atleast_1d, (run, standby)))
    gains = np.tile(np.maximum(known.lowest, 0), (len(settings[0]), 1))
    for part, value in zip((RUN, STANDBY), settings, strict=True):
        column = known.column(*part)
        if column is not None:
            gains[:, column] = np.minimum(value, most)
    return gains


def run_and_standby(device: Device, gains: Integers) -> tuple[Floats, Floats]:
    """Return the amplitudes [A] of gains' run and standby current, (n,) each; without the second the first."""
    known = device.gains
    run, standby = known.column(*RUN), known.column(*STANDBY)
    assert run is not None, "an open loop has a run current"
    moving = amplitude(device, gains[:, run])
    return moving, moving if standby is None else amplitude(device, gains[:, standby])


def _levels(device: Device) -> tuple[int, int]:
    column = device.gains.column(*RUN)
    assert column is not None, "an open loop has a run current"
    row = device.gains.rows[column]
    return row.highest, row.steps or row.highest + 1
