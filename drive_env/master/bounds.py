"""The limits of a program: what the user says, or else what the drive's own dictionary says."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.master.description import Key

if TYPE_CHECKING:
    from drive_env.can_drives import CanDrives

Integers = NDArray[np.int64]

NO_LIMIT = 2**62  # beyond what any object holds
POSITION_LOW, POSITION_HIGH, FOLLOWING_WINDOW = (0x607D, 1), (0x607D, 2), (0x6065, 0)
MAX_PROFILE_VELOCITY = (0x607F, 0)


@dataclass(frozen=True)
class Limits:
    """What a program may do to drives, in the drive's units; None takes the drive's own limit.

    Attributes:
        position: Lowest and highest position [unit of 6064h]; the drive's are 607Dh. Homing is exempt.
        velocity: Highest speed either way [unit of 606Ch]; the drive's is 607Fh, if it has one.
        current: Highest current or torque either way [unit of 6077h]; the drive's is 2003h or 6073h.
        following_error: Largest distance of demand and position in pp and csp; the drive's is 6065h.
        oscillation: Quick-stop an axis whose current oscillates.
        stall: Longest pause between two calls while an axis is enabled [s]; None for any.
        silence: Silence of this process after which the drive stops by itself [s]; None for any.
    """

    position: tuple[int, int] | None = None
    velocity: int | None = None
    current: int | None = None
    following_error: int | None = None
    oscillation: bool = True
    stall: float | None = 1.0
    silence: float | None = 0.5

    def __post_init__(self) -> None:
        if self.position is not None and not self.position[0] < self.position[1]:
            raise ValueError(f"position limits are lowest and highest, not {self.position}")
        for name in ("velocity", "current", "following_error", "stall", "silence"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, not {value}; None takes the drive's own limit")


@dataclass
class Bounds:
    """Limits of every axis, shape (num_axes,); whether any axis has a limit of its position."""

    low: Integers
    high: Integers
    velocity: Integers
    current: Integers
    following: Integers
    has_position: bool = field(init=False)

    def __post_init__(self) -> None:
        self.has_position = bool(np.any((self.low > -NO_LIMIT) | (self.high < NO_LIMIT)))


def read_bounds(limits: Limits, drives: CanDrives) -> Bounds:
    """Return the limits of every axis; those that the user left open are read from the drives."""
    if limits.position is not None:
        low, high = _same(drives, limits.position[0]), _same(drives, limits.position[1])
    else:
        low, high = _own(drives, POSITION_LOW, -NO_LIMIT), _own(drives, POSITION_HIGH, NO_LIMIT)
        # The ends of the type, which are the factory's, are no limits; neither is an empty range.
        empty = low >= high
        low = np.where(empty | (low <= -(2**31)), -NO_LIMIT, low)
        high = np.where(empty | (high >= 2**31 - 1), NO_LIMIT, high)
    current_limit = drives.description.hints.current_limit
    return Bounds(
        low,
        high,
        _magnitude(drives, limits.velocity, MAX_PROFILE_VELOCITY),
        _magnitude(drives, limits.current, current_limit),
        _magnitude(drives, limits.following_error, FOLLOWING_WINDOW),
    )


def _same(drives: CanDrives, value: int) -> Integers:
    return np.full(drives.num_axes, value, np.int64)


def _own(drives: CanDrives, key: Key, absent: int) -> Integers:
    if not drives.description.has(key):
        return _same(drives, absent)
    found: Integers = drives.read_entry(drives.description.dictionary.find(key))
    return found


def _magnitude(drives: CanDrives, given: int | None, key: Key) -> Integers:
    """Return the user's limit, or the drive's; 0 and the end of the type switch the drive's off."""
    if given is not None:
        return _same(drives, given)
    found = _own(drives, key, NO_LIMIT)
    return np.where((found <= 0) | (found >= 2**31 - 1), NO_LIMIT, found)
