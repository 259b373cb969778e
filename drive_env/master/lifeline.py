"""What stops drives when the program does not: heartbeats that end with the process, and a look at a stalled program.

A process that dies sends no heartbeat any more, and the drive stops by itself: it consumes heartbeats (1016h) or, where
it has none, guards its life (100Ch, 100Dh). A program that stalls while its process lives is noticed by this thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

from drive_env.canopen.frames import ERROR_CONTROL
from drive_env.dictionary.access import ObjectAccessError
from drive_env.master.description import Description
from drive_env.master.errors import BusError
from drive_env.master.port import Port
from drive_env.master.sdo import SdoClient
from drive_env.master.tidying import Tidying

logger = logging.getLogger(__name__)

MASTER = 127  # node-ID under which the master sends its heartbeat
OPERATIONAL = 0x05
BEATS_PER_TIMEOUT = 3  # of which two may be lost
STAYS = 1  # 1029h:01: a communication error changes nothing (CiA 301, and the TMCM-1636)

_CONSUMER, _GUARD_TIME, _LIFE_FACTOR, _ERROR_BEHAVIOUR = (0x1016, 1), (0x100C, 0), (0x100D, 0), (0x1029, 1)


class ErrorControl:
    """Configures the error control of one node, and puts it back.

    Args:
        node: Node-ID.
        sdo: Its SDO client.
        description: What device it is.
        timeout: After which silence the drive acts [s].
    """

    def __init__(self, node: int, sdo: SdoClient, description: Description, timeout: float) -> None:
        self._node = node
        self._sdo = sdo
        self._description = description
        self._timeout = timeout
        self._before: dict[tuple[int, int], bytes] = {}
        self.kind = "none"  # or "heartbeat", "life guarding"

    def configure(self) -> None:
        """Have the drive act when the master falls silent; a drive that cannot is left as it is, and logged.

        Raises:
            BusError: If the node does not answer.
        """
        milliseconds = round(1e3 * self._timeout)
        try:
            if self._description.has(_CONSUMER):
                self._change(_CONSUMER, (MASTER << 16 | milliseconds).to_bytes(4, "little"))
                self.kind = "heartbeat"
            elif self._description.has(_GUARD_TIME) and self._description.has(_LIFE_FACTOR):
                self._change(_GUARD_TIME, (milliseconds // BEATS_PER_TIMEOUT).to_bytes(2, "little"))
                self._change(_LIFE_FACTOR, bytes((BEATS_PER_TIMEOUT,)))
                self.kind = "life guarding"
            if self.kind != "none" and self._description.has(_ERROR_BEHAVIOUR):
                self._change(_ERROR_BEHAVIOUR, b"\0", only_from=bytes((STAYS,)))
        except ObjectAccessError as error:
            logger.warning("node %d cannot watch over its master: %s", self._node, error)
        if self.kind == "none":
            logger.warning(
                "node %d will not stop by itself when this process dies: it has neither a heartbeat consumer (1016h) "
                "nor life guarding (100Ch); keep the emergency stop at hand",
                self._node,
            )

    def restore(self) -> None:
        """Put the objects back as they were.

        The master's heartbeats must go on until then: a drive that still waits for them, and misses them, stops, and
        answers no more.

        Raises:
            BusError: If the drive did not take all of them.
        """
        before, self._before = self._before, {}
        tidying = Tidying()
        for (index, sub), data in before.items():
            label = f"{index:04X}h:{sub:02X}"
            tidying.step(partial(self._sdo.put_back, index, sub, data, label, self._description.answer_timeout))
        tidying.end()
        self.kind = "none"

    def forget(self) -> None:
        """Forget what was: the node was reset."""
        self._before.clear()
        self.kind = "none"

    def _change(self, key: tuple[int, int], data: bytes, only_from: bytes | None = None) -> None:
        label = f"{key[0]:04X}h:{key[1]:02X}"
        before = self._sdo.read(*key, label, self._description.answer_timeout)[: len(data)]
        if before == data or (only_from is not None and before != only_from):
            return
        self._sdo.write(*key, data, label, self._description.answer_timeout)
        self._before[key] = before


class Lifeline:
    """A thread that sends heartbeats and quick-stops when the program stalls.

    Args:
        port: The bus.
        controls: Error control of each node.
        nodes: Node-IDs.
        timeout: Silence after which a drive acts [s].
        stall: Longest pause between two calls of the program [s]; None for no limit.
        stop: Quick-stops the drives, from this thread.
    """

    def __init__(
        self,
        port: Port,
        controls: Sequence[ErrorControl],
        nodes: Sequence[int],
        timeout: float,
        stall: float | None,
        stop: Callable[[], None],
    ) -> None:
        self._port = port
        self._controls = controls
        self._nodes = nodes
        self._period = timeout / BEATS_PER_TIMEOUT
        self._stall = stall
        self._stop = stop
        self._alive = time.monotonic()
        self._watching = False
        self._ended = threading.Event()
        self.stalled_for: float | None = None  # set when it has quick-stopped [s]
        self._thread = threading.Thread(target=self._run, name="lifeline", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._beat()
        self._thread.start()

    def alive(self) -> None:
        """Say that the program runs; called by whatever it does."""
        self._alive = time.monotonic()

    def watch(self, on: bool) -> None:
        """Watch for stalls, or do not: a program may take its time while no axis is enabled."""
        self.alive()
        self._watching = on

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _run(self) -> None:
        step = min(self._period, self._stall / 4 if self._stall else self._period)
        next_beat = time.monotonic() + self._period
        told = ""  # a bus that is gone is told once, not with every beat
        while not self._ended.wait(step):
            try:
                if time.monotonic() >= next_beat:
                    next_beat = time.monotonic() + self._period
                    self._beat()
                    told = ""
                pause = time.monotonic() - self._alive
                if self._watching and self._stall is not None and pause > self._stall:
                    self._watching = False
                    self.stalled_for = pause
                    logger.error("the program did nothing for %.2f s: quick stop", pause)
                    self._stop()
            except BusError as error:
                # Heartbeats that do not get out are what the drive waits for to stop by itself.
                if str(error) != told:
                    told = str(error)
                    logger.error("%s", told)

    def _beat(self) -> None:
        if any(control.kind == "heartbeat" for control in self._controls):
            self._port.send(ERROR_CONTROL + MASTER, bytes((OPERATIONAL,)))
        for node, control in zip(self._nodes, self._controls, strict=True):
            if control.kind == "life guarding":
                self._port.send(ERROR_CONTROL + node, remote=True, length=1)
