"""Cyclic synchronous velocity mode (TMCM-1636 manual, section 10)."""

from __future__ import annotations

from drive_env.firmware.common.modes import cyclic
from mechanics.kernels.compiled import stage


@stage
def generate(drive, lane, dt):
    """Move the velocity demand to 60FFh + 60B1h within the interpolation period; the position demand follows."""
    drive.loop_level[lane] = 1
    before = drive.velocity_demand[lane]
    target = drive.target_velocity[lane] + drive.velocity_offset[lane]
    demand = cyclic.interpolate(drive, lane, before, target, dt)
    drive.position_demand[lane] += 0.5 * (before + demand) * dt
    drive.velocity_demand[lane] = demand
    drive.target_reached[lane] = 0
