"""Objects of a node that this master changes temporarily, and restores afterwards."""

from __future__ import annotations

from functools import partial

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.link import NoWatchdogError, ObjectClient
from drive_env.fieldbus.tidying import Tidying

# 6007h, the reaction of an axis to a lost connection (CiA 402): none, or the quick stop.
_ABORT_CONNECTION, _NO_ACTION, _QUICK_STOP = (cia402.ABORT_CONNECTION_OPTION, 0), b"\0\0", b"\3\0"
REMEDY = "to move it without that, open it in Python with Limits(silence=None) and keep the emergency stop at hand"


class ChangedObjects:
    """Objects changed for a node's watchdog over its master, with their previous values.

    Args:
        node: The node's address, for messages.
        sdo: Its objects.
        description: Its device.
    """

    def __init__(self, node: int, sdo: ObjectClient, description: Description) -> None:
        self._node = node
        self._sdo = sdo
        self._description = description
        self._before: dict[Key, bytes] = {}
        self._set: dict[Key, bytes] = {}

    def __contains__(self, key: Key) -> bool:
        return key in self._before

    def holds(self, key: Key) -> bool:
        """Return whether a watchdog set with these objects depends on a key, changed or already right (6007h)."""
        return key in self or key == _ABORT_CONNECTION

    def before(self, key: Key) -> int | None:
        """Return the value that an object is given back later; None if it was not changed."""
        return int.from_bytes(self._before[key], "little") if key in self._before else None

    def read(self, key: Key) -> bytes:
        """Return the bytes of an object."""
        return self._sdo.read(*key, f"{key[0]:04X}h:{key[1]:02X}", self._description.answer_timeout)

    def change(self, key: Key, data: bytes, only_from: bytes | None = None, before: bytes | None = None) -> None:
        """Write other bytes to an object, and verify them.

        Args:
            key: The object.
            data: The new bytes.
            only_from: The bytes that it must have now, otherwise it is left unchanged; None: any.
            before: The value to restore afterwards, by default its present one.

        Raises:
            NoWatchdogError: If the node accepts them but holds others.
            ObjectAccessError: If it refuses; BusError if it does not answer.
        """
        label, timeout = f"{key[0]:04X}h:{key[1]:02X}", self._description.answer_timeout
        found = self.read(key)[: len(data)]
        if only_from is not None and found != only_from:
            return
        is_new = key not in self._before
        self._before.setdefault(key, found if before is None else before)
        if found != data:
            try:
                self._sdo.write(*key, data, label, timeout)
            except ObjectAccessError:
                if is_new:
                    del self._before[key]
                raise
            if (now := self.read(key)[: len(data)]) != data:
                raise NoWatchdogError(f"node {self._node} took {data.hex()} for {label} and has {now.hex()}; {REMEDY}")
        self._set[key] = data

    def quick_stop_on_lost_connection(self) -> None:
        """Make every axis that would ignore a lost connection do a quick stop then (6007h)."""
        if not self._description.has(_ABORT_CONNECTION):
            return
        entry = self._description.dictionary.find(_ABORT_CONNECTION)
        for part in range(self._description.num_axes):
            self.change(self._description.key(entry, part), _QUICK_STOP, only_from=_NO_ACTION)

    def are_in_force(self) -> bool:
        """Read the objects; return whether the node still has the values that were set.

        Raises:
            BusError: If the node does not answer.
        """
        return all(self.read(key)[: len(data)] == data for key, data in self._set.items())

    def restore(self) -> None:
        """Restore the objects.

        Raises:
            BusError: If the node did not accept all of them.
        """
        before, self._before = self._before, {}
        self._set.clear()
        tidying = Tidying()
        for key, data in before.items():
            tidying.step(partial(self._put_back, key, data))
        tidying.end()

    def _put_back(self, key: Key, data: bytes) -> None:
        label = f"{key[0]:04X}h:{key[1]:02X}"
        self._sdo.put_back(*key, data, label, self._description.answer_timeout)
        if (now := self.read(key)[: len(data)]) != data:
            raise BusError(f"node {self._node}: {label} should have {data.hex()} again, and has {now.hex()}")

    def forget(self) -> None:
        """Forget the previous values: the node was reset."""
        self._before.clear()
        self._set.clear()
