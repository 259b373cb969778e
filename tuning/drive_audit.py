"""An audit of a tuner's use of drives: time, moves, and violations of their limits.

Tuners are compared by these counts, not by their own statements: the audit is between tuner and drives, and hides the
emulated machine behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary, ObjectName, Rows
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, counts_per_ampere
from drive_env.drives.interface import CYCLE, Drives, Observer
from drive_env.drives.speeds import per_increment
from drive_env.drives.trace import Trace
from drive_env.trials.oscillation import OSCILLATION
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers, Mask
from tuning.move_counter import MoveCounter
from tuning.target import Target

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry


# Violations; each is counted once, when it begins.
OVERSPEED = 1.2  # times the target's limit of speed
BLOCK, SHAKING_BLOCKS = 25, 4  # [cycles]: an oscillation that was not stopped within 100 ms
SLACK = 0.02  # rev beyond the travel that are not yet a violation: a few counts of overshoot at its end
KINDS = ("left its travel", "too fast", "oscillated", "tripped")


@cache
def _dictionary(device: str) -> ObjectDictionary:
    """Return the object dictionary of a device for look-ups; cached, since reading it takes longer than a trial."""
    return find_device(device).new_dictionary()


class DriveAudit(Observer):
    """Counts a tuner's time, moves and violations, and hides the emulated machine from the tuner.

    Args:
        target: The target to be tuned.

    Attributes:
        seconds: Time of the last write to each axis, or of its last played motion [s], shape (num_axes,): the axis
            was in use until then.
        elapsed: Time since the audit began [s].
        violations: Number of violations by kind of `KINDS`, shape (4, num_axes).
    """

    objects = (cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD)
    hides_machine = True  # a tuner must not see true parameters

    def __init__(self, target: Target) -> None:
        drives = target.drives
        count = target.num_axes
        self.elapsed = 0.0
        self.seconds = np.zeros(count)
        self.violations = np.zeros((len(KINDS), count), np.int64)
        self._dictionary = _dictionary(target.device.name)
        scaler = np.asarray(drives.read(Role.POSITION_SCALE), float)
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        self._low, self._high = (ends * scaler / (2.0 * np.pi) for ends in (target.low, target.high))
        self._slack = SLACK * scaler
        limit = target.speed * scaler / (2.0 * np.pi)
        counts = per_increment(drives, cia402.VELOCITY_ACTUAL)
        self._ampere = ampere_per_count(drives)
        self._fastest = OVERSPEED * limit * counts
        self._counter = MoveCounter(limit, target.current * counts_per_ampere(drives), counts)
        self._rated = target.motor.rated_current
        self._outside: Mask = np.zeros((len(KINDS), count), bool)
        self._last_current = np.zeros(count)
        self._squares, self._in_block = np.zeros(count), 0
        self._shaken = np.zeros(count, np.int64)  # number of shaking blocks in a row

    @property
    def moves(self) -> Integers:
        """Commanded motions from standstill to standstill so far, as move_counter.py counts them, shape (num_axes,)."""
        return self._counter.moves

    def written(self, below: Drives, name: ObjectName, value: ArrayLike, where: Mask | None) -> None:
        """Count moves that a write starts."""
        axes = np.ones(len(self.seconds), bool) if where is None else where
        self.seconds[axes] = self.elapsed
        entry = self._dictionary.find(name)
        self._counter.written((entry.index, entry.sub), value, axes)

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Sequence[ObjectName], play: Rows) -> None:
        """Count time, moves and violations of a passed duration."""
        self.elapsed += duration
        rows = {(entry.index, entry.sub): values for entry, values in self._entries(play)}
        moved = self._counter.passed(round(duration / CYCLE), rows)
        self.seconds[moved] = self.elapsed
        self._watch(trace)
        current = np.asarray(trace[cia402.TORQUE_ACTUAL], float) * self._ampere
        if play:  # played rows excite the axis on purpose
            self._shaken[:] = 0
            self._squares[:], self._in_block, self._last_current = 0.0, 0, current[-1]
        else:
            self._watch_current(current)

    def _entries(self, play: Rows) -> list[tuple[Entry, ArrayLike]]:
        return [(self._dictionary.find(name), values) for name, values in (play or {}).items()]

    def _watch(self, trace: Trace) -> None:
        position = wrapped(trace[cia402.POSITION_ACTUAL] - self._origin)
        rows = np.stack(
            [
                (position < self._low - self._slack) | (position > self._high + self._slack),
                np.abs(trace[cia402.VELOCITY_ACTUAL]) > self._fastest,
                np.zeros(position.shape, bool),
                cia402.matches(trace[cia402.STATUSWORD], cia402.FAULT_BIT),
            ]
        )
        before = np.concatenate([self._outside[:, None], rows[:, :-1]], axis=1)
        self.violations += np.sum(rows & ~before, axis=1)
        self._outside = rows[:, -1]

    def _watch_current(self, current: Floats) -> None:
        change = np.diff(np.concatenate([self._last_current[None], current]), axis=0) ** 2
        self._last_current = current[-1]
        at = 0
        while at < len(change):
            part = change[at : at + BLOCK - self._in_block]
            self._squares += part.sum(axis=0)
            self._in_block += len(part)
            at += len(part)
            if self._in_block == BLOCK:
                shaking = np.sqrt(self._squares / BLOCK) > OSCILLATION * self._rated
                self._shaken = np.where(shaking, self._shaken + 1, 0)
                self.violations[KINDS.index("oscillated")] += self._shaken == SHAKING_BLOCKS
                self._squares, self._in_block = np.zeros_like(self._squares), 0
