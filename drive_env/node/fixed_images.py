"""The fields of a process image that a device has ready-made (`devices/image_rows.py`), and the objects behind them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from drive_env.devices.image_rows import TYPES, ImageField
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.process_data import order_of_writing


class PackedFields:
    """The fields of an image and the objects behind them.

    Args:
        fields: In the order of the bytes.
        port: Returns the way to an object.

    Attributes:
        size: Length of their data [bytes].
    """

    def __init__(self, fields: Sequence[ImageField], port: Callable[[int, int], ObjectPort]) -> None:
        self._layout = struct.Struct("<" + "".join(TYPES[field.type][0] for field in fields))
        self.size = self._layout.size
        self._bits = [TYPES[field.type][1] for field in fields]
        self._find = port
        self._ports = [None if field.key is None else port(*field.key) for field in fields]
        self._is_name = [field.is_name for field in fields]
        self._order = order_of_writing([("" if one is None else one.event) for one in self._ports])

    def pack(self) -> bytes:
        """Return their values as they are now; 0 of what is reserved."""
        return self._layout.pack(
            *(self._read(k) % (1 << bits) for k, bits in enumerate(self._bits))  # negative ones as their bits
        )

    def write(self, data: bytes) -> bool:
        """Write all of them, or none where one does not take its value; return whether they were written."""
        raw = self._layout.unpack(data)
        plan = []
        for k in self._order:
            port = self._ports[k]
            if port is not None:
                bits = port.entry.bits or 0
                value = raw[k] & ((1 << bits) - 1)
                plan.append((port, value - (1 << bits) if port.entry.signed and value >> (bits - 1) else value))
        try:
            for port, value in plan:
                port.check(value)
        except ObjectAccessError:
            return False
        for port, value in plan:
            port.write(value)
        return True

    def _read(self, k: int) -> int:
        port = self._ports[k]
        if port is None:
            return 0
        value = port.read()
        assert isinstance(value, int), "fields are numbers"
        return self._named(value) if self._is_name[k] else value

    def _named(self, entry: int) -> int:
        """Return the object that a mapping entry names; 0 of none, and of one that is not there."""
        index, sub, _ = mapping.parse(entry)
        try:
            value = self._find(index, sub).read()
        except ObjectAccessError:
            return 0
        return value if isinstance(value, int) else 0
