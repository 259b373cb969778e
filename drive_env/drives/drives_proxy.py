"""Base class of wrappers of drives: calls that a wrapper does not override go to the wrapped drives."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from numpy.typing import ArrayLike

from drive_env.drives.interface import CYCLE, BusSide, Drives, MachineSide, Observer, SafetyWatch
from drive_env.drives.trace import Trace
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import ObjectName, ObjectNames, Rows
    from drive_env.drives.emergency import EmergencyMessage


class DrivesProxy:
    """Drives that pass all calls to the drives below; a wrapper overrides some of them.

    Args:
        drives: The drives below.
    """

    def __init__(self, drives: Drives) -> None:
        self._drives = drives

    @property
    def num_axes(self) -> int:
        """Number of axes."""
        return self._drives.num_axes

    @property
    def axis_numbers(self) -> Sequence[int]:
        """Number of each axis."""
        return self._drives.axis_numbers

    @property
    def device(self) -> Device | None:
        """The device; None if only the EDS is known."""
        return self._drives.device

    @property
    def machine(self) -> MachineSide | None:
        """The emulated machines' side; None on a bus."""
        return self._drives.machine

    @property
    def bus(self) -> BusSide | None:
        """The drives of the bus with all axes of its nodes, without this wrapper; None for emulated drives."""
        return self._drives.bus

    @property
    def safety(self) -> SafetyWatch | None:
        """The watch over drives that may be real; None without one."""
        return self._drives.safety

    @property
    def time_waits(self) -> bool:
        """Whether time passes only on request."""
        return self._drives.time_waits

    @property
    def observers(self) -> tuple[Observer, ...]:
        """The observers of these drives, the innermost first."""
        return self._drives.observers

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""
        return self._drives.read(name)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every axis, or of some."""
        self._drives.write(name, value, where=where)

    def advance(self, duration: float) -> None:
        """Let time pass [s]."""
        self._drives.advance(duration)

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let time pass [s] while objects are recorded and played."""
        return self._drives.record(objects, duration, play, period)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return the emergencies that the drives have sent since the last call."""
        return self._drives.emergencies()

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""
        self._drives.reset_node(where)

    def start_node(self, where: Mask | None = None) -> None:
        """Start nodes that have left operational."""
        self._drives.start_node(where)

    def close(self) -> None:
        """Release what the drives hold."""
        self._drives.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._drives.__exit__(kind, error, traceback)
