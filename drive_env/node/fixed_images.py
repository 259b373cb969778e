"""The fields of a device's ready-made process image (`devices/image_rows.py`), and their objects."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from drive_env.devices.image_rows import TYPES, ImageField
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.process_data import ReceivedFields


class PackedFields:
    """The fields of an image and the objects behind them.

    Args:
        fields: The fields, in byte order.
        port: Returns the port of an object.

    Attributes:
        size: Length of their data [bytes].
    """

    def __init__(self, fields: Sequence[ImageField], port: Callable[[int, int], ObjectPort]) -> None:
        self._layout = struct.Struct("<" + "".join(TYPES[field.type][0] for field in fields))
        self.size = self._layout.size
        self._bits = [TYPES[field.type][1] for field in fields]
        self._find = port
        self._ports = [self._port(field) for field in fields]
        self._is_name = [field.is_name for field in fields]
        self._received = struct.Struct("<" + "".join(map(_received, self._bits, self._ports)))
        self._fields = ReceivedFields([one for one in self._ports if one is not None])

    def pack(self) -> bytes:
        """Return the present values; 0 for reserved fields."""
        return self._layout.pack(
            *(self._read(k) % (1 << bits) for k, bits in enumerate(self._bits))  # negative ones in two's complement
        )

    def write(self, data: bytes) -> bool:
        """Write each field to its object; return whether all objects accepted their values."""
        return self._fields.write(self._received.unpack(data))

    def _port(self, field: ImageField) -> ObjectPort | None:
        """Return the port of a field's object, None for a gap; it ignores writes while the field is not in use."""
        if field.key is None:
            return None
        port = self._find(*field.key)
        if field.taken_while is None:
            return port
        gate, values = self._find(*field.taken_while[0]), field.taken_while[1]
        return port._replace(write=lambda raw: port.write(raw) if gate.read() in values else None)

    def _read(self, k: int) -> int:
        port = self._ports[k]
        if port is None:
            return 0
        value = port.read()
        assert isinstance(value, int), "fields are numbers"
        return self._named(value) if self._is_name[k] else value

    def _named(self, entry: int) -> int:
        """Return the key of the object that a mapping entry names; 0 for an entry without one, or a missing object."""
        index, sub, _ = mapping.parse(entry)
        try:
            value = self._find(index, sub).read()
        except ObjectAccessError:
            return 0
        return value if isinstance(value, int) else 0


def _received(bits: int, port: ObjectPort | None) -> str:
    """Return the `struct` format for a field of `bits` bits: the object's own are the lowest, others are skipped."""
    if port is None:
        return f"{bits // 8}x"
    own = min(port.entry.bits or 0, bits)
    return f"{mapping.LAYOUT[own][port.entry.signed]}{(bits - own) // 8}x"
