"""The drive's watch over its master: it expects heartbeats (1016h) or life guarding (100Ch, 100Dh).

Each process sends heartbeats under a node-ID of its own: if two shared one, the drives would not notice the death of
either.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial

from drive_env import cia402
from drive_env.canopen.frames import ERROR_CONTROL
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.link import NoWatchdogError, ObjectClient
from drive_env.master.can.port import Port
from drive_env.master.changed_objects import REMEDY, ChangedObjects

logger = logging.getLogger(__name__)

MASTERS = range(96, 128)  # node-IDs under which masters of this library send their heartbeats
OPERATIONAL = 0x05
BEATS_PER_TIMEOUT = 3  # of which two may be lost
FIRST_BEATS = 3  # a drive watches from the first heartbeat received: a lost one must not be the only one
STAYS = 1  # 1029h:01: a communication error changes nothing (CiA 301, and the TMCM-1636)

_CONSUMERS, _GUARD_TIME, _LIFE_FACTOR, _ERROR_BEHAVIOUR = 0x1016, (0x100C, 0), (0x100D, 0), (0x1029, 1)


class Heartbeats:
    """Sends this process' heartbeats, and hears those of others.

    Args:
        port: The bus.
        nodes: Node-IDs of our drives.
    """

    def __init__(self, port: Port, nodes: Sequence[int]) -> None:
        self._port = port
        self._heard: dict[int, float] = {}
        self._nodes = tuple(nodes)
        self.node_id = 0  # set by `choose`
        for node in set(range(1, 128)) - set(nodes):
            port.subscribe(ERROR_CONTROL + node, partial(self._hear, node))

    def choose(self) -> None:
        """Choose a node-ID without heartbeats on the bus; two programs differ by their process numbers."""
        self._port.drain()
        if self.node_id and self.node_id not in self._heard:
            return
        start = os.getpid() % len(MASTERS)
        free = [MASTERS[(start + k) % len(MASTERS)] for k in range(len(MASTERS))]
        self.node_id = next(node for node in free if node not in self._heard and node not in self._nodes)

    @property
    def is_shared(self) -> bool:
        """Whether another program sends heartbeats under our node-ID."""
        return self.node_id in self._heard

    def is_alive(self, node: int, within: float) -> bool:
        """Wait up to `within` [s] for a heartbeat of a node; return whether one came."""
        since = time.monotonic()
        return self._port.wait(lambda: self._heard.get(node, -1.0) >= since, within)

    def send(self) -> None:
        """Send a heartbeat, unless another program was found to send under our node-ID."""
        if self.node_id:
            self._port.send(ERROR_CONTROL + self.node_id, bytes((OPERATIONAL,)))

    def _hear(self, node: int, data: bytes) -> None:
        self._heard[node] = time.monotonic()


def is_of_a_watchdog(index: int) -> bool:
    """Return whether a drive's watch over its master depends on an object (CiA 301; with 6007h, CiA 402)."""
    alone = index in (_CONSUMERS, *(key[0] for key in (_GUARD_TIME, _LIFE_FACTOR, _ERROR_BEHAVIOUR)))
    return alone or cia402.of_first_axis(index) == cia402.ABORT_CONNECTION_OPTION


class ErrorControl:
    """Configures the error control of one node, and restores it.

    Args:
        node: Node-ID.
        sdo: Its SDO client.
        description: Its device.
        heartbeats: The heartbeats of this process.
        guard: Sends the node a guarding request.

    Attributes:
        kind: "heartbeat", "life guarding" or "none".
        time: The silence after which the node acts [s].
    """

    def __init__(
        self, node: int, sdo: ObjectClient, description: Description, heartbeats: Heartbeats, guard: Callable[[], None]
    ) -> None:
        self._node = node
        self._description = description
        self._heartbeats = heartbeats
        self._guard = guard
        self._objects = ChangedObjects(node, sdo, description)
        self._watched_id = 0  # node-ID whose heartbeats the drive watches
        self.kind = "none"
        self.time = math.inf

    def configure(self, timeout: float) -> None:
        """Have the drive act when the master falls silent for `timeout` [s].

        Raises:
            NoWatchdogError: If the drive cannot, or watches another master that is alive.
            BusError: If the node does not answer.
        """
        milliseconds = round(1e3 * timeout)
        try:
            if consumers := self._consumers():
                self._watch_heartbeats(consumers, milliseconds)
                self.kind, self.time = "heartbeat", 1e-3 * milliseconds
            elif self._description.has(_GUARD_TIME) and self._description.has(_LIFE_FACTOR):
                guard_time = milliseconds // BEATS_PER_TIMEOUT
                self._objects.change(_GUARD_TIME, guard_time.to_bytes(2, "little"))
                self._objects.change(_LIFE_FACTOR, bytes((BEATS_PER_TIMEOUT,)))
                self.kind, self.time = "life guarding", 1e-3 * guard_time * BEATS_PER_TIMEOUT
            if self.kind != "none" and self._description.has(_ERROR_BEHAVIOUR):
                self._have_it_stop()
            self._objects.quick_stop_on_lost_connection()
        except ObjectAccessError as error:
            raise NoWatchdogError(f"node {self._node} cannot monitor its master: {error}; {REMEDY}") from None
        if self.kind == "none":
            raise NoWatchdogError(
                f"node {self._node} would not stop by itself when this process dies: it has neither a heartbeat "
                "consumer (1016h) nor life guarding (100Ch); to move it all the same, keep the emergency stop at hand "
                "and give --no-watchdog to jog, move or home, or open it in Python with Limits(silence=None)"
            )

    def _have_it_stop(self) -> None:
        """Make a communication error stop the node if 1029h leads elsewhere: pre-operational may stop no axis.

        For a drive with undocumented values of 1029h, 0 is written if a communication error would change nothing.
        """
        device = self._description.device
        known = {} if device is None else device.canopen.error_behaviour
        stops = [raw for raw, state in sorted(known.items()) if state == "STOPPED"]
        if not stops:
            self._objects.change(_ERROR_BEHAVIOUR, b"\0", only_from=bytes((STAYS,)))
            return
        for raw in known.keys() - set(stops):
            self._objects.change(_ERROR_BEHAVIOUR, bytes((stops[0],)), only_from=bytes((raw,)))

    def is_in_force(self) -> bool:
        """Ask the drive whether it still watches over this master, and return its answer.

        Raises:
            BusError: If the node does not answer.
        """
        if self.kind == "heartbeat" and self._watched_id != self._heartbeats.node_id:
            return False
        return self._objects.are_in_force()

    def holds(self, key: tuple[int, int]) -> bool:
        """Return whether the watchdog, if it is set, depends on an object."""
        return self.kind != "none" and (key == _ERROR_BEHAVIOUR or self._objects.holds(key))

    def before(self, key: tuple[int, int]) -> int | None:
        """Return the value that an object had before the watchdog was set; None for one that is its own."""
        return self._objects.before(key)

    def beat(self) -> None:
        """Send a guarding request, if the node has no heartbeat consumer."""
        if self.kind == "life guarding":
            self._guard()

    def restore(self) -> None:
        """Restore the objects. The caller has proved that the node's axes are off.

        The master's heartbeats must go on until then: a drive that still expects them would stop and no longer answer.

        Raises:
            BusError: If the drive did not accept all of them.
        """
        self._objects.restore()
        self.kind = "none"

    def forget(self) -> None:
        """Delete the stored settings: the node was reset."""
        self._objects.forget()
        self.kind = "none"

    def _consumers(self) -> list[tuple[int, int]]:
        return [(e.index, e.sub) for e in self._description.dictionary if e.index == _CONSUMERS and e.sub > 0]

    def _watch_heartbeats(self, consumers: Collection[tuple[int, int]], milliseconds: int) -> None:
        ours = (self._heartbeats.node_id << 16 | milliseconds).to_bytes(4, "little")
        living = []
        for key in consumers:
            raw = int.from_bytes(self._objects.read(key), "little")
            watched, period = raw >> 16 & 0x7F, raw & 0xFFFF
            if key in self._objects or not (watched and period) or watched == self._heartbeats.node_id:
                pass  # our own, or that of no node
            elif self._heartbeats.is_alive(watched, 1e-3 * period):
                living.append(watched)
                continue
            elif watched in MASTERS:
                logger.warning("node %d still monitors a master that is gone (node-ID %d)", self._node, watched)
            else:
                logger.warning(
                    "node %d monitors node-ID %d, which sends no heartbeat: replaced for now", self._node, watched
                )
            self._objects.change(key, ours, before=bytes(4) if watched in MASTERS else None)
            self._watched_id = self._heartbeats.node_id
            return
        raise NoWatchdogError(
            f"node {self._node} has another master, whose heartbeats still come (node-ID {living[0]}, 1016h); end "
            "that program first: two masters of one drive undo each other's stops"
        )


class Beats:
    """Sends heartbeats and guarding requests for all nodes when they are due.

    Args:
        heartbeats: The heartbeats of this process.
        controls: Error control of each node.
        timeout: Silence after which a drive acts [s].
        clock: Returns the time [s].
    """

    def __init__(
        self,
        heartbeats: Heartbeats,
        controls: Sequence[ErrorControl],
        timeout: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._heartbeats = heartbeats
        self._controls = controls
        self._period = timeout / BEATS_PER_TIMEOUT
        self._clock = clock
        self._next = 0.0
        self.has_ceased = False  # permanent: a drive that cannot be proved off is to stop by itself

    def begin(self) -> None:
        """Send several heartbeats or requests at once: a single one may be lost."""
        for _ in range(FIRST_BEATS):
            self._beat()

    def keep(self) -> None:
        """Send the heartbeats or requests that are due."""
        if not self.has_ceased and self._clock() >= self._next:
            self._beat()

    def cease(self) -> None:
        """Send the last heartbeats or requests: a node started meanwhile watches from these on, and then stops, too."""
        self.has_ceased = True
        self.begin()

    def _beat(self) -> None:
        self._next = self._clock() + self._period
        if any(control.kind == "heartbeat" for control in self._controls):
            self._heartbeats.send()
        for control in self._controls:
            control.beat()


class ErrorControls:
    """The error control of all nodes, and the heartbeats and requests that feed it.

    Args:
        port: The bus.
        nodes: Node-IDs.
        clients: The nodes' SDO clients.
        description: Their device.
    """

    def __init__(
        self, port: Port, nodes: Sequence[int], clients: Sequence[ObjectClient], description: Description
    ) -> None:
        self._heartbeats = Heartbeats(port, nodes)
        self._controls = [
            ErrorControl(node, sdo, description, self._heartbeats, partial(_ask_for_life, port, node))
            for node, sdo in zip(nodes, clients, strict=True)
        ]
        self._beats: Beats | None = None

    @property
    def detection_time(self) -> float:
        """The silence after which every node has noticed [s]; infinite while no watchdog is set."""
        return math.inf if self._beats is None else max(control.time for control in self._controls)

    def begin(self, silence: float) -> None:
        """Have every node act when its master falls silent for `silence` [s], and begin to send heartbeats.

        Raises:
            NoWatchdogError: If a drive cannot, or watches another master that is alive.
            BusError: If a node does not answer.
        """
        self._heartbeats.choose()
        for control in self._controls:
            control.configure(silence)
        self._beats = Beats(self._heartbeats, self._controls, silence)
        self._beats.begin()

    def keep(self) -> None:
        """Send the heartbeats that are due."""
        if self._beats is not None:
            self._beats.keep()

    def cease(self) -> None:
        """Send the last heartbeats, so that the drives, which watch from these on at the latest, stop by themselves."""
        if self._beats is not None:
            self._beats.cease()

    def end(self) -> None:
        """Send no more heartbeats, since the watchdogs are given up."""
        self._beats = None

    def is_set(self, node: int) -> bool:
        """Return whether a node's error control was set and not yet restored."""
        return self._controls[node].kind != "none"

    def is_in_force(self, node: int) -> bool:
        """Ask a node whether it still watches over this master, and return its answer.

        Raises:
            BusError: If the node does not answer.
        """
        return self._controls[node].is_in_force()

    def holds(self, key: tuple[int, int]) -> bool:
        """Return whether a watchdog that is set depends on an object."""
        return any(control.holds(key) for control in self._controls)

    def before(self, node: int, key: tuple[int, int]) -> int | None:
        """Return the value that an object of a node had before its watchdog was set; None for one that is its own."""
        return self._controls[node].before(key)

    def restore(self, node: int) -> None:
        """Restore a node's objects.

        Raises:
            BusError: If the node did not accept all of them.
        """
        self._controls[node].restore()

    def forget(self, node: int) -> None:
        """Forget the settings: the node was reset, and its error control has its own settings again."""
        self._controls[node].forget()

    def take_rival(self) -> str:
        """Return, once, the other program that sends heartbeats under our node-ID; "" if no other program does."""
        if not self._heartbeats.is_shared or self._beats is None:
            return ""
        node, self._heartbeats.node_id = self._heartbeats.node_id, 0  # another one at the next enabling
        return (
            f"another program sends heartbeats as node-ID {node}, too, so that the drives would not notice the death "
            "of either"
        )


def _ask_for_life(port: Port, node: int) -> None:
    """Send a guarding request to a node (CiA 301)."""
    port.send(ERROR_CONTROL + node, remote=True, length=1)
