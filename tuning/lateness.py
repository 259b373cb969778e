"""SYNCs of a bus that were late: what distorts a move, before anything else is blamed for what it shows."""

from __future__ import annotations

from drive_env.drives.interface import Drives, Observer
from drive_env.fieldbus.link import Timing

NONE = Timing(0, 0, 0.0)
# From here on a check that turns the field says nothing: a part of it takes 24 ms, in which the field turns by a fifth.
DISTORTING, DISTORTING_SHARE = 0.02, 0.05  # s, of the worst SYNC; of all
LATE = "SYNCs were more than a cycle late"  # by which a reason is known that names them
REMEDY = "end other programs, or put `chrt -f 10` before the command (Linux)"


class Punctuality(Observer):
    """Knows how punctual the SYNCs of drives were before a tuner began.

    Args:
        drives: The drives.
    """

    def __init__(self, drives: Drives) -> None:
        self.before = _timing(drives)


def told_lateness(drives: Drives) -> str:
    """Return what to say of SYNCs of a bus in real time that were late, which distorts moves and responses; or "".

    Of those since the tuner began, where it is known when (`tuning.target.timed` knows), else since the drives were
    opened.
    """
    before, now = _before(drives), _timing(drives)
    if now.late <= before.late:
        return ""
    # The worst of all runs: that of these alone, unless it is the same as before.
    worst = f"the worst by {'at most ' if before.worst == now.worst else ''}{1e3 * now.worst:.1f} ms"
    return (
        f"{now.late - before.late} of {now.cycles - before.cycles} SYNCs were more than a cycle late, {worst}: this "
        f"computer is too busy, which distorts moves and frequency responses; {REMEDY}"
    )


def is_distorted(drives: Drives) -> bool:
    """Return whether SYNCs were so late since the tuner began that what the drives showed says nothing."""
    before, now = _before(drives), _timing(drives)
    late, worst = now.late - before.late, now.worst if now.worst > before.worst else 0.0
    return late > 0 and (worst >= DISTORTING or late > DISTORTING_SHARE * (now.cycles - before.cycles))


def late_first(drives: Drives, reason: str) -> str:
    """Return why something failed, late SYNCs first if there were any; "" stays ""."""
    late = told_lateness(drives)
    return f"{late}. With that: {reason}" if late and reason and LATE not in reason else reason


def _before(drives: Drives) -> Timing:
    return next((each.before for each in drives.observers if isinstance(each, Punctuality)), NONE)


def _timing(drives: Drives) -> Timing:
    return NONE if drives.time_waits or drives.bus is None else drives.bus.total_timing
