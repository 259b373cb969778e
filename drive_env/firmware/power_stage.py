"""Inverter, supply and the winding of a permanent-magnet synchronous motor, solved exactly over a tick.

The bridge holds a voltage in the stator frame. In the rotor frame, at constant speed, that voltage turns backwards:

    di/dt = A i + B u + e      A = [[-R/L_d,  w L_q/L_d], [-w L_d/L_q, -R/L_q]],  B = diag(1/L_d, 1/L_q)
    du/dt = W u                W = [[0, w], [-w, 0]],  e = [0, -w psi/L_q]

so one tick is i(dt) = exp(A dt) i + G u + g with G the solution of A G - G W = exp(A dt) B - B exp(W dt). The
matrices change with speed only and are refreshed once per window.
"""

from __future__ import annotations

from drive_env.firmware.arithmetic import clip, cosine_series, exponential, sine_series
from drive_env.firmware.record import LANES
from mechanics.compiled import inlined

SQRT3 = 3.0**0.5


@inlined
def refresh_winding(drive, dt, h):
    """Compute the matrices of the exact step for ticks of dt [s] at the speed in the middle of this window of h [s]."""
    for lane in range(LANES):
        R = drive.R_s[lane]
        L_d = drive.L_d[lane]
        L_q = drive.L_q[lane]
        acceleration = (drive.tau_m[lane] + drive.tau_cogging[lane] - drive.tau_reaction[lane]) / drive.J_rotor[lane]
        w = drive.n_p[lane] * (drive.omega_m[lane] + 0.5 * h * acceleration)
        a_dd = -R / L_d
        a_qq = -R / L_q
        a_dq = w * L_q / L_d
        a_qd = -w * L_d / L_q
        # exp(A dt) = e^(mu dt) (C I + S dt (A - mu I)), C and S even in dt sqrt(delta^2 - w^2).
        mu = 0.5 * (a_dd + a_qq)
        delta = 0.5 * (a_dd - a_qq)
        y = (delta * delta - w * w) * dt * dt
        decay = exponential(mu * dt)
        C = decay * cosine_series(y)
        S = decay * dt * sine_series(y)
        p_dd = C + S * delta
        p_qq = C - S * delta
        p_dq = S * a_dq
        p_qd = S * a_qd
        # exp(W dt) and its integral over the tick divided by dt.
        wt = w * dt
        z = -wt * wt
        cw = cosine_series(z)
        sw = wt * sine_series(z)
        # Y = exp(A dt) B - B exp(W dt).
        b_d = 1.0 / L_d
        b_q = 1.0 / L_q
        y_dd = (p_dd - cw) * b_d
        y_dq = p_dq * b_q - b_d * sw
        y_qd = p_qd * b_d + b_q * sw
        y_qq = (p_qq - cw) * b_q
        # A G - G W = Y gives (A^2 + w^2 I) G = A Y + Y W, and A^2 + w^2 I = 2 mu A - (R^2/(L_d L_q)) I.
        r = R * R * b_d * b_q
        k_dd = 2.0 * mu * a_dd - r
        k_qq = 2.0 * mu * a_qq - r
        k_dq = 2.0 * mu * a_dq
        k_qd = 2.0 * mu * a_qd
        m_dd = a_dd * y_dd + a_dq * y_qd - w * y_dq
        m_dq = a_dd * y_dq + a_dq * y_qq + w * y_dd
        m_qd = a_qd * y_dd + a_qq * y_qd - w * y_qq
        m_qq = a_qd * y_dq + a_qq * y_qq + w * y_qd
        k = 1.0 / (k_dd * k_qq - k_dq * k_qd)
        g_dd = (k_qq * m_dd - k_dq * m_qd) * k
        g_dq = (k_qq * m_dq - k_dq * m_qq) * k
        g_qd = (k_dd * m_qd - k_qd * m_dd) * k
        g_qq = (k_dd * m_qq - k_qd * m_dq) * k
        # Back-EMF: A^-1 (exp(A dt) - I) e.
        e_q = -w * drive.psi_m[lane] * b_q
        det = 1.0 / (r + w * w)
        f_d = p_dq * e_q
        f_q = (p_qq - 1.0) * e_q
        h_d = (a_qq * f_d - a_dq * f_q) * det
        h_q = (a_dd * f_q - a_qd * f_d) * det
        drive.step_i[0, lane] = p_dd
        drive.step_i[1, lane] = p_dq
        drive.step_i[2, lane] = p_qd
        drive.step_i[3, lane] = p_qq
        drive.step_u[0, lane] = g_dd
        drive.step_u[1, lane] = g_dq
        drive.step_u[2, lane] = g_qd
        drive.step_u[3, lane] = g_qq
        drive.step_e[0, lane] = h_d
        drive.step_e[1, lane] = h_q
        # Mean current over the tick from the integrated equation: A mean = (i1 - i0)/dt - B mean(u) - e.
        n = det / dt
        o = det
        cs = sine_series(z)
        # (1 - cos)/wt without cancellation: the series of (1 - cos x)/x^2 is that of sin(x/2)^2.
        half = sine_series(0.25 * z)
        vs = 0.5 * wt * half * half
        d_dd = p_dd - 1.0
        d_qq = p_qq - 1.0
        drive.mean_i[0, lane] = (a_qq * d_dd - a_dq * p_qd) * n
        drive.mean_i[1, lane] = (a_qq * p_dq - a_dq * d_qq) * n
        drive.mean_i[2, lane] = (a_dd * p_qd - a_qd * d_dd) * n
        drive.mean_i[3, lane] = (a_dd * d_qq - a_qd * p_dq) * n
        q_dd = g_dd / dt - b_d * cs
        q_dq = g_dq / dt - b_d * vs
        q_qd = g_qd / dt + b_q * vs
        q_qq = g_qq / dt - b_q * cs
        drive.mean_u[0, lane] = (a_qq * q_dd - a_dq * q_qd) * o
        drive.mean_u[1, lane] = (a_qq * q_dq - a_dq * q_qq) * o
        drive.mean_u[2, lane] = (a_dd * q_qd - a_qd * q_dd) * o
        drive.mean_u[3, lane] = (a_dd * q_qq - a_qd * q_dq) * o
        r_d = h_d / dt
        r_q = h_q / dt - e_q
        drive.mean_e[0, lane] = (a_qq * r_d - a_dq * r_q) * o
        drive.mean_e[1, lane] = (a_dd * r_q - a_qd * r_d) * o


@inlined
def power_stage(drive, dt, progress):
    """Hold the bridge's duty for one tick of dt [s]: writes i_d, i_q, tau_m, and moves the rotor on.

    Args:
        drive: The record.
        dt: Current-loop period [s].
        progress: Middle of this tick, as a share of the window, plus one half: the load's reaction is extrapolated
            from the middles of the last two windows to it.
    """
    for lane in range(LANES):
        s = drive.sin_e[lane]
        c = drive.cos_e[lane]
        i_d = drive.i_d[lane]
        i_q = drive.i_q[lane]
        u_dc = drive.u_dc[lane]
        # While both switches of a leg are off the current chooses the rail: a phase loses dead_time u_dc sign(i).
        i_alpha = c * i_d - s * i_q
        i_beta = s * i_d + c * i_q
        per_ampere = 1.0 / drive.dead_time_current[lane]
        lost = u_dc * drive.dead_time_duty[lane]
        lost_a = clip(i_alpha * per_ampere, 1.0)
        lost_b = clip(0.5 * (SQRT3 * i_beta - i_alpha) * per_ampere, 1.0)
        lost_c = clip(-0.5 * (SQRT3 * i_beta + i_alpha) * per_ampere, 1.0)
        u_alpha = drive.duty_alpha[lane] * u_dc - lost * (1.0 / 3.0) * (2.0 * lost_a - lost_b - lost_c)
        u_beta = drive.duty_beta[lane] * u_dc - lost * (1.0 / SQRT3) * (lost_b - lost_c)
        u_d = c * u_alpha + s * u_beta
        u_q = c * u_beta - s * u_alpha
        on = drive.drive_function[lane]
        new_d = (
            drive.step_i[0, lane] * i_d
            + drive.step_i[1, lane] * i_q
            + drive.step_u[0, lane] * u_d
            + drive.step_u[1, lane] * u_q
            + drive.step_e[0, lane]
        ) * on
        new_q = (
            drive.step_i[2, lane] * i_d
            + drive.step_i[3, lane] * i_q
            + drive.step_u[2, lane] * u_d
            + drive.step_u[3, lane] * u_q
            + drive.step_e[1, lane]
        ) * on
        mean_d = (
            drive.mean_i[0, lane] * i_d
            + drive.mean_i[1, lane] * i_q
            + drive.mean_u[0, lane] * u_d
            + drive.mean_u[1, lane] * u_q
            + drive.mean_e[0, lane]
        ) * on
        mean_q = (
            drive.mean_i[2, lane] * i_d
            + drive.mean_i[3, lane] * i_q
            + drive.mean_u[2, lane] * u_d
            + drive.mean_u[3, lane] * u_q
            + drive.mean_e[1, lane]
        ) * on
        # mean(i_d i_q) of currents that change linearly within the tick.
        mean_dq = mean_d * mean_q + (new_d - i_d) * (new_q - i_q) * (1.0 / 12.0)
        tau = 1.5 * drive.n_p[lane] * (drive.psi_m[lane] * mean_q + (drive.L_d[lane] - drive.L_q[lane]) * mean_dq)
        drive.i_d[lane] = new_d
        drive.i_q[lane] = new_q
        drive.tau_m[lane] = tau
        # The supply's sag follows the DC current of this tick, one tick later.
        power = 1.5 * (u_d * i_d + u_q * i_q) * on
        drive.u_dc[lane] = drive.supply_voltage[lane] - drive.supply_resistance[lane] * power / u_dc
        reaction = drive.tau_reaction[lane] + progress * (drive.tau_reaction[lane] - drive.tau_reaction_before[lane])
        omega = drive.omega_m[lane]
        new_omega = omega + dt * (tau + drive.tau_cogging[lane] - reaction) / drive.J_rotor[lane]
        drive.omega_m[lane] = new_omega
        drive.theta_m[lane] += 0.5 * dt * (omega + new_omega)
        drive.duty_alpha[lane] = drive.duty_next_alpha[lane]
        drive.duty_beta[lane] = drive.duty_next_beta[lane]
