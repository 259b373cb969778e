"""The slaves' watch over their master: the watchdog of sync manager 2, which process data feed."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Sequence

from drive_env.cia402 import Key
from drive_env.ethercat import registers
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.link import NoWatchdogError, ObjectClient
from drive_env.master.changed_objects import REMEDY, ChangedObjects
from drive_env.master.ethercat.ethercat_master import EtherCatMaster
from drive_env.master.ethercat.image_data import EtherCatProcessData

TICK = 40e-9  # s
LONGEST = 0xFFFF  # ticks of the divider
TRIGGERS = 0x40  # of a sync manager's control: process data trigger the watchdog
OUTPUTS_CONTROL = registers.SYNC_MANAGERS + 2 * registers.SYNC_MANAGER_SIZE + 4
FACTORY = 0.1  # s, of a controller after reset
TIMES = (registers.WATCHDOG_DIVIDER, registers.SM_WATCHDOG)
LOOK = 0.05  # s between two checks whether another master has changed them


class ProcessWatchdog:
    """The watch over this master by each slave's watchdog.

    A slave that gets no outputs for the watchdog's time leaves Op, and its axes stop by their fault reaction. It
    watches only in Op, the only state in which motors run. After power-on the time is 100 ms.

    Args:
        master: The segment's master.
        nodes: Positions of the slaves.
        clients: Their objects.
        data: Their process data.
        description: Their device.
    """

    def __init__(
        self,
        master: EtherCatMaster,
        nodes: Sequence[int],
        clients: Sequence[ObjectClient],
        data: EtherCatProcessData,
        description: Description,
    ) -> None:
        self._master, self._nodes, self._data = master, tuple(nodes), data
        self._objects = [ChangedObjects(*one, description) for one in zip(nodes, clients, strict=True)]
        self._before: dict[int, bytes] = {}
        self._set: dict[int, tuple[bytes, bytes]] = {}  # divider and time written to each
        self._time = math.inf
        self._looked_at = 0.0

    @property
    def detection_time(self) -> float:
        """The silence after which every node has noticed [s]; infinite while no watchdog is set."""
        return self._time

    def begin(self, silence: float) -> None:
        """Have every node act when its master falls silent for `silence` [s], or less.

        Raises:
            NoWatchdogError: If a slave has no watchdog on its outputs, or does not accept the time.
            BusError: If a node does not answer.
        """
        times = []
        for k, position in enumerate(self._nodes):
            control = self._master.register(position, OUTPUTS_CONTROL, 1)
            if control is None or not control[0] & TRIGGERS:
                raise NoWatchdogError(
                    f"position {position} does not watch its outputs: its EEPROM has sync manager 2 without the "
                    f"watchdog (0814h, bit 6); {REMEDY}"
                )
            divider = self._register(position, registers.WATCHDOG_DIVIDER)
            tick = (int.from_bytes(divider, "little") + 2) * TICK
            count = struct.pack("<H", min(max(math.floor(silence / tick + 1e-6), 1), LONGEST))
            found = self._register(position, registers.SM_WATCHDOG)
            self._master.write_register(position, registers.SM_WATCHDOG, count)
            now = self._register(position, registers.SM_WATCHDOG)
            if now != count:
                raise NoWatchdogError(f"position {position} took {count.hex()} for 0420h and has {now.hex()}; {REMEDY}")
            self._before.setdefault(k, found)
            self._set[k] = divider, count
            self._objects[k].quick_stop_on_lost_connection()
            times.append(int.from_bytes(count, "little") * tick)
        self._time = max(times)
        self._data.is_silent = False
        self.keep()

    def keep(self) -> None:
        """Exchange images if none were exchanged for a third of the watchdog's time."""
        if time.monotonic() - self._data.exchanged_at > min(self._time, FACTORY) / 3.0:
            self._data.exchange(is_cycle=False)

    def cease(self) -> None:
        """Exchange images a last time, so that the drives then stop by themselves."""
        self._data.exchange(is_cycle=False)
        self._data.is_silent = True

    def end(self) -> None:
        """Note that the watchdogs are given up; images may still be exchanged."""
        self._time = math.inf

    def is_set(self, node: int) -> bool:
        """Return whether a node's watchdog was set and not yet restored."""
        return node in self._set

    def is_in_force(self, node: int) -> bool:
        """Ask a node; return whether watchdog and reaction are as set, and active, which a watchdog is in Op only."""
        position = self._nodes[node]
        has = tuple(self._register(position, address) for address in TIMES) == self._set.get(node)
        return has and self._master.status(position).is_op and self._objects[node].are_in_force()

    def holds(self, key: Key) -> bool:
        """Return whether the watchdogs that are set depend on an object."""
        return any(k in self._set and one.holds(key) for k, one in enumerate(self._objects))

    def before(self, node: int, key: Key) -> int | None:
        """Return the value that an object of a node had before its watchdog was set; None for one that is its own."""
        return self._objects[node].before(key)

    def restore(self, node: int) -> None:
        """Restore a node's watchdog; BusError if it did not accept all of it."""
        self._set.pop(node, None)
        before = self._before.pop(node, None)
        try:
            self._objects[node].restore()
        finally:
            if before is not None:
                self._master.write_register(self._nodes[node], registers.SM_WATCHDOG, before)

    def forget(self, node: int) -> None:
        """Forget the watchdog's previous settings: the node was reset."""
        self._objects[node].forget()
        self._before.pop(node, None)
        self._set.pop(node, None)

    def take_rival(self) -> str:
        """Return, once, the slave whose watchdog another master has changed, and restore its time; else "".

        Another master that takes over a slave's address, states or images is noticed otherwise: the images do not
        return.
        """
        now = time.monotonic()
        if now - self._looked_at < LOOK:
            return ""
        self._looked_at = now
        changed = [k for k in self._set if self._set_again(k)]
        if not changed:
            return ""
        numbers = ", ".join(str(self._nodes[k]) for k in changed)
        return (
            f"another master has changed the watchdog of position {numbers} (0400h, 0420h), so that the drives would "
            "not notice this program's death"
        )

    def _set_again(self, node: int) -> bool:
        """Return whether a slave that answers had lost its watchdog's time, which is set again."""
        position, wanted = self._nodes[node], self._set[node]
        found = tuple(self._master.register(position, address, 2) for address in TIMES)
        if None in found or found == wanted:
            return False
        for address, value in zip(TIMES, wanted, strict=True):
            self._master.write_register(position, address, value)
        return True

    def _register(self, position: int, address: int) -> bytes:
        found = self._master.register(position, address, 2)
        if found is None:
            raise NoWatchdogError(f"position {position} does not answer; check cable and power")
        return found
