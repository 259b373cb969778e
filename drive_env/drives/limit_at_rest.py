"""An axis that stands and pushes with all its current: blocked, against a stop, or with an encoder that is stuck.

The drive itself sees nothing wrong: it is enabled, in no fault, and with an encoder that is stuck even its target is
reached. The motor has its greatest torque meanwhile, and turns as soon as what holds it gives way.
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

SHARE = 0.95  # of the current limit, from which on a current is at it: samples are noisy
HELD = 0.5  # s, for which it stands so: to set off takes all the current, too, and less time
SAYS = (
    "its current is at its limit, and it stands: the axis is blocked or stands against a stop, or its encoder is "
    "stuck; disable it, and check both before it is enabled again"
)


class LimitAtRest:
    """Finds axes that stand with their current at its limit; raw integers of the wire throughout.

    Args:
        drives: The drives. No axis is found on drives without a current limit of their own, as steppers, without 606Ch,
            or known by their EDS alone.
    """

    def __init__(self, drives: Drives) -> None:
        self.axes = drives.num_axes
        self._since: Floats = np.full(self.axes, np.nan)  # s, when it began
        device = drives.device
        speed = (cia402.VELOCITY_ACTUAL, 0)
        self.is_known = device is not None and Role.CURRENT_LIMIT in device.roles and speed in device.bindings
        if device is not None and self.is_known:
            self._counts_per_limit = np.asarray(ampere_per_limit(drives) / ampere_per_count(drives), float)
            self._most = np.asarray(highest_current(drives) / ampere_per_count(drives), float)
            increments = np.asarray(drives.read(Role.POSITION_SCALE), float) / (2.0 * np.pi)
            self._slow = device.standstill * increments * per_increment(drives, speed)

    def look(self, now: float, status: ArrayLike, current: ArrayLike, speed: ArrayLike, limit: ArrayLike) -> Mask:
        """Return which axes have stood so for `HELD`, shape (num_axes,).

        Args:
            now: Time of the readings [s].
            status: 6041h, (num_axes,), as all that follow.
            current: 6077h.
            speed: 606Ch.
            limit: The current limit, as its object has it.
        """
        if not self.is_known:
            return np.zeros(self.axes, bool)
        enabled = cia402.matches(np.asarray(status), cia402.OPERATION_ENABLED)
        pushes = enabled & (self.share(current, limit) >= SHARE) & (np.abs(speed) <= self._slow)
        self._since = np.where(pushes, np.fmin(self._since, now), np.nan)
        return np.asarray(now - self._since >= HELD)

    def share(self, current: ArrayLike, limit: ArrayLike) -> Floats:
        """Return the share of its limit that each current is, shape (num_axes,); NaN of a limit of 0, or of none known.

        Args:
            current: 6077h, (num_axes,).
            limit: The current limit, as its object has it, alike.
        """
        if not self.is_known:
            return np.full(self.axes, np.nan)
        most = np.minimum(np.asarray(limit) * self._counts_per_limit, self._most)
        return np.asarray(np.abs(current) / np.where(most > 0, most, np.nan))
