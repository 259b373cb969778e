"""Files that anybody may have written: read within limits of size, depth and kind, and without running what is in them.

A file that passes a limit is refused before memory is taken for it. All errors are ValueErrors of one line; what a file
means is its reader's matter.
"""

from __future__ import annotations

import io
import json
import math
import re
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

MOST_TEXT = 16_000_000  # bytes of a TOML, JSON, YAML or EDS: the largest that we write has some 100 kB
MOST_RECORDING = 500_000_000  # bytes of a log of frames or samples: an hour of a full bus has some 300 MB
MOST_ARRAYS = 500_000_000  # bytes of the arrays in an .npz, unpacked
MOST_ENTRIES = 10_000  # arrays in an .npz
DEEPEST = 40  # tables and lists in one another
# A dotted key of so many parts, for which tomllib takes memory that grows with the square of their number.
_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"{_PART}(?:[ \t]*\.[ \t]*{_PART}){{{DEEPEST}}}")
MOST_VALUES = 1_000_000  # in a table, each mention of a YAML alias counted

_CONTAINERS = (Mapping, list, tuple)

# What zip, zlib and NumPy raise at a file that is damaged, or made to be: RuntimeError of an encrypted member,
# NotImplementedError of a way of packing that is unknown, SyntaxError of an array's header.
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, TypeError, OverflowError, RuntimeError,
            NotImplementedError, SyntaxError, tokenize.TokenError,
            RecursionError, MemoryError, AttributeError, IndexError)  # fmt: skip


class UntrustedFileError(ValueError):
    """A file passes a limit, or holds what none of its kind does; the message says which."""


class TooLargeError(UntrustedFileError):
    """A file is larger than any of its kind, or would be once it is unpacked."""


def check_size(path: Path, most: int) -> None:
    """Raise UntrustedFileError for a file of more than `most` bytes; OSError if it cannot be looked at."""
    size = path.stat().st_size
    if size > most:
        raise TooLargeError(f"{path} has {size / 1e6:.0f} MB, and {most / 1e6:.0f} MB are read; is it the right file?")


def read_bytes(path: str | Path, most: int = MOST_TEXT) -> bytes:
    """Return a file's bytes.

    Raises:
        UntrustedFileError: If there are more than `most`; a device without end (/dev/zero) has more.
        OSError: If it cannot be read.
    """
    check_size(Path(path), most)
    with Path(path).open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise TooLargeError(f"{path} has more than {most / 1e6:.0f} MB; is it the right file?")
    return content


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file with one end of lines; raises as `read_bytes`, and UnicodeDecodeError."""
    return io.TextIOWrapper(io.BytesIO(read_bytes(path)), encoding="utf-8").read()


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the table in a TOML file.

    Raises:
        tomllib.TOMLDecodeError: If it is none, or passes a limit; UnicodeDecodeError, OSError as reading a file does.
    """
    try:
        return parse_toml(read_text(path))
    except UntrustedFileError as error:
        raise tomllib.TOMLDecodeError(str(error)) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the table in a text; raises tomllib.TOMLDecodeError if it is not TOML or exceeds a limit."""
    if _LONG_KEY.search(text):
        raise tomllib.TOMLDecodeError(_too_deep())
    try:
        table = tomllib.loads(text)
        check_table(table)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError(_too_deep()) from None
    except (ValueError, OverflowError) as error:  # a number of more digits than Python reads, or a limit of ours
        raise tomllib.TOMLDecodeError(str(error)) from None
    return table


def parse_json(text: str | bytes) -> Any:
    """Return the value in a text; raises ValueError if it is not JSON, has NaN, or exceeds a limit.

    JSON has neither NaN nor Infinity, though Python's reader takes both.
    """
    try:
        value = json.loads(text, parse_constant=_no_constant, parse_float=_finite)
    except RecursionError:
        raise UntrustedFileError(_too_deep()) from None
    check_table(value)
    return value


def read_json(path: str | Path) -> Any:
    """Return the value in a JSON file; raises as `parse_json` and `read_text`."""
    return parse_json(read_text(path))


def check_table(value: Any) -> None:
    """Raise UntrustedFileError for what nests deeper than DEEPEST or has more than MOST_VALUES values.

    A table mentioned many times counts each time (YAML's aliases): whoever walks through it meets it each time.
    """
    level, count = [one for one in [value] if isinstance(one, _CONTAINERS)], 0
    for _ in range(DEEPEST):
        below: list[Any] = []
        for one in level:
            inside = one.values() if isinstance(one, Mapping) else one
            count += len(one)
            if count > MOST_VALUES:
                raise UntrustedFileError(f"it holds more than {MOST_VALUES} values")
            below.extend(item for item in inside if isinstance(item, _CONTAINERS))
        if not below:
            return
        level = below
    raise UntrustedFileError(_too_deep())


def read_arrays(source: str | Path | BinaryIO, most: int = MOST_ARRAYS) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers and texts in an .npz; never objects, which would be pickles.

    The directory of the file says how large its members are, and each member's header must say the same: a bomb is
    refused before it is unpacked.

    Raises:
        UntrustedFileError: If it is no .npz, is damaged, or holds more than `most` bytes.
        OSError: If it cannot be read.
    """
    name = source if isinstance(source, str | Path) else "the data"
    try:
        with zipfile.ZipFile(source) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > most or len(members) > MOST_ENTRIES:
                raise TooLargeError(
                    f"{name} would unpack to {size / 1e6:.0f} MB in {len(members)} arrays, and {most / 1e6:.0f} MB in "
                    f"{MOST_ENTRIES} are read; is it the right file?"
                )
            return {member.filename.removesuffix(".npy"): _array(_unpacked(archive, member)) for member in members}
    except UntrustedFileError:
        raise
    except _DAMAGED as error:
        raise UntrustedFileError(f"{name} is not a complete .npz: {_one_line(error)}") from None


def read_member(path: str | Path, name: str, most: int = MOST_TEXT) -> bytes:
    """Return a member of a .zip.

    Raises:
        KeyError: If there is none of that name.
        UntrustedFileError: If it is no .zip, is damaged, or the member has more than `most` bytes.
        OSError: If it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if name not in archive.namelist():
                raise KeyError(name)
            member = archive.getinfo(name)
            if member.file_size > most:
                raise TooLargeError(f"{name} in {path} would unpack to {member.file_size / 1e6:.0f} MB")
            return _unpacked(archive, member)
    except (UntrustedFileError, KeyError):
        raise
    except _DAMAGED as error:
        raise UntrustedFileError(f"{path} is not a complete .zip: {_one_line(error)}") from None


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return a member's bytes, never more than the directory says, whatever was packed."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others are unpacked without a limit
        raise ValueError(f"{member.filename} is packed in another way than .npz and .zip are")
    with archive.open(member) as stream:
        return stream.read(member.file_size)


def _array(content: bytes) -> NDArray[Any]:
    """Return the array in a member, whose bytes are as many as its header says."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, kind = read_header[version](stream)
    if kind.kind not in "fiubcSU" or kind.itemsize == 0:
        raise ValueError(f"an array of {kind} is neither numbers nor text")
    if any(length < 0 for length in shape) or math.prod(shape) * kind.itemsize != len(content) - stream.tell():
        raise ValueError(f"an array says that it is {kind} of shape {shape}, and has {len(content)} bytes")
    stream.seek(0)
    found: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return found


def _one_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _too_deep() -> str:
    return f"tables and lists lie more than {DEEPEST} deep in one another"


def _no_constant(name: str) -> NoReturn:
    raise UntrustedFileError(f"{name} is not a number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise UntrustedFileError(f"{text} is beyond the numbers of a computer")
    return value
