"""PDOs: receiving and sending, transmission types, identifiers (CiA 301, 7.2.2)."""

from __future__ import annotations

from collections.abc import Callable

from drive_env.canopen import frames
from drive_env.canopen.communication import TO_MAPPING, ModuleObjects
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.process_data import MappedObjects

LAST_SYNCHRONOUS = 240  # transmission types 0...240; 254 and 255 are driven by events
EPSILON = 1e-6  # s: times are sums of cycles


class Pdo:
    """Common part of both directions: identifier, transmission type and the mapped objects.

    Args:
        index: Index of its communication parameter.
        objects: The module's objects.
        port: Finds an object by index and sub-index.
    """

    def __init__(self, index: int, objects: ModuleObjects, port: Callable[[int, int], ObjectPort]) -> None:
        self.index = index
        self._objects = objects
        self._port = port
        self.can_id: int | None = None
        self.configure()

    def configure(self) -> None:
        """Read the settings from the objects."""
        objects, index = self._objects, self.index
        cob_id = objects.value(index, 1)
        self.can_id = None if cob_id & frames.INVALID else cob_id & frames.IDENTIFIER
        self.transmission_type = objects.value(index, 2)
        count = objects.value(index + TO_MAPPING, 0)
        mapped = [mapping.parse(objects.value(index + TO_MAPPING, sub)) for sub in range(1, count + 1)]
        self._mapped = MappedObjects([self._port(mapped_index, mapped_sub) for mapped_index, mapped_sub, _ in mapped])

    @property
    def is_synchronous(self) -> bool:
        """Whether it is synchronous (SYNC)."""
        return self.transmission_type <= LAST_SYNCHRONOUS


class ReceivePdo(Pdo):
    """A PDO that the drive receives."""

    def configure(self) -> None:
        """Read the settings from the objects; data waiting for SYNC are dropped."""
        super().configure()
        self._waiting: bytes | None = None

    def receive(self, data: bytes) -> str | None:
        """Handle a frame; return the error condition that it causes, None if it is good."""
        if len(data) != self._mapped.size:
            return "pdo_too_short" if len(data) < self._mapped.size else "pdo_too_long"
        if self.is_synchronous:
            self._waiting = data
            return None
        return self._apply(data)

    def latch(self) -> str | None:
        """Apply the data received since the last SYNC; return the error condition that they cause, or None."""
        if self._waiting is None:
            return None
        data, self._waiting = self._waiting, None
        return self._apply(data)

    def forget(self) -> None:
        """Drop data waiting for SYNC."""
        self._waiting = None

    def _apply(self, data: bytes) -> str | None:
        return None if self._mapped.write(data) else "pdo_not_accepted"


class TransmitPdo(Pdo):
    """A PDO that the drive sends.

    Event-driven ones (254, 255) are sent when a mapped value has changed, at most once per communication cycle, when
    their event timer ends, and when the node becomes operational, since its values are unknown then. Synchronous ones
    are sampled at SYNC: type n at every n-th, type 0 if a value has changed since the last; event timer and inhibit
    time do not apply to them (CiA 301, 1800h).
    """

    def __init__(
        self,
        index: int,
        objects: ModuleObjects,
        port: Callable[[int, int], ObjectPort],
        inhibit_unit: float,
        event_unit: float,
    ) -> None:
        self._inhibit_unit, self._event_unit = inhibit_unit, event_unit
        self._sent_at: float | None = None
        super().__init__(index, objects, port)

    def configure(self) -> None:
        """Read the settings from the objects."""
        before = self.can_id, self._sent_at
        super().configure()
        self._inhibit = self._objects.value(self.index, 3) * self._inhibit_unit
        self._period = self._objects.value(self.index, 5) * self._event_unit
        self._start_value = self._objects.value(self.index, 6)
        self.start()
        if self.can_id is not None and self.can_id == before[0]:
            self._sent_at = before[1]  # the inhibit time of a PDO that stays on continues

    def start(self) -> None:
        """Restart, as on entering operational."""
        self._seen: bytes | None = None
        self._is_due = False
        self._sent_at = None
        self._syncs = 0
        self._waits_for_start = self._start_value != 0

    def on_sync(self, counter: int | None = None) -> bytes | None:
        """Return the data to send at this SYNC, or None.

        Args:
            counter: The count in the SYNC, None without one; the first counted SYNC is the one with the SYNC start
                value (1800h:06).
        """
        if not self.is_synchronous or not len(self._mapped):
            return None
        if self.transmission_type == 0:
            data = self._mapped.pack()
            changed, self._seen = data != self._seen, data
            return data if changed else None
        if self._waits_for_start and counter is not None:
            if counter != self._start_value:
                return None
            self._waits_for_start = False
        self._syncs += 1
        if self._syncs < self.transmission_type:
            return None
        self._syncs = 0
        return self._mapped.pack()

    def on_cycle(self, now: float) -> bytes | None:
        """Return the data to send after a communication cycle that ended at `now` [s], or None."""
        if self.is_synchronous or not len(self._mapped):
            return None
        data = self._mapped.pack()
        if data != self._seen:
            self._seen = data
            self._is_due = True
        if self._sent_at is not None:
            waited = now - self._sent_at + EPSILON
            if self._period > 0.0 and waited >= self._period:
                self._is_due = True
            if waited < self._inhibit:
                return None
        if not self._is_due:
            return None
        self._is_due = False
        self._sent_at = now
        return data
