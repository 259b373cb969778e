"""Block transfers as a client: one answer per 127 segments instead of one per segment (CiA 301).

Lost segments are sent again: the receiver names the last segment received in order, and the next sub-block begins after
it.
"""

from __future__ import annotations

from typing import Protocol

from canopen.sdo import SdoCommunicationError

from drive_env.node.block_transfer import (
    ACKNOWLEDGE,
    DOWNLOAD,
    DOWNLOAD_RESPONSE,
    END,
    HAS_CRC,
    HAS_SIZE,
    INITIATE,
    LARGEST_BLOCK,
    LAST,
    SEGMENT,
    START,
    UPLOAD,
    UPLOAD_RESPONSE,
    crc,
)

BLOCK_FROM = 128  # bytes from which a block transfer is faster than a segmented one
RETRIES = 3  # consecutive sub-blocks that may arrive incomplete
_CRC_ERROR, _WRONG_COMMAND = 0x05040004, 0x05040001
_COMMAND, _KIND = 0xE3, 0xE1


class NoBlockTransferError(Exception):
    """The server has no block transfer; no transfer has begun."""


class SdoChannel(Protocol):
    """The client's side that a transfer needs; errors are python-canopen's."""

    def send_request(self, request: bytes) -> None:
        """Send a frame."""

    def send_patiently(self, request: bytes) -> None:
        """Send a frame, and wait for room in the buffer if many were sent before."""

    def read_response(self) -> bytes:
        """Return the next frame of the server."""

    def abort(self, abort_code: int) -> None:
        """End the transfer."""


def read(channel: SdoChannel, initiated: bytes) -> bytes:
    """Return the data of an upload whose initiate request was answered; SdoCommunicationError if it fails.

    Args:
        channel: The client.
        initiated: The answer.
    """
    has_crc = bool(initiated[0] & HAS_CRC)
    channel.send_request(bytes((UPLOAD | START,)) + bytes(7))
    content = bytearray()
    is_over, retries = False, 0
    while not is_over:
        count, is_over = _receive_block(channel, content)
        retries = 0 if count else retries + 1
        if retries > RETRIES:
            raise SdoCommunicationError("No SDO response received")
        channel.send_request(bytes((UPLOAD | ACKNOWLEDGE, count, LARGEST_BLOCK)) + bytes(5))
    end = channel.read_response()
    while end[0] & _COMMAND != UPLOAD_RESPONSE | END:  # skip segments that were sent twice
        end = channel.read_response()
    unused = end[0] >> 2 & 0x07
    found = bytes(content[: len(content) - unused])
    if has_crc and crc(found) != end[1] | end[2] << 8:
        channel.abort(_CRC_ERROR)
        raise SdoCommunicationError(f"the checksum of {len(found)} bytes is wrong")
    channel.send_request(bytes((UPLOAD | END,)) + bytes(7))
    return found


def _receive_block(channel: SdoChannel, content: bytearray) -> tuple[int, bool]:
    """Return how many segments of a sub-block came in order, and whether the last segment of all is among them."""
    in_order = 0
    while True:
        try:
            segment = channel.read_response()
        except SdoCommunicationError:
            return in_order, False  # its last segment is lost
        number, is_last = segment[0] & ~LAST, bool(segment[0] & LAST)
        is_next = number == in_order + 1
        if is_next:
            content += segment[1:]
            in_order = number
        if is_last or number == LARGEST_BLOCK:
            return in_order, is_last and is_next


def upload_request(index: int, sub: int) -> bytes:
    """Return the request that begins an upload."""
    head = index.to_bytes(2, "little") + bytes((sub, LARGEST_BLOCK))
    return bytes((UPLOAD | HAS_CRC | INITIATE,)) + head + bytes(3)


def is_upload(answer: bytes) -> bool:
    """Return whether an answer begins an upload."""
    return answer[0] & _KIND == UPLOAD_RESPONSE | INITIATE


def download_request(index: int, sub: int, size: int) -> bytes:
    """Return the request that begins a download of so many bytes."""
    head = index.to_bytes(2, "little") + bytes((sub,))
    return bytes((DOWNLOAD | HAS_CRC | HAS_SIZE | INITIATE,)) + head + size.to_bytes(4, "little")


def is_download(answer: bytes) -> bool:
    """Return whether an answer begins a download."""
    return answer[0] & _COMMAND == DOWNLOAD_RESPONSE | INITIATE


def write(channel: SdoChannel, initiated: bytes, content: bytes) -> None:
    """Send the data of a download whose initiate request was answered; SdoCommunicationError if it fails.

    Args:
        channel: The client.
        initiated: The answer.
        content: All data.
    """
    block_size, position, retries = initiated[4], 0, 0
    while position < len(content):
        if not 1 <= block_size <= LARGEST_BLOCK or retries > RETRIES:
            channel.abort(_WRONG_COMMAND)
            raise SdoCommunicationError(f"the server takes no blocks of {block_size} segments, or loses all")
        sent = 0
        while sent < block_size and position + SEGMENT * sent < len(content):
            begin = position + SEGMENT * sent
            sent += 1
            last = LAST if begin + SEGMENT >= len(content) else 0
            part = content[begin : begin + SEGMENT].ljust(SEGMENT, b"\0")
            channel.send_patiently(bytes((sent | last,)) + part)
        answer = _expect(channel, DOWNLOAD_RESPONSE | ACKNOWLEDGE)
        came, block_size = min(answer[1], sent), answer[2]
        position += SEGMENT * came
        retries = 0 if came else retries + 1
    unused = -len(content) % SEGMENT
    checksum = crc(content) if initiated[0] & HAS_CRC else 0
    channel.send_request(bytes((DOWNLOAD | unused << 2 | END,)) + checksum.to_bytes(2, "little") + bytes(5))
    _expect(channel, DOWNLOAD_RESPONSE | END)


def _expect(channel: SdoChannel, first: int) -> bytes:
    answer = channel.read_response()
    if answer[0] & _COMMAND != first:
        channel.abort(_WRONG_COMMAND)
        raise SdoCommunicationError(f"Unexpected response 0x{answer[0]:02X}")
    return answer
