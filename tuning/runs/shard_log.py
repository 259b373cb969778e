"""Results of shards in a file that is only appended to: an interrupted run leaves it and continues from it.

A frame is a line of JSON with the shard's number, the length of the data and their hash, followed by the data: NumPy
arrays. Incomplete frames are detected and cut off, such as one that was being written when the process was killed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from drive_env.whole_file import naming
from mechanics.reading.untrusted import MOST_ARRAYS, parse_json, read_arrays
from tuning.runs import provenance

Arrays = dict[str, NDArray[Any]]

FORMAT = 2
LONGEST_HEADER = 1000  # bytes


class ShardLogError(ValueError):
    """A file that does not belong to this run: one line with its remedy."""


class ShardLog:
    """The results of a run's shards so far.

    Args:
        path: The file; created if it does not exist.
        key: Text that identifies the run of the results.

    Raises:
        ShardLogError: If the file belongs to another run, or was begun with other sources.
        OSError: If it cannot be written.
    """

    def __init__(self, path: str | Path, key: str) -> None:
        self.path, self.key = Path(path), key
        self._key = hashlib.sha256(f"{FORMAT} {key}".encode()).hexdigest()
        self.done: dict[int, Arrays] = {}
        self.holds_results = False  # set before the first frame is written: an interrupt may come at any time
        end = self._read() if self.path.exists() else 0
        self._file: BinaryIO = self.path.open("r+b" if end else "wb")
        self._file.truncate(end)
        self._file.seek(end)
        if end == 0:
            try:
                self._write(json.dumps({"run": self._key, "sources": provenance.SOURCES}).encode() + b"\n")
            except OSError:
                with suppress(OSError):  # closing tries again to write what did not fit on the disk
                    self._file.close()
                self.path.unlink()
                raise

    def append(self, shard: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add the result of a shard; after this call it survives the process."""
        data = io.BytesIO()
        np.savez(data, **arrays)  # type: ignore[arg-type]  # NumPy's own stub takes a keyword for its flag
        content = data.getvalue()
        header = {"shard": shard, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        self.holds_results = True
        self._write(json.dumps(header).encode() + b"\n" + content)
        self.done[shard] = dict(arrays)

    def close(self) -> None:
        """Close the file; it is not deleted."""
        with suppress(OSError):  # closing tries again to write what did not fit; this was already reported
            self._file.close()

    def __enter__(self) -> ShardLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, frame: bytes) -> None:
        with naming(self.path):
            self._file.write(frame)
            self._file.flush()
            os.fsync(self._file.fileno())

    def _read(self) -> int:
        """Read the complete frames and return where they end."""
        with self.path.open("rb") as file:
            first = _header(file)
            if first is None:
                return 0  # killed before the first line was complete
            try:
                provenance.check_begun(self.path, first.get("sources"), "remove it")
            except ValueError as error:
                raise ShardLogError(str(error)) from None
            if first.get("run") != self._key:
                raise ShardLogError(
                    f"{self.path} holds results of another experiment, or of another version; give the experiment that "
                    "it was begun with, or remove it"
                )
            end = file.tell()
            while (header := _header(file)) is not None and {"shard", "bytes", "sha256"} <= header.keys():
                length = header["bytes"]
                if type(length) is not int or not 0 <= length <= MOST_ARRAYS:
                    break
                content = file.read(length)
                if len(content) < length or hashlib.sha256(content).hexdigest() != header["sha256"]:
                    break
                try:
                    self.done[int(header["shard"])] = read_arrays(io.BytesIO(content))
                except (ValueError, TypeError) as error:
                    raise ShardLogError(f"{self.path} is damaged: {error}; remove it to start again") from None
                self.holds_results = True
                end = file.tell()
        return end


def _header(file: BinaryIO) -> dict[str, Any] | None:
    """Return the next line as JSON; None if it is incomplete or not JSON."""
    line = file.readline(LONGEST_HEADER)
    if not line.endswith(b"\n"):
        return None
    try:
        header = parse_json(line)
    except ValueError:
        return None
    return header if isinstance(header, dict) else None
