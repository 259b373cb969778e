"""The TMCM-6212 with its six axes: on the emulator and over CAN in lockstep the same script gives the same integers."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.world_bus import assert_equal, on_bus

from drive_env import EmulatedDrives, motion

AXES = 6
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


LOADS = {pp: "robot", pv: "robot", csp: "robot", fault: "inertia"}
SCRIPTS = {script.__name__: script for script in LOADS}


@pytest.mark.every(6)
@pytest.mark.parametrize(("name", "safety"), [*((name, True) for name in SCRIPTS), ("csp", False), ("fault", False)])
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
