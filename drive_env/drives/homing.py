"""Homing methods that an axis has, and the speeds that a method needs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.axis_objects import AxisObjects, read_if_there
from drive_env.dictionary.homing_methods import HERE, INDEX_ALONE

if TYPE_CHECKING:
    from drive_env.fieldbus.description import Description
    from mechanics.arrays import Mask

ACCELERATION = (cia402.HOMING_ACCELERATION, 0)
SEARCH, EDGE = (cia402.HOMING_SPEEDS, 1), (cia402.HOMING_SPEEDS, 2)


def methods_of(drives: AxisObjects, known: Description, axis: int) -> list[int]:
    """Return the homing methods of an axis: those of 60E3h and of a known device's data; [] if neither lists any."""
    found: set[int] = set()
    if known.has((cia402.HOMING_METHODS, 1)):
        count = int(drives.read((cia402.HOMING_METHODS, 0))[axis])
        found = {int(drives.read((cia402.HOMING_METHODS, sub))[axis]) for sub in range(1, count + 1)}
    if known.device is not None:
        found |= set(known.device.allowed_values.get((cia402.HOMING_METHOD, 0), ()))
    return sorted(found - {0})


def zero_speeds(drives: AxisObjects, method: int) -> Iterator[tuple[Key, str, Mask]]:
    """Yield the speeds and the acceleration that a homing method needs, an example of each, and which axes have 0."""
    needed = {} if method in HERE else {ACCELERATION: "500 rev/s^2"}
    if method not in (*HERE, *INDEX_ALONE):  # it searches a switch or a stop
        needed[SEARCH] = "100 rpm"
    if method not in HERE and method > 0:  # it searches an edge or an index
        needed[EDGE] = "10 rpm"
    for key, example in needed.items():
        if (values := read_if_there(drives, key)) is not None:
            yield key, example, values == 0


def missing_speeds(drives: AxisObjects, axis: int, method: int) -> dict[Key, str]:
    """Return the speeds and the acceleration that a method needs and an axis has at 0, each with an example."""
    return {key: example for key, example, is_zero in zero_speeds(drives, method) if is_zero[axis]}
