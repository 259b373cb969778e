"""The node's non-volatile memory: sections of parameters in a file that is never half written.

A saved section holds the changed values of its group; objects that it does not name have their factory value. A missing
section was never saved, or was restored.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mechanics.reading.untrusted import read_json

if TYPE_CHECKING:
    from drive_env.cia402 import Key

Section = dict["Key", int]
FORMAT = 1


class PowerLostError(Exception):
    """The power fails while values are being saved."""


class Store:
    """Sections of a device, in a file if there is a path.

    Attributes:
        sections: The stored values.
        loses_power: Whether the power fails in the middle of each save.

    Args:
        path: The file; it need not exist.
        device: Name of the device, which the file must name, too.
        commissioned: Sections of a memory before the first save.

    Raises:
        ValueError: If the file was not written by this class for this device.
    """

    def __init__(self, path: Path | None, device: str, commissioned: Mapping[str, Section] | None = None) -> None:
        self._path = path
        self._device = device
        self.sections: dict[str, Section] = dict(commissioned or {})
        self.loses_power = False
        if path is not None and path.exists():
            self.sections |= _parse(path, device)

    def save(self, changed: Mapping[str, Section]) -> None:
        """Replace sections: all of them, or none if the file cannot be written.

        Raises:
            OSError: If the file cannot be written.
            PowerLostError: If the power fails meanwhile; the previous values remain stored.
        """
        sections = {**self.sections, **changed}
        if self._path is not None:
            content = {
                "format": FORMAT,
                "device": self._device,
                "sections": {
                    name: {f"{index:04X}:{sub}": raw for (index, sub), raw in sorted(section.items())}
                    for name, section in sorted(sections.items())
                },
            }
            text = json.dumps(content, indent=1) + "\n"
            if self.loses_power:
                _unfinished(self._path).write_text(text[: len(text) // 2], encoding="utf-8")
                raise PowerLostError
            write_whole(self._path, text)
        if self.loses_power:
            raise PowerLostError
        self.sections = sections


def _unfinished(path: Path) -> Path:
    """Return the temporary file that replaces the old one once it is complete."""
    return path.with_name(path.name + ".new")


def write_whole(path: Path, text: str) -> None:
    """Write a file so that after a kill or a power failure it has the old or the new content, never a mixture."""
    new = _unfinished(path)
    with new.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    if os.name == "posix":  # elsewhere folders cannot be opened, and renaming is durable by itself
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _parse(path: Path, device: str) -> dict[str, Section]:
    try:
        content = read_json(path)
        if content["format"] != FORMAT or content["device"] != device:
            raise ValueError(f"it is of format {content['format']} and of a {content['device']}")
        return {
            str(name): {_key(text): _raw(text, raw) for text, raw in section.items()}
            for name, section in content["sections"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} has no parameters of a {device} ({error}); give another file, or delete it to start with factory "
            "values"
        ) from error


def _raw(text: str, raw: Any) -> int:
    if type(raw) is not int:
        raise ValueError(f"{text} is {raw!r}, no whole number")
    return raw


def _key(text: str) -> Key:
    index, sub = text.split(":")
    return int(index, 16), int(sub)
