"""Emergencies: the conditions of the bus that make one, the queue with its inhibit time, the error history (1003h)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from drive_env.canopen.frames import Frame
from drive_env.devices import Emergency
from drive_env.dictionary.access import NO_DATA, VALUE_RANGE, ObjectAccessError

EPSILON = 1e-6  # s: times are sums of cycles
GENERIC, COMMUNICATION, PROFILE = 0x01, 0x10, 0x20  # bits of 1001h
QUEUE = 8


class Condition(NamedTuple):
    """A row: name as in the device's emergency table, bits of 1001h, and whether it lasts or is over when told."""

    name: str
    error_register: int
    lasts: bool


# Of the node, beside the causes of its axes (firmware/protection.py).
CONDITIONS = {
    row.name: row
    for row in (
        Condition("communication_error", GENERIC | COMMUNICATION, False),
        Condition("pdo_not_accepted", GENERIC | PROFILE, True),  # until a good one comes
        Condition("pdo_too_short", GENERIC | COMMUNICATION, True),
        Condition("pdo_too_long", GENERIC | COMMUNICATION, True),
        Condition("heartbeat_lost", GENERIC | COMMUNICATION, True),  # until it comes again
        Condition("error_passive", GENERIC | COMMUNICATION, False),
        Condition("controller_overflow", GENERIC | COMMUNICATION, False),
        Condition("transmit_overflow", GENERIC | COMMUNICATION, False),
        Condition("receive_overflow", GENERIC | COMMUNICATION, False),
        Condition("bus_off_recovered", GENERIC | COMMUNICATION, False),
    )
}


class EmergencyProducer:
    """Sends emergencies in their order, no faster than the inhibit time allows.

    Args:
        send: Takes a frame.

    Attributes:
        told: Error register of the last message that was queued; 0 before the first.
    """

    def __init__(self, send: Callable[[Frame], None]) -> None:
        self.told = 0
        self._send = send
        self._waiting: deque[bytes] = deque()
        self._sent_at: float | None = None
        self.configure(None, 0.0)

    def configure(self, can_id: int | None, inhibit: float) -> None:
        """Take over identifier, None if switched off, and inhibit time [s]."""
        self._can_id = can_id
        self._inhibit = inhibit

    def push(self, emergency: Emergency, error_register: int) -> None:
        """Queue a message; a full queue loses the newest, as a transmit buffer does."""
        if self._can_id is not None and len(self._waiting) < QUEUE:
            head = emergency.code.to_bytes(2, "little") + bytes((error_register,))
            self._waiting.append(head + bytes(emergency.extra))
            self.told = error_register

    def flush(self, now: float) -> None:
        """Send what may be sent at `now` [s]."""
        while self._waiting and self._can_id is not None:
            if self._sent_at is not None and now - self._sent_at + EPSILON < self._inhibit:
                return
            self._sent_at = now
            self._send(Frame(self._can_id, self._waiting.popleft()))

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()
        self._sent_at = None
        self.told = 0


class ErrorHistory:
    """Object 1003h: the last errors, the newest first; code in the lower word, the axis above.

    Args:
        depth: Number of sub-indices.
    """

    def __init__(self, depth: int) -> None:
        self._errors: deque[int] = deque(maxlen=depth)

    def add(self, code: int, axis: int = 0) -> None:
        """Note an error; code 0000h is none."""
        if code:
            self._errors.appendleft(code | axis << 16)

    def read(self, sub: int) -> int:
        """Return a sub-index; 08000024h of one that holds no error yet."""
        if sub == 0:
            return len(self._errors)
        if sub > len(self._errors):
            raise ObjectAccessError(NO_DATA, f"1003h:{sub:02X} holds no error; there are {len(self._errors)}")
        return self._errors[sub - 1]

    def write(self, raw: int) -> None:
        """Clear the history by writing 0 to sub-index 0."""
        if raw != 0:
            raise ObjectAccessError(VALUE_RANGE, f"1003h:00 cannot be {raw}; 0 clears it")
        self._errors.clear()
