"""Profile velocity mode (manual, section 7)."""

from __future__ import annotations

from drive_env.firmware import profiles
from mechanics.compiled import stage


@stage
def generate(drive, lane, dt):
    """Ramp the velocity demand to 60FFh with 6083h both ways; bit 10 tells that the ramp has ended.

    The position demand follows as the integral of the velocity demand, so that 6062h and the following error window,
    which the manual lists in this mode, mean something here. A ramp of 0 (factory) does not move.
    """
    drive.loop_level[lane] = 1
    v = drive.velocity_demand[lane]
    rate = drive.acceleration[lane]
    v_new = profiles.ramp(v, drive.target_velocity[lane], rate, dt) if rate > 0.0 else v
    drive.position_demand[lane] += 0.5 * (v + v_new) * dt
    drive.velocity_demand[lane] = v_new
    drive.target_reached[lane] = 1 if v_new == drive.target_velocity[lane] else 0
