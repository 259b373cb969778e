"""The six axes of a TMCM-6212: their limits and travel in tests of faults, and two of them with a motor."""

from __future__ import annotations

import numpy as np

from drive_env import EmulatedDrives, Limits
from rigs.fault_injection import RADIANS

AXES, WIRED = 6, (1, 3)
TURN = 200 * 256  # microsteps
LIMITS = Limits(position=(-3 * TURN, 3 * TURN), velocity=6 * TURN)
TRAVEL = tuple(3 * sign * 2.0 * np.pi / RADIANS for sign in (-1, 1))  # as `problems` counts


def partly_wired(**options):
    """Return the six axes of a TMCM-6212 of which two have a motor."""
    no_motor = np.array([float(axis not in WIRED) for axis in range(AXES)])
    parameters = {"motor.open_a": no_motor, "motor.open_b": no_motor}
    return EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1, parameters=parameters, **options)
