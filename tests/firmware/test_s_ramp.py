"""S-shaped ramps against a closed form of their own, in pp and pv, and what changes in flight.

The closed form has the parts of constant jerk that the bows give: acceleration rises, is held, falls; speed is held;
the same down. It knows nothing of the planner, which goes one period along a plan that it makes anew in each.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from rigs.closed_loop_rig import build
from rigs.stepper_rig import lane

from drive_env import motion

DT = 0.001
INC = 51200.0 / (2.0 * math.pi)  # increments per rad
NAMES = {"v": 0x6081, "a": 0x6083, "d": 0x6084, "j1": (0x60A4, 1), "j2": (0x60A4, 2), "j3": (0x60A4, 3),
         "j4": (0x60A4, 4), "factor": 0x2110}  # fmt: skip
# Increments, seconds.
RAMP = {"v": 50_000, "a": 200_000, "d": 150_000, "j1": 4_000_000, "j2": 2_000_000, "j3": 3_000_000, "j4": 1_000_000,
        "factor": 1}  # fmt: skip
RAMPS = {
    "four different bows": RAMP,
    "all bows the same": RAMP | {"d": 200_000, "j1": 2_000_000, "j3": 2_000_000, "j4": 2_000_000},
    "bows too soft for the acceleration": RAMP | {"j1": 400_000, "j2": 300_000, "j3": 350_000, "j4": 250_000},
    "bows times their factor": RAMP | {"j1": 400_000, "j2": 200_000, "j3": 300_000, "j4": 100_000, "factor": 10},
    "a bow of 0 jumps": RAMP | {"j2": 0, "j3": 0},
}
JUMP = 1e15


def change(speed, rate, begins, ends):
    """Return (duration, jerk) of the parts of a change of speed from rest or to it."""
    begins, ends = begins or JUMP, ends or JUMP
    peak = min(rate, math.sqrt(speed / (0.5 / begins + 0.5 / ends)))
    held = (speed - 0.5 * peak**2 * (1.0 / begins + 1.0 / ends)) / peak
    return [(peak / begins, begins), (max(held, 0.0), 0.0), (peak / ends, -ends)]


def way(parts, u=0.0):
    """Return the way of parts of constant jerk."""
    x, a = 0.0, 0.0
    for t, jerk in parts:
        x += u * t + a * t**2 / 2 + jerk * t**3 / 6
        u += a * t + jerk * t**2 / 2
        a += jerk * t
    return x


def move(ramp, distance):
    """Return the parts of a move; its highest speed is found by halving if it does not reach its own."""
    f = ramp["factor"]

    def parts(v):
        up = change(v, ramp["a"], f * ramp["j1"], f * ramp["j2"])
        down = [(t, -jerk) for t, jerk in change(v, ramp["d"], f * ramp["j3"], f * ramp["j4"])]
        return up, down, distance - way(up) - way(down, v)

    low, high = 0.0, float(ramp["v"])
    if parts(high)[2] >= 0.0:
        low = high
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if parts(middle)[2] >= 0.0 else (low, middle)
    up, down, rest = parts(low)
    return [*up, (rest / low, 0.0), *down]


def path(parts, times, x=0.0, u=0.0, a=0.0):
    """Return position, speed and acceleration at times, shape (3, times)."""
    found = np.zeros((3, len(times)))
    begin = 0.0
    for t, jerk in [*parts, (1e9, 0.0)]:
        into = times - begin
        chosen = into >= 0.0
        into = into[chosen]
        found[0, chosen] = x + u * into + a * into**2 / 2 + jerk * into**3 / 6
        found[1, chosen] = u + a * into + jerk * into**2 / 2
        found[2, chosen] = a + jerk * into
        x, u, a = x + u * t + a * t**2 / 2 + jerk * t**3 / 6, u + a * t + jerk * t**2 / 2, a + jerk * t
        begin += t
    return found


def set_ramp(drives, ramps):
    drives.write(0x6086, 1)
    for name, index in NAMES.items():
        drives.write(index, [ramp[name] for ramp in ramps])


def states(drives, cycles):
    """Return demands of position, speed and acceleration [inc, inc/s, inc/s^2] after each cycle, (3, cycles, axes)."""
    rows = []
    for _ in range(cycles):
        drives.advance(DT)
        rows.append([INC * lane(drives, f"{name}_demand") for name in ("position", "velocity", "acceleration")])
    return np.array(rows).swapaxes(0, 1)


@pytest.mark.every(2)
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("distance", [60_000, 4_000, 100])
def test_a_move_is_its_closed_form_every_millisecond(sign, distance):
    with build(recipe=None, num_machines=len(RAMPS)) as drives:
        set_ramp(drives, list(RAMPS.values()))
        motion.enable(drives, mode="pp")
        motion.start_move(drives, sign * distance)
        found = sign * states(drives, 2_600)
    times = DT * np.arange(1, found.shape[1] + 1)
    for k, (name, ramp) in enumerate(RAMPS.items()):
        parts = move(ramp, distance)
        assert sum(t for t, _ in parts) < times[-1]
        exact = path(parts, times)
        # To a ten-thousandth of an increment; what of the closed form's halving is left at its end.
        assert np.abs(found[0, :, k] - exact[0]).max() < 1e-3, name
        assert np.abs(found[1, :, k] - exact[1]).max() < 0.05, name
        assert found[0, -1, k] == pytest.approx(distance, abs=1e-6), name
        # An acceleration that jumps is seen either side of its jump, once for each.
        wrong = np.abs(found[2, :, k] - exact[2]) > 30.0
        assert np.count_nonzero(wrong) <= (4 if 0 in ramp.values() else 0), name


def test_without_bows_it_is_the_trapezoid():
    with build(recipe=None, num_machines=2) as drives:
        set_ramp(drives, [RAMP | {"j1": 0, "j2": 0, "j3": 0, "j4": 0}] * 2)
        drives.write(0x6086, [1, 0])
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 33_333)
        x, u, _ = states(drives, 1_500)
    np.testing.assert_allclose(x[:, 0], x[:, 1], atol=1e-3)
    np.testing.assert_allclose(u[:, 0], u[:, 1], atol=0.1)


CHANGES = {  # what changes 0.5 s after the start: target, and numbers of the ramp
    "nothing": (60_000, {}),
    "farther": (150_000, {}),
    "behind": (-20_000, {}),
    "nearer than braking takes": (9_000, {}),
    "slower": (60_000, {"v": 20_000}),
    "faster": (100_000, {"v": 90_000}),
    "softer": (100_000, {"a": 100_000, "j1": 1_000_000, "j2": 1_000_000, "j3": 500_000, "j4": 500_000}),
    "linear from now on": (60_000, {}),
}


@pytest.mark.every(3)
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("first_cycles", [180, 500])  # while it accelerates, and at speed
def test_what_changes_in_flight_breaks_no_bow_and_ends_at_its_target(sign, first_cycles):
    with build(recipe=None, num_machines=len(CHANGES)) as drives:
        set_ramp(drives, [RAMP] * len(CHANGES))
        motion.enable(drives, mode="pp")
        motion.start_move(drives, sign * 60_000)
        first = states(drives, first_cycles)
        ramps = [RAMP | changed for _, changed in CHANGES.values()]
        set_ramp(drives, ramps)
        drives.write(0x6086, [0 if name.startswith("linear") else 1 for name in CHANGES])
        targets = sign * np.array([target for target, _ in CHANGES.values()])
        motion.start_move(drives, targets)
        later = states(drives, 4_000)
    x, u, a = np.concatenate([first[:, -1:], later], axis=1)
    np.testing.assert_allclose(x[-1], targets, atol=1e-6)
    assert np.all(u[-1] == 0.0)
    for k, (name, ramp) in enumerate(zip(CHANGES, ramps, strict=True)):
        if name.startswith("linear"):
            continue
        most = max(ramp[f"j{n}"] for n in range(1, 5))
        assert np.abs(np.diff(a[:, k])).max() <= most * DT * (1.0 + 1e-9) + 1e-3, name
        beyond = np.abs(a[:, k]) > max(ramp["a"], ramp["d"]) * (1.0 + 1e-9)
        # An acceleration above a limit that was lowered falls without a break.
        assert not beyond[100:].any(), name
        # Speed and way are the integrals of what is asked for, so nothing jumps.
        assert np.abs(np.diff(u[:, k]) - 0.5 * DT * (a[1:, k] + a[:-1, k])).max() <= most * DT**2, name
        # What is left of an acceleration ends with its bow, wherever that leads.
        top = max(ramp["v"], abs(u[0, k]) + a[0, k] ** 2 / 2 / ramp["j2"])
        assert np.abs(u[:, k]).max() <= top * (1.0 + 1e-9), name
        last = int(np.flatnonzero(u[:, k])[-1])
        assert np.count_nonzero(u[:last, k] == 0.0) <= 2, name  # in motion until it is there


def test_pv_rises_and_falls_with_its_bows():
    """6083h and 6084h (manual, section 7.1.14), the four bows, and through rest to the other direction."""
    with build(recipe=None) as drives:
        set_ramp(drives, [RAMP])
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 40_000)
        up = states(drives, 700)[:, :, 0]
        assert drives.read(0x6041)[0] & 0x0400
        drives.write(0x60FF, -30_000)
        down = states(drives, 1_200)[:, :, 0]
        assert drives.read(0x6041)[0] & 0x0400
    times = DT * np.arange(1, 701)
    exact = path(change(40_000, RAMP["a"], RAMP["j1"], RAMP["j2"]), times)
    for row, limit in zip(range(3), (1e-3, 1e-2, 5.0), strict=True):
        assert np.abs(up[row] - exact[row]).max() < limit
    first = [(t, -jerk) for t, jerk in change(40_000, RAMP["d"], RAMP["j3"], RAMP["j4"])]
    second = [(t, -jerk) for t, jerk in change(30_000, RAMP["a"], RAMP["j1"], RAMP["j2"])]
    times = DT * np.arange(1, 1_201)
    exact = path([*first, *second], times, x=up[0, -1], u=40_000.0)
    for row, limit in zip(range(3), (1e-3, 1e-2, 5.0), strict=True):
        assert np.abs(down[row] - exact[row]).max() < limit


def test_pv_changes_its_mind_on_the_way_without_a_break():
    """A new target while the acceleration rises, is held or falls: each from where it is."""
    changes = list(itertools.product((20, 90, 180, 250), (60_000, 10_000, -20_000, 0)))
    with build(recipe=None, num_machines=len(changes)) as drives:
        set_ramp(drives, [RAMP] * len(changes))
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 45_000)
        target = np.full(len(changes), 45_000)
        rows = []
        for k in range(1_500):
            now = np.array([new if at == k else old for (at, new), old in zip(changes, target, strict=True)])
            if np.any(now != target):
                target = now
                drives.write(0x60FF, target)
            rows.append(states(drives, 1)[:, 0])
    u, a = np.array(rows)[:, 1], np.array(rows)[:, 2]
    np.testing.assert_array_equal(np.rint(u[-1]), [new for _, new in changes])
    assert np.all(a[-1] == 0.0)
    assert np.abs(np.diff(a, axis=0)).max() <= RAMP["j1"] * DT * (1.0 + 1e-9)
    assert a.max() <= RAMP["a"] * (1.0 + 1e-9)


def test_a_stop_leaves_no_acceleration_behind():
    """Halt and quick stop have the linear ramp; a move after it begins at rest."""
    with build(recipe=None) as drives:
        set_ramp(drives, [RAMP])
        drives.write(0x6085, 500_000)
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 60_000)
        states(drives, 150)
        drives.write(0x6040, 0x010F)
        states(drives, 300)
        x = INC * lane(drives, "position_demand")[0]
        drives.write(0x6040, 0x0F)
        motion.start_move(drives, round(x) + 20_000)
        found = states(drives, 1_500)[:, :, 0]
    exact = path(move(RAMP, round(x) + 20_000 - x), DT * np.arange(1, 1_501), x=x)
    assert np.abs(found[0] - exact[0]).max() < 1e-3
