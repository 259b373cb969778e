"""A log of all frames for Wireshark: a pcap file of Ethernet frames with nanoseconds."""

from __future__ import annotations

import struct
from pathlib import Path

from drive_env.whole_file import naming

MAGIC, ETHERNET_LINK, LARGEST = 0xA1B23C4D, 1, 65_535


class PcapLog:
    """Writes frames to a file; its `add` is a listener of a segment.

    Args:
        path: The file, which must not exist.

    Raises:
        OSError: If it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("xb")
        with naming(path):
            self._file.write(struct.pack("<IHHiIII", MAGIC, 2, 4, 0, 0, LARGEST, ETHERNET_LINK))

    def add(self, now: float, frame: bytes, _came_back: bool = False) -> None:
        """Write a frame at world time `now` [s]."""
        seconds, nanoseconds = divmod(round(now * 1e9), 1_000_000_000)
        with naming(self._path):
            self._file.write(struct.pack("<IIII", seconds, nanoseconds, len(frame), len(frame)) + frame)

    def close(self) -> None:
        """Close the file."""
        with naming(self._path):
            self._file.close()

    def __enter__(self) -> PcapLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
