"""Tuners that are told to end while a motor turns: the axis is braked, then off, and only then has its gains back.

Judged by the truth inside the emulator, at the cycle in which the stage went off.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rigs.fault_injection import ON, TURN, ObservedWorld, served, until
from rigs.served_drives import environment

from drive_env import EmulatedDrives, SafetyError
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.cia402 import State
from drive_env.devices import find_device
from tuning.identify.identification import identify
from tuning.target import on_bus

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")

FAST = 10.0 * 2.0 * np.pi  # rad/s at which the program is told to end
SLOW = 2.0 * 2.0 * np.pi  # rad/s that a ramp's end and a cycle of 1 ms leave
COMMANDS = {
    "auto": ("tuning.commands.cli", ("auto", "--bus")),
    "identify": ("tuning.commands.cli", ("identify", "--bus")),
    "agent": ("tuning.commands.cli", ("auto", "--by", "agent")),
}


ATTEMPTS = 4  # a tuner ends by itself, too, where a computer is so busy that drives answer late or SYNCs come late


def start(command, channel, out):
    """Start a tuner on the served drive, as a process of its own."""
    module, words = COMMANDS[command]
    entry = "drive_agent" if module.startswith("agents") else "drive_tune"
    return subprocess.Popen(
        [sys.executable, "-c", f"from drive_env.programs import *; import sys; sys.argv[0] = 'x'; {entry}()", *words,
         "--channel", channel, "--node", "1", "--motor", "qbl4208", "--travel", "-3:3", "--yes", "--out", str(out)],
        env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def gains(machine):
    return [int(machine.read(key)[0]) for key in GAIN_OBJECTS]


def speed(world):
    return abs(world.truth.omega(max(world.truth.cycles - 3, 0))[-1, 0])


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_tuner_that_is_told_to_end_brakes_before_it_cleans_up(tmp_path, command, number):
    with EmulatedDrives(load="inertia", num_threads=1) as machine, served(machine) as (world, channel):
        before = gains(machine)
        for attempt in range(ATTEMPTS):
            home = world.truth.theta(world.truth.cycles - 1)[0, 0]  # --travel counts from here
            process = start(command, channel, tmp_path / f"out{attempt}")
            try:
                until(lambda: process.poll() is not None or speed(world) > FAST, "a fast motor", 240.0)  # noqa: B023
                if process.poll() is None:
                    since = world.truth.cycles
                    process.send_signal(number)
                    _, said = process.communicate(timeout=120)
                    break
                said = "".join(process.communicate())
            finally:
                process.kill()
        else:
            pytest.skip(f"this computer is too busy: the tuner gave up by itself {ATTEMPTS} times: {said[-300:]}")
        assert process.returncode in (1, 130), said
        until(world.truth.at_rest, "rest")
        on = np.isin(world.truth.fsa(since)[:, 0], ON)
        omega = np.abs(world.truth.omega(since)[:, 0])
        ends = np.flatnonzero(on[:-1] & ~on[1:])
        assert ends.size, "it was not on when it was told to end"
        assert omega[ends[0]] < SLOW, f"the power was cut at {omega[ends[0]] / (2 * np.pi):.1f} rev/s"
        assert np.abs(world.truth.theta(since) - home).max() < 4.0 * 2.0 * np.pi
        assert gains(machine) == before
        assert machine.read(0x2058)[0] == TURN


@pytest.mark.slow
def test_a_trip_inside_an_identification_is_not_cut_short_by_its_clean_up():
    """The axis leaves its limits: what follows is the ramp to rest, whatever the tuner puts back meanwhile."""
    with EmulatedDrives(load="inertia", num_threads=1) as machine:
        world, hub = ObservedWorld(machine, lockstep=True), Hub()
        with Server(world, hub), on_bus(channel=hub.channel, pace="lockstep", travel=(-30.0, 30.0)) as target:
            envelope = target.drives.safety
            here = int(target.drives.read(0x6064)[0])
            envelope.change(replace(envelope.limits, position=(here - TURN // 4, here + TURN // 4)))
            with pytest.raises(SafetyError, match="beyond the limits"):
                identify(target)
        stopping = int(np.flatnonzero(world.truth.fsa()[:, 0] == int(State.QUICK_STOP_ACTIVE))[0])
        fsa, omega = world.truth.fsa(stopping)[:, 0], np.abs(world.truth.omega(stopping)[:, 0])
        assert omega[0] > SLOW  # it was under way
        # Its last cycle may be one of the ramp's end: what switches it off takes no time in lockstep.
        off = int(np.argmax(~np.isin(fsa, ON))) or len(fsa) - 1
        assert not np.any(fsa[:off] == int(State.OPERATION_ENABLED))
        assert omega[off] < SLOW
        assert machine.read(0x6041)[0] & 0x4F == 0x40
