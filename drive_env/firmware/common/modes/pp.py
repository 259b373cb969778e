"""Profile position mode (TMCM-1636 manual, section 6)."""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa, profiles, s_ramp, shaped, six_point
from drive_env.firmware.common.limits import ROUNDING, corrected_maximum, corrected_minimum
from mechanics.kernels.compiled import stage

FAR = 1e6  # rad: target of a trapezoid that must not brake


@stage
def new_set_point(drive, lane, word_before):
    """Accept the target position on the rising edge of controlword bit 4; bit 12 shows it until bit 4 falls.

    Without a buffer a new edge plans anew from the present position, with or without "change set immediately" (bit 5).
    With a buffer, an edge without bit 5 during a motion puts the set-point into it, and bit 12 stays until it is taken
    out; another edge without bit 5 has no effect then (CiA 402-2, profile position mode). With bit 9 (change on
    set-point) the axis does not stop at the previous set-point: it passes it with the profile's velocity, and continues
    to the buffered one. Ramps other than trapezoids end at each set-point.
    """
    word = drive.controlword[lane]
    if not word & cia402.NEW_SET_POINT:
        drive.set_point_acknowledged[lane] = drive.set_point_waiting[lane]
        return
    if word_before & cia402.NEW_SET_POINT or drive.fsa[lane] != fsa.ENABLED or drive.stopping[lane] == 1:
        return
    if drive.set_point_buffer[lane] == 1 and not word & cia402.CHANGE_AT_ONCE and _is_under_way(drive, lane):
        if drive.set_point_waiting[lane] == 0:
            drive.set_point_waiting[lane] = 1
            drive.waiting_target[lane] = drive.target_position[lane]
            drive.waiting_word[lane] = word
            drive.set_point_acknowledged[lane] = 1
        return
    drive.set_point_waiting[lane] = 0
    _take(drive, lane, drive.target_position[lane], word)
    drive.set_point_acknowledged[lane] = 1


@stage
def _is_under_way(drive, lane):
    """Return whether the profile moves to a set-point."""
    return drive.set_point_valid[lane] == 1 and (
        drive.position_demand[lane] != drive.profile_target[lane] or drive.velocity_demand[lane] != 0.0
    )


@stage
def _passes(drive, lane):
    """Return whether the profile passes through its set-point to the buffered one."""
    waits = drive.set_point_waiting[lane] == 1
    return waits and drive.waiting_word[lane] & cia402.CHANGE_ON_SET_POINT != 0


@stage
def _follow_trapezoid(drive, lane, v_max, up, down, dt):
    """Move the demand along a trapezoid to the set-point, or through it to the buffered one."""
    x, v, target = drive.position_demand[lane], drive.velocity_demand[lane], drive.profile_target[lane]
    through = _passes(drive, lane)
    aim = target
    if through:
        aim += FAR if target > x or (target == x and v > 0.0) else -FAR
    new_x, v = profiles.trapezoid(x, v, aim, v_max, up, down, dt)
    drive.position_demand[lane] = new_x
    drive.velocity_demand[lane] = v
    if through and (x - target) * (new_x - target) <= 0.0:
        _take_waiting(drive, lane)


@stage
def _take_waiting(drive, lane):
    _take(drive, lane, drive.waiting_target[lane], drive.waiting_word[lane])
    empty_buffer(drive, lane)


@stage
def empty_buffer(drive, lane):
    """Empty the buffer; bit 12 follows bit 4 again."""
    drive.set_point_waiting[lane] = 0
    if not drive.controlword[lane] & cia402.NEW_SET_POINT:
        drive.set_point_acknowledged[lane] = 0


@stage
def _take(drive, lane, target, word):
    """Plan the motion to a target [rad] by the controlword of its edge."""
    if word & cia402.RELATIVE:
        option = drive.positioning_option[lane] & 3
        if option == 0:
            target += drive.profile_target[lane] if drive.set_point_valid[lane] else drive.position_demand[lane]
        elif option == 1:
            target += drive.position_demand[lane]
        else:
            target += drive.theta_meas[lane]
    elif drive.target_is_whole[lane] == 0:
        target = profiles.unwrapped(target, drive.position_demand[lane], drive.position_scaler[lane])
    low, high = corrected_minimum(drive, lane), corrected_maximum(drive, lane)
    drive.internal_limit[lane] = 1 if target > high + ROUNDING or target < low - ROUNDING else 0
    target = min(max(target, low), high)
    drive.profile_target[lane] = target
    drive.set_point_valid[lane] = 1
    drive.target_reached[lane] = 0
    drive.in_window_time[lane] = 0.0


@stage
def generate(drive, lane, ramp, dt):
    """Move the demand along the profile; without a set-point, brake with `ramp` and hold."""
    drive.loop_level[lane] = 2
    x, v = drive.position_demand[lane], drive.velocity_demand[lane]
    if drive.set_point_valid[lane] == 0:
        x, v = profiles.stop(x, v, ramp, dt)
        drive.position_demand[lane] = x
        drive.velocity_demand[lane] = v
        return
    if drive.set_point_waiting[lane] == 1 and not _is_under_way(drive, lane):
        _take_waiting(drive, lane)
    up = drive.acceleration[lane]
    v_max = profiles.limited(drive.max_velocity[lane], drive.velocity_limit[lane])
    target = drive.profile_target[lane]
    if up > 0.0 and v_max > 0.0:
        # Factory values of 6081h and 6083h are 0: then there is no speed to move with, and the axis stays.
        down = drive.deceleration[lane] if drive.deceleration[lane] > 0.0 else up
        if s_ramp.is_set(drive, lane):
            s_ramp.advance(drive, lane, target, v_max, up, down, dt)
        elif shaped.is_set(drive, lane):
            shaped.advance(drive, lane, target, v_max, up, down, dt)
        elif six_point.is_set(drive, lane):
            six_point.advance(drive, lane, target, v_max, up, down, dt)
        else:
            _follow_trapezoid(drive, lane, v_max, up, down, dt)
            target = drive.profile_target[lane]
        x, v = drive.position_demand[lane], drive.velocity_demand[lane]
    window = drive.position_window[lane]
    if window == 0.0 or window > 1e300:
        drive.target_reached[lane] = 1 if x == target and v == 0.0 else 0
        return
    if abs(drive.theta_meas[lane] - target) <= window:
        drive.in_window_time[lane] += dt
    else:
        drive.in_window_time[lane] = 0.0
    # The window time is in whole milliseconds; half of one avoids rounding errors of the sum.
    reached = drive.in_window_time[lane] > drive.position_window_time[lane] + 0.5 * dt
    drive.target_reached[lane] = 1 if reached else 0
