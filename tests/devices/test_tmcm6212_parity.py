"""The TMCM-6212 with its six axes: on the emulator and over CAN in lockstep the same script gives the same integers."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.world_bus import assert_equal, on_bus

from drive_env import EmulatedDrives, ObjectAccessError, motion

AXES = 6
TURN = 51200  # microsteps
WATCHED = [0x6041, 0x6061, 0x6062, 0x6064, 0x606C]
EACH = np.arange(1, AXES + 1)  # axes go different ways


def machine(load):
    return EmulatedDrives("tmcm6212", load, num_machines=1 if load == "robot" else AXES, num_threads=1)


def watch(drives, seconds, play=None):
    trace = drives.record(WATCHED, seconds, play=play)
    return np.stack([trace[name] for name in WATCHED])


def pp(drives):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 1200 * EACH)
    motion.start_move(drives, 300 * EACH)
    yield watch(drives, 0.15)
    motion.start_move(drives, -100 * EACH, relative=True)
    yield watch(drives, 0.5)
    motion.disable(drives)
    yield watch(drives, 0.02)


def six_point(drives):
    """Start and end velocity, and a slower ramp below 2012h."""
    for name, raw in ((0x2010, 500), (0x6082, 600), (0x2012, 4000), (0x2011, 20_000), (0x2013, 15_000), (0x2015, 200)):
        drives.write(name, raw)
    motion.enable(drives, mode="pp")
    drives.write(0x6081, 9000)
    motion.start_move(drives, 1000 * EACH)
    yield watch(drives, 0.9)


def pv(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 1500 * EACH)
    yield watch(drives, 0.1)
    drives.write("Target velocity", -700 * EACH)
    yield watch(drives, 0.2)
    motion.quick_stop(drives)
    yield watch(drives, 0.1)


def csp(drives):
    motion.enable(drives, mode="csp")
    way = 150 * (1 - np.cos(np.linspace(0, 2 * np.pi, 200)))[:, None] * EACH
    yield watch(drives, 0.2, {0x607A: np.rint(way).astype(int)})
    yield watch(drives, 0.03)


def csv(drives):
    motion.enable(drives, mode="csv")
    speed = 1500 * np.sin(np.linspace(0, 6, 200))[:, None] * EACH
    yield watch(drives, 0.2, {0x60FF: np.rint(speed).astype(int)})
    for target in range(0, 1000, 100):
        drives.write(0x60FF, target)
        yield watch(drives, 0.002)


def homing(drives):
    drives.write(0x6098, 21)
    drives.write((0x6099, 1), TURN * 2)
    drives.write((0x6099, 2), TURN // 8)
    drives.write(0x609A, 20 * TURN)
    drives.write(0x607C, 100 * EACH)
    motion.enable(drives, mode="hm")
    drives.write(0x6040, 0x1F)
    yield watch(drives, 0.6)
    motion.wait_for(drives, (0x1400, 0x1400), 5.0, "homing attained")
    yield drives.read(0x6064)


def fault(drives):
    """Axis 2 is asked for more than it has: its emergency and no other."""
    drives.write(0x606A, 0)
    drives.write(0x6065, np.where(EACH == 3, 1, 4000))
    motion.enable(drives, mode="csv")
    speed = np.linspace(0, 20_000, 60)[:, None] * np.ones(AXES)
    yield watch(drives, 0.06, {0x60FF: np.rint(speed).astype(int)})
    yield [tuple(message) for message in drives.emergencies()]
    motion.reset_fault(drives, where=EACH == 3)
    drives.advance(0.002)
    yield [tuple(message) for message in drives.emergencies()]
    yield drives.read(0x6041)


def switch(drives, open_it):
    """The shutdown switch of the module: each axis is told, whether one frame did so or six machines."""
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 1500 * EACH)
    drives.advance(0.05)
    open_it()
    drives.advance(0.1)
    return [(one.axis, one.code, one.extra) for one in drives.emergencies()]


def test_the_shutdown_switch_is_told_of_each_axis():
    with machine("inertia") as drives:
        expected = switch(drives, lambda: setattr(drives.machine, "enable_input", False))
    assert expected == [(axis, 0x5441, (0, 255, 0, 0, 0)) for axis in range(AXES)]
    inside = machine("inertia")
    with on_bus(inside) as drives:
        assert switch(drives, lambda: setattr(inside.machine, "enable_input", False)) == expected


LOADS = {pp: "robot", six_point: "inertia", pv: "robot", csp: "robot", csv: "robot", homing: "belt", fault: "inertia"}
SCRIPTS = {script.__name__: script for script in LOADS}


@pytest.mark.every(8)
@pytest.mark.parametrize(
    ("name", "safety"),
    [
        pytest.param(name, True, marks=pytest.mark.slow if name in ("homing", "six_point", "csv") else ())
        for name in SCRIPTS
    ]
    + [("csp", False), ("fault", False)],
)
def test_the_same_script_gives_the_same_integers(name, safety):
    script = SCRIPTS[name]
    with machine(LOADS[script]) as drives:
        expected = list(script(drives))
    with on_bus(machine(LOADS[script]), safety=safety) as drives:
        found = list(script(drives))
    messages = [isinstance(part, list) for part in expected]
    for told, part, other in zip(messages, expected, found, strict=True):
        if told:
            assert part == other
            continue
        assert_equal([np.asarray(part)], [np.asarray(other)])
    watched = [part for part in expected if isinstance(part, np.ndarray) and part.ndim == 3]
    moved = np.concatenate(watched, axis=1)[WATCHED.index(0x6064)]
    trips = (EACH == 3) & (name == "fault")
    assert ((np.ptp(moved, axis=0) > 50) | trips).all(), "every axis moves"
    if name == "fault":
        assert [(one[0], one[1]) for one in expected[1]] == [(2, 0x8611)]
        assert (expected[3] & 0x6F == np.where(EACH == 3, 0x40, 0x27)).all()


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        (0x6077, 0),  # it has none
        (0x6071, 0),
        (0x2058, 0),
        (0x2001, 0),  # no full steps
        (0x208C, 0),  # units of the chip
        (0x6060, 10),  # cst
        (0x2097, 1),  # an off time that it does not know
        (0x2003, 256),
        (0x6081, 8_000_000),  # beyond the chip's register
        ((0x1600, 4), 0),  # a fourth object of a PDO
    ],
)
def test_what_is_refused_is_refused_with_the_same_code(name, value):
    with machine("inertia") as drives, pytest.raises(ObjectAccessError) as expected:
        drives.write(name, value)
    with on_bus(machine("inertia")) as drives, pytest.raises(ObjectAccessError) as found:
        drives.write(name, value)
    assert found.value.abort_code == expected.value.abort_code
