"""A watch over drives in experiments: an axis that oscillates is switched off, or gets calm gains, within 50 ms.

Time passes in windows of 25 ms; the currents of each are checked before the next begins. The current of an axis that
moves quietly hardly changes from one millisecond to the next; that of an axis excited on purpose stays below the
allowed value. A loop that oscillates breaks one of the two rules.
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
SOFTER = 4  # divisor of the velocity gains of an axis that oscillates with gains chosen by the tuner


class OscillationError(RuntimeError):
    """All axes under experiment have oscillated and are switched off."""


class OscillationWatch(Observer):
    """Switches the voltage of an oscillating axis off, so that it coasts as after a fault, or gives it calm gains.

    Args:
        where: Axes under experiment, shape (num_axes,).
        limit: Greatest current commanded to each axis [A], shape (num_axes,).
        noise: RMS of the current samples at rest [A]; smaller changes are not an oscillation.
        calm: Raw gains for axes that oscillate, shape (num_axes, count); None switches these off.

    Attributes:
        limit: As given; it may be lowered later.
        swung: Axes that oscillated and were switched off or calmed, shape (num_axes,).
        frequency: Frequency of each axis' last oscillation [Hz], at most 40 Hz; nan without one, shape (num_axes,).

    Letting time pass raises OscillationError once all axes under experiment are switched off.
    """

    objects = (cia402.TORQUE_ACTUAL,)

    def __init__(self, where: Mask, limit: Floats, noise: float = 0.0, calm: Integers | None = None) -> None:
        self._where, self._calm = where, calm
        self.limit = limit
        self._least = CLEAR * noise
        self._ampere: Floats | float | None = None  # amperes per count of the current
        self._shaken: Floats | None = None  # allowed current during an excitation [A RMS]; None without one
        self._window: list[Floats] = []  # currents since the last check, with the sample before them
        self.swung: Mask = np.zeros(len(where), bool)
        self.frequency: Floats = np.full(len(where), np.nan)

    def patience(self) -> int:
        """Return the number of cycles until the window is full."""
        return WATCH - self._looked()

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Sequence[ObjectName], play: Rows) -> None:
        """Check the currents, and switch oscillating axes off."""
        if self._ampere is None:
            self._ampere = ampere_per_count(below)
        self._look(below, np.asarray(trace[cia402.TORQUE_ACTUAL], float) * self._ampere)

    @contextmanager
    def shaken(self, current: Floats) -> Iterator[None]:
        """Allow this current, however it changes, during the block [A RMS], shape (num_axes,)."""
        before, self._shaken = self._shaken, current
        self._window.clear()
        try:
            yield
        finally:
            self._shaken = before
            self._window.clear()

    def soften(self, drives: Drives, where: Mask, gains: Integers, mode: str) -> Integers:
        """Enable switched-off axes again with softer velocity gains, and watch them again.

        Args:
            drives: The watched drives.
            where: Axes to enable, shape (num_axes,).
            gains: Raw gains of all axes, shape (num_axes, count).
            mode: "csv" or "csp".

        Returns:
            The gains, softened where the mask is true.
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
            if self._calm is None:
                below.write(cia402.CONTROLWORD, cia402.DISABLE_VOLTAGE, where=late)
            else:
                write_gains(below, self._calm, late)
            self.swung |= late
            self.frequency = np.where(late, strongest_frequency(window)[0], self.frequency)
            if self._calm is None and self.swung[self._where].all():
                raise OscillationError("all axes oscillate, and were switched off")


def watch_of(drives: Drives) -> OscillationWatch | None:
    """Return the oscillation watch of drives; None if they have none."""
    return next((each for each in drives.observers if isinstance(each, OscillationWatch)), None)


@contextmanager
def shaken(drives: Drives, current: Floats) -> Iterator[None]:
    """Allow this current during the block [A RMS], shape (num_axes,), if the drives have an oscillation watch."""
    watch = watch_of(drives)
    if watch is None:
        yield
        return
    with watch.shaken(current):
        yield
