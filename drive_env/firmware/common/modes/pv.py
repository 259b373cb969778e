"""Profile velocity mode (TMCM-1636 manual, section 7)."""

from __future__ import annotations

from drive_env.firmware.common import profiles, s_ramp
from mechanics.kernels.compiled import stage


@stage
def slow_down_ramp(drive, lane):
    """Return the deceleration of the mode [rad/s^2]: 6083h, or 6084h on drives whose manual says so."""
    if drive.pv_slows_down_by_6084h[lane] == 1 and drive.deceleration[lane] > 0.0:
        return drive.deceleration[lane]
    return drive.acceleration[lane]


@stage
def begun(drive, lane, v, target):
    """Return the velocity [rad/s] that a ramp from v to a target begins with: the start velocity, if v is below it."""
    start = min(drive.start_velocity[lane], abs(target)) if drive.pv_starts_and_stops[lane] == 1 else 0.0
    if abs(v) >= start or v * target < 0.0:
        return v
    return start if target > 0.0 else -start


@stage
def approach(drive, lane, v, target, up, down, dt):
    """Return the velocity [rad/s] after dt [s] of a ramp from v to a target; away from 0 with `up`, to it with `down`.

    On drives that start and stop in this mode, a speed below the start velocity jumps to it, and a stop jumps to 0 from
    the end velocity.
    """
    jumps = drive.pv_starts_and_stops[lane] == 1
    reverses = v * target < 0.0
    left = dt
    if reverses or abs(target) < abs(v):
        floor = 0.0 if reverses else target
        slow = drive.end_velocity[lane] if jumps and floor == 0.0 else 0.0
        edge = max(slow, abs(floor))
        if abs(v) > edge:
            taken = (abs(v) - edge) / down
            if taken > left:
                return v - down * left if v > 0.0 else v + down * left
            left -= taken
        v = floor
        if not reverses:
            return v
    return profiles.ramp(begun(drive, lane, v, target), target, up, left)


@stage
def generate(drive, lane, dt):
    """Ramp the velocity demand to 60FFh; bit 10 shows that the ramp has ended.

    A target beyond 607Fh, if the device has that, is not reached: bit 11 shows it, and bit 10 stays 0.

    The position demand follows as the integral of the velocity demand, so that 6062h and the following error window,
    which the manual lists in this mode, are meaningful. A ramp of 0 (factory) does not move. An S-shaped ramp slows
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
    v_new = approach(drive, lane, v, target, rate, slow_down_ramp(drive, lane), dt) if rate > 0.0 else v
    drive.position_demand[lane] += 0.5 * ((begun(drive, lane, v, target) if rate > 0.0 else v) + v_new) * dt
    drive.velocity_demand[lane] = v_new
    drive.target_reached[lane] = 1 if v_new == drive.target_velocity[lane] else 0
