"""A fault at frame k of a session: the rotor ends at rest, disabled, inside its travel plus the stopping distance.

Every k in the slow run (with FAULT_STRIDE=40 every fortieth, from FAULT_FIRST on), a sample in every run.
The verdict is the emulator's inside alone (tests/rigs/fault_injection.py).
"""

from __future__ import annotations

import os
import random
import signal
import struct
import sys
from contextlib import suppress
from pathlib import Path

import can
import numpy as np
import pytest
from rigs.fault_injection import (
    KINDS,
    SESSIONS,
    WORLD_PATIENCE,
    Fault,
    FaultyBus,
    ObservedWorld,
    Programs,
    WorldBus,
    eds_read_once,
    no_longer_than,
    overshoot,
    problems,
    rest,
    run_lockstep,
    run_real_time,
    run_with,
    sample,
    served,
    until,
    worst_of,
)

from drive_env import EmulatedDrives

# Every frame takes a quarter of an hour on two cores, every twentieth a minute. FAULT_FIRST: the first one.
STRIDE, FIRST = (int(os.environ.get(f"FAULT_{name}", least)) for name, least in (("STRIDE", "1"), ("FIRST", "0")))
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "SIGSTOP")


@pytest.fixture(scope="module")
def emulated():
    with eds_read_once(), EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture(autouse=True)
def no_test_hangs(request):
    with no_longer_than(1800.0 if request.node.get_closest_marker("slow") else 120.0):
        yield


# --- lockstep: frames of one thread, every k the same in every run --------------------------------------------------
@pytest.mark.parametrize("name", SESSIONS)
def test_without_a_fault_a_session_moves_and_ends_at_rest(emulated, name):
    truth, frames, ended = run_lockstep(emulated, SESSIONS[name])
    assert ended is None
    assert problems(truth) == []
    assert frames > 100
    assert np.ptp(truth.theta()) > 0.02 * 2 * np.pi


def worst_at(emulated, name, kind, chosen):
    """Return the worst outcome of a session with a fault at one of the frames that `chosen` takes of their number."""
    _, frames, _ = run_lockstep(emulated, SESSIONS[name])
    return worst_of([(f"{kind} {k}", run_with(emulated, SESSIONS[name], kind, k)) for k in chosen(frames)])


@pytest.mark.every(27)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_a_frame_leaves_no_axis_running(emulated, name, kind):
    assert worst_at(emulated, name, kind, lambda frames: sample(random.Random(f"{name} {kind}"), frames, 5)) == ""


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_any_frame_leaves_no_axis_running(emulated, name, kind):
    assert worst_at(emulated, name, kind, lambda frames: range(FIRST, frames, STRIDE)) == ""


# --- real time: the drives' watchdogs are awake, and frame k is another one in every run -----------------------------
def count_frames(emulated, name):
    """Return the frames of a session in real time; another run has some more or less."""
    truth, frames = run_real_time(emulated, SESSIONS[name])
    assert problems(truth) == []
    return frames


def faults_in_real_time(emulated, name, each, seed):
    """Run a session with faults at `each` frames for each kind; return the outcomes."""
    rng, frames = random.Random(f"{seed} {name}"), count_frames(emulated, name)
    faults = [Fault(kind, frame) for kind in ("lose", "double", "delay") for frame in sample(rng, frames, each)]
    return [(str(fault), problems(run_real_time(emulated, SESSIONS[name], fault)[0])) for fault in faults]


@pytest.mark.slow
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_a_frame_in_real_time_leaves_no_axis_running(emulated, name):
    assert worst_of(faults_in_real_time(emulated, name, 1, 0)) == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", SESSIONS)
def test_a_fault_at_many_frames_in_real_time_leaves_no_axis_running(emulated, name):
    assert worst_of(faults_in_real_time(emulated, name, 4, 1)) == ""


# --- signals: the program is a process, and a signal reaches it as it sends or receives frame k ---------------------
@pytest.fixture(scope="module")
def programs():
    made = Programs()
    yield made
    made.close()


def run_and_signal(emulated, programs, name, number, frame, times, safety="limits", within=WORLD_PATIENCE):
    """Run a session that is sent a signal at a frame; return what is wrong, as texts."""
    with served(emulated) as (world, channel):
        pid = programs.start(name, channel, getattr(signal, number), frame, times, safety=safety)
        try:
            if number == "SIGSTOP":
                until(lambda: pid in programs.ended or is_stopped(pid), "the stop")
            else:
                until(lambda: pid in programs.ended, f"the end of the program after {number}")
            rest(world, within)
            return problems(world.truth)
        finally:
            if pid not in programs.ended:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                until(lambda: pid in programs.ended, "the end of the program")


def is_stopped(pid):
    """Whether a process is stopped (the third field of its status, after the name in brackets), not gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] == "T"
    except FileNotFoundError:
        return False


def cases(emulated, name, numbers, each, seed):
    """Yield signal, frame and how often: `each` frames for each signal, once and thrice."""
    frames = count_frames(emulated, name)
    rng = random.Random(f"{seed} {name}")
    for number in numbers:
        for frame in sample(rng, frames, each):
            # A process that is killed or stopped takes no second signal.
            yield number, frame, 1 if number in ("SIGKILL", "SIGSTOP") else rng.choice((1, 3))


posix_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals, fork and /proc")


@pytest.mark.slow
@posix_only
@pytest.mark.parametrize(("name", "numbers"), [
    ("pp_move", ("SIGINT", "SIGKILL", "SIGSTOP")),
    ("pv_run", SIGNALS),
    ("csp_play", ("SIGTERM", "SIGKILL")),
    ("cst_play", ("SIGINT", "SIGHUP", "SIGKILL")),
    ("gain_trial", ("SIGTERM", "SIGSTOP")),
])  # fmt: skip
def test_a_signal_at_a_frame_leaves_no_axis_running(emulated, programs, name, numbers):
    outcomes = [
        (f"{number} x{times} at frame {frame}", run_and_signal(emulated, programs, name, number, frame, times))
        for number, frame, times in cases(emulated, name, numbers, 1, 0)
    ]
    assert worst_of(outcomes) == ""


@posix_only
@pytest.mark.slow
@pytest.mark.parametrize("name", SESSIONS)
def test_a_signal_at_many_frames_leaves_no_axis_running(emulated, programs, name):
    outcomes = [
        (f"{number} x{times} at frame {frame}", run_and_signal(emulated, programs, name, number, frame, times))
        for number, frame, times in cases(emulated, name, SIGNALS, 5, 1)
    ]
    assert worst_of(outcomes) == ""


# --- the harness finds what it is for -------------------------------------------------------------------------------
@pytest.mark.slow
@posix_only
def test_the_verdict_sees_a_program_without_an_envelope_that_is_killed(emulated, programs):
    found = run_and_signal(emulated, programs, "cst_play", "SIGKILL", 150, 1, safety=False, within=1.0)
    assert [os.waitstatus_to_exitcode(status) for status in programs.ended.values()][-1] == -signal.SIGKILL
    assert any("left in OPERATION_ENABLED" in one for one in found)
    assert any("turns at" in one for one in found)
    assert any("beyond travel and stopping distance" in one for one in found)


def test_the_overshoot_counts_from_the_stopping_distance_at_the_crossing():
    omega = np.concatenate([np.full(500, 100.0), np.linspace(100.0, 0.0, 501), np.zeros(100)])  # 200 rad/s^2
    theta = np.cumsum(omega) * 1e-3
    end = theta[499]  # the ramp begins as the axis passes it, and takes 25 rad
    predicted = 100.0**2 / (2 * 200.0) + 0.1 * 2 * np.pi
    found = overshoot(theta, omega, (-1.0, end), 0.0, 200.0)
    assert found == pytest.approx(theta.max() - end - predicted, abs=1e-9)
    assert found < 0.0
    assert overshoot(theta, omega, (-1.0, end), 0.0, 400.0) > 0.0
    assert overshoot(theta, omega, (-1.0, theta.max() + 1e-9), 0.0) == -np.inf
    assert overshoot(-theta, -omega, (-end, 1.0), 0.0, 400.0) > 0.0  # the other way


def can_read(index):
    data = struct.pack("<BHB4x", 0x40, index, 0)
    return can.Message(arbitration_id=0x601, data=data, is_extended_id=False)


@pytest.mark.parametrize("kind", ["lose", "double", "delay"])
@pytest.mark.parametrize("frame", [0, 1], ids=["request", "answer"])
def test_the_fault_meets_its_frame_and_no_other(emulated, kind, frame):
    emulated.machine.reset()
    world = ObservedWorld(emulated, lockstep=True)
    heard = []
    world.listeners.append(lambda ended: heard.append((ended.frame.can_id, ended.frame.data[1:3].hex())))
    bus = FaultyBus(WorldBus(world), Fault(kind, frame))
    answers = []
    for index in (0x1000, 0x1001, 0x1008):
        bus.send(can_read(index))
        while (message := bus.recv(0.0)) is not None:
            answers.append(message.data[1:3].hex())
    bus.shutdown()
    requests = [data for can_id, data in heard if can_id == 0x601]
    first, second, third = "0010", "0110", "0810"
    usual = [first, second, third]
    meets = {"lose": [second, third], "double": [first, first, second, third], "delay": [second, third, first]}[kind]
    assert requests == (meets if frame == 0 else usual)
    if frame == 1 and kind == "delay":  # it is there as the answer to the third request is read
        assert sorted(answers) == sorted(usual)
        assert answers[0] == second
    else:
        assert answers == meets
