"""Axes, limits and travel of a TMCM-6212 in tests of faults."""

from __future__ import annotations

import numpy as np

from drive_env import Limits
from rigs.fault_injection import (
    RADIANS,
)

AXES = 6
TURN = 200 * 256  # microsteps
LIMITS = Limits(position=(-3 * TURN, 3 * TURN), velocity=6 * TURN)
TRAVEL = tuple(3 * sign * 2.0 * np.pi / RADIANS for sign in (-1, 1))  # as `problems` counts
