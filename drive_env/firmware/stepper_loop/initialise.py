"""Closing of the loop: by 2020h, after aligning the encoder with the field (2028h, 2120h).

Load angle control commutates by the encoder, so it must know at which position the field holds the rotor: the axis
stands, run current flows, the rotor swings in, and its position is stored. The angle of a load that pulls at it
meanwhile cannot be separated: it stays in the offset. A PID does not commutate; its encoder starts at the steps'
position, at once.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common import fsa
from drive_env.firmware.common.start_up import DONE, FIRST_ANGLE
from drive_env.firmware.stepper.current_scale import STEPS
from drive_env.firmware.stepper_loop.encoder import encoder_position
from mechanics.kernels.compiled import stage

OPEN, LOAD_ANGLE, PID_ON_RAMP, PID_ALONE = 0.0, 1.0, 2.0, 3.0

HOLD_TIME = 0.4  # s: the rotor swings in
LONGEST_HOLD = 3.0  # s after which its position is stored even if it still swings


@stage
def open_loop(drive, lane):
    """Leave the loop: the field continues with the steps from its present position."""
    drive.loop_closed[lane] = OPEN
    drive.loop_initialised[lane] = 0
    drive.tracks_rotor[lane] = 0.0
    drive.settle_time[lane] = 0.0
    drive.init_state[lane] = DONE
    forget_corrections(drive, lane)


@stage
def forget_corrections(drive, lane):
    """Reset the corrections."""
    drive.correction_sum[lane] = 0.0
    drive.derivative_time[lane] = 0.0
    drive.derivative_part[lane] = 0.0
    drive.deviation_before[lane] = drive.loop_deviation[lane]


@stage
def close_loop(drive, lane, mode):
    """Align the encoder with the steps and close the loop."""
    drive.loop_offset[lane] = drive.step_position[lane] - encoder_position(drive, lane)
    drive.field_shift[lane] = drive.field_position[lane] - drive.step_position[lane]
    drive.loop_deviation[lane] = 0.0
    drive.loop_closed[lane] = mode
    drive.loop_initialised[lane] = 1 if mode == LOAD_ANGLE else 0
    drive.tracks_rotor[lane] = 1.0 if mode == LOAD_ANGLE else 0.0
    drive.init_state[lane] = DONE
    forget_corrections(drive, lane)


@stage
def hold(drive, lane, dt):
    """Hold the rotor at rest until it has swung in, then close the loop."""
    if drive.init_state[lane] != FIRST_ANGLE:
        drive.settle_time[lane] = 0.0
        if drive.velocity_demand[lane] != 0.0 or drive.step_rate[lane] != 0.0:
            return  # the ramp ends first
        drive.init_state[lane] = FIRST_ANGLE
    drive.standstill_time[lane] = 0.0  # run current, not standstill current
    drive.settle_time[lane] += dt
    rests = abs(drive.omega_encoder[lane]) <= drive.standstill[lane]
    if drive.settle_time[lane] > LONGEST_HOLD or (rests and drive.settle_time[lane] > HOLD_TIME):
        close_loop(drive, lane, LOAD_ANGLE)


@stage
def choose_loop(drive, lane, dt):
    """Open or close the loop by 2020h, once per period of dt [s]; without an encoder (606Ah) it is open."""
    steps = np.floor(drive.run_current[lane] * (STEPS / 256.0)) + 1.0
    drive.run_amplitude[lane] = drive.full_scale_current[lane] / (1.0 + drive.vsense[lane]) * steps / STEPS
    wanted = drive.loop_mode[lane]
    if wanted > PID_ALONE or drive.position_sensor[lane] < -0.5:
        wanted = OPEN
    if drive.loop_closed[lane] != OPEN and drive.loop_closed[lane] != wanted:
        open_loop(drive, lane)
    if drive.drive_function[lane] == 0.0:
        if drive.loop_closed[lane] == OPEN:
            open_loop(drive, lane)
        forget_corrections(drive, lane)
    elif drive.loop_closed[lane] == OPEN:
        if wanted == LOAD_ANGLE:
            hold(drive, lane, dt)
        elif wanted != OPEN:
            close_loop(drive, lane, wanted)
        elif drive.init_state[lane] == FIRST_ANGLE:
            open_loop(drive, lane)
    # A fault's stop uses only the ramp: a PID with a broken encoder would run on.
    reacts = drive.fsa[lane] == fsa.REACTING
    drive.corrects[lane] = 0.0 if reacts else drive.drive_function[lane]


@stage
def power_on(drive, lane):
    """Reset: the field at the table's first entry, the loop open."""
    drive.field_position[lane] = 0.0
    drive.field_rate[lane] = 0.0
    drive.field_shift[lane] = 0.0
    drive.loop_offset[lane] = 0.0
    drive.loop_scale[lane] = 255.0
    drive.loop_deviation[lane] = 0.0
    drive.torque_current[lane] = 0.0
    drive.asks_torque[lane] = 0.0
    open_loop(drive, lane)


@stage
def halt(drive, lane):
    """Replace non-finite state by 0."""
    drive.loop_deviation[lane] = 0.0
    drive.omega_encoder[lane] = 0.0
    drive.field_position[lane] = drive.step_position[lane]
    drive.field_rate[lane] = 0.0
    drive.torque_current[lane] = 0.0
    open_loop(drive, lane)
