"""Slow fallback gains for axes that keep oscillating, even with the last good gains.

A trial stops an axis that oscillates and returns to the last good gains. These may be so close to instability that the
axis, once excited, stays in a limit cycle with them; only this observer detects that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drive_env import cia402
from drive_env.dictionary.entries import ObjectName, Rows
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import Drives, Observer
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.trace import Trace
from drive_env.trials.oscillation import shakes
from drive_env.trials.positioning import WATCH
from mechanics.arrays import Floats, Integers, Mask

WINDOWS = 3  # of 25 ms in a row: a trial reacts after the first, and good gains have the second to damp the oscillation


class FallbackGains(Observer):
    """Gives slow gains to axes that oscillate for too long.

    Args:
        num_axes: Number of axes.
        rated_current: Rated current of their motors [A].
        windows: Oscillating windows of 25 ms in a row until the slow gains are given; a trial reacts after the first.

    Attributes:
        calm: The slow gains, shape (num_axes, count); None until they are known.
        calmed: Axes that got them since the last `begin`, shape (num_axes,).
    """

    def __init__(self, num_axes: int, rated_current: float, windows: int = WINDOWS) -> None:
        self.calm: Integers | None = None
        self.calmed: Mask = np.zeros(num_axes, bool)
        self._rated = rated_current
        self._ampere: Floats | float | None = None  # amperes per count of the current
        self._most = windows
        self._windows = np.zeros(num_axes, np.int64)

    def begin(self) -> None:
        """Reset the counts at the beginning of a trial."""
        self.calmed[:] = False
        self._windows[:] = 0

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Sequence[ObjectName], play: Rows) -> None:
        """Give slow gains to axes that have oscillated for too long."""
        if self.calm is None or cia402.TORQUE_ACTUAL not in asked or len(trace) != WATCH:
            return
        if self._ampere is None:
            self._ampere = ampere_per_count(below)
        shaking = shakes(trace[cia402.TORQUE_ACTUAL] * self._ampere, self._rated)
        self._windows = np.where(shaking, self._windows + 1, 0)
        late = self._windows >= self._most
        if late.any():
            write_gains(below, self.calm, late)
            self.calmed |= late
            self._windows[late] = 0
