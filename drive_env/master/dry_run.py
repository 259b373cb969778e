"""A dry run: what would go over the bus is written down, and a drive that obeys at once is imagined behind it.

Without an answer nothing would go on, so reads return the dictionary's defaults or what was written, and the
statusword follows the controlword.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from drive_env.canopen.frames import SDO_REQUEST
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.master.description import PROFILE_OFFSET, Description
from drive_env.master.port import Handler, Port

_CONTROLWORD, _STATUSWORD, _MODE, _MODE_DISPLAY = 0x6040, 0x6041, 0x6060, 0x6061
# Controlword: mask and value, and the statusword of the state it leads to (CiA 402, state coding).
_STATES = (
    ((0x82, 0x00), 0x0240),  # disable voltage: switch on disabled
    ((0x86, 0x02), 0x0240),  # quick stop, at rest again
    ((0x87, 0x06), 0x0221),  # ready to switch on
    ((0x8F, 0x07), 0x0233),  # switched on
    ((0x8F, 0x0F), 0x0637),  # operation enabled, target reached
    ((0x80, 0x80), 0x0240),  # fault reset
)


def show_frame(can_id: int, data: bytes, remote: bool = False) -> str:
    """Return a frame as candump shows it."""
    return f"{can_id:03X}   [{len(data)}]  {'remote request' if remote else data.hex(' ').upper()}".rstrip()


class DryPort(Port):
    """A port that writes frames down.

    Args:
        out: Takes a line of text for each frame.
    """

    def __init__(self, out: Callable[[str], None]) -> None:
        self._out = out

    def subscribe(self, can_id: int, handler: Handler | None) -> None:
        """Do nothing: nothing comes."""

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False, length: int = 0) -> None:
        """Write a frame down."""
        self._out(show_frame(can_id, data, remote))

    def receive(self, timeout: float = 0.0, done: Callable[[], bool] | None = None) -> bool:
        """Receive nothing, at once."""
        return False

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Do not wait."""
        return True

    def close(self) -> None:
        """Do nothing."""


class DrySdoClient:
    """The SDO client of an imagined node.

    Args:
        port: Where its requests are written down.
        node: Node-ID.
        description: What device is imagined.
    """

    def __init__(self, port: DryPort, node: int, description: Description) -> None:
        self._port = port
        self._node = node
        self._values: dict[tuple[int, int], bytes] = {}
        for entry in ObjectDictionary(description.dictionary.path, node):
            self._values[entry.index, entry.sub] = (
                description.encode(entry, entry.default) if description.is_number(entry) else b""
            )
        for axis in range(description.num_axes):
            self._values[_STATUSWORD + PROFILE_OFFSET * axis, 0] = struct.pack("<H", 0x0240)

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return what was written, or else the dictionary's default."""
        self._request(struct.pack("<BHB4x", 0x40, index, sub))
        return self._values.get((index, sub), b"\0\0\0\0")

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return what `read` does."""
        return self.read(index, sub, "", timeout)

    def command(self, index: int, sub: int, data: bytes) -> None:
        """Keep a value."""
        self.write(index, sub, data, "", 0.0)

    def put_back(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Keep a value that was there before."""
        self.write(index, sub, data, label, timeout)

    def write(self, index: int, sub: int, data: bytes, label: str, timeout: float) -> None:
        """Keep a value."""
        if len(data) <= 4:
            command = 0x23 | (4 - len(data)) << 2
            self._request(struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))
        else:
            self._request(struct.pack("<BHBL", 0x21, index, sub, len(data)))
        self._values[index, sub] = data
        base, offset = index % PROFILE_OFFSET, index - index % PROFILE_OFFSET
        if base == _CONTROLWORD % PROFILE_OFFSET and index >= 0x6000:
            word = int.from_bytes(data, "little")
            status = next((status for (mask, value), status in _STATES if word & mask == value), 0x0240)
            status |= 0x1000 if word & 0x10 and status == 0x0637 else 0  # set-point acknowledge
            self._values[offset + _STATUSWORD % PROFILE_OFFSET, 0] = struct.pack("<H", status)
        if base == _MODE % PROFILE_OFFSET and index >= 0x6000:
            self._values[offset + _MODE_DISPLAY % PROFILE_OFFSET, 0] = data

    def _request(self, data: bytes) -> None:
        self._port.send(SDO_REQUEST + self._node, data)
