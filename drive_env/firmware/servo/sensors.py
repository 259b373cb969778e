"""Sensors: incremental encoder, velocity from its counts, and the two phase-current channels."""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.common.encoder import BYTES_MEAN, BYTES_SCALE, U32, count_at, filtered_velocity, read_counter
from drive_env.firmware.common.phases import note_peaks
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined, stage

SQRT3 = 3.0**0.5
PI = 3.141592653589793
HALL_STANDSTILL = 0.05  # s without an edge after which the halls' speed is 0
HALL_UNKNOWN = 1.0  # s between edges, meaning unknown: beyond standstill


@inlined
def measure_motion(drive, h):
    """Read the encoder at the velocity loop's rate, period h [s]: writes theta_meas, omega_meas.

    Velocity is the count difference per period through a second-order low-pass, so one count is real noise:
    at 4096 counts and 5 kHz it is 73 rpm before the filter.
    """
    for lane in range(LANES):
        count = read_counter(drive, lane)
        before = drive.count[lane]
        shaft = 1.0 - 2.0 * drive.shaft_direction[lane]
        per_count = shaft * TWO_PI * drive.turns_per_count[lane]
        # With hall commutation the halls are the encoder, unless 2043h:03 says otherwise: 6 steps per pole pair, speed
        # from the time between edges. All is computed and then selected: a branch would prevent vectorisation.
        per_sector = shaft * (PI / 3.0) / drive.pole_pairs[lane]
        elapsed = drive.hall_time[lane]
        period = drive.hall_period[lane]
        since = elapsed if elapsed > period else period
        hall_speed = per_sector * drive.hall_sense[lane] / since
        hall_speed = 0.0 if since > HALL_STANDSTILL else hall_speed
        hall_position = (drive.hall_sector[lane] - drive.hall_zero[lane]) * per_sector
        by_hall = (1.0 if drive.angle_source[lane] == 2.0 else 0.0) * (1.0 - drive.always_use_encoder[lane])
        speed = (count - before) * per_count / h
        position = (count - drive.count_zero[lane]) * per_count
        sensor = drive.velocity_sensor[lane]
        speed_by_hall = by_hall if sensor == 0.0 else (1.0 if sensor == 1.0 else 0.0)
        raw = hall_speed if speed_by_hall > 0.5 else speed
        position = hall_position if by_hall > 0.5 else position
        drive.count[lane] = count
        drive.theta_meas[lane] = position - drive.home_shift[lane]
        drive.omega_meas[lane] = filtered_velocity(drive, lane, raw)


@inlined
def measure_halls(drive, dt):
    """Read the halls after dt [s]: writes their sector, the time between edges, and angle_hall."""
    for lane in range(LANES):
        # Halls: six sectors per electrical turn; wrong polarity is three sectors off, wrong direction counts backwards.
        true_sector = np.floor((drive.n_p[lane] * drive.theta_m[lane] + drive.hall_true_offset[lane]) * (3.0 / PI))
        reverse = abs(drive.hall_true_direction[lane] - drive.hall_direction[lane])
        inverse = abs(drive.hall_true_polarity[lane] - drive.hall_polarity[lane])
        sector = true_sector + reverse * (-1.0 - 2.0 * true_sector) + 3.0 * inverse
        sector = drive.hall_sector[lane] if drive.hall_broken[lane] > 0.5 else sector
        change = sector - drive.hall_sector[lane]
        elapsed = drive.hall_time[lane] + dt
        edge = change != 0.0
        sense = (1.0 if change > 0.0 else -1.0) if edge else drive.hall_sense[lane]
        # An edge that is crossed back ends no sector: the next one gives the rotor's speed.
        back = sense * drive.hall_sense[lane] < 0.0
        period = (HALL_UNKNOWN if back else elapsed) if edge else drive.hall_period[lane]
        elapsed = 0.0 if edge else elapsed
        drive.hall_sector[lane] = sector
        drive.hall_time[lane] = elapsed
        drive.hall_period[lane] = period
        drive.hall_sense[lane] = sense
        share = elapsed / period
        share = 1.0 if share > 1.0 else share
        entered = sector if sense > 0.0 else sector + 1.0
        moving = drive.hall_interpolation[lane] > 0.5 and elapsed < HALL_STANDSTILL and period < HALL_STANDSTILL
        hall = (entered + sense * share if moving else sector + 0.5) * (PI / 3.0) - drive.hall_offset[lane]
        drive.angle_hall[lane] = hall


@inlined
def measure_angle(drive, dt):
    """Find the electrical angle of the commutation in use, every current tick of dt [s]: writes sin_meas, cos_meas."""
    for lane in range(LANES):
        count = count_at(drive, lane, drive.theta_m[lane] + drive.encoder_error[lane])
        turns = (count - drive.count_zero[lane]) * drive.turns_per_count[lane]
        encoder = drive.angle_zero[lane] + drive.pole_pairs[lane] * turns * TWO_PI
        open_loop = drive.angle_open_loop[lane] + dt * drive.pole_pairs[lane] * drive.velocity_demand[lane]
        drive.angle_encoder[lane] = encoder
        drive.angle_open_loop[lane] = open_loop
        source = drive.angle_source[lane]
        angle = encoder if source == 3.0 else drive.angle_forced[lane]
        angle = drive.angle_hall[lane] if source == 2.0 else angle
        angle = open_loop if source == 1.0 else angle
        angle = -0.5 * PI if source == 5.0 else angle
        s, c = sine_cosine(angle)
        drive.angle_meas[lane] = angle
        drive.sin_meas[lane] = s
        drive.cos_meas[lane] = c


@inlined
def measure_currents(drive):
    """Sample phase currents a and b with offset, gain error, noise, quantisation: writes i_alpha_meas, i_beta_meas."""
    for lane in range(LANES):
        # A DC motor's current flows along alpha, which is its q axis turned back by a quarter.
        s, c = sine_cosine(-0.5 * PI if drive.is_dc[lane] > 0.5 else drive.n_p[lane] * drive.theta_m[lane])
        drive.sin_e[lane] = s
        drive.cos_e[lane] = c
        i_alpha = c * drive.i_d[lane] - s * drive.i_q[lane]
        i_beta = s * drive.i_d[lane] + c * drive.i_q[lane]
        i_a = i_alpha
        i_b = -i_alpha if drive.is_dc[lane] > 0.5 else 0.5 * (SQRT3 * i_beta - i_alpha)
        # Two words of xorshift32, four bytes each: a sum of four is sufficiently close to a normal deviate.
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
        noise_a = (np.float64(sum_a) - BYTES_MEAN) * BYTES_SCALE
        noise_b = (np.float64(sum_b) - BYTES_MEAN) * BYTES_SCALE
        noise = drive.adc_noise[lane]
        inverse_step = drive.adc_steps_per_ampere[lane]
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
        per_lsb = drive.ampere_per_lsb[lane]
        i_a_meas = (raw_a - drive.adc_offset[0, lane]) * per_lsb
        i_b_meas = (raw_b - drive.adc_offset[1, lane]) * per_lsb
        drive.adc_current[0, lane] = i_a_meas
        drive.adc_current[1, lane] = i_b_meas
        drive.adc_current[2, lane] = -i_a_meas - i_b_meas
        drive.i_alpha_meas[lane] = i_a_meas
        driven_as_dc = drive.motor_type[lane] == 1.0
        drive.i_beta_meas[lane] = 0.0 if driven_as_dc else (i_a_meas + 2.0 * i_b_meas) * (1.0 / SQRT3)
        note_peaks(drive, lane, i_a_meas, i_b_meas)


# Reading of the ADC registers at zero current when the channel has no offset error (default of 2060h:03 and :04).
ADC_CENTRE = 33500.0


@stage
def tell_counts(drive, lane):
    """Write the counts per revolution of the position sensor: the halls, or the encoder."""
    by_hall = drive.angle_source[lane] == 2.0 and drive.always_use_encoder[lane] == 0.0
    drive.counts_per_turn[lane] = 6.0 * drive.pole_pairs[lane] if by_hall else drive.encoder_steps[lane]
