"""A fieldbus that is none: a link which calls the nodes of emulated drives, and no CAN frame anywhere.

It is as little like CAN as a link can be: nodes have states of their own and a mailbox for their objects, all process
data of a node are one packed image of each direction, and a node that gets none for as long as its process-data
watchdog says stops its axes. In lockstep a cycle lets time pass, otherwise a thread does by the clock.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from enum import Enum

import numpy as np

from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, ObjectAccessError
from drive_env.dictionary.access import check_readable, check_writable
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError, NoAnswerError, refused
from drive_env.fieldbus.link import NoWatchdogError, ReceivedEmergency, Wording
from drive_env.master.bus_drives import BusDrives, checked_limits
from drive_env.master.changed_objects import ChangedObjects
from drive_env.master.pace import LockstepPace, RealTimePace
from drive_env.master.packing import Member, pack_rows, unpack_rows
from drive_env.node.axis import Axis
from drive_env.node.process_data import MappedObjects

CYCLE = 0.001  # s
IMAGE = 24  # bytes of an axis' image of either direction
MOST_BEHIND = 0.01  # s
WATCHDOG_STEP = 0.04  # s in which a node counts
FIRST_ADDRESS = 1001

State = Enum("State", "PREOP SAFEOP OP")  # in which a node has a mailbox; and inputs; and outputs, too


class MemoryNode:
    """One emulated device: its mailbox, its images, its watchdog."""

    def __init__(self, drives, first_axis):
        self.device = drives.device
        self.state = State.PREOP
        self.watchdog = 0.0  # s; 0 watches nobody
        self.emergencies = deque()
        self.is_listening = True
        self.exchanged_at = self.lost_at = 0  # cycles at the last image, and when the master was found silent
        self._drives = drives
        self._mine = np.zeros(drives.num_axes, bool)
        self._mine[first_axis : first_axis + self.device.num_axes] = True
        self._entries = self.device.new_dictionary()
        self._axes = [Axis(drives.inside.objects, first_axis + k) for k in range(self.device.num_axes)]
        self._silent = 0.0
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

    def enter(self, state):
        self.state, self._silent = state, 0.0

    def configure(self, outputs, inputs):
        """Take what its images hold, as (index, sub) of each object."""
        assert self.state is State.PREOP, "images are not changed while they are exchanged"
        self._outputs, self._inputs = (MappedObjects([self.port(*key) for key in keys]) for keys in (outputs, inputs))

    def exchange(self, outputs, cycles):
        """Take an image, None for none, and return the other; None in a state without process data."""
        if self.state is not State.OP:
            return None
        self._silent, self.exchanged_at = 0.0, cycles
        if outputs is not None:
            self._outputs.write(outputs)
        return self._inputs.pack()

    def before_cycle(self, cycles):
        """Notice a master that is silent, before the cycle that would be one too many."""
        self._silent += CYCLE
        if self.state is State.OP and self.watchdog and self._silent > self.watchdog:
            self.enter(State.SAFEOP)
            self.lost_at = cycles
            for axis in self._axes:
                axis.trip()

    def after_cycle(self):
        for k, axis in enumerate(self._axes):
            for queued in axis.take_emergencies():
                row = self.device.emergencies[self.device.firmware.causes[queued.row].name].of_axis(k)
                self.emergencies.append((row.code, queued.error_register, tuple(row.extra)))

    def restart(self):
        self.enter(State.PREOP)
        self.watchdog = 0.0
        self.configure((), ())
        self._drives.reset_node(self._mine)


class MemoryBus:
    """Nodes, and their time: that of cycles in lockstep, else that of the clock, in a thread of `run`."""

    def __init__(self, drives, lockstep=True):
        per_node = drives.device.num_axes
        self.drives = drives
        self.lockstep = lockstep
        self.nodes = [MemoryNode(drives, first) for first in range(0, drives.num_axes, per_node)]
        self.is_connected = True  # the cable
        self.cycles = 0
        self.turn = threading.RLock()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def cycle(self):
        with self.turn:
            for node in self.nodes:
                node.before_cycle(self.cycles)
            self.drives.advance(CYCLE)
            self.cycles += 1
            for node in self.nodes:
                node.after_cycle()

    def let_pass(self, until, patience=60.0):
        """Return when `until()`, or so much later [s] on a computer that is busy otherwise."""
        deadline = time.monotonic() + patience
        while not until() and time.monotonic() < deadline:
            time.sleep(CYCLE)
        assert until()

    def _run(self):
        due = time.perf_counter()
        while not self._is_over.wait(max(due - time.perf_counter(), 0.0)):
            self.cycle()
            due = max(due + CYCLE, time.perf_counter() - MOST_BEHIND)  # a computer busy otherwise does not catch up

    def __enter__(self):
        if not self.lockstep:
            self._thread.start()
        return self

    def __exit__(self, *error):
        self._is_over.set()
        if not self.lockstep:
            self._thread.join()


class Mailbox:
    """The client for a node's objects."""

    def __init__(self, link, k):
        self._link, self._k = link, k

    def read(self, index, sub, label, timeout):
        return self._transfer(lambda node: node.upload(index, sub), f"the read of {label}", timeout)

    def write(self, index, sub, data, label, timeout):
        self._transfer(lambda node: node.download(index, sub, data), f"the write of {label}", timeout)

    put_back = write

    def ask(self, index, sub, timeout):
        try:
            return self.read(index, sub, "a look", timeout)
        except (BusError, ObjectAccessError):
            return None

    def command(self, index, sub, data):
        with contextlib.suppress(NoAnswerError, ObjectAccessError):  # nobody waits for an answer
            self._transfer(lambda node: node.download(index, sub, data), "a command", 0.0)

    def _transfer(self, do, what, timeout):
        self._link.alive()
        bus, where = self._link.bus, f"node {self._link.nodes[self._k]}"
        with bus.turn:
            if bus.is_connected and bus.nodes[self._k].is_listening:
                try:
                    return do(bus.nodes[self._k])
                except ObjectAccessError as error:
                    raise refused(where, what, error.abort_code) from None
        time.sleep(timeout)
        raise NoAnswerError(f"{where} did not answer {what} within {timeout:g} s; check its power")


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
        with self._link.bus.turn:
            for node in self._link.bus.nodes:
                before = node.state
                node.enter(State.PREOP)
                node.configure(self._keys(self._played), self._keys(self._sampled))
                node.enter(before)

    def sampled_entries(self):
        return self._sampled

    def outputs(self, played):
        return OutputRows(self._link, self._members(self._played), played) if played else None

    def samples(self):
        return InputRows(self._link, self._members(self._sampled)) if self._sampled else None

    def forget(self, nodes):
        self.mapping += 1
        self._played = self._sampled = ()

    def restore(self, node):
        with self._link.bus.turn:
            self._link.bus.nodes[node].enter(State.PREOP)
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
    """The watch over the master by a node's process-data watchdog, which counts in steps."""

    def __init__(self, link, description):
        self._link = link
        self._objects = [ChangedObjects(node, link.sdo(k), description) for k, node in enumerate(link.nodes)]
        self._time = math.inf
        self._is_ours = [False] * len(link.nodes)

    @property
    def detection_time(self):
        return self._time

    def begin(self, silence):
        self._time = max(math.floor(silence / WATCHDOG_STEP + 1e-6), 1) * WATCHDOG_STEP
        for k, (node, objects) in enumerate(zip(self._link.bus.nodes, self._objects, strict=True)):
            if not node.is_listening:
                raise NoWatchdogError(f"node {self._link.nodes[k]} is not there")
            objects.quick_stop_on_lost_connection()
            node.watchdog, self._is_ours[k] = self._time, True
        self.keep()

    def keep(self):
        if math.isfinite(self._time) and time.monotonic() - self._link.exchanged_at > self._time / 3.0:
            self._link.exchange(is_cycle=False)

    def cease(self):
        self._time = math.inf

    end = cease

    def is_set(self, node):
        return self._is_ours[node]

    def is_in_force(self, node):
        return self._link.bus.nodes[node].watchdog == self._time and self._objects[node].are_in_force()

    def holds(self, key):
        return any(ours and o.holds(key) for ours, o in zip(self._is_ours, self._objects, strict=True))

    def restore(self, node):
        self._objects[node].restore()
        self._link.bus.nodes[node].watchdog, self._is_ours[node] = 0.0, False

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
        self.exchanged_at = -math.inf
        self.takers = []
        self._clients = [Mailbox(self, k) for k in range(len(bus.nodes))]
        self.process = Images(self, description)
        self.watch = ImageWatch(self, description)

    def hear(self, alive, restarted):
        self.alive, self.restarted = alive, restarted

    def sdo(self, node):
        return self._clients[node]

    def wake(self, node):
        self.bus.nodes[node].is_listening = True

    def welcome(self, node):
        pass

    def start(self, nodes=None):
        with self.bus.turn:
            for node in self.bus.nodes if nodes is None else [self.bus.nodes[k] for k in nodes]:
                if self.bus.is_connected:
                    node.enter(State.OP)

    def reset(self, nodes):
        with self.bus.turn:
            for k in nodes:
                self.bus.nodes[k].restart()

    def lose_power(self, node):
        """Have a node restart by itself."""
        self.reset([node])
        self.restarted(node)

    def take_emergencies(self):
        with self.bus.turn:
            found = [ReceivedEmergency(address, *one) for address, node in zip(self.nodes, self.bus.nodes, strict=True)
                     for one in node.emergencies]  # fmt: skip
            for node in self.bus.nodes:
                node.emergencies.clear()
        return found

    def time_passes(self):
        before = self.bus.cycles
        time.sleep(5 * CYCLE)
        return self.bus.cycles > before

    def other_masters(self):
        return NoOtherMasters()

    def hand_out(self, words):
        """Leave it to the transfers."""

    def sync(self):
        self.exchange(is_cycle=True)
        if self.bus.lockstep:
            self.bus.cycle()

    def exchange(self, is_cycle):
        """Exchange images with all nodes; those that come outside a cycle are a sign of life and nobody's samples."""
        outputs = [None] * len(self.nodes)
        with self.bus.turn:
            if is_cycle and self.next_outputs is not None:
                outputs, self.next_outputs = self.next_outputs, None
            if not self.bus.is_connected:
                return
            self.exchanged_at = time.monotonic()
            for k, node in enumerate(self.bus.nodes):
                inputs = node.exchange(outputs[k], self.bus.cycles)
                if is_cycle and inputs is not None:
                    for images in self.takers:
                        images[k].append(inputs)

    def receive(self, timeout=0.0):
        if timeout:
            time.sleep(timeout)
        return False  # images come with the cycle that asks for them

    def wait(self, done, timeout):
        deadline = time.monotonic() + timeout
        while not done() and time.monotonic() < deadline:
            time.sleep(CYCLE)
        return done()

    def drain(self):
        pass

    def close(self):
        pass


class MemoryDrives(BusDrives):
    """Drives over a `MemoryBus`, as `CanDrives` are over CAN."""

    def __init__(self, bus, *, pace="lockstep", safety=True, timeout=None):
        description = describe(bus.drives.device.name, None)
        description.timeout = timeout
        checked_limits(safety)
        paced = LockstepPace() if pace == "lockstep" else RealTimePace(description.cycle)
        super().__init__(MemoryLink(bus, description), description, paced, safety)
