"""The fields of a process image that a device has ready-made (`devices/image_rows.py`), and the objects behind them."""

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
        self._ports = [self._port(field) for field in fields]
        self._is_name = [field.is_name for field in fields]
        self._received = struct.Struct("<" + "".join(map(_received, self._bits, self._ports)))
        self._fields = ReceivedFields([one for one in self._ports if one is not None])

    def pack(self) -> bytes:
        """Return their present values; 0 for reserved fields."""
        return self._layout.pack(
            *(self._read(k) % (1 << bits) for k, bits in enumerate(self._bits))  # negative ones as their bits
        )

    def write(self, data: bytes) -> bool:
        """Write each object that takes its value; return whether all did."""
        return self._fields.write(self._received.unpack(data))

    def _port(self, field: ImageField) -> ObjectPort | None:
        """Return the way to a field's object, which a write does not reach while the field is not taken."""
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
        """Return the object that a mapping entry names; 0 for an entry without one, and for a missing object."""
        index, sub, _ = mapping.parse(entry)
        try:
            value = self._find(index, sub).read()
        except ObjectAccessError:
            return 0
        return value if isinstance(value, int) else 0


def _received(bits: int, port: ObjectPort | None) -> str:
    """Return how `struct` reads a field of so many bits: an object's own in the lowest ones, the others passed over."""
    if port is None:
        return f"{bits // 8}x"
    own = min(port.entry.bits or 0, bits)
    return f"{mapping.LAYOUT[own][port.entry.signed]}{(bits - own) // 8}x"
