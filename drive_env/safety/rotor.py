"""Where the rotors are, in revolutions since the drives were opened: independent of scale and zero of 6064h."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.position_scale import PositionScale, position_scale, set_point_ratio, velocity_ratio
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import RefusedError
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


TURN = 65536.0  # increments per revolution assumed for drives without a position
HOME_OFFSET = (cia402.HOME_OFFSET, 0)


def wrapped(difference: Integers) -> Integers:
    """Return differences of positions, corrected where the 32-bit position has wrapped."""
    result: Integers = (difference + 2**31) % 2**32 - 2**31
    return result


class RotorAngle:
    """Converts between increments of 6064h and revolutions of the rotors.

    Angles are counted from a reference (`place`) in increments since; call `place` again after scale or zero changed.

    Args:
        num_axes: Number of axes.
    """

    def __init__(self, num_axes: int) -> None:
        self._increments = np.zeros(num_axes, np.int64)
        self._turns = np.zeros(num_axes)
        self.scale = np.ones(num_axes)  # increments per revolution; 1 if unknown
        self.ratio = np.ones(num_axes)  # rpm of a velocity unit; 1 without such a unit
        self.set_point_ratio = np.ones(num_axes)  # velocity units of a target of vl; 1 without 604Bh
        self.is_placed = False

    def place(self, increments: Integers, scale: Floats, turns: Floats | None = None) -> None:
        """Set the reference: rotors are at `turns` (default: as computed) where 6064h shows `increments`."""
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
    """Return the objects that give the increments per revolution and the rpm of a velocity unit."""
    roles = description.dictionary.roles
    ratios = (_there(description, ratio) for ratio in (velocity_ratio(roles), set_point_ratio(roles)))
    return _position_objects(description) + tuple(key for ratio in ratios if ratio is not None for key in ratio.keys)


def _there(description: Description, ratio: PositionScale | None) -> PositionScale | None:
    return ratio if ratio is not None and all(description.has(key) for key in ratio.keys) else None


def read_ratios(drives: WatchedDrives) -> tuple[Floats, Floats]:
    """Return the rpm of a velocity unit and the velocity units of a target of vl, of every axis; 1 if it has none."""
    roles = drives.description.dictionary.roles
    return _read(drives, velocity_ratio(roles)), _read(drives, set_point_ratio(roles))


def _read(drives: WatchedDrives, ratio: PositionScale | None) -> Floats:
    there = _there(drives.description, ratio)
    if there is None:
        return np.ones(drives.num_axes)
    known = drives.description.dictionary
    return there.increments([drives.read_entry(known.find(key)).astype(float) for key in there.keys])


def _position_objects(description: Description) -> tuple[Key, ...]:
    """Return the objects that give the increments per revolution."""
    own = _own_scale(description)
    if own is not None:
        return own.keys
    if all(description.has((index, sub)) for index in (cia402.GEAR_RATIO, cia402.FEED_CONSTANT) for sub in (1, 2)):
        return ((cia402.GEAR_RATIO, 1), (cia402.GEAR_RATIO, 2), (cia402.FEED_CONSTANT, 1), (cia402.FEED_CONSTANT, 2))
    return tuple(
        key for key in ((cia402.ENCODER_RESOLUTION, 1), (cia402.ENCODER_RESOLUTION, 2)) if description.has(key)
    )


def read_scale(drives: WatchedDrives) -> Floats:
    """Return the increments per revolution of every axis; nan if the drive does not report them.

    A drive that shows the speed of vl and no position has none: its rpm are counted in `TURN` parts of a revolution.
    """
    has = drives.description.has
    if has((cia402.VL_VELOCITY_ACTUAL, 0)) and not has((cia402.POSITION_ACTUAL, 0)):
        return np.full(drives.num_axes, TURN)
    keys = _position_objects(drives.description)
    known = drives.description.dictionary
    try:
        values = [drives.read_entry(known.find(key)).astype(float) for key in keys]
    except RefusedError:  # the EDS lists an object that the drive lacks
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
