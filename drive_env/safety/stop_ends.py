"""The position where a stop of an axis would end, and whether the axis should rather go on to its set-point.

A quick stop ends where its demand does. With v the speed, a the deceleration of 6085h and i the current:

    pp, csp, hm v^2 / 2a + v / k_v the demand is ahead by the lag of the position loop csv v^2 / 2a + sum of (asked - v)
    dt the ramp begins with the commanded speed pv, torque modes v^2 / 2a + i / (P I f) of an axis that speeds up

In the last two the integral of the velocity loop holds a current, which decays only after the axis has passed its
demand by as much (`Bounds.windup`, times the current limit at most).

An axis in pp or csp ends by itself, at a set-point that was checked. Its loops brake with the full current, a quick
stop with no more than 6085h: if a set-point of csp has jumped, or the profile is steeper than 6085h, the axis is so
fast that the quick stop itself would take it out of its travel.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from drive_env.cia402 import Key
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import Bounds
from drive_env.safety.limits_in_force import STOP_WITHIN
from drive_env.safety.objects import CSP, CSV, CURRENT, HM, IP, PP, TORQUE_MODES, is_one_of
from mechanics.arrays import Floats, Integers, Mask

LATENCY = 0.010  # s from a sample to the drive's ramp
DEMAND_AGE = 0.05  # s, the age up to which a demand is used
BEFORE = 0.006  # s, the interval over which acceleration is measured
SPEEDS_UP = 0.1  # of a quick stop's deceleration, above which an axis speeds up; the integral alone causes less
FORGETS = 0.2  # s after which a shortfall of speed is forgotten: the load that causes it persists
PROFILE_SHARE = 0.8  # of the profile's braking distance: the axis is a little faster or slower than its profile
SHORT = 0.75  # of the commanded current: less flows at the voltage limit, but the integral holds all of it


def is_led(axes: Axes) -> Mask:
    """Return which axes are commanded by a position in each cycle."""
    return np.asarray((axes.mode == CSP) | (axes.mode == IP))  # called in each look: np.isin takes ten times as long


def by_position(axes: Axes) -> Mask:
    """Return which axes are in a mode that ends at a checked position set-point."""
    return np.asarray((axes.mode == PP) | is_led(axes))


def lags(axes: Axes) -> Mask:
    """Return which axes follow a position demand, and lag behind it while they move."""
    return np.asarray(by_position(axes) | (axes.mode == HM))


def sees_demand(axes: Axes) -> Mask:
    """Return for which axes the position demand is known in their present mode."""
    now = axes.now()
    return np.asarray((now - axes.demand_seen <= DEMAND_AGE) & (axes.demand_seen >= axes.mode_written))


def ends_by_itself(axes: Axes, bounds: Bounds) -> Mask:
    """Return which axes are known to come to rest within their limits if left to their set-point."""
    aim = axes.demand.astype(float)
    for axis, target in axes.aim.items():
        aim[axis] = target if axes.mode[axis] == PP else aim[axis]
    leads = np.where(axes.mode == PP, axes.moves, sees_demand(axes))
    # A move to a target behind the axis turns back only after its profile has brought it to rest.
    turn = axes.position + profile_way(bounds, axes.newest_speed(), PROFILE_SHARE)
    turns_inside = (axes.mode != PP) | (outside(bounds, turn) <= bounds.settled)
    return np.asarray(by_position(axes) & leads & turns_inside & (outside(bounds, aim) <= bounds.settled))


def profile_way(bounds: Bounds, speed: Floats, share: float = 1.0) -> Floats:
    """Return how far a profile goes on from a speed [inc/s] to rest [inc], by a share of its ramp's way."""
    known = bounds.slowing > 0.0
    ramp = np.where(known, speed**2 / (2.0 * np.where(known, bounds.slowing, 1.0)), 0.0)
    return np.asarray(share * np.sign(speed) * ramp + speed * bounds.lag)


def ramp_way(bounds: Bounds, speed: Floats) -> Floats:
    """Return the signed way of a quick stop's ramp from a speed [inc/s] to rest [inc]."""
    fast = np.abs(speed)
    # If the ramp is unknown: the longest way that a stop may take.
    known = bounds.braking > 0.0
    way = np.where(known, fast**2 / (2.0 * np.where(known, bounds.braking, 1.0)), fast * STOP_WITHIN / 2.0)
    return np.asarray(np.sign(speed) * way)


def stop_way(axes: Axes, bounds: Bounds, speed: Floats) -> Floats:
    """Return how far a quick stop from a speed [inc/s] takes the axes [inc], without current held in the integral."""
    before = np.where(lags(axes), np.maximum(bounds.lag, LATENCY), LATENCY)
    return np.asarray(ramp_way(bounds, speed) + speed * before)


def outside(bounds: Bounds, position: Floats | Integers) -> Floats:
    """Return how far positions [inc] lie outside the limits [inc], 0 within them."""
    return np.asarray(np.maximum(np.maximum(bounds.low - position, position - bounds.high), 0.0), float)


class StopEnds:
    """Predicts where stops that begin now would end.

    Args:
        axes: The axes' present state.

    Attributes:
        speed: Present speeds [inc/s].
    """

    def __init__(self, axes: Axes) -> None:
        count = len(axes.everywhere)
        self.speed = np.zeros(count)
        self._axes = axes
        self._short = np.zeros(count)  # distance by which an axis in csv lags its commanded speed [inc]
        self._before = np.zeros(count)  # speed, BEFORE ago [inc/s]
        self._gain = np.zeros(count)  # increase of |speed| since then [inc/s^2]
        self._before_at = self._at = 0.0  # s
        self._current = np.zeros(count)

    def take(self, rows: Mapping[Key, Integers], bounds: Bounds) -> None:
        """Note samples, each object of shape (rows, num_axes)."""
        axes, now = self._axes, self._axes.now()
        self.speed = axes.newest_speed()
        if CURRENT in rows:
            self._current = rows[CURRENT][-1].astype(float)
        span, self._at = min(max(now - self._at, 0.0), BEFORE), now
        most = bounds.windup * np.where(bounds.current < NO_LIMIT, bounds.current, 0.0)
        gathered = self._short * (1.0 - span / FORGETS) + (axes.asked_speed - self.speed) * span
        self._short = np.where(axes.mode == CSV, np.clip(gathered, -most, most), 0.0)
        if now - self._before_at >= BEFORE:
            self._gain = (np.abs(self.speed) - np.abs(self._before)) / (now - self._before_at)
            self._before, self._before_at = self.speed, now

    def ways(self, bounds: Bounds) -> tuple[Floats, Floats]:
        """Return how far the axes go on, by their actual speed and by their commanded speed [inc]."""
        axes = self._axes
        own = stop_way(axes, bounds, self.speed) + self._held(bounds)
        asked = ramp_way(bounds, axes.asked_speed) + axes.asked_speed * LATENCY + self._short
        return own, np.where(axes.mode == CSV, asked, own)

    def _held(self, bounds: Bounds) -> Floats:
        """Return the extra way [inc] that comes from the current held in the velocity loop's integral."""
        axes, way = self._axes, np.sign(self.speed)
        torque = is_one_of(axes.mode, TORQUE_MODES)
        asked = np.where(torque, axes.asked_current, 0.0)
        speeds_up = self._gain > SPEEDS_UP * bounds.braking
        is_short = np.abs(self._current) < SHORT * np.abs(asked)
        current = np.where(torque, asked, self._current) * way
        holds = (speeds_up | is_short) & ~lags(axes) & (axes.mode != CSV) & (np.abs(self.speed) > bounds.rest)
        return np.asarray(way * bounds.windup * np.where(holds, np.maximum(current, 0.0), 0.0))
