"""A fault at frame k of a session over EtherCAT: the rotors end at rest, their stages off, whatever the program saw.

In lockstep, so that each k is the same in every run. A session has some 7,500 frames: every 25th in the slow run (with
FAULT_STRIDE=40 every thousandth), one in every run. The verdict is the emulator's inside alone.
"""

import logging
import os
from contextlib import suppress

import numpy as np
import pytest
from rigs.ethercat_segment import EmulatedSegment

from drive_env import motion
from drive_env.drives.limits import Limits
from drive_env.ethercat import registers
from drive_env.fieldbus.errors import BusError
from drive_env.firmware.record import get_lanes
from drive_env.master.ethercat_drives import EtherCatDrives
from drive_env.safety.envelope import SafetyError

STRIDE = int(os.environ.get("FAULT_STRIDE", "1"))
STEP = 25  # frames from fault to fault in the slow run
KINDS = ("request lost", "answer lost", "twice", "cable pulled", "program killed")
SPEED = 20_000  # pps


class ProgramKilledError(BaseException):
    """The program is dead: nothing of it happens any more."""


class Faulty:
    """What happens to frame k; counts them."""

    def __init__(self, segment, kind=None, at=-1):
        self.segment, self.kind, self.at, self.frames = segment, kind, at, 0
        self._receive = segment.receive
        segment.receive = self.receive

    def receive(self, frame):
        self.frames += 1
        if self.kind is None or self.frames - 1 != self.at:
            return self._receive(frame)
        if self.kind == "request lost":
            return None
        if self.kind == "cable pulled":
            self.segment.is_connected = False
            return None
        if self.kind == "program killed":
            self.segment.is_connected = False
            raise ProgramKilledError
        self._receive(frame)
        return None if self.kind == "answer lost" else self._receive(frame)


def session(segment):
    """Enable, turn, and stop, as programs do."""
    master = segment.master()
    with EtherCatDrives(master=master, pace="lockstep", timeout=0.05, safety=Limits(silence=0.05)) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, SPEED)
        drives.advance(0.08)
        motion.quick_stop(drives)
        motion.disable(drives)
        motion.enable(drives, mode="csp")
        drives.advance(0.02)
        motion.disable(drives)


def verdict(segment):
    """Let the drives go on without a master; return what is wrong with them then."""
    segment.world.lockstep = False
    segment.world.run_until(segment.world.time + 1.0)  # the drives go on without a master
    rest = segment.drives.machine.rotor_angle.copy()
    segment.world.run_until(segment.world.time + 0.2)
    segment.world.lockstep = True
    found = []
    if np.any(get_lanes(segment.drives.inside.records, "stage_on", segment.drives.num_axes) != 0.0):
        found.append("a stage is on")
    if np.abs(segment.drives.machine.rotor_angle - rest).max() > 1e-3:
        found.append("a rotor turns")
    return found


def lives(segment, kind=None, at=-1):
    """Live a session with a fault; return frames, whether a rotor turned in it, and what is wrong in the end."""
    faulty = Faulty(segment, kind, at)
    before = segment.drives.machine.rotor_angle.copy()
    with suppress(BusError, SafetyError, ProgramKilledError, RuntimeError):
        session(segment)
    turned = np.abs(segment.drives.machine.rotor_angle - before).max()
    return faulty.frames, turned, verdict(segment)


def one(kind=None, at=-1):
    with EmulatedSegment(load="inertia", num_machines=3) as segment:
        return lives(segment, kind, at)


@pytest.fixture(scope="module")
def frames():
    logging.getLogger("drive_env").setLevel(logging.CRITICAL + 1)
    count, turned, found = one()
    assert found == [] and turned > 0.1 and count > 100
    yield count
    logging.getLogger("drive_env").setLevel(logging.NOTSET)


@pytest.mark.every(3)
@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_at_a_frame_leaves_no_axis_running(kind, frames):
    assert one(kind, 2 * frames // 3)[2] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_at_any_frame_leaves_no_axis_running(kind, frames):
    assert [k for k in range(0, frames, STEP * STRIDE) if one(kind, k)[2]] == []


def test_the_verdict_sees_a_drive_that_runs_on():
    """Its slave's watchdog is off, and its master leaves it alone in Op."""
    with EmulatedSegment(load="inertia", num_machines=3) as segment:
        master = segment.master()
        drives = EtherCatDrives(master=master, pace="lockstep", timeout=0.05, safety=False)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, SPEED)
        drives.advance(0.05)
        master.write_register(0, registers.SM_WATCHDOG, bytes(2))
        segment.is_connected = False
        assert verdict(segment) == ["a stage is on", "a rotor turns"]
        with suppress(BusError, SafetyError):
            drives.close()
