"""A virtual cable is taken down while three axes move, again and again; says as JSON how they stopped. Takes root.

python tests/ethercat_cable.py COUNT
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from drive_env import EmulatedDrives, Limits, ObjectAccessError, SafetyError, motion
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.namespaces import Namespaces
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket
from drive_env.ethercat.world import EtherCatWorld
from drive_env.fieldbus.errors import BusError
from drive_env.master.ethercat_drives import EtherCatDrives

SILENCE = 0.3  # s
MOVING, AT_REST = 1.0, 0.02  # rad/s
PATIENCE = 300.0  # s
LOOK = 0.0005  # s


def await_that(done) -> float:
    """Wait until `done()`, and return how long it took [s]."""
    begun = time.monotonic()
    while not done():
        if time.monotonic() - begun > PATIENCE:
            raise TimeoutError(f"nothing within {PATIENCE:g} s")
        time.sleep(LOOK)
    return time.monotonic() - begun


def link(interface: str, state: str) -> None:
    subprocess.run(["ip", "link", "set", interface, state], check=True)


def pull(world: EtherCatWorld, drives: EmulatedDrives, interface: str) -> dict[str, float] | None:
    """Take the cable down in motion, and up again, until all axes move again; times but `back` are the drives' [s].

    None: the master had left Op just before, by its own envelope, on a computer that is too busy.
    """
    (slave,) = world.segment.slaves
    speeds = drives.machine

    def moves() -> bool:
        return slave.state is AlState.OP and bool((np.abs(speeds.rotor_speed) > MOVING).all())

    await_that(moves)
    link(interface, "down")
    down, watchdog = world.time, slave.controller.watchdog_time
    await_that(lambda: slave.state is not AlState.OP)
    left = world.time
    if (slave.state, slave.code) != (AlState.SAFE_OP, AlStatusCode.SM_WATCHDOG):
        link(interface, "up")
        return None
    await_that(lambda: bool((np.abs(speeds.rotor_speed) < AT_REST).all()))
    at_rest = world.time
    link(interface, "up")
    return {"watchdog": watchdog, "left_op": left - down, "at_rest": at_rest - down, "back": await_that(moves)}


def serve(interface: str, count: int) -> None:
    """Be the drive, and whoever pulls the cable."""
    world = EtherCatWorld(lockstep=False)
    drives = EmulatedDrives("tmcm3313", "portal", num_threads=1)
    drives.advance(0.002)
    world.add(EtherCatSlave(CoeNode(drives), takes_time=True), drives)
    with EtherCatServer(world, RawSocket(interface)):
        print("ready", flush=True)
        while count > 0:
            pulled = pull(world, drives, interface)
            if pulled is not None:
                count -= 1
                print(json.dumps(pulled), flush=True)
    world.close()


def move(interface: str) -> None:
    """Be the master: move to and fro; after each error begin anew."""
    while True:
        with (
            suppress(BusError, SafetyError, ObjectAccessError, RuntimeError, TimeoutError),
            EtherCatDrives("tmcm3313", channel=interface, safety=Limits(silence=SILENCE), timeout=5.0) as drives,
        ):
            motion.enable(drives, mode="csv")
            for sign in (1, -1) * 1000:
                drives.record([0x6041], 0.4, {0x60FF: np.full((400, 3), sign * 30_000)})
        time.sleep(0.05)


def main(count: int) -> Iterator[dict[str, float]]:
    """Yield what happened, pull by pull."""
    number = os.getpid() % 100_000
    spaces = Namespaces(f"cable-{number}", f"pulls-{number}", "veth1", "veth0")
    spaces.make()
    processes = []
    try:
        for space, *words in ((spaces.slave, "serve", "veth1", str(count)), (spaces.master, "move", "veth0")):
            program = ["ip", "netns", "exec", space, sys.executable, __file__, *words]
            processes.append(subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True))
            if words[0] == "serve":
                assert processes[0].stdout.readline() == "ready\n"
        for _ in range(count):
            yield json.loads(processes[0].stdout.readline())
    finally:
        for process in processes:
            process.kill()
            process.wait()
            process.stdout.close()
        spaces.remove()


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2], int(sys.argv[3]))
    elif sys.argv[1] == "move":
        move(sys.argv[2])
    else:
        for number, one in enumerate(main(int(sys.argv[1])), 1):
            print(f"{number}: {json.dumps(one)}", flush=True)
