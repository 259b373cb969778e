"""A device's ready-made process images, as packed structures: `images.toml` names the object of each field."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

from drive_env.cia402 import Key
from mechanics.reading.untrusted import read_toml

# Data types of fields: `struct` character for the raw bits, and their number.
TYPES = {"u8": ("B", 8), "u16": ("H", 16), "i16": ("H", 16), "u32": ("I", 32), "i32": ("I", 32), "i64": ("Q", 64)}
NAMES_ANOTHER = "@"


class ImageField(NamedTuple):
    """A field of an image.

    Attributes:
        type: Its data type.
        key: Its object; None for a reserved field.
        is_name: Whether it names the object that the image carries.
        taken_while: An object, and the values with which the field is applied; None: always.
    """

    type: str
    key: Key | None
    is_name: bool
    taken_while: tuple[Key, tuple[int, ...]] | None = None


class FixedImage(NamedTuple):
    """An image: whether it is sent to the drive, and its fields in byte order."""

    is_output: bool
    fields: tuple[ImageField, ...]


@cache
def fixed_images(folder: Path) -> dict[int, FixedImage]:
    """Return the images of the device in a folder, by number; {} without the file."""
    path = folder / "images.toml"
    if not path.exists():
        return {}
    data = read_toml(path)
    return {
        int(number, 16): FixedImage(row["direction"] == "outputs", tuple(_field(*one) for one in row["fields"]))
        for number, row in data.items()
    }


def _field(kind: str, text: str, gate: str = "", values: tuple[int, ...] = ()) -> ImageField:
    name = text.removeprefix(NAMES_ANOTHER)
    if not name:
        return ImageField(kind, None, False)
    return ImageField(kind, _key(name), name != text, (_key(gate), tuple(values)) if gate else None)


def _key(name: str) -> Key:
    index, sub = name.split(":")
    return int(index, 16), int(sub)
