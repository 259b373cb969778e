"""Drives that count what is done to them: the time it took, moves, and what a drive must not be put through.

A tuner is compared by what it did, not by what it says: the meter stands between it and the drives, and it hides the
emulated machine behind them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env import motion
from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.positioning import CURRENT, CYCLE, POSITION, STATUS, VELOCITY, wrapped
from drive_env.speeds import per_increment
from tuning.moves import MoveCounter
from tuning.target import POSITION_SCALER, Target

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# What counts as a violation, each time anew that it begins:
OVERSPEED = 1.2  # times the target's limit of speed
BLOCK, SHAKING_BLOCKS = 25, 4  # [cycles]: an oscillation that nobody has stopped after 100 ms
SHAKING = 0.4  # RMS change of the current per ms over the rated current, as gain_trial.OSCILLATION
SLACK = 0.02  # rev beyond the travel that are none yet: a few counts of an overshoot at its end
KINDS = ("left its travel", "too fast", "oscillated", "tripped")

_WATCHED = (POSITION, VELOCITY, CURRENT, STATUS)


@cache
def _dictionary(device: str) -> ObjectDictionary:
    """Return the object dictionary of a device, for looking objects up; reading it takes longer than a trial."""
    return find_device(device).new_dictionary()


class MeteredDrives:
    """Drives behind a meter; what is not counted is theirs.

    Args:
        target: What is tuned.

    Attributes:
        seconds: When each axis was last written to, or moved by what was played [s], (num_axes,): until then it was in
            use.
        elapsed: Time that passed [s].
        violations: By kind of `KINDS`, (4, num_axes).
    """

    machine = None  # true parameters are nobody's business who tunes

    def __init__(self, target: Target) -> None:
        drives = target.drives
        count = target.num_axes
        self.elapsed = 0.0
        self.seconds = np.zeros(count)
        self.violations = np.zeros((len(KINDS), count), np.int64)
        self._drives = drives
        self._dictionary = _dictionary(target.device.name)
        scaler = np.asarray(drives.read(POSITION_SCALER), float)
        self._origin = drives.read(POSITION)
        self._low, self._high = (ends * scaler / (2.0 * np.pi) for ends in (target.low, target.high))
        self._slack = SLACK * scaler
        limit = target.speed * scaler / (2.0 * np.pi)
        counts = per_increment(drives, VELOCITY)
        self._fastest = OVERSPEED * limit * counts
        self._counter = MoveCounter(limit, target.current * 1e3, counts)
        self._rated = target.motor.rated_current
        self._outside: Mask = np.zeros((len(KINDS), count), bool)
        self._last_current = np.zeros(count)
        self._squares, self._in_block = np.zeros(count), 0
        self._shaken = np.zeros(count, np.int64)  # blocks in a row

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drives, name)

    @property
    def moves(self) -> Integers:
        """Commanded motions from standstill to standstill so far, as moves.py counts them, (num_axes,)."""
        return self._counter.moves

    def write(self, name: Any, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object, and count what it starts."""
        self._drives.write(name, value, where=where)
        axes = np.ones(len(self.seconds), bool) if where is None else where
        self.seconds[axes] = self.elapsed
        entry = self._dictionary.find(name)
        self._counter.written((entry.index, entry.sub), value, axes)

    def advance(self, duration: float) -> None:
        """Let time pass, watched."""
        if duration > 0.0:
            self.record([], duration)

    def record(
        self,
        objects: Sequence[Any],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = CYCLE,
    ) -> Any:
        """Let time pass while objects are recorded and played, watched."""
        watched = [name for name in _WATCHED if name not in objects]
        trace = self._drives.record([*objects, *watched], duration, play, period)
        self.elapsed += duration
        rows = {(entry.index, entry.sub): values for entry, values in self._entries(play)}
        moved = self._counter.passed(round(duration / CYCLE), rows)
        self.seconds[moved] = self.elapsed
        self._watch(trace)
        current = np.asarray(trace[CURRENT], float) * 1e-3
        if play:  # what is played is to shake the axis
            self._shaken[:] = 0
            self._squares[:], self._in_block, self._last_current = 0.0, 0, current[-1]
        else:
            self._watch_current(current)
        return trace

    def _entries(self, play: Mapping[Any, ArrayLike] | None) -> list[tuple[Entry, ArrayLike]]:
        return [(self._dictionary.find(name), values) for name, values in (play or {}).items()]

    def _watch(self, trace: Any) -> None:
        position = wrapped(trace[POSITION] - self._origin)
        mask, fault = motion.FAULT_BIT
        rows = np.stack(
            [
                (position < self._low - self._slack) | (position > self._high + self._slack),
                np.abs(trace[VELOCITY]) > self._fastest,
                np.zeros(position.shape, bool),
                trace[STATUS] & mask == fault,
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
                shaking = np.sqrt(self._squares / BLOCK) > SHAKING * self._rated
                self._shaken = np.where(shaking, self._shaken + 1, 0)
                self.violations[KINDS.index("oscillated")] += self._shaken == SHAKING_BLOCKS
                self._squares, self._in_block = np.zeros_like(self._squares), 0
