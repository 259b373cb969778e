"""Block transfers of the SDO server: up to 127 segments, a sub-block, are sent before the other side answers (CiA 301).

A lost segment costs the rest of its sub-block: the receiver names the last segment received in order, and the next
sub-block begins after it. A CRC over all data ends the transfer if both sides support it.
"""

from __future__ import annotations

import binascii
from typing import NamedTuple

from drive_env.dictionary.aborts import (
    CRC_ERROR,
    INVALID_BLOCK_SIZE,
    INVALID_SEQUENCE_NUMBER,
    OUT_OF_MEMORY,
    UNKNOWN_COMMAND,
    ObjectAccessError,
)

SEGMENT = 7  # bytes
LARGEST_BLOCK = 127  # segments
LAST = 0x80  # first byte of a segment: no more follow
# First bytes of requests of the client, and of responses, without the bits that vary.
INITIATE, END, ACKNOWLEDGE, START = 0, 1, 2, 3  # bits 1 and 0
DOWNLOAD, UPLOAD = 0xC0, 0xA0  # client command specifier 6 and 5
DOWNLOAD_RESPONSE, UPLOAD_RESPONSE = 0xA0, 0xC0  # server command specifier 5 and 6
HAS_CRC, HAS_SIZE = 0x04, 0x02
_SPECIFIER, _COMMAND = 0xE0, 0x03


def crc(data: bytes) -> int:
    """Return the checksum of CiA 301: x^16 + x^12 + x^5 + 1, from 0; that of "123456789" is 31C3h."""
    return binascii.crc_hqx(data, 0)


class Received(NamedTuple):
    """The result of a download: the data, complete."""

    data: bytes


class BlockDownload:
    """A block download to the server.

    Args:
        request: The client's initiate request.
        block_size: Number of segments in a sub-block.
        room: Maximum length of the object [bytes].

    Attributes:
        takes_segments: Every frame received now is a segment.
        position: Sequence number of the last received segment, in order or not; 0 at the beginning of a sub-block.
    """

    specifier = DOWNLOAD >> 5

    def __init__(self, request: bytes, block_size: int, room: int) -> None:
        self.multiplexor = request[1:4]
        self.takes_segments = True
        self.position = 0
        self._block_size = block_size
        self._room = -(-room // SEGMENT) * SEGMENT or SEGMENT
        self._has_crc = bool(request[0] & HAS_CRC)
        self._data = bytearray()
        self._in_order = 0

    def initiated(self) -> bytes:
        """Return the response to the initiate request, which announces that the server has a CRC."""
        return bytes((DOWNLOAD_RESPONSE | HAS_CRC | INITIATE,)) + self.multiplexor + bytes((self._block_size, 0, 0, 0))

    def request(self, data: bytes) -> bytes | Received | None:
        """Handle a segment or the end request.

        Returns:
            The response, None if the protocol has none yet, or all data when complete: `ended` confirms them.

        Raises:
            ObjectAccessError: 05040001h, 05040003h, 05040004h or 05040005h.
        """
        return self._segment(data) if self.takes_segments else self._end(data)

    @staticmethod
    def ended() -> bytes:
        """Return the response to an end request whose data were accepted."""
        return bytes((DOWNLOAD_RESPONSE | END,)) + bytes(7)

    def _segment(self, data: bytes) -> bytes | None:
        number, is_last = data[0] & ~LAST, bool(data[0] & LAST)
        if not 1 <= number <= self._block_size:
            raise ObjectAccessError(
                INVALID_SEQUENCE_NUMBER, f"segment {number} of a block of {self._block_size} cannot be"
            )
        self.position = number
        is_next = number == self._in_order + 1
        if is_next:
            self._in_order = number
            self._data += data[1:]
            if len(self._data) > self._room:
                raise ObjectAccessError(OUT_OF_MEMORY, f"{len(self._data)} bytes came, {self._room} have room")
        if not is_last and number < self._block_size:
            return None
        # The last segment counts only if none before it is missing.
        self.takes_segments = not (is_last and is_next)
        in_order, self._in_order, self.position = self._in_order, 0, 0
        return bytes((DOWNLOAD_RESPONSE | ACKNOWLEDGE, in_order, self._block_size)) + bytes(5)

    def _end(self, data: bytes) -> Received:
        if data[0] & (_SPECIFIER | END) != DOWNLOAD | END:
            raise ObjectAccessError(UNKNOWN_COMMAND, "the end of a block download was expected")
        content = bytes(self._data[: len(self._data) - (data[0] >> 2 & 0x07)])
        if self._has_crc and crc(content) != data[1] | data[2] << 8:
            raise ObjectAccessError(CRC_ERROR, f"the checksum of {len(content)} bytes is {crc(content):04X}h")
        return Received(content)


class BlockUpload:
    """A block upload from the server.

    Args:
        request: The client's initiate request.
        content: All data.

    Raises:
        ObjectAccessError: 05040002h for an impossible block size.
    """

    specifier = UPLOAD >> 5
    takes_segments = False
    position = 0

    def __init__(self, request: bytes, content: bytes) -> None:
        self.multiplexor = request[1:4]
        self._content = content
        self._block_size = _checked_size(request[4])
        self._done = 0  # bytes that the client has confirmed
        self._sent = 0  # segments of this sub-block
        self.is_sending = False
        self._is_acknowledged = self._is_started = False

    def initiated(self) -> bytes:
        """Return the response to the initiate request, which announces a CRC and the size."""
        size = len(self._content).to_bytes(4, "little")
        return bytes((UPLOAD_RESPONSE | HAS_CRC | HAS_SIZE | INITIATE,)) + self.multiplexor + size

    def next_segment(self) -> bytes | None:
        """Return the next segment of the sub-block; None when the client has to answer."""
        if not self.is_sending:
            return None
        begin = self._done + SEGMENT * self._sent
        self._sent += 1
        is_last = begin + SEGMENT >= len(self._content)
        self.is_sending = not is_last and self._sent < self._block_size
        part = self._content[begin : begin + SEGMENT]
        return bytes((self._sent | (LAST if is_last else 0),)) + part.ljust(SEGMENT, b"\0")

    def request(self, data: bytes) -> bytes | None:
        """Handle the client's start or acknowledgement; return the response, None if segments follow.

        Raises:
            ObjectAccessError: 05040001h, 05040002h or 05040003h.
        """
        command = data[0] & _COMMAND
        if command == START and not self._is_started:
            self._is_started = self.is_sending = True
            return None
        if command != ACKNOWLEDGE or not self._is_started or self._is_acknowledged:
            raise ObjectAccessError(UNKNOWN_COMMAND, "another step of the block upload was expected")
        if data[1] > self._sent:
            raise ObjectAccessError(
                INVALID_SEQUENCE_NUMBER, f"segment {data[1]} is acknowledged, and {self._sent} were sent"
            )
        self._done += SEGMENT * data[1]
        # Empty data have one segment, too.
        self._is_acknowledged = data[1] > 0 and self._done >= len(self._content)
        if not self._is_acknowledged:
            self._block_size = _checked_size(data[2])
            self._sent, self.is_sending = 0, True
            return None
        checksum = crc(self._content)  # also for clients without CRC: python-canopen checks it all the same
        unused = self._done - len(self._content)
        return bytes((UPLOAD_RESPONSE | unused << 2 | END,)) + checksum.to_bytes(2, "little") + bytes(5)

    def is_confirmed(self, data: bytes) -> bool:
        """Return whether a request is the client's confirmation of the end, which has no response."""
        return self._is_acknowledged and data[0] & (_SPECIFIER | _COMMAND) == UPLOAD | END


def _checked_size(size: int) -> int:
    if not 1 <= size <= LARGEST_BLOCK:
        raise ObjectAccessError(INVALID_BLOCK_SIZE, f"a block has 1 to {LARGEST_BLOCK} segments, not {size}")
    return size


def is_initiate(data: bytes) -> bool:
    """Return whether a request with the block command specifier begins a transfer."""
    if data[0] & _SPECIFIER == UPLOAD:
        return data[0] & _COMMAND == INITIATE
    return data[0] & END == 0  # bit 1 says whether the size is given
