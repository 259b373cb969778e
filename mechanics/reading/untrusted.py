"""Untrusted files: read within limits of size, depth and type, without executing their content.

A file beyond a limit is refused before memory is allocated for it. All errors are ValueErrors of one line; the meaning
of a file is left to its reader.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import stat
import sys
import tokenize
import tomllib
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

MOST_TEXT = 16_000_000  # bytes of a JSON, YAML, EDS or MJCF: the largest of our own has some 100 kB
MOST_TOML = 4_000_000  # bytes; tomllib reads about 1 MB/s
MOST_RECORDING = 500_000_000  # bytes of a log of frames or samples: an hour of a full bus has some 300 MB
MOST_LINE = 1_000_000  # letters of a line of a CSV
MOST_ARRAYS = 500_000_000  # bytes of the arrays in an .npz, unpacked
MOST_ENTRIES = 10_000  # arrays in an .npz
DEEPEST = 40  # nested tables and lists
MOST_VALUES = 1_000_000  # in a table, each mention of a YAML alias counted
MOST_ELEMENTS = 500_000  # of an XML: the ESI of a maker's whole series has some 300,000
MOST_TOML_VALUES = 200_000  # and parts of keys: each part of a dotted key is a table

# Cases that tomllib does not limit are checked before: its memory grows with the square of a key's parts. Each pattern
# passes any text only once: it never backtracks, and a string without an end extends to the end of the text.
_TOML_STRINGS = re.compile(
    r'''"""(?:[^"\\]++|\\(?:.|\Z)|"(?!""))*+(?:"{3,5}|\Z)'''
    r"""|'''(?:[^']++|'(?!''))*+(?:'{3,5}|\Z)"""
    r"""|"(?:[^"\\\n]++|\\[^\n]?)*+"?|'[^'\n]*+'?|\#[^\n]*+""",
    re.DOTALL,
)
_TOML_PART = r"""(?:[A-Za-z0-9_-]++|")"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_TOML_PART}(?:[ \t]*+\.[ \t]*+{_TOML_PART}){{{DEEPEST}}}")
_BRACKET = re.compile(r"[\[\]{}]")

_CONTAINERS = (Mapping, list, tuple)

# Exceptions of zip, zlib and NumPy for a damaged or malicious file: RuntimeError for an encrypted member,
# NotImplementedError for an unknown compression, SyntaxError for an array's header.
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, TypeError, OverflowError, RuntimeError,
            NotImplementedError, SyntaxError, tokenize.TokenError,
            RecursionError, MemoryError, AttributeError, IndexError)  # fmt: skip


class UntrustedFileError(ValueError):
    """A file exceeds a limit, or has impossible content for its type; the message says which."""


class TooLargeError(UntrustedFileError):
    """A file is larger than any of its type, or would be after unpacking."""


def check_size(path: Path, most: int) -> None:
    """Raise UntrustedFileError for a file that is not regular or has more than `most` bytes, OSError for an absent one.

    Opening a pipe waits for its writer, and a device may be endless.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode):  # opening a folder fails by itself
        raise UntrustedFileError(f"{path} is a pipe or a device; give a file, copied from it if need be")
    if found.st_size > most:
        raise TooLargeError(
            f"{path} has {found.st_size / 1e6:.0f} MB, and {most / 1e6:.0f} MB are read; is it the right file?"
        )


def read_bytes(path: str | Path, most: int = MOST_TEXT) -> bytes:
    """Return a file's bytes.

    Raises:
        UntrustedFileError: If it has more than `most` bytes, or is a pipe or a device.
        OSError: If it cannot be read.
    """
    check_size(Path(path), most)
    with Path(path).open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise TooLargeError(f"{path} has more than {most / 1e6:.0f} MB; is it the right file?")
    return content


def read_start(path: str | Path, count: int) -> bytes:
    """Return the first `count` bytes of a file, however long it is; UntrustedFileError for a pipe or a device."""
    check_size(Path(path), sys.maxsize)
    with Path(path).open("rb") as file:
        return file.read(count)


def read_text(path: str | Path, most: int = MOST_TEXT) -> str:
    """Return the text of a UTF-8 file with uniform line ends; raises as `read_bytes`, and UnicodeDecodeError."""
    return io.TextIOWrapper(io.BytesIO(read_bytes(path, most)), encoding="utf-8").read()


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the table in a TOML file.

    Raises:
        tomllib.TOMLDecodeError: If it is not TOML, or exceeds a limit; UnicodeDecodeError, OSError as reading a file
            does.
    """
    try:
        return parse_toml(read_text(path, MOST_TOML))
    except UntrustedFileError as error:
        raise tomllib.TOMLDecodeError(str(error)) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the table in a text; raises tomllib.TOMLDecodeError if it is not TOML or exceeds a limit."""
    try:
        _check_toml(text)
        table = tomllib.loads(text)
        check_table(table)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError(_too_deep()) from None
    except (ValueError, OverflowError) as error:  # a number with more digits than Python reads, or a limit of ours
        raise tomllib.TOMLDecodeError(str(error)) from None
    return table


def parse_json(text: str | bytes) -> Any:
    """Return the value in a text.

    JSON has neither NaN nor Infinity, although Python's reader accepts both. For a duplicate name in a table Python's
    reader drops the first value, so a person might read another value than the program.

    Raises:
        ValueError: If it is not JSON, has NaN, a name twice in one table, or exceeds a limit.
    """
    try:
        text = text if isinstance(text, str) else text.decode("utf-8-sig")
        if sum(map(text.count, ",[{")) > 2 * MOST_VALUES:  # values and containers, before allocating memory
            raise UntrustedFileError(_too_many())
        value = json.loads(
            text, parse_constant=_no_constant, parse_float=_finite, object_pairs_hook=_table_of_different_names
        )
    except RecursionError:
        raise UntrustedFileError(_too_deep()) from None
    check_table(value)
    return value


def read_json(path: str | Path) -> Any:
    """Return the value in a JSON file; raises as `parse_json` and `read_text`."""
    return parse_json(read_text(path))


def parse_xml(content: bytes) -> ET.Element:
    """Return the root of an XML document; names of elements are without their namespaces.

    A document type is refused: entities, which may grow without end or name other files, can only be declared in one.

    Raises:
        UntrustedFileError: If it is not XML, has a document type, or exceeds a limit.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    depth = count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST:
            raise UntrustedFileError(f"its elements lie more than {DEEPEST} deep in one another")
        if count > MOST_ELEMENTS:
            raise UntrustedFileError(f"it has more than {MOST_ELEMENTS} elements; leave out those that you do not need")
        builder.start(tag.rpartition(":")[2], attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag.rpartition(":")[2])

    def refuse(*_: object) -> NoReturn:
        raise UntrustedFileError("it has a document type (<!DOCTYPE ...>), which is not read; delete that declaration")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
        return builder.close()
    except expat.ExpatError as error:
        raise UntrustedFileError(f"it is not XML: {error}") from None
    except (LookupError, ValueError) as error:
        if isinstance(error, UntrustedFileError):
            raise
        raise UntrustedFileError(f"it is not XML in an encoding that is known: {_one_line(error)}") from None


def read_rows(path: str | Path) -> Iterator[list[str]]:
    """Yield the rows of a CSV line by line.

    Raises:
        UntrustedFileError: As `check_size`, and for a line of more than MOST_LINE letters.
        csv.Error: If it is not a CSV file; UnicodeDecodeError, OSError as reading a file does.
    """
    check_size(Path(path), MOST_RECORDING)
    with Path(path).open(newline="", encoding="utf-8") as file:
        yield from csv.reader(iter(lambda: _short(path, file.readline(MOST_LINE + 1)), ""))


def _short(path: str | Path, line: str) -> str:
    if len(line) > MOST_LINE:
        raise UntrustedFileError(f"{path} has a line of more than {MOST_LINE} letters; is it the right file?")
    return line


def check_table(value: Any) -> None:
    """Raise UntrustedFileError for a value nested deeper than DEEPEST, or with more than MOST_VALUES values.

    A table mentioned several times (YAML's aliases) counts each time, since a reader visits it each time.
    """
    level, count = [one for one in [value] if isinstance(one, _CONTAINERS)], 0
    for _ in range(DEEPEST):
        below: list[Any] = []
        for one in level:
            inside = one.values() if isinstance(one, Mapping) else one
            count += len(one)
            if count > MOST_VALUES:
                raise UntrustedFileError(_too_many())
            below.extend(item for item in inside if isinstance(item, _CONTAINERS))
        if not below:
            return
        level = below
    raise UntrustedFileError(_too_deep())


def read_arrays(source: str | Path | BinaryIO, most: int = MOST_ARRAYS) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers and texts in an .npz; never objects, which would be pickles.

    The sizes in the file's directory must equal those in each member's header: a bomb is refused before it is unpacked.

    Raises:
        UntrustedFileError: If it is not an .npz, is damaged, or holds more than `most` bytes.
        OSError: If it cannot be read.
    """
    name = source if isinstance(source, str | Path) else "the data"
    if isinstance(source, str | Path):
        check_size(Path(source), MOST_ARRAYS)
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
        KeyError: If there is no such member.
        UntrustedFileError: If it is not a .zip, is damaged, or the member has more than `most` bytes.
        OSError: If it cannot be read.
    """
    check_size(Path(path), sys.maxsize)
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


def member_names(path: str | Path) -> list[str]:
    """Return the names of the members of a .zip; raises as `read_member`."""
    check_size(Path(path), sys.maxsize)
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except _DAMAGED as error:
        raise UntrustedFileError(f"{path} is not a complete .zip: {_one_line(error)}") from None


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return a member's bytes, at most as many as the directory says."""
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


def _check_toml(text: str) -> None:
    """Raise UntrustedFileError for text that would take tomllib memory or time far beyond its length."""
    if len(text) > MOST_TOML:
        raise TooLargeError(f"it has {len(text) / 1e6:.0f} MB, and {MOST_TOML / 1e6:.0f} MB of TOML are read")
    bare = _TOML_STRINGS.sub('"', text)  # strings and comments nest nothing
    if _LONG_KEY.search(bare):
        raise UntrustedFileError(_too_deep())
    if sum(map(bare.count, ",=.[{")) > MOST_TOML_VALUES:
        raise UntrustedFileError(_too_many(MOST_TOML_VALUES))
    depth = 0
    for bracket in _BRACKET.findall(bare):
        depth += 1 if bracket in "[{" else -1
        if depth > DEEPEST:
            raise UntrustedFileError(_too_deep())


def _table_of_different_names(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the table of a JSON object; UntrustedFileError for a duplicate name."""
    pairs = list(pairs)
    table = dict(pairs)
    if len(table) < len(pairs):
        name = next(name for name, count in Counter(name for name, _ in pairs).items() if count > 1)
        raise UntrustedFileError(f"the name {name[:100]!r} stands twice in one table; leave one of them")
    return table


def _too_many(most: int = MOST_VALUES) -> str:
    return f"it holds more than {most} values"


def _too_deep() -> str:
    return f"tables and lists lie more than {DEEPEST} deep in one another"


def _no_constant(name: str) -> NoReturn:
    raise UntrustedFileError(f"{name} is not a number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise UntrustedFileError(f"{text} is beyond the numbers of a computer")
    return value
