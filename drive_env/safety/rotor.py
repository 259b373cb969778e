"""Where the rotors are, in revolutions since the drives were opened: independent of scale and zero of 6064h."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.position_scale import PositionScale, position_scale, velocity_ratio
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import RefusedError
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


HOME_OFFSET = (cia402.HOME_OFFSET, 0)


def wrapped(difference: Integers) -> Integers:
    """Return differences of positions that count on past the end of 32 bits."""
    result: Integers = (difference + 2**31) % 2**32 - 2**31
    return result


class RotorAngle:
    """The way between increments of 6064h and revolutions of the rotors.

    Positions are those of a moment (`place`) and the increments since; place rotors anew after scale or zero changed.

    Args:
        num_axes: How many.
    """

    def __init__(self, num_axes: int) -> None:
        self._increments = np.zeros(num_axes, np.int64)
        self._turns = np.zeros(num_axes)
        self.scale = np.ones(num_axes)  # increments per revolution; 1 where the drive does not say
        self.ratio = np.ones(num_axes)  # rpm of a velocity unit, of drives that have such
        self.is_placed = False

    def place(self, increments: Integers, scale: Floats, turns: Floats | None = None) -> None:
        """Note that rotors are at `turns` where 6064h shows `increments`; where they were believed by default."""
        if turns is None:
            turns = self.turns(increments) if self.is_placed else np.zeros(len(increments))
        self._increments, self._turns, self.scale = increments.copy(), turns.copy(), scale.copy()
        self.is_placed = True

    def turns(self, increments: Integers) -> Floats:
        """Return the angles [rev] at increments."""
        result: Floats = self._turns + wrapped(increments - self._increments) / self.scale
        return result

    def increments(self, turns: Floats) -> Floats:
        """Return the increments at angles [rev]; infinite ones stay so."""
        result: Floats = self._increments + (turns - self._turns) * self.scale
        return result


def _own_scale(description: Description) -> PositionScale | None:
    """Return the objects of the drive's own scale, None for a drive with CiA 402's."""
    own = position_scale(description.dictionary.roles)
    return own if own is not None and all(description.has(key) for key in own.keys) else None


def scale_objects(description: Description) -> tuple[Key, ...]:
    """Return the objects that say how many increments a revolution has, and how many rpm a velocity unit."""
    ratio = _own_ratio(description)
    return _position_objects(description) + (() if ratio is None else ratio.keys)


def _own_ratio(description: Description) -> PositionScale | None:
    ratio = velocity_ratio(description.dictionary.roles)
    return ratio if ratio is not None and all(description.has(key) for key in ratio.keys) else None


def read_ratio(drives: WatchedDrives) -> Floats:
    """Return the rpm of a velocity unit of every axis; 1 of drives that have no such unit."""
    ratio = _own_ratio(drives.description)
    if ratio is None:
        return np.ones(drives.num_axes)
    known = drives.description.dictionary
    return ratio.increments([drives.read_entry(known.find(key)).astype(float) for key in ratio.keys])


def _position_objects(description: Description) -> tuple[Key, ...]:
    """Return the objects that say how many increments a revolution has."""
    own = _own_scale(description)
    if own is not None:
        return own.keys
    if all(description.has((index, sub)) for index in (cia402.GEAR_RATIO, cia402.FEED_CONSTANT) for sub in (1, 2)):
        return ((cia402.GEAR_RATIO, 1), (cia402.GEAR_RATIO, 2), (cia402.FEED_CONSTANT, 1), (cia402.FEED_CONSTANT, 2))
    return tuple(
        key for key in ((cia402.ENCODER_RESOLUTION, 1), (cia402.ENCODER_RESOLUTION, 2)) if description.has(key)
    )


def read_scale(drives: WatchedDrives) -> Floats:
    """Return the increments of a revolution of every axis; nan where the drive does not say."""
    keys = _position_objects(drives.description)
    known = drives.description.dictionary
    try:
        values = [drives.read_entry(known.find(key)).astype(float) for key in keys]
    except RefusedError:  # the EDS has what the drive has not
        values = []
    own = _own_scale(drives.description)
    if own is not None and values:
        scale = own.increments(values)
    elif (
        len(values) == 4
    ):  # feed per revolution of the driving shaft, and revolutions of the motor for one of the shaft
        motor, shaft, feed, shafts = values
        scale = feed / np.where(shafts > 0, shafts, np.nan) * shaft / np.where(motor > 0, motor, np.nan)
    elif len(values) == 2:
        scale = values[0] / np.where(values[1] > 0, values[1], np.nan)
    elif values:
        scale = values[0]
    else:
        scale = np.full(drives.num_axes, np.nan)
    result: Floats = np.where(scale > 0, scale, np.nan)
    return result
