"""The Drives interface: what callers may ask of drives, emulated, on a bus, or behind an observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from numpy.typing import ArrayLike

from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import ObjectName
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.drives.observed import Observer
    from drive_env.drives.trace import Trace
    from drive_env.emulator.machine import Machines
    from drive_env.master.bus_drives import BusDrives
    from drive_env.safety.envelope import Envelope


class BasicDrives(Protocol):
    """What it takes to move axes: objects that are read and written, and time that passes.

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

    What a kind of drives does not have is None: a bus has no `machine`, emulated drives have no `bus` and no `safety`.
    """

    @property
    def device(self) -> Device | None:
        """What the drives are; None where only their EDS is known."""

    @property
    def axis_numbers(self) -> Sequence[int]:
        """What each axis is called: its number among all axes of the drives, of which these may be chosen ones."""

    @property
    def machine(self) -> Machines | None:
        """The emulated machines' side that no bus shows."""

    @property
    def bus(self) -> BusDrives | None:
        """The drives of a bus: its nodes, frames and single axes; axis k of these is its axis `axis_numbers[k]`."""

    @property
    def safety(self) -> Envelope | None:
        """What watches over drives that may be real."""

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
        """Return what the drives have said by themselves since the last call."""

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""

    def close(self) -> None:
        """Release what the drives hold."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None: ...


def axis_number(drives: BasicDrives, axis: int) -> int:
    """Return what an axis is called in messages and results."""
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
    """Return what drives are; ValueError where their EDS alone is known."""
    if drives.device is None:
        raise ValueError("only the EDS of these drives is known; give the device by name")
    return drives.device
