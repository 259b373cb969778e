"""Registers of the amplifier's maker: settings that are converted for the stages, and readings.

A feedback's resolution depends on its type (F-Type): it is given by the encoder (Hiperface DSL, EnDat), by
F-Resolution, or as four counts per pulse of F-IncrEnc. An external encoder of F-ExtIncrEnc pulses sits on the shaft of
the module's first motor, and counts from power-on. With M-StaticBrake the drive controls a brake at its output: current
flows for D-DelayUnbrake_Enable before the brake is released, and for D-DelayDisable_Brake after it was applied. The
output's current over the largest is the brake's supply over 24 V. The enable input must have been closed for
D-DelayEnable_Hwen before an axis is enabled.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common import brake, inputs, start_up
from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.record import LANES
from drive_env.firmware.servo import alignment
from mechanics.kernels.compiled import inlined, stage

DSL, ENDAT, INCREMENTAL = 1, 2, 4  # F-Type; 6 BiSS, 7 SSI
COUNTS_PER_PULSE = 4.0
RMS_TIME = 0.1  # s, of the RMS currents
PT1000, PT1000_SLOPE = 1000.0, 3.851e-3  # ohm at 0 degC, 1/K (IEC 60751, mean of 0 to 100 degC)
COUNTER_PERIOD = 2.0**32
ON, HARDWARE, SOFTWARE, RELEASED, NO_ERROR, INITIALISED, FIELDBUS = 1, 2, 4, 8, 16, 32, 64  # bits of aDriveStatus
BRAKE_VOLTAGE = 24.0  # V, of the brake's supply
INPUTS_AT = 2.0**28  # position of the lowest of the four inputs


@inlined
def read_settings(drive, dt):
    """Convert settings for the stages: counts, angle of commutation, delays, output of the brake, cogging."""
    drive.block_compensates_cogging[0] = 0
    for lane in range(LANES):
        torque = drive.phase_factor[lane] * drive.n_p[lane] * drive.psi_nominal[lane]  # N m per ampere
        share = drive.cogging_compensation[lane]
        drive.cogging_current[lane] = share * drive.cogging_torque[lane] / torque if torque > 0.0 else 0.0
        if drive.cogging_current[lane] != 0.0:
            drive.block_compensates_cogging[0] = 1
        kind = drive.feedback_type[lane]
        own = kind in (DSL, ENDAT)
        told = drive.encoder_counts[lane] / drive.encoder_interpolation[lane]
        steps = told if own else drive.feedback_resolution[lane]
        drive.encoder_steps[lane] = COUNTS_PER_PULSE * drive.feedback_pulses[lane] if kind == INCREMENTAL else steps
        shift = drive.pole_pairs[lane] * drive.commutation_shift[lane]
        drive.angle_zero[lane] += shift - drive.angle_shifted[lane]
        drive.angle_shifted[lane] = shift
        has_brake = drive.static_brake[lane] == 1
        drive.brake_release_current[lane] = brake.LARGEST if has_brake else 0.0
        closed = drive.inputs[lane] & inputs.ENABLE
        drive.hardware_time[lane] = drive.hardware_time[lane] + dt if closed else 0.0
        wait = drive.hardware_delay[lane] - drive.hardware_time[lane]
        delay = (drive.unbrake_delay[lane] if has_brake else 0.0) + (wait if wait > 0.0 else 0.0)
        # While an axis waits for it, the delay is that at the command.
        drive.enable_delay[lane] = drive.enable_delay[lane] if drive.transition_pending[lane] == 4 else delay
    for pair in range(LANES // 2):  # a module's single registers are its first axis'
        first, second = 2 * pair, 2 * pair + 1
        shared = drive.link_shared[second] > 0.5
        drive.undervoltage[second] = drive.undervoltage[first] if shared else drive.undervoltage[second]
        drive.overvoltage[second] = drive.overvoltage[first] if shared else drive.overvoltage[second]
        drive.set_cycle[second] = drive.set_cycle[first] if shared else drive.set_cycle[second]
    for lane in range(LANES):
        is_new = drive.set_cycle[lane] != drive.cycle_seen[lane]
        drive.cycle_seen[lane] = drive.set_cycle[lane]
        drive.interpolation_value[lane] = 1e3 * drive.set_cycle[lane] if is_new else drive.interpolation_value[lane]
        drive.interpolation_index[lane] = -3.0 if is_new else drive.interpolation_index[lane]


@inlined
def find_readings(drive, dt):
    """Write readings that are means, or computed from others: RMS currents, I2t, the temperature sensor."""
    for lane in range(LANES):
        for phase in range(3):
            current = drive.adc_current[phase, lane]
            square = drive.phase_square[phase, lane]
            square += (current * current - square) * (dt / RMS_TIME)
            drive.phase_square[phase, lane] = square
            drive.phase_rms[phase, lane] = square**0.5
        time = drive.motor_thermal_time[lane]
        square = 0.5 * (drive.i_d_meas[lane] * drive.i_d_meas[lane] + drive.i_q_meas[lane] * drive.i_q_meas[lane])
        mean = drive.motor_square[lane]
        mean += (square - mean) * (dt / time if time > dt else 1.0)
        drive.motor_square[lane] = mean if time > 0.0 else 0.0
        drive.mean_motor_current[lane] = drive.motor_square[lane] ** 0.5
        sensor = PT1000 * (1.0 + PT1000_SLOPE * drive.T_winding[lane])
        drive.sensor_resistance[lane] = 0.0 if drive.feedback_type[lane] == INCREMENTAL else sensor
        linked = drive.feedback_type[lane] == DSL and drive.encoder_broken[lane] < 0.5
        drive.feedback_link[lane] = 1.0 if linked else 0.0
        turned = (drive.theta_m[lane] - drive.external_zero[lane]) / TWO_PI
        external = np.floor(COUNTS_PER_PULSE * drive.external_pulses[lane] * turned)
        drive.external_count[lane] = external - COUNTER_PERIOD * np.floor(external / COUNTER_PERIOD + 0.5)
        count = drive.period_count[lane] + 1.0
        drive.period_count[lane] = 0.0 if count >= COUNTER_PERIOD else count


@stage
def energise(drive, lane, dt):
    """Keep the stage on while its current waits for the brake, and advance the brake at the output."""
    ready = drive.hardware_time[lane] >= drive.hardware_delay[lane]
    if drive.holding[lane] == 1 and ready and drive.angle_source[lane] != alignment.DISABLED:
        drive.stage_on[lane] = 1.0
    brake.drive_output(drive, lane, dt)
    drive.brake_output[lane] *= drive.brake_supply[lane] / BRAKE_VOLTAGE
    brake.follow_output(drive, lane, dt)


@stage
def tell_status(drive, lane):
    """Write the error register, a bit for each error that is present or shown until the reset, aDriveStatus and Rdy."""
    reached = drive.target_reached[lane]
    drive.profile_ready[lane] = reached if reached != drive.reached_before[lane] else drive.profile_ready[lane]
    drive.reached_before[lane] = reached
    errors = drive.cause_flags[lane]
    drive.status_flags[lane] = errors
    bits = ON if drive.stage_on[lane] > 0.0 else 0
    bits |= HARDWARE if drive.inputs[lane] & inputs.ENABLE else 0
    bits |= SOFTWARE if drive.drive_function[lane] > 0.0 or drive.transition_pending[lane] == 4 else 0
    bits |= RELEASED if drive.static_brake[lane] == 0 or drive.brake_output[lane] > 0.0 else 0
    bits |= NO_ERROR if errors == 0 else 0
    bits |= INITIALISED if drive.init_state[lane] == start_up.DONE else 0
    bits |= FIELDBUS if drive.disconnected[lane] == 0 else 0
    drive.drive_status[lane] = bits + INPUTS_AT * drive.axis_inputs[lane]


@stage
def forget_readings(drive, lane):
    """Reset all readings."""
    drive.angle_shifted[lane] = 0.0
    drive.cycle_seen[lane] = drive.set_cycle[lane]
    drive.hardware_time[lane] = 0.0
    drive.motor_square[lane] = 0.0
    drive.period_count[lane] = 0.0
    drive.external_zero[lane] = drive.theta_m[lane]
    for phase in range(3):
        drive.phase_square[phase, lane] = 0.0
