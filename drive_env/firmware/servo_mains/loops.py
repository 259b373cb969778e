"""Position P and velocity PI of a servo amplifier, with feed-forward of speed and current, and the current's limit.

The regulators have a gain and an integration time (C-K and C-Ti, V-K and V-Ti); the position loop adds a share of its
set-points' speed (P-SFF). Torque objects are shares of the motor's peak current (M-Ipeak): 32767 is 100 %. The manual
has 6071h as the set-point of cst and pt, and in csp and ip as "the feedforward torque value", which "is added to the
desired value of the current regulator". For the current limit it gives only the ends: 0 is no limitation, "where
maximal current = M-Ipeak", 32767 is full limitation. A straight line is assumed between them,

    i_most = M-Ipeak (32767 - limit) / 32767

and values above 32767 are full limitation, too. C-LimN and C-LimP also limit each sign, in thousandths of M-Inull (in
mA of amplitude: C-Lim M-Inull / 1000, as the maker's page has it), V-LimN and V-LimP the speed demanded by the position
loop.

C-CogCompFac is the share of the motor's cogging that a current compensates in every mode. "Before using function must
be measured compensation data of motor" (the maker's page), but no register has them: here they are the motor's true
ones, at the angle of its feedback.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa
from drive_env.firmware.common.arithmetic import TWO_PI, between, sine_cosine
from drive_env.firmware.common.modes import CSP, acts_as, is_blocked
from drive_env.firmware.common.modes.cyclic import NO_SET_POINT
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined, stage

FULL_LIMITATION = 32767.0


@inlined
def share_current(drive):
    """Write i_low, i_high: the limits by C-LimN, C-LimP, M-Ipeak and the images; i_max, and torque_demand_share."""
    for lane in range(LANES):
        peak, nominal = drive.peak_current[lane], drive.nominal_motor_current[lane]
        most = peak * (1.0 - drive.image_limit[lane] / FULL_LIMITATION)
        most = most if most > 0.0 else 0.0
        low, high = drive.limit_negative[lane] * nominal, drive.limit_positive[lane] * nominal
        low, high = (low if low < most else most), (high if high < most else most)
        drive.i_low[lane] = -low
        drive.i_high[lane] = high
        drive.i_max[lane] = low if low > high else high
        drive.torque_demand_share[lane] = drive.i_q_ref[lane] / peak if peak > 0.0 else 0.0


@inlined
def find_integral_shares(drive, tick, window):
    """Write the integrators' shares of P e per sample, from the integration times; ticks and windows in s."""
    for lane in range(LANES):
        current, velocity = drive.current_integration[lane], drive.velocity_integration[lane]
        drive.current_i[lane] = tick / current if current > 0.0 else 0.0
        drive.velocity_i[lane] = window / velocity if velocity > 0.0 else 0.0


@stage
def feed_forward_current(drive, lane):
    """Write the feed-forward current of ip and csp; an axis that stops, waits or is blocked has none."""
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
        asked = between(drive.position_p[lane] * position_error + ahead, -drive.speed_low[lane], drive.speed_high[lane])
        omega_ref = asked if level == 2 else demand
        error = omega_ref - drive.omega_meas[lane]
        low, high = drive.i_low[lane], drive.i_high[lane]
        proportional = drive.velocity_p[lane] * error
        total = between(drive.velocity_sum[lane] + proportional * drive.velocity_i[lane], low, high)
        i_loop = between(between(proportional + total, low, high) + drive.torque_feed_forward[lane], low, high)
        i_direct = between(drive.torque_demand[lane], low, high)
        # While torque is commanded the integrator follows it, otherwise a change to a velocity mode would jump.
        total = between(i_direct - proportional, low, high) if level == 0 else total
        i_ref = i_direct if level == 0 else i_loop
        # A current that waits for the brake holds the axis meanwhile.
        on = 1.0 if drive.drive_function[lane] > 0.0 or drive.holding[lane] == 1 else 0.0
        drive.position_error[lane] = position_error
        drive.omega_ref[lane] = omega_ref
        drive.velocity_error[lane] = error
        drive.velocity_sum[lane] = total * on
        drive.i_q_ref[lane] = i_ref * on


@inlined
def compensate_cogging(drive):
    """Add to i_q_ref [A] the current whose torque is opposite to the cogging at the angle of the feedback."""
    for lane in range(LANES):
        angle = TWO_PI * drive.turns_per_count[lane] * drive.count[lane]
        s, _ = sine_cosine(drive.cogging_order[lane] * angle + drive.cogging_phase[lane])
        wanted = drive.i_q_ref[lane] - drive.cogging_current[lane] * s
        on = drive.drive_function[lane] > 0.0 or drive.holding[lane] == 1
        drive.i_q_ref[lane] = between(wanted, drive.i_low[lane], drive.i_high[lane]) if on else drive.i_q_ref[lane]
