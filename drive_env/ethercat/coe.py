"""CANopen over EtherCAT: services of a mailbox message, and emergencies (ETG.1000.6, 5.6).

A message has two bytes of header: a number, which is not used, and the service in the upper four bits.
"""

from __future__ import annotations

import struct
from collections import deque
from enum import IntEnum

from drive_env.devices import EmergencyCode

HEADER = 2
MAILBOX_HEADER = 6
QUEUE = 8  # emergencies for each axis of the node

# Client command specifiers (bits 7 to 5 of the first byte).
DOWNLOAD_SEGMENT, INITIATE_DOWNLOAD, INITIATE_UPLOAD, UPLOAD_SEGMENT, ABORT = range(5)
DOWNLOAD_CONFIRMED, SEGMENT_CONFIRMED, UPLOADED, ABORTED = 0x60, 0x20, 0x40, 0x80  # first bytes of responses
HAS_SIZE, EXPEDITED, COMPLETE, TOGGLE, LAST = 0x01, 0x02, 0x10, 0x10, 0x01
INITIATE = 8  # bytes of an SDO before data
LEAST = 7  # bytes of data in a segment, in use or not


class CoeService(IntEnum):
    """Services of CoE (ETG.1000.6, table 28)."""

    EMERGENCY = 1
    SDO_REQUEST = 2
    SDO_RESPONSE = 3
    INFORMATION = 8


def message(service: CoeService, content: bytes) -> bytes:
    """Return a message with its header."""
    return struct.pack("<H", service << 12) + content


def split(data: bytes) -> tuple[int, bytes]:
    """Return service and content of a message; ValueError for one without a header."""
    if len(data) < HEADER:
        raise ValueError(f"a CoE message has {HEADER} bytes of header or more, not {len(data)}")
    return data[1] >> 4, data[HEADER:]


class MailboxEmergencies:
    """Emergencies that wait for the mailbox.

    Args:
        num_axes: Axes of the node.

    Attributes:
        told: Error register of the last one that was queued; 0 before the first.
    """

    def __init__(self, num_axes: int) -> None:
        self.told = 0
        self._waiting: deque[bytes] = deque()
        self._room = QUEUE * num_axes

    def push(self, emergency: EmergencyCode, error_register: int) -> None:
        """Queue an emergency; a full queue loses the newest."""
        if len(self._waiting) < self._room:
            content = emergency.code.to_bytes(2, "little") + bytes((error_register,)) + bytes(emergency.extra)
            self._waiting.append(message(CoeService.EMERGENCY, content))
            self.told = error_register

    def take(self) -> list[bytes]:
        """Return and forget the waiting messages."""
        taken = list(self._waiting)
        self._waiting.clear()
        return taken

    def clear(self) -> None:
        """Drop waiting emergencies."""
        self._waiting.clear()
        self.told = 0
