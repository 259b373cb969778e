"""A drive that waits for its brake before it enables: an axis on its way there is no axis that is off."""

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
    worst_of,
)
from rigs.six_axes import AXES, LIMITS, TRAVEL, TURN

from drive_env import EmulatedDrives, cia402, motion

RELEASE = 400  # ms from the brake's release to operation enabled (2002h:02)


@pytest.fixture(scope="module")
def emulated():
    with eds_read_once(), EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1) as drives:
        yield drives


@pytest.fixture(autouse=True)
def no_test_hangs():
    with no_longer_than(300.0):
        yield


def on_its_way(drives, wait):
    for name, value in (((0x2002, 2), RELEASE), ((0x200C, 1), 0), ((0x200C, 2), 200)):
        drives.write(name, value)
    motion.select_mode(drives, "pv")
    drives.write(cia402.TARGET_VELOCITY, TURN)
    for word in (cia402.SHUTDOWN, cia402.SWITCH_ON, cia402.ENABLE_OPERATION):
        drives.write(cia402.CONTROLWORD, word)
        drives.advance(0.003)
    drives.advance(wait)


@pytest.mark.every(4)
@pytest.mark.parametrize("wait", [0.001, 0.1])
@pytest.mark.parametrize("end", ["close", "interrupt"])
def test_an_axis_on_its_way_to_operation_enabled_is_called_off_at_the_end(emulated, wait, end):
    def session(drives):
        on_its_way(drives, wait)
        assert not cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any()
        if end == "interrupt":
            raise KeyboardInterrupt

    truth, *_ = run_lockstep(emulated, session, limits=LIMITS)
    for _ in range(2 * RELEASE):  # whatever was left on its way would be there by now
        emulated.advance(0.001)
    assert not cia402.matches(emulated.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any()
    assert problems(truth, travel=TRAVEL) == []
    assert np.ptp(truth.theta()) < 0.1


@pytest.mark.slow
def test_one_that_is_waited_for_is_watched(emulated):
    """It turns once it is there, and its limits hold."""

    def session(drives):
        on_its_way(drives, 0.001 * RELEASE + 0.1)
        assert cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).all()
        drives.advance(4.0)

    truth, _, ended = run_lockstep(emulated, session, limits=LIMITS)
    assert "the position is" in str(ended) or "its stop would end" in str(ended)
    assert problems(truth, travel=TRAVEL) == []


@pytest.mark.every(10)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [2, pytest.param(16, marks=pytest.mark.slow)])
def test_a_fault_at_a_frame_leaves_none_on_its_way(emulated, kind, count):
    def session(drives):
        on_its_way(drives, 0.02)

    _, frames, _ = run_lockstep(emulated, session, limits=LIMITS)
    outcomes = []
    for frame in sample(random.Random(f"{kind} {count}"), frames, count):
        found = run_with(emulated, session, kind, frame)
        emulated.advance(0.002 * RELEASE)
        if cia402.matches(emulated.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED).any():
            found.append("enabled after all")
        outcomes.append((f"{kind} {frame}", found))
    assert worst_of(outcomes) == ""
