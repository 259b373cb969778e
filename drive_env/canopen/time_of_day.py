"""TIME: the time of day on the bus, received and sent, and the clock that it sets (CiA 301, 1012h and 1013h).

TIME_OF_DAY is six bytes: 28 bits of milliseconds after midnight, four that are reserved, 16 bits of days since
1 January 1984. 1013h counts microseconds and wraps round after 2^32 of them, some 72 minutes.
"""

from __future__ import annotations

from datetime import datetime, timedelta

EPOCH = datetime(1984, 1, 1)  # CiA 301 names no time zone
DAY = 86_400_000  # ms
EPSILON = 1e-6  # s: times are sums of cycles


def encode(days: int, milliseconds: int) -> bytes:
    """Return the six bytes of a time of day."""
    return milliseconds.to_bytes(4, "little") + (days & 0xFFFF).to_bytes(2, "little")


def decode(data: bytes) -> tuple[int, int] | None:
    """Return days since 1984 and milliseconds after midnight; None for data that are not a time of day."""
    if len(data) != 6:
        return None
    milliseconds = int.from_bytes(data[:4], "little") & 0x0FFF_FFFF
    return (int.from_bytes(data[4:6], "little"), milliseconds) if milliseconds < DAY else None


class Clock:
    """A node's clock: it runs from power-on, where it shows the beginning of 1984, and is set over the bus."""

    def __init__(self) -> None:
        self._zero = 0.0  # when it was at the beginning of 1984 [s]
        self._high_resolution_zero = 0.0
        self.is_set = False

    def power_on(self, now: float) -> None:
        """Start the clock at the beginning of 1984: it has no battery."""
        self._zero = self._high_resolution_zero = now
        self.is_set = False

    def set(self, days: int, milliseconds: int, now: float) -> None:
        """Set it to a time of day."""
        self._zero = now - (days * 86_400.0 + milliseconds * 1e-3)
        self.is_set = True

    def milliseconds(self, now: float) -> tuple[int, int]:
        """Return days since 1984 and milliseconds after midnight at `now` [s]."""
        return divmod(int((now - self._zero) * 1e3 + 1e-3), DAY)

    def date(self, now: float) -> datetime:
        """Return the date and time that it shows at `now` [s]."""
        return EPOCH + timedelta(seconds=round(now - self._zero, 6))

    def set_microseconds(self, raw: int, now: float) -> None:
        """Set the time stamp of high resolution (1013h)."""
        self._high_resolution_zero = now - raw * 1e-6

    def microseconds(self, now: float) -> int:
        """Return the time stamp of high resolution (1013h)."""
        return round((now - self._high_resolution_zero) * 1e6) & 0xFFFF_FFFF


class TimeProducer:
    """Decides when to send TIME.

    Args:
        period: Seconds between two of them.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._next: float | None = None
        self._is_on = False

    def configure(self, is_on: bool) -> None:
        """Switch on or off; the first TIME is due at once."""
        if is_on is not self._is_on:
            self._is_on, self._next = is_on, None

    def is_due(self, now: float) -> bool:
        """Return whether TIME is due at `now` [s], and schedule the next."""
        if not self._is_on or (self._next is not None and now < self._next - EPSILON):
            return False
        self._next = max((now if self._next is None else self._next) + self._period, now)
        return True
