"""The encoder's index (channel N) on a servo motor: it is searched only during homing.

It is active for one count of each turn, at a true angle of the disc, and counts when N becomes active: upwards at its
first edge, downwards at its second one. An absolute encoder's is at the beginning of its turn.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.common.encoder import index_in_window
from drive_env.firmware.common.modes import hm
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined, stage


@stage
def find_whether_index_is_needed(drive):
    """Write whether a lane of the block is homing, and the discs' angles when the first one begins."""
    looks = 0
    for lane in range(LANES):
        looks = 1 if hm.is_running(drive, lane) else looks
    if looks == 1 and drive.block_looks_for_index[0] == 0:
        for lane in range(LANES):
            angle = drive.theta_m[lane] + drive.encoder_error[lane]
            drive.true_edges[lane] = angle * drive.encoder_counts[lane] * (1.0 / TWO_PI)
    drive.block_looks_for_index[0] = looks


@inlined
def watch_index(drive):
    """Search the index in the last window: writes index_seen and index_position [rad]."""
    for lane in range(LANES):
        counts = drive.encoder_counts[lane]
        edges = (drive.theta_m[lane] + drive.encoder_error[lane]) * counts * (1.0 / TWO_PI)
        up = 1.0 if edges >= drive.true_edges[lane] else 0.0
        first = np.floor(drive.index_angle[lane] * counts * (1.0 / TWO_PI)) + 1.0 - up
        came, _, count = index_in_window(drive, lane, edges, first, up)
        per_count = (1.0 - 2.0 * drive.shaft_direction[lane]) * TWO_PI * drive.turns_per_count[lane]
        by_encoder = (count - drive.count_zero[lane]) * per_count - drive.home_shift[lane]
        # With hall commutation the halls may give the position.
        by_hall = drive.angle_source[lane] == 2.0 and drive.always_use_encoder[lane] == 0.0
        position = drive.theta_meas[lane] if by_hall else by_encoder
        drive.index_seen[lane] = 1.0 if came else drive.index_seen[lane]
        drive.index_position[lane] = position if came else drive.index_position[lane]
        drive.true_edges[lane] = edges
