"""Pace of cycles: when the next SYNC is due."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from drive_env.drives.arguments import whole_cycles
from drive_env.fieldbus.link import Timing

MOST_FRAMES = 256  # received between two SYNCs; a bus of 1 Mbit/s carries about 8 in a millisecond
CATCH_UP = 0.02  # of a cycle, by which a SYNC is moved to suit the drives' clocks
LONGEST_CYCLE = 0.1  # s: a slower cycle would leave the drives without monitoring
Receive = Callable[[float], bool]  # waits that many seconds for a frame; returns whether one came


def _take_in(receive: Receive) -> None:
    """Receive waiting frames; ends even if frames arrive faster than they are processed."""
    for _ in range(MOST_FRAMES):
        if not receive(0.0):
            return


class Pace(Protocol):
    """The calls of a run of cycles to its pace."""

    window: int  # SYNCs that may be sent before their samples have arrived
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

    A SYNC that is more than a cycle late shifts the following ones: several at once would not make the motor faster,
    only its set-points. Between runs of cycles, which a policy makes one by one, half a cycle late is the limit: a
    single action of 1.1 ms does not shift the drives' rhythm.

    Args:
        cycle: Communication cycle [s].
        phase: Returns the delay [s] after an instant [s, of perf_counter] at which a SYNC suits the drives' clocks;
            None if they have no clocks.
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
        if self._phase is not None:  # this computer's clock runs at another rate
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
    """SYNCs as fast as the emulator answers; time passes only with them."""

    window = 16
    time_waits = True

    def __init__(self) -> None:
        self.timing = self.total = Timing(0, 0, 0.0)

    def begin(self) -> None:
        """Begin a run of cycles."""
        self.timing = Timing(0, 0, 0.0)

    def wait(self, receive: Receive) -> int:
        """Receive waiting frames; in lockstep there is no time to wait for, and none to miss."""
        _take_in(receive)
        self.timing, self.total = (Timing(one.cycles + 1, 0, 0.0) for one in (self.timing, self.total))
        return 0

    def end(self, receive: Receive) -> None:
        """Do nothing: no time passes without SYNC."""


def cycles_per_sync(cycle: float, least: float, pace: str) -> int:
    """Return how many communication cycles [s] pass from SYNC to SYNC [s]; ValueError for an impossible ratio."""
    if pace == "lockstep":
        raise ValueError(f"cycle={cycle:g} s is for real time: in lockstep each SYNC is a cycle of {least:g} s")
    if not least <= cycle <= LONGEST_CYCLE:
        raise ValueError(
            f"cycle={cycle:g} s must be from {least:g} s, the drives' communication cycle, to {LONGEST_CYCLE:g} s"
        )
    return whole_cycles(cycle, least)
