"""The two phases of a hybrid stepper, solved exactly over a tick, and its torque.

Each phase is a winding of its own; the rotor's flux links them as psi cos(theta_e) and psi sin(theta_e), so that

    L di_a/dt = u_a - R i_a + psi w sin(theta_e)        L di_b/dt = u_b - R i_b - psi w cos(theta_e)
    tau_m = n_p psi (i_b cos(theta_e) - i_a sin(theta_e))

where R is that of winding and stage, and the rotor is at rest where theta_e is the current vector's angle. Iron
saturates with the current: psi = psi_m / sqrt(1 + saturation (i_a^2 + i_b^2)), in torque and back-EMF alike, so that
energy balances. The teeth cause the detent torque -T_d sin(4 theta_e), with rest positions where one phase would hold
the rotor. Speed and psi are constant within a window.
"""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import cosine_series, exponential, sine_cosine, sine_series
from drive_env.firmware.common.dc_link import drain_link, turn_rotor
from drive_env.firmware.common.phases import note_peaks
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.chopper import PWM_STEPS, phase_voltage
from mechanics.kernels.compiled import inlined


@inlined
def refresh_winding(drive, dt, h):
    """Compute the exact step for ticks of dt [s] at the speed in the middle of this window of h [s], and its flux."""
    for lane in range(LANES):
        square = drive.i_a[lane] * drive.i_a[lane] + drive.i_b[lane] * drive.i_b[lane]
        psi = drive.psi_m[lane] / (1.0 + drive.saturation[lane] * square) ** 0.5
        R = drive.R_s[lane] + drive.on_resistance[lane]
        L = drive.L_s[lane]
        acceleration = (drive.tau_m[lane] + drive.tau_detent[lane] - drive.tau_reaction[lane]) / drive.J_rotor[lane]
        w = drive.n_p[lane] * (drive.omega_m[lane] + 0.5 * h * acceleration)
        k = R / L
        decay = exponential(-k * dt)
        wt = w * dt
        z = -wt * wt
        cw = cosine_series(z)
        sw = wt * sine_series(z)
        # Integral of exp(-k (dt - t)) exp(i w t): (exp(i w dt) - exp(-k dt)) / (k + i w).
        scale = psi * w / L / (k * k + w * w)
        along_sine = scale * ((cw - decay) * k + sw * w)
        along_cosine = scale * (sw * k - (cw - decay) * w)
        half = sine_series(0.25 * z)
        # Mean current from the integrated equation: R mean = mean(u - e) - L (i1 - i0) / dt.
        per_tick = L / dt
        drive.psi[lane] = psi
        drive.step_i[lane] = decay
        drive.step_u[lane] = (1.0 - decay) / R
        drive.step_u_inverse[lane] = R / (1.0 - decay)
        drive.step_e[0, lane] = along_sine
        drive.step_e[1, lane] = along_cosine
        kept = per_tick * (1.0 - decay) / R
        drive.mean_i[lane] = kept
        drive.mean_u[lane] = (1.0 - kept) / R
        drive.mean_e[0, lane] = (psi * w * sine_series(z) - per_tick * along_sine) / R
        drive.mean_e[1, lane] = (psi * w * 0.5 * wt * half * half - per_tick * along_cosine) / R
        drive.half_turn_sin[lane] = 0.5 * wt * half
        drive.half_turn_cos[lane] = cosine_series(0.25 * z)
        drive.turn_sinc[lane] = half
        drive.turn_sixth[lane] = wt * (1.0 / 12.0)


@inlined
def chop(drive):
    """Choose the phases' mean voltages for one tick: writes u_a and u_b, and the back-EMF's share of the currents."""
    for lane in range(LANES):
        s, c = sine_cosine(drive.n_p[lane] * drive.theta_m[lane])
        largest = drive.u_dc[lane] * drive.duty_limit[lane]
        lowest = largest * drive.lowest_share[lane]
        left = drive.step_i[lane]
        slope = drive.step_u_inverse[lane]
        emf_a = drive.step_e[0, lane] * s + drive.step_e[1, lane] * c
        emf_b = drive.step_e[1, lane] * s - drive.step_e[0, lane] * c
        shift = drive.current_shift[lane]
        amplitude = drive.amplitude[lane] * drive.current_gain[lane]
        offset_a = -(left * drive.i_a[lane] + emf_a) * slope
        offset_b = -(left * drive.i_b[lane] + emf_b) * slope
        u_a = phase_voltage(amplitude * drive.cos_ref[lane], shift, offset_a, slope, lowest, largest)
        u_b = phase_voltage(amplitude * drive.sin_ref[lane], shift, offset_b, slope, lowest, largest)
        held = largest * drive.pwm_scale[lane] * (1.0 / PWM_STEPS)
        in_pwm = drive.in_pwm[lane] > 0.5
        drive.sin_e[lane] = s
        drive.cos_e[lane] = c
        drive.emf_a[lane] = emf_a
        drive.emf_b[lane] = emf_b
        drive.u_a[lane] = held * drive.cos_ref[lane] if in_pwm else u_a
        drive.u_b[lane] = held * drive.sin_ref[lane] if in_pwm else u_b


@inlined
def power_stage(drive):
    """Hold the phases' voltages for one tick: writes currents, their means, torques and the power from the DC link."""
    for lane in range(LANES):
        s = drive.sin_e[lane]
        c = drive.cos_e[lane]
        i_a = drive.i_a[lane]
        i_b = drive.i_b[lane]
        u_a = drive.u_a[lane]
        u_b = drive.u_b[lane]
        on_a = drive.stage_on[lane] * (1.0 - drive.open_a[lane])
        on_b = drive.stage_on[lane] * (1.0 - drive.open_b[lane])
        new_a = (drive.step_i[lane] * i_a + drive.step_u[lane] * u_a + drive.emf_a[lane]) * on_a
        new_b = (drive.step_i[lane] * i_b + drive.step_u[lane] * u_b + drive.emf_b[lane]) * on_b
        from_u = drive.mean_u[lane]
        mean_a = drive.mean_i[lane] * i_a + from_u * u_a + drive.mean_e[0, lane] * s + drive.mean_e[1, lane] * c
        mean_b = drive.mean_i[lane] * i_b + from_u * u_b + drive.mean_e[1, lane] * s - drive.mean_e[0, lane] * c
        mean_a = mean_a * on_a
        mean_b = mean_b * on_b
        # In the middle of the tick, including the change of angle and currents within it.
        sm = s * drive.half_turn_cos[lane] + c * drive.half_turn_sin[lane]
        cm = c * drive.half_turn_cos[lane] - s * drive.half_turn_sin[lane]
        turning = drive.turn_sixth[lane] * ((new_b - i_b) * sm + (new_a - i_a) * cm)
        drive.tau_m[lane] = (
            drive.n_p[lane] * drive.psi[lane] * (drive.turn_sinc[lane] * (mean_b * cm - mean_a * sm) - turning)
        )
        drive.tau_detent[lane] = -drive.detent_torque[lane] * 4.0 * sm * cm * (cm * cm - sm * sm)
        # A triangle of the ripple's size adds its mean square, a twelfth, to each phase's.
        R = drive.R_s[lane] + drive.on_resistance[lane]
        ripple_loss = R * drive.ripple[lane] * drive.ripple[lane] * (1.0 / 12.0) * (on_a + on_b)
        drive.bridge_power[lane] = u_a * mean_a + u_b * mean_b + ripple_loss
        drive.i_a[lane] = new_a
        drive.i_b[lane] = new_b
        drive.i_a_mean[lane] = mean_a
        drive.i_b_mean[lane] = mean_b


@inlined
def move_rotor(drive, dt, progress):
    """Take the power from the DC link and advance the rotor by one tick of dt [s]; note the largest currents.

    `progress` is that of `turn_rotor`.
    """
    for lane in range(LANES):
        drain_link(drive, lane, drive.drain[lane] + drive.bridge_power[lane] / drive.u_dc[lane])
        note_peaks(drive, lane, drive.i_a_mean[lane], drive.i_b_mean[lane])
        turn_rotor(drive, lane, drive.tau_m[lane] + drive.tau_detent[lane], dt, progress)
