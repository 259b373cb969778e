"""Drives that are watched while they are experimented on: what oscillates is switched off within 50 ms.

Time passes in windows of 25 ms, and the currents of each are looked at before the next begins. An axis that moves
quietly has a current that hardly changes from one millisecond to the next; one that is shaken on purpose has a current
no larger than it takes. A loop that oscillates breaks the one rule or the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env import cia402, motion
from drive_env.drives.trace import Trace
from drive_env.gains import write_gains
from drive_env.trials.gain_trial import OSCILLATION
from drive_env.trials.positioning import WATCH

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

CYCLE = 0.001  # s
DISABLE_VOLTAGE = 0
VELOCITY_P, VELOCITY_I = 2, 3  # of raw gains
CLEAR = 3.0
SOFTER = 4  # by what the velocity gains of an axis are divided that oscillates with gains of our own


class OscillationError(RuntimeError):
    """All axes that were experimented on have oscillated, and are off."""


class WatchedDrives:
    """Drives of which an axis that oscillates is switched off, to coast, as after a fault; everything else is theirs.

    Args:
        drives: The drives.
        where: Axes that are experimented on, shape (num_axes,).
        limit: Most current that is asked of each axis [A], shape (num_axes,).
        noise: RMS of the current's samples at rest [A]: what is not clear of it is no oscillation.

    Attributes:
        watch: This object, also where other drives are wrapped around it.
        limit: As given; it may be lowered.
        swung: Axes that oscillated and were switched off, shape (num_axes,).

    `record` and `advance` raise OscillationError once all of them have.
    """

    def __init__(self, drives: Any, where: Mask, limit: Floats, noise: float = 0.0) -> None:
        self._drives = drives
        self._where = where
        self.limit = limit
        self._least = CLEAR * noise
        self._shaken: Floats | None = None  # most current meanwhile [A RMS]
        self._window: list[Floats] = []  # currents since the last look, the one before it among them
        self.watch = self
        self.swung: Mask = np.zeros(drives.num_axes, bool)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drives, name)

    def advance(self, duration: float) -> None:
        """Let time pass, watched."""
        if duration > 0.0:
            self.record([cia402.TORQUE_ACTUAL], duration)

    def record(
        self,
        objects: Sequence[Any],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = CYCLE,
    ) -> Trace:
        """Let time pass while objects are recorded and played, watched; the period is a cycle."""
        rows = {name: np.asarray(values) for name, values in (play or {}).items()}
        wanted = list(objects) if cia402.TORQUE_ACTUAL in objects else [*objects, cia402.TORQUE_ACTUAL]
        cycles, done, parts = round(duration / CYCLE), 0, []
        while done < cycles:
            now = min(cycles - done, WATCH - self._looked())
            part = {name: values[done : done + now] for name, values in rows.items()}
            parts.append(self._drives.record(wanted, now * CYCLE, part or None, period))
            self._look(np.asarray(parts[-1][cia402.TORQUE_ACTUAL], float) * 1e-3)
            done += now
        return Trace.joined(parts, period) if parts else self._drives.record(objects, 0.0, play, period)

    @contextmanager
    def shaken(self, current: Floats) -> Iterator[None]:
        """Allow so much current meanwhile [A RMS], shape (num_axes,), however it changes."""
        before, self._shaken = self._shaken, current
        self._window.clear()
        try:
            yield
        finally:
            self._shaken = before
            self._window.clear()

    def soften(self, where: Mask, gains: Integers, mode: str) -> Integers:
        """Enable axes again that were switched off, with softer velocity gains, and watch them anew.

        Args:
            where: Which, shape (num_axes,).
            gains: Raw gains of all axes, shape (num_axes, 5).
            mode: "csv" or "csp".

        Returns:
            The gains, softer where the mask is true.
        """
        softer = gains.copy()
        for k in (VELOCITY_P, VELOCITY_I):
            softer[where, k] = np.maximum(gains[where, k] // SOFTER, 1)
        write_gains(self._drives, softer, where)
        self.swung &= ~where
        self._drives.write(cia402.TARGET_VELOCITY, 0, where=where)
        motion.enable(self, mode=mode, where=where)
        return softer

    def _looked(self) -> int:
        return sum(len(part) for part in self._window)

    def _look(self, current: Floats) -> None:
        self._window.append(current)
        if self._looked() < WATCH:
            return
        window = np.concatenate(self._window)
        self._window.clear()
        if self._shaken is None:
            shaking, allowed = np.diff(window, axis=0), OSCILLATION * self.limit
        else:
            shaking, allowed = window - window.mean(axis=0), self._shaken
        late = (np.sqrt(np.mean(shaking**2, axis=0)) > np.maximum(allowed, self._least)) & ~self.swung
        if late.any():
            self._drives.write(cia402.CONTROLWORD, DISABLE_VOLTAGE, where=late)
            self.swung |= late
            if self.swung[self._where].all():
                raise OscillationError("all axes oscillate, and were switched off")


@contextmanager
def shaken(drives: Any, current: Floats) -> Iterator[None]:
    """Have drives, if they are watched, allow so much current meanwhile [A RMS], shape (num_axes,)."""
    watch = getattr(drives, "watch", None)
    if watch is None:
        yield
        return
    with watch.shaken(current):
        yield
