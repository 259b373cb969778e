"""A drive served on EtherCAT over UDP."""

from __future__ import annotations

from contextlib import contextmanager

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import UdpSocket
from drive_env.ethercat.world import EtherCatWorld


@contextmanager
def served(device):
    """Serve a drive, a machine on each axis; yields the UDP port and the emulated drives."""
    world = EtherCatWorld()
    drives = EmulatedDrives(device, "inertia", num_machines=find_device(device).num_axes, num_threads=1)
    world.add(EtherCatSlave(CoeNode(drives)), drives)
    # Compiled before a frame comes: one that waits too long is sent again, and a cycle more passes.
    drives.advance(0.002)
    drives.machine.reset()
    with EtherCatServer(world, UdpSocket(0)) as server:
        yield str(server.way.port), drives
    world.close()
