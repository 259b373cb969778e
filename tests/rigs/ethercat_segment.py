"""Emulated drives behind slaves in this process, and a master of them; in lockstep, or by a thread in real time."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld
from drive_env.master.ethercat.frame_master import FrameMaster
from drive_env.master.ethercat.frame_ways import CallWay
from drive_env.master.ethercat_drives import EtherCatDrives

MOST_BEHIND = 0.01  # s


class EmulatedSegment:
    """Slaves in a line, the drives behind them, and the cable.

    Attributes:
        world: The slaves.
        is_connected: Frames come back.
        damage: Changes a frame on its way; None loses it.
    """

    def __init__(self, device="tmcm3313", number=1, lockstep=True, **machine):
        machine = {"load": "portal", "num_threads": 1} | machine
        cycle = 1.0 / find_device(device).communication_rate
        self.world = EtherCatWorld(lockstep=lockstep, cycle_time=cycle)
        for k in range(number):
            drives = EmulatedDrives(device, **machine)
            self.world.add(EtherCatSlave(CoeNode(drives), epoch=1000 * k), drives)
        self.world.drives[0].advance(max(0.002, cycle))  # compiled before time counts
        self.world.power_on()
        self.is_connected = True
        self.damage = lambda frame: frame
        self.turn = threading.RLock()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def slaves(self):
        return self.world.segment.slaves

    @property
    def drives(self):
        return self.world.drives[0]

    def receive(self, frame):
        with self.turn:
            frame = self.damage(frame) if self.is_connected else None
            return None if frame is None else self.world.receive(frame)

    def master(self):
        return FrameMaster(CallWay(self.receive))

    def _run(self):
        due = time.perf_counter()
        while not self._is_over.wait(max(due - time.perf_counter(), 0.0)):
            with self.turn:
                self.world.run_until(self.world.next_cycle)
            due = max(due + self.world.cycle_time, time.perf_counter() - MOST_BEHIND)

    def __enter__(self):
        if not self.world.lockstep:
            self._thread.start()
        return self

    def __exit__(self, *error):
        self._is_over.set()
        if not self.world.lockstep:
            self._thread.join()
        self.world.close()


@contextmanager
def linked(safety=True, pace="lockstep", nodes=(0,), timeout=None, **machine):
    """Drives of a master, and the segment that they are on."""
    number = max(nodes) + 1
    with (
        EmulatedSegment(number=number, lockstep=pace == "lockstep", **machine) as segment,
        EtherCatDrives(
            "tmcm3313", master=segment.master(), nodes=nodes, pace=pace, safety=safety, timeout=timeout
        ) as drives,
    ):
        yield drives, segment
