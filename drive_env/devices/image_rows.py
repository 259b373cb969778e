"""Process images that a device has ready-made, as packed structures: `images.toml` has the object of each field."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

from drive_env.cia402 import Key
from mechanics.reading.untrusted import read_toml

# Data types of fields: character of `struct` for the bits as they are, and how many.
TYPES = {"u8": ("B", 8), "u16": ("H", 16), "i16": ("H", 16), "u32": ("I", 32), "i32": ("I", 32), "i64": ("Q", 64)}
NAMES_ANOTHER = "@"


class ImageField(NamedTuple):
    """A field of an image.

    Attributes:
        type: Its data type.
        key: Its object; None for a reserved field.
        is_name: Whether it names the object that the image carries.
        taken_while: An object, and its values with which the field is taken; None: it always is.
    """

    type: str
    key: Key | None
    is_name: bool
    taken_while: tuple[Key, tuple[int, ...]] | None = None


class FixedImage(NamedTuple):
    """An image: whether it goes into the drive, and its fields in the order of the bytes."""

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
