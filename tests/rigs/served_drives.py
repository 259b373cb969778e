"""A drive behind a hub, in a thread or in a process of its own, and what a command leaves behind."""

import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from drive_env import CanDrives, EmulatedDrives
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.master.parameters import read_parameters
from rigs import ROOT

# The command alone, so that a mistake in another command does not show here.
APP = "import typer; from drive_env.commands.serve import serve; typer.run(serve)"


def command(*arguments):
    return [sys.executable, "-c", APP, *map(str, arguments)]


def environment():
    return os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "NO_COLOR": "1"}


@contextmanager
def served(*arguments, cwd):
    """A server in a process of its own; yields the process and the channel that it printed."""
    process = subprocess.Popen(
        command("--port", "0", *arguments), cwd=cwd, env=environment(),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for line in process.stdout:
            if match := re.search(r'channel="(socket://127\.0\.0\.1:\d+)"', line):
                break
        else:
            pytest.fail(process.stderr.read())
        yield process, match[1]
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


GAIN_OBJECTS = find_device("tmcm1636").gains.keys
PATIENCE = 120.0  # s until a run has come so far; it is never this long


@contextmanager
def node(lockstep=True, load="inertia", machine=None):
    """An emulated drive on a hub: its machine, one of the first drive by default, and the options that name it."""
    world = World(lockstep=lockstep)
    machine = machine or EmulatedDrives(load=load, num_threads=1)
    machine.advance(0.001)  # compiles: a node that does would not answer in time
    world.add(machine, [1])
    hub = Hub()
    try:
        with Server(world, hub):
            yield machine, ["--interface", "slcan", "--channel", hub.channel, *["--lockstep"] * lockstep]
    finally:
        world.close()


def parameters(bus):
    """Return the parameters that a master reads, those of communication too."""
    _, interface, _, channel, *lockstep = bus
    pace = "lockstep" if lockstep else "real-time"
    with CanDrives(interface=interface, channel=channel, pace=pace, safety=False) as drives:
        return read_parameters(drives)


def status_is(machine, *states):
    return any(int(machine.read(0x6041)[0]) & mask == value for mask, value in states)


def wait_until(condition, process=None):
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end and (process is None or process.poll() is None):
        time.sleep(0.01)


def files(folder):
    return [path for path in folder.rglob("*before*.toml") if not path.name.startswith(".")]
