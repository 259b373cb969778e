"""What is inside emulated drives: how tools, faults and tests look there, and change what they must."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.emulator.group import Group
from drive_env.emulator.live_dictionary import LiveDictionary
from drive_env.faults.machine_faults import MachineFaults
from mechanics.arrays import Floats

if TYPE_CHECKING:
    from drive_env.emulator.emulated_drives import EmulatedDrives


class Inside:
    """The truth inside emulated drives, which no drive shows on a bus.

    Args:
        drives: The drives.
    """

    def __init__(self, drives: EmulatedDrives) -> None:
        self._drives = drives

    @property
    def records(self) -> NDArray[np.void]:
        """The drives' records, each of eight lanes, shape (blocks,); `get_lanes` and `set_lanes` read and write one."""
        return self._drives._records

    @property
    def groups(self) -> list[Group]:
        """The machines, in groups with a packed load each."""
        return self._drives._groups

    @property
    def objects(self) -> LiveDictionary:
        """The object dictionary of every axis."""
        return self._drives._objects

    @property
    def faults(self) -> MachineFaults:
        """Faults of the machines."""
        return self._drives._faults

    @property
    def noise_seeds(self) -> Floats:
        """State from which each axis' noise goes on, shape (num_axes,)."""
        return self._drives._noise_seeds

    @property
    def cycle(self) -> int:
        """Communication cycles since the beginning."""
        return self._drives._now

    @cycle.setter
    def cycle(self, number: int) -> None:
        self._drives._now = number

    def cycles(self, duration: float) -> int:
        """Return how many communication cycles a time [s] has.

        Raises:
            ValueError: If it is no time, or no whole number of them.
        """
        return self._drives._cycles(duration)

    def connect_axes(self, first: int, number: int) -> None:
        """Let machines of one axis each have in common what axes of one drive share, as a DC link: as on a node.

        Args:
            first: The drive's first axis.
            number: Its axes that turn a machine.

        Raises:
            ValueError: If they share a DC link, and their machines have different supplies.
        """
        drives = self._drives
        if drives._kind.connect is not None and drives.load.num_axes == 1:
            axes = np.arange(drives.num_axes)
            drives._kind.connect(drives._records, drives.device, (axes >= first) & (axes < first + number))

    def refresh_inertia(self) -> None:
        """Tell the rotors what they turn, after a load was changed."""
        self._drives._refresh_inertia()
