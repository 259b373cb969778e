"""Late SYNCs of a bus: they distort moves, so messages name them before any other cause."""

from __future__ import annotations

from drive_env.drives.interface import Drives, Observer
from drive_env.fieldbus.link import Timing

NONE = Timing(0, 0, 0.0)
# From here on a check in which the field turns is invalid: one part takes 24 ms, in which the field makes a fifth of a
# turn.
DISTORTING, DISTORTING_SHARE = 0.02, 0.05  # s, lateness of the worst SYNC; share of late SYNCs
LATE = "SYNCs were more than a cycle late"  # `late_first` recognises by it a reason that names them
REMEDY = "end other programs, or put `chrt -f 10` before the command (Linux)"


class Punctuality(Observer):
    """Remembers the timing of the SYNCs before a tuner began.

    Args:
        drives: The drives.
    """

    def __init__(self, drives: Drives) -> None:
        self.before = _timing(drives)


def told_lateness(drives: Drives) -> str:
    """Return a sentence on late SYNCs of a bus in real time, which distort moves and responses; "" without late ones.

    Counts SYNCs since the tuner began if the drives have a `Punctuality` (`tuning.target.timed` adds it), else since
    the drives were opened.
    """
    before, now = _before(drives), _timing(drives)
    if now.late <= before.late:
        return ""
    # `worst` is of all SYNCs since opening: it is only an upper bound for those since the tuner began if it did not
    # change.
    worst = f"the worst by {'at most ' if before.worst == now.worst else ''}{1e3 * now.worst:.1f} ms"
    return (
        f"{now.late - before.late} of {now.cycles - before.cycles} SYNCs were more than a cycle late, {worst}: this "
        f"computer is too busy, which distorts moves and frequency responses; {REMEDY}"
    )


def is_distorted(drives: Drives) -> bool:
    """Return whether SYNCs since the tuner began were so late that the samples cannot be used."""
    before, now = _before(drives), _timing(drives)
    late, worst = now.late - before.late, now.worst if now.worst > before.worst else 0.0
    return late > 0 and (worst >= DISTORTING or late > DISTORTING_SHARE * (now.cycles - before.cycles))


def late_first(drives: Drives, reason: str) -> str:
    """Prepend late SYNCs, if there were any, to the reason of a failure; "" stays ""."""
    late = told_lateness(drives)
    return f"{late}. With that: {reason}" if late and reason and LATE not in reason else reason


def _before(drives: Drives) -> Timing:
    return next((each.before for each in drives.observers if isinstance(each, Punctuality)), NONE)


def _timing(drives: Drives) -> Timing:
    return NONE if drives.time_waits or drives.bus is None else drives.bus.total_timing
