"""A node's memory of errors: the error history (1003h), and the conditions of its communication."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from drive_env.dictionary.aborts import NO_DATA, VALUE_RANGE, ObjectAccessError

GENERIC, COMMUNICATION, PROFILE = 0x01, 0x10, 0x20  # bits of 1001h


class ErrorCondition(NamedTuple):
    """A row: name as in the device's emergency table, bits of 1001h, and whether it lasts after being reported."""

    name: str
    error_register: int
    lasts: bool


# Conditions of the node, in addition to the causes of its axes (firmware/servo/causes.py).
CONDITIONS = {
    row.name: row
    for row in (
        ErrorCondition("communication_error", GENERIC | COMMUNICATION, False),
        ErrorCondition("pdo_not_accepted", GENERIC | PROFILE, True),  # until a good PDO comes
        ErrorCondition("pdo_too_short", GENERIC | COMMUNICATION, True),
        ErrorCondition("pdo_too_long", GENERIC | COMMUNICATION, True),
        ErrorCondition("heartbeat_lost", GENERIC | COMMUNICATION, True),  # until it comes again
        ErrorCondition("error_passive", GENERIC | COMMUNICATION, False),
        ErrorCondition("controller_overflow", GENERIC | COMMUNICATION, False),
        ErrorCondition("transmit_overflow", GENERIC | COMMUNICATION, False),
        ErrorCondition("receive_overflow", GENERIC | COMMUNICATION, False),
        ErrorCondition("bus_off_recovered", GENERIC | COMMUNICATION, False),
    )
}


# Of services that a device may have (drive_env/devices/services.py); not reported if its emergency table lacks them.
OPTIONAL_CONDITIONS = {
    row.name: row
    for row in (
        ErrorCondition("sync_length", GENERIC | COMMUNICATION, True),  # until a good SYNC comes
        ErrorCondition("sync_window_missed", GENERIC | COMMUNICATION, True),
    )
}


class ErrorHistory:
    """Object 1003h: the last errors, the newest first; code in the lower word, axis and number of the error above.

    Args:
        depth: Number of sub-indices.
        reads_0: Whether a sub-index without an error yet reads 0.
    """

    def __init__(self, depth: int, *, reads_0: bool = False) -> None:
        self._reads_0 = reads_0
        self._errors: deque[int] = deque(maxlen=depth)

    def add(self, code: int, axis: int = 0, number: int = 0) -> None:
        """Add an error; code 0000h is ignored. `number` is the device's own number of the error."""
        if code:
            self._errors.appendleft(code | axis << 16 | (number & 0x3F) << 24)

    def read(self, sub: int) -> int:
        """Return a sub-index; if it holds no error yet, abort 08000024h or 0."""
        if sub == 0:
            return len(self._errors)
        if sub > len(self._errors):
            if self._reads_0:
                return 0
            raise ObjectAccessError(NO_DATA, f"1003h:{sub:02X} holds no error; there are {len(self._errors)}")
        return self._errors[sub - 1]

    def write(self, raw: int) -> None:
        """Clear the history by writing 0 to sub-index 0."""
        if raw != 0:
            raise ObjectAccessError(VALUE_RANGE, f"1003h:00 cannot be {raw}; 0 clears it")
        self._errors.clear()
