"""The trapezoidal profile against a second planner that has no cases, and as pp plays it."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from drive_env import EmulatedDrives, motion
from drive_env.firmware.common import profiles
from mechanics.kernels.compiled import cached

DT = 1e-3


@cached()
def play_trapezoid(x, v, target, v_max, a_up, a_down, dt, steps):
    path = np.empty((steps + 1, 2))
    path[0, 0], path[0, 1] = x, v
    for k in range(steps):
        x, v = profiles.trapezoid(x, v, target, v_max, a_up, a_down, dt)
        path[k + 1, 0], path[k + 1, 1] = x, v
    return path


@cached()
def play_ramp(v, v_end, rate, dt, steps):
    path = np.empty(steps + 1)
    path[0] = v
    for k in range(steps):
        v = profiles.ramp(v, v_end, rate, dt)
        path[k + 1] = v
    return path


@cached()
def play_stop(x, v, rate, dt, steps):
    path = np.empty((steps + 1, 2))
    path[0, 0], path[0, 1] = x, v
    for k in range(steps):
        x, v = profiles.stop(x, v, rate, dt)
        path[k + 1, 0], path[k + 1, 1] = x, v
    return path


# --- the oracle -------------------------------------------------------------------------------------------------------
class Plan:
    """The time-optimal move to rest at the target, from a search for its signed cruising velocity.

    Whatever the start, the move is: change to velocity c, hold it, brake to rest. Where it ends grows with c, so c is
    a root, or plus or minus v_max with the rest of the way at that velocity.
    """

    def __init__(self, x, v, target, v_max, a_up, a_down):
        self.start = x, v
        way = target - x

        def segments(c, hold=0.0):
            stops = [v, 0.0, c] if v * c < 0.0 else [v, c]
            result = []
            for a, b in pairwise(stops):
                result.append(((b - a) / (a_up if abs(b) > abs(a) else a_down), a, b))
            return [(abs(t), a, b) for t, a, b in result] + [(hold, c, c), (abs(c) / a_down, c, 0.0)]

        def end(c):
            return sum(t * (a + b) / 2.0 for t, a, b in segments(c))

        if end(v_max) <= way:
            chosen, hold = v_max, (way - end(v_max)) / v_max
        elif end(-v_max) >= way:
            chosen, hold = -v_max, (end(-v_max) - way) / v_max
        else:
            chosen, hold = (
                brentq(lambda c: end(c) - way, -v_max, v_max, xtol=1e-15 * v_max, rtol=1e-15, maxiter=500),
                0.0,
            )
        self.segments = segments(chosen, hold)
        self.duration = sum(t for t, _, _ in self.segments)

    def at(self, time):
        """Return position and velocity `time` after the start."""
        x, v = self.start
        for t, a, b in self.segments:
            if t <= 0.0:
                continue
            share = min(time, t)
            slope = (b - a) / t
            x, v = x + a * share + 0.5 * slope * share * share, a + slope * share
            time -= share
            if time <= 0.0:
                break
        return x, v

    def path(self, steps):
        return np.array([self.at(k * DT) for k in range(steps + 1)])


def assert_same_path(path, plan, speed):
    # The target and the speed are the scales; 1 ms steps replan every time, so this also shows that nothing drifts.
    expected = plan.path(len(path) - 1)
    reach = max(1.0, np.abs(expected[:, 0]).max())
    np.testing.assert_allclose(path[:, 0], expected[:, 0], rtol=0.0, atol=1e-9 * reach)
    np.testing.assert_allclose(path[:, 1], expected[:, 1], rtol=0.0, atol=1e-9 * max(speed, 1.0))


# --- closed forms -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("a_up", "a_down"), [(1000.0, 1000.0), (1000.0, 400.0), (300.0, 2000.0)])
def test_trapezoid_is_the_textbook_one(sign, a_up, a_down):
    # 50 rad at up to 100 rad/s: accelerate v/a_up, cruise, decelerate v/a_down.
    v, way = 100.0, 50.0
    t_up, t_down = v / a_up, v / a_down
    t_cruise = (way - v * t_up / 2.0 - v * t_down / 2.0) / v
    assert t_cruise > 0.0
    total = t_up + t_cruise + t_down
    steps = math.ceil(total / DT) + 2
    path = play_trapezoid(2.0, 0.0, 2.0 + sign * way, v, a_up, a_down, DT, steps)
    for k, (x, speed) in enumerate(path):
        t = k * DT
        if t <= t_up:
            s, u = a_up * t * t / 2.0, a_up * t
        elif t <= t_up + t_cruise:
            s, u = v * t_up / 2.0 + v * (t - t_up), v
        elif t < total:
            s, u = way - a_down * (total - t) ** 2 / 2.0, a_down * (total - t)
        else:
            s, u = way, 0.0
        assert x == pytest.approx(2.0 + sign * s, rel=1e-9, abs=1e-9)
        assert speed == pytest.approx(sign * u, rel=1e-9, abs=1e-7)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("a_up", "a_down"), [(1000.0, 1000.0), (1000.0, 400.0), (300.0, 2000.0)])
def test_short_move_is_the_textbook_triangle(sign, a_up, a_down):
    # 4 rad: the peak sqrt(2 s a_up a_down / (a_up + a_down)) stays below v_max.
    way = 4.0
    peak = math.sqrt(2.0 * way * a_up * a_down / (a_up + a_down))
    assert peak < 100.0
    t_up, total = peak / a_up, peak / a_up + peak / a_down
    steps = math.ceil(total / DT) + 2
    path = play_trapezoid(0.0, 0.0, sign * way, 100.0, a_up, a_down, DT, steps)
    for k, (x, speed) in enumerate(path):
        t = k * DT
        if t <= t_up:
            s, u = a_up * t * t / 2.0, a_up * t
        elif t < total:
            s, u = way - a_down * (total - t) ** 2 / 2.0, a_down * (total - t)
        else:
            s, u = way, 0.0
        assert x == pytest.approx(sign * s, rel=1e-9, abs=1e-9)
        assert speed == pytest.approx(sign * u, rel=1e-9, abs=1e-7)
    assert tuple(path[-1]) == (sign * way, 0.0)


# --- changed in flight ------------------------------------------------------------------------------------------------
IN_FLIGHT = [  # what changes at 60 ms: target, v_max, a_up, a_down
    pytest.param(80.0, 100.0, 1000.0, 600.0, id="target farther"),
    pytest.param(9.0, 100.0, 1000.0, 600.0, id="target nearer"),
    pytest.param(4.0, 100.0, 1000.0, 600.0, id="target within the braking distance: overshoot and return"),
    pytest.param(-30.0, 100.0, 1000.0, 600.0, id="target behind"),
    pytest.param(50.0, 100.0, 1000.0, 3000.0, id="harder deceleration"),
    pytest.param(50.0, 100.0, 200.0, 600.0, id="softer acceleration"),
    pytest.param(50.0, 140.0, 1000.0, 600.0, id="velocity raised"),
    pytest.param(50.0, 25.0, 1000.0, 600.0, id="velocity below the present speed"),
    pytest.param(-30.0, 25.0, 1500.0, 300.0, id="everything at once"),
]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("target", "v_max", "a_up", "a_down"), IN_FLIGHT)
def test_a_change_in_flight_continues_from_where_the_axis_is(target, v_max, a_up, a_down, sign):
    first = Plan(0.0, 0.0, sign * 50.0, 100.0, 1000.0, 600.0)
    before = play_trapezoid(0.0, 0.0, sign * 50.0, 100.0, 1000.0, 600.0, DT, 60)
    assert_same_path(before, first, 100.0)
    x, v = before[-1]
    second = Plan(*first.at(0.060), sign * target, v_max, a_up, a_down)
    steps = math.ceil(second.duration / DT) + 1
    after = play_trapezoid(x, v, sign * target, v_max, a_up, a_down, DT, steps)
    assert_same_path(after, second, 140.0)
    assert tuple(after[-1]) == (sign * target, 0.0)


def test_a_velocity_below_the_present_speed_is_braked_to_not_jumped_to():
    path = play_trapezoid(0.0, 80.0, 100.0, 20.0, 1000.0, 500.0, DT, 130)
    np.testing.assert_allclose(path[:121, 1], 80.0 - 0.5 * np.arange(121), atol=1e-9)
    np.testing.assert_allclose(path[121:, 1], 20.0, atol=1e-9)


def test_nothing_to_do_is_nothing_done():
    path = play_trapezoid(1.25, 0.0, 1.25, 10.0, 100.0, 100.0, DT, 5)
    assert (path == [1.25, 0.0]).all()


# --- properties -------------------------------------------------------------------------------------------------------
SPEEDS = st.floats(0.5, 500.0)
RATES = st.floats(50.0, 50_000.0)


@settings(max_examples=120, deadline=None, derandomize=True)
@given(x=st.floats(-50, 50), way=st.floats(-50, 50), share=st.floats(-1, 1), v_max=SPEEDS, a_up=RATES, a_down=RATES)
def test_every_move_keeps_its_limits_and_ends_on_the_target(x, way, share, v_max, a_up, a_down):
    v, target = share * v_max, x + way
    plan = Plan(x, v, target, v_max, a_up, a_down)
    assume(plan.duration < 20.0)
    steps = math.ceil(plan.duration / DT) + 2
    path = play_trapezoid(x, v, target, v_max, a_up, a_down, DT, steps)
    position, velocity = path[:, 0], path[:, 1]
    assert np.abs(velocity).max() <= v_max * (1.0 + 1e-9)
    # Speeding up takes no more than a_up, slowing down no more than a_down, also in the period that changes over.
    slack = 1e-6 * v_max + 1e-9
    change = np.diff(velocity)
    assert np.all(np.abs(change) <= max(a_up, a_down) * DT + slack)
    speeding = np.diff(np.abs(velocity)) > slack
    same_way = velocity[1:] * velocity[:-1] >= 0.0
    assert np.all(np.diff(np.abs(velocity))[speeding & same_way] <= a_up * DT + slack)
    # The position is the integral of the velocity, up to a corner within the period.
    trapezoids = 0.5 * (velocity[1:] + velocity[:-1]) * DT
    assert np.all(np.abs(np.diff(position) - trapezoids) <= (a_up + a_down) * DT * DT / 4.0 + 1e-9)
    assert position[-1] == target
    assert velocity[-1] == 0.0


@settings(max_examples=120, deadline=None, derandomize=True)
@given(x=st.floats(-50, 50), way=st.floats(-50, 50), share=st.floats(-3, 3), v_max=SPEEDS, a_up=RATES, a_down=RATES)
def test_every_move_is_the_time_optimal_one(x, way, share, v_max, a_up, a_down):
    # A share beyond 1: the velocity was lowered below the present speed.
    v, target = share * v_max, x + way
    plan = Plan(x, v, target, v_max, a_up, a_down)
    assume(plan.duration < 5.0)
    steps = math.ceil(plan.duration / DT) + 1
    path = play_trapezoid(x, v, target, v_max, a_up, a_down, DT, steps)
    # Braking from rounding to rest may cost one period; nothing costs two, and nothing arrives early.
    arrived = int(np.flatnonzero((path[:, 0] == target) & (path[:, 1] == 0.0))[0])
    assert abs(arrived * DT - plan.duration) < 1.001 * DT
    expected = plan.path(steps)
    reach = max(1.0, np.abs(expected[:, 0]).max())
    assert np.abs(path[:, 0] - expected[:, 0]).max() <= 1e-8 * reach


# --- ramps ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("v", "v_end"), [(0.0, 10.0), (10.0, 0.0), (-4.0, 7.3), (7.3, -4.0), (5.0, 5.0)])
def test_ramp_has_one_slope_both_ways_and_ends_exactly(v, v_end):
    path = play_ramp(v, v_end, 1000.0, DT, 20)
    expected = v + np.sign(v_end - v) * np.minimum(np.arange(21) * 1.0, abs(v_end - v))
    np.testing.assert_allclose(path, expected, atol=1e-12)
    assert path[-1] == v_end


def test_ramp_without_a_rate_jumps():
    assert play_ramp(3.0, -8.0, 0.0, DT, 1)[1] == -8.0


@pytest.mark.parametrize("v", [20.0, -20.0, 0.35, 0.0])
def test_stop_is_the_braking_parabola(v):
    rate = 1000.0
    path = play_stop(1.0, v, rate, DT, 25)
    for k, (x, speed) in enumerate(path):
        t = min(k * DT, abs(v) / rate)
        assert x == pytest.approx(1.0 + v * t - math.copysign(rate * t * t / 2.0, v), abs=1e-12)
        assert speed == pytest.approx(v - math.copysign(rate * t, v), abs=1e-12)
    assert path[-1, 1] == 0.0


def test_stop_without_a_rate_is_at_once():
    assert tuple(play_stop(1.0, 20.0, 0.0, DT, 1)[1]) == (1.0, 0.0)


# --- as pp plays it ---------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(load="inertia", num_machines=2, ideal=True, num_threads=1) as made:
        made.write("Following error window", 0)
        yield made


@pytest.fixture
def moving(drives):
    """Two drives in pp: 6081h 1,000,000 pps, 6083h 20,000,000 and 6084h 8,000,000 pps^2; axis 1 in reverse."""
    drives.machine.reset()
    for name, value in ((0x6065, 0), (0x6081, 1_000_000), (0x6083, 20_000_000), (0x6084, 8_000_000)):
        drives.write(name, value)
    motion.enable(drives, mode="pp")
    return drives


def demand(drives, duration):
    return drives.record([0x6062], duration=duration)[0x6062]


def assert_demand_is(recorded, plans):
    """The recorded 6062h is the plan rounded to increments."""
    for axis, plan in enumerate(plans):
        expected = plan.path(len(recorded) - 1)[:, 0]
        np.testing.assert_allclose(recorded[:, axis], expected, rtol=0.0, atol=0.5 + 1e-3)


@pytest.mark.parametrize("target", [400_000, 40_000])  # a trapezoid, a triangle
def test_6062h_is_the_profile(moving, target):
    moving.write(0x607A, [target, -target])
    moving.write(0x6040, 0x1F)
    recorded = demand(moving, 0.62)
    plans = [Plan(0.0, 0.0, goal, 1e6, 2e7, 8e6) for goal in (target, -target)]
    assert_demand_is(recorded, plans)
    assert recorded[-1].tolist() == [target, -target]


@pytest.mark.parametrize(
    ("change", "plan"),
    [
        ({0x607A: 700_000}, (700_000.0, 1e6, 2e7, 8e6)),
        ({0x607A: -200_000}, (-200_000.0, 1e6, 2e7, 8e6)),
        ({0x6081: 300_000}, (400_000.0, 3e5, 2e7, 8e6)),
        ({0x6081: 1_200_000}, (400_000.0, 1.2e6, 2e7, 8e6)),
        ({0x6084: 4_000_000}, (400_000.0, 1e6, 2e7, 4e6)),
        ({0x6083: 5_000_000, 0x607A: 900_000, 0x6081: 1_200_000}, (900_000.0, 1.2e6, 5e6, 8e6)),
    ],
)
def test_6062h_changed_in_flight(moving, change, plan):
    moving.write(0x607A, 400_000)
    moving.write(0x6040, 0x1F)
    moving.advance(0.150)
    start = Plan(0.0, 0.0, 400_000.0, 1e6, 2e7, 8e6).at(0.150)
    for name, value in change.items():
        moving.write(name, value)
    moving.write(0x6040, 0x0F)
    moving.write(0x6040, 0x1F)  # a new set-point replans at once
    recorded = demand(moving, 1.5)
    assert_demand_is(recorded, [Plan(*start, *plan)] * 2)
    assert recorded[-1, 0] == plan[0]


def test_the_axis_itself_comes_to_rest_on_the_target(moving):
    moving.write(0x607A, [123_456, -654_321])
    moving.write(0x6040, 0x1F)
    moving.advance(1.6)
    assert moving.read(0x6062).tolist() == [123_456, -654_321]
    # An encoder step is 16 increments without interpolation; the ideal machine's is far finer.
    np.testing.assert_allclose(moving.read(0x6064), [123_456, -654_321], atol=16)
