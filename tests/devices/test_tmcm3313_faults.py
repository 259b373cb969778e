"""A fault at frame k of a session with a node of three axes, open, in closed loop, by PID and in torque.

All rotors end at rest, disabled, inside their travel, as test_tmcm6212_faults.py has it for six axes; the
verdict is the emulator's inside alone.
"""

from __future__ import annotations

import random

import numpy as np
import pytest
from rigs.fault_injection import (
    KINDS,
    RADIANS,
    eds_read_once,
    no_longer_than,
    problems,
    run_lockstep,
    run_with,
    sample,
    stop_by_ramp,
    worst_of,
)

from drive_env import EmulatedDrives, Limits, cia402, motion
from drive_env.dictionary.roles import Role

AXES = 3
TURN = 200 * 256  # microsteps
LIMITS = Limits(position=(-3 * TURN, 3 * TURN), velocity=6 * TURN)
TRAVEL = tuple(3 * sign * 2.0 * np.pi / RADIANS for sign in (-1, 1))  # as `problems` counts
LOAD_ANGLE, PID, PID_ALONE = 1, 2, 3


@pytest.fixture(scope="module")
def emulated():
    with eds_read_once(), EmulatedDrives("tmcm3313", "inertia", num_machines=AXES, num_threads=1) as drives:
        yield drives


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


def to_and_fro(drives, fastest=AXES * TURN):
    """Every axis at a speed of its own, then the other way, and a stop by ramp."""
    for name in ("Profile acceleration", "Profile deceleration"):
        drives.write(name, 60 * TURN)
    each = np.arange(1, AXES + 1) * fastest // AXES
    drives.write(cia402.TARGET_VELOCITY, each)
    drives.advance(0.03)
    drives.write(cia402.TARGET_VELOCITY, -each)
    drives.advance(0.02)
    stop_by_ramp(drives)


def open_loop(drives):
    motion.enable(drives, mode="pv")
    to_and_fro(drives)


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
    """Three paths, played in one call, and the stop left to the end of the program."""
    close_loop(drives, "csp", LOAD_ANGLE)
    path = TURN // 32 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 60)))
    rows = np.rint(path[:, None] * np.linspace(-1.0, 1.0, AXES) + drives.read(cia402.TARGET_POSITION)).astype(int)
    drives.record([cia402.POSITION_ACTUAL], 0.06, play={cia402.TARGET_POSITION: rows})


def torque(drives):
    """A policy in torque, cycle by cycle; it leaves two axes turning, and a third switched off."""
    close_loop(drives, "cst", LOAD_ANGLE)
    motion.disable(drives, where=np.arange(AXES) == 2)
    for k in range(20):
        rows = [[200 if k < 14 else -100, -150, 0]]
        drives.record([cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL], 0.001, play={cia402.TARGET_TORQUE: rows})


SESSIONS = {
    session.__name__: session
    for session in (open_loop, closed_loop, position_pid, position_pid_alone, closed_loop_paths, torque)
}


@pytest.mark.every(12)
@pytest.mark.parametrize("name", SESSIONS)
def test_without_a_fault_a_session_moves_and_ends_at_rest(emulated, name):
    truth, frames, ended = run_lockstep(emulated, SESSIONS[name], limits=LIMITS)
    assert ended is None
    assert problems(truth, travel=TRAVEL) == []
    assert frames > 100
    moved = np.ptp(truth.theta(), axis=0) / (2.0 * np.pi)
    least = 0.002 if name == "position_pid_alone" else 0.01
    assert moved[moved > least].size >= (2 if name in ("torque", "closed_loop_paths") else AXES), moved
    closed = emulated.read(Role.LOOP_INITIALISED)
    assert (closed == (1 if name in ("closed_loop", "closed_loop_paths", "torque") else 0)).all()


@pytest.mark.every(60)
@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_a_frame_leaves_no_axis_running(emulated, name, kind, count):
    _, frames, _ = run_lockstep(emulated, SESSIONS[name], limits=LIMITS)
    chosen = sample(random.Random(f"{name} {kind} {count}"), frames, count)
    assert (
        worst_of([(f"{kind} {k}", run_with(emulated, SESSIONS[name], kind, k, LIMITS, TRAVEL)) for k in chosen]) == ""
    )
