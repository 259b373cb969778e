"""How drives count speeds and accelerations: in increments of position, or in rpm."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

POSITION_SCALER = (0x2058, 0)
_BY_MINUTE = ("rpm", "rpm/s")


def per_increment(drives: Any, name: int | tuple[int, int]) -> NDArray[np.float64] | float:
    """Return the counts that an object has of one increment a second (or second squared), 1 or shape (num_axes,).

    A drive that is known by its EDS alone is taken to count increments.

    Args:
        drives: Emulated, or on a bus.
        name: Index, or index and sub-index, of a speed or an acceleration.
    """
    device = getattr(drives, "device", None)
    key = name if isinstance(name, tuple) else (name, 0)
    if device is None or device.bindings[key].unit not in _BY_MINUTE:
        return 1.0
    return 60.0 / np.asarray(drives.read(POSITION_SCALER), float)


def per_increment_of(unit: str, scaler: float) -> float:
    """Return the same for a unit, and a scale of positions [inc/rev]."""
    return 60.0 / scaler if unit in _BY_MINUTE else 1.0
