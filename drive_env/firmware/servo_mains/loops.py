"""Position P and velocity PI of a servo amplifier, with feed-forward of speed and current, and the current's limit.

The regulators are told by a gain and an integration time (C-K and C-Ti, V-K and V-Ti); the position loop adds a share
of the speed that its set-points have (P-SFF).
Torque objects are shares of the motor's peak current (M-Ipeak): 32767 is all of it. The manual has 6071h as the
set-point of cst and pt, and in csp and ip as "the feedforward torque value", which "is added to the desired value of
the current regulator". Of the current limit it prints no equation, only its ends: 0 is no limitation, "where maximal
current = M-Ipeak", 32767 is full limitation. Taken is the straight line between them,

    i_most = M-Ipeak (32767 - limit) / 32767

and what lies above 32767 is full limitation, too.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa
from drive_env.firmware.common.arithmetic import clip
from drive_env.firmware.common.modes import CSP, acts_as, is_blocked
from drive_env.firmware.common.modes.cyclic import NO_SET_POINT
from drive_env.firmware.record import LANES
from mechanics.compiled import inlined, stage

FULL_LIMITATION = 32767.0


@inlined
def share_current(drive):
    """Write current_share, what M-Ipeak and the current limit leave of i_max, and torque_demand_share."""
    for lane in range(LANES):
        i_max, peak = drive.i_max[lane], drive.peak_current[lane]
        most = peak * (1.0 - drive.image_limit[lane] / FULL_LIMITATION)
        most = most if most > 0.0 else 0.0
        drive.current_share[lane] = most / i_max if most < i_max else 1.0
        drive.torque_demand_share[lane] = drive.i_q_ref[lane] / peak if peak > 0.0 else 0.0


@inlined
def find_integral_shares(drive, tick, window):
    """Write what the integrators take of P e per sample, from the integration times; ticks and windows in s."""
    for lane in range(LANES):
        current, velocity = drive.current_integration[lane], drive.velocity_integration[lane]
        drive.current_i[lane] = tick / current if current > 0.0 else 0.0
        drive.velocity_i[lane] = window / velocity if velocity > 0.0 else 0.0


@stage
def feed_forward_current(drive, lane):
    """Write the current that ip and csp add; an axis that stops, waits or is blocked is driven by its loops alone."""
    follows = (
        acts_as(drive.mode_display[lane]) == CSP
        and drive.fsa[lane] == fsa.ENABLED
        and drive.stopping[lane] == 0
        and drive.set_point_steps[lane] != NO_SET_POINT
        and (drive.controlword[lane] & cia402.HALT) == 0
        and not is_blocked(drive, lane)
    )
    drive.torque_feed_forward[lane] = drive.target_torque[lane] + drive.torque_offset[lane] if follows else 0.0


@inlined
def motion_loops(drive):
    """Position P and velocity PI, one window: reads demands and measurements; writes i_q_ref [A]."""
    for lane in range(LANES):
        level = drive.loop_level[lane]
        position_error = drive.position_demand[lane] - drive.theta_meas[lane]
        demand = drive.velocity_demand[lane]
        ahead = drive.feed_forward[lane] * demand
        omega_ref = drive.position_p[lane] * position_error + ahead if level == 2 else demand
        error = omega_ref - drive.omega_meas[lane]
        i_max = drive.i_max[lane] * drive.current_share[lane]
        proportional = drive.velocity_p[lane] * error
        total = clip(drive.velocity_sum[lane] + proportional * drive.velocity_i[lane], i_max)
        i_loop = clip(clip(proportional + total, i_max) + drive.torque_feed_forward[lane], i_max)
        i_direct = clip(drive.torque_demand[lane], i_max)
        # While torque is commanded the integrator follows it, or a change to a velocity mode would jump.
        total = clip(i_direct - proportional, i_max) if level == 0 else total
        i_ref = i_direct if level == 0 else i_loop
        # A current that waits for the brake holds the axis meanwhile.
        on = 1.0 if drive.drive_function[lane] > 0.0 or drive.holding[lane] == 1 else 0.0
        drive.position_error[lane] = position_error
        drive.omega_ref[lane] = omega_ref
        drive.velocity_error[lane] = error
        drive.velocity_sum[lane] = total * on
        drive.i_q_ref[lane] = i_ref * on
