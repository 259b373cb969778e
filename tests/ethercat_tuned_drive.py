"""Serves a drive on a network interface in real time, a machine with a flywheel on each axis, until it is ended.

python tests/ethercat_tuned_drive.py INTERFACE DEVICE
"""

from __future__ import annotations

import signal
import sys
import threading

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket
from drive_env.ethercat.world import EtherCatWorld


def main(interface: str, device: str) -> None:
    """Serve it."""
    world, is_over = EtherCatWorld(lockstep=False), threading.Event()
    drives = EmulatedDrives(device, "inertia", num_machines=find_device(device).num_axes, num_threads=1)
    drives.advance(0.002)  # compiled before time counts
    world.add(EtherCatSlave(CoeNode(drives), takes_time=True), drives)
    signal.signal(signal.SIGTERM, lambda *_: is_over.set())
    with EtherCatServer(world, RawSocket(interface)):
        print("1 slave", flush=True)
        is_over.wait()
    world.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
