r"""Shaped ramps: velocity goes from one value to another along a curve, the motion profile types of servo amplifiers.

A ramp from v to w takes T = k |w - v| / a, where a is the profile acceleration or deceleration and k the greatest slope
of the curve S, so that a is the greatest acceleration of the ramp for any shape:

    v(t) = v + (w - v) S(t / T)         type (6086h)  acceleration     deceleration
                                        -3            sine             sine
    sine   (1 - cos pi y) / 2           -2            early            late
    sin^2  y - sin(2 pi y) / (2 pi)     -1            early            early
    early  sin(pi y / 2)                 1            sin^2            sin^2
    late   1 - cos(pi y / 2)

The TGZ manual only names the types; the curves are our choice. Sine and sin^2 are the shapes of the acceleration.
"Fast" is full acceleration at once, decreasing towards the constant speed; its mirror image, the fast deceleration,
ends with the full one at the target. The slow deceleration begins with it and decreases towards the target. A
deceleration is a ramp to rest: early has its full deceleration at the beginning, late at the end.

A move is planned once and followed in time, so that it equals the closed form and ends exactly at the target. A change
during the move (target, speed, rates, type, or a demand moved by something else) begins a new plan at the present
position and speed; the acceleration may jump then, within its limits. An axis that must reverse, or cannot stop before
the target, comes to rest first.
"""

from __future__ import annotations

import math

from mechanics.kernels.compiled import stage

SINE, SINE_SQUARE, EARLY, LATE = 0, 1, 2, 3
MOST_PARTS = 4  # of a move within one period: stop, reversal and a new start
NEAR = 1e-12  # of a distance: rounding

# Parts of the record's plan.
ACTIVE, TIME, START, FROM, SPEED, UP_TIME, CRUISE_TIME, DOWN_TIME, END = range(9)
TARGET, MOST_SPEED, UP, DOWN, SHAPE = range(9, 14)


@stage
def is_set(drive, lane):
    """Return whether a drive's ramp is shaped."""
    return drive.profile_shape[lane] != 0.0


@stage
def curve_of(shape, speeds_up):
    """Return the curve of a ramp of that motion profile type."""
    if shape == -3.0:
        return SINE
    if shape == 1.0:
        return SINE_SQUARE
    return EARLY if speeds_up or shape == -1.0 else LATE


@stage
def slope(curve):
    """Return the greatest slope of a curve."""
    return 2.0 if curve == SINE_SQUARE else 0.5 * math.pi


@stage
def area(curve):
    """Return the integral of a curve from 0 to 1."""
    if curve == EARLY:
        return 2.0 / math.pi
    return 1.0 - 2.0 / math.pi if curve == LATE else 0.5


@stage
def along(curve, y):
    """Return a curve's slope, value and integral at y, 0 to 1."""
    if curve == SINE:
        s, c = math.sin(math.pi * y), math.cos(math.pi * y)
        return 0.5 * math.pi * s, 0.5 * (1.0 - c), 0.5 * y - 0.5 / math.pi * s
    if curve == SINE_SQUARE:
        s, c = math.sin(2.0 * math.pi * y), math.cos(2.0 * math.pi * y)
        return 1.0 - c, y - 0.5 / math.pi * s, 0.5 * y * y - (1.0 - c) / (4.0 * math.pi * math.pi)
    s, c = math.sin(0.5 * math.pi * y), math.cos(0.5 * math.pi * y)
    if curve == EARLY:
        return 0.5 * math.pi * c, s, 2.0 / math.pi * (1.0 - c)
    return 0.5 * math.pi * s, 1.0 - c, y - 2.0 / math.pi * s


@stage
def _keep(drive, lane, x, v, w, times, end):
    """Store a move from position and speed over a constant speed w to rest; `times` are those of its three parts."""
    plan = drive.plan
    plan[ACTIVE, lane], plan[TIME, lane] = 1.0, 0.0
    plan[START, lane], plan[FROM, lane], plan[SPEED, lane], plan[END, lane] = x, v, w, end
    plan[UP_TIME, lane], plan[CRUISE_TIME, lane], plan[DOWN_TIME, lane] = times


@stage
def _plan(drive, lane, target, v_max, up, down):
    """Plan the move from the present demand to rest at the target [rad], or only to rest if it must stop first."""
    x, v, shape = drive.position_demand[lane], drive.velocity_demand[lane], drive.profile_shape[lane]
    rises, falls = curve_of(shape, True), curve_of(shape, False)
    sign = 1.0 if target > x or (target == x and v > 0.0) else -1.0
    distance, u = sign * (target - x), sign * v
    alpha, m = slope(rises) / up, area(rises)
    per_speed = slope(falls) / down
    beta = per_speed * (1.0 - area(falls))  # rad per (rad/s)^2 of stopping distance
    w, up_time, way = u, 0.0, 0.0
    if u > v_max:
        w, up_time = v_max, per_speed * (u - v_max)
        way = up_time * (u - (u - v_max) * area(falls))
    elif u >= 0.0:
        a, b, c = alpha * m + beta, alpha * u * (1.0 - 2.0 * m), alpha * u * u * (1.0 - m) + distance
        w = (math.sqrt(b * b + 4.0 * a * c) - b) / (2.0 * a)
        w = min(max(w, u), v_max)
        up_time = alpha * (w - u)
        way = up_time * (u + m * (w - u))
    rest = distance - way - beta * w * w
    if u < 0.0 or rest < -NEAR * (1.0 + abs(x) + distance + beta * w * w):
        _keep(drive, lane, x, v, v, (0.0, 0.0, per_speed * abs(v)), x + beta * v * abs(v))
    else:
        cruise = max(rest, 0.0) / w if w > 0.0 else 0.0
        _keep(drive, lane, x, v, sign * w, (up_time, cruise, per_speed * w), target)
    plan = drive.plan
    plan[TARGET, lane], plan[MOST_SPEED, lane], plan[UP, lane], plan[DOWN, lane] = target, v_max, up, down
    plan[SHAPE, lane] = shape


@stage
def _at(drive, lane):
    """Return position, speed and acceleration of the plan at its time."""
    plan = drive.plan
    t, shape, w, v = plan[TIME, lane], plan[SHAPE, lane], plan[SPEED, lane], plan[FROM, lane]
    up, cruise, down = plan[UP_TIME, lane], plan[CRUISE_TIME, lane], plan[DOWN_TIME, lane]
    if t < up:
        rate, value, integral = along(curve_of(shape, abs(w) > abs(v)), t / up)
        change = w - v
        return plan[START, lane] + v * t + change * up * integral, v + change * value, change * rate / up
    left = up + cruise + down - t
    if left <= 0.0:
        return plan[END, lane], 0.0, 0.0
    # Backwards from the end: the target is reached exactly, despite rounding of the sums.
    falls = curve_of(shape, False)
    stop = w * down * (1.0 - area(falls))
    if left >= down:
        return plan[END, lane] - stop - w * (left - down), w, 0.0
    y = 1.0 - left / down
    rate, value, integral = along(falls, y)
    return plan[END, lane] - stop + w * down * (y - integral), w * (1.0 - value), -w * rate / down


@stage
def _holds(drive, lane, target, v_max, up, down):
    """Return whether the plan still fits this target, these limits, and the present demand."""
    plan = drive.plan
    if plan[ACTIVE, lane] == 0.0 or plan[SHAPE, lane] != drive.profile_shape[lane]:
        return False
    if plan[TARGET, lane] != target or plan[DOWN, lane] != down:
        return False
    x, v, _ = _at(drive, lane)
    # Once it comes to rest, a speed limit above its present speed, or another acceleration, changes nothing.
    comes_to_rest = plan[TIME, lane] >= plan[UP_TIME, lane] + plan[CRUISE_TIME, lane] and abs(v) <= v_max
    if not comes_to_rest and (plan[MOST_SPEED, lane] != v_max or plan[UP, lane] != up):
        return False
    return x == drive.position_demand[lane] and v == drive.velocity_demand[lane]


@stage
def advance(drive, lane, target, v_max, up, down, dt):
    """Move the demands by dt [s] along the move to rest at the target [rad].

    Writes position_demand, velocity_demand and acceleration_demand.

    Args:
        drive: The record.
        lane: Lane of the axis.
        target: Where the move ends [rad].
        v_max: Largest speed, positive [rad/s]; an axis that is faster brakes to it first.
        up: Greatest acceleration, positive [rad/s^2].
        down: Greatest deceleration, positive [rad/s^2].
        dt: Period [s].
    """
    left = dt
    for _ in range(MOST_PARTS):
        if drive.velocity_demand[lane] == 0.0 and drive.position_demand[lane] == target:
            drive.plan[ACTIVE, lane] = 0.0
            break
        if not _holds(drive, lane, target, v_max, up, down):
            _plan(drive, lane, target, v_max, up, down)
        plan = drive.plan
        ends = plan[UP_TIME, lane] + plan[CRUISE_TIME, lane] + plan[DOWN_TIME, lane]
        passed = ends - plan[TIME, lane]
        done = passed <= left
        plan[TIME, lane] = ends if done else plan[TIME, lane] + left
        x, v, a = _at(drive, lane)
        drive.position_demand[lane], drive.velocity_demand[lane] = x, v
        drive.acceleration_demand[lane] = a
        if not done:
            break
        left -= max(passed, 0.0)
        plan[ACTIVE, lane] = 0.0
