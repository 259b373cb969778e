"""Serves echo devices on a raw socket until its input ends: python tests/ethercat_echo.py INTERFACE NUMBER."""

from __future__ import annotations

import sys
from pathlib import Path

from rigs.ethercat_rig import EchoDevice

from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.pcap_log import PcapLog
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket
from drive_env.ethercat.world import EtherCatWorld


def main(interface: str, number: int, log: str) -> None:
    """Serve in real time."""
    world = EtherCatWorld(lockstep=False)
    for k in range(number):
        world.add(EtherCatSlave(EchoDevice(), takes_time=True, drift=20e-6 * k, epoch=12_345_678 * k))
    with PcapLog(Path(log)) as frames:
        world.segment.listeners.append(frames.add)
        with EtherCatServer(world, RawSocket(interface)):
            print("ready", flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
