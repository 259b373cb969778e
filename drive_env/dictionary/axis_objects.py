"""Protocol of reading and writing objects of several axes, which suffices for most modules that know a dictionary."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, NO_SUCH_SUB_INDEX, ObjectAccessError
from drive_env.dictionary.entries import ObjectName
from mechanics.arrays import Integers, Mask


class AxisObjects(Protocol):
    """Reads and writes objects of axes. Integers are those on the bus, one for each axis, shape (num_axes,)."""

    @property
    def num_axes(self) -> int:
        """Number of axes."""

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every axis, or of some."""


def read_if_there(drives: AxisObjects, name: ObjectName) -> Integers | None:
    """Return an object of every axis, None if the drives have no such object."""
    try:
        return drives.read(name)
    except ObjectAccessError as error:
        if error.abort_code not in (NO_SUCH_OBJECT, NO_SUCH_SUB_INDEX):
            raise
        return None
