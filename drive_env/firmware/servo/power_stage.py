"""Inverter, DC link and the winding of a PMSM or a DC motor, solved exactly over a tick.

The bridge holds a voltage in the stator frame. In the rotor frame, at constant speed, that voltage turns backwards:

    di/dt = A i + B u + e      A = [[-R/L_d,  w L_q/L_d], [-w L_d/L_q, -R/L_q]],  B = diag(1/L_d, 1/L_q)
    du/dt = W u                W = [[0, w], [-w, 0]],  e = [0, -w psi/L_q]

where R is that of winding and stage: a phase's current flows through one switch of its leg, a DC motor's through one
switch of each leg. So one tick is i(dt) = exp(A dt) i + G u + g with G the solution of A G - G W = exp(A dt) B - B
exp(W dt). The matrices depend only on speed and are refreshed once per window. A DC motor is the q axis of a frame at
rest.
"""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import clip, cosine_series, exponential, sine_series
from drive_env.firmware.common.dc_link import drain_link, turn_rotor
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined

SQRT3 = 3.0**0.5


@inlined
def refresh_winding(drive, dt, h):
    """Compute the matrices of the exact step for ticks of dt [s] at the speed in the middle of this window of h [s]."""
    for lane in range(LANES):
        R = drive.R_s[lane] + (1.0 + drive.is_dc[lane]) * drive.on_resistance[lane]
        L_d = drive.L_d[lane]
        L_q = drive.L_q[lane]
        acceleration = (drive.tau_m[lane] + drive.tau_cogging[lane] - drive.tau_reaction[lane]) / drive.J_rotor[lane]
        omega_e = drive.n_p[lane] * (drive.omega_m[lane] + 0.5 * h * acceleration)
        # A DC motor's frame does not turn, but its back-EMF is present.
        w = omega_e * (1.0 - drive.is_dc[lane])
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
        e_q = -omega_e * drive.psi_m[lane] * b_q
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
        drive.half_turn_sin[lane] = 0.5 * wt * half
        drive.half_turn_cos[lane] = cosine_series(0.25 * z)
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
def power_stage(drive):
    """Hold the bridge's duty for one tick: writes the currents at its end, their means, and the voltage held."""
    for lane in range(LANES):
        s = drive.sin_e[lane]
        c = drive.cos_e[lane]
        i_d = drive.i_d[lane]
        i_q = drive.i_q[lane]
        u_dc = drive.u_dc[lane]
        # While both switches of a leg are off the current chooses the rail: a phase loses dead_time u_dc sign(i).
        i_alpha = c * i_d - s * i_q
        i_beta = s * i_d + c * i_q
        per_ampere = drive.dead_time_slope[lane]
        lost = u_dc * drive.dead_time_duty[lane]
        lost_a = clip(i_alpha * per_ampere, 1.0)
        lost_b = clip(0.5 * (SQRT3 * i_beta - i_alpha) * per_ampere, 1.0)
        lost_c = clip(-0.5 * (SQRT3 * i_beta + i_alpha) * per_ampere, 1.0)
        is_dc = drive.is_dc[lane]
        # A DC motor is between two legs: each has a loss, and there is no beta.
        lost_alpha = lost * (2.0 * lost_a if is_dc > 0.5 else (1.0 / 3.0) * (2.0 * lost_a - lost_b - lost_c))
        u_alpha = drive.duty_alpha[lane] * u_dc - lost_alpha
        u_beta = (drive.duty_beta[lane] * u_dc - lost * (1.0 / SQRT3) * (lost_b - lost_c)) * (1.0 - is_dc)
        u_d = c * u_alpha + s * u_beta
        u_q = c * u_beta - s * u_alpha
        on = drive.stage_on[lane]
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
        drive.i_d_before[lane] = i_d
        drive.i_q_before[lane] = i_q
        drive.i_d[lane] = new_d
        drive.i_q[lane] = new_q
        drive.i_d_mean[lane] = mean_d
        drive.i_q_mean[lane] = mean_q
        drive.u_d[lane] = u_d
        drive.u_q[lane] = u_q
        drive.duty_alpha[lane] = drive.duty_next_alpha[lane]
        drive.duty_beta[lane] = drive.duty_next_beta[lane]


@inlined
def open_phases(drive):
    """Remove the current along a phase with a broken cable."""
    for lane in range(LANES):
        s = drive.sin_e[lane]
        c = drive.cos_e[lane]
        # Axes of the phases in the rotor frame; a DC motor's two legs are in series and share one.
        is_dc = drive.is_dc[lane] > 0.5
        a_d = c
        a_q = -s
        b_d = a_d if is_dc else 0.5 * (SQRT3 * s - c)
        b_q = a_q if is_dc else 0.5 * (SQRT3 * c + s)
        i_d = drive.i_d[lane]
        i_q = drive.i_q[lane]
        out = drive.open_a[lane] * (i_d * a_d + i_q * a_q)
        i_d -= out * a_d
        i_q -= out * a_q
        out = drive.open_b[lane] * (i_d * b_d + i_q * b_q)
        i_d -= out * b_d
        i_q -= out * b_q
        open_c = 0.0 if is_dc else drive.open_c[lane]
        c_d = -a_d - b_d
        c_q = -a_q - b_q
        out = open_c * (i_d * c_d + i_q * c_q)
        drive.i_d[lane] = i_d - out * c_d
        drive.i_q[lane] = i_q - out * c_q
        m_d = drive.i_d_mean[lane]
        m_q = drive.i_q_mean[lane]
        out = drive.open_a[lane] * (m_d * a_d + m_q * a_q)
        m_d -= out * a_d
        m_q -= out * a_q
        out = drive.open_b[lane] * (m_d * b_d + m_q * b_q)
        m_d -= out * b_d
        m_q -= out * b_q
        out = open_c * (m_d * c_d + m_q * c_q)
        drive.i_d_mean[lane] = m_d - out * c_d
        drive.i_q_mean[lane] = m_q - out * c_q


@inlined
def find_torque(drive, lane):
    """Compute torque and power from the tick's mean currents: writes tau_m and bridge_power."""
    mean_d = drive.i_d_mean[lane]
    mean_q = drive.i_q_mean[lane]
    change = (drive.i_d[lane] - drive.i_d_before[lane]) * (drive.i_q[lane] - drive.i_q_before[lane])
    # mean(i_d i_q) of currents that change linearly within the tick.
    mean_dq = mean_d * mean_q + change * (1.0 / 12.0)
    drive.tau_m[lane] = (
        drive.phase_factor[lane]
        * drive.n_p[lane]
        * (drive.psi_m[lane] * mean_q + (drive.L_d[lane] - drive.L_q[lane]) * mean_dq)
    )
    # The held voltage in the rotor frame in the middle of the tick, times the mean current.
    half_s = drive.half_turn_sin[lane]
    half_c = drive.half_turn_cos[lane]
    mid_d = half_c * drive.u_d[lane] + half_s * drive.u_q[lane]
    mid_q = half_c * drive.u_q[lane] - half_s * drive.u_d[lane]
    drive.bridge_power[lane] = drive.phase_factor[lane] * (mid_d * mean_d + mid_q * mean_q)


@inlined
def convert_energy(drive, dt, progress):
    """Compute torque and supply current from the tick's mean currents: writes tau_m, u_dc, and advances the rotor.

    Ticks take dt [s]; `progress` is that of `turn_rotor`.
    """
    for lane in range(LANES):
        find_torque(drive, lane)
        u_dc = drive.u_dc[lane]
        # Charge by braking is removed only by the chopper.
        limit = drive.chopper_voltage[lane]
        chopper = drive.chopper[lane]
        chopper = 0.0 if u_dc < limit - drive.chopper_hysteresis[lane] else chopper
        chopper = drive.chopper_enable[lane] if u_dc > limit else chopper
        drive.chopper[lane] = chopper
        burnt = u_dc * chopper * drive.chopper_conductance[lane]
        drain_link(drive, lane, drive.idle_current[lane] + drive.bridge_power[lane] / u_dc + burnt)
        turn_rotor(drive, lane, drive.tau_m[lane] + drive.tau_cogging[lane], dt, progress)
