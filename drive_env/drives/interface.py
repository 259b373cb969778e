"""The Drives interface: protocols of drives, emulated, on a bus, or behind an observer.

This module defines the protocols that it names; the classes with a machine, a bus or a watch are above it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from numpy.typing import ArrayLike

from drive_env.dictionary.axis_objects import AxisObjects
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import Entry, ObjectName, ObjectNames, Rows
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.drives.limits import Limits
    from drive_env.drives.trace import Trace
    from drive_env.fieldbus.description import Description
    from drive_env.fieldbus.link import Link, ObjectReader, Timing
    from mechanics.load import Load

CYCLE = 0.001  # s, the communication cycle: drives advance by whole ones, and record one row in each


class BasicDrives(AxisObjects, Protocol):
    """Drives as needed to move axes: objects that are read and written, and time that passes."""

    def advance(self, duration: float) -> None:
        """Let time pass [s], whole communication cycles."""


class DescribedAxes(AxisObjects, Protocol):
    """Axes of nodes, one at a time, as needed to read, compare and write the parameters of a drive."""

    @property
    def description(self) -> Description:
        """The device's description."""

    @property
    def nodes(self) -> tuple[int, ...]:
        """The nodes' addresses."""

    def read_axis(self, entry: Entry, axis: int) -> Any:
        """Return an object of one axis: an integer, or a text."""

    def write_axis(self, entry: Entry, axis: int, value: int | str) -> None:
        """Write an object of one axis."""

    def sdo(self, node: int) -> ObjectReader:
        """Return the reader of a node's objects, by its position in `nodes`."""


class SafetyWatch(Protocol):
    """The watch over drives that may be real, as their user sees it."""

    @property
    def limits(self) -> Limits:
        """The limits of the program."""

    @limits.setter
    def limits(self, limits: Limits) -> None: ...

    def change(self, limits: Limits) -> None:
        """Replace the limits; those of position are in the present counts of 6064h."""

    def leave_alone(self, axes: Iterable[int]) -> None:
        """Note axes that the program never moves."""

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, the most important first."""

    def stop(self, reason: str) -> None:
        """Bring live axes to rest and switch them off."""

    def stop_at_once(self, reason: str) -> None:
        """Have live axes quick-stopped; callable from any thread, whatever the program's thread is doing."""


class MachineSide(Protocol):
    """The emulated machines' side that no bus shows; one value per machine unless stated otherwise."""

    @property
    def drives(self) -> Drives:
        """The emulated drives, without the observers around them."""

    @property
    def load(self) -> Load:
        """The load of each machine."""

    @property
    def parameters(self) -> dict[str, Floats]:
        """True parameters by name [SI]."""

    @property
    def diverged(self) -> Mask:
        """Which machines have diverged and are frozen."""

    @property
    def load_torque(self) -> Floats:
        """External torque on the load [N*m; N on a belt]."""

    @load_torque.setter
    def load_torque(self, value: ArrayLike) -> None: ...

    @property
    def supply(self) -> Floats:
        """Supply voltage of each axis [V], shape (num_axes,)."""

    @supply.setter
    def supply(self, value: ArrayLike) -> None: ...

    def set(self, name: str, value: ArrayLike, where: Mask | None = None) -> None:
        """Set a true parameter [SI]."""

    def set_all(self, values: Mapping[str, ArrayLike], where: Mask | None = None) -> None:
        """Set several true parameters [SI] at once."""

    def pushed(self) -> AbstractContextManager[Callable[[ArrayLike], None]]:
        """Yield a function that puts a torque on each axis [N*m], shape (num_axes,), until the block ends."""

    def reset(self, where: Mask | None = None) -> None:
        """Put machines to rest at zero and restart their drives."""


class Observer:
    """An observer of drives; methods that it does not override do nothing.

    Attributes:
        objects: Objects to record for it whenever time passes.
        hides_machine: Whether users of these drives do not see the emulated machine behind them.
    """

    objects: Sequence[ObjectName] = ()
    hides_machine = False

    def patience(self) -> int | None:
        """Return the number of cycles after which it wants to be called; None: after each record."""
        return None

    def written(self, below: Drives, name: ObjectName, value: ArrayLike, where: Mask | None) -> None:
        """Note a write."""

    def passes(self, duration: float) -> None:
        """Note that time is about to pass [s]."""

    def passed(self, below: Drives, duration: float, trace: Trace, asked: Sequence[ObjectName], play: Rows) -> None:
        """Handle a record.

        Args:
            below: The drives to act on.
            duration: Duration [s].
            trace: The recorded trace.
            asked: The objects that the caller requested.
            play: The played rows.
        """


class Drives(BasicDrives, Protocol):
    """The complete interface of drives.

    An attribute that a kind of drives lacks is None: a bus has no `machine`, emulated drives no `bus` and no `safety`.
    """

    @property
    def device(self) -> Device | None:
        """The device of the drives; None if only their EDS is known."""

    @property
    def axis_numbers(self) -> Sequence[int]:
        """Each axis' number among all axes of the drives, of which these may be a selection."""

    @property
    def machine(self) -> MachineSide | None:
        """The emulated machines' side that no bus shows; None on a bus, or where an observer hides it."""

    @property
    def bus(self) -> BusSide | None:
        """The drives of a bus, whose axis `axis_numbers[k]` is axis k of these; None for emulated drives."""

    @property
    def safety(self) -> SafetyWatch | None:
        """The watch over drives that may be real; None without one."""

    @property
    def time_waits(self) -> bool:
        """Whether time passes only on request."""

    @property
    def observers(self) -> tuple[Observer, ...]:
        """The observers of these drives, the innermost first."""

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let time pass [s] while objects are recorded, and others, the keys of `play`, are written row by row."""

    def emergencies(self) -> list[EmergencyMessage]:
        """Return the emergencies of the drives since the last call."""

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""

    def start_node(self, where: Mask | None = None) -> None:
        """Start nodes that have left operational, as after missed heartbeats; no motor runs by it."""

    def close(self) -> None:
        """Release the drives' resources."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None: ...


class BusSide(Drives, DescribedAxes, Protocol):
    """The drives of a bus with all axes of its nodes."""

    @property
    def link(self) -> Link:
        """The fieldbus."""

    @property
    def total_timing(self) -> Timing:
        """Punctuality of all SYNCs since the drives were opened."""

    def read_of(self, name: ObjectName, axes: Sequence[int]) -> Integers:
        """Return an object of some axes, in their order, as `read` does of all."""

    def can_record(self, objects: Sequence[ObjectName]) -> bool:
        """Return whether objects can be recorded together."""


def axis_number(drives: BasicDrives, axis: int) -> int:
    """Return an axis' number in messages and results."""
    numbers: Sequence[int] | None = getattr(drives, "axis_numbers", None)  # BasicDrives may lack them
    return axis if numbers is None else int(numbers[axis])


def machine_of(drives: Drives) -> MachineSide:
    """Return the emulated machines behind drives; ValueError for drives without a machine in this process."""
    if drives.machine is None:
        raise ValueError("these drives have no emulated machine; use EmulatedDrives")
    return drives.machine


def bus_of(drives: Drives) -> BusSide:
    """Return the drives of a bus; ValueError for emulated ones."""
    if drives.bus is None:
        raise ValueError("these drives are not on a bus; use open_drives")
    return drives.bus


def device_of(drives: Drives) -> Device:
    """Return the device of drives; ValueError if only their EDS is known."""
    if drives.device is None:
        raise ValueError("only the EDS of these drives is known; give the device by name")
    return drives.device
