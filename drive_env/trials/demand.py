"""The position demand of a move in pp: read from the drive, or computed from the profile written to it.

Drives without 6062h in their process data get a demand computed from the written profile. It equals the drive's to
about a millisecond, since the time at which a set-point written by SDO takes effect is unknown.
"""

from __future__ import annotations

import numpy as np

from drive_env import cia402
from drive_env.drives.interface import CYCLE, Drives
from drive_env.trials.positioning import Move
from mechanics.arrays import Floats, Integers

COMPUTED = (
    "the position demand (6062h) is in no process data of this drive: that of a move is computed from target, profile "
    "velocity and acceleration, to about a millisecond, and not recorded"
)


def is_recorded(drives: Drives) -> bool:
    """Return whether the drives can record their position demand."""
    return drives.bus is None or drives.bus.can_record([cia402.POSITION_DEMAND])


def computed(begin: Integers, target: Integers, move: Move, cycles: int) -> Floats:
    """Return the demand of the profile of a move from rest to rest [inc], shape (cycles, num_axes).

    Args:
        begin: First position [inc], (num_axes,).
        target: Last position [inc], (num_axes,).
        move: Its velocity and acceleration.
        cycles: Number of cycles, the first at the beginning.
    """
    way = np.asarray(target, float) - begin
    distance = np.abs(way)
    acceleration = np.asarray(move.acceleration, float)
    speed = np.minimum(move.velocity, np.sqrt(distance * acceleration))
    ramp = speed / acceleration
    end = np.where(distance > 0.0, distance / np.maximum(speed, 1e-9) + ramp, 0.0)
    t = np.minimum(np.arange(cycles)[:, None] * CYCLE, end)
    rising, falling = np.minimum(t, ramp), np.maximum(t - (end - ramp), 0.0)
    gone = 0.5 * acceleration * rising**2 + speed * (t - rising) - 0.5 * acceleration * falling**2
    return np.asarray(begin + np.sign(way) * np.rint(np.minimum(gone, distance)))
