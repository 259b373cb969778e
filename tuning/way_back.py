"""The last lines of a command that changes drives of a bus: the remaining changes, and the command that restores.

They are measured, not assumed: after the run has closed the drives, they are opened again and compared with the file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError
from drive_env.held_signals import held_signals
from drive_env.master.open_drives import check_answers, open_drives
from drive_env.master.parameters import Difference, list_differences
from tuning.snapshot import Snapshot, differences, load_snapshot
from tuning.target import LOCKSTEP_PATIENCE


@contextmanager
def way_back(file: Path | None, program: str) -> Iterator[None]:
    """Print on stderr, if a block that changes drives fails, the remaining changes and the command that restores them.

    Args:
        file: The file with the state before, which the block writes before its first change; None for emulated drives,
            which end with the program. The block must open and close the drives itself: closing restores what they
            borrowed.
        program: Name of the program for the message.
    """
    try:
        yield
    except BaseException as error:
        if file is not None and file.exists():
            print(f"{program}: {what_is_changed(file)}", file=sys.stderr)
        elif file is not None and isinstance(error, KeyboardInterrupt):
            print(f"{program}: nothing was changed", file=sys.stderr)
        raise


def what_is_changed(file: Path) -> str:
    """Read drives of a bus again; return a message with the differences from a file of the state before.

    A node that does not answer is not woken: it may be stopping by itself (docs/safety.md).
    """
    with held_signals():  # a second Ctrl-C would suppress the line that matters
        try:
            snapshot = load_snapshot(file)
            found = read_anew(snapshot)
        except (BusError, ObjectAccessError, OSError, RuntimeError, ValueError) as error:
            why = str(error).partition(";")[0]
            return (
                f"what is changed still is not known: {why}. Once it answers, drive-tune undo {file} restores the "
                "state before"
            )
    if not found:
        return f"the drives have their state from before, by a second reading; drive-tune undo {file} restores it"
    several = len(snapshot.axes) + len(snapshot.left_out) > 1
    told = [f"{f'axis {axis}: ' if several else ''}{list_differences([one])}" for axis, one in found[:TOLD]]
    more = f" and {len(found) - TOLD} more" if len(found) > TOLD else ""
    return f"changed still: {', '.join(told)}{more}; drive-tune undo {file} restores the state before"


TOLD = 5  # differences listed in one line


def read_anew(snapshot: Snapshot) -> list[tuple[int, Difference]]:
    """Open the drives of a snapshot again and return their `differences`; raise if they do not answer."""
    address = {name: value for name, value in snapshot.bus.items() if name != "axes"}
    if address.get("pace") == "lockstep":
        address["timeout"] = LOCKSTEP_PATIENCE
    check_answers(snapshot.device, **address)
    with open_drives(snapshot.device, safety=False, **address) as drives:
        return differences(drives, snapshot)
