"""Trapezoidal profile: the time-optimal way from (x, v) to rest at the target, one period at a time, in closed form.

Every period plans the rest of the move anew from its present state and advances by one period. On an undisturbed move
that reproduces the analytic trapezoid or triangle exactly, and a changed target, velocity or ramp needs no special
case.
"""

from __future__ import annotations

import math

from mechanics.kernels.compiled import stage


@stage
def ramp(v, v_end, rate, dt):
    """Return the velocity [rad/s] after dt [s] of a ramp towards v_end; a rate of 0 jumps."""
    if rate <= 0.0:
        return v_end
    step = rate * dt
    if abs(v_end - v) <= step:
        return v_end
    return v + step if v_end > v else v - step


@stage
def limited(v, limit):
    """Return a velocity [rad/s] limited in absolute value; a limit of 0 means no limit."""
    return v if limit <= 0.0 else min(max(v, -limit), limit)


@stage
def unwrapped(target, position, scaler):
    """Return an absolute target [rad] in the turn of the 32-bit counter in which the position [rad] is.

    Positions on the bus wrap at 2^31 increments (`scaler` per revolution); a target that the master gives refers to
    what it reads.
    """
    turn = 4294967296.0 * 6.283185307179586 / scaler
    if abs(position) < 0.5 * turn:
        return target
    return target + turn * math.floor((position - target) / turn + 0.5)


@stage
def nearest(target, position, scaler):
    """Return the nearest of all positions [rad] that differ from a target by turns of the 32-bit counter."""
    turn = 4294967296.0 * 6.283185307179586 / scaler
    return target + turn * math.floor((position - target) / turn + 0.5)


@stage
def stop(x, v, rate, dt):
    """Return position and velocity after dt [s] of braking to standstill with `rate` [rad/s^2]; 0 stops at once."""
    if v == 0.0 or rate <= 0.0:
        return x, 0.0
    t = abs(v) / rate
    if t <= dt:
        return x + 0.5 * v * t, 0.0
    a = -rate if v > 0.0 else rate
    return x + (v + 0.5 * a * dt) * dt, v + a * dt


@stage
def trapezoid(x, v, target, v_max, a_up, a_down, dt):
    """Return position [rad] and velocity [rad/s] after dt [s] on the way to rest at the target.

    Args:
        x: Position now [rad].
        v: Velocity now [rad/s], of any sign and size.
        target: Where the move ends [rad].
        v_max: Largest speed, positive [rad/s]; an axis that is faster brakes to it first.
        a_up: Acceleration, positive [rad/s^2].
        a_down: Deceleration, positive [rad/s^2].
        dt: Period [s].
    """
    if v == 0.0 and x == target:
        return x, 0.0
    # The direction follows from the side on which the target is once the axis has stopped.
    beyond = target - x - 0.5 * v * abs(v) / a_down
    sign = 1.0 if beyond > 0.0 or (beyond == 0.0 and v > 0.0) else -1.0
    distance = sign * (target - x)
    u = sign * v
    left = dt
    moved = 0.0
    if u < 0.0:
        t = -u / a_down
        if t >= left:
            return x + sign * (u + 0.5 * a_down * left) * left, sign * (u + a_down * left)
        moved += 0.5 * u * t
        left -= t
        u = 0.0
    if u > v_max:
        # Brake to v_max, or all the way if the target needs it.
        t = (u - v_max) / a_down
        if t >= left:
            return x + sign * (moved + (u - 0.5 * a_down * left) * left), sign * (u - a_down * left)
        moved += 0.5 * (u + v_max) * t
        left -= t
        u = v_max
    rest = max(distance - moved, 0.5 * u * u / a_down)
    peak = ((2.0 * a_up * rest + u * u) * a_down / (a_up + a_down)) ** 0.5
    peak = max(min(peak, v_max), u)
    t_up = (peak - u) / a_up
    t_down = peak / a_down
    cruise = rest - 0.5 * (u + peak) * t_up - 0.5 * peak * t_down
    t_cruise = max(cruise, 0.0) / peak if peak > 0.0 else 0.0
    if left >= t_up + t_cruise + t_down:
        return target, 0.0
    if left < t_up:
        return x + sign * (moved + (u + 0.5 * a_up * left) * left), sign * (u + a_up * left)
    moved += 0.5 * (u + peak) * t_up
    left -= t_up
    if left < t_cruise:
        return x + sign * (moved + peak * left), sign * peak
    moved += peak * t_cruise
    left -= t_cruise
    return x + sign * (moved + (peak - 0.5 * a_down * left) * left), sign * (peak - a_down * left)
