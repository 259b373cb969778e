"""Parameters of a drive as a file: TOML, with the drive that they were read from and a check sum."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.dictionary.access import check_in_range, check_writable
from drive_env.master.identity import Identity, load_identity, read_identity
from drive_env.whole_file import FORMAT, check_seal
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectDictionary
    from drive_env.drives.interface import DescribedAxes


def checked_origin(file: Path, *, unchecked: bool) -> tuple[Identity | None, int | None]:
    """Return the drive and axis that a file was read from, None if it does not name them; raise if it was changed."""
    table = _read_toml(file)
    check_seal(file, table, unchecked=unchecked)
    identity = table.get("identity")
    if not isinstance(identity, dict):
        return None, None
    axis = identity.get("axis")
    return load_identity(identity), axis if type(axis) is int else None


def parameters_text(drives: DescribedAxes, axis: int, values: Mapping[tuple[int, int], int]) -> str:
    """Return parameters as TOML; the index counts, the objects' names are comments."""
    known = drives.description
    lines = [
        f"# Parameters of node {drives.nodes[0]}. The check sum at the end shows a change, and restore refuses a "
        "changed file.",
        f"format = {FORMAT}",
        f'read = "{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"',
        "",
        "[identity]",
        *read_identity(drives).to_toml(),
        f"axis = {axis}",
    ]
    lines += ["", "[parameters]  # index:sub-index, both hexadecimal"]
    for (index, sub), value in values.items():
        entry = known.dictionary.find((index, sub))
        unit = f" [{entry.unit}]" if entry.unit else ""
        lines.append(f'"{index:04X}:{sub:02X}" = {value}  # {entry.name}{unit}')
    return "\n".join(lines) + "\n"


def load_parameters(path: Path, dictionary: ObjectDictionary) -> dict[tuple[int, int], int]:
    """Read the parameters of a file; ValueError for other files, ObjectAccessError for a wrong object or value."""
    rows = _read_toml(path).get("parameters")
    if not isinstance(rows, dict) or not rows:
        raise ValueError(f"{path} has no table [parameters]; `drive-env parameters backup` writes one")
    values = {}
    for text, value in rows.items():
        index, _, sub = text.partition(":")
        try:
            key = int(index, 16), int(sub or "0", 16)
        except ValueError:
            raise ValueError(f"{path}: {text!r} is not an index:sub-index; write it as 607D:01") from None
        entry = dictionary.find(key)
        check_writable(entry)
        check_in_range(entry, np.asarray(value))
        values[key] = int(value)
    return values


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"there is no file {path}; write one with `drive-env parameters backup {path}`")
    try:
        return read_toml(path)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML, or incomplete: {error}; take another copy") from error
