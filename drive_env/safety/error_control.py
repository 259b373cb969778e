"""What the drive does when its master dies: it misses heartbeats (1016h) or its life is not guarded (100Ch, 100Dh).

Each process sends heartbeats under a node-ID of its own: two that shared one would hide each other's death.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial

from drive_env import cia402
from drive_env.canopen.frames import ERROR_CONTROL
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.master.description import Description
from drive_env.master.errors import BusError
from drive_env.master.port import Port
from drive_env.master.sdo import SdoClient
from drive_env.master.tidying import Tidying

logger = logging.getLogger(__name__)

MASTERS = range(96, 128)  # node-IDs under which masters of this library send their heartbeats
OPERATIONAL = 0x05
BEATS_PER_TIMEOUT = 3  # of which two may be lost
FIRST_BEATS = 3  # a drive watches from the first heartbeat that it gets on: one that is lost must not be the only one
STAYS = 1  # 1029h:01: a communication error changes nothing (CiA 301, and the TMCM-1636)

# 6007h, what an axis does when its connection is lost (CiA 402): nothing, or the quick stop.
_ABORT_CONNECTION, NO_ACTION, QUICK_STOP_THEN = (cia402.ABORT_CONNECTION_OPTION, 0), b"\0\0", b"\3\0"
_CONSUMERS, _GUARD_TIME, _LIFE_FACTOR, _ERROR_BEHAVIOUR = 0x1016, (0x100C, 0), (0x100D, 0), (0x1029, 1)


class NoWatchdogError(BusError):
    """A drive cannot watch over its master; the message says why and what to do."""


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
        self.node_id = 0  # ours, once `choose` has found one
        for node in set(range(1, 128)) - set(nodes):
            port.subscribe(ERROR_CONTROL + node, partial(self._hear, node))

    def choose(self) -> None:
        """Take a node-ID that nobody is heard under; the process' number makes two choose two."""
        self._port.drain()
        if self.node_id and self.node_id not in self._heard:
            return
        start = os.getpid() % len(MASTERS)
        free = [MASTERS[(start + k) % len(MASTERS)] for k in range(len(MASTERS))]
        self.node_id = next(node for node in free if node not in self._heard and node not in self._nodes)

    @property
    def is_shared(self) -> bool:
        """Whether somebody else sends heartbeats under our node-ID."""
        return self.node_id in self._heard

    def is_alive(self, node: int, within: float) -> bool:
        """Wait up to `within` [s] for a heartbeat of somebody; return whether one came."""
        since = time.monotonic()
        return self._port.wait(lambda: self._heard.get(node, -1.0) >= since, within)

    def send(self) -> None:
        """Send one, unless somebody else was found to send under our node-ID."""
        if self.node_id:
            self._port.send(ERROR_CONTROL + self.node_id, bytes((OPERATIONAL,)))

    def _hear(self, node: int, data: bytes) -> None:
        self._heard[node] = time.monotonic()


class ErrorControl:
    """Configures the error control of one node, and puts it back.

    Args:
        node: Node-ID.
        sdo: Its SDO client.
        description: What device it is.
        heartbeats: Those of this process.
    """

    def __init__(self, node: int, sdo: SdoClient, description: Description, heartbeats: Heartbeats) -> None:
        self._node = node
        self._sdo = sdo
        self._description = description
        self._heartbeats = heartbeats
        self._before: dict[tuple[int, int], bytes] = {}
        self._set: dict[tuple[int, int], bytes] = {}
        self._watched_id = 0  # node-ID whose heartbeats the drive watches
        self.kind = "none"  # or "heartbeat", "life guarding"

    def configure(self, timeout: float) -> None:
        """Have the drive act when the master falls silent for `timeout` [s].

        Raises:
            NoWatchdogError: If the drive cannot, or watches over another master that lives.
            BusError: If the node does not answer.
        """
        milliseconds = round(1e3 * timeout)
        try:
            if consumers := self._consumers():
                self._watch_heartbeats(consumers, milliseconds)
                self.kind = "heartbeat"
            elif self._description.has(_GUARD_TIME) and self._description.has(_LIFE_FACTOR):
                self._change(_GUARD_TIME, (milliseconds // BEATS_PER_TIMEOUT).to_bytes(2, "little"))
                self._change(_LIFE_FACTOR, bytes((BEATS_PER_TIMEOUT,)))
                self.kind = "life guarding"
            if self.kind != "none" and self._description.has(_ERROR_BEHAVIOUR):
                self._change(_ERROR_BEHAVIOUR, b"\0", only_from=bytes((STAYS,)))
            if self._description.has(_ABORT_CONNECTION):
                entry = self._description.dictionary.find(_ABORT_CONNECTION)
                for part in range(self._description.num_axes):
                    key = self._description.key(entry, part)
                    self._change(key, QUICK_STOP_THEN, only_from=NO_ACTION)
        except ObjectAccessError as error:
            raise NoWatchdogError(f"node {self._node} cannot monitor its master: {error}; {_REMEDY}") from None
        if self.kind == "none":
            raise NoWatchdogError(
                f"node {self._node} would not stop by itself when this process dies: it has neither a heartbeat "
                f"consumer (1016h) nor life guarding (100Ch); {_REMEDY}"
            )

    def is_in_force(self) -> bool:
        """Return whether the drive, asked, still watches over this master.

        Raises:
            BusError: If the node does not answer.
        """
        if self.kind == "heartbeat" and self._watched_id != self._heartbeats.node_id:
            return False
        return all(self._read(key)[: len(data)] == data for key, data in self._set.items())

    def beat(self) -> None:
        """Ask for the node's life, where it has no heartbeat consumer."""
        if self.kind == "life guarding":
            self._sdo.guard()

    def restore(self) -> None:
        """Put the objects back as they were. Whoever calls has proved that the node's axes are off.

        The master's heartbeats must go on until then: a drive that still waits for them, and misses them, stops, and
        answers no more.

        Raises:
            BusError: If the drive did not take all of them.
        """
        before, self._before = self._before, {}
        self._set.clear()
        tidying = Tidying()
        for (index, sub), data in before.items():
            label = f"{index:04X}h:{sub:02X}"
            tidying.step(partial(self._sdo.put_back, index, sub, data, label, self._description.answer_timeout))
        tidying.end()
        self.kind = "none"

    def forget(self) -> None:
        """Forget what was: the node was reset."""
        self._before.clear()
        self._set.clear()
        self.kind = "none"

    def _consumers(self) -> list[tuple[int, int]]:
        return [(e.index, e.sub) for e in self._description.dictionary if e.index == _CONSUMERS and e.sub > 0]

    def _watch_heartbeats(self, consumers: Collection[tuple[int, int]], milliseconds: int) -> None:
        ours = (self._heartbeats.node_id << 16 | milliseconds).to_bytes(4, "little")
        living = []
        for key in consumers:
            raw = int.from_bytes(self._read(key), "little")
            watched, period = raw >> 16 & 0x7F, raw & 0xFFFF
            if key in self._before or not (watched and period) or watched == self._heartbeats.node_id:
                pass  # ours, or nobody's
            elif self._heartbeats.is_alive(watched, 1e-3 * period):
                living.append(watched)
                continue
            elif watched in MASTERS:
                logger.warning("node %d still monitors a master that is gone (node-ID %d)", self._node, watched)
            else:
                logger.warning(
                    "node %d monitors node-ID %d, which sends no heartbeat: replaced for now", self._node, watched
                )
            self._change(key, ours, before=bytes(4) if watched in MASTERS else None)
            self._watched_id = self._heartbeats.node_id
            return
        raise NoWatchdogError(
            f"node {self._node} has another master that lives (node-ID {living[0]}, 1016h), which may command it; end "
            "that program first: two masters of one drive undo each other's stops"
        )

    def _read(self, key: tuple[int, int]) -> bytes:
        return self._sdo.read(*key, f"{key[0]:04X}h:{key[1]:02X}", self._description.answer_timeout)

    def _change(
        self, key: tuple[int, int], data: bytes, only_from: bytes | None = None, before: bytes | None = None
    ) -> None:
        label, timeout = f"{key[0]:04X}h:{key[1]:02X}", self._description.answer_timeout
        found = self._read(key)[: len(data)]
        if only_from is not None and found != only_from:
            return
        if found != data:
            self._sdo.write(*key, data, label, timeout)
            if (now := self._read(key)[: len(data)]) != data:
                raise NoWatchdogError(f"node {self._node} took {data.hex()} for {label} and has {now.hex()}; {_REMEDY}")
        self._before.setdefault(key, found if before is None else before)
        self._set[key] = data


class Beats:
    """Heartbeats and guarding requests of all nodes, when they are due.

    Args:
        heartbeats: Those of this process.
        controls: Error control of each node.
        timeout: Silence after which a drive acts [s].
        clock: Gives the time [s].
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
        self.has_ceased = False  # for good: a drive that cannot be proved off is to stop by itself

    def begin(self) -> None:
        """Send the first ones."""
        for _ in range(FIRST_BEATS):
            self._beat()

    def keep(self) -> None:
        """Send what is due."""
        if not self.has_ceased and self._clock() >= self._next:
            self._beat()

    def cease(self) -> None:
        """Never send one again."""
        self.has_ceased = True

    def _beat(self) -> None:
        self._next = self._clock() + self._period
        if any(control.kind == "heartbeat" for control in self._controls):
            self._heartbeats.send()
        for control in self._controls:
            control.beat()


_REMEDY = "to move it without that, open it with Limits(silence=None) and keep the emergency stop at hand"
