r"""The S-shaped ramp: accelerations rise and fall with four bows, one jerk for each.

    acceleration      ____                             jerk_1 begins an acceleration, jerk_2 ends it,
                     /    \                            jerk_3 begins a deceleration, jerk_4 ends it
    _______________1/      \2________3        4________________ time
                                      \      /
                                       \____/

As in the TMC4361 (data sheet, "S-shaped ramps"). A change of speed has up to four parts of constant jerk: a remaining
acceleration ends, the next one begins, is held, and ends. A move to a target is a change to the highest possible speed,
that speed, and a change to rest. Every period plans the rest of the move anew and advances by one period, so that a
changed target, speed, ramp or bow needs no special case. An axis that must reverse comes to rest first.
"""

from __future__ import annotations

from drive_env.firmware.common.arithmetic import TWO_PI
from mechanics.kernels.compiled import stage

MOST_PARTS = 6  # of a move within one period: braking, reversal and a new start
NEAR = 1e-9  # rad: at the target except for rounding
HALVINGS = 60
NO_BOW = 1e13  # rad/s^3: for a bow of 0 the acceleration jumps
MOST_JERK = 467.837e9  # microsteps/s^3 (TMCM-3313 manual, section 4.2.16)


@stage
def is_set(drive, lane):
    """Return whether a drive's ramp is S-shaped."""
    return drive.profile_type[lane] > 0.5


@stage
def bow(drive, lane, jerk):
    """Return the effective jerk [rad/s^3] of a bow: times 2015h, limited to that of the chip."""
    most = MOST_JERK * TWO_PI / drive.counts_per_turn[lane]
    return min(jerk * drive.jerk_factor[lane], most) if jerk > 0.0 else NO_BOW


@stage
def limits(drive, lane, up, down):
    """Return acceleration and deceleration [rad/s^2] and the four jerks [rad/s^3]."""
    return (
        up,
        down,
        bow(drive, lane, drive.jerk_1[lane]),
        bow(drive, lane, drive.jerk_2[lane]),
        bow(drive, lane, drive.jerk_3[lane]),
        bow(drive, lane, drive.jerk_4[lane]),
    )


@stage
def one_way(change, a, rate, begins, ends):
    """Return times and jerks of a change of speed (> 0) [rad/s] by an acceleration whose present value is a >= 0.

    Returns:
        Time and jerk of its first part, time for which it is held, time and jerk of its last part.
    """
    if a > rate:  # the limit was lowered: go down to it first
        return (a - rate) / ends, -ends, max((change - 0.5 * a * a / ends) / rate, 0.0), rate / ends, -ends
    peak = ((change + 0.5 * a * a / begins) / (0.5 / begins + 0.5 / ends)) ** 0.5
    peak = max(min(peak, rate), a)
    held = change - 0.5 * (peak * peak - a * a) / begins - 0.5 * peak * peak / ends
    return (peak - a) / begins, begins, max(held, 0.0) / peak if peak > 0.0 else 0.0, peak / ends, -ends


@stage
def settled(u, a, ramp):
    """Return the speed [rad/s] once the present acceleration [rad/s^2] has ended, and the time until then [s]."""
    t = a / ramp[3] if a > 0.0 else -a / ramp[5]
    return u + 0.5 * a * t, t


@stage
def change_of_speed(u, a, w, ramp):
    """Return the parts of the change from speed u [rad/s] and acceleration a [rad/s^2] to a steady speed w.

    Returns:
        (time, jerk) of four parts, one after the other; the third has no jerk.
    """
    reached, t = settled(u, a, ramp)
    jerk = -ramp[3] if a > 0.0 else ramp[5]
    if w > reached:
        begun = a if a > 0.0 else 0.0
        t0 = 0.0 if a > 0.0 else t
        t1, j1, t2, t3, j3 = one_way(w - (u if a > 0.0 else reached), begun, ramp[0], ramp[2], ramp[3])
        return t0, jerk, t1, j1, t2, 0.0, t3, j3
    if w < reached:
        begun = -a if a < 0.0 else 0.0
        t0 = 0.0 if a < 0.0 else t
        t1, j1, t2, t3, j3 = one_way((u if a < 0.0 else reached) - w, begun, ramp[1], ramp[4], ramp[5])
        return t0, jerk, t1, -j1, t2, 0.0, t3, -j3
    return t, jerk, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@stage
def along(u, a, parts, left):
    """Advance along the parts of a change for `left` [s] at most; return distance, speed, acceleration, time left."""
    way = 0.0
    for k in range(4):
        t, jerk = min(parts[2 * k], left), parts[2 * k + 1]
        way += (u + (0.5 * a + jerk * t / 6.0) * t) * t
        u += (a + 0.5 * jerk * t) * t
        a += jerk * t
        left -= t
    return way, u, a, left


@stage
def way_to(u, a, w, ramp):
    """Return the distance [rad] of a change of speed."""
    way, _, _, _ = along(u, a, change_of_speed(u, a, w, ramp), 1e300)
    return way


@stage
def peak_speed(u, a, distance, v_max, ramp):
    """Return the highest speed [rad/s] up to v_max from which the axis can still stop within a distance [rad]."""
    reached, _ = settled(u, a, ramp)
    low, high = 0.0, v_max
    if reached <= v_max and way_to(u, a, reached, ramp) + way_to(reached, 0.0, 0.0, ramp) > distance + NEAR:
        high = reached
    else:
        if way_to(u, a, v_max, ramp) + way_to(v_max, 0.0, 0.0, ramp) <= distance + NEAR:
            return v_max
        if reached <= v_max:
            low = max(reached, 0.0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if way_to(u, a, middle, ramp) + way_to(middle, 0.0, 0.0, ramp) <= distance:
            low = middle
        else:
            high = middle
    return low


@stage
def advance(drive, lane, target, v_max, up, down, dt):
    """Move the demands by dt [s] towards rest at the target [rad].

    Writes position_demand, velocity_demand and acceleration_demand.

    Args:
        drive: The record.
        lane: Lane of the axis.
        target: Where the move ends [rad].
        v_max: Largest speed, positive [rad/s]; an axis that is faster brakes to it first.
        up: Acceleration, positive [rad/s^2].
        down: Deceleration, positive [rad/s^2].
        dt: Period [s].
    """
    ramp = limits(drive, lane, up, down)
    x, v, a = drive.position_demand[lane], drive.velocity_demand[lane], drive.acceleration_before[lane]
    left = dt
    for _ in range(MOST_PARTS):
        if v == 0.0 and a == 0.0 and abs(target - x) <= 10.0 * NEAR:
            x = target
            break
        if left <= 0.0:
            break
        sign = 1.0 if target - x >= 0.0 else -1.0
        distance = abs(target - x)
        w, cruise = 0.0, 0.0
        if sign * v < 0.0 or (v == 0.0 and sign * a < 0.0):
            sign = -sign  # away from the target: to rest first
        elif way_to(sign * v, sign * a, 0.0, ramp) < distance - NEAR:
            w = peak_speed(sign * v, sign * a, distance, v_max, ramp)
            if w > 0.0:
                rest = distance - way_to(sign * v, sign * a, w, ramp) - way_to(w, 0.0, 0.0, ramp)
                cruise = max(rest, 0.0) / w
        way, u, b, left = along(sign * v, sign * a, change_of_speed(sign * v, sign * a, w, ramp), left)
        x, v, a = x + sign * way, sign * u, sign * b
        if left <= 0.0:
            break
        t = min(cruise, left)
        x, v, a = x + sign * w * t, sign * w, 0.0
        left -= t
        if left <= 0.0:
            break
        if w > 0.0:
            way, u, b, left = along(w, 0.0, change_of_speed(w, 0.0, 0.0, ramp), left)
            x, v, a = x + sign * way, sign * u, sign * b
            if left > 0.0:
                v, a = 0.0, 0.0
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v
    drive.acceleration_demand[lane] = a


@stage
def approach(drive, lane, target, up, down, dt):
    """Move the demands by dt [s] towards a steady velocity [rad/s]; through rest if its direction changes.

    Writes position_demand, velocity_demand and acceleration_demand.
    """
    ramp = limits(drive, lane, up, down)
    x, v, a = drive.position_demand[lane], drive.velocity_demand[lane], drive.acceleration_before[lane]
    left = dt
    for _ in range(3):
        if left <= 0.0:
            break
        heading = v if v != 0.0 else (a if a != 0.0 else target)
        sign = 1.0 if heading >= 0.0 else -1.0
        w = max(sign * target, 0.0)
        way, u, b, left = along(sign * v, sign * a, change_of_speed(sign * v, sign * a, w, ramp), left)
        x, v, a = x + sign * way, sign * u, sign * b
        if left > 0.0:
            v, a = sign * w, 0.0
            if v == target:
                x += v * left
                left = 0.0
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v
    drive.acceleration_demand[lane] = a
