"""The SDO server: expedited and segmented transfers (CiA 301, 7.2.4).

A request and the time go in, the response comes out: eight bytes, or None where the protocol has no response.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drive_env.dictionary.aborts import (
    PROTOCOL_TIMED_OUT,
    TOGGLE_NOT_ALTERNATED,
    TOO_LONG,
    TOO_SHORT,
    UNKNOWN_COMMAND,
    WRONG_TYPE,
    ObjectAccessError,
)
from drive_env.dictionary.access import check_readable, check_writable
from drive_env.dictionary.entries import Entry
from drive_env.node.axis import ObjectPort

# Client command specifiers, bits 7...5 of the first byte.
DOWNLOAD_SEGMENT, INITIATE_DOWNLOAD, INITIATE_UPLOAD, UPLOAD_SEGMENT, ABORT, BLOCK_UPLOAD, BLOCK_DOWNLOAD = range(7)
# First bytes of responses.
DOWNLOAD_CONFIRMED, SEGMENT_CONFIRMED, ABORTED = 0x60, 0x20, 0x80
EXPEDITED_UPLOAD, SEGMENTED_UPLOAD = 0x43, 0x41
TOGGLE = 0x10
SEGMENT = 7  # bytes
EPSILON = 1e-6  # s: times are sums of cycles


@dataclass(slots=True)
class Transfer:
    """A segmented transfer that is open; `expected` is the length [bytes] that the client announced."""

    entry: Entry
    multiplexor: bytes
    data: bytearray
    is_upload: bool
    last: float
    port: ObjectPort | None = None
    expected: int | None = None
    position: int = 0
    toggle: int = 0


class SdoServer:
    """One server: one transfer at a time.

    Args:
        port: Finds an object by index and sub-index; raises ObjectAccessError.
        timeout: Time [s] after which an open transfer is given up.
    """

    def __init__(self, port: Callable[[int, int], ObjectPort], timeout: float) -> None:
        self._port = port
        self._timeout = timeout
        self._open: Transfer | None = None

    def request(self, data: bytes, now: float) -> bytes | None:
        """Return the response to a request that came at `now` [s]; a frame of other than 8 bytes is no request."""
        if len(data) != 8:
            return None
        specifier = data[0] >> 5
        if specifier == ABORT:
            self._open = None
            return None
        try:
            if specifier == INITIATE_UPLOAD:
                return self._initiate_upload(data, now)
            if specifier == INITIATE_DOWNLOAD:
                return self._initiate_download(data, now)
            if specifier == UPLOAD_SEGMENT:
                return self._upload_segment(data, now)
            if specifier == DOWNLOAD_SEGMENT:
                return self._download_segment(data, now)
        except ObjectAccessError as error:
            # Of a segment, which carries no multiplexor, it is the transfer's.
            is_segment = specifier in (DOWNLOAD_SEGMENT, UPLOAD_SEGMENT)
            multiplexor = self._open.multiplexor if is_segment and self._open else bytes(3) if is_segment else data[1:4]
            self._open = None
            return _abort(multiplexor, error.abort_code)
        # Block transfer, which this server does not have, or a specifier that nobody has.
        self._open = None
        return _abort(data[1:4], UNKNOWN_COMMAND)

    def expire(self, now: float) -> bytes | None:
        """Return the abort of a transfer whose client has been silent for too long, None as long as there is none."""
        if self._open is None or now - self._open.last < self._timeout - EPSILON:
            return None
        multiplexor, self._open = self._open.multiplexor, None
        return _abort(multiplexor, PROTOCOL_TIMED_OUT)

    def close(self) -> None:
        """Forget an open transfer."""
        self._open = None

    # --- inside: upload is what the client reads ------------------------------------------------------------------
    def _initiate_upload(self, data: bytes, now: float) -> bytes:
        self._open = None
        port = self._port(data[1] | data[2] << 8, data[3])
        check_readable(port.entry)
        content = encode(port.entry, port.read())
        size = len(content)
        if 1 <= size <= 4:
            return bytes((EXPEDITED_UPLOAD | (4 - size) << 2,)) + data[1:4] + content + bytes(4 - size)
        self._open = Transfer(port.entry, data[1:4], bytearray(content), True, now)
        return bytes((SEGMENTED_UPLOAD,)) + data[1:4] + size.to_bytes(4, "little")

    def _upload_segment(self, data: bytes, now: float) -> bytes:
        transfer = self._transfer(data, now, is_upload=True)
        part = transfer.data[transfer.position : transfer.position + SEGMENT]
        transfer.position += len(part)
        is_last = transfer.position >= len(transfer.data)
        first = transfer.toggle | (SEGMENT - len(part)) << 1 | is_last
        transfer.toggle ^= TOGGLE
        if is_last:
            self._open = None
        return bytes((first,)) + part + bytes(SEGMENT - len(part))

    def _initiate_download(self, data: bytes, now: float) -> bytes:
        self._open = None
        port = self._port(data[1] | data[2] << 8, data[3])
        entry = port.entry
        check_writable(entry)
        is_expedited, has_size = data[0] & 0x02, data[0] & 0x01
        if is_expedited:
            size = 4 - (data[0] >> 2 & 0x03) if has_size else _size(entry)
            _check_length(entry, size)
            _store(port, data[4 : 4 + size])
        else:
            expected = int.from_bytes(data[4:8], "little") if has_size else None
            if expected is not None:
                _check_length(entry, expected)
            self._open = Transfer(entry, data[1:4], bytearray(), False, now, port, expected)
        return bytes((DOWNLOAD_CONFIRMED,)) + data[1:4] + bytes(4)

    def _download_segment(self, data: bytes, now: float) -> bytes:
        transfer = self._transfer(data, now, is_upload=False)
        assert transfer.port is not None
        transfer.data += data[1 : 8 - (data[0] >> 1 & 0x07)]
        if len(transfer.data) > _size(transfer.entry):
            _check_length(transfer.entry, len(transfer.data))
        if data[0] & 0x01:
            _check_length(transfer.entry, len(transfer.data))
            _store(transfer.port, bytes(transfer.data))
            self._open = None
        toggle = transfer.toggle
        transfer.toggle ^= TOGGLE
        return bytes((SEGMENT_CONFIRMED | toggle,)) + bytes(7)

    def _transfer(self, data: bytes, now: float, *, is_upload: bool) -> Transfer:
        """Return the open transfer that a segment belongs to, which proves that its client lives."""
        transfer = self._open
        if transfer is None or transfer.is_upload != is_upload:
            raise ObjectAccessError(UNKNOWN_COMMAND, "a segment of a transfer that was not initiated")
        if data[0] & TOGGLE != transfer.toggle:
            raise ObjectAccessError(TOGGLE_NOT_ALTERNATED, "the toggle bit did not alternate")
        transfer.last = now
        return transfer


def encode(entry: Entry, value: int | str) -> bytes:
    """Return a value as the wire carries it."""
    if isinstance(value, str):
        return value.encode("latin-1", "replace")
    assert entry.bits is not None, "a number has a width"
    return value.to_bytes(_size(entry), "little", signed=entry.signed)


def _size(entry: Entry) -> int:
    """Return the length [bytes] of an object; 0 of a text, which is as long as it is."""
    return 0 if entry.bits is None else (entry.bits + 7) // 8


def _check_length(entry: Entry, size: int) -> None:
    """Raise 06070012h or 06070013h for data of another length [bytes] than the object's."""
    if entry.bits is None:
        raise ObjectAccessError(WRONG_TYPE, f"{entry.label} is a text; only numbers can be written")
    if size > _size(entry):
        raise ObjectAccessError(TOO_LONG, f"{entry.label} has {_size(entry)} bytes, not {size}")
    if size < _size(entry):
        raise ObjectAccessError(TOO_SHORT, f"{entry.label} has {_size(entry)} bytes, not {size}")


def _store(port: ObjectPort, content: bytes) -> None:
    raw = int.from_bytes(content, "little", signed=port.entry.signed)
    port.check(raw)
    port.write(raw)


def _abort(multiplexor: bytes, code: int) -> bytes:
    return bytes((ABORTED,)) + multiplexor + code.to_bytes(4, "little")
