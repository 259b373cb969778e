"""Error control: producing and monitoring heartbeats, node guarding and life guarding (CiA 301, 7.2.8.3)."""

from __future__ import annotations

from collections.abc import Sequence

EPSILON = 1e-6  # s: times are sums of cycles
TOGGLE = 0x80


class HeartbeatProducer:
    """Decides when to send a heartbeat (1017h)."""

    def __init__(self) -> None:
        self.period = 0.0
        self._next: float | None = None

    def configure(self, period: float) -> None:
        """Set the period [s], 0 for no heartbeats; the first one is due at once."""
        self.period = period
        self._next = None

    def postpone(self, now: float) -> None:
        """Count from `now`: the boot-up message was the first heartbeat."""
        self._next = now + self.period

    def is_due(self, now: float) -> bool:
        """Return whether a heartbeat is due at `now` [s], and schedule the next: a late one does not delay it."""
        if self.period == 0.0 or (self._next is not None and now < self._next - EPSILON):
            return False
        following = now if self._next is None else self._next
        self._next = max(following + self.period, now)
        return True


class HeartbeatConsumer:
    """One monitored node (a sub-index of 1016h); monitoring begins with its first heartbeat."""

    def __init__(self, node_id: int, time: float) -> None:
        self.node_id = node_id
        self._time = time
        self._last: float | None = None

    def receive(self, now: float) -> None:
        """Note a heartbeat."""
        self._last = now

    def is_lost(self, now: float) -> bool:
        """Return True once after the node was silent for too long; its next heartbeat restarts the monitoring."""
        if self._last is None or now - self._last < self._time - EPSILON:
            return False
        self._last = None
        return True


def consumers(entries: Sequence[int]) -> list[HeartbeatConsumer]:
    """Return the consumers for 1016h's values, times in ms; without those with time 0 or an impossible node-ID."""
    found = [(raw >> 16 & 0xFF, (raw & 0xFFFF) * 1e-3) for raw in entries]
    return [HeartbeatConsumer(node_id, time) for node_id, time in found if time > 0.0 and 1 <= node_id <= 127]


class NodeGuarding:
    """Answers node guarding, and monitors the master (100Ch, 100Dh) from the first request on."""

    def __init__(self) -> None:
        self._toggle = 0
        self._last: float | None = None
        self._life_time = 0.0

    def configure(self, life_time: float) -> None:
        """Set the life time [s], guard time times life time factor; 0: no monitoring. It begins with the next request.

        A master that configures it anew has stopped asking meanwhile, so the time since the previous request does not
        count.
        """
        self._life_time = life_time
        self._last = None

    def reset(self) -> None:
        """Start anew, as after reset communication: the next answer has toggle 0."""
        self._toggle = 0
        self._last = None

    def answer(self, state: int, now: float) -> bytes:
        """Return the answer to a request received at `now` [s]: the state, with bit 7 alternating."""
        data = bytes((state | self._toggle,))
        self._toggle ^= TOGGLE
        self._last = now
        return data

    def is_lost(self, now: float) -> bool:
        """Return True once after no request has come for the life time; the next request restarts the monitoring."""
        if self._life_time == 0.0 or self._last is None or now - self._last < self._life_time - EPSILON:
            return False
        self._last = None
        return True
