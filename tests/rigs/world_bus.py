"""Emulated drives at the other end of a python-can bus, all in the caller's thread, or behind a hub."""

from __future__ import annotations

import math
import uuid
from collections import deque
from contextlib import contextmanager

import can
import numpy as np

from drive_env import CanDrives, EmulatedDrives
from drive_env.bus.can_port import CanPort
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from rigs.socketcan import CHANNEL


class WorldBus(can.BusABC):
    """A python-can bus with a world at its other end, all in the caller's thread."""

    def __init__(self, world):
        super().__init__(channel="world")
        self._world = world
        self._waiting = deque()
        world.power_on()
        world.listeners.append(self._hear)

    def send(self, msg, timeout=None):
        self._world.receive(Frame(msg.arbitration_id, bytes(msg.data), msg.is_remote_frame))

    def _hear(self, ended):
        if ended.sender != "master":
            frame = ended.frame
            self._waiting.append(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    def _recv_internal(self, timeout):
        return (self._waiting.popleft() if self._waiting else None), True

    def fileno(self):
        raise NotImplementedError


@contextmanager
def bus_of(emulated, nodes, *, stay=False):
    """A bus in lockstep with nodes of emulated drives, which end with it unless they `stay`."""
    world = World(lockstep=True)
    world.add(emulated, list(nodes))
    bus = WorldBus(world)
    try:
        yield bus
    finally:
        bus.shutdown()
        if not stay:
            world.close()


@contextmanager
def on_bus(emulated, nodes=None, *, stay=False, **options):
    """Emulated drives on a bus in lockstep, by our master: by default as nodes 1 and so on, of a device that it knows.

    Args:
        emulated: The drives, which end with the bus unless they `stay`.
        nodes: The numbers of their nodes.
        options: The master's.
    """
    nodes = nodes or range(1, 1 + math.ceil(emulated.num_axes / emulated.device.num_axes))
    known = {"device": emulated.device.name} | options
    with bus_of(emulated, nodes, stay=stay) as bus, CanDrives(bus=bus, nodes=nodes, pace="lockstep", **known) as drives:
        yield drives


@contextmanager
def served(how, nodes=(1,), safety=True, **machine):
    """Emulated drives behind a bus, as CanDrives."""
    emulated = EmulatedDrives(num_threads=1, **machine)
    if how == "calls":
        with on_bus(emulated, nodes, safety=safety) as drives:
            yield drives
        return
    world = World(lockstep=True)
    world.add(emulated, list(nodes))
    options = {"nodes": nodes, "pace": "lockstep", "safety": safety}
    try:
        if how == "hub":
            port = Hub()
            where = {"channel": port.channel}
        else:
            where = {"interface": how, "channel": CHANNEL if how == "socketcan" else str(uuid.uuid4())}
            port = CanPort(can.Bus(**where))
        with Server(world, port), CanDrives(**where, **options) as drives:
            yield drives
    finally:
        world.close()


def assert_equal(expected, found):
    assert len(expected) == len(found)
    for k, (a, b) in enumerate(zip(expected, found, strict=True)):
        assert a.shape == b.shape
        wrong = np.argwhere(a != b)
        assert not wrong.size, f"part {k}: first difference at object, cycle, axis {wrong[0]}: {a[tuple(wrong[0])]}, " \
            f"on the bus {b[tuple(wrong[0])]}"  # fmt: skip
