"""Stepper motors on the bare stepper drive, and their closed forms: what the tests of the stepper firmware stand on."""

from __future__ import annotations

import math

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import MOTORS
from rigs import TESTS

BARE = str(TESTS / "bare_stepper")
MICROSTEPS = 51200  # a turn, by the scale of the bare drive
FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0, "load.inertia": 1e-12}
SMOOTH = FREE | {"motor.detent_torque": 0.0, "motor.coulomb": 0.0, "motor.viscous": 0.0}


def build(motor="qsh4218_51", *, current=None, parameters=None, **options):
    """Return drives of a motor whose largest current is a share of the rated one, or all of it; not yet enabled."""
    options = {"num_threads": 1, "supply": MOTORS[motor].voltage, **options}
    drives = EmulatedDrives(BARE, "inertia", motor, parameters=SMOOTH if parameters is None else parameters, **options)
    full = MOTORS[motor].rated_current * (1.0 if current is None else current)
    set_lanes(drives.inside.records, "full_scale_current", np.full(drives.num_axes, full))
    return drives


def lane(drives, name, part=0):
    """Return a field of every axis."""
    return get_lanes(drives.inside.records, name, drives.num_axes, part).astype(float)


def holding_torque(motor, amplitude):
    """Return the largest torque [N m] of a current vector of that size [A]."""
    return motor.n_p * motor.psi_m * amplitude / math.sqrt(1.0 + motor.saturation * amplitude**2)


def hold(drives, mode="pp"):
    """Enable, and let currents and rotor settle."""
    motion.enable(drives, mode=mode)
    drives.advance(0.05)


def pull_out(motor, speed, supply, amplitude):
    """Return the largest torque [N m] at constant speed [rad/s], friction taken away, by an integration of its own.

    Of each lag of the rotor behind the field the periodic currents of two ideal comparators: each phase gets the whole
    supply, one way or the other, until its current is where the table wants it. Forward Euler in 1/2000 of a period.
    """
    lag = np.radians(np.arange(20.0, 178.0, 2.0))
    w, steps, periods = motor.n_p * speed, 2000, 12
    dt = 2.0 * math.pi / w / steps
    i_a, i_b = amplitude * np.ones_like(lag), np.zeros_like(lag)
    torque = np.zeros_like(lag)
    for k in range(steps * periods):
        field = 2.0 * math.pi * k / steps
        s, c = np.sin(field - lag), np.cos(field - lag)
        psi = motor.psi_m / np.sqrt(1.0 + motor.saturation * (i_a * i_a + i_b * i_b))
        free_a = i_a + dt / motor.L_q * (psi * w * s - motor.R_s * i_a)
        free_b = i_b - dt / motor.L_q * (psi * w * c + motor.R_s * i_b)
        most = dt / motor.L_q * supply
        i_a = np.clip(amplitude * math.cos(field), free_a - most, free_a + most)
        i_b = np.clip(amplitude * math.sin(field), free_b - most, free_b + most)
        if k >= steps * (periods - 1):
            torque += motor.n_p * psi * (i_b * c - i_a * s) / steps
    return float(torque.max()) - motor.coulomb - motor.viscous * speed
