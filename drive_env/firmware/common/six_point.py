r"""The six-point ramp: a trapezoid that begins and ends with a jump, and has other ramps at low speed.

    v_max         ________
                 /        \             acceleration above velocity_1, deceleration above it
    velocity_1  /          \
               |            |           acceleration_1 below it, deceleration_1 below it
    start      |            | end       jumped from, or left by stop_deceleration
    ____________________________ time   ramp_wait passes before the next motion

As in Trinamic's motion controllers (TMC5130 data sheet, "ramp generator"): with velocity_1 = 0 there is one ramp per
direction, the speed jumps to start_velocity and from end_velocity, and after a stop the axis waits. With a
stop_deceleration (TMCM-3313 manual, section 4.2.15) that ramp takes over at the end velocity. The ramp is exact within
a period: the times at which one part ends are computed, not sampled.
"""

from __future__ import annotations

from mechanics.kernels.compiled import stage

MOST_PARTS = 12  # of a ramp within one period: reversal, braking, waiting, and a new start
NEAR = 1e-9  # rad: at the target except for rounding


@stage
def is_set(drive, lane):
    """Return whether a drive's ramp is more than a trapezoid."""
    return (
        drive.velocity_1[lane] > 0.0
        or drive.start_velocity[lane] > 0.0
        or drive.end_velocity[lane] > 0.0
        or drive.ramp_wait[lane] > 0.0
    )


@stage
def slow_ramp(ramp, above):
    """Return the ramp below velocity_1; 0 means the one above it."""
    return ramp if ramp > 0.0 else above


@stage
def last_speed(drive, lane):
    """Return the speed [rad/s] that a ramp jumps from to rest: the end velocity, unless a separate ramp ends it."""
    return 0.0 if drive.stop_deceleration[lane] > 0.0 else drive.end_velocity[lane]


@stage
def braking_constants(drive, lane, u, down):
    """Return D and c of the braking distance u^2 / (2 D) + c from a speed u [rad/s] on its part of the ramp."""
    low, end, stop = drive.velocity_1[lane], drive.end_velocity[lane], drive.stop_deceleration[lane]
    if stop > 0.0 and u < end:
        return stop, 0.0
    ended = 0.5 * end * end / stop if stop > 0.0 else 0.0
    slow_down = slow_ramp(drive.deceleration_1[lane], down)
    if u < low:
        return slow_down, ended - 0.5 * end * end / slow_down
    if low <= end:
        return down, ended - 0.5 * end * end / down
    return down, ended + 0.5 * (low * low - end * end) / slow_down - 0.5 * low * low / down


@stage
def braking_way(drive, lane, u, down):
    """Return the distance [rad] from a speed u [rad/s], 0 or more, to rest or to the speed that jumps to rest."""
    if u <= last_speed(drive, lane):
        return 0.0
    D, c = braking_constants(drive, lane, u, down)
    return 0.5 * u * u / D + c


@stage
def slow_down(drive, lane, u, floor, down, left):
    """Return speed, distance and time of one part of a braking: to the part's end or a floor, in `left` [s] at most.

    Args:
        drive: The record.
        lane: Lane of the axis.
        u: Speed [rad/s], above the floor.
        floor: Speed at which it ends [rad/s].
        down: Deceleration above velocity_1 [rad/s^2].
        left: Available time [s].
    """
    low, stop_from = drive.velocity_1[lane], drive.end_velocity[lane]
    if drive.stop_deceleration[lane] > 0.0 and u <= stop_from:
        rate, end = drive.stop_deceleration[lane], floor
    else:
        rate = down if u > low else slow_ramp(drive.deceleration_1[lane], down)
        end = max(low, floor) if u > low else floor
        end = max(end, stop_from) if drive.stop_deceleration[lane] > 0.0 else end
    t = (u - end) / rate
    if t >= left:
        return u - rate * left, (u - 0.5 * rate * left) * left, left
    return end, 0.5 * (u + end) * t, t


@stage
def go_on(drive, lane, u, distance, v_max, up, down, left):
    """Return speed, distance and time of one part of the move: speeding up or constant, in `left` [s] at most.

    Args:
        drive: The record.
        lane: Lane of the axis.
        u: Speed [rad/s], v_max at most.
        distance: Distance to the target [rad], more than the braking distance.
        v_max: Largest speed [rad/s].
        up: Acceleration above velocity_1 [rad/s^2].
        down: Deceleration above it [rad/s^2].
        left: Available time [s].
    """
    if u >= v_max:
        t = min((distance - braking_way(drive, lane, u, down)) / u, left)
        return u, u * t, t
    low, end = drive.velocity_1[lane], drive.end_velocity[lane]
    rate = slow_ramp(drive.acceleration_1[lane], up) if u < low else up
    top = min(v_max, low) if u < low else v_max
    if u < end:
        top = min(top, end)
    if u < last_speed(drive, lane):  # from which nothing is braked
        peak = (u * u + 2.0 * rate * distance) ** 0.5
    else:
        D, c = braking_constants(drive, lane, u, down)
        peak = (max(distance - c + 0.5 * u * u / rate, 0.0) / (0.5 / rate + 0.5 / D)) ** 0.5
    top = max(min(top, peak), u)
    t = (top - u) / rate
    if t >= left:
        return u + rate * left, (u + 0.5 * rate * left) * left, left
    return top, 0.5 * (u + top) * t, t


@stage
def advance(drive, lane, target, v_max, up, down, dt):
    """Move the demands by dt [s] along the ramp to rest at the target [rad]: writes position and velocity demand.

    Args:
        drive: The record.
        lane: Lane of the axis.
        target: Where the move ends [rad].
        v_max: Largest speed, positive [rad/s]; an axis that is faster brakes to it first.
        up: Acceleration above velocity_1, positive [rad/s^2].
        down: Deceleration above it, positive [rad/s^2].
        dt: Period [s].
    """
    x, v = drive.position_demand[lane], drive.velocity_demand[lane]
    left = dt
    for _ in range(MOST_PARTS):
        if v == 0.0:
            waited = min(drive.ramp_wait_left[lane], left)
            drive.ramp_wait_left[lane] -= waited
            left -= waited
            if left <= 0.0 or x == target:
                break
        sign = 1.0 if target - x > 0.0 else -1.0
        distance, u = sign * (target - x), sign * v
        if u == 0.0:
            if distance <= 10.0 * NEAR:
                x = target
                continue
            # A distance too short for braking from that speed begins at rest.
            start = min(drive.start_velocity[lane], v_max)
            u = start if braking_way(drive, lane, start, down) <= distance else 0.0
        floor = last_speed(drive, lane)
        brakes = u < 0.0 or distance <= braking_way(drive, lane, u, down) + NEAR
        if brakes and abs(u) <= floor + NEAR:
            # The speed jumps from the last speed to rest; away from the target the axis reverses.
            x, v = (target if distance <= 10.0 * NEAR else x), 0.0
            drive.ramp_wait_left[lane] = drive.ramp_wait[lane]
            continue
        if left <= 0.0:
            break
        if u < 0.0:
            speed, way, t = slow_down(drive, lane, -u, floor, down, left)
            x, v = x - sign * way, -sign * speed
            if v == 0.0:  # also before it reverses (TMC5130 data sheet, TZEROWAIT)
                drive.ramp_wait_left[lane] = drive.ramp_wait[lane]
        elif brakes:
            speed, way, t = slow_down(drive, lane, u, floor, down, left)
            x, v = x + sign * way, sign * speed
        elif u > v_max:
            speed, way, t = slow_down(drive, lane, u, v_max, down, left)
            x, v = x + sign * way, sign * speed
        else:
            speed, way, t = go_on(drive, lane, u, distance, v_max, up, down, left)
            x, v = x + sign * way, sign * speed
        left -= t
    drive.position_demand[lane] = x
    drive.velocity_demand[lane] = v
