"""The SDO server of CoE: expedited, normal, segmented transfers; single entries, whole objects (ETG.1000.6, 5.6.2).

Differences from CANopen's (`node/sdo_server.py`): a message holds all data that fit into the mailbox, not 4 or 7 bytes,
and there is complete access: sub-index 0 as 16 bits, followed by the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drive_env.dictionary.aborts import (
    NO_SUCH_SUB_INDEX,
    TOGGLE_NOT_ALTERNATED,
    TOO_LONG,
    TOO_SHORT,
    UNKNOWN_COMMAND,
    UNSUPPORTED_ACCESS,
    WRONG_STATE,
    ObjectAccessError,
)
from drive_env.dictionary.access import check_readable, check_writable
from drive_env.dictionary.entries import Entry
from drive_env.ethercat.coe import (
    ABORT,
    ABORTED,
    COMPLETE,
    DOWNLOAD_CONFIRMED,
    DOWNLOAD_SEGMENT,
    EXPEDITED,
    HAS_SIZE,
    HEADER,
    INITIATE,
    INITIATE_DOWNLOAD,
    INITIATE_UPLOAD,
    LAST,
    LEAST,
    MAILBOX_HEADER,
    SEGMENT_CONFIRMED,
    TOGGLE,
    UPLOAD_SEGMENT,
    UPLOADED,
    CoeService,
    message,
)
from drive_env.node.axis import ObjectPort
from drive_env.node.process_image import ImageObjects
from drive_env.node.sdo_server import check_length, encode, size_of, take


@dataclass(slots=True)
class CoeTransfer:
    """An open segmented transfer; `multiplexor` is index and sub-index as in the messages."""

    multiplexor: bytes
    data: bytearray
    finish: Callable[[bytes], None] | None  # of a download
    expected: int = 0
    position: int = 0
    toggle: int = 0


class CoeSdoServer:
    """One server: one transfer at a time.

    Args:
        port: Finds an object by index and sub-index; raises ObjectAccessError.
        entries: Returns the entries of an object in the order of their sub-indices.
        image: Objects whose number of entries can be written.
        room: Length of the send mailbox [bytes].
    """

    def __init__(
        self,
        port: Callable[[int, int], ObjectPort],
        entries: Callable[[int], Sequence[Entry]],
        image: ImageObjects,
        room: int,
    ) -> None:
        self._port = port
        self._entries = entries
        self._image = image
        self._room = room - MAILBOX_HEADER - HEADER
        self._open: CoeTransfer | None = None

    def close(self) -> None:
        """Forget an open transfer."""
        self._open = None

    def request(self, data: bytes) -> list[bytes]:
        """Return the answers to a request without its CoE header; ValueError for one that is too short."""
        if not data:
            raise ValueError("an SDO request has a first byte")
        specifier = data[0] >> 5
        is_segment = specifier in (DOWNLOAD_SEGMENT, UPLOAD_SEGMENT)
        if len(data) < (1 if is_segment else INITIATE):
            raise ValueError(f"an SDO request has {INITIATE} bytes or more, not {len(data)}")
        multiplexor = data[1:4]
        if is_segment:
            multiplexor = self._open.multiplexor if self._open else bytes(3)
        try:
            answer = self._answer(specifier, data)
        except ObjectAccessError as error:
            self._open = None
            code = error.abort_code.to_bytes(4, "little")
            return [message(CoeService.SDO_REQUEST, bytes((ABORTED,)) + multiplexor + code)]
        return [] if answer is None else [message(CoeService.SDO_RESPONSE, answer)]

    # --- inside -----------------------------------------------------------------------------------------------------
    def _answer(self, specifier: int, data: bytes) -> bytes | None:
        if specifier == UPLOAD_SEGMENT:
            return self._upload_segment(data)
        if specifier == DOWNLOAD_SEGMENT:
            return self._download_segment(data)
        self._open = None
        if specifier == INITIATE_UPLOAD:
            return self._initiate_upload(data)
        if specifier == INITIATE_DOWNLOAD:
            return self._initiate_download(data)
        if specifier == ABORT:
            return None
        raise ObjectAccessError(UNKNOWN_COMMAND, f"{data[0]:02X}h begins no SDO request")

    def _initiate_upload(self, data: bytes) -> bytes:
        index, sub, complete = data[1] | data[2] << 8, data[3], data[0] & COMPLETE
        if complete:
            content = self._whole(index, sub)
        else:
            port = self._port(index, sub)
            check_readable(port.entry)
            content = encode(port.entry, port.read())
        size = len(content)
        if 1 <= size <= 4:
            first = UPLOADED | complete | EXPEDITED | HAS_SIZE | (4 - size) << 2
            return bytes((first,)) + data[1:4] + content.ljust(4, b"\0")
        part = content[: self._room - INITIATE]
        if len(part) < size:
            self._open = CoeTransfer(data[1:4], bytearray(content), None, position=len(part))
        return bytes((UPLOADED | complete | HAS_SIZE,)) + data[1:4] + size.to_bytes(4, "little") + part

    def _upload_segment(self, data: bytes) -> bytes:
        transfer = self._transfer(data, is_upload=True)
        part = bytes(transfer.data[transfer.position : transfer.position + self._room - 1])
        transfer.position += len(part)
        is_last = transfer.position >= len(transfer.data)
        first = transfer.toggle | max(0, LEAST - len(part)) << 1 | is_last
        transfer.toggle ^= TOGGLE
        if is_last:
            self._open = None
        return bytes((first,)) + part.ljust(LEAST, b"\0")

    def _initiate_download(self, data: bytes) -> bytes:
        index, sub = data[1] | data[2] << 8, data[3]
        finish = self._whole_writer(index, sub) if data[0] & COMPLETE else self._writer(index, sub)
        answer = bytes((DOWNLOAD_CONFIRMED | data[0] & COMPLETE,)) + data[1:4] + bytes(4)
        if data[0] & EXPEDITED:
            size = 4 - (data[0] >> 2 & 0x03) if data[0] & HAS_SIZE else self._expedited_size(index, sub, data[0])
            finish(data[4 : 4 + size])
            return answer
        expected = int.from_bytes(data[4:8], "little")
        content = data[INITIATE:]
        if len(content) > expected:
            raise ObjectAccessError(TOO_LONG, f"{len(content)} bytes came, {expected} were announced")
        self._check_room(index, sub, expected, is_whole=bool(data[0] & COMPLETE))
        if len(content) < expected:
            self._open = CoeTransfer(data[1:4], bytearray(content), finish, expected)
        else:
            finish(content)
        return answer

    def _download_segment(self, data: bytes) -> bytes:
        transfer = self._transfer(data, is_upload=False)
        assert transfer.finish is not None, "it is a download"
        content = data[1:]
        if len(content) <= LEAST:  # only the shortest segment has a count of unused bytes
            content = content[: LEAST - (data[0] >> 1 & 0x07)]
        transfer.data += content
        if len(transfer.data) > transfer.expected:
            raise ObjectAccessError(TOO_LONG, f"{len(transfer.data)} bytes came, {transfer.expected} were announced")
        if data[0] & LAST:
            if len(transfer.data) < transfer.expected:
                raise ObjectAccessError(
                    TOO_SHORT, f"{len(transfer.data)} bytes came, {transfer.expected} were announced"
                )
            transfer.finish(bytes(transfer.data))
            self._open = None
        toggle = transfer.toggle
        transfer.toggle ^= TOGGLE
        return bytes((SEGMENT_CONFIRMED | toggle,)) + bytes(7)

    def _transfer(self, data: bytes, *, is_upload: bool) -> CoeTransfer:
        transfer = self._open
        if transfer is None or (transfer.finish is None) != is_upload:
            raise ObjectAccessError(UNKNOWN_COMMAND, "a segment of a transfer that was not initiated")
        if data[0] & TOGGLE != transfer.toggle:
            raise ObjectAccessError(TOGGLE_NOT_ALTERNATED, "the toggle bit did not alternate")
        return transfer

    # --- one entry --------------------------------------------------------------------------------------------------
    def _writer(self, index: int, sub: int) -> Callable[[bytes], None]:
        port = self._port(index, sub)
        check_writable(port.entry)

        def finish(content: bytes) -> None:
            check_length(port.entry, len(content))
            take(port, content)

        return finish

    def _expedited_size(self, index: int, sub: int, first: int) -> int:
        """Return how many of the four bytes are data if the request does not give it."""
        return 4 if first & COMPLETE else size_of(self._port(index, sub).entry) or 4

    def _check_room(self, index: int, sub: int, size: int, *, is_whole: bool) -> None:
        """Raise before the data come if the object cannot hold them."""
        if is_whole:
            most = sum(max(2 if one.sub == 0 else 0, size_of(one)) for one in self._entries(index))
            if size > most:
                raise ObjectAccessError(TOO_LONG, f"{index:04X}h has {most} bytes, not {size}")
        else:
            check_length(self._port(index, sub).entry, size)

    # --- whole objects ------------------------------------------------------------------------------------------------
    def _members(self, index: int, first: int) -> list[Entry]:
        """Return the entries that complete access to an object covers, including sub-index 0."""
        entries = list(self._entries(index))
        if len(entries) == 1 or any(one.bits is None for one in entries):
            raise ObjectAccessError(UNSUPPORTED_ACCESS, f"{index:04X}h can only be accessed entry by entry")
        if first > 1:
            raise ObjectAccessError(UNSUPPORTED_ACCESS, f"complete access begins at sub-index 0 or 1, not {first}")
        return entries

    def _whole(self, index: int, first: int) -> bytes:
        entries = self._members(index, first)
        number = self._port(index, 0).read()
        assert isinstance(number, int), "sub-index 0 of an object with others is a number"
        parts = [number.to_bytes(2, "little")] if first == 0 else []
        has_number = self._image.writes_whole(index)
        for entry in entries[1:]:
            if has_number and entry.sub > number:
                break
            check_readable(entry)
            parts.append(encode(entry, self._port(index, entry.sub).read()))
        return b"".join(parts)

    def _whole_writer(self, index: int, first: int) -> Callable[[bytes], None]:
        entries = self._members(index, first)
        if self._image.writes_whole(index):
            check_writable(entries[0])
            return lambda content: self._image.write_whole(index, _image_values(entries, content, first))
        for entry in entries[1:]:
            check_writable(entry)

        def finish(content: bytes) -> None:
            number = self._port(index, 0).read()
            assert isinstance(number, int), "sub-index 0 of an object with others is a number"
            if first == 0 and int.from_bytes(content[:2], "little") != number:
                raise ObjectAccessError(WRONG_STATE, f"{index:04X}h has {number} entries, which cannot be changed")
            rows, rest = _parts(entries, content[2 if first == 0 else 0 :])
            if rest or len(rows) < len(entries) - 1:
                raise ObjectAccessError(TOO_LONG if rest else TOO_SHORT, f"{index:04X}h has {len(entries) - 1} entries")
            ports = [(self._port(index, entry.sub), raw) for entry, raw in rows]
            for port, raw in ports:
                port.check(raw)
            for port, raw in ports:
                port.write(raw)

        return finish


def _parts(entries: Sequence[Entry], content: bytes) -> tuple[list[tuple[Entry, int]], bytes]:
    """Return the values of entries from sub-index 1 on, as far as there are data, and the remaining data."""
    rows = []
    for entry in entries[1:]:
        size = size_of(entry)
        if len(content) < size:
            break
        rows.append((entry, int.from_bytes(content[:size], "little", signed=entry.signed)))
        content = content[size:]
    return rows, content


def _image_values(entries: Sequence[Entry], content: bytes, first: int) -> list[int]:
    """Return the entries of a mapping or an assignment that is written whole."""
    rows, rest = _parts(entries, content[2 if first == 0 else 0 :])
    if rest:
        raise ObjectAccessError(TOO_LONG, f"{len(rest)} bytes are left over after {len(rows)} entries")
    number = int.from_bytes(content[:2], "little") if first == 0 else len(rows)
    if number > len(entries) - 1:
        raise ObjectAccessError(NO_SUCH_SUB_INDEX, f"there are {len(entries) - 1} entries, not {number}")
    if number > len(rows):
        raise ObjectAccessError(TOO_SHORT, f"{len(rows)} entries came, {number} were announced")
    return [raw for _, raw in rows[:number]]
