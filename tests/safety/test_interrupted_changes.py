"""A program that is interrupted at any frame gives a drive back what it lent, or says what is changed."""

from __future__ import annotations

import logging
import signal
import sys
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from rigs.served_drives import node
from rigs.world_bus import WorldBus
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, Limits, cia402, motion
from drive_env.bus.world import World
from drive_env.commands import get
from drive_env.commands.cli import app
from drive_env.commands.options import BusOptions
from drive_env.drives.lent_object import lent
from drive_env.fieldbus.errors import NoAnswerError
from drive_env.master.parameters import NotRestoredError, read_parameters, write_all_or_none

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
OPTIONS = {"nodes": (1,), "pace": "lockstep"}
VELOCITY, RAMP = (cia402.PROFILE_VELOCITY, 0), (cia402.PROFILE_ACCELERATION, 0)


class InterruptedBus(WorldBus):
    """A bus on which Ctrl-C is pressed as frame `at` is sent: it is, and its answer comes."""

    count, at = 0, -1

    def send(self, msg, timeout=None):
        super().send(msg, timeout)
        self.count += 1
        if self.count == self.at:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture
def bus():
    world = World(lockstep=True)
    world.add(EmulatedDrives(num_threads=1), [1])
    made = InterruptedBus(world)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield made
    signal.signal(signal.SIGINT, before)
    made.shutdown()
    world.close()


@pytest.fixture
def served_node():
    with node(lockstep=False) as (machine, bus):
        yield machine, bus[:4]


def held(bus):
    """Return what the drive has."""
    with CanDrives(bus=bus, safety=False, **OPTIONS) as drives:
        return read_parameters(drives)


def sample(drives):
    """Have the drive send samples: its TPDOs are lent."""
    drives.record([cia402.POSITION_ACTUAL], 0.002)


def move(drives):
    """Move an axis at a speed of this program: profile velocity, limits and watchdog are lent, too."""
    with lent(drives, cia402.PROFILE_VELOCITY, 655_360):
        sample(drives)
        motion.enable(drives, mode="pp")
        motion.start_move(drives, 3000, relative=True)
        drives.advance(0.05)


NEW = {VELOCITY: 655_360, RAMP: 655_360, (0x1A00, 0): 1, (0x1A00, 1): 0x60640020}
LIMITS = Limits(position=(-3_000_000, 3_000_000), current=3000, following_error=50_000)


@contextmanager
def interrupted(bus, at):
    """Press Ctrl-C at a frame of a block, and let pass what that raises."""
    bus.count, bus.at = 0, at
    with suppress(KeyboardInterrupt, NotRestoredError):
        yield
    bus.at = -1


@pytest.mark.slow
@pytest.mark.parametrize(("act", "safety"), [(sample, False), (move, LIMITS)])
def test_ctrl_c_at_any_frame_leaves_nothing_lent(bus, act, safety):
    """15 of 499 frames left TPDOs switched off, remapped, or a heartbeat set, and the program said nothing of it."""
    before, at = held(bus), 0
    while at <= bus.count:
        at += 1
        with interrupted(bus, at), CanDrives(bus=bus, safety=safety, **OPTIONS) as drives:
            act(drives)
        count = bus.count
        found = held(bus)
        assert {key: (at, one, found[key]) for key, one in before.items() if one != found[key]} == {}
        bus.count = count
    assert at > 30


def test_ctrl_c_at_any_frame_of_an_exchange_leaves_all_or_nothing(bus):
    before, at = held(bus), 0
    while at <= bus.count:
        at += 1
        with interrupted(bus, at), CanDrives(bus=bus, safety=False, **OPTIONS) as drives:
            write_all_or_none(drives, NEW)
        count = bus.count
        found = held(bus)
        assert found in (before, before | NEW), at
        with CanDrives(bus=bus, safety=False, **OPTIONS) as drives:
            write_all_or_none(drives, before)
        bus.count = count
    assert at > 30


def test_what_cannot_be_given_back_is_said_with_the_line_that_restores_it(caplog):
    with EmulatedDrives(num_threads=1) as drives:
        write, before = drives.write, int(drives.read(VELOCITY)[0])

        def silent(name, value, where=None):
            if np.any(np.asarray(value) == before):
                raise NoAnswerError("node 1 does not answer")
            write(name, value, where)

        drives.write = silent
        with caplog.at_level(logging.WARNING), pytest.raises(NoAnswerError), lent(drives, VELOCITY[0], 655_360):
            pass
    assert f"6081h may be 655360 still, and was {before}; drive-env set 6081 {before} --raw restores it" in caplog.text


def test_a_set_that_is_interrupted_says_what_it_wrote(served_node, monkeypatch):
    machine, bus = served_node
    with monkeypatch.context() as patch:
        write = get._write
        patch.setattr(get, "_write", lambda *arguments: (write(*arguments), signal.raise_signal(signal.SIGINT)))
        done = CliRunner().invoke(app, ["set", "6081", "7777", *bus])
    assert (done.exit_code, done.stdout, machine.read(VELOCITY)[0]) == (130, "", 7777)
    assert "6081h:00 Profile velocity may be 7777 by now; drive-env get '6081' shows it\n" in done.stderr


def test_a_commissioning_that_is_interrupted_says_what_it_wrote(served_node, monkeypatch):
    machine, bus = served_node
    before = int(machine.read(VELOCITY)[0])
    assert CliRunner().invoke(app, ["set", "6081", "655361", *bus]).exit_code == 0
    connect, opened = BusOptions.connect, []

    def once(*arguments, **others):
        opened.append(None)
        if len(opened) > 1:
            raise KeyboardInterrupt
        return connect(*arguments, **others)

    monkeypatch.setattr(BusOptions, "connect", once)
    done = CliRunner().invoke(app, ["parameters", "commission", machine.motor.name, "--yes", "--json", *bus])
    assert (done.exit_code, int(machine.read(VELOCITY)[0])) == (130, before)
    assert f"6081h:00 Profile velocity: 655361 -> {before}" in done.stderr
