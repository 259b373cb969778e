"""Shaped ramps (6086h of the TGZ) against closed forms of their own, and what changes in flight.

The oracle writes each ramp's acceleration down as a function of time, integrates it numerically, and puts ramps and
even speed together; it knows nothing of the curves' integrals that the planner has.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env.firmware.common import fields, shaped
from drive_env.firmware.record import RecordLayout
from mechanics.kernels.compiled import cached

DT = 0.001
LAYOUT = RecordLayout(fields.PARAMETERS, fields.STATE)
SPEED, UP, DOWN = 100.0, 1000.0, 600.0  # rad/s, rad/s^2
# Acceleration over the ramp's time, as a share of its greatest: of speeding up, and of coming to rest.
SINE = (lambda y: np.sin(np.pi * y),) * 2
SINE_SQUARE = (lambda y: np.sin(np.pi * y) ** 2,) * 2
FAST_FAST = (lambda y: np.cos(0.5 * np.pi * y), lambda y: np.sin(0.5 * np.pi * y))
FAST_SLOW = (lambda y: np.cos(0.5 * np.pi * y),) * 2
TYPES = {-3: SINE, -2: FAST_FAST, -1: FAST_SLOW, 1: SINE_SQUARE}


@cached()
def run(drive, target, speed, up, down, dt, rows):
    """Advance axis 0 period by period: rows (periods, 3) of position, velocity and acceleration demand."""
    for k in range(rows.shape[0]):
        shaped.advance(drive, 0, target, speed, up, down, dt)
        rows[k, 0] = drive.position_demand[0]
        rows[k, 1] = drive.velocity_demand[0]
        rows[k, 2] = drive.acceleration_demand[0]


def new_axis(shape, x=0.0, v=0.0):
    records = LAYOUT.new_records(1)
    records["profile_shape"], records["position_demand"], records["velocity_demand"] = shape, x, v
    return records[0]


def go(axis, target, periods, speed=SPEED, up=UP, down=DOWN):
    rows = np.zeros((periods, 3))
    run(axis, target, speed, up, down, DT, rows)
    return rows


def ramp(form, change, rate):
    """Return times, speeds gained and ways of a ramp that changes the speed by `change` with `rate` at most."""
    y = np.linspace(0.0, 1.0, 8_001)
    a = form(y)
    gained = np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(y))])
    T = change / (rate * gained[-1])
    v = gained / gained[-1] * change
    x = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(y))]) * T
    return y * T, v, x, a * rate


def move(shape, distance, speed=SPEED):
    """Return functions of time: position, speed, acceleration of a move from rest to rest, and its duration."""
    rises, falls = TYPES[shape]

    def ways(w):
        return ramp(rises, w, UP)[2][-1] + w * ramp(falls, w, DOWN)[0][-1] - ramp(falls, w, DOWN)[2][-1]

    low, high = 0.0, speed
    if ways(speed) <= distance:
        low = speed
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ways(middle) <= distance else (low, middle)
    t_up, v_up, x_up, a_up = ramp(rises, low, UP)
    t_down, v_down, x_down, a_down = ramp(falls, low, DOWN)
    even = (distance - ways(low)) / low
    begins = t_up[-1] + even
    t = np.concatenate([t_up, begins + t_down])
    x = np.concatenate([x_up, x_up[-1] + low * even + low * t_down - x_down])
    v = np.concatenate([v_up, low - v_down])
    a = np.concatenate([a_up, -a_down])

    def at(rows, times):
        inside = np.interp(times, t, rows)
        return np.where((times > t_up[-1]) & (times < begins), 0.0, inside) if rows is a else inside

    return (lambda s: at(x, s)), (lambda s: at(v, s)), (lambda s: at(a, s)), t[-1]


@pytest.mark.every(2)
@pytest.mark.parametrize("shape", TYPES)
@pytest.mark.parametrize("distance", [60.0, 8.0], ids=["long", "short"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_move_is_the_closed_form(shape, distance, sign):
    x, v, a, ends = move(shape, distance)
    periods = int(ends / DT) + 5
    rows = sign * go(new_axis(shape), sign * distance, periods)
    times = DT * np.arange(1, periods + 1)
    assert np.abs(rows[:, 0] - x(times)).max() < 1e-5 * distance
    assert np.abs(rows[:, 1] - v(times)).max() < 1e-4 * SPEED
    moves = times < ends - DT
    jumps = np.abs(np.diff(a(times), prepend=0.0)) > 0.1 * DOWN  # a period with a jump of the acceleration in it
    jumps |= np.roll(jumps, -1)
    assert np.abs(rows[:, 2] - a(times))[moves & ~jumps].max() < 2e-3 * UP
    assert rows[-1, 0] == distance
    assert rows[-1, 1] == 0.0


@pytest.mark.parametrize("shape", TYPES)
def test_peaks_are_the_limits(shape):
    rows = go(new_axis(shape), 80.0, 2000)
    assert rows[:, 1].max() == pytest.approx(SPEED, rel=1e-12)
    assert 0.99 * UP < rows[:, 2].max() <= UP * (1 + 1e-12)
    assert 0.99 * DOWN < -rows[:, 2].min() <= DOWN * (1 + 1e-12)


@pytest.mark.parametrize(("shape", "factor"), [(-3, math.pi / 2), (-2, math.pi / 2), (-1, math.pi / 2), (1, 2.0)])
def test_a_ramp_takes_its_factor_times_that_of_a_trapezoid(shape, factor):
    rows = go(new_axis(shape), 80.0, 2000)
    reached = np.flatnonzero(rows[:, 1] >= SPEED)[0] + 1
    assert reached * DT == pytest.approx(factor * SPEED / UP, abs=1.01 * DT)


@pytest.mark.parametrize("shape", TYPES)
@pytest.mark.parametrize(
    ("at", "change"),
    [
        (60, {"target": 70.0}),  # farther, while it speeds up
        (60, {"target": 1.0}),  # back
        (250, {"target": 12.0}),  # too near to stop before it
        (60, {"speed": 40.0}),
        (250, {"speed": 40.0}),
        (60, {"up": 400.0}),
        (250, {"down": 2000.0}),
        (250, {"down": 300.0}),  # too soft to stop before the target
    ],
)
def test_what_changes_in_flight_leaves_neither_jump_nor_limit_and_ends_at_the_target(shape, at, change):
    axis = new_axis(shape)
    first = go(axis, 40.0, at)
    after = {"target": 40.0, "speed": SPEED, "up": UP, "down": DOWN} | change
    rows = np.concatenate([first, go(axis, after["target"], 3000, after["speed"], after["up"], after["down"])])
    most = max(UP, DOWN, after["up"], after["down"])
    assert np.abs(np.diff(rows[:, 1], prepend=0.0)).max() <= most * DT * (1 + 1e-9)
    mean = 0.5 * (rows[1:, 1] + rows[:-1, 1])
    assert np.abs(np.diff(rows[:, 0]) / DT - mean).max() < 0.5 * most * DT
    assert np.abs(rows[:, 1]).max() <= SPEED * (1 + 1e-9)
    assert tuple(rows[-1, :2]) == (after["target"], 0.0)


@pytest.mark.parametrize("shape", TYPES)
def test_a_speed_that_is_above_the_new_one_changes_nothing_of_a_deceleration_that_is_under_way(shape):
    axis = new_axis(shape)
    go(axis, 40.0, 1)
    undisturbed = go(new_axis(shape), 40.0, 2000)
    slows = int(np.flatnonzero((undisturbed[:, 1] < 60.0) & (undisturbed[:, 0] > 25.0))[0])
    axis = new_axis(shape)
    first = go(axis, 40.0, slows)
    rest = go(axis, 40.0, 2000 - slows, speed=80.0, up=50.0)
    assert np.concatenate([first, rest]) == pytest.approx(undisturbed, abs=1e-9)


@pytest.mark.parametrize("shape", TYPES)
def test_an_axis_that_is_too_fast_or_goes_the_wrong_way_comes_to_the_target(shape):
    for v in (130.0, -50.0):
        rows = go(new_axis(shape, v=v), 60.0, 4000)
        assert np.abs(np.diff(rows[:, 1], prepend=v)).max() <= UP * DT * (1 + 1e-9)
        assert tuple(rows[-1, :2]) == (60.0, 0.0)


def test_a_demand_that_something_else_moved_is_planned_from_where_it_is():
    axis = new_axis(-3)
    go(axis, 40.0, 200)
    axis["position_demand"][0] -= 5.0  # as homing does
    rows = go(axis, 40.0, 3000)
    assert tuple(rows[-1, :2]) == (40.0, 0.0)
