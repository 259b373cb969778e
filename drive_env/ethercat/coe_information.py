"""SDO information: the list of objects, descriptions of objects and entries, in fragments (ETG.1000.6, 5.6.3)."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, NO_SUCH_SUB_INDEX, UNKNOWN_COMMAND
from drive_env.ethercat.coe import HEADER, MAILBOX_HEADER, CoeService, message
from drive_env.ethercat.object_descriptions import (
    BACKUP,
    MAPS_INPUT,
    MAPS_OUTPUT,
    SETTING,
    EntryDescription,
    ObjectDescription,
)

# Operation codes: each request's response is the next number.
LIST_REQUEST, LIST, OBJECT_REQUEST, OBJECT, ENTRY_REQUEST, ENTRY, ERROR = range(1, 8)
INCOMPLETE = 0x80
HEAD = 4  # bytes: operation code, reserved, fragments left
ALL, OUTPUTS, INPUTS, KEPT, SETTINGS = range(1, 6)  # kinds of lists; 0 asks how long each is
BITS = {OUTPUTS: MAPS_OUTPUT, INPUTS: MAPS_INPUT, KEPT: BACKUP, SETTINGS: SETTING}
HAS_DEFAULT, HAS_LOW, HAS_HIGH = 0x10, 0x20, 0x40  # of an entry description's value information
LENGTHS = {LIST_REQUEST: 2, OBJECT_REQUEST: 2, ENTRY_REQUEST: 4}


class SdoInformation:
    """The server.

    Args:
        objects: Descriptions by index.
        room: Length of the send mailbox [bytes].
    """

    def __init__(self, objects: Mapping[int, ObjectDescription], room: int) -> None:
        self._objects = objects
        self._room = room - MAILBOX_HEADER - HEADER - HEAD
        self._lists = {ALL: list(objects)} | {
            kind: [index for index, one in objects.items() if any(entry.access & bit for entry in one.entries)]
            for kind, bit in BITS.items()
        }

    def request(self, data: bytes) -> list[bytes]:
        """Return the answers to a request; ValueError for one that is too short or incomplete."""
        if len(data) < HEAD or data[0] & INCOMPLETE:
            raise ValueError("SDO information is asked for in one message of four bytes or more")
        operation, content = data[0], data[HEAD:]
        if len(content) < LENGTHS.get(operation, 0):
            raise ValueError(f"the request {operation} of SDO information has {len(content)} bytes, which are too few")
        if operation == LIST_REQUEST:
            return self._list(int.from_bytes(content[:2], "little"))
        if operation == OBJECT_REQUEST:
            found = self._objects.get(int.from_bytes(content[:2], "little"))
            return _error(NO_SUCH_OBJECT) if found is None else self._fragments(OBJECT, _object(found))
        if operation == ENTRY_REQUEST:
            index, sub, wanted = struct.unpack_from("<HBB", content)
            found = self._objects.get(index)
            if found is None:
                return _error(NO_SUCH_OBJECT)
            entry = next((one for one in found.entries if one.sub == sub), None)
            if entry is None:
                return _error(NO_SUCH_SUB_INDEX)
            return self._fragments(ENTRY, _entry(index, entry, wanted))
        return _error(UNKNOWN_COMMAND)

    # --- inside -----------------------------------------------------------------------------------------------------
    def _list(self, kind: int) -> list[bytes]:
        if kind == 0:
            words = [len(one) for one in self._lists.values()]
        elif kind in self._lists:
            words = self._lists[kind]
        else:
            return _error(UNKNOWN_COMMAND)
        return self._fragments(LIST, struct.pack(f"<{len(words) + 1}H", kind, *words))

    def _fragments(self, operation: int, content: bytes) -> list[bytes]:
        """Return a response in as many messages as needed, each of whole words."""
        size = self._room // 2 * 2
        parts = [content[k : k + size] for k in range(0, len(content), size)]
        messages = []
        for left, part in zip(range(len(parts) - 1, -1, -1), parts, strict=True):
            head = struct.pack("<BBH", operation | (INCOMPLETE if left else 0), 0, left)
            messages.append(message(CoeService.INFORMATION, head + part))
        return messages


def _object(found: ObjectDescription) -> bytes:
    head = struct.pack("<HHBB", found.index, found.data_type, found.last, found.code)
    return head + found.name.encode("latin-1", "replace")


def _entry(index: int, entry: EntryDescription, wanted: int) -> bytes:
    values = b""
    has = 0
    for bit, value in ((HAS_DEFAULT, entry.default), (HAS_LOW, entry.low), (HAS_HIGH, entry.high)):
        if wanted & bit and isinstance(value, int) and entry.low is not None:
            has |= bit
            values += value.to_bytes((entry.bits + 7) // 8, "little", signed=entry.low < 0)
    head = struct.pack("<HBBHHH", index, entry.sub, has, entry.data_type, entry.bits, entry.access)
    return head + values + entry.name.encode("latin-1", "replace")


def _error(code: int) -> list[bytes]:
    return [message(CoeService.INFORMATION, struct.pack("<BBHI", ERROR, 0, 0, code))]
