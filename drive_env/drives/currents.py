"""How drives count torques: in milliamperes of torque current, or in parts of the motor's peak current."""

from __future__ import annotations

from typing import Any

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import MILLIAMPERE
from drive_env.drives.interface import BasicDrives, Drives
from mechanics.arrays import Floats, Integers

_OF_PEAK = "1/32767 M-Ipeak"
_WHOLE = 32767.0


def ampere_per_count(drives: Drives) -> Floats | float:
    """Return the amperes of a count of 6071h, 6077h and the current limit, one or shape (num_axes,).

    A drive that is known by its EDS alone is taken to count milliamperes.

    Args:
        drives: Emulated, or on a bus.
    """
    device = drives.device
    row = None if device is None else device.bindings.get((cia402.TORQUE_ACTUAL, 0))
    if row is None or row.unit != _OF_PEAK:
        return MILLIAMPERE
    return peak_current(drives) / _WHOLE


def counts_per_ampere(drives: Drives) -> Floats | float:
    """Return the same the other way round."""
    per_count = ampere_per_count(drives)
    return 1e3 if isinstance(per_count, float) else 1.0 / per_count


def peak_current(drives: BasicDrives) -> Floats:
    """Return the motor's peak current that a drive tells torques in [A], shape (num_axes,)."""
    return np.asarray(drives.read(Role.PEAK_CURRENT), float) * MILLIAMPERE


def to_counts(drives: Drives, current: Any) -> Integers:
    """Return currents [A], axes last, as counts of 6071h and of the current limit."""
    return np.asarray(np.rint(counts_per_ampere(drives) * np.asarray(current, float)), np.int64)
