"""Velocity mode of frequency inverters (CiA 402-2, IEC 61800-7-201: limit and ramp function, controlword).

The target 6042h is limited by 6046h, and each direction also by 6047h. A ramp follows it, given by a speed over a time:
6048h, 6049h and 604Ah or, if these have no speed, 604Eh over 604Fh, 6050h and 6051h. In the controlword

    bit 4 = 0  the ramp is not used: the axis comes to rest, by 6049h (the standard leaves the way to the maker)
    bit 5 = 0  the ramp's output is held
    bit 6 = 0  the ramp's input is 0

so that an axis enabled with none of them does not move, for any 6042h. A target of 0 means rest; for other targets the
least speed applies: the drive may turn at 6046h:01 instead.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common.modes import pv
from mechanics.kernels.compiled import stage

AT_ONCE = 1e9  # rad/s^2


@stage
def rate(speed, time):
    """Return the acceleration [rad/s^2] of a speed [rad/s] over a time [s]; 0 without a speed, AT_ONCE for 0 s."""
    if speed <= 0.0:
        return 0.0
    return speed / time if time > 0.0 else AT_ONCE


@stage
def speed_up_ramp(drive, lane):
    """Return the acceleration of the mode [rad/s^2]: 6048h, else 604Eh over 604Fh; 0 if neither is set."""
    up = rate(drive.vl_acceleration_speed[lane], drive.vl_acceleration_time[lane])
    return up if up > 0.0 else rate(drive.vl_reference[lane], drive.vl_ramp_time[lane])


@stage
def slow_down_ramp(drive, lane):
    """Return the deceleration of the mode [rad/s^2]: 6049h, 604Eh over 6050h, else as it speeds up; 0 without any."""
    down = rate(drive.vl_deceleration_speed[lane], drive.vl_deceleration_time[lane])
    if down <= 0.0:
        down = rate(drive.vl_reference[lane], drive.vl_slow_down_time[lane])
    return down if down > 0.0 else speed_up_ramp(drive, lane)


@stage
def quick_stop_ramp(drive, lane):
    """Return the deceleration of a quick stop in this mode [rad/s^2]: 604Ah, 604Eh over 6051h, else 6085h."""
    down = rate(drive.vl_quick_stop_speed[lane], drive.vl_quick_stop_time[lane])
    if down <= 0.0:
        down = rate(drive.vl_reference[lane], drive.vl_brake_time[lane])
    return down if down > 0.0 else drive.quick_stop_deceleration[lane]


@stage
def limited_target(drive, lane):
    """Return 6042h [rad/s] within 6046h and, in its direction, 6047h."""
    target = drive.vl_target[lane]
    if target == 0.0:
        return 0.0
    forwards = target > 0.0
    least = drive.vl_min_forwards[lane] if forwards else drive.vl_min_backwards[lane]
    most = drive.vl_max_forwards[lane] if forwards else drive.vl_max_backwards[lane]
    size = min(max(abs(target), drive.vl_min[lane], least), drive.vl_max[lane], most)
    return size if forwards else -size


@stage
def ramp_input(drive, lane):
    """Return the speed at which the ramp ends [rad/s], by bits 4 and 6 of the controlword."""
    bits = cia402.ENABLE_RAMP | cia402.REFERENCE_RAMP
    return limited_target(drive, lane) if drive.controlword[lane] & bits == bits else 0.0


@stage
def generate(drive, lane, dt):
    """Ramp the velocity demand to the limited target; bit 11 shows that it is limited, bit 10 that it is reached."""
    drive.loop_level[lane] = 1
    v = drive.velocity_demand[lane]
    word = drive.controlword[lane]
    if limited_target(drive, lane) != drive.vl_target[lane]:
        drive.internal_limit[lane] = 1
    v_new = v
    if word & cia402.ENABLE_RAMP == 0 or word & cia402.UNLOCK_RAMP:
        up = speed_up_ramp(drive, lane)
        down = slow_down_ramp(drive, lane)
        target = ramp_input(drive, lane)
        if up == 0.0:  # no faster than now
            target = min(max(target, min(v, 0.0)), max(v, 0.0))
        v_new = pv.approach(drive, lane, v, target, up, down if down > 0.0 else AT_ONCE, dt)
    drive.position_demand[lane] += 0.5 * (v + v_new) * dt
    drive.velocity_demand[lane] = v_new
    drive.target_reached[lane] = 1 if v_new == drive.vl_target[lane] else 0
