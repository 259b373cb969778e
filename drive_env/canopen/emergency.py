"""Emergencies on the bus: the queue with its inhibit time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from drive_env.canopen.frames import Frame
from drive_env.devices import EmergencyCode

EPSILON = 1e-6  # s: times are sums of cycles
QUEUE = 8  # messages for each axis of the node


class EmergencyProducer:
    """Sends emergencies in their order, no faster than the inhibit time allows.

    Args:
        send: Sends a frame.
        num_axes: Axes of the node.

    Attributes:
        told: Error register of the last message that was queued; 0 before the first.
    """

    def __init__(self, send: Callable[[Frame], None], num_axes: int = 1) -> None:
        self.told = 0
        self._room = QUEUE * num_axes
        self._send = send
        self._waiting: deque[bytes] = deque()
        self._sent_at: float | None = None
        self.configure(None, 0.0)

    def configure(self, can_id: int | None, inhibit: float) -> None:
        """Set identifier, None if switched off, and inhibit time [s]."""
        self._can_id = can_id
        self._inhibit = inhibit

    def push(self, emergency: EmergencyCode, error_register: int) -> None:
        """Queue a message; a full queue loses the newest, as a transmit buffer does."""
        if self._can_id is not None and len(self._waiting) < self._room:
            head = emergency.code.to_bytes(2, "little") + bytes((error_register,))
            self._waiting.append(head + bytes(emergency.extra))
            self.told = error_register

    def flush(self, now: float) -> None:
        """Send the waiting emergencies that the inhibit time allows at `now` [s]."""
        while self._waiting and self._can_id is not None:
            if self._sent_at is not None and now - self._sent_at + EPSILON < self._inhibit:
                return
            self._sent_at = now
            self._send(Frame(self._can_id, self._waiting.popleft()))

    def clear(self) -> None:
        """Drop waiting emergencies."""
        self._waiting.clear()
        self._sent_at = None
        self.told = 0
