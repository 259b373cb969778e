"""DcStep: above a speed the steps wait for the rotor, so that an overloaded motor slows down instead of losing steps.

With full steps and the high speed chopper (20B7h, 20B8h), which it needs, the driver makes the next step once the
on-time of the phase that it will reverse is no longer than 20B4h. With the load angle d of the present full step that
phase has the back-EMF psi w sin(d - 45 degrees) against its current i, so that its on-time

    t_on = t_off (R i + e) / (u_dc - R i - e)

is short once the rotor is near enough. The chip checks each chopper cycle; a window of 0.2 ms is longer, so only the
mean effect is modelled: solved for e the condition gives the largest lead of the field over the rotor, which limits the
steps of a window. Their speed never falls below 20B3h, and a motor that stands then has stalled: without a back-EMF the
longest on-time of a step is not above 20B5h, which stops it if 20A4h says so.
"""

from __future__ import annotations

import numpy as np

from drive_env.cia402 import CSP
from drive_env.firmware.common import modes, profiles
from drive_env.firmware.common.arithmetic import TWO_PI
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.chopper import blank_clocks, larger, slow_decay_clocks
from mechanics.kernels.compiled import inlined, stage

HALF_PI = 1.5707963267948966
ROOT_HALF = 0.7071067811865476  # share of the amplitude that each phase carries in a full step
SMALLEST_EMF = 1e-9  # V
STALL_UNIT = 16.0  # clocks, of 20B5h
FULL_STEPS_OF_STALL = 4.0  # within which a slipping rotor has turned back


@inlined
def release_steps(drive, h):
    """Limit the field's lead over the rotor in the coming window of h [s] by the on-times.

    Writes step_rate, held_way, and stalled if the rotor has no back-EMF.
    """
    for lane in range(LANES):
        planned = drive.planned_rate[lane]
        direction = 1.0 if planned > 0.0 else -1.0
        speed = abs(planned)
        least = drive.dc_speed[lane]
        chops = drive.stage_on[lane] * (1.0 - drive.in_pwm[lane])
        chops *= drive.high_speed_chopper[lane] * drive.high_speed_fullstep[lane]
        works = chops > 0.5 and least > 0.0 and speed >= least
        off = 2.0 * slow_decay_clocks(drive.off_time[lane])
        time = drive.dc_time[lane]
        u = drive.u_dc[lane] * drive.duty_limit[lane]
        resisted = (drive.R_s[lane] + drive.on_resistance[lane]) * drive.amplitude[lane] * ROOT_HALF
        per_speed = drive.psi[lane] * drive.n_p[lane] * direction
        # The back-EMF allowed at that on-time, as a share of its peak.
        share = (u * time / (time + off) - resisted) / larger(per_speed * drive.omega_m[lane], SMALLEST_EMF)
        share = share if share < 1.0 else 1.0
        share = share if share > -1.0 else -1.0
        per_rad = 0.25 * drive.full_steps[lane]
        ahead = direction * (per_rad * drive.step_position[lane] - drive.n_p[lane] * drive.theta_m[lane])
        ahead -= TWO_PI * np.floor(ahead / TWO_PI + 0.5)
        most = HALF_PI + np.arcsin(share)
        room = most - ahead + direction * drive.n_p[lane] * drive.omega_m[lane] * h
        # A rotor equally far ahead of the field opposes the phase, too; and no on-time is shorter than the blank time.
        waits = ahead < -most or time <= blank_clocks(drive.chopper_blank[lane])
        allowed = 0.0 if waits else room / (per_rad * h)
        rate = larger(allowed, least)
        rate = direction * (rate if rate < speed else speed)
        rate = rate if works else planned
        drive.step_rate[lane] = rate
        drive.held_way[lane] += (planned - rate) * h
        # Four full steps have ended: their mean speed gives the peak of the back-EMF, however the rotor swings.
        windows = drive.dc_windows[lane]
        way = abs(drive.step_position[lane] - drive.dc_start[lane]) * 4.0 * per_rad * (1.0 / TWO_PI)
        ended = works and windows > 0.0 and way >= FULL_STEPS_OF_STALL
        turned = drive.theta_m[lane] - drive.dc_rotor[lane]
        against = resisted + per_speed * turned / (larger(windows, 1.0) * h)
        longest = off * against / larger(u - against, SMALLEST_EMF)
        stands = drive.dc_stall[lane] > 0.0 and longest <= STALL_UNIT * drive.dc_stall[lane]
        stops = drive.stall_speed[lane] > 0.0 and abs(rate) > drive.stall_speed[lane]
        drive.stalled[lane] = 1.0 if ended and stands and stops else drive.stalled[lane]
        begins = ended or not works or windows == 0.0
        drive.dc_start[lane] = drive.step_position[lane] if begins else drive.dc_start[lane]
        drive.dc_rotor[lane] = drive.theta_m[lane] if begins else drive.dc_rotor[lane]
        drive.dc_windows[lane] = (1.0 if begins else windows + 1.0) if works else 0.0


@stage
def slow_ramp(drive, lane, dt):
    """Move the demand back to the waiting steps; its speed changes to theirs with the mode's ramp.

    In csp, whose set-points come from the master, the steps catch up instead.
    """
    held = drive.held_way[lane]
    drive.held_way[lane] = 0.0
    if held != 0.0 and (drive.mode_display[lane] != CSP or drive.braking[lane] == 1):
        made = drive.planned_rate[lane] - held / dt
        drive.position_demand[lane] -= held
        if abs(made) < abs(drive.velocity_demand[lane]):
            rate = modes.slow_down_ramp(drive, lane)
            drive.velocity_demand[lane] = profiles.ramp(drive.velocity_demand[lane], made, rate, dt)


@stage
def forget_waiting(drive, lane):
    """Reset: no step waits."""
    drive.planned_rate[lane] = 0.0
    drive.held_way[lane] = 0.0
    drive.dc_windows[lane] = 0.0
