"""A CAN frame, and the identifiers that CiA 301 gives to each service."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """A classical CAN frame with an 11-bit identifier.

    Attributes:
        can_id: Identifier, 0...7FFh.
        data: 0...8 bytes; empty in a remote frame.
        rtr: Whether it is a remote frame.
        dlc: Data length code of a remote frame; None for other frames, whose data have that length.
    """

    can_id: int
    data: bytes = b""
    rtr: bool = False
    dlc: int | None = None

    def __str__(self) -> str:
        """Return the frame as a transcript shows it, e.g. `605  40 41 60 00 00 00 00 00`."""
        return f"{self.can_id:03X}  {'RTR' if self.rtr else self.data.hex(' ').upper()}".rstrip()


# The predefined connection set (CiA 301, tables 38 and 39 of version 4.2): first identifier of a service; the others
# add the node's number.
NMT = 0x000
SYNC = 0x080
EMCY = 0x080
TIME = 0x100
TPDO = (0x180, 0x280, 0x380, 0x480)
RPDO = (0x200, 0x300, 0x400, 0x500)
SDO_RESPONSE = 0x580
SDO_REQUEST = 0x600
ERROR_CONTROL = 0x700

# Identifiers that no configurable object may take (CiA 301, table 41 of version 4.2): first and last of each range.
RESTRICTED = ((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF))

# Bits of an object that holds an identifier.
INVALID = 1 << 31  # EMCY, PDO: 1 switches the object off
NO_REMOTE = 1 << 30  # PDO: 1 refuses remote frames
PRODUCE = 1 << 30  # SYNC, TIME: 1 makes the device produce it
CONSUME_TIME = 1 << 31
EXTENDED = 1 << 29
IDENTIFIER = 0x7FF


def service_name(can_id: int) -> str:
    """Return the service and the node of an identifier in the predefined connection set; "" if it is of no service."""
    node = can_id & 0x7F
    if node == 0:
        return {NMT: "NMT", SYNC: "SYNC", TIME: "TIME"}.get(can_id, "")
    names = {EMCY: "EMCY", SDO_RESPONSE: "SDO response", SDO_REQUEST: "SDO request", ERROR_CONTROL: "heartbeat"}
    names |= {first: f"TPDO {k}" for k, first in enumerate(TPDO, 1)}
    names |= {first: f"RPDO {k}" for k, first in enumerate(RPDO, 1)}
    name = names.get(can_id - node)
    return "" if name is None else f"{name}, node {node}"


def is_restricted(can_id: int) -> bool:
    """Return whether an identifier is reserved for services whose identifiers are fixed."""
    return any(first <= can_id <= last for first, last in RESTRICTED)
