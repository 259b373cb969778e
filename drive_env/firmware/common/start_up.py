"""States of a motor's start-up: preparations before the modes may move it, such as finding the rotor's angle."""

from __future__ import annotations

from mechanics.kernels.compiled import stage

NEEDED, FIRST_ANGLE, SECOND_ANGLE, DONE, FAILED = 0, 1, 2, 3, 4


@stage
def is_busy(drive, lane):
    """Return whether the start-up turns the motor, so that the mode must wait."""
    return drive.init_state[lane] == FIRST_ANGLE or drive.init_state[lane] == SECOND_ANGLE
