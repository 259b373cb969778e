"""The incremental encoder for all kinds of drives: its fields, noise, and counter."""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.record import LANES, Field
from mechanics.kernels.compiled import inlined

U32 = np.uint32  # without it every operation of the generator widens to 64 bits
# Sum of four random bytes: mean 510, variance 4 (256^2 - 1) / 12.
BYTES_MEAN = 510.0
BYTES_SCALE = 1.0 / (4.0 * 65535.0 / 12.0) ** 0.5

PARAMETERS = (
    Field("encoder_direction", "f8", "", "1: the drive takes its counts backwards"),
    Field("encoder_steps", "f8", "1/rev", "counts a turn: the drive's belief", 8192.0),
    Field("velocity_filter_b", "f8", "1", "first numerator coefficient of the velocity filter; the others 2b, b"),
    Field("velocity_filter_a", "f8", "1", "denominator coefficients of the velocity filter", depth=2),
    Field("encoder_true_direction", "f8", "", "1: channels A and B are exchanged, the encoder counts backwards"),
    Field("encoder_broken", "f8", "", "1: the encoder's cable is broken, it does not count"),
    Field("encoder_counts", "f8", "1/rev", "counts per turn, interpolation included", 4096.0),
    Field("encoder_interpolation", "f8", "1", "counts per encoder step: above 1 an interpolated analog encoder", 1.0),
    Field("encoder_line_error", "f8", "rad", "once-per-turn error of the encoder disc, mechanical angle"),
    Field("encoder_line_phase", "f8", "rad", "phase of that error"),
    Field("encoder_gain", "f8", "1", "counts per true count: below 1 some are lost, 0 stuck", 1.0),
    Field("encoder_noise", "f8", "rad", "rms noise of the encoder's angle"),
    Field("index_angle", "f8", "rad", "of the rotor, at which the encoder's index begins; it is one count wide"),
)

STATE = (
    Field("block_has_noisy_encoder", "i4", "", "lane 0: 1 if a lane of this block has a noisy encoder"),
    Field("count", "f8", "", "encoder count"),
    Field("count_zero", "f8", "", "encoder count at power-on"),
    Field("encoder_error", "f8", "rad", "disc error at the present angle, and noise"),
    Field("encoder_shake", "f8", "rad", "noise of the encoder in this window"),
    Field("encoder_random", "f8", "", "state of that noise's generator, an unsigned 32-bit integer", 1.0),
    Field("velocity_filter_z", "f8", "rad/s", "state of the velocity filter", depth=2),
    Field("true_edges", "f8", "", "edges of the encoder's disc at its angle of the last window"),
    Field("turns_per_count", "f8", "rev", "1 / encoder_steps, signed by the encoder's direction"),
    Field("counts_per_rad", "f8", "1/rad", "encoder_counts / 2 pi"),
)


@inlined
def shake_encoders(drive):
    """Draw the noise of the encoders for one window: writes encoder_shake [rad]; it has a generator of its own."""
    for lane in range(LANES):
        x = U32(drive.encoder_random[lane])
        x = U32(x ^ U32(x << U32(13)))
        x = U32(x ^ U32(x >> U32(17)))
        x = U32(x ^ U32(x << U32(5)))
        drive.encoder_random[lane] = x
        pairs = U32(U32(x & U32(0x00FF00FF)) + U32(U32(x >> U32(8)) & U32(0x00FF00FF)))
        total = np.int32(U32(U32(pairs & U32(0xFFFF)) + U32(pairs >> U32(16))))
        drive.encoder_shake[lane] = drive.encoder_noise[lane] * (np.float64(total) - BYTES_MEAN) * BYTES_SCALE


@inlined
def encoder_count(edges, backwards):
    """Return the counter after a number of edges, whole or not; backwards if `backwards` is 1.

    Edge 0 lies between 0 and -1 for both wirings: the drive's direction, 2080h:01, restores the angle.
    """
    count = np.floor(edges)
    return count + backwards * (-1.0 - 2.0 * count)


@inlined
def derive_counter(drive, lane):
    """Compute the quotients of the encoder: writes turns_per_count and counts_per_rad."""
    # 2080h:02 and 608Fh may be 0, with which no encoder can be counted.
    steps = drive.encoder_steps[lane] * drive.encoder_interpolation[lane]
    steps = steps if steps > 0.0 else 1.0
    drive.turns_per_count[lane] = (1.0 - 2.0 * drive.encoder_direction[lane]) / steps
    drive.counts_per_rad[lane] = drive.encoder_counts[lane] * (1.0 / TWO_PI) * drive.encoder_gain[lane]


@inlined
def count_at(drive, lane, angle):
    """Return the counter at an angle of the disc [rad]; a broken encoder's does not change."""
    count = encoder_count(angle * drive.counts_per_rad[lane], drive.encoder_true_direction[lane])
    return drive.count[lane] if drive.encoder_broken[lane] > 0.5 else count


@inlined
def read_counter(drive, lane):
    """Compute the disc's error, and return the present counter."""
    s, _ = sine_cosine(drive.theta_m[lane] + drive.encoder_line_phase[lane])
    drive.encoder_error[lane] = drive.encoder_line_error[lane] * s + drive.encoder_shake[lane]
    return count_at(drive, lane, drive.theta_m[lane] + drive.encoder_error[lane])


@inlined
def forget_velocity(drive, lane):
    """Reset the velocity filter."""
    drive.velocity_filter_z[0, lane] = 0.0
    drive.velocity_filter_z[1, lane] = 0.0


@inlined
def start_counter(drive, lane):
    """Start counting at the disc's present angle, and return its edges there."""
    forget_velocity(drive, lane)
    s, _ = sine_cosine(drive.theta_m[lane] + drive.encoder_line_phase[lane])
    drive.encoder_error[lane] = drive.encoder_line_error[lane] * s
    edges = (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] / TWO_PI
    drive.count[lane] = encoder_count(edges * drive.encoder_gain[lane], drive.encoder_true_direction[lane])
    drive.count_zero[lane] = drive.count[lane]
    return edges


@inlined
def find_noise(drive):
    """Write whether a lane of the block has a noisy encoder."""
    drive.block_has_noisy_encoder[0] = 0
    for lane in range(LANES):
        # Once more after the noise has ended, so that the angle contains none of it.
        if drive.encoder_noise[lane] > 0.0 or drive.encoder_shake[lane] != 0.0:
            drive.block_has_noisy_encoder[0] = 1


@inlined
def filtered_velocity(drive, lane, raw):
    """Return a velocity [rad/s] after the second-order low-pass, whose state it advances by a window."""
    b = drive.velocity_filter_b[lane]
    omega = b * raw + drive.velocity_filter_z[0, lane]
    drive.velocity_filter_z[0, lane] = (
        2.0 * b * raw - drive.velocity_filter_a[0, lane] * omega + drive.velocity_filter_z[1, lane]
    )
    drive.velocity_filter_z[1, lane] = b * raw - drive.velocity_filter_a[1, lane] * omega
    return omega


@inlined
def index_in_window(drive, lane, edges, first, up):
    """Return whether the index came in the last window, at which edge, and the count there.

    Args:
        drive: The record.
        lane: Lane of the axis.
        edges: Edges of the disc at its present angle.
        first: Edge at which the index becomes active in that direction, of any turn.
        up: 1 if it turned upwards, or stood; 0 if downwards.
    """
    counts = drive.encoder_counts[lane]
    before = drive.true_edges[lane]
    turn = np.floor((edges - first) / counts)
    turn_before = np.floor((before - first) / counts)
    sees = drive.encoder_broken[lane] < 0.5 and drive.encoder_gain[lane] > 0.0
    came = sees and turn != turn_before
    at = first + counts * (turn if turn > turn_before else turn_before)
    count = encoder_count(at * drive.encoder_gain[lane] + up - 0.5, drive.encoder_true_direction[lane])
    return came, at, count
