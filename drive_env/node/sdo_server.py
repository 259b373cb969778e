"""The SDO server: expedited, segmented and block transfers (CiA 301, 7.2.4).

A call takes a request and the time, and returns the response: eight bytes, or None if the protocol has no response. The
segments of a block upload are fetched one by one, when the bus can carry them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drive_env.dictionary.aborts import (
    CANNOT_BE_STORED,
    OUT_OF_MEMORY,
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
from drive_env.node.block_transfer import HAS_SIZE, BlockDownload, BlockUpload, Received, is_initiate

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
        block_size: Segments of a sub-block in block transfers; 0: no block transfers.
        longest_text: Longest string or domain that can be written [bytes]; 0: not writable.

    Attributes:
        block: The open block transfer; None between transfers.
    """

    def __init__(
        self, port: Callable[[int, int], ObjectPort], timeout: float, block_size: int, longest_text: int
    ) -> None:
        self._port = port
        self._timeout = timeout
        self._block_size = block_size
        self._longest_text = longest_text
        self._open: Transfer | None = None
        self.block: BlockDownload | BlockUpload | None = None
        self._block_port: ObjectPort | None = None  # of a block download
        self._block_size_said: int | None = None
        self._last: float  # last activity of a block transfer [s]
        self._leftover = 0  # next segment of an aborted sub-block: segments from it on are not requests
        self._services = {
            INITIATE_UPLOAD: self._initiate_upload,
            INITIATE_DOWNLOAD: self._initiate_download,
            UPLOAD_SEGMENT: self._upload_segment,
            DOWNLOAD_SEGMENT: self._download_segment,
        }

    def request(self, data: bytes, now: float) -> bytes | None:
        """Return the response to a request received at `now` [s]; None without, as for a frame not of 8 bytes."""
        if len(data) != 8:
            return None
        specifier = data[0] >> 5
        if self.block is not None:
            if data[0] != ABORTED and self._is_of_block(self.block, data):
                return self._go_on(self.block, data, now)
            self.block = None
        elif self._leftover and self._is_leftover(data):
            return None
        if specifier == ABORT:
            self._open = None
            return None
        try:
            if specifier in self._services:
                return self._services[specifier](data, now)
            if self._block_size and specifier in (BLOCK_UPLOAD, BLOCK_DOWNLOAD) and is_initiate(data):
                self._open = None
                return self._initiate_block(data, now)
        except ObjectAccessError as error:
            # A segment has no multiplexor: that of its transfer applies.
            is_segment = specifier in (DOWNLOAD_SEGMENT, UPLOAD_SEGMENT)
            multiplexor = self._open.multiplexor if is_segment and self._open else bytes(3) if is_segment else data[1:4]
            self._open = None
            return _abort(multiplexor, error.abort_code)
        # A block transfer without server support, a step of a transfer that is not open, or an unknown specifier.
        self._open = None
        names_object = self._block_size == 0 or specifier not in (BLOCK_UPLOAD, BLOCK_DOWNLOAD)
        return _abort(data[1:4] if names_object else bytes(3), UNKNOWN_COMMAND)

    def next_segment(self, now: float) -> bytes | None:
        """Return the next segment of a block upload, to be sent at `now` [s]; None without a segment to send."""
        if not isinstance(self.block, BlockUpload):
            return None
        segment = self.block.next_segment()
        if segment is not None:
            self._last = now
        return segment

    def expire(self, now: float) -> bytes | None:
        """Return the abort of a transfer whose client has been silent for too long; None if no client was."""
        if self.block is not None:
            if now - self._last < self._timeout - EPSILON:
                return None
            block, self.block = self.block, None
            return _abort(block.multiplexor, PROTOCOL_TIMED_OUT)
        if self._open is None or now - self._open.last < self._timeout - EPSILON:
            return None
        multiplexor, self._open = self._open.multiplexor, None
        return _abort(multiplexor, PROTOCOL_TIMED_OUT)

    def close(self) -> None:
        """Forget an open transfer."""
        self._open = self.block = None
        self._leftover = 0

    # --- inside: upload is what the client reads ------------------------------------------------------------------
    def _initiate_upload(self, data: bytes, now: float) -> bytes:
        self._open = None
        port = self._port(data[1] | data[2] << 8, data[3])
        check_readable(port.entry)
        return self._begin_upload(port.entry, data[1:4], encode(port.entry, port.read()), now)

    def _begin_upload(self, entry: Entry, multiplexor: bytes, content: bytes, now: float) -> bytes:
        size = len(content)
        if 1 <= size <= 4:
            return bytes((EXPEDITED_UPLOAD | (4 - size) << 2,)) + multiplexor + content + bytes(4 - size)
        self._open = Transfer(entry, multiplexor, bytearray(content), True, now)
        return bytes((SEGMENTED_UPLOAD,)) + multiplexor + size.to_bytes(4, "little")

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
            size = 4 - (data[0] >> 2 & 0x03) if has_size else size_of(entry) or 4
            self._check_length(entry, size)
            take(port, data[4 : 4 + size])
        else:
            expected = int.from_bytes(data[4:8], "little") if has_size else None
            if expected is not None:
                self._check_length(entry, expected)
            self._open = Transfer(entry, data[1:4], bytearray(), False, now, port, expected)
        return bytes((DOWNLOAD_CONFIRMED,)) + data[1:4] + bytes(4)

    def _download_segment(self, data: bytes, now: float) -> bytes:
        transfer = self._transfer(data, now, is_upload=False)
        assert transfer.port is not None
        transfer.data += data[1 : 8 - (data[0] >> 1 & 0x07)]
        if len(transfer.data) > self._room(transfer.entry):
            self._check_length(transfer.entry, len(transfer.data))
        if data[0] & 0x01:
            self._check_length(transfer.entry, len(transfer.data), transfer.expected)
            take(transfer.port, bytes(transfer.data))
            self._open = None
        toggle = transfer.toggle
        transfer.toggle ^= TOGGLE
        return bytes((SEGMENT_CONFIRMED | toggle,)) + bytes(7)

    # --- block transfers ------------------------------------------------------------------------------------------
    def _initiate_block(self, data: bytes, now: float) -> bytes:
        port = self._port(data[1] | data[2] << 8, data[3])
        entry = port.entry
        self._last = now
        if data[0] >> 5 == BLOCK_DOWNLOAD:
            check_writable(entry)
            self._block_size_said = int.from_bytes(data[4:8], "little") if data[0] & HAS_SIZE else None
            if entry.bits is None or self._block_size_said is not None:
                self._check_length(entry, self._block_size_said or 0)
            self._block_port = port
            self.block = BlockDownload(data, self._block_size, self._room(entry))
            return self.block.initiated()
        check_readable(entry)
        content = encode(entry, port.read())
        upload = BlockUpload(data, content)
        if 0 < data[5] >= len(content):  # protocol switch threshold: short values go by the other protocol
            return self._begin_upload(entry, data[1:4], content, now)
        self.block = upload
        return upload.initiated()

    @staticmethod
    def _is_of_block(block: BlockDownload | BlockUpload, data: bytes) -> bool:
        """Return whether a request continues the open block transfer; any other request replaces it."""
        return block.takes_segments or (data[0] >> 5 == block.specifier and not is_initiate(data))

    def _go_on(self, block: BlockDownload | BlockUpload, data: bytes, now: float) -> bytes | None:
        self._last = now
        try:
            if isinstance(block, BlockUpload):
                if block.is_confirmed(data):
                    self.block = None
                    return None
                return block.request(data)
            answer = block.request(data)
            if not isinstance(answer, Received):
                return answer
            port = self._block_port
            assert port is not None
            self._check_length(port.entry, len(answer.data), self._block_size_said)
            take(port, answer.data)
        except ObjectAccessError as error:
            self._leftover = block.position
            self.block = None
            return _abort(block.multiplexor, error.abort_code)
        self.block = None
        return block.ended()

    def _is_leftover(self, data: bytes) -> bool:
        """Return whether a frame is a segment that was under way when its sub-block was aborted.

        It could be mistaken for a write, since its bytes may look like a command and an object.
        """
        number = data[0] & 0x7F
        if number != self._leftover + 1:
            self._leftover = 0
            return False
        self._leftover = 0 if data[0] & 0x80 or number >= self._block_size else number
        return True

    def _room(self, entry: Entry) -> int:
        """Return the maximum length of an object [bytes]."""
        return self._longest_text if entry.bits is None else size_of(entry)

    def _check_length(self, entry: Entry, size: int, expected: int | None = None) -> None:
        """Raise 0607xxxxh for data of another length [bytes] than the object's, or than the client announced."""
        if entry.bits is None and self._longest_text:
            if size > self._longest_text:
                raise ObjectAccessError(
                    OUT_OF_MEMORY, f"{entry.label} has room for {self._longest_text} bytes, not {size}"
                )
        else:
            check_length(entry, size)
        if expected is not None and size != expected:
            raise ObjectAccessError(
                TOO_LONG if size > expected else TOO_SHORT, f"{size} bytes came, {expected} were announced"
            )

    def _transfer(self, data: bytes, now: float, *, is_upload: bool) -> Transfer:
        """Return the open transfer of a segment, and restart its time-out."""
        transfer = self._open
        if transfer is None or transfer.is_upload != is_upload:
            raise ObjectAccessError(UNKNOWN_COMMAND, "a segment of a transfer that was not initiated")
        if data[0] & TOGGLE != transfer.toggle:
            raise ObjectAccessError(TOGGLE_NOT_ALTERNATED, "the toggle bit did not alternate")
        transfer.last = now
        return transfer


def encode(entry: Entry, value: int | str) -> bytes:
    """Return a value as bytes on the bus."""
    if isinstance(value, str):
        return value.encode("latin-1", "replace")
    assert entry.bits is not None, "a number has a width"
    return value.to_bytes(size_of(entry), "little", signed=entry.signed)


def size_of(entry: Entry) -> int:
    """Return the length [bytes] of an object; 0 for a text, whose length varies."""
    return 0 if entry.bits is None else (entry.bits + 7) // 8


def check_length(entry: Entry, size: int) -> None:
    """Raise 06070012h or 06070013h for data of another length [bytes] than the object's."""
    if entry.bits is None:
        raise ObjectAccessError(WRONG_TYPE, f"{entry.label} is a text; only numbers can be written")
    if size > size_of(entry):
        raise ObjectAccessError(TOO_LONG, f"{entry.label} has {size_of(entry)} bytes, not {size}")
    if size < size_of(entry):
        raise ObjectAccessError(TOO_SHORT, f"{entry.label} has {size_of(entry)} bytes, not {size}")


def take(port: ObjectPort, content: bytes) -> None:
    """Write received bytes, of the object's length, to an object; ObjectAccessError if it does not accept them."""
    if port.entry.bits is None:
        if port.write_text is None:
            raise ObjectAccessError(CANNOT_BE_STORED, f"{port.entry.label} is a text that cannot be written")
        port.write_text(content.decode("latin-1"))  # each byte is a character, of whatever encoding
        return
    raw = int.from_bytes(content, "little", signed=port.entry.signed)
    port.check(raw)
    port.write(raw)


def _abort(multiplexor: bytes, code: int) -> bytes:
    return bytes((ABORTED,)) + multiplexor + code.to_bytes(4, "little")
