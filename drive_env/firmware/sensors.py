"""Sensors: incremental encoder, velocity from its counts, and the two phase-current channels."""

from __future__ import annotations

import numpy as np

from drive_env.firmware.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.record import LANES
from mechanics.compiled import inlined

SQRT3 = 3.0**0.5
U32 = np.uint32  # without it every operation of the generator widens to 64 bits
# Sum of four random bytes: mean 510, variance 4 (256^2 - 1) / 12.
_BYTES_MEAN = 510.0
_BYTES_SCALE = 1.0 / (4.0 * 65535.0 / 12.0) ** 0.5


@inlined
def measure_motion(drive, h):
    """Read the encoder at the velocity loop's rate, period h [s]: writes theta_meas, omega_meas.

    Velocity is the count difference per period through a second-order low-pass, so one count is real noise:
    at 4096 counts and 5 kHz it is 73 rpm before the filter.
    """
    for lane in range(LANES):
        s, _ = sine_cosine(drive.theta_m[lane] + drive.encoder_line_phase[lane])
        drive.encoder_error[lane] = drive.encoder_line_error[lane] * s
        count = np.floor(
            (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] * (1.0 / TWO_PI)
        )
        per_count = (
            (1.0 - 2.0 * drive.shaft_direction[lane])
            * (1.0 - 2.0 * drive.encoder_direction[lane])
            * TWO_PI
            / (drive.encoder_steps[lane] * drive.encoder_interpolation[lane])
        )
        raw = (count - drive.count[lane]) * per_count / h
        drive.count[lane] = count
        drive.theta_meas[lane] = (count - drive.count_zero[lane]) * per_count
        b = drive.velocity_filter_b[lane]
        omega = b * raw + drive.velocity_filter_z[0, lane]
        drive.velocity_filter_z[0, lane] = (
            2.0 * b * raw - drive.velocity_filter_a[0, lane] * omega + drive.velocity_filter_z[1, lane]
        )
        drive.velocity_filter_z[1, lane] = b * raw - drive.velocity_filter_a[1, lane] * omega
        drive.omega_meas[lane] = omega


@inlined
def measure_angle(drive):
    """Find the electrical angle that the encoder tells, once per current tick: writes sin_meas, cos_meas."""
    for lane in range(LANES):
        count = np.floor(
            (drive.theta_m[lane] + drive.encoder_error[lane]) * drive.encoder_counts[lane] * (1.0 / TWO_PI)
        )
        turns = (
            (count - drive.count_zero[lane])
            * (1.0 - 2.0 * drive.encoder_direction[lane])
            / (drive.encoder_steps[lane] * drive.encoder_interpolation[lane])
        )
        angle = drive.angle_zero[lane] + drive.pole_pairs[lane] * turns * TWO_PI
        s, c = sine_cosine(angle)
        drive.angle_meas[lane] = angle
        drive.sin_meas[lane] = s
        drive.cos_meas[lane] = c


@inlined
def measure_currents(drive):
    """Sample phase currents a and b with offset, gain error, noise, quantisation: writes i_alpha_meas, i_beta_meas."""
    for lane in range(LANES):
        s, c = sine_cosine(drive.n_p[lane] * drive.theta_m[lane])
        drive.sin_e[lane] = s
        drive.cos_e[lane] = c
        i_alpha = c * drive.i_d[lane] - s * drive.i_q[lane]
        i_beta = s * drive.i_d[lane] + c * drive.i_q[lane]
        i_a = i_alpha
        i_b = 0.5 * (SQRT3 * i_beta - i_alpha)
        # Two words of xorshift32, four bytes each: a sum of four is close enough to a normal deviate.
        x = U32(drive.random[lane])
        x = U32(x ^ U32(x << U32(13)))
        x = U32(x ^ U32(x >> U32(17)))
        x = U32(x ^ U32(x << U32(5)))
        y = U32(x ^ U32(x << U32(13)))
        y = U32(y ^ U32(y >> U32(17)))
        y = U32(y ^ U32(y << U32(5)))
        drive.random[lane] = y
        pairs_a = U32(U32(x & U32(0x00FF00FF)) + U32(U32(x >> U32(8)) & U32(0x00FF00FF)))
        pairs_b = U32(U32(y & U32(0x00FF00FF)) + U32(U32(y >> U32(8)) & U32(0x00FF00FF)))
        sum_a = np.int32(U32(U32(pairs_a & U32(0xFFFF)) + U32(pairs_a >> U32(16))))
        sum_b = np.int32(U32(U32(pairs_b & U32(0xFFFF)) + U32(pairs_b >> U32(16))))
        noise_a = (np.float64(sum_a) - _BYTES_MEAN) * _BYTES_SCALE
        noise_b = (np.float64(sum_b) - _BYTES_MEAN) * _BYTES_SCALE
        noise = drive.adc_noise[lane]
        inverse_step = 1.0 / drive.adc_step[lane]
        steps_a = np.floor(
            (i_a * drive.adc_gain[0, lane] + drive.adc_offset_error[0, lane] + noise * noise_a) * inverse_step + 0.5
        )
        steps_b = np.floor(
            (i_b * drive.adc_gain[1, lane] + drive.adc_offset_error[1, lane] + noise * noise_b) * inverse_step + 0.5
        )
        raw_a = ADC_CENTRE + steps_a * drive.adc_step_lsb[lane]
        raw_b = ADC_CENTRE + steps_b * drive.adc_step_lsb[lane]
        raw_a = 0.0 if raw_a < 0.0 else (65535.0 if raw_a > 65535.0 else raw_a)
        raw_b = 0.0 if raw_b < 0.0 else (65535.0 if raw_b > 65535.0 else raw_b)
        drive.adc_raw[0, lane] = raw_a
        drive.adc_raw[1, lane] = raw_b
        per_lsb = drive.adc_step[lane] / drive.adc_step_lsb[lane]
        i_a_meas = (raw_a - drive.adc_offset[0, lane]) * per_lsb
        i_b_meas = (raw_b - drive.adc_offset[1, lane]) * per_lsb
        drive.adc_current[0, lane] = i_a_meas
        drive.adc_current[1, lane] = i_b_meas
        drive.adc_current[2, lane] = -i_a_meas - i_b_meas
        drive.i_alpha_meas[lane] = i_a_meas
        drive.i_beta_meas[lane] = (i_a_meas + 2.0 * i_b_meas) * (1.0 / SQRT3)


# Reading of the ADC registers at zero current when the channel has no offset error (default of 2060h:03 and :04).
ADC_CENTRE = 33500.0
