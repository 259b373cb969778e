"""Commutation: which angle the current loop uses, and how the encoder is aligned with the rotor (2055h, 2080h:03).

"Estimate offset" holds a current along one angle, then a quarter electrical turn further: the rotor must follow in the
counting direction of the encoder. "Use hall" takes the middle of the sector, with an error of at most half a sector.
"Use offset" uses a stored alignment.
"""

from __future__ import annotations

from drive_env.firmware.common.start_up import DONE, FAILED, FIRST_ANGLE, NEEDED, SECOND_ANGLE, is_busy
from mechanics.kernels.compiled import stage

TWO_PI = 6.283185307179586
QUARTER = 0.25 * TWO_PI

DC, BLDC = 1.0, 3.0
DISABLED, OPEN_LOOP, HALL, ENCODER = 0.0, 1.0, 2.0, 3.0
FORCED, DC_FRAME = 4.0, 5.0
ESTIMATE, USE_OFFSET, USE_HALL = 0, 1, 2
VELOCITY_BY_HALL = 1.0  # 2042h:05

HOLD_TIME = 0.4  # s at each angle: the rotor swings in
LONGEST_HOLD = 3.0  # s after which the angle is taken even if it still swings
TOLERANCE = 0.3  # of a quarter turn, by which the rotor's motion may differ


@stage
def _encoder_turn(drive, lane):
    """Return the electrical angle that the encoder has counted since power-on [rad]."""
    turns = (drive.count[lane] - drive.count_zero[lane]) * drive.turns_per_count[lane]
    return turns * TWO_PI * drive.pole_pairs[lane]


@stage
def has_come_to_rest(drive, lane):
    """Return whether the held rotor stands, or LONGEST_HOLD has passed."""
    return abs(drive.omega_slow[lane]) <= 0.25 * drive.standstill[lane] or drive.init_time[lane] > LONGEST_HOLD


@stage
def commutate(drive, lane, dt):
    """Choose the angle's source and switch the stage, once per period of dt [s]; runs the initialisation."""
    on = drive.drive_function[lane] > 0.0
    drive.torque_share[lane] = 1.0
    drive.i_d_ref[lane] = 0.0
    mode = drive.commutation_mode[lane]
    if drive.motor_type[lane] == DC:
        drive.angle_source[lane] = DC_FRAME
        # A stage configured for two legs does not drive three phases, and vice versa.
        drive.stage_on[lane] = 1.0 if on and drive.is_dc[lane] == 1.0 else 0.0
        drive.init_state[lane] = DONE
        return
    if drive.motor_type[lane] != BLDC or drive.is_dc[lane] == 1.0 or mode == DISABLED:
        drive.angle_source[lane] = DISABLED
        drive.stage_on[lane] = 0.0
        return
    drive.stage_on[lane] = 1.0 if on else 0.0
    drive.angle_source[lane] = mode
    if mode == OPEN_LOOP:
        drive.torque_share[lane] = 0.0
        drive.i_d_ref[lane] = min(drive.open_loop_current[lane], drive.i_max[lane])
        return
    if mode == HALL or drive.init_state[lane] == FAILED:
        return
    if drive.init_state[lane] == NEEDED:
        if drive.encoder_init_mode[lane] == USE_OFFSET:
            drive.init_state[lane] = DONE
        elif drive.encoder_init_mode[lane] == USE_HALL:
            drive.angle_zero[lane] = drive.angle_hall[lane] - _encoder_turn(drive, lane)
            drive.init_state[lane] = DONE
        elif on:
            drive.init_state[lane] = FIRST_ANGLE
            drive.init_time[lane] = 0.0
    if not is_busy(drive, lane):
        return
    if not on:
        drive.init_state[lane] = NEEDED
        return
    drive.angle_source[lane] = FORCED
    drive.torque_share[lane] = 0.0
    current = drive.open_loop_current[lane] if drive.open_loop_current[lane] > 0.0 else 0.5 * drive.i_max[lane]
    drive.i_d_ref[lane] = min(current, drive.i_max[lane])
    drive.init_time[lane] += dt
    if drive.init_state[lane] == FIRST_ANGLE:
        # The current sweeps to the first angle: a rotor exactly opposite would not move.
        drive.angle_forced[lane] = QUARTER * (min(2.0 * drive.init_time[lane] / HOLD_TIME, 1.0) - 1.0)
        if drive.init_time[lane] >= HOLD_TIME and has_come_to_rest(drive, lane):
            drive.init_angle[lane] = _encoder_turn(drive, lane)
            drive.init_state[lane] = SECOND_ANGLE
            drive.init_time[lane] = 0.0
        return
    # Turned there step by step: a rotor on the opposite side could fall to either side.
    drive.angle_forced[lane] = QUARTER * min(2.0 * drive.init_time[lane] / HOLD_TIME, 1.0)
    if drive.init_time[lane] < 2.0 * HOLD_TIME or not has_come_to_rest(drive, lane):
        return
    turned = _encoder_turn(drive, lane) - drive.init_angle[lane]
    if abs(turned - QUARTER) > TOLERANCE * QUARTER:
        drive.init_state[lane] = FAILED
        return
    drive.angle_zero[lane] = QUARTER - _encoder_turn(drive, lane)
    drive.init_state[lane] = DONE


@stage
def needs_halls(drive, lane):
    """Return whether angle, velocity, or the initialisation of the encoder use the halls."""
    return (
        drive.angle_source[lane] == HALL
        or drive.velocity_sensor[lane] == VELOCITY_BY_HALL
        or (drive.angle_source[lane] == ENCODER and drive.encoder_init_mode[lane] == USE_HALL)
    )
