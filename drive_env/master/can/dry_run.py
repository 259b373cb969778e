"""A dry run: frames are printed instead of sent, and a drive that obeys at once is simulated.

Since nothing could go on without answers, reads return the dictionary's defaults or the values written before, and the
statusword follows the controlword.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from drive_env import cia402
from drive_env.canopen.frames import SDO_REQUEST
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.fieldbus.description import Description
from drive_env.master.can.port import Handler, Port

# The statusword after each command.
_OFF, _ENABLED = 0x0240, 0x0637  # enabled, and the target is reached
_STATES = {
    "disable voltage": _OFF,
    "quick stop": _OFF,  # at rest again
    "shutdown": 0x0221,
    "switch on": 0x0233,
    "enable operation": _ENABLED,
    "fault reset": _OFF,
}


def show_frame(can_id: int, data: bytes, asked: int | None = None) -> str:
    """Return a frame as candump shows it; `asked` is the length that a remote frame requests, else None."""
    if asked is not None:
        return f"{can_id:03X}   [{asked}]  remote request"
    return f"{can_id:03X}   [{len(data)}]  {data.hex(' ').upper()}".rstrip()


class DryPort(Port):
    """A port that prints frames.

    Args:
        out: Takes a line of text for each frame.
    """

    def __init__(self, out: Callable[[str], None]) -> None:
        self._out = out

    def subscribe(self, can_id: int, handler: Handler | None) -> None:
        """Do nothing: no frame is ever received."""

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False, length: int = 0) -> None:
        """Print a frame."""
        self._out(show_frame(can_id, data, length if remote else None))

    def receive(self, timeout: float = 0.0, done: Callable[[], bool] | None = None) -> bool:
        """Receive nothing, at once."""
        return False

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Do not wait."""
        return True

    def close(self) -> None:
        """Do nothing."""


class DrySdoClient:
    """The SDO client of a simulated node.

    Args:
        port: Prints its requests.
        node: Node-ID.
        description: The simulated device.
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
            self._values[cia402.STATUSWORD + cia402.AXIS_OFFSET * axis, 0] = struct.pack("<H", 0x0240)

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return the bytes written before, or else the dictionary's default."""
        self._request(struct.pack("<BHB4x", 0x40, index, sub))
        return self._values.get((index, sub), b"\0\0\0\0")

    def ask(self, index: int, sub: int, timeout: float) -> bytes | None:
        """Return the bytes that `read` returns, never None."""
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
        base, offset = index % cia402.AXIS_OFFSET, index - index % cia402.AXIS_OFFSET
        if base == cia402.CONTROLWORD % cia402.AXIS_OFFSET and index in cia402.PROFILE_AREAS:
            word = int.from_bytes(data, "little")
            commands = (name for name in _STATES if cia402.matches(word, cia402.COMMANDS[name]))
            status = _STATES.get(next(commands, ""), _OFF)
            if word & cia402.NEW_SET_POINT and status == _ENABLED:
                status |= cia402.SET_POINT_ACKNOWLEDGED.value
            self._values[offset + cia402.STATUSWORD % cia402.AXIS_OFFSET, 0] = struct.pack("<H", status)
        if base == cia402.MODE % cia402.AXIS_OFFSET and index in cia402.PROFILE_AREAS:
            self._values[offset + cia402.MODE_DISPLAY % cia402.AXIS_OFFSET, 0] = data

    def _request(self, data: bytes) -> None:
        self._port.send(SDO_REQUEST + self._node, data)
