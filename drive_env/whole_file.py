"""Files that are whole or absent, also after a full disk or a power cut, and TOML that shows whether it was changed.

A sealed file ends with a check sum over its content, not over its text: comments and white space may change. One that
is torn has none at its end. It tells of accidents and of a change in passing; it is no signature.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 2  # of sealed files; those before had neither check sum nor identity
_CHECK, _SUM = "check", "sha256"


class FileChangedError(ValueError):
    """A file that is torn, was changed since it was written, or has no check sum that could tell."""


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under another name, have the disk keep it, and give it its name; make its folder if needed.

    A device or pipe (/dev/null) is written directly.

    Raises:
        OSError: If it cannot be written, with the file and the reason; what was there before is there still.
    """
    if path.exists() and not path.is_file():  # another file in its place would be the end of it
        with naming(path), path.open("wb") as device:
            device.write(_bytes(content))
        return
    with files_to_be({path: content}):
        pass


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


@contextmanager
def files_to_be(contents: Mapping[Path, str | bytes]) -> Iterator[None]:
    """Have files written and kept by the disk while a block runs; they get their names at its end, or vanish.

    Raises:
        OSError: If one cannot be written, with the file and the reason.
    """
    named: list[Path] = []
    partial = {path: path.with_name(f".{path.name}.partial") for path in contents}
    try:
        for path, content in contents.items():
            with naming(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                with partial[path].open("wb") as file:
                    file.write(_bytes(content))
                    file.flush()
                    os.fsync(file.fileno())
        yield
        for path in contents:
            with naming(path):
                partial[path].replace(path)
                named.append(path)
                keep_names(path.parent)
    except BaseException:
        # What took another file's place is that file's successor: alone, it is the one there is.
        for path in (*partial.values(), *(named if len(contents) > 1 else ())):
            with suppress(OSError):
                path.unlink(missing_ok=True)
        raise


def write_picture(path: Path, figure: Any, dpi: float) -> None:
    """Write a figure of matplotlib, in the format of the file's ending; raises as `write_whole` does."""
    memory = io.BytesIO()
    figure.savefig(memory, format=path.suffix.removeprefix("."), dpi=dpi)
    write_whole(path, memory.getvalue())


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as a compressed NumPy file; raises as `write_whole` does."""
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, **arrays)
    write_whole(path, memory.getvalue())


def write_table(path: Path, rows: Iterable[Iterable[Any]], lineterminator: str = "\r\n") -> None:
    """Write rows as CSV; raises as `write_whole` does."""
    text = io.StringIO()
    csv.writer(text, lineterminator=lineterminator).writerows(rows)
    write_whole(path, text.getvalue())


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an error name the file that a block writes, which it does not where the disk is full."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def keep_names(folder: Path) -> None:
    """Have the disk keep which files a folder has."""
    if os.name != "posix":  # Windows knows no such thing
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # nor do some file systems
            os.fsync(number)
    finally:
        os.close(number)


def sealed(text: str) -> str:
    """Return a TOML text with the check sum over its content as its last lines."""
    return f'{text.rstrip()}\n\n[{_CHECK}]\n{_SUM} = "{content_hash(tomllib.loads(text))}"\n'


def check_seal(path: Path, table: Mapping[str, Any], *, unchecked: bool = False) -> None:
    """Raise FileChangedError unless a TOML file is as it was written.

    Args:
        path: For the message.
        table: What the file holds.
        unchecked: Accept a changed file, and one without check sum; a truncated one is refused all the same.
    """
    check = table.get(_CHECK)
    stated = check.get(_SUM) if isinstance(check, dict) else None
    if stated is None and "format" in table:
        raise FileChangedError(f"{path} is incomplete: it ends before its check sum; take another copy")
    if unchecked:
        return
    if stated is None:
        raise FileChangedError(
            f"{path} has no check sum: it was written by hand, or by an older version, so that neither its "
            "completeness nor its drive can be checked. Read through it, then restore it with --unchecked"
        )
    if content_hash({name: value for name, value in table.items() if name != _CHECK}) != stated:
        raise FileChangedError(
            f"{path} was changed since it was written: its content does not match its check sum. If you changed it, "
            "read through it, then restore it with --unchecked; otherwise take another copy"
        )


def content_hash(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 over a content: over its JSON with sorted keys and no white space."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
