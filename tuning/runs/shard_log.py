"""Results of shards in a file that is only ever appended to: a killed run leaves it, and goes on from it.

A frame is a line of JSON, which shard it is, how long its data are and their hash, and the data: NumPy arrays. Frames
are complete or recognised as incomplete; what was being written when the process was killed is cut off.
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
    """A file that is not of this run: one line with its remedy."""


class ShardLog:
    """The results of a run's shards so far.

    Args:
        path: The file; made if it is not there.
        key: What the results belong to: a text that another run does not have.

    Raises:
        ShardLogError: If the file belongs to another run, or was begun with other sources.
        OSError: If it cannot be written.
    """

    def __init__(self, path: str | Path, key: str) -> None:
        self.path, self.key = Path(path), key
        self._key = hashlib.sha256(f"{FORMAT} {key}".encode()).hexdigest()
        self.done: dict[int, Arrays] = {}
        self.holds_results = False  # from before the first frame is written: an interrupt may come at any moment
        end = self._read() if self.path.exists() else 0
        self._file: BinaryIO = self.path.open("r+b" if end else "wb")
        self._file.truncate(end)
        self._file.seek(end)
        if end == 0:
            try:
                self._write(json.dumps({"run": self._key, "sources": provenance.SOURCES}).encode() + b"\n")
            except OSError:
                with suppress(OSError):  # what found no room is tried once more
                    self._file.close()
                self.path.unlink()
                raise

    def append(self, shard: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add the result of a shard; once this returns it survives the process."""
        data = io.BytesIO()
        np.savez(data, **arrays)  # type: ignore[arg-type]  # NumPy's own stub takes a keyword for its flag
        content = data.getvalue()
        header = {"shard": shard, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        self.holds_results = True
        self._write(json.dumps(header).encode() + b"\n" + content)
        self.done[shard] = dict(arrays)

    def close(self) -> None:
        """Close the file; it stays."""
        with suppress(OSError):  # what found no room is tried once more, and was told
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
    """Return the next line as JSON, or None if there is no complete one."""
    line = file.readline(LONGEST_HEADER)
    if not line.endswith(b"\n"):
        return None
    try:
        header = parse_json(line)
    except ValueError:
        return None
    return header if isinstance(header, dict) else None
