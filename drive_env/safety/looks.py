"""The objects that the envelope watches: sampled with every SYNC as far as they fit, the others read."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import Bounds
from drive_env.safety.limits_in_force import LimitsInForce
from drive_env.safety.objects import CURRENT, DEMAND, POSITION, STATUSWORD
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


UNSAMPLED = 0.010  # s between two reads of objects that no PDO carries
ASK, ASK_AGAIN = 0.015, 0.010  # s to wait for an answer in real time, and for that of a node that was silent before
SILENT = 0.05  # s before a silent node is asked again: it must not hold up the others


def answer_time(drives: WatchedDrives, usual: float = ASK) -> float:
    """Return how long to wait for an answer [s]; in lockstep longer, since nothing moves meanwhile."""
    return drives.description.answer_timeout if drives.time_waits else usual


class Looks:
    """The objects that come with every SYNC, and those that are read separately.

    Args:
        drives: The drives.
        axes: Their present state.
        limits: The limits in force.
        observe: Called with an axis' answers: rows, the epoch of the request, the axis.
    """

    def __init__(
        self,
        drives: WatchedDrives,
        axes: Axes,
        limits: LimitsInForce,
        observe: Callable[[Mapping[Key, Integers], int, Mask], None],
    ) -> None:
        self._drives = drives
        self._known = drives.description.dictionary
        self._axes = axes
        self._limits = limits
        self._observe = observe
        self._watched: tuple[Bounds, list[Entry]] | None = None
        self._unsampled: list[Entry] = []
        self._unsampled_at = 0.0
        self._silent: dict[int, float] = {}  # node, by position -> time [s] before which it is not asked again

    @property
    def is_short(self) -> bool:
        """Whether some of the watched objects do not come with SYNC."""
        return bool(self._unsampled)

    def ask_unsampled(self) -> None:
        """Read the objects that no PDO carries, when they are due."""
        now = time.monotonic()
        if self._unsampled and now >= self._unsampled_at:
            self._unsampled_at = now + UNSAMPLED
            self.ask(self._unsampled)

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, most important first; the same list until the limits change."""
        bounds = self._limits.bounds()
        if self._watched is not None and self._watched[0] is bounds:
            return self._watched[1]
        keys = [STATUSWORD, POSITION, self._axes.velocity_object]
        if np.any(bounds.current < NO_LIMIT):
            keys.insert(2, CURRENT)
        if bounds.has_position or np.any(bounds.following < NO_LIMIT):
            keys.append(DEMAND)
        entries = [self._known.find(key) for key in keys if self._drives.description.has(key)]
        self._watched = (bounds, entries)
        return entries

    def sampled(self, chosen: Sequence[Entry]) -> None:
        """Note the objects that come with every SYNC; the other watched ones are read."""
        self._unsampled = [entry for entry in self.watched() if entry not in chosen]
        keys = [(entry.index, entry.sub) for entry in self._unsampled]
        if DEMAND in keys and POSITION not in keys:  # a following error needs both at the same moment
            self._unsampled.insert(0, self._known.find(POSITION))

    def with_unsampled(self, rows: Mapping[Key, Integers]) -> Mapping[Key, Integers]:
        """Return samples together with the last read values of objects that no PDO carries."""
        count = len(next(iter(rows.values()))) if rows else 1
        if self._axes.clock + count * self._drives.description.cycle < self._unsampled_at:
            return rows
        self._unsampled_at = self._axes.clock + UNSAMPLED
        asked = {}
        for entry in self._unsampled:
            value = self._drives.read_entry(entry)
            asked[entry.index, entry.sub] = np.tile(value, (count, 1))
        return {**asked, **rows}

    def ask(self, entries: Sequence[Entry]) -> bool:
        """Read objects of every axis; return whether all answered. Beyond a limit the drives are stopped.

        Nodes that did not answer before come last, one of them per call, so that the others do not wait for them.
        """
        now = self._axes.now()
        due = [node for node, until in self._silent.items() if until <= now][:1]
        answering = [node for node in range(len(self._drives.nodes)) if node not in self._silent]
        complete = len(answering) == len(self._drives.nodes)
        for node in answering:
            complete &= self._ask_node(node, entries, answer_time(self._drives))
        for node in due:
            self._ask_node(node, entries, answer_time(self._drives, ASK_AGAIN))
        return complete

    def _ask_node(self, node: int, entries: Sequence[Entry], timeout: float) -> bool:
        """Read objects of a node's axes, each within `timeout` [s]; return whether all came."""
        per_node = self._drives.description.num_axes
        for axis in range(node * per_node, (node + 1) * per_node):
            epoch = self._axes.epoch
            rows = self._ask_axis(node, axis, entries, timeout)
            where = np.zeros(self._drives.num_axes, bool)
            where[axis] = True
            if rows:
                self._observe(rows, epoch, where)
            if len(rows) < len(entries):
                self._silent.pop(node, None)  # moves it to the end of those asked again
                self._silent[node] = self._axes.now() + SILENT
                return False
        self._silent.pop(node, None)
        return True

    def _ask_axis(self, node: int, axis: int, entries: Sequence[Entry], timeout: float) -> dict[Key, Integers]:
        """Read objects of an axis until one does not answer; return the values that came."""
        rows: dict[Key, Integers] = {}
        for entry in entries:
            index, sub = self._drives.description.key(entry, axis % self._drives.description.num_axes)
            data = self._drives.sdo(node).ask(index, sub, timeout)
            if data is None:
                break
            row = np.zeros((1, self._drives.num_axes), np.int64)
            row[0, axis] = self._drives.description.decode(entry, data)
            rows[entry.index, entry.sub] = row
        return rows
