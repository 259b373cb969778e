"""A fault at frame k of a session with the node of a stepper of three or six axes, open, in closed loop, in torque.

All rotors end at rest, disabled, inside their travel, as tests/safety/test_fault_injection.py has it for one servo
axis, with a sample of the frames; the verdict is the emulator's inside alone.
"""

from __future__ import annotations

import random
from contextlib import ExitStack
from functools import cache

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
from rigs.six_axes import LIMITS, TRAVEL, TURN

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role

LOAD_ANGLE, PID, PID_ALONE = 1, 2, 3


@pytest.fixture(scope="module")
def emulated():
    """Return the function that returns the emulated drives of a device."""
    with eds_read_once(), ExitStack() as opened:

        @cache
        def drives_of(device):
            axes = find_device(device).num_axes
            return opened.enter_context(EmulatedDrives(device, "inertia", num_machines=axes, num_threads=1))

        yield drives_of


@pytest.fixture(autouse=True)
def no_test_hangs():
    with no_longer_than(600.0):
        yield


def close_loop(drives, mode, loop):
    """Enable and close the loop; a long wait in one call has frames of SYNC alone."""
    drives.write("Sensor selection code", 0)
    motion.enable(drives, mode=mode)
    drives.write(Role.LOOP_MODE, loop)
    drives.advance(0.5)


def to_and_fro(drives, fastest=3 * TURN):
    """Every axis at a speed of its own, then the other way, and a stop by ramp."""
    for name in ("Profile acceleration", "Profile deceleration"):
        drives.write(name, 60 * TURN)
    each = np.arange(1, drives.num_axes + 1) * fastest // drives.num_axes
    drives.write(cia402.TARGET_VELOCITY, each)
    drives.advance(0.03)
    drives.write(cia402.TARGET_VELOCITY, -each)
    drives.advance(0.02)
    stop_by_ramp(drives)


def play_paths(drives):
    """Paths of all axes, played in one call, and the stop left to the end of the program."""
    path = TURN // 32 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 60)))
    ways = path[:, None] * np.linspace(-1.0, 1.0, drives.num_axes)
    rows = np.rint(ways + drives.read(cia402.TARGET_POSITION)).astype(int)
    drives.record([cia402.POSITION_ACTUAL], 0.06, play={cia402.TARGET_POSITION: rows})


def speeds(drives):
    motion.enable(drives, mode="pv")
    to_and_fro(drives)


def paths(drives):
    motion.enable(drives, mode="csp")
    play_paths(drives)


def some_are_off(drives):
    """Two of the axes turn; one of them is switched off while the other goes on, for ever."""
    where = np.arange(drives.num_axes) < 2
    motion.enable(drives, mode="pv", where=where)
    drives.write(cia402.TARGET_VELOCITY, 2 * TURN, where=where)
    drives.advance(0.05)
    motion.disable(drives, where=np.arange(drives.num_axes) == 0)
    drives.advance(0.05)


def closed_loop(drives):
    close_loop(drives, "pv", LOAD_ANGLE)
    to_and_fro(drives)


def position_pid(drives):
    close_loop(drives, "pv", PID)
    to_and_fro(drives)


def position_pid_alone(drives):
    """All of the motion is the PID's, at a speed at which it is a few full steps behind, and loses none."""
    gains = {
        "Correction position P": 10_000,
        "Correction velocity P": 8000,
        "Correction velocity I": 1,
        "Correction velocity DV clock": 2,
        "Maximum correction tolerance": 8,
    }
    for name, value in gains.items():
        drives.write(name, value)
    close_loop(drives, "pv", PID_ALONE)
    to_and_fro(drives, fastest=TURN // 2)


def closed_loop_paths(drives):
    close_loop(drives, "csp", LOAD_ANGLE)
    play_paths(drives)


def torque(drives):
    """A policy in torque, cycle by cycle; it leaves two axes turning, and a third switched off."""
    close_loop(drives, "cst", LOAD_ANGLE)
    motion.disable(drives, where=np.arange(drives.num_axes) == 2)
    for k in range(20):
        rows = [[200 if k < 14 else -100, -150, 0]]
        drives.record([cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL], 0.001, play={cia402.TARGET_TORQUE: rows})


OF_TWO = (some_are_off, closed_loop_paths, torque)  # which move two axes at least, others all
CLOSED = (closed_loop, closed_loop_paths, torque)
SESSIONS = [("tmcm6212", session) for session in (speeds, paths, some_are_off)]
SESSIONS += [("tmcm3313", session) for session in (speeds, position_pid, position_pid_alone, *CLOSED)]
EACH_SESSION = pytest.mark.parametrize(
    ("device", "session"), SESSIONS, ids=[f"{device} {session.__name__}" for device, session in SESSIONS]
)


@pytest.mark.every(12)
@EACH_SESSION
def test_without_a_fault_a_session_moves_and_ends_at_rest(emulated, device, session):
    drives = emulated(device)
    truth, frames, ended = run_lockstep(drives, session, limits=LIMITS)
    assert ended is None
    assert problems(truth, travel=TRAVEL) == []
    assert frames > 100
    moved = np.ptp(truth.theta(), axis=0) / (2.0 * np.pi)
    least = 0.002 if session is position_pid_alone else 0.01
    assert moved[moved > least].size >= (2 if session in OF_TWO else drives.num_axes), moved
    assert device == "tmcm6212" or (drives.read(Role.LOOP_INITIALISED) == (session in CLOSED)).all()


@pytest.mark.every(60)
@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
@EACH_SESSION
def test_a_fault_at_a_frame_leaves_no_axis_running(emulated, device, session, kind, count):
    drives = emulated(device)
    _, frames, _ = run_lockstep(drives, session, limits=LIMITS)
    chosen = sample(random.Random(f"{session.__name__} {kind} {count}"), frames, count)
    assert worst_of([(f"{kind} {k}", run_with(drives, session, kind, k, LIMITS, TRAVEL)) for k in chosen]) == ""
