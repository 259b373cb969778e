"""The axes of one node: which of the emulated axes they are, and actions on all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import overload

import numpy as np

from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.firmware.common.protection import COMMUNICATION
from drive_env.node.axis import Axis


class NodeAxes(Sequence[Axis]):
    """The axes of a node, in their order.

    Args:
        drives: The emulated drives.
        first_axis: Number of the device's first axis among the drives'.
        spare: Drives of the node's last axes if `drives` have too few.

    Raises:
        ValueError: For axes that the drives do not have.
    """

    def __init__(self, drives: EmulatedDrives, first_axis: int = 0, spare: EmulatedDrives | None = None) -> None:
        device, objects = drives.device, drives.inside.objects
        number = device.num_axes - (0 if spare is None else spare.num_axes)
        if not 0 <= first_axis <= drives.num_axes - number:
            raise ValueError(
                f"first_axis={first_axis}: {device.name} has {number} of the {drives.num_axes} axes there are; "
                f"use 0 to {drives.num_axes - number}"
            )
        drives.inside.connect_axes(first_axis, number)
        mask = np.zeros(drives.num_axes, bool)
        mask[first_axis : first_axis + number] = True
        self._axes = [Axis(objects, int(k)) for k in np.flatnonzero(mask)]
        self._sets = [(objects, mask)]
        if spare is not None:
            self._axes += [Axis(spare.inside.objects, k) for k in range(spare.num_axes)]
            self._sets.append((spare.inside.objects, np.ones(spare.num_axes, bool)))

    def __len__(self) -> int:
        return len(self._axes)

    @overload
    def __getitem__(self, number: int) -> Axis: ...
    @overload
    def __getitem__(self, number: slice) -> Sequence[Axis]: ...
    def __getitem__(self, number: int | slice) -> Axis | Sequence[Axis]:
        return self._axes[number]

    def __iter__(self) -> Iterator[Axis]:
        return iter(self._axes)

    def restart(self) -> None:
        """Restore the stored values of the axes and start their firmware anew; the motors are off."""
        for objects, mask in self._sets:
            objects.restart(mask)
        for axis in self._axes:
            axis.forget_texts()

    def trip(self, told: str = COMMUNICATION) -> bool:
        """Take each axis from operation enabled into fault, since its network is lost; return whether any was there.

        Args:
            told: The condition that the node reports.
        """
        tripped = [axis.trip(told) for axis in self._axes]  # a list: all of them trip, not only those up to the first
        return any(tripped)

    def engrave(self, key: tuple[int, int], raw: int) -> None:
        """Set the factory value of an object of all axes, such as a serial number."""
        for objects, mask in self._sets:
            objects.engrave(key, raw, mask)

    def store(self, values: Sequence[Mapping[tuple[int, int], int]]) -> None:
        """Set the values that a restart restores, axis by axis: those of existing objects, limited to their range."""
        for axis, stored in zip(self._axes, values, strict=True):
            axis.store(stored)
