"""Error control: heartbeat, sent and watched, and node guarding with life guarding (CiA 301, 7.2.8.3)."""

from __future__ import annotations

from collections.abc import Sequence

EPSILON = 1e-6  # s: times are sums of cycles
TOGGLE = 0x80


class HeartbeatProducer:
    """When to send a heartbeat (1017h)."""

    def __init__(self) -> None:
        self.period = 0.0
        self._next: float | None = None

    def configure(self, period: float) -> None:
        """Take over the period [s], 0 for none; the protocol begins at once."""
        self.period = period
        self._next = None

    def postpone(self, now: float) -> None:
        """Count from `now`: the boot-up message was the first heartbeat."""
        self._next = now + self.period

    def is_due(self, now: float) -> bool:
        """Return whether one is due at `now` [s], and count on: late ones do not delay the next."""
        if self.period == 0.0 or (self._next is not None and now < self._next - EPSILON):
            return False
        following = now if self._next is None else self._next
        self._next = max(following + self.period, now)
        return True


class HeartbeatConsumer:
    """One watched node (a sub-index of 1016h); watching begins with its first heartbeat."""

    def __init__(self, node_id: int, time: float) -> None:
        self.node_id = node_id
        self._time = time
        self._last: float | None = None

    def receive(self, now: float) -> None:
        """Note a heartbeat."""
        self._last = now

    def is_lost(self, now: float) -> bool:
        """Return True once when the node has been silent for too long; then its next heartbeat begins anew."""
        if self._last is None or now - self._last < self._time - EPSILON:
            return False
        self._last = None
        return True


def consumers(entries: Sequence[int]) -> list[HeartbeatConsumer]:
    """Return the consumers of 1016h's values; times in ms; a time of 0 or an impossible node-ID watches no node."""
    found = [(raw >> 16 & 0xFF, (raw & 0xFFFF) * 1e-3) for raw in entries]
    return [HeartbeatConsumer(node_id, time) for node_id, time in found if time > 0.0 and 1 <= node_id <= 127]


class NodeGuarding:
    """Answers of the guarding protocol, and the master's life (100Ch, 100Dh); life begins with the first request."""

    def __init__(self) -> None:
        self._toggle = 0
        self._last: float | None = None
        self._life_time = 0.0

    def configure(self, life_time: float) -> None:
        """Set guard time times life time factor [s]; 0 watches no master. Life begins with the next request.

        A master that configures it anew has stopped asking meanwhile: the time since the master before it is no loss.
        """
        self._life_time = life_time
        self._last = None

    def reset(self) -> None:
        """Begin anew, as after reset communication: the next answer has toggle 0."""
        self._toggle = 0
        self._last = None

    def answer(self, state: int, now: float) -> bytes:
        """Return the answer to a request that came at `now` [s]: the state, its bit 7 alternating."""
        data = bytes((state | self._toggle,))
        self._toggle ^= TOGGLE
        self._last = now
        return data

    def is_lost(self, now: float) -> bool:
        """Return True once when no request has come for the life time; then the next request begins anew."""
        if self._life_time == 0.0 or self._last is None or now - self._last < self._life_time - EPSILON:
            return False
        self._last = None
        return True
