"""Process images that a device has ready-made, as packed structures: its `images.toml` says what each field is."""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.process_data import order_of_writing

Key = tuple[int, int]
# Data types of fields: character of `struct` for the bits as they are, and how many.
TYPES = {"u8": ("B", 8), "u16": ("H", 16), "i16": ("H", 16), "u32": ("I", 32), "i32": ("I", 32), "i64": ("Q", 64)}
NAMES_ANOTHER = "@"


class ImageField(NamedTuple):
    """A field: its type, the object that it is, None of a reserved one; whether that names the one it carries."""

    type: str
    key: Key | None
    is_name: bool


class FixedImage(NamedTuple):
    """An image: whether it goes into the drive, and its fields in the order of the bytes."""

    is_output: bool
    fields: tuple[ImageField, ...]


@cache
def fixed_images(folder: Path) -> dict[int, FixedImage]:
    """Return the images of the device in a folder, by number; none where it has no such file."""
    path = folder / "images.toml"
    if not path.exists():
        return {}
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    return {
        int(number, 16): FixedImage(row["direction"] == "outputs", tuple(_field(*one) for one in row["fields"]))
        for number, row in data.items()
    }


def _field(kind: str, text: str) -> ImageField:
    name = text.removeprefix(NAMES_ANOTHER)
    if not name:
        return ImageField(kind, None, False)
    index, sub = name.split(":")
    return ImageField(kind, (int(index, 16), int(sub)), name != text)


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
