"""When the next SYNC is due."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from drive_env.drives.arguments import whole_cycles
from drive_env.fieldbus.link import Timing

MOST_FRAMES = 256  # taken in between two SYNCs; a bus of 1 Mbit/s carries about 8 in a millisecond
CATCH_UP = 0.02  # of a cycle, by which a SYNC is moved to suit the drives' clocks
LONGEST_CYCLE = 0.1  # s: slower, nobody watches
Receive = Callable[[float], bool]  # waits so many seconds for a frame; whether one came


def _take_in(receive: Receive) -> None:
    """Receive what has come, but not for ever where more comes than can be received."""
    for _ in range(MOST_FRAMES):
        if not receive(0.0):
            return


class Pace(Protocol):
    """What a run of cycles asks of a pace."""

    window: int  # SYNCs that may be out before their samples are in
    time_waits: bool  # whether no time passes while no SYNC is sent
    timing: Timing  # of the last run
    total: Timing  # of all runs

    def begin(self) -> None:
        """Begin a run of cycles."""

    def wait(self, receive: Receive) -> int:
        """Wait until the next SYNC is due; return how many cycles were missed before it."""

    def end(self, receive: Receive) -> None:
        """Wait until the cycle of the last SYNC has passed."""


class RealTimePace:
    """One SYNC per communication cycle by the clock.

    A SYNC that is more than a cycle late shifts those that follow: several at once would not make the motor faster,
    only its set-points. Between runs of cycles, which a policy makes one by one, half a cycle does: one action that
    took 1.1 ms leaves the drives' rhythm as it was.

    Args:
        cycle: Communication cycle [s].
        phase: Returns how much later than an instant [s, of perf_counter] a SYNC suits the drives' clocks [s]; None:
            they have none to suit.
    """

    window = 64
    time_waits = False

    def __init__(self, cycle: float, phase: Callable[[float], float] | None = None) -> None:
        self._cycle = cycle
        self._phase = phase
        self._due = 0.0
        self.timing = self.total = Timing(0, 0, 0.0)

    def begin(self) -> None:
        """Begin a cycle after the last SYNC; now, if that was more than half a cycle ago."""
        now = time.perf_counter()
        if now - self._due > 0.5 * self._cycle:
            self._due = now if self._phase is None else now + self._phase(now)
        self.timing = Timing(0, 0, 0.0)

    def wait(self, receive: Receive) -> int:
        """Wait until the next SYNC is due, receiving meanwhile; return how many cycles were missed before it."""
        self._pass_time(receive)
        now = time.perf_counter()
        lateness = now - self._due
        late = lateness > self._cycle
        self.timing, self.total = (
            Timing(one.cycles + 1, one.late + late, max(one.worst, lateness)) for one in (self.timing, self.total)
        )
        self._due = (now if late else self._due) + self._cycle
        if self._phase is not None:  # this computer's clock is another one
            ahead = self._phase(self._due)
            off = ahead if ahead < 0.5 * self._cycle else ahead - self._cycle
            self._due += min(max(off, -CATCH_UP * self._cycle), CATCH_UP * self._cycle)
        return int(lateness / self._cycle) if late else 0

    def end(self, receive: Receive) -> None:
        """Wait until the cycle of the last SYNC has passed."""
        self._pass_time(receive)

    def _pass_time(self, receive: Receive) -> None:
        while (left := self._due - time.perf_counter()) > 0.0:
            receive(left)
        _take_in(receive)


class LockstepPace:
    """SYNCs as fast as the emulator answers; time passes by them alone."""

    window = 16
    time_waits = True

    def __init__(self) -> None:
        self.timing = self.total = Timing(0, 0, 0.0)

    def begin(self) -> None:
        """Begin."""
        self.timing = Timing(0, 0, 0.0)

    def wait(self, receive: Receive) -> int:
        """Take in what has come; there is nothing to wait for, and nothing to miss."""
        _take_in(receive)
        self.timing, self.total = (Timing(one.cycles + 1, 0, 0.0) for one in (self.timing, self.total))
        return 0

    def end(self, receive: Receive) -> None:
        """Do nothing: no time passes without SYNC."""


def cycles_per_sync(cycle: float, least: float, pace: str) -> int:
    """Return how many communication cycles [s] pass from SYNC to SYNC [s]; ValueError for what cannot be."""
    if pace == "lockstep":
        raise ValueError(f"cycle={cycle:g} s is for real time: in lockstep each SYNC is a cycle of {least:g} s")
    if not least <= cycle <= LONGEST_CYCLE:
        raise ValueError(
            f"cycle={cycle:g} s must be from {least:g} s, the drives' communication cycle, to {LONGEST_CYCLE:g} s"
        )
    return whole_cycles(cycle, least)
