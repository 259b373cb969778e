"""A world: emulated machines, the nodes of their drives, one bus and one time."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Hashable, Sequence
from pathlib import Path
from typing import Protocol

from drive_env.bus.wire import Transmission, Wire
from drive_env.canopen.frames import SYNC, Frame
from drive_env.canopen.lss import UNCONFIGURED
from drive_env.canopen.node import Node
from drive_env.drives.interface import CYCLE
from drive_env.emulator.emulated_drives import EmulatedDrives

# Frames of a node that may wait for the bus, per axis; our choice, since no manual gives one. Further ones are lost.
TRANSMIT_BUFFER = 64
MAX_NODE_ID = 127


class BusNode(Protocol):
    """The calls of a world to a node; their meaning is described in drive_env/canopen/node.py."""

    def receive(self, frame: Frame, now: float) -> None:
        """Receive a frame of the bus."""

    def before_cycle(self, now: float) -> None:
        """Prepare for a communication cycle."""

    def after_cycle(self, now: float) -> None:
        """Send the results of a communication cycle."""

    def error_passive(self, now: float) -> None:
        """Note that its controller has become error passive."""

    def overrun(self, now: float, buffer: str) -> None:
        """Note that frames were lost in the "transmit" buffer."""

    def bus_off(self, now: float) -> None:
        """Note that its controller is bus-off."""

    def bus_on(self, now: float) -> None:
        """Note that its controller has recovered from bus-off."""

    def power_on(self, now: float) -> None:
        """Boot."""


class Beside(Protocol):
    """A second fieldbus of the same machines, which follows a world's time."""

    def begin_cycle(self) -> None:
        """Prepare for a communication cycle."""

    def end_cycle(self) -> None:
        """Handle the results of a communication cycle."""

    def pass_time(self, now: float) -> None:
        """Run everything due between cycles until `now` [s]."""

    def next_event(self) -> float:
        """Return when something is next due [s]."""


class World:
    """Nodes and their drives on one bus.

    In lockstep each SYNC from outside lets one communication cycle pass, and only SYNC does; frames take no time.
    Frames are handled one by one: all responses to a frame are sent before the next one, so a master that sends SYNC,
    SYNC and an SDO request knows by the answer that both cycles are over. Otherwise `run_until` sets the time, and
    frames take the wire's time.

    Attributes:
        nodes: Node identifier -> node; nodes that begin without one have numbers from 128 on here.
        drives: All emulated drives, each a set with its nodes.
        machines: Those of `drives` with a load, in the order in which they were added.
        listeners: Called with each frame that all nodes received.
        before_cycle: Called at the beginning of a communication cycle; they may send by the wire.
        beside: Another fieldbus of these drives, which follows this world's time; None without one.
        time: Time since the world began [s].
        cycles: Communication cycles that have passed.

    Args:
        lockstep: Time advances by SYNC.
        wire: The bus; by default one of 1 Mbit/s without faults, instant in lockstep.
    """

    def __init__(self, *, lockstep: bool = True, wire: Wire | None = None) -> None:
        self.lockstep = lockstep
        self.wire = wire if wire is not None else Wire(instant=lockstep)
        self.nodes: dict[int, BusNode] = {}
        self.drives: list[EmulatedDrives] = []
        self.machines: list[EmulatedDrives] = []
        self.listeners: list[Callable[[Transmission], None]] = []
        self.before_cycle: list[Callable[[], None]] = []
        self.beside: Beside | None = None
        self.time = 0.0
        self.cycles = 0
        self._answering: list[Node] = []  # nodes with SDO answers that take time
        self._synchronised: list[Node] = []  # nodes that react to SYNC, each with its own identifier
        self._room: dict[int, int] = {}  # node identifier -> frames that may wait
        self._on: set[int] = set()
        self._overflowed: set[int] = set()
        self._off: dict[int, float] = {}  # node identifier -> when its controller has recovered [s]

    def add(
        self,
        drives: EmulatedDrives,
        node_ids: Sequence[int],
        store: Path | None = None,
        elsewhere: Collection[int] = (),
    ) -> list[Node]:
        """Put drives on the bus, one node per device, and return the nodes.

        Axes of the last node beyond those of the machines have no motor connected.

        Args:
            drives: The drives; machines of several one-axis devices have as many nodes as axes.
            node_ids: Identifiers 1 to 127 in the order of the axes; 255, of devices with LSS, for a node without one.
            store: Folder of the nodes' stored values; None: they last as long as the world.
            elsewhere: Numbers of the devices, from 0 in the order of the axes, that are not on this bus.

        Raises:
            ValueError: For identifiers that are taken, out of range, or too few or too many; for a bit rate of the wire
                that the device does not have.
        """
        per_node = drives.device.num_axes
        needed = -(-drives.num_axes // per_node)
        here = [k for k in range(needed) if k not in elsewhere]
        if len(node_ids) != len(here):
            raise ValueError(
                f"{drives.num_axes} axes ({drives.num_machines} x load {drives.load.name!r}) take {needed} nodes of "
                f"{drives.device.name}, which drives {per_node} axes{self._told(needed - len(here))}; "
                f"{len(node_ids)} node identifiers were given: give {len(here)}, or another load or number of machines"
            )
        left_over = needed * per_node - drives.num_axes if needed - 1 in here else 0
        spare = without_motors(drives, left_over) if left_over else None
        nodes: list[Node] = []
        for k, given in zip(here, node_ids, strict=True):
            is_new = given == UNCONFIGURED and drives.device.canopen.services.lss
            node_id = max([MAX_NODE_ID, *self.nodes]) + 1 if is_new else given
            path = None if store is None else store / f"node-{node_id}-{Path(drives.device.name).stem}.json"

            def make(
                send: Callable[[Frame], None],
                k: int = k,
                path: Path | None = path,
                node_id: int = node_id,
                given: int = given,
            ) -> Node:
                bit_rate = round(self.wire.bit_rate)
                real = not self.lockstep  # docs/decisions/bus.md explains why nothing takes time in lockstep
                node = Node(
                    given, drives, k * per_node, send=send, store=path, bit_rate=bit_rate, takes_time=real,
                    spare=spare if k == needed - 1 else None, serial=node_id,
                    has_room=lambda: self.wire.waiting(("node", node_id)) < self._room_of(node_id) // 2,
                )  # fmt: skip
                nodes.append(node)
                return node

            self._room[node_id] = TRANSMIT_BUFFER * per_node
            (self._attach if is_new else self.attach)(node_id, make)
            self._synchronised.append(nodes[-1])
            axes = slice(k * per_node, (k + 1) * per_node)
            drives.machine.connect_lamps(axes, self._lamps_of(nodes[-1], node_id))
        self.drives += [drives] if spare is None else [drives, spare]
        self.machines.append(drives)
        self._answering += nodes
        return nodes

    @staticmethod
    def _told(elsewhere: int) -> str:
        return f" ({elsewhere} of them on EtherCAT)" if elsewhere else ""

    def attach(self, node_id: int, make: Callable[[Callable[[Frame], None]], BusNode]) -> None:
        """Put a node on the bus, built by `make` from the function by which it sends; ValueError for a used node-ID."""
        if not 1 <= node_id <= MAX_NODE_ID:
            raise ValueError(f"node {node_id} is out of range; identifiers are 1 to {MAX_NODE_ID}")
        if node_id in self.nodes:
            raise ValueError(f"node {node_id} is on the bus already; give each its own identifier, 1 to {MAX_NODE_ID}")
        self._attach(node_id, make)

    def _attach(self, node_id: int, make: Callable[[Callable[[Frame], None]], BusNode]) -> None:
        self.nodes[node_id] = make(lambda frame: self._send(node_id, frame))

    def power_on(self) -> None:
        """Switch on all nodes that are off; in lockstep they have booted afterwards."""
        for node_id in [node_id for node_id in self.nodes if node_id not in self._on]:
            self._on.add(node_id)
            self.nodes[node_id].power_on(self.time)
        if self.lockstep:
            self._settle()

    def receive(self, frame: Frame, sender: Hashable = "master", *, extended: bool = False) -> None:
        """Receive a frame from outside, at the world's time.

        Args:
            frame: The frame.
            sender: Its sender; the frames of one sender keep their order.
            extended: Whether it has a 29-bit identifier; nodes ignore it.
        """
        self.wire.send(frame, sender, self.time, extended)
        if self.lockstep:
            self._settle()
            # A SYNC that the wire loses still lets time pass: only the nodes miss it.
            if not extended and self._is_sync(frame):
                self.cycle()
                self._settle()

    def run_until(self, now: float, begins: Callable[[float], None] | None = None, early: float = 0.0) -> None:
        """Run all events due until `now` [s], in their order; not in lockstep.

        Args:
            now: New time of the world [s].
            begins: Called at the beginning of a communication cycle, with its due time [s].
            early: Events due within this time [s] after `now` happen already.
        """
        until = now + early
        while True:
            cycle, event, answer = self.next_cycle, self.wire.next_event(), self._next_answer()
            if answer <= until and answer <= min(cycle, event):
                self.time = max(self.time, answer)
                for node in self._answering:
                    node.answer(self.time)
            elif event <= until and event <= cycle:
                self.time = max(self.time, event)
                self._pass_on(self.wire.take(event))
            elif cycle <= until:
                if begins is not None:
                    begins(cycle)
                self.cycle()
            else:
                break
        self.time = max(self.time, now)
        if self.beside is not None:
            self.beside.pass_time(self.time)

    @property
    def next_cycle(self) -> float:
        """When the next communication cycle ends [s]."""
        return (self.cycles + 1) * CYCLE

    def next_event(self) -> float:
        """Return when `run_until` next has something to do [s]."""
        beside = math.inf if self.beside is None else self.beside.next_event()
        return min(self.next_cycle, self.wire.next_event(), self._next_answer(), beside)

    def cycle(self) -> None:
        """Let one communication cycle of 1 ms pass."""
        for due in self.before_cycle:
            due()
        for node_id in [node_id for node_id, back in self._off.items() if back <= self.time]:
            del self._off[node_id]
            self.nodes[node_id].bus_on(self.time)
        for node_id in [i for i in self._overflowed if self.wire.waiting(("node", i)) < self._room_of(i) // 2]:
            self._overflowed.remove(node_id)
            self.nodes[node_id].overrun(self.time, "transmit")
        for node in self.nodes.values():
            node.before_cycle(self.time)
        if self.beside is not None:
            self.beside.begin_cycle()
        for drives in self.drives:
            drives.advance(CYCLE)
        self.cycles += 1
        self.time = self.cycles * CYCLE
        if self.beside is not None:
            self.beside.end_cycle()
        for node in self.nodes.values():
            node.after_cycle(self.time)

    def take_off_bus(self, node_id: int, until: float) -> None:
        """Take a node off the bus until `until` [s], at least as long as its controller needs to recover."""
        until = max(until, self.time + self.wire.recovery_time)
        self.wire.silence(("node", node_id), until)
        self._off[node_id] = until
        self.nodes[node_id].bus_off(self.time)

    def let_recover(self, node_id: int) -> None:
        """Let a node that is bus-off recover at the beginning of the next communication cycle."""
        if node_id in self._off:
            self.wire.silence(("node", node_id), self.time)
            self._off[node_id] = self.time

    def load(self) -> float:
        """Return the share of time in which the bus was busy."""
        return self.wire.statistics.load(self.wire.bit_rate, self.time)

    def close(self) -> None:
        """End the drives."""
        for drives in self.drives:
            drives.close()

    def _lamps_of(self, node: Node, node_id: int) -> Callable[[], tuple[str, str]]:
        return lambda: node.leds(self.wire.error_counter(("node", node_id)))

    # --- inside ---------------------------------------------------------------------------------------------------
    def _next_answer(self) -> float:
        return min((node.next_answer for node in self._answering), default=math.inf)

    def _room_of(self, node_id: int) -> int:
        """Return the number of a node's frames that may wait."""
        return self._room.get(node_id, TRANSMIT_BUFFER)

    def _send(self, node_id: int, frame: Frame) -> None:
        sender = ("node", node_id)
        if self.wire.waiting(sender) < self._room_of(node_id):
            self.wire.send(frame, sender, self.time)
        else:  # the node is notified once there is room for its emergency
            self._overflowed.add(node_id)
            self.wire.statistics.lost += 1

    def _is_sync(self, frame: Frame) -> bool:
        """Return whether a frame is a SYNC to the nodes, with or without a counter (1005h can be changed)."""
        if frame.rtr or len(frame.data) > 1:
            return False
        if not self._synchronised:
            return frame.can_id == SYNC
        return any(frame.can_id == node.sync_id for node in self._synchronised)

    def _settle(self) -> None:
        """Carry frames until no frame, nor a segment of a block upload, is ready at this time."""
        while True:
            while (ended := self.wire.take(self.time)) is not None:
                self._pass_on(ended)
            if self._next_answer() > self.time:
                return
            for node in self._answering:
                node.answer(self.time)
            if self.wire.next_event() > self.time:  # no node could send one
                return

    def _pass_on(self, ended: Transmission | None) -> None:
        if ended is None:
            return
        sender = ended.sender[1] if isinstance(ended.sender, tuple) and ended.sender[0] == "node" else None
        if ended.outcome == "received":
            if not ended.extended:
                for node_id, node in self.nodes.items():
                    if node_id != sender:
                        node.receive(ended.frame, self.time)
            for listener in self.listeners:
                listener(ended)
        elif sender is not None and ended.outcome == "error passive":
            self.nodes[sender].error_passive(self.time)
        elif sender is not None and ended.outcome == "bus off":
            self._off[sender] = self.time + self.wire.recovery_time
            self.nodes[sender].bus_off(self.time)


def without_motors(drives: EmulatedDrives, number: int) -> EmulatedDrives:
    """Return axes of the same device with factory values and open phases, for axes without a motor."""
    open_phases = {"motor.open_a": 1.0, "motor.open_b": 1.0}
    return EmulatedDrives(
        drives.device.name, "inertia", drives.motor, number, commissioned=False, parameters=open_phases, num_threads=1
    )
