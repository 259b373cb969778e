r"""The six-point ramp: a trapezoid that begins and ends with a jump, and has other ramps at low speed.

    v_max         ________
                 /        \             acceleration above velocity_1, deceleration above it
    velocity_1  /          \
               |            |           acceleration_1 below it, deceleration_1 below it
    start      |            | end       jumped from, or left by stop_deceleration
    ____________________________ time   ramp_wait passes before the next motion

As the motion controllers of Trinamic have it (TMC5130 data sheet, "ramp generator"): velocity_1 = 0 leaves one ramp for
each way, start_velocity and end_velocity are jumped to and from, and after a stop the axis waits. Where there is a
stop_deceleration (TMCM-3313 manual, section 4.2.15) the end velocity is where that ramp takes over. It is exact within
a period: the times at which one ramp goes over into the next are found, not sampled.
"""

from __future__ import annotations

from mechanics.kernels.compiled import stage

MOST_PARTS = 12  # of a ramp, within one period: reversed on the way, braked, waited for, and begun anew
NEAR = 1e-9  # rad: at the target but for rounding


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
    """Return the ramp below velocity_1, where 0 stands for the one above it."""
    return ramp if ramp > 0.0 else above


@stage
def last_speed(drive, lane):
    """Return the speed [rad/s] that a ramp jumps from to rest: the end velocity, unless a ramp of its own ends it."""
    return 0.0 if drive.stop_deceleration[lane] > 0.0 else drive.end_velocity[lane]


@stage
def braking_constants(drive, lane, u, down):
    """Return D and c of the way u^2 / (2 D) + c that braking takes from a speed u [rad/s] on its part of the ramp."""
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
    """Return the way [rad] from a speed u [rad/s], 0 or more, down to rest or to what is jumped from."""
    if u <= last_speed(drive, lane):
        return 0.0
    D, c = braking_constants(drive, lane, u, down)
    return 0.5 * u * u / D + c


@stage
def slow_down(drive, lane, u, floor, down, left):
    """Return speed, way and time of one part of a braking: to the part's end or a floor in it, in `left` [s] at most.

    Args:
        drive: The record.
        lane: Of the axis.
        u: Speed [rad/s], above the floor.
        floor: Where it ends [rad/s].
        down: Deceleration above velocity_1 [rad/s^2].
        left: Time that there is [s].
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
    """Return speed, way and time of one part of the way to the target: speeding up or even, in `left` [s] at most.

    Args:
        drive: The record.
        lane: Of the axis.
        u: Speed [rad/s], v_max at most.
        distance: To the target [rad], more than braking takes.
        v_max: Largest speed [rad/s].
        up: Acceleration above velocity_1 [rad/s^2].
        down: Deceleration above it [rad/s^2].
        left: Time that there is [s].
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
        lane: Of the axis.
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
            # A way on which it could not be braked from begins at rest.
            start = min(drive.start_velocity[lane], v_max)
            u = start if braking_way(drive, lane, start, down) <= distance else 0.0
        floor = last_speed(drive, lane)
        brakes = u < 0.0 or distance <= braking_way(drive, lane, u, down) + NEAR
        if brakes and abs(u) <= floor + NEAR:
            # The last speed is jumped from; away from the target the axis turns round.
            x, v = (target if distance <= 10.0 * NEAR else x), 0.0
            drive.ramp_wait_left[lane] = drive.ramp_wait[lane]
            continue
        if left <= 0.0:
            break
        if u < 0.0:
            speed, way, t = slow_down(drive, lane, -u, floor, down, left)
            x, v = x - sign * way, -sign * speed
            if v == 0.0:  # before it turns round, too (TMC5130 data sheet, TZEROWAIT)
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
