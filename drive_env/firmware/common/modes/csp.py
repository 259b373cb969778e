"""Cyclic synchronous position mode (TMCM-1636 manual, section 9)."""

from __future__ import annotations

from drive_env.firmware.common import profiles
from drive_env.firmware.common.limits import ROUNDING, corrected_maximum, corrected_minimum
from drive_env.firmware.common.modes import cyclic
from mechanics.kernels.compiled import stage


@stage
def generate(drive, lane, dt):
    """Move the position demand to 607Ah + 60B0h within the interpolation period; 607Dh limits it, and sets bit 11."""
    drive.loop_level[lane] = 2
    target = drive.target_position[lane] + drive.position_offset[lane]
    if drive.target_is_whole[lane] == 0 and drive.cyclic_wraps[lane] == 1:
        target = profiles.nearest(target, drive.position_demand[lane], drive.position_scaler[lane])
    elif drive.target_is_whole[lane] == 0:
        target = profiles.unwrapped(target, drive.position_demand[lane], drive.position_scaler[lane])
    low, high = corrected_minimum(drive, lane), corrected_maximum(drive, lane)
    drive.internal_limit[lane] = 1 if target > high + ROUNDING or target < low - ROUNDING else 0
    target = min(max(target, low), high)
    before = drive.position_demand[lane]
    demand = cyclic.interpolate(drive, lane, before, target, dt)
    drive.position_demand[lane] = demand
    drive.velocity_demand[lane] = (demand - before) / dt
    drive.target_reached[lane] = 0
