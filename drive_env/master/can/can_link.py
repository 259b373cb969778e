"""The link over CAN: SDO, NMT and emergencies, PDOs that go with SYNC, error control (CiA 301)."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from functools import cached_property

from drive_env.canopen.frames import SYNC
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.link import ObjectClient, ReceivedEmergency, Wording
from drive_env.held_signals import held_signals
from drive_env.master.can.borrowed_identifiers import BorrowedIdentifiers
from drive_env.master.can.bus_time import BusTime
from drive_env.master.can.dry_run import DryPort, DrySdoClient
from drive_env.master.can.error_control import ErrorControls
from drive_env.master.can.network import PRE_OPERATIONAL, START, Network
from drive_env.master.can.other_masters import OtherMasters
from drive_env.master.can.pdo import PdoConfiguration
from drive_env.master.can.port import Port
from drive_env.master.can.process_data import PdoProcessData
from drive_env.master.can.sdo import SdoClient

_EMCY_COB_ID, _PRODUCER_HEARTBEAT = 0x1014, (0x1017, 0)
TIME_LOOK = 0.012  # s during which a drive in lockstep must not move on


class CanLink:
    """Nodes of one device on a CAN bus.

    Args:
        port: The bus; a `DryPort` for a dry run.
        nodes: Node-IDs.
        description: Their device.
        bus_time: Capacity of the bus in a cycle.
        twin_time: How much later than the first a second node with the same node-ID may answer [s].
    """

    def __init__(
        self,
        port: Port,
        nodes: Sequence[int],
        description: Description,
        bus_time: BusTime = BusTime(),  # noqa: B008
        twin_time: float = 0.0,
    ) -> None:
        self.port = port
        self._twin_time = twin_time
        self.nodes = tuple(nodes)
        self.is_dry = isinstance(port, DryPort)
        self.wording = Wording(
            "NMT operational", "check 1005h and 18xxh, and whether another master is on the bus", "heartbeats"
        )
        self._description = description
        self._alive: Callable[[], None] = lambda: None
        self._restarted: Callable[[int], None] = lambda node: None
        self._network = Network(port, self.nodes)
        self._network.on_restart = lambda node: self._restarted(self.nodes.index(node))
        self._clients: list[ObjectClient] = []
        if isinstance(port, DryPort):
            self._clients += [DrySdoClient(port, node, description) for node in self.nodes]
        else:
            clients = [SdoClient(port, node, lambda: self._alive()) for node in self.nodes]
            for client in clients:
                client.is_new = True
            self._network.on_boot = lambda node: clients[self.nodes.index(node)].forget()
            self._network.on_heartbeats_missed = lambda node: clients[self.nodes.index(node)].may_be_stopped()
            self._clients += clients
        borrowed = BorrowedIdentifiers(port, self.nodes, description.num_axes)
        pdos = [PdoConfiguration(*one, description, borrowed) for one in zip(self.nodes, self._clients, strict=True)]
        self.process = PdoProcessData(port, description, pdos, self.is_dry, bus_time)

    @cached_property
    def watch(self) -> ErrorControls:
        """The nodes' error control; heartbeats are listened to from the first use on."""
        return ErrorControls(self.port, self.nodes, self._clients, self._description)

    def hear(self, alive: Callable[[], None], restarted: Callable[[int], None]) -> None:
        """Set callbacks: `alive` while an answer is waited for, `restarted` for a node that booted unasked."""
        self._alive, self._restarted = alive, restarted

    # --- objects and states -----------------------------------------------------------------------------------------
    def sdo(self, node: int) -> ObjectClient:
        """Return a node's SDO client."""
        return self._clients[node]

    def wake(self, node: int) -> None:
        """Take a node to pre-operational, where it answers SDO requests."""
        self._network.command(PRE_OPERATIONAL, (self.nodes[node],))

    def welcome(self, node: int) -> None:
        """Receive a node's emergencies by the identifier in its 1014h; BusError if two nodes have its node-ID."""
        if self._description.has(_EMCY_COB_ID):
            cob_id = self._read(node, self._description.dictionary.find(_EMCY_COB_ID))
            self._network.move_emergencies(self.nodes[node], cob_id)
        client = self._clients[node]
        if isinstance(client, SdoClient):
            if self._twin_time > 0.0:
                self.port.wait(lambda: False, self._twin_time)
            client.check_alone()
            client.is_new = False

    def start(self, nodes: Sequence[int] | None = None) -> None:
        """Take nodes to NMT operational, all of them for None."""
        self._network.command(START, self.nodes if nodes is None else [self.nodes[k] for k in nodes])

    def reset(self, nodes: Sequence[int]) -> None:
        """Reset nodes (NMT reset node) and wait until they have booted.

        Raises:
            NoAnswerError: If a node sends no boot-up message.
        """
        self._network.reset([self.nodes[k] for k in nodes])

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies, in their order."""
        return self._network.take_emergencies()

    def time_passes(self) -> bool | None:
        """Return whether a drive sends heartbeats that are due although no SYNC is sent.

        Returns:
            None for drives that cannot send heartbeats.

        Raises:
            BusError: If the node does not answer.
        """
        if not self._description.has(_PRODUCER_HEARTBEAT):
            return None
        producer = self._description.dictionary.find(_PRODUCER_HEARTBEAT)
        beats: list[bytes] = []
        try:
            before = self._read(0, producer)
            self._network.on_error_control = lambda node, data: beats.append(data)
            with held_signals() as noted:
                self._write(0, producer, 1)
                self.port.drain()
                beats.clear()
                time.sleep(TIME_LOOK)
                self._read(0, producer)  # a late node sends due heartbeats before this answer
                self._write(0, producer, before)
            if noted:
                signal.raise_signal(noted[0])
        except ObjectAccessError:
            return None
        finally:
            self._network.on_error_control = None
        return len(beats) > 1

    def other_masters(self) -> OtherMasters:
        """Begin to listen for frames that only a master sends."""
        return OtherMasters(self.port, self.nodes)

    # --- cycles -----------------------------------------------------------------------------------------------------
    def hand_out(self, words: Sequence[tuple[int, Key, bytes]]) -> None:
        """Do nothing: a node answers SDOs one after the other, which follow each other as closely as the bus allows."""

    def sync(self) -> None:
        """Send SYNC."""
        self.port.send(SYNC)

    def receive(self, timeout: float = 0.0) -> bool:
        """Wait up to `timeout` [s] for a frame and hand it out; return whether one came."""
        return self.port.receive(timeout)

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Receive until `done()` is true or `timeout` [s] has passed; return done()."""
        return self.port.wait(done, timeout)

    def drain(self) -> None:
        """Process the received frames, without waiting."""
        self.port.drain()

    def close(self) -> None:
        """Close the bus if it is ours."""
        self.port.close()

    def _read(self, node: int, entry: Entry) -> int:
        """Read a numeric object that a node has once, not per axis."""
        known = self._description
        data = self._clients[node].read(entry.index, entry.sub, known.label(entry, 0), known.patience(entry))
        return int(known.decode(entry, data))

    def _write(self, node: int, entry: Entry, value: int) -> None:
        known, label = self._description, f"{value} to {self._description.label(entry, 0)}"
        data = known.encode(entry, value)
        self._clients[node].write(entry.index, entry.sub, data, label, known.patience(entry))
