"""Tuners that are interrupted at random, as processes on served drives in real time: at rest, off, and undone.

The truth is read inside the emulator: how long each rotor still turned, by the emulator's own time. Where a process is
killed, the drive's watchdog stops the motor (docs/safety.md: 0.5 s of silence, less on EtherCAT, and its ramp); any
other end is the program's own stop. What it leaves is what its last lines say, and `undo` brings back what was before.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from rigs.served_drives import PATIENCE, environment, files
from typer.testing import CliRunner

from drive_env import EmulatedDrives, cia402
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import UdpSocket
from drive_env.ethercat.world import EtherCatWorld
from drive_env.master.open_drives import open_drives
from drive_env.master.parameters import read_parameters
from tuning.commands.cli import app as drive_tune

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")]

TURNS = 0.5  # rad/s: an axis that is slower stands, or is held against its cogging
SILENCE = 0.5  # s, after which a drive that nobody speaks to stops
BRAKES = 0.6  # s that a ramp takes at most, from where a tuner goes (`Limits`: a second from the highest speed)
LATE = 1.0  # s that a busy computer may need to hand on a signal, or a frame
HOW = {"INT": signal.SIGINT, "TERM": signal.SIGTERM, "HUP": signal.SIGHUP, "KILL": signal.SIGKILL}


class Truth:
    """What the emulator did in each of its steps: time [s], speed [rad/s] and statusword of every axis."""

    def __init__(self, drives):
        self.drives, self._advance, self._lock = drives, drives.advance, threading.Lock()
        self.t, self.omega, self.status = 0.0, [], []
        drives.advance = self._look

    def _look(self, duration):
        self._advance(duration)
        with self._lock:
            self.t += duration
            self.omega.append((self.t, np.abs(self.drives.machine.rotor_speed).max()))
            self.status = self.drives.read(cia402.STATUSWORD)

    def is_on(self):
        return any(cia402.matches(int(word), cia402.OPERATION_ENABLED) for word in self.status)

    def is_off(self):
        return not any(cia402.is_live(int(word)) for word in self.drives.read(cia402.STATUSWORD))

    def turned_until(self, since):
        """Return how long after a time an axis still turned [s]."""
        with self._lock:
            late = [t for t, omega in self.omega if t > since and omega > TURNS]
        return late[-1] - since if late else 0.0


@contextmanager
def served(device, fieldbus, pace="real-time"):
    """Serve a drive with a flywheel on each axis: its truth, and its address."""
    drives = EmulatedDrives(device, "inertia", num_machines=find_device(device).num_axes, num_threads=1)
    drives.advance(0.002)  # compiled before time counts
    truth = Truth(drives)
    if fieldbus == "ethercat":
        world = EtherCatWorld(lockstep=False)
        world.add(EtherCatSlave(CoeNode(drives), takes_time=True), drives)
        server = EtherCatServer(world, UdpSocket(0))
        address = {"interface": "ethercat-udp", "channel": str(server.way.port), "nodes": [0]}
    else:
        world = World(lockstep=pace == "lockstep")
        world.add(drives, [1])
        hub = Hub()
        server = Server(world, hub)
        address = {"interface": "slcan", "channel": hub.channel, "nodes": [1], "pace": pace}
    try:
        with server:
            yield truth, address
    finally:
        world.close()


def parameters(device, address):
    with open_drives(device, safety=False, timeout=20.0, **address) as drives:
        return [read_parameters(drives, axis) for axis in range(drives.num_axes)]


def wait_for(condition, process=None):
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end and (process is None or process.poll() is None):
        time.sleep(0.005)


def start(command, device, address, folder):
    bus = ["--interface", address["interface"], "--channel", address["channel"], "--node", str(address["nodes"][0])]
    return subprocess.Popen(
        [sys.executable, "-c", "from drive_env.programs import drive_tune as run; run()", *command, "--device", device,
         *bus, *["--lockstep"] * (address.get("pace") == "lockstep"), "--travel", "-5:5", "--yes"],
        cwd=folder, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def check_left(truth, device, address, folder, said, before):
    """Check that the line of the last run is so, and that `undo` brings back all."""
    (file,) = files(folder)
    left = parameters(device, address)
    if "by a second reading" in said:
        assert left == before
    done = CliRunner().invoke(drive_tune, ["undo", str(file), "--yes"])
    assert done.exit_code == 0, done.output
    assert parameters(device, address) == before
    assert truth.is_off()


ROWS = [
    (device, fieldbus, command, how)
    for device, fieldbus, commands in (
        ("tgz_d", "ethercat", (("auto",), ("identify",), ("response",), ("auto", "--by", "agent"))),
        ("tmcm3313", "ethercat", (("auto",), ("auto", "--by", "random", "--trials", "20"))),
        ("tmcm6212", "can", (("auto",),)),
    )
    for command in commands
    for how in HOW
]


def named(one):
    """Return what a test of a row is called."""
    return one if isinstance(one, str) else " ".join(one[:3]) if "--by" in one else one[0]


@pytest.mark.parametrize(("device", "fieldbus", "command", "how"), ROWS, ids=named)
@pytest.mark.parametrize("seed", [0])
def test_a_tuner_is_interrupted_at_random(tmp_path, device, fieldbus, command, how, seed):
    random = np.random.default_rng([seed, ROWS.index((device, fieldbus, command, how))])
    with served(device, fieldbus) as (truth, address):
        before = parameters(device, address)
        process = start(command, device, address, tmp_path)
        try:
            wait_for(truth.is_on, process)
            wait_for(lambda: truth.omega[-1][1] > TURNS, process)
            begun = truth.t + random.uniform(0.0, 6.0)
            wait_for(lambda: truth.t > begun, process)
            since = truth.t
            process.send_signal(HOW[how])
            _, said = process.communicate(timeout=PATIENCE)
        finally:
            if process.poll() is None:
                process.kill()
                process.communicate()
        wait_for(truth.is_off)
        time.sleep(1.0)
        turned = truth.turned_until(since)
        print(f"\n{device} {' '.join(command)} {how}: turned {turned:.3f} s on; {process.returncode}: {said[-400:]}")
        assert truth.is_off()
        assert turned < SILENCE + BRAKES + LATE
        if how != "KILL" and process.returncode == 130:
            assert "drive-tune undo " in said
        check_left(truth, device, address, tmp_path, said, before)


TWO = {
    "one axis": ("tmcm1636", ("auto",), ("auto",)),
    "one axis, an agent second": ("tmcm1636", ("identify",), ("auto", "--by", "agent")),
    "two axes of a module": ("tmcm6212", ("auto", "--axis", "0"), ("auto", "--axis", "3")),
}


@pytest.mark.parametrize("which", TWO)
def test_of_two_tuners_on_one_drive_the_second_is_refused_before_it_sends_anything(tmp_path, which):
    """Both were stopped half-way, since they took each other's answers; the second kept the first one's trial as the
    state before.
    """
    device, first, second = TWO[which]
    with served(device, "can", "lockstep") as (truth, address):
        before = parameters(device, address)
        folders = [tmp_path / "first", tmp_path / "second"]
        for folder in folders:
            folder.mkdir()
        processes = [start(first, device, address, folders[0])]
        try:
            wait_for(truth.is_on, processes[0])
            processes.append(start(second, device, address, folders[1]))
            said = [process.communicate(timeout=3 * PATIENCE) for process in processes]
        finally:
            for process in processes:
                if process.poll() is None:
                    process.kill()
                    process.communicate()
        assert processes[1].returncode == 1 and "another master commands the bus" in said[1][1], said[1]
        assert files(folders[1]) == [] and processes[0].returncode == 0, said[0]
        assert truth.is_off()
        check_left(truth, device, address, folders[0], said[0][1], before)
