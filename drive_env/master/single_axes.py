"""Drives, emulated or on a bus, as commands for parameters need them: one axis at a time.

Writes go through the Drives interface, and so through its envelope.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.entries import Entry, ObjectName
from drive_env.drives.interface import Drives
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.fieldbus.description import Description


class SingleAxes:
    """Reads and writes single axes.

    Args:
        drives: The drives.
        description: Their device's description.
    """

    def __init__(self, drives: Drives, description: Description) -> None:
        self._drives = drives
        # A machine may have fewer axes than a node of its device.
        per_node = min(description.num_axes, drives.num_axes)
        self.description = replace(description, num_axes=per_node)
        self.num_axes = drives.num_axes
        bus = drives.bus
        self.nodes: tuple[int, ...] = (
            tuple(range(1, 1 + -(-drives.num_axes // per_node))) if bus is None else tuple(bus.nodes)
        )

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""
        return self._drives.read(name)

    def read_axis(self, entry: Entry, axis: int) -> Any:
        """Return an object of one axis: an integer, or a text."""
        found = self._drives.read((entry.index, entry.sub))[axis]
        return str(found) if entry.bits is None else int(found)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every axis, or of some."""
        self._drives.write(name, value, where=where)

    def write_axis(self, entry: Entry, axis: int, value: int | str) -> None:
        """Write an object of one axis."""
        self._drives.write((entry.index, entry.sub), value, where=np.arange(self.num_axes) == axis)

    def sdo(self, node: int) -> _Objects:
        """Return the reader of a node's objects as bytes."""
        return _Objects(self, node)


class _Objects:
    """Reads objects of a node as bytes, for its identity."""

    def __init__(self, axes: SingleAxes, node: int) -> None:
        self._axes = axes
        self._node = node

    def read(self, index: int, sub: int, label: str, timeout: float) -> bytes:
        """Return an object as bytes."""
        known = self._axes.description
        entry = known.dictionary.find((index, sub))
        return known.encode(entry, self._axes.read_axis(entry, self._node * known.num_axes))
