"""A watch over drives in experiments: an axis that oscillates is switched off within 50 ms.

Time passes in windows of 25 ms, and the currents of each are looked at before the next begins. An axis that moves
quietly has a current that hardly changes from one millisecond to the next; one that is shaken on purpose has a current
no larger than it takes. A loop that oscillates breaks the one rule or the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from drive_env import cia402, motion
from drive_env.dictionary.entries import ObjectName, Rows
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import Drives, Observer, device_of
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.trace import Trace
from drive_env.trials.oscillation import OSCILLATION, strongest_frequency
from drive_env.trials.positioning import WATCH
from mechanics.arrays import Floats, Integers, Mask

CLEAR = 3.0
SOFTER = 4  # by what the velocity gains of an axis are divided that oscillates with gains of our own


class OscillationError(RuntimeError):
    """All axes that were experimented on have oscillated, and are off."""


class OscillationWatch(Observer):
    """Switches an axis off that oscillates, to coast, as after a fault.

    Args:
        where: Axes that are experimented on, shape (num_axes,).
        limit: Most current that is asked of each axis [A], shape (num_axes,).
        noise: RMS of the current's samples at rest [A]: a swing within it is no oscillation.

    Attributes:
        limit: As given; it may be lowered.
        swung: Axes that oscillated and were switched off, shape (num_axes,).
        frequency: At which each did so last [Hz], to 40 Hz; nan before, shape (num_axes,).

    What lets time pass raises OscillationError once all of them have.
    """

    objects = (cia402.TORQUE_ACTUAL,)

    def __init__(self, where: Mask, limit: Floats, noise: float = 0.0) -> None:
        self._where = where
        self.limit = limit
        self._least = CLEAR * noise
        self._ampere: Floats | float | None = None  # of a count of the current
        self._shaken: Floats | None = None  # most current meanwhile [A RMS]
        self._window: list[Floats] = []  # currents since the last look, the one before it among them
        self.swung: Mask = np.zeros(len(where), bool)
        self.frequency: Floats = np.full(len(where), np.nan)

    def patience(self) -> int:
        """Return the cycles until the window is full."""
        return WATCH - self._looked()

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Sequence[ObjectName], play: Rows) -> None:
        """Look at the currents, and switch oscillating axes off."""
        if self._ampere is None:
            self._ampere = ampere_per_count(below)
        self._look(below, np.asarray(trace[cia402.TORQUE_ACTUAL], float) * self._ampere)

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

    def soften(self, drives: Drives, where: Mask, gains: Integers, mode: str) -> Integers:
        """Enable axes again that were switched off, with softer velocity gains, and watch them anew.

        Args:
            drives: The drives, as they are watched.
            where: Which, shape (num_axes,).
            gains: Raw gains of all axes, shape (num_axes, count).
            mode: "csv" or "csp".

        Returns:
            The gains, softer where the mask is true.
        """
        softer = np.where(where[:, None], device_of(drives).gains.softened(gains, SOFTER, "velocity"), gains)
        write_gains(drives, softer, where)
        self.swung &= ~where
        drives.write(cia402.TARGET_VELOCITY, 0, where=where)
        motion.enable(drives, mode=mode, where=where)
        return softer

    def _looked(self) -> int:
        return sum(len(part) for part in self._window)

    def _look(self, below: Drives, current: Floats) -> None:
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
            below.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE, where=late)
            self.swung |= late
            self.frequency = np.where(late, strongest_frequency(window)[0], self.frequency)
            if self.swung[self._where].all():
                raise OscillationError("all axes oscillate, and were switched off")


def watch_of(drives: Drives) -> OscillationWatch | None:
    """Return the watch of drives for oscillation, None without one."""
    return next((each for each in drives.observers if isinstance(each, OscillationWatch)), None)


@contextmanager
def shaken(drives: Drives, current: Floats) -> Iterator[None]:
    """Have drives, if they are watched, allow so much current meanwhile [A RMS], shape (num_axes,)."""
    watch = watch_of(drives)
    if watch is None:
        yield
        return
    with watch.shaken(current):
        yield
