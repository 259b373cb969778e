"""Checks of arguments of the Drives interface: which axes or machines, and whole cycles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drive_env.dictionary.roles import Role
from mechanics.arrays import Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName


LONGEST = 1e7  # s, the longest call, wait or recording: 115 days


def checked_mask(where: Mask | None, count: int) -> Mask:
    """Return the mask of the chosen axes or machines, of `count` in all; all of them by default.

    Raises:
        ValueError: If it is not a boolean array of that length.
    """
    if where is None:
        return np.ones(count, bool)
    mask = np.asarray(where)
    if mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(f"where must be a boolean array of shape ({count},), not {mask.dtype} {mask.shape}")
    return mask


def whole_cycles(duration: float, cycle: float) -> int:
    """Return how many communication cycles [s] fill a duration [s].

    Raises:
        ValueError: If it is not a whole number of cycles.
    """
    if not 0.0 <= duration <= LONGEST:
        raise ValueError(
            f"{duration:g} s is not a whole number of communication cycles; give a time of 0 s to {LONGEST:g} s"
        )
    cycles = round(duration / cycle)
    if abs(cycles * cycle - duration) > 1e-9:
        raise ValueError(
            f"{duration:.12g} s is not a whole number of communication cycles of {cycle:g} s; "
            f"use {cycles * cycle:.12g} s"
        )
    return cycles


def object_names(objects: ObjectName | Sequence[ObjectName]) -> tuple[ObjectName, ...]:
    """Return the objects as a tuple: one by its name or index alone, or several; two integers are two indices."""
    return (objects,) if isinstance(objects, str | int | np.integer | Role) else tuple(objects)
