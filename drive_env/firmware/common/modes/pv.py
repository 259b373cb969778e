"""Profile velocity mode (manual, section 7)."""

from __future__ import annotations

from drive_env.firmware.common import profiles
from mechanics.compiled import stage


@stage
def generate(drive, lane, dt):
    """Ramp the velocity demand to 60FFh with 6083h both ways; bit 10 tells that the ramp has ended.

    A target beyond 607Fh, where a device has that, is not reached: bit 11 tells so, and bit 10 stays 0.

    The position demand follows as the integral of the velocity demand, so that 6062h and the following error window,
    which the manual lists in this mode, mean something here. A ramp of 0 (factory) does not move.
    """
    drive.loop_level[lane] = 1
    v = drive.velocity_demand[lane]
    rate = drive.acceleration[lane]
    target = profiles.limited(drive.target_velocity[lane], drive.velocity_limit[lane])
    if target != drive.target_velocity[lane]:
        drive.internal_limit[lane] = 1
    v_new = profiles.ramp(v, target, rate, dt) if rate > 0.0 else v
    drive.position_demand[lane] += 0.5 * (v + v_new) * dt
    drive.velocity_demand[lane] = v_new
    drive.target_reached[lane] = 1 if v_new == drive.target_velocity[lane] else 0
