"""SYNC of a node: the producer with its period and counter, and the window after a SYNC (CiA 301).

1005h: identifier and, in bit 30, whether it is produced; 1006h: period; 1007h: window; 1019h: overflow of the counter.
"""

from __future__ import annotations

EPSILON = 1e-6  # s: times are sums of cycles


class SyncProducer:
    """Decides when to send SYNC, and its data."""

    def __init__(self) -> None:
        self._period = 0.0
        self._next: float | None = None
        self._overflow = 0
        self._counter = 0

    def configure(self, period: float, overflow: int) -> None:
        """Set the period [s], 0 for no SYNC, and the highest count, 0 for SYNCs without a counter.

        A producer that is switched on starts in its first communication cycle; one that stays on keeps its rhythm.
        """
        if period != self._period:
            self._period, self._next = period, None
        if overflow != self._overflow:
            self._overflow, self._counter = overflow, 0

    def restart(self) -> None:
        """Restart with the count 1, as when the node leaves the NMT state stopped."""
        self._counter, self._next = 0, None

    def take(self, now: float) -> bytes | None:
        """Return the data of a SYNC due at `now` [s], or None; a late SYNC does not delay the next."""
        if self._period == 0.0 or (self._next is not None and now < self._next - EPSILON):
            return None
        self._next = max((now if self._next is None else self._next) + self._period, now)
        if self._overflow == 0:
            return b""
        self._counter = self._counter % self._overflow + 1
        return bytes((self._counter,))


class SyncWindow:
    """The time after a SYNC in which synchronous PDOs are accepted (1007h)."""

    def __init__(self) -> None:
        self._length = 0.0
        self._opened: float | None = None

    def configure(self, length: float) -> None:
        """Set the length [s]; 0 for no limit."""
        self._length = length

    def open(self, now: float) -> None:
        """Note a SYNC received at `now` [s]."""
        self._opened = now

    def forget(self) -> None:
        """Forget earlier SYNCs: without a SYNC no PDO is late."""
        self._opened = None

    def is_over(self, now: float) -> bool:
        """Return whether a PDO at `now` [s] is later than the window."""
        return self._length > 0.0 and self._opened is not None and now - self._opened > self._length + EPSILON
