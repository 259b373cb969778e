"""What a stepper drive knows of its position: its own steps, and an encoder on the shaft where there is one."""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.common.encoder import encoder_count
from drive_env.firmware.record import LANES
from mechanics.compiled import inlined


@inlined
def derive_encoder(drive):
    """Compute the quotients of the encoder: writes turns_per_count and counts_per_rad."""
    for lane in range(LANES):
        # 608Fh may be 0, which is no encoder that could be counted with.
        steps = drive.encoder_steps[lane] * drive.encoder_interpolation[lane]
        steps = steps if steps > 0.0 else 1.0
        drive.turns_per_count[lane] = (1.0 - 2.0 * drive.encoder_direction[lane]) / steps
        drive.counts_per_rad[lane] = drive.encoder_counts[lane] * (1.0 / TWO_PI) * drive.encoder_gain[lane]


@inlined
def measure_motion(drive, h):
    """Read step counter and encoder once per window of h [s].

    Writes theta_meas and omega_meas, which are the steps', theta_encoder, omega_encoder, position_actual and
    deviation.
    """
    for lane in range(LANES):
        s, _ = sine_cosine(drive.theta_m[lane] + drive.encoder_line_phase[lane])
        drive.encoder_error[lane] = drive.encoder_line_error[lane] * s + drive.encoder_shake[lane]
        edges = (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.counts_per_rad[lane]
        count = encoder_count(edges, drive.encoder_true_direction[lane])
        before = drive.count[lane]
        count = before if drive.encoder_broken[lane] > 0.5 else count
        per_count = TWO_PI * drive.turns_per_count[lane]
        steps = drive.step_position[lane] - drive.home_shift[lane]
        encoder = (count - drive.count_zero[lane]) * per_count - drive.home_shift[lane]
        drive.count[lane] = count
        drive.theta_meas[lane] = steps
        drive.omega_meas[lane] = drive.step_rate[lane]
        drive.theta_encoder[lane] = encoder
        actual = encoder if drive.position_sensor[lane] > -0.5 else steps
        drive.position_actual[lane] = actual
        drive.deviation[lane] = steps - actual
        raw = (count - before) * per_count / h
        b = drive.velocity_filter_b[lane]
        omega = b * raw + drive.velocity_filter_z[0, lane]
        drive.velocity_filter_z[0, lane] = (
            2.0 * b * raw - drive.velocity_filter_a[0, lane] * omega + drive.velocity_filter_z[1, lane]
        )
        drive.velocity_filter_z[1, lane] = b * raw - drive.velocity_filter_a[1, lane] * omega
        drive.omega_encoder[lane] = omega
