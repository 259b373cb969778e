"""Units of torques and current limits: milliamperes, or relative to the motor's rated, peak or nominal current."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import MILLIAMPERE
from drive_env.drives.interface import BasicDrives, Drives
from mechanics.arrays import Floats, Integers, Mask

_OF_PEAK, _OF_NOMINAL, _OF_RATED = "1/32767 M-Ipeak", "1/1000 of M-Inull", "1/1000 rated"
_WHOLE = 32767.0


def ampere_per_count(drives: Drives) -> Floats | float:
    """Return the amperes of a count of 6071h and 6077h, one or shape (num_axes,).

    For a drive known only by its EDS milliamperes are assumed.

    Args:
        drives: Emulated, or on a bus.
    """
    device = drives.device
    row = None if device is None else device.bindings.get((cia402.TORQUE_ACTUAL, 0))
    if device is not None and row is not None and row.unit == _OF_RATED:
        return 1e-3 * device.rated_current
    if row is None or row.unit not in (_OF_PEAK, _OF_NOMINAL):
        return MILLIAMPERE
    return peak_current(drives) / _WHOLE if row.unit == _OF_PEAK else ampere_per_limit(drives)


def counts_per_ampere(drives: Drives) -> Floats | float:
    """Return the counts per ampere of 6071h and 6077h, one or shape (num_axes,)."""
    return 1.0 / ampere_per_count(drives)


def peak_current(drives: BasicDrives) -> Floats:
    """Return the motor's peak current to which the drive's torques are relative [A], shape (num_axes,)."""
    return np.asarray(drives.read(Role.PEAK_CURRENT), float) * MILLIAMPERE


def highest_current(drives: Drives) -> Floats | float:
    """Return the highest possible current [A], one or (num_axes,): the motor's peak current; infinite if unknown."""
    per_count = ampere_per_count(drives)
    return math.inf if isinstance(per_count, float) else peak_current(drives)


def to_counts(drives: Drives, current: Any) -> Integers:
    """Return currents [A], axes last, as counts of 6071h."""
    return np.asarray(np.rint(counts_per_ampere(drives) * np.asarray(current, float)), np.int64)


def ampere_per_limit(drives: Drives) -> Floats | float:
    """Return the amperes of a count of the current limit, one or shape (num_axes,).

    Its unit is that of 6077h, or thousandths of the motor's nominal current if the drive has that role.
    """
    device = drives.device
    if device is None or Role.NOMINAL_CURRENT not in device.roles:
        return ampere_per_count(drives)
    return np.asarray(drives.read(Role.NOMINAL_CURRENT), float) * (MILLIAMPERE * 1e-3)


def current_limit_roles(drives: Drives) -> tuple[Role, ...]:
    """Return the roles of the current limits that a drive has: one, or one for each sign."""
    device = drives.device
    both = (Role.CURRENT_LIMIT, Role.CURRENT_LIMIT_NEGATIVE)
    return both[:1] if device is None else tuple(role for role in both if role in device.roles)


def read_current_limit(drives: Drives) -> Floats:
    """Return the current limit of every axis [A], shape (num_axes,): the least of both signs and the peak current."""
    raw = np.min([drives.read(role) for role in current_limit_roles(drives)], axis=0)
    return np.asarray(np.minimum(raw * ampere_per_limit(drives), highest_current(drives)), float)


def write_current_limit(drives: Drives, current: ArrayLike, where: Mask | None = None) -> None:
    """Write the current limit [A] of both signs.

    Args:
        drives: Emulated, or on a bus.
        current: One for all axes, or one each.
        where: Axes; all by default.
    """
    counts = np.asarray(current, float) / ampere_per_limit(drives)
    raw = np.rint(np.broadcast_to(counts, (drives.num_axes,))).astype(np.int64)
    for role in current_limit_roles(drives):
        drives.write(role, raw, where=where)
