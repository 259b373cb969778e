"""The objects that a node has once for all axes: 1000h to 1FFFh, and others that its device's data name.

Each write is checked by the rule of its object before it changes anything; the owner of the service behind an object is
notified of the change. The fieldbus provides the rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np

from drive_env.cia402 import Key
from drive_env.devices import Device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_allowed, check_limits
from drive_env.dictionary.entries import EdsText, Entry, ObjectDictionary
from drive_env.emulator.live_dictionary import check_supported
from drive_env.node.axis import ObjectPort

ERROR_REGISTER = 0x1001
ERROR_HISTORY = 0x1003
STORE = 0x1010
RESTORE = 0x1011
IDENTITY = 0x1018


@cache
def _factory(path: Path | EdsText, node_id: int) -> dict[Key, int | str]:
    return {(entry.index, entry.sub): entry.default for entry in ObjectDictionary(path, node_id)}


class NodeObjects:
    """Values of the node's own objects.

    Args:
        device: The device.
        entries: Its dictionary.
        changed: Called with the index of an object that was written.

    Attributes:
        readers: Objects whose value comes from a service.
        commands: Objects whose write is a command that stores no value.
    """

    def __init__(self, device: Device, entries: ObjectDictionary, changed: Callable[[int], None]) -> None:
        self._device = device
        self._entries = entries
        self._changed = changed
        self._own = set(device.canopen.objects.values())
        factory = _factory(entries.path, 1)
        self._values: dict[Key, int | str] = {key: factory[key] for key in self._own}
        self.readers: dict[Key, Callable[[], int | str]] = {}
        self.commands: dict[Key, Callable[[int], None]] = {}

    def owns(self, entry: Entry) -> bool:
        """Return whether an object is the node's."""
        return 0x1000 <= entry.index <= 0x1FFF or (entry.index, entry.sub) in self._own

    def restore(self, node_id: int, stored: Mapping[Key, int]) -> None:
        """Set the communication objects as at the start of a node: the stored values, otherwise the factory's."""
        factory = self.factory(node_id)
        for entry in self._entries:
            if 0x1000 <= entry.index <= 0x1FFF:
                key = (entry.index, entry.sub)
                self._values[key] = stored.get(key, factory[key])

    def factory(self, node_id: int) -> Mapping[Key, int | str]:
        """Return the factory's values of all objects, also of the axes; COB-IDs contain the node-ID."""
        return _factory(self._entries.path, node_id)

    def set(self, role: str, raw: int | str) -> None:
        """Set an object of the node by the role that the device's data gives it."""
        self._values[self._device.canopen.objects[role]] = raw

    def value(self, index: int, sub: int = 0) -> int:
        """Return a number; 0 for an object that this device lacks."""
        raw: int | str = self._values.get((index, sub), 0)
        assert isinstance(raw, int), "a text is not a number"
        return raw

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of one of the node's own objects."""
        key = (entry.index, entry.sub)
        values = self._values
        read: Callable[[], int | str] = self.readers.get(key) or (lambda: values[key])
        if key in self.commands:
            command = self.commands[key]
            return ObjectPort(entry, read, lambda raw: check_limits(entry, raw), command)
        check = self._rule(entry)

        def write(raw: int) -> None:
            values[key] = raw | self._fixed(entry)
            self._changed(entry.index)

        def checked(raw: int) -> None:
            check_limits(entry, raw)
            check_supported(self._device, entry)
            # A device's data name objects of the first axis; those of the others accept the same values.
            allowed = self._device.allowed_values.get((self._device.locate(entry.index)[1], entry.sub))
            if allowed is not None:
                check_allowed(entry, np.array([raw]), allowed)
            if check is not None:
                check(raw)

        if entry.bits is None:
            return ObjectPort(entry, read, checked, write, "", lambda text: values.update({key: text}))
        return ObjectPort(entry, read, checked, write)

    def factory_value(self, entry: Entry) -> int:
        """Return the factory's number of an object, with node 1's COB-IDs."""
        raw = self.factory(1)[entry.index, entry.sub]
        assert isinstance(raw, int), "a text is not a number"
        return raw

    def find(self, index: int, sub: int) -> Entry:
        """Return an entry of the device's dictionary; 06020000h or 06090011h without such an entry."""
        return self._entries.find((index, sub))

    def has(self, index: int) -> bool:
        """Return whether the device has an object."""
        return (index, 0) in self._values

    def subs(self, index: int) -> list[int]:
        """Return the sub-indices above 0 of an object."""
        return [entry.sub for entry in self._entries if entry.index == index and entry.sub > 0]

    def _rule(self, entry: Entry) -> Callable[[int], None] | None:
        """Return the fieldbus' check of a value before a write, beyond the object's limits; None for no check."""
        return None

    def _fixed(self, entry: Entry) -> int:
        """Return the bits that are set in every written value."""
        return 0


def signed_command(signature: int, code: int, action: Callable[[], None]) -> Callable[[int], None]:
    """Return a command that acts only on the right signature."""

    def command(raw: int) -> None:
        if raw != signature:
            raise ObjectAccessError(code, f"{raw:08X}h is not the signature {signature:08X}h")
        action()

    return command
