"""The six-point ramp against its closed form, phase by phase, and what changes in flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import SMOOTH, build, lane

from drive_env import motion
from drive_env.firmware.record import set_lanes

DT = 0.001
INC = 51200.0 / (2.0 * math.pi)  # increments per rad
NAMES = {"start": 0x2010, "a1": 0x2011, "v1": 0x2012, "d1": 0x2013, "wait": 0x2015, "v": 0x6081, "end": 0x6082,
         "a": 0x6083, "d": 0x6084}  # fmt: skip
# Increments, seconds; the wait in milliseconds.
RAMP = {"start": 1_000, "a1": 20_000, "v1": 10_000, "d1": 30_000, "v": 50_000, "end": 2_000, "a": 100_000, "d": 80_000,
        "wait": 0}  # fmt: skip
RAMPS = {
    "all six points": RAMP,
    "one ramp with jumps": RAMP | {"v1": 0},
    "no jumps": RAMP | {"start": 0, "end": 0},
    "slow ramps alone": RAMP | {"v": 8_000},
    "end above velocity 1": RAMP | {"end": 15_000},
    "slow ramps left 0": RAMP | {"a1": 0, "d1": 0},
    "a ramp to rest": RAMP | {"stop": 5_000},
    "a ramp to rest from above velocity 1": RAMP | {"end": 15_000, "stop": 40_000},
    "a ramp to rest alone": RAMP | {"end": 60_000, "stop": 30_000},
    "no ramp to rest without an end velocity": RAMP | {"end": 0, "stop": 5_000},
}


def braking(ramp):
    """Return the parts of a braking from the largest speed as (from, to, rate), fastest first."""
    v, low, end, stop = ramp["v"], ramp["v1"], ramp["end"], ramp.get("stop", 0)
    last = [(min(v, end), 0, stop)] if stop and end else []
    if v <= end:
        return last
    if low == 0 or end >= low:
        return [(v, end, ramp["d"]), *last]
    parts = [(v, low, ramp["d"])] if v > low else []
    return [*parts, (min(v, low), end, ramp["d1"] or ramp["d"]), *last]


def parts(ramp, distance):
    """Return the closed form of a move that reaches its speed: (duration, speed at its start, acceleration) of each."""
    v, low, start = ramp["v"], ramp["v1"], ramp["start"]
    up = [(start, v, ramp["a"])]
    if low > start:
        up = [(start, min(low, v), ramp["a1"] or ramp["a"]), (low, v, ramp["a"])]
    rows = [((high - begin) / rate, begin, rate) for begin, high, rate in up if high > begin]
    down = [((begin - last) / rate, begin, -rate) for begin, last, rate in braking(ramp)]
    way = sum(t * (u + 0.5 * a * t) for t, u, a in rows + down)
    assert way < distance
    return [*rows, ((distance - way) / v, v, 0.0), *down]


def path(rows, t):
    """Return position and speed at times of a closed form."""
    x, u, begin = np.zeros_like(t), np.zeros_like(t), 0.0
    at = 0.0
    for duration, speed, rate in rows:
        into = np.clip(t - begin, 0.0, duration)
        x += np.where(t > begin, speed * into + 0.5 * rate * into**2, 0.0)
        u = np.where((t > begin) & (t <= begin + duration), speed + rate * into, u)
        begin += duration
        at += speed * duration + 0.5 * rate * duration**2
    return np.where(t >= begin, at, x), np.where(t >= begin, 0.0, u)


def set_ramp(drives, ramps):
    for name, index in NAMES.items():
        drives.write(index, [ramp[name] for ramp in ramps])
    # 2014h, which the bare drive has not.
    stops = np.array([ramp.get("stop", 0) / INC for ramp in ramps])
    set_lanes(drives.inside.records, "stop_deceleration", stops)


def states(drives, cycles):
    """Return demands of positions and speeds [inc, inc/s] after each cycle, shape (cycles, axes)."""
    rows = []
    for _ in range(cycles):
        drives.advance(DT)
        rows.append([INC * lane(drives, name) for name in ("position_demand", "velocity_demand")])
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


@pytest.mark.every(2)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_move_is_its_closed_form_every_millisecond(sign):
    distance = 60_000
    with build(num_machines=len(RAMPS), parameters=SMOOTH) as drives:
        set_ramp(drives, list(RAMPS.values()))
        motion.enable(drives, mode="pp")
        motion.start_move(drives, sign * distance)
        x, u = states(drives, 9_000)
    t = DT * np.arange(1, len(x) + 1)
    for k, (name, ramp) in enumerate(RAMPS.items()):
        exact, speed = path(parts(ramp, distance), t)
        assert np.max(np.abs(sign * x[:, k] - exact)) < 1e-4, name
        assert x[-1, k] == pytest.approx(sign * distance, abs=1e-6), name
        # At the millisecond in which a speed is jumped from, either side of it.
        wrong = np.abs(sign * u[:, k] - speed) > 1e-3
        assert np.count_nonzero(wrong) <= 1, name


def test_a_move_too_short_for_its_speed_turns_in_the_middle():
    """Peak speed of a way s with one ramp each way: v^2 (1/2a + 1/2d) = s + start^2/2a + end^2/2d."""
    ramp = RAMP | {"v1": 0}
    way = 5_000
    peak = math.sqrt(
        (way + ramp["start"] ** 2 / 2 / ramp["a"] + ramp["end"] ** 2 / 2 / ramp["d"])
        / (0.5 / ramp["a"] + 0.5 / ramp["d"])
    )
    with build(parameters=SMOOTH) as drives:
        set_ramp(drives, [ramp])
        motion.enable(drives, mode="pp")
        motion.start_move(drives, way)
        x, u = states(drives, 800)
    assert peak - ramp["a"] * DT <= u.max() <= peak + 1e-6
    exact, _ = path([((peak - 1000) / ramp["a"], 1000, ramp["a"]), ((peak - 2000) / ramp["d"], peak, -ramp["d"])],
                    DT * np.arange(1, 801))  # fmt: skip
    assert np.max(np.abs(x[:, 0] - exact)) < 1e-4


@pytest.mark.parametrize("stop", [0, 5_000])
def test_a_short_move_begins_at_rest_where_the_start_velocity_could_not_be_braked(stop):
    """From 4000 inc/s braking takes 100 increments and more: no overshoot, whichever ramp ends a move of 60."""
    ramp = RAMP | {"v1": 0, "start": 4_000, "end": 2_000 if stop else 0, "stop": stop}
    with build(parameters=SMOOTH) as drives:
        set_ramp(drives, [ramp])
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 60)
        x, u = states(drives, 400)
    assert x.max() <= 60 + 1e-4 and x[-1, 0] == pytest.approx(60, abs=1e-6)
    rate = stop or ramp["d"]
    peak = math.sqrt(60 / (0.5 / ramp["a"] + 0.5 / rate))
    assert peak - ramp["a"] * DT <= u.max() <= peak + 1e-6


@pytest.mark.parametrize("stop", [0, 5_000])
def test_a_move_that_starts_faster_than_it_ends_comes_to_its_target(stop):
    ramp = RAMP | {"start": 3_000, "end": 2_000 if stop else 0, "stop": stop}
    with build(parameters=SMOOTH) as drives:
        set_ramp(drives, [ramp])
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 20_000)
        x, u = states(drives, 3_000)
    assert x.max() <= 20_000 + 1e-6 and x[-1, 0] == pytest.approx(20_000, abs=1e-6)
    assert (u >= 0).all() and u[-1, 0] == 0.0


def test_after_a_stop_the_axis_waits():
    with build(num_machines=2, parameters=SMOOTH) as drives:
        set_ramp(drives, [RAMP | {"wait": 100}, RAMP])
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 3_000)
        drives.write(0x6040, 0x0F)
        drives.advance(0.02)
        motion.start_move(drives, 0)
        _, u = states(drives, 150)
    begins = [int(np.argmax(u[:, k] != 0.0)) for k in range(2)]
    assert begins[1] == 0
    assert 75 <= begins[0] <= 85  # since the later of the two had come to rest before the 20 ms


def test_before_it_turns_round_the_axis_waits_too():
    """With nothing to jump from, it comes to rest on the way: 100 ms there, and on as without."""
    with build(num_machines=2, parameters=SMOOTH) as drives:
        set_ramp(drives, [RAMP | {"wait": 100, "end": 0, "start": 0}, RAMP | {"end": 0, "start": 0}])
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 30_000)
        drives.advance(0.2)
        motion.start_move(drives, -30_000)
        _, u = states(drives, 1500)
    first = [int(np.argmax(u[:, k] < 0.0)) for k in range(2)]
    assert first[0] - first[1] == pytest.approx(100, abs=1)
    np.testing.assert_allclose(u[first[0] : first[0] + 100, 0], u[first[1] : first[1] + 100, 1], rtol=0.01, atol=0.02)


CHANGES = {  # what changes at 0.4 s: target, and numbers of the ramp
    "farther": (150_000, {}),
    "behind": (-20_000, {}),
    "nearer than braking takes": (3_000, {}),
    "slower": (60_000, {"v": 5_000}),
    "faster": (60_000, {"v": 90_000}),
    "other ramps": (60_000, {"a1": 60_000, "d1": 10_000, "v1": 20_000}),
}


@pytest.mark.every(2)
@pytest.mark.parametrize("sign", [1, -1])
def test_what_changes_in_flight_breaks_no_ramp_and_ends_at_its_target(sign):
    """No speed changes faster than its ramp, jumps of start and end apart; no time passes at rest on the way."""
    with build(num_machines=len(CHANGES), parameters=SMOOTH) as drives:
        set_ramp(drives, [RAMP] * len(CHANGES))
        motion.enable(drives, mode="pp")
        motion.start_move(drives, sign * 60_000)
        _, first = states(drives, 400)
        ramps = [RAMP | change for _, change in CHANGES.values()]
        set_ramp(drives, ramps)
        targets = sign * np.array([target for target, _ in CHANGES.values()])
        motion.start_move(drives, targets)
        x, u = states(drives, 12_000)
    np.testing.assert_allclose(x[-1], targets, atol=1e-6)
    assert np.all(u[-1] == 0.0)
    speeds = np.concatenate([first[-1:], u])
    for k, ramp in enumerate(ramps):
        change = np.abs(np.diff(speeds[:, k]))
        most = max(ramp["a"], ramp["d"]) * DT
        beyond = change > most * (1.0 + 1e-9) + 1e-6
        # What is more than a ramp gives is a jump from or to rest.
        assert np.all(np.minimum(np.abs(speeds[1:, k]), np.abs(speeds[:-1, k]))[beyond] <= ramp["end"] + most)
        slow = np.maximum(np.abs(speeds[1:, k]), np.abs(speeds[:-1, k])) < min(ramp["v1"], 10_000)
        moving = np.minimum(np.abs(speeds[1:, k]), np.abs(speeds[:-1, k])) > 0.0
        same = np.sign(speeds[1:, k]) == np.sign(speeds[:-1, k])
        least = max(ramp["a1"], ramp["d1"]) * DT
        assert np.all(change[slow & moving & same] <= least * (1.0 + 1e-9) + 1e-6)
        assert np.abs(u[:, k]).max() <= max(ramp["v"], np.abs(first[-1, k])) + 1e-6
        # In motion until it is there.
        last = int(np.flatnonzero(u[:, k])[-1])
        assert np.count_nonzero(u[:last, k] == 0.0) <= 2


def test_without_its_numbers_the_ramp_is_the_trapezoid():
    flat = RAMP | {"start": 0, "end": 0, "v1": 0}
    with build(num_machines=2, parameters=SMOOTH) as drives:
        set_ramp(drives, [flat, flat | {"wait": 1}])  # a wait alone makes it a six-point ramp
        motion.enable(drives, mode="pp")
        motion.start_move(drives, [33_333, 33_333])
        x, u = states(drives, 2_000)
    np.testing.assert_allclose(x[:, 0], x[:, 1], atol=1e-4)
    np.testing.assert_allclose(u[:, 0], u[:, 1], atol=1e-3)
