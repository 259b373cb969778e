"""Homing mode (CiA 402-2): methods 1 to 14, 17 to 30, 33 to 35 and 37, -1 to -4 of makers; 0 does nothing.

A switch is searched fast; once it is reached the axis brakes and searches the edge slowly, always in the same
direction, until the switch changes; that edge is home. Then the axis returns to the edge and rests there. Search and
edge of each method:

    17  search left until the left limit switch is active, edge to the right where it becomes inactive
    18  search right until the right limit switch is active, edge to the left
    19, 23  search right until the home switch is active, edge to the left where it becomes inactive
    21, 27  search left until the home switch is active, edge to the right where it becomes inactive
    26  search right, the right edge where the home switch becomes inactive;  30  search left, its left edge
    20, 24, 29  the left edge, to the right where the home switch becomes active; 29 searches left, the others right
    22, 25, 28  the right edge, to the left where the home switch becomes active; 25 searches right, the others left
    1 to 14  as 17 to 30; from the edge on, the same way, to the encoder's next index, which is home
    33, 34  to the next index, left or right, slowly
    35, 37  here
    -1, -2  right or left, fast, until a mechanical stop holds the axis; its position stays as it was counted
    -3, -4  likewise, and the position is 0 there

A limit switch reverses the search for a home switch. An edge at which a switch becomes active is found by leaving the
switch there slowly and returning.

Zero is at home plus 607Ch, so that home itself has the position -607Ch.

If no index comes within a turn, homing fails before the axis runs into a stop.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa, inputs, profiles
from drive_env.firmware.common.arithmetic import TWO_PI
from mechanics.kernels.compiled import stage

LEFT, RIGHT, HOME = 0, 1, 2

# States of a homing run.
(
    IDLE, SEARCH, TURNED, BRAKE, TO_EDGE, AWAY, RETURN, STOPPED, DONE, FAILED, TO_INDEX, BACK_ON, TO_STOP,
) = range(13)  # fmt: skip

BY_SWITCH = 16  # offset from a method with an index to the one that ends at the switch's edge
INDEX_LEFT, INDEX_RIGHT = 33, 34
SEARCH_LEFT = (17, 21, 22, 27, 28, 29, 30)  # the others of 17 to 30 search to the right
RIGHT_EDGE = (17, 21, 22, 25, 26, 27, 28)  # the others end at the left edge
WHERE_ACTIVE = (20, 22, 24, 25, 28, 29)  # the others end where the switch becomes inactive
HERE = (35, 37)  # CiA 402 has 35 as the older number of 37
STOPS_RIGHT, SETS_ZERO = (-1, -3), (-3, -4)  # methods that end at a stop
STALL_TIME, STALL_SHARE = 0.1, 0.1  # s, share of the speed: a slower axis is at a stop after this time; our choice
INDEX_WAY = 1.05 * TWO_PI  # rad in which an index must come


@stage
def _ends_at_index(method):
    """Return whether a method continues from the switch's edge to an index."""
    return 0 < method < BY_SWITCH


@stage
def _looks_for_index_alone(method):
    """Return whether a method searches only the next index."""
    return method in (INDEX_LEFT, INDEX_RIGHT)


@stage
def _by_switch(method):
    """Return the method without an index that finds the same edge."""
    return method + BY_SWITCH if _ends_at_index(method) else method


@stage
def _switch(method):
    """Return the switch that a method without an index searches."""
    if method == 17:
        return LEFT
    if method == 18:
        return RIGHT
    return HOME


@stage
def _has_switch(drive, lane, method):
    """Return whether the axis has the switch that a method searches; without it the search would never end."""
    return (drive.homing_switches[lane] >> _switch(_by_switch(method))) & 1 == 1


@stage
def _search_sign(method):
    """Return the direction in which a method searches its switch."""
    return -1.0 if method in SEARCH_LEFT else 1.0


@stage
def _edge_side(method):
    """Return the side of the switch's edge at which a method without an index ends: -1 left, 1 right."""
    return 1.0 if method in RIGHT_EDGE else -1.0


@stage
def is_running(drive, lane):
    """Return whether a homing run is under way."""
    state = drive.homing_state[lane]
    return SEARCH <= state <= RETURN or state in (TO_INDEX, BACK_ON, TO_STOP)


@stage
def _look_for_index(drive, lane, direction):
    """Begin to search the index in a direction; return the state."""
    drive.homing_direction[lane] = direction
    drive.index_seen[lane] = 0.0
    drive.homing_limit[lane] = drive.theta_meas[lane] + direction * INDEX_WAY
    return TO_INDEX


@stage
def start_or_stop(drive, lane, word_before):
    """Start homing on the rising edge of controlword bit 4, stop it on the falling one."""
    word = drive.controlword[lane]
    if word & cia402.NEW_SET_POINT and not word_before & cia402.NEW_SET_POINT:
        drive.homing_attained[lane] = 0
        drive.target_reached[lane] = 0
        method = drive.homing_method[lane]
        if method in HERE:
            # Does not need operation enabled. At rest the demand is zero, too, whatever position error remains.
            if drive.velocity_demand[lane] == 0.0:
                drive.position_demand[lane] = drive.theta_meas[lane]
            offset = 0.0 if drive.homing_here_sets_zero[lane] == 1 else drive.home_offset[lane]
            set_home(drive, lane, drive.theta_meas[lane], -offset)
            drive.homing_state[lane] = DONE
            drive.homing_attained[lane] = 1
            drive.target_reached[lane] = 1
        elif drive.fsa[lane] == fsa.ENABLED:
            alone, to_stop = _looks_for_index_alone(method), -5 < method < 0
            unable = (
                (drive.homing_fast[lane] <= 0.0 and not alone)
                or (drive.homing_slow[lane] <= 0.0 and not to_stop)
                or drive.homing_acceleration[lane] <= 0.0
                or not (alone or to_stop or _has_switch(drive, lane, method))
            )
            drive.homing_state[lane] = FAILED if method == 0 or unable else SEARCH
            if to_stop and not unable:
                drive.homing_state[lane] = TO_STOP
                drive.homing_stall[lane] = 0.0
            if alone and not unable:
                drive.homing_state[lane] = _look_for_index(drive, lane, 1.0 if method == INDEX_RIGHT else -1.0)
            drive.target_reached[lane] = 1 if drive.homing_state[lane] == FAILED else 0
    elif not word & cia402.NEW_SET_POINT and is_running(drive, lane):
        drive.homing_state[lane] = STOPPED


@stage
def forget(drive, lane):
    """Leave homing: an unfinished run is discarded."""
    drive.homing_state[lane] = IDLE
    drive.homing_attained[lane] = 0


@stage
def set_home(drive, lane, position, value):
    """Assign the value `value` [rad] to `position` [rad]; demand and measurement move together, so nothing jumps."""
    drive.home_count[lane] = (position + drive.home_shift[lane]) * drive.counts_per_turn[lane] / TWO_PI
    shift = position - value
    drive.home_shift[lane] += shift
    drive.theta_meas[lane] -= shift
    drive.position_demand[lane] -= shift
    drive.profile_target[lane] -= shift
    drive.homing_edge[lane] = value


@stage
def _run(drive, lane, velocity, dt):
    """Ramp the demand to a velocity [rad/s] with the homing acceleration."""
    v = drive.velocity_demand[lane]
    v_new = profiles.ramp(v, velocity, drive.homing_acceleration[lane], dt)
    drive.position_demand[lane] += 0.5 * (v + v_new) * dt
    drive.velocity_demand[lane] = v_new


@stage
def _search(drive, lane, state, active, dt):
    """Search the switch, fast; return the state after it."""
    method = _by_switch(drive.homing_method[lane])
    sign = _search_sign(method)
    direction = sign if state == SEARCH else -sign
    drive.homing_direction[lane] = direction
    if active:
        state = BRAKE
        # An axis that still comes from the other side leaves a narrow switch on that side.
        v = drive.velocity_demand[lane]
        drive.homing_direction[lane] = direction if v == 0.0 else (1.0 if v > 0.0 else -1.0)
    elif _switch(method) == HOME and inputs.is_active(drive, lane, RIGHT if direction > 0.0 else LEFT):
        # The search led away from the switch: it is on the other side, or missing.
        state = TURNED if state == SEARCH else FAILED
    if state in (SEARCH, TURNED):
        _run(drive, lane, (sign if state == SEARCH else -sign) * drive.homing_fast[lane], dt)
    return state


@stage
def _come_to_rest(drive, lane, active, dt):
    """Brake on the switch; return the state after it."""
    _run(drive, lane, 0.0, dt)
    # The axis lags behind its demand: its position at rest decides on which side of the edge it is.
    if drive.velocity_demand[lane] == 0.0 and abs(drive.omega_slow[lane]) <= drive.standstill[lane]:
        return TO_EDGE if active else AWAY
    return BRAKE


@stage
def _come_back(drive, lane, edge, active, dt):
    """Go back onto a narrow switch that braking carried the axis across, slowly; return the state after it."""
    back = -drive.homing_direction[lane]
    if not active:
        _run(drive, lane, back * drive.homing_slow[lane], dt)
        return AWAY
    return TO_EDGE if back * edge > 0.0 else BRAKE


@stage
def _leave_switch(drive, lane, edge, active, dt):
    """Search the edge on a side (-1, 1), slowly; return the state after it."""
    if not active and drive.velocity_demand[lane] * edge > 0.0:
        return BACK_ON if _by_switch(drive.homing_method[lane]) in WHERE_ACTIVE else _take_edge(drive, lane, edge)
    if inputs.is_active(drive, lane, RIGHT if edge > 0.0 else LEFT):
        return FAILED
    _run(drive, lane, edge * drive.homing_slow[lane], dt)
    return TO_EDGE


@stage
def _enter_switch(drive, lane, edge, active, dt):
    """Search the edge from outside, slowly; return the state after it."""
    if active and drive.velocity_demand[lane] * edge < 0.0:
        return _take_edge(drive, lane, -edge)
    if inputs.is_active(drive, lane, LEFT if edge > 0.0 else RIGHT):
        return FAILED
    _run(drive, lane, -edge * drive.homing_slow[lane], dt)
    return BACK_ON


@stage
def _take_edge(drive, lane, direction):
    """Use the edge that the axis passes now as home, or continue to the next index; return the state after it."""
    if _ends_at_index(drive.homing_method[lane]):
        return _look_for_index(drive, lane, direction)
    set_home(drive, lane, drive.theta_meas[lane], -drive.home_offset[lane])
    return RETURN


@stage
def _go_to_index(drive, lane, dt):
    """Search the index, slowly; return the state after it."""
    direction = drive.homing_direction[lane]
    if drive.index_seen[lane] > 0.0:
        set_home(drive, lane, drive.index_position[lane], -drive.home_offset[lane])
        return RETURN
    too_far = (drive.theta_meas[lane] - drive.homing_limit[lane]) * direction > 0.0
    if too_far or inputs.is_active(drive, lane, RIGHT if direction > 0.0 else LEFT):
        return FAILED
    _run(drive, lane, direction * drive.homing_slow[lane], dt)
    return TO_INDEX


@stage
def _go_to_stop(drive, lane, dt):
    """Move until the axis stands despite the demanded speed; return the state after it."""
    method, fast = drive.homing_method[lane], drive.homing_fast[lane]
    sign = 1.0 if method in STOPS_RIGHT else -1.0
    _run(drive, lane, sign * fast, dt)
    is_held = drive.velocity_demand[lane] == sign * fast and abs(drive.omega_slow[lane]) < STALL_SHARE * fast
    drive.homing_stall[lane] = drive.homing_stall[lane] + dt if is_held else 0.0
    if drive.homing_stall[lane] < STALL_TIME:
        return TO_STOP
    drive.velocity_demand[lane] = 0.0
    drive.position_demand[lane] = drive.theta_meas[lane]
    drive.velocity_sum[lane] = 0.0  # otherwise the axis would press on
    if method in SETS_ZERO:
        set_home(drive, lane, drive.theta_meas[lane], 0.0)
    drive.homing_attained[lane] = 1
    drive.target_reached[lane] = 1
    return DONE


@stage
def _return_to_edge(drive, lane, dt):
    """Return to the edge and rest there; return the state after it."""
    edge, acceleration = drive.homing_edge[lane], drive.homing_acceleration[lane]
    x, v = profiles.trapezoid(
        drive.position_demand[lane],
        drive.velocity_demand[lane],
        edge,
        drive.homing_slow[lane],
        acceleration,
        acceleration,
        dt,
    )
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v
    if v == 0.0 and x == edge:
        drive.homing_attained[lane] = 1
        drive.target_reached[lane] = 1
        return DONE
    return RETURN


@stage
def generate(drive, lane, dt):
    """Run homing for one period of dt [s]; without a run the axis holds."""
    drive.loop_level[lane] = 2
    state = drive.homing_state[lane]
    method = _by_switch(drive.homing_method[lane])
    edge = _edge_side(method)
    active = inputs.is_active(drive, lane, _switch(method))
    if state in (SEARCH, TURNED):
        state = _search(drive, lane, state, active, dt)
    if state == BRAKE:
        state = _come_to_rest(drive, lane, active, dt)
    elif state == AWAY:
        state = _come_back(drive, lane, edge, active, dt)
    elif state == TO_EDGE:
        state = _leave_switch(drive, lane, edge, active, dt)
    elif state == BACK_ON:
        state = _enter_switch(drive, lane, edge, active, dt)
    elif state == TO_INDEX:
        state = _go_to_index(drive, lane, dt)
    elif state == TO_STOP:
        state = _go_to_stop(drive, lane, dt)
    elif state == RETURN:
        state = _return_to_edge(drive, lane, dt)
    elif state in (STOPPED, FAILED):
        _run(drive, lane, 0.0, dt)
        drive.target_reached[lane] = 1 if drive.velocity_demand[lane] == 0.0 else 0
    elif state in (IDLE, DONE):
        _run(drive, lane, 0.0, dt)
    drive.homing_state[lane] = state
