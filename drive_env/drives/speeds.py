"""Units of speeds and accelerations: increments of position, rpm, or a unit of the drive."""

from __future__ import annotations

import numpy as np

from drive_env.dictionary.position_scale import velocity_ratio
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import split_unit
from drive_env.drives.interface import Drives
from mechanics.arrays import Floats

_BY_MINUTE = ("rpm", "rpm/s")
_BY_RATIO = ("velocity unit", "velocity unit/s")  # a drive's own unit, whose rpm two of its objects give


def per_increment(drives: Drives, name: int | tuple[int, int]) -> Floats | float:
    """Return an object's counts per increment a second (or second squared), 1 or shape (num_axes,).

    For a drive known only by its EDS increments are assumed.

    Args:
        drives: Emulated, or on a bus.
        name: Index, or index and sub-index, of a speed or an acceleration.
    """
    device = drives.device
    key = name if isinstance(name, tuple) else (name, 0)
    unit = "" if device is None else device.bindings[key].unit
    number, base = split_unit(unit)
    if base not in _BY_MINUTE + _BY_RATIO:
        return 1.0 / number
    rpm = 60.0 / np.asarray(drives.read(Role.POSITION_SCALE), float) / number
    return rpm if base in _BY_MINUTE else rpm / rpm_of_unit(drives)


def rpm_of_unit(drives: Drives) -> Floats:
    """Return the rpm of a velocity unit, shape (num_axes,); 1 for drives without such a unit."""
    device = drives.device
    ratio = None if device is None else velocity_ratio(device.roles)
    if ratio is None:
        return np.ones(drives.num_axes)
    return ratio.increments([np.asarray(drives.read(key), float) for key in ratio.keys])


def per_increment_of(unit: str, scaler: float, ratio: float = 1.0) -> float:
    """Return the counts of a unit per increment, by the position scale [inc/rev] and the rpm of a velocity unit."""
    number, base = split_unit(unit)
    if base in _BY_RATIO:
        return 60.0 / scaler / ratio / number
    return (60.0 / scaler if base in _BY_MINUTE else 1.0) / number
