"""Position of a stepper drive: its own steps, and an encoder on the shaft, if any.

The encoder's index (channel N) is active for one count of each turn, at a true angle of the disc. It counts when N
changes to the drive's active level: with the right polarity the counter then has the same value from both sides, with
the wrong one a count more. The steps are those at that time within the window.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.common.encoder import derive_counter, filtered_velocity, index_in_window, read_counter
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined


@inlined
def derive_encoder(drive):
    """Compute the quotients of the encoder, and the edge of its index."""
    for lane in range(LANES):
        derive_counter(drive, lane)
        # N is gated with A and B: it begins at an edge.
        drive.index_edge[lane] = np.floor(drive.index_angle[lane] * drive.encoder_counts[lane] * (1.0 / TWO_PI))


@inlined
def watch_index(drive):
    """Search the index in the last window: writes index_seen, index_position and the latch."""
    for lane in range(LANES):
        edges = (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] * (1.0 / TWO_PI)
        before = drive.true_edges[lane]
        up = 1.0 if edges >= before else 0.0
        wrong = abs(drive.index_polarity[lane] - drive.index_inverted[lane])
        # Upwards N becomes active at its first edge, downwards at its second, inverted vice versa.
        first = drive.index_edge[lane] + abs(1.0 - up - wrong)
        came, at, count = index_in_window(drive, lane, edges, first, up)
        moved = edges - before
        part = (at - before) / (moved if came else 1.0)
        seen = drive.step_seen[lane]
        steps = seen + part * (drive.step_position[lane] - seen) - drive.step_shift[lane] - drive.home_shift[lane]
        per_count = TWO_PI * drive.turns_per_count[lane]
        turned = (count - drive.count_zero[lane]) * per_count
        encoder = turned + drive.encoder_shift[lane] - drive.home_shift[lane]
        position = encoder if drive.position_sensor[lane] > -0.5 else steps
        drive.index_seen[lane] = 1.0 if came else drive.index_seen[lane]
        drive.index_position[lane] = position if came else drive.index_position[lane]
        latches = came and drive.latch_armed[lane] > 0.5
        drive.latch_steps[lane] = steps if latches else drive.latch_steps[lane]
        drive.latch_encoder[lane] = encoder if latches else drive.latch_encoder[lane]
        drive.latch_armed[lane] = 0.0 if latches else drive.latch_armed[lane]
        drive.true_edges[lane] = edges
        drive.step_seen[lane] = drive.step_position[lane]


@inlined
def measure_motion(drive, h):
    """Read step counter and encoder once per window of h [s].

    Writes theta_meas and omega_meas (of the steps), theta_encoder, omega_encoder, position_actual and deviation.
    """
    watch_index(drive)
    for lane in range(LANES):
        count = read_counter(drive, lane)
        before = drive.count[lane]
        per_count = TWO_PI * drive.turns_per_count[lane]
        turned = (count - drive.count_zero[lane]) * per_count
        # Without current the rotor may be turned by hand: then the axis' position is the encoder's. In a loop it is in
        # any case.
        is_off = drive.drive_function[lane] < 0.5 and drive.loop_closed[lane] < 0.5
        takes = is_off and drive.position_sensor[lane] > -0.5 and drive.takes_encoder_position[lane] > 0.5
        shift = drive.step_position[lane] - turned if takes else drive.step_shift[lane]
        steps = drive.step_position[lane] - shift - drive.home_shift[lane]
        encoder = turned - drive.home_shift[lane]
        drive.step_shift[lane] = shift
        drive.count[lane] = count
        drive.theta_meas[lane] = steps
        drive.omega_meas[lane] = drive.step_rate[lane]
        drive.theta_encoder[lane] = encoder
        actual = encoder if drive.position_sensor[lane] > -0.5 else steps
        drive.position_actual[lane] = actual
        drive.deviation[lane] = steps - actual
        raw = (count - before) * per_count / h
        drive.omega_encoder[lane] = filtered_velocity(drive, lane, raw)
