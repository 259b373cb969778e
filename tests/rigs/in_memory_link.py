"""A fieldbus that is none: a link which calls the nodes of emulated drives, and no CAN frame anywhere.

It is as little like CAN as a link can be: nodes have states of their own and a mailbox for their objects, and all
process data of a node are one packed image of each direction. A cycle lets time pass: no master dies on it, no frame is
lost, and nodes restart by command alone. What a link does where they are is tests/ethercat's.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from enum import Enum

import numpy as np

from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, ObjectAccessError
from drive_env.dictionary.access import check_readable, check_writable
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import NoAnswerError, refused
from drive_env.fieldbus.link import ReceivedEmergency, Wording
from drive_env.master.bus_drives import BusDrives
from drive_env.master.changed_objects import ChangedObjects
from drive_env.master.pace import LockstepPace
from drive_env.master.packing import Member, pack_rows, unpack_rows
from drive_env.node.axis import Axis
from drive_env.node.process_data import MappedObjects

CYCLE = 0.001  # s
IMAGE = 24  # bytes of an axis' image of either direction
FIRST_ADDRESS = 1001

State = Enum("State", "PREOP OP")  # in which a node has a mailbox; and images, too


class MemoryNode:
    """One emulated device: its mailbox and its images."""

    def __init__(self, drives, first_axis):
        self.device = drives.device
        self.state = State.PREOP
        self.emergencies = deque()
        self._drives = drives
        self._mine = np.zeros(drives.num_axes, bool)
        self._mine[first_axis : first_axis + self.device.num_axes] = True
        self._entries = self.device.new_dictionary()
        self._axes = [Axis(drives.inside.objects, first_axis + k) for k in range(self.device.num_axes)]
        self._outputs, self._inputs = MappedObjects([]), MappedObjects([])

    def port(self, index, sub):
        axis, base = self.device.locate(index)
        return self._axes[axis].port(self._entries.find((base, sub)))

    def upload(self, index, sub):
        port = self.port(index, sub)
        check_readable(port.entry)
        value = port.read()
        if isinstance(value, str):
            return value.encode()
        return value.to_bytes((port.entry.bits + 7) // 8, "little", signed=value < 0)

    def download(self, index, sub, data):
        port = self.port(index, sub)
        check_writable(port.entry)
        raw = int.from_bytes(data, "little", signed=port.entry.signed)
        port.check(raw)
        port.write(raw)

    def configure(self, outputs, inputs):
        """Take what its images hold, as (index, sub) of each object."""
        assert self.state is State.PREOP, "images are not changed while they are exchanged"
        self._outputs, self._inputs = (MappedObjects([self.port(*key) for key in keys]) for keys in (outputs, inputs))

    def exchange(self, outputs):
        """Take an image, None for none, and return the other; None in a state without process data."""
        if self.state is not State.OP:
            return None
        if outputs is not None:
            self._outputs.write(outputs)
        return self._inputs.pack()

    def after_cycle(self):
        for k, axis in enumerate(self._axes):
            for queued in axis.take_emergencies():
                row = self.device.emergencies[self.device.firmware.causes[queued.row].name].of_axis(k)
                self.emergencies.append((row.code, queued.error_register, tuple(row.extra)))

    def restart(self):
        self.state = State.PREOP
        self.configure((), ())
        self._drives.reset_node(self._mine)


class MemoryBus:
    """Nodes, and their time, which passes by cycles."""

    def __init__(self, drives):
        self.drives = drives
        self.nodes = [MemoryNode(drives, first) for first in range(0, drives.num_axes, drives.device.num_axes)]

    def cycle(self):
        self.drives.advance(CYCLE)
        for node in self.nodes:
            node.after_cycle()


class Mailbox:
    """The client for a node's objects."""

    def __init__(self, link, k):
        self._link, self._k = link, k

    def read(self, index, sub, label, timeout):
        return self._transfer(lambda node: node.upload(index, sub), f"the read of {label}")

    def write(self, index, sub, data, label, timeout):
        self._transfer(lambda node: node.download(index, sub, data), f"the write of {label}")

    put_back = write

    def ask(self, index, sub, timeout):
        with contextlib.suppress(ObjectAccessError):
            return self.read(index, sub, "a look", timeout)

    def command(self, index, sub, data):
        with contextlib.suppress(ObjectAccessError):  # nobody waits for an answer
            self._transfer(lambda node: node.download(index, sub, data), "a command")

    def _transfer(self, do, what):
        self._link.alive()
        try:
            return do(self._link.bus.nodes[self._k])
        except ObjectAccessError as error:
            raise refused(f"node {self._link.nodes[self._k]}", what, error.abort_code) from None


class Images:
    """Process data: one packed image of a node and direction."""

    def __init__(self, link, description):
        self.mapping = 0
        self._link = link
        self._known = description
        self._played = self._sampled = ()

    def check_sampled(self, entries):
        self._check(entries, "wo", "recorded")

    def check_played(self, entries):
        self._check(entries, "ro", "played")

    def choose(self, wanted, welcome, played=()):
        chosen = list(wanted)
        if self._size(chosen) > IMAGE:
            raise ObjectAccessError(PDO_LENGTH_EXCEEDED, f"{len(chosen)} objects are beyond {IMAGE} bytes; take fewer")
        for entry in welcome:
            if entry not in chosen and self._size([*chosen, entry]) <= IMAGE:
                chosen.append(entry)
        return tuple(chosen)

    def is_mapped(self, played, sampled):
        return (not played or played == self._played) and set(sampled) <= set(self._sampled)

    def map(self, played, sampled):
        self.mapping += 1
        self._played = played or self._played
        if not set(sampled) <= set(self._sampled):
            self._sampled = sampled
        for node in self._link.bus.nodes:
            before, node.state = node.state, State.PREOP
            node.configure(self._keys(self._played), self._keys(self._sampled))
            node.state = before

    def sampled_entries(self):
        return self._sampled

    def outputs(self, played):
        return OutputRows(self._link, self._members(self._played), played) if played else None

    def samples(self):
        return InputRows(self._link, self._members(self._sampled)) if self._sampled else None

    def forget(self, nodes):
        self.mapping += 1
        self._played = self._sampled = ()

    def before(self, node, key):
        return None

    def restore(self, node):
        self._link.bus.nodes[node].state = State.PREOP
        self._link.bus.nodes[node].configure((), ())

    def _check(self, entries, wrong_way, verb):
        for entry in entries:
            if not entry.pdo_mappable or entry.access in (wrong_way, "const"):
                raise ObjectAccessError(CANNOT_BE_MAPPED, f"{entry.label} cannot be {verb}")

    def _size(self, entries):
        return sum(entry.bits // 8 for entry in entries)

    def _keys(self, entries):
        return [self._known.key(entry, axis) for axis in range(self._known.num_axes) for entry in entries]

    def _members(self, entries):
        members, start = [], 0
        for axis in range(self._known.num_axes):
            for entry in entries:
                members.append(Member(entry, axis, start, entry.bits // 8))
                start += entry.bits // 8
        return members


class OutputRows:
    def __init__(self, link, members, played):
        self._link = link
        per_node = link.num_axes // len(link.nodes)
        self._images = [pack_rows(members, played, k * per_node) for k in range(len(link.nodes))]

    def send(self, row):
        self._link.next_outputs = [image[row].tobytes() for image in self._images]


class InputRows:
    def __init__(self, link, members):
        self._link, self._members = link, members
        self._images = [[] for _ in link.nodes]
        link.takers.append(self._images)

    def complete(self):
        return min(map(len, self._images))

    def decode(self, first, last):
        values, per_node = {}, self._link.num_axes // len(self._images)
        for k, images in enumerate(self._images):
            data = np.frombuffer(b"".join(images[first:last]), np.uint8).reshape(last - first, -1)
            unpack_rows(values, data, self._members, k * per_node, self._link.num_axes)
        return values

    def missing(self, rows, timeout):
        return NoAnswerError(f"{self.complete()} images came in {rows} cycles, and no more within {timeout:g} s")

    def close(self):
        self._link.takers.remove(self._images)


class ImageWatch:
    """The watch over the master: where time waits for it, no node has to notice that it is gone."""

    def __init__(self, link, description):
        self._objects = [ChangedObjects(node, link.sdo(k), description) for k, node in enumerate(link.nodes)]
        self._is_ours = [False] * len(link.nodes)
        self.detection_time = math.inf

    def begin(self, silence):
        self.detection_time = silence
        for k, objects in enumerate(self._objects):
            objects.quick_stop_on_lost_connection()
            self._is_ours[k] = True

    def keep(self):
        """Nobody waits for a sign of life."""

    def cease(self):
        self.detection_time = math.inf

    end = cease

    def is_set(self, node):
        return self._is_ours[node]

    def is_in_force(self, node):
        return self._objects[node].are_in_force()

    def holds(self, key):
        return any(ours and o.holds(key) for ours, o in zip(self._is_ours, self._objects, strict=True))

    def before(self, node, key):
        return self._objects[node].before(key)

    def restore(self, node):
        self._objects[node].restore()
        self._is_ours[node] = False

    def forget(self, node):
        self._objects[node].forget()
        self._is_ours[node] = False

    def take_rival(self):
        return ""


class NoOtherMasters:
    def check(self):
        """There is one master."""


class MemoryLink:
    """A link to the nodes of a `MemoryBus`."""

    def __init__(self, bus, description):
        self.bus = bus
        self.nodes = tuple(range(FIRST_ADDRESS, FIRST_ADDRESS + len(bus.nodes)))
        self.num_axes = bus.drives.num_axes
        self.is_dry = False
        self.wording = Wording("OP", "check the cable", "images")
        self.alive = lambda: None
        self.next_outputs = None
        self.takers = []
        self._clients = [Mailbox(self, k) for k in range(len(bus.nodes))]
        self.process = Images(self, description)
        self.watch = ImageWatch(self, description)

    def hear(self, alive, restarted):
        self.alive, self.restarted = alive, restarted

    def sdo(self, node):
        return self._clients[node]

    def wake(self, node):
        """None sleeps."""

    welcome = wake

    def start(self, nodes=None):
        for node in self.bus.nodes if nodes is None else [self.bus.nodes[k] for k in nodes]:
            node.state = State.OP

    def reset(self, nodes):
        for k in nodes:
            self.bus.nodes[k].restart()

    def take_emergencies(self):
        found = [ReceivedEmergency(address, *one) for address, node in zip(self.nodes, self.bus.nodes, strict=True)
                 for one in node.emergencies]  # fmt: skip
        for node in self.bus.nodes:
            node.emergencies.clear()
        return found

    def time_passes(self):
        return False

    def other_masters(self):
        return NoOtherMasters()

    def hand_out(self, words):
        """Leave it to the transfers."""

    def sync(self):
        """Exchange images with all nodes, and let a cycle pass."""
        outputs, self.next_outputs = self.next_outputs or [None] * len(self.nodes), None
        for k, node in enumerate(self.bus.nodes):
            inputs = node.exchange(outputs[k])
            if inputs is not None:
                for images in self.takers:
                    images[k].append(inputs)
        self.bus.cycle()

    def receive(self, timeout=0.0):
        return False  # images come with the cycle that asks for them

    def wait(self, done, timeout):
        return done()

    def drain(self):
        pass

    def close(self):
        pass


class MemoryDrives(BusDrives):
    """Drives over a `MemoryBus`, as `CanDrives` are over CAN."""

    def __init__(self, bus, *, safety=True):
        description = describe(bus.drives.device.name, None)
        super().__init__(MemoryLink(bus, description), description, LockstepPace(), safety)
