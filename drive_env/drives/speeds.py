"""How drives count speeds and accelerations: in increments of position, or in rpm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import split_unit
from drive_env.drives.interface import Drives

_BY_MINUTE = ("rpm", "rpm/s")


def per_increment(drives: Drives, name: int | tuple[int, int]) -> NDArray[np.float64] | float:
    """Return the counts that an object has of one increment a second (or second squared), 1 or shape (num_axes,).

    A drive that is known by its EDS alone is taken to count increments.

    Args:
        drives: Emulated, or on a bus.
        name: Index, or index and sub-index, of a speed or an acceleration.
    """
    device = drives.device
    key = name if isinstance(name, tuple) else (name, 0)
    if device is None:
        return 1.0
    number, unit = split_unit(device.bindings[key].unit)
    if unit not in _BY_MINUTE:
        return 1.0 / number
    return 60.0 / np.asarray(drives.read(Role.POSITION_SCALE), float) / number


def per_increment_of(unit: str, scaler: float) -> float:
    """Return the same for a unit, and a scale of positions [inc/rev]."""
    number, base = split_unit(unit)
    return (60.0 / scaler if base in _BY_MINUTE else 1.0) / number
