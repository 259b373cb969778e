"""File access over EtherCAT in Bootstrap (ETG.1000.6, 5.8): a firmware image is received, stored and returned.

An emulated drive does not run it, and loses it at power-off.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import ClassVar

LARGEST_IMAGE = 1 << 20  # bytes


class FoeOperation(IntEnum):
    """Operations (ETG.1000.6, table 91)."""

    READ = 1
    WRITE = 2
    DATA = 3
    ACKNOWLEDGE = 4
    ERROR = 5
    BUSY = 6


class FoeError(IntEnum):
    """Errors (ETG.1000.6, table 97)."""

    NOT_FOUND = 0x8001
    DISK_FULL = 0x8003
    ILLEGAL = 0x8004
    PACKET_NUMBER = 0x8005
    BOOTSTRAP_ONLY = 0x8008


class FileServer:
    """A slave's files, by name.

    Attributes:
        images: Completely written files.
    """

    HEADER: ClassVar[int] = 6  # bytes: operation, reserved, and a number whose meaning depends on the operation

    def __init__(self) -> None:
        self.images: dict[str, bytes] = {}
        self.close()

    def close(self) -> None:
        """Forget an open transfer."""
        self._name: str | None = None
        self._is_read = False
        self._data = bytearray()
        self._packet = 0

    def request(self, message: bytes, full: int, room: int, *, is_bootstrap: bool) -> bytes | None:
        """Return the answer to a message, both without mailbox header; None without an answer.

        Args:
            message: The message.
            full: Length of the longest message from the master [bytes]; a shorter data packet is the last.
            room: Length of the longest answer [bytes].
            is_bootstrap: Whether the slave is in Bootstrap; in other states it has no files.
        """
        operation, number = message[0], struct.unpack_from("<I", message, 2)[0]
        if not is_bootstrap:
            return _error(FoeError.BOOTSTRAP_ONLY, "files are taken and given in Bootstrap alone")
        content = message[self.HEADER :]
        if operation == FoeOperation.WRITE:
            self.close()
            self._name = content.split(b"\0")[0].decode("latin-1")
            return _numbered(FoeOperation.ACKNOWLEDGE, 0)
        if operation == FoeOperation.READ:
            return self._read(content.split(b"\0")[0].decode("latin-1"), room)
        if operation == FoeOperation.DATA:
            return self._take(number, content, full)
        if operation == FoeOperation.ACKNOWLEDGE:
            return self._go_on(number, room)
        self.close()
        if operation in (FoeOperation.ERROR, FoeOperation.BUSY):
            return None
        return _error(FoeError.ILLEGAL, f"operation {operation} is not one of FoE")

    # --- inside -----------------------------------------------------------------------------------------------------
    def _take(self, number: int, content: bytes, full: int) -> bytes:
        if self._name is None or self._is_read or number != self._packet + 1:
            is_open = self._name is not None and not self._is_read
            expected = self._packet + 1
            self.close()
            if is_open:
                return _error(FoeError.PACKET_NUMBER, f"packet {number} came, {expected} is next")
            return _error(FoeError.ILLEGAL, "data of a file that is not being written")
        if len(self._data) + len(content) > LARGEST_IMAGE:
            self.close()
            return _error(FoeError.DISK_FULL, f"an image has {LARGEST_IMAGE} bytes at most")
        self._data += content
        self._packet = number
        if len(content) < full - self.HEADER:
            self.images = {self._name: bytes(self._data)}  # it keeps one image
            self.close()
        return _numbered(FoeOperation.ACKNOWLEDGE, number)

    def _read(self, name: str, room: int) -> bytes:
        self.close()
        if name not in self.images:
            return _error(FoeError.NOT_FOUND, f"there is no {name}")
        self._name, self._is_read, self._data = name, True, bytearray(self.images[name])
        return self._packet_of(1, room)

    def _go_on(self, number: int, room: int) -> bytes | None:
        if not self._is_read or number != self._packet:
            self.close()
            return _error(FoeError.ILLEGAL, "nothing was sent that this acknowledges")
        if number * (room - self.HEADER) > len(self._data):
            self.close()
            return None
        return self._packet_of(number + 1, room)

    def _packet_of(self, number: int, room: int) -> bytes:
        size = room - self.HEADER
        self._packet = number
        return _numbered(FoeOperation.DATA, number) + bytes(self._data[(number - 1) * size : number * size])


def _numbered(operation: FoeOperation, number: int) -> bytes:
    return struct.pack("<BBI", operation, 0, number)


def _error(code: FoeError, text: str) -> bytes:
    return _numbered(FoeOperation.ERROR, code) + text.encode("latin-1", "replace")
