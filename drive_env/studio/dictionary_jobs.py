"""The jobs of the page Dictionary: values, writes, comparisons, backups, restores."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary import quantities
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.access import check_limits, check_writable
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.quantities import Scale
from drive_env.drives.interface import Drives
from drive_env.master.identity import check_same_drive, read_identity
from drive_env.master.parameter_files import checked_origin, load_parameters, parameters_text
from drive_env.master.parameters import (
    SAVE,
    Difference,
    check_no_commands,
    compare,
    parameters,
    read_parameters,
    write_all_or_none,
)
from drive_env.master.single_axes import SingleAxes
from drive_env.whole_file import sealed

if TYPE_CHECKING:
    from drive_env.fieldbus.description import Description

# Targets with which an axis turns without end.
ON_AND_ON = (
    cia402.TARGET_VELOCITY, cia402.VL_TARGET_VELOCITY, cia402.TARGET_TORQUE, cia402.VELOCITY_OFFSET,
    cia402.TORQUE_OFFSET,
)  # fmt: skip


class ShownValue(NamedTuple):
    """A value for display: raw, None if it cannot be read, and as text with its unit."""

    raw: int | str | None
    text: str


@dataclass(frozen=True)
class Checked:
    """A value entered for an object: its integer, and its text."""

    raw: int
    text: str


def values_of(entries: Sequence[Entry], axis: int, scale: Scale) -> Callable[[Drives], dict[Key, ShownValue]]:
    """Return the job that reads objects of an axis; for an object that the drive refuses the text says so."""

    def job(drives: Drives) -> dict[Key, ShownValue]:
        found = {}
        for entry in entries:
            key = (entry.index, entry.sub)
            if entry.access == "wo":
                found[key] = ShownValue(None, "cannot be read")
                continue
            try:
                value = drives.read(key)[axis]
            except ObjectAccessError as error:
                found[key] = ShownValue(None, f"refused ({error.abort_code:08X}h)")
                continue
            raw = str(value) if entry.bits is None else int(value)
            found[key] = ShownValue(raw, shown(entry, raw, scale))
        return found

    return job


def shown(entry: Entry, raw: int | str, scale: Scale) -> str:
    """Format a value for display."""
    if isinstance(raw, str):
        return "".join(letter if letter.isprintable() else "·" for letter in raw[:60])
    text = quantities.show(raw, entry, scale)
    if entry.unit or entry.bits is None:
        return text
    return f"{text} ({raw & (1 << entry.bits) - 1:X}h)"


def checked(entry: Entry, text: str, scale: Scale) -> Checked:
    """Convert a text to an object's value, and check it before anything is sent.

    Raises:
        ValueError: For a text that is not a number, or has a wrong unit.
        ObjectAccessError: For an object that cannot be written, or a value out of its range.
    """
    check_writable(entry)
    if cia402.of_first_axis(entry.index) == cia402.CONTROLWORD:
        raise ValueError(f"{entry.label} commands the axis: do that on the page Axes, where you see what it does")
    raw = quantities.parse(text, entry, scale)
    check_limits(entry, raw)
    return Checked(raw, shown(entry, raw, scale))


def write(entry: Entry, raw: int, axis: int) -> Callable[[Drives], int]:
    """Return the job that writes an object of an axis, and returns the value read back."""

    def job(drives: Drives) -> int:
        key = (entry.index, entry.sub)
        drives.write(key, raw, where=np.arange(drives.num_axes) == axis)
        return raw if entry.access == "wo" else int(drives.read(key)[axis])

    return job


def store(axis: int) -> Callable[[Drives], None]:
    """Return the job that has the drive store its parameters (1010h:01)."""
    return lambda drives: drives.write((0x1010, 1), SAVE, where=np.arange(drives.num_axes) == axis)


def factory(known: Description) -> dict[Key, int]:
    """Return the default values of parameters in the EDS, without those that have none."""
    described: Any = _DescriptionAlone(known)
    return {
        (entry.index, entry.sub): entry.default for entry in parameters(described) if isinstance(entry.default, int)
    }


class _DescriptionAlone:
    """The attribute of drives that `parameters` uses: their description."""

    def __init__(self, description: Description) -> None:
        self.description = description


def differences(known: Description, wanted: Mapping[Key, int], axis: int) -> Callable[[Drives], list[Difference]]:
    """Return the job that compares an axis with values and returns the differences."""
    return lambda drives: compare(SingleAxes(drives, known), wanted, axis)


def backup(known: Description, axis: int) -> Callable[[Drives], str]:
    """Return the job that creates a backup file of an axis, as `drive-env parameters backup`; it returns the text."""

    def job(drives: Drives) -> str:
        axes = SingleAxes(drives, known)
        return sealed(parameters_text(axes, axis, read_parameters(axes, axis)))

    return job


def read_file(content: bytes, name: str, known: Description) -> dict[Key, int]:
    """Read the parameters of an uploaded file; ValueError if it has none or is damaged."""
    with _as_file(content, name) as path:
        return load_parameters(path, known.dictionary)


def restore(
    known: Description, content: bytes, name: str, axis: int, *, unchecked: bool, other_drive: bool
) -> Callable[[Drives], list[Difference]]:
    """Return the job that writes a backup completely or not at all, as `drive-env parameters restore`.

    The job returns the changes.

    Args:
        known: Description of the device.
        content: Content of the file.
        name: Name of the file.
        axis: Number of the axis.
        unchecked: Accept a file that was changed since it was written.
        other_drive: Accept a file that was read from another drive.
    """

    def job(drives: Drives) -> list[Difference]:
        axes = SingleAxes(drives, known)
        with _as_file(content, name) as path:
            wanted = load_parameters(path, known.dictionary)
            written, axis_then = checked_origin(path, unchecked=unchecked)
        check_no_commands(wanted, name, known.hints)
        check_same_drive(name, written, read_identity(axes), other_drive=other_drive)
        if axis_then not in (None, axis) and not other_drive:
            raise ValueError(f"{name} was read from axis {axis_then}, and this is axis {axis}; nothing was written")
        return write_all_or_none(axes, wanted, axis)

    return job


@contextmanager
def _as_file(content: bytes, name: str) -> Iterator[Path]:
    """Write uploaded content to a temporary file with its name."""
    with tempfile.TemporaryDirectory(prefix="drive-env-studio-") as folder:
        path = Path(folder) / (Path(name).name or "parameters.toml")
        path.write_bytes(content)
        yield path
