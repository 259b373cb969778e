"""What the bridges of a module do in a tick: torque, power from the link, and the rotor's motion."""

from __future__ import annotations

from drive_env.firmware.record import LANES
from drive_env.firmware.servo_mains.mains_link import move_link
from mechanics.compiled import inlined


@inlined
def convert_energy(drive, dt, progress):
    """Turn the tick's mean currents into torque and power: writes tau_m, bridge_power, the link, and moves the rotor.

    Args:
        drive: The record.
        dt: Current-loop period [s].
        progress: Middle of this tick, as a share of the window, plus one half: the load's reaction is extrapolated
            from the middles of the last two windows to it.
    """
    for lane in range(LANES):
        mean_d = drive.i_d_mean[lane]
        mean_q = drive.i_q_mean[lane]
        change = (drive.i_d[lane] - drive.i_d_before[lane]) * (drive.i_q[lane] - drive.i_q_before[lane])
        # mean(i_d i_q) of currents that change linearly within the tick.
        mean_dq = mean_d * mean_q + change * (1.0 / 12.0)
        tau = (
            drive.phase_factor[lane]
            * drive.n_p[lane]
            * (drive.psi_m[lane] * mean_q + (drive.L_d[lane] - drive.L_q[lane]) * mean_dq)
        )
        drive.tau_m[lane] = tau
        # The held voltage, as the rotor frame sees it in the middle of the tick, times the mean current.
        half_s = drive.half_turn_sin[lane]
        half_c = drive.half_turn_cos[lane]
        mid_d = half_c * drive.u_d[lane] + half_s * drive.u_q[lane]
        mid_q = half_c * drive.u_q[lane] - half_s * drive.u_d[lane]
        drive.bridge_power[lane] = drive.phase_factor[lane] * (mid_d * mean_d + mid_q * mean_q)
    move_link(drive, dt)
    for lane in range(LANES):
        reaction = drive.tau_reaction[lane] + progress * (drive.tau_reaction[lane] - drive.tau_reaction_before[lane])
        omega = drive.omega_m[lane]
        torque = drive.tau_m[lane] + drive.tau_cogging[lane] - reaction
        new_omega = omega + drive.tick_mobility[lane] * torque
        drive.omega_m[lane] = new_omega
        drive.theta_m[lane] += 0.5 * dt * (omega + new_omega)
