"""A fault at frame k of a session with a node of six axes: all rotors end at rest, disabled, inside their travel.

As tests/safety/test_fault_injection.py has it for one servo axis, with a sample of the frames; the
verdict is the emulator's inside alone.
"""

from __future__ import annotations

import random

import numpy as np
import pytest
from rigs.fault_injection import (
    KINDS,
    eds_read_once,
    no_longer_than,
    problems,
    run_lockstep,
    run_with,
    sample,
    stop_by_ramp,
    worst_of,
)
from rigs.six_axes import AXES, LIMITS, TRAVEL, TURN

from drive_env import EmulatedDrives, cia402, motion


@pytest.fixture(scope="module")
def emulated():
    with eds_read_once(), EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1) as drives:
        yield drives


@pytest.fixture(autouse=True)
def no_test_hangs():
    with no_longer_than(600.0):
        yield


def speeds(drives):
    """Every axis at a speed of its own, then the other way, and a stop by ramp."""
    for name in ("Profile acceleration", "Profile deceleration"):
        drives.write(name, 60 * TURN)
    motion.enable(drives, mode="pv")
    each = np.arange(1, AXES + 1) * TURN // 2
    drives.write(cia402.TARGET_VELOCITY, each)
    drives.advance(0.03)
    drives.write(cia402.TARGET_VELOCITY, -each)
    drives.advance(0.02)
    stop_by_ramp(drives)


def paths(drives):
    """Six paths, played in one call, and the stop left to the end of the program."""
    motion.enable(drives, mode="csp")
    path = TURN // 32 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 60)))
    rows = np.rint(path[:, None] * np.linspace(-1.0, 1.0, AXES)).astype(int)
    drives.record([cia402.POSITION_ACTUAL], 0.06, play={cia402.TARGET_POSITION: rows})


def some_are_off(drives):
    """Two of the axes turn; one of them is switched off while the other goes on, for ever."""
    where = np.arange(AXES) < 2
    motion.enable(drives, mode="pv", where=where)
    drives.write(cia402.TARGET_VELOCITY, 2 * TURN, where=where)
    drives.advance(0.05)
    motion.disable(drives, where=np.arange(AXES) == 0)
    drives.advance(0.05)


SESSIONS = {session.__name__: session for session in (speeds, paths, some_are_off)}


@pytest.mark.every(3)
@pytest.mark.parametrize("name", SESSIONS)
def test_without_a_fault_a_session_moves_and_ends_at_rest(emulated, name):
    truth, frames, ended = run_lockstep(emulated, SESSIONS[name], limits=LIMITS)
    assert ended is None
    assert problems(truth, travel=TRAVEL) == []
    assert frames > 100
    assert np.ptp(truth.theta(), axis=0)[: 2 if name == "some_are_off" else AXES].min() > 0.01 * 2 * np.pi


@pytest.mark.every(30)
@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_a_frame_leaves_no_axis_running(emulated, name, kind, count):
    _, frames, _ = run_lockstep(emulated, SESSIONS[name], limits=LIMITS)
    chosen = sample(random.Random(f"{name} {kind} {count}"), frames, count)
    assert (
        worst_of([(f"{kind} {k}", run_with(emulated, SESSIONS[name], kind, k, LIMITS, TRAVEL)) for k in chosen]) == ""
    )
