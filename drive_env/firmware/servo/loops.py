"""The cascade: position P, velocity PI, current PI in d and q, in the motion chip's "advanced" form.

x = clip(x + P I e), out = clip(P e + x), both at the output's limit, without back-calculation (TMC4671 data sheet
2.08, "advanced PI"); then the voltage circle.
"""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import between, clip
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined


@inlined
def motion_loops(drive):
    """Position P and velocity PI, one window: reads demands and measurements; writes i_q_ref [A]."""
    for lane in range(LANES):
        level = drive.loop_level[lane]
        position_error = drive.position_demand[lane] - drive.theta_meas[lane]
        omega_ref = drive.position_p[lane] * position_error if level == 2 else drive.velocity_demand[lane]
        error = omega_ref - drive.omega_meas[lane]
        i_max = drive.i_max[lane] * drive.current_share[lane]
        proportional = drive.velocity_p[lane] * error
        total = clip(drive.velocity_sum[lane] + proportional * drive.velocity_i[lane], i_max)
        i_loop = clip(proportional + total, i_max)
        i_direct = clip(drive.torque_demand[lane], i_max)
        # While torque is commanded the integrator follows it, otherwise a change to a velocity mode would jump.
        total = clip(i_direct - proportional, i_max) if level == 0 else total
        i_ref = i_direct if level == 0 else i_loop
        on = drive.drive_function[lane]
        drive.position_error[lane] = position_error
        drive.omega_ref[lane] = omega_ref
        drive.velocity_error[lane] = error
        drive.velocity_sum[lane] = total * on
        drive.i_q_ref[lane] = i_ref * on


@inlined
def current_loop(drive):
    """Current PI in d and q, one tick: reads i_q_ref, measured currents and angle; writes the next period's duty."""
    for lane in range(LANES):
        s = drive.sin_meas[lane]
        c = drive.cos_meas[lane]
        i_d = c * drive.i_alpha_meas[lane] + s * drive.i_beta_meas[lane]
        i_q = c * drive.i_beta_meas[lane] - s * drive.i_alpha_meas[lane]
        error_d = drive.i_d_ref[lane] - i_d
        shaft_sign = 1.0 - 2.0 * drive.shaft_direction[lane]
        error_q = shaft_sign * drive.torque_share[lane] * drive.i_q_ref[lane] - i_q
        on = drive.stage_on[lane]
        # Two legs have the whole supply between them, not the voltage circle.
        limit = 1.0 if drive.angle_source[lane] == 5.0 else drive.duty_limit[lane]
        p_d = drive.current_p_d[lane] * error_d
        p_q = drive.current_p[lane] * error_q
        low, high = -limit * drive.voltage_low[lane], limit * drive.voltage_high[lane]
        sum_d = between(drive.current_sum_d[lane] + p_d * drive.current_i[lane], low, high) * on
        sum_q = between(drive.current_sum_q[lane] + p_q * drive.current_i[lane], low, high) * on
        duty_d = between(p_d + sum_d, low, high)
        duty_q = between(p_q + sum_q, low, high)
        length = (duty_d * duty_d + duty_q * duty_q) ** 0.5
        scale = on * (limit / length if length > limit else 1.0)
        duty_d = duty_d * scale
        duty_q = duty_q * scale
        drive.i_d_meas[lane] = i_d
        drive.i_q_meas[lane] = i_q
        drive.torque_meas[lane] = shaft_sign * i_q
        drive.current_error_d[lane] = error_d
        drive.current_error_q[lane] = error_q
        drive.current_sum_d[lane] = sum_d
        drive.current_sum_q[lane] = sum_q
        # Computed from this tick's samples, applied by the bridge during the next: one PWM period of delay.
        drive.duty_next_alpha[lane] = c * duty_d - s * duty_q
        drive.duty_next_beta[lane] = s * duty_d + c * duty_q
