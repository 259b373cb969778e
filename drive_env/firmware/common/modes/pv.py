"""Profile velocity mode (manual, section 7)."""

from __future__ import annotations

from drive_env.firmware.common import profiles, s_ramp
from mechanics.compiled import stage


@stage
def generate(drive, lane, dt):
    """Ramp the velocity demand to 60FFh with 6083h both ways; bit 10 tells that the ramp has ended.

    A target beyond 607Fh, where a device has that, is not reached: bit 11 tells so, and bit 10 stays 0.

    The position demand follows as the integral of the velocity demand, so that 6062h and the following error window,
    which the manual lists in this mode, mean something here. A ramp of 0 (factory) does not move. An S-shaped ramp goes
    down with 6084h (TMCM-3313 manual, section 7.1.14).
    """
    drive.loop_level[lane] = 1
    v = drive.velocity_demand[lane]
    rate = drive.acceleration[lane]
    target = profiles.limited(drive.target_velocity[lane], drive.velocity_limit[lane])
    if target != drive.target_velocity[lane]:
        drive.internal_limit[lane] = 1
    if rate > 0.0 and s_ramp.is_set(drive, lane):
        down = drive.deceleration[lane] if drive.deceleration[lane] > 0.0 else rate
        s_ramp.approach(drive, lane, target, rate, down, dt)
        ended = drive.velocity_demand[lane] == drive.target_velocity[lane] and drive.acceleration_demand[lane] == 0.0
        drive.target_reached[lane] = 1 if ended else 0
        return
    v_new = profiles.ramp(v, target, rate, dt) if rate > 0.0 else v
    drive.position_demand[lane] += 0.5 * (v + v_new) * dt
    drive.velocity_demand[lane] = v_new
    drive.target_reached[lane] = 1 if v_new == drive.target_velocity[lane] else 0
