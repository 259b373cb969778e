"""The Drives interface: the calls that drives answer, emulated, on a bus, or behind an observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import ObjectName
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.drives.observed import Observer
    from drive_env.drives.trace import Trace
    from drive_env.emulator.machine import Machines
    from drive_env.master.bus_drives import BusDrives
    from drive_env.safety.envelope import Envelope

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]


class BasicDrives(Protocol):
    """The part that moves axes: objects that are read and written, and time that passes.

    Integers are those of the wire, one for each axis, shape (num_axes,).
    """

    @property
    def num_axes(self) -> int:
        """Number of axes."""

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every axis, or of some."""

    def advance(self, duration: float) -> None:
        """Let time pass [s], whole communication cycles."""


class Drives(BasicDrives, Protocol):
    """Everything that callers may ask of drives.

    An attribute that a kind of drives lacks is None: a bus has no `machine`, emulated drives no `bus` and no `safety`.
    """

    @property
    def device(self) -> Device | None:
        """The device that the drives are; None where only their EDS is known."""

    @property
    def axis_numbers(self) -> Sequence[int]:
        """Each axis' number among all axes of the drives, of which these may be chosen ones."""

    @property
    def machine(self) -> Machines | None:
        """The emulated machines' side that no bus shows."""

    @property
    def bus(self) -> BusDrives | None:
        """The drives of a bus: its nodes, frames and single axes; axis k of these is its axis `axis_numbers[k]`."""

    @property
    def safety(self) -> Envelope | None:
        """The envelope around drives that may be real."""

    @property
    def time_waits(self) -> bool:
        """Whether time stands still until it is asked to pass."""

    @property
    def observers(self) -> tuple[Observer, ...]:
        """Who looks at these drives, the innermost first."""

    def record(
        self,
        objects: ObjectName | Sequence[ObjectName],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = 0.001,
    ) -> Trace:
        """Let time pass [s] while objects are recorded, and others, the keys of `play`, are written row by row."""

    def emergencies(self) -> list[EmergencyMessage]:
        """Return the emergencies of the drives since the last call."""

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""

    def close(self) -> None:
        """Release the drives' resources."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None: ...


def axis_number(drives: BasicDrives, axis: int) -> int:
    """Return an axis' number in messages and results."""
    numbers: Sequence[int] | None = getattr(drives, "axis_numbers", None)  # BasicDrives need not have them
    return axis if numbers is None else int(numbers[axis])


def machine_of(drives: Drives) -> Machines:
    """Return the emulated machines behind drives; ValueError for drives that have none."""
    if drives.machine is None:
        raise ValueError("these drives have no emulated machine; use EmulatedDrives")
    return drives.machine


def bus_of(drives: Drives) -> BusDrives:
    """Return the drives of a bus; ValueError for emulated ones."""
    if drives.bus is None:
        raise ValueError("these drives are not on a bus; use CanDrives")
    return drives.bus


def device_of(drives: Drives) -> Device:
    """Return the device that drives are; ValueError where their EDS alone is known."""
    if drives.device is None:
        raise ValueError("only the EDS of these drives is known; give the device by name")
    return drives.device
