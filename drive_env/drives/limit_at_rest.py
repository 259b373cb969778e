"""Detects an axis that stands at its full current: blocked, against a stop, or with a stuck encoder.

The drive itself detects no error: it is enabled, without a fault, and with a stuck encoder even its target is reached.
The motor has its full torque meanwhile, and turns as soon as the obstacle gives way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, ampere_per_limit, highest_current
from drive_env.drives.interface import Drives
from drive_env.drives.speeds import per_increment
from mechanics.arrays import Floats, Mask

SHARE = 0.95  # of the current limit, above which a current counts as at the limit: samples are noisy
HELD = 0.5  # s for which it must stand at the limit: starting needs all the current, too, but for less time
SAYS = (
    "its current is at its limit, and it stands: the axis is blocked or stands against a stop, or its encoder is "
    "stuck; disable it, and check both before it is enabled again"
)


class LimitAtRest:
    """Finds axes that stand with their current at its limit; all values are raw integers on the bus.

    Args:
        drives: The drives. No axis is found on drives without a current limit, as steppers, without 606Ch, or known
            only by their EDS.
    """

    def __init__(self, drives: Drives) -> None:
        self.axes = drives.num_axes
        self._since: Floats = np.full(self.axes, np.nan)  # s, since when it stands at the limit
        device = drives.device
        speed = (cia402.VELOCITY_ACTUAL, 0)
        self.is_known = device is not None and Role.CURRENT_LIMIT in device.roles and speed in device.bindings
        if device is not None and self.is_known:
            self._counts_per_limit = np.asarray(ampere_per_limit(drives) / ampere_per_count(drives), float)
            self._most = np.asarray(highest_current(drives) / ampere_per_count(drives), float)
            increments = np.asarray(drives.read(Role.POSITION_SCALE), float) / (2.0 * np.pi)
            self._slow = device.standstill * increments * per_increment(drives, speed)

    def look(self, now: float, status: ArrayLike, current: ArrayLike, speed: ArrayLike, limit: ArrayLike) -> Mask:
        """Return which axes have stood at the limit for `HELD`, shape (num_axes,).

        Args:
            now: Time of the readings [s].
            status: 6041h, (num_axes,), like the following ones.
            current: 6077h.
            speed: 606Ch.
            limit: The current limit, in the units of its object.
        """
        if not self.is_known:
            return np.zeros(self.axes, bool)
        enabled = cia402.matches(np.asarray(status), cia402.OPERATION_ENABLED)
        pushes = enabled & (self.share(current, limit) >= SHARE) & (np.abs(speed) <= self._slow)
        self._since = np.where(pushes, np.fmin(self._since, now), np.nan)
        return np.asarray(now - self._since >= HELD)

    def share(self, current: ArrayLike, limit: ArrayLike) -> Floats:
        """Return each current over its limit, shape (num_axes,); NaN if the limit is 0 or unknown.

        Args:
            current: 6077h, (num_axes,).
            limit: The current limit, in the units of its object, (num_axes,).
        """
        if not self.is_known:
            return np.full(self.axes, np.nan)
        most = np.minimum(np.asarray(limit) * self._counts_per_limit, self._most)
        return np.asarray(np.abs(current) / np.where(most > 0, most, np.nan))
