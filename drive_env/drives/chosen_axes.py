"""Chosen axes of some drives as separate drives: the others are never commanded, and their parameters stay.

A module may have more axes than motors. An operation on all axes of such drives acts on the chosen ones; each keeps its
number (`axis_numbers`) in results and errors. On a bus, process data are still those of whole nodes: when rows are
played, the other axes get their present values.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env.drives.arguments import checked_mask
from drive_env.drives.drives_proxy import DrivesProxy
from drive_env.drives.interface import CYCLE, Drives, SafetyWatch
from drive_env.drives.trace import Trace
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import Entry, ObjectName, ObjectNames, Rows
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.drives.limits import Limits

_PER_AXIS_LIMITS = ("velocity", "current", "following_error")


def chosen_parts(axes: Iterable[int], count: int, name: str) -> tuple[int, ...]:
    """Return axes of a module, each once and in order.

    Args:
        axes: Their numbers, from 0.
        count: Number of axes of a module.
        name: Their name, for the message.

    Raises:
        ValueError: For an axis that it does not have, or an empty choice.
    """
    chosen = tuple(sorted(set(axes)))
    for axis in chosen:
        if not 0 <= axis < count:
            there = "1 axis: 0" if count == 1 else f"{count} axes: 0 to {count - 1}"
            raise ValueError(f"--axis {axis}: a {name} has {there}")
    if not chosen:
        raise ValueError(f"no axis is chosen; name one or several of a {name}, from 0")
    return chosen


class ChosenAxes(DrivesProxy):
    """Chosen axes of drives, with the interface of drives.

    Args:
        drives: The drives, which are closed when the chosen axes are.
        axes: Numbers of the chosen axes, ascending.

    Raises:
        ValueError: For an axis that the drives do not have.
    """

    def __init__(self, drives: Drives, axes: Sequence[int]) -> None:
        super().__init__(drives)
        self._axes = np.array(chosen_parts(axes, drives.num_axes, "set of drives"), np.int64)
        self._numbers = tuple(drives.axis_numbers[k] for k in self._axes)
        self._others: dict[ObjectName, Integers] = {}  # present values of the other axes for played objects
        self._safety: ChosenWatch | None = None
        if drives.safety is not None:
            left_out = set(range(drives.num_axes)) - set(self._axes.tolist())
            drives.safety.leave_alone(left_out)
            self._safety = ChosenWatch(drives.safety, self._axes, drives.num_axes)

    @property
    def num_axes(self) -> int:
        """Number of chosen axes."""
        return len(self._axes)

    @property
    def axis_numbers(self) -> Sequence[int]:
        """Number of each chosen axis."""
        return self._numbers

    @property
    def machine(self) -> None:
        """None: the emulated machine belongs to the other axes, too, and moves with all of them."""
        return None

    @property
    def safety(self) -> SafetyWatch | None:
        """The watch over drives that may be real, with limits of the chosen axes; None without one."""
        return self._safety

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every chosen axis."""
        bus = self._drives.bus
        if bus is not None and bus is self._drives:  # one SDO each: reading the others would only take time
            return bus.read_of(name, self._axes.tolist())
        return np.asarray(self._drives.read(name)[self._axes])

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object of every chosen axis, or of some; ValueError for another number of values than axes."""
        mask = self._of_all(where)
        if isinstance(value, str) or np.ndim(value) == 0:
            self._drives.write(name, value, where=mask)
            return
        given = np.asarray(value)
        if given.shape != (self.num_axes,):
            raise ValueError(f"{given.shape} values are given for {self.num_axes} axes; give one for all, or one each")
        whole = np.full(self._drives.num_axes, given[0], given.dtype)  # values for the other axes are not written
        whole[self._axes] = given
        self._drives.write(name, whole, where=mask)

    def _of_all(self, where: Mask | None) -> Mask:
        """Return a mask of the chosen axes as one of all axes."""
        mask = np.zeros(self._drives.num_axes, bool)
        mask[self._axes[checked_mask(where, self.num_axes)]] = True
        return mask

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let time pass while objects of the chosen axes are recorded and played."""
        rows = {name: self._rows(name, np.asarray(values)) for name, values in (play or {}).items()}
        return self._drives.record(objects, duration, rows or None, period).of_axes(self._axes.tolist())

    def _rows(self, name: ObjectName, values: Integers) -> Integers:
        """Return rows for all axes, with present values for the axes that are not chosen."""
        if name not in self._others:
            self._others[name] = np.asarray(self._drives.read(name))
        whole = np.tile(self._others[name], (len(values), 1))
        whole[:, self._axes] = values if values.ndim == 2 else values[:, None]
        return whole

    def emergencies(self) -> list[EmergencyMessage]:
        """Return the chosen axes' emergencies since the last call, by their position among these."""
        place = {int(axis): k for k, axis in enumerate(self._axes)}
        told = self._drives.emergencies()
        return [message._replace(axis=place[message.axis]) for message in told if message.axis in place]

    def reset_node(self, where: Mask | None = None) -> None:
        """Raise ValueError: a node restarts with all of its axes."""
        raise ValueError("a node is reset with all its axes, and some are left out here; open it with all of them")

    def start_node(self, where: Mask | None = None) -> None:
        """Start the nodes of the chosen axes, or of some of them."""
        self._drives.start_node(self._of_all(where))


class ChosenWatch:
    """The watch over drives with limits of the chosen axes; the others have their drives' own limits.

    Args:
        whole: The watch over all axes.
        axes: The chosen ones.
        count: Number of all axes.
    """

    def __init__(self, whole: SafetyWatch, axes: Integers, count: int) -> None:
        self._whole = whole
        self._axes = axes.tolist()
        self._count = count
        self._limits = self._chosen(whole.limits)

    @property
    def limits(self) -> Limits:
        """The program's limits for the chosen axes."""
        return self._limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self._whole.limits = self._of_all(limits)
        self._limits = limits

    def change(self, limits: Limits) -> None:
        """Replace the limits of the chosen axes."""
        limits.check_axes(len(self._axes))
        self._whole.change(self._of_all(limits))
        self._limits = limits

    def leave_alone(self, axes: Iterable[int]) -> None:
        """Note axes that the program never moves, by their numbers among all."""
        self._whole.leave_alone(axes)

    def watched(self) -> list[Entry]:
        """Return the objects to sample at every SYNC, the most important first."""
        return self._whole.watched()

    def stop(self, reason: str) -> None:
        """Bring live axes to rest and switch them off."""
        self._whole.stop(reason)

    def stop_at_once(self, reason: str) -> None:
        """Have live axes quick-stopped; callable from any thread."""
        self._whole.stop_at_once(reason)

    def _chosen(self, limits: Limits) -> Limits:
        """Select the chosen axes' limits from those of all axes."""
        return _each(limits, lambda value: [value[axis] for axis in self._axes])

    def _of_all(self, limits: Limits) -> Limits:
        """Extend limits of the chosen axes to all axes."""

        def spread(value: Sequence[float | None]) -> list[float | None]:
            whole: list[float | None] = [None] * self._count
            for axis, one in zip(self._axes, value, strict=True):
                whole[axis] = one
            return whole

        def one_each(value: Any) -> Any:
            return None if value is None else spread([value] * len(self._axes) if np.ndim(value) == 0 else value)

        low, high = (None, None) if limits.position is None else map(one_each, limits.position)
        return replace(
            limits,
            position=None if limits.position is None else (low, high),
            **{name: one_each(getattr(limits, name)) for name in _PER_AXIS_LIMITS},
        )


def _each(limits: Limits, chosen: Any) -> Limits:
    """Return limits in which each value per axis is replaced by the function `chosen`."""

    def of(value: Any) -> Any:
        return value if value is None or np.ndim(value) == 0 else chosen(value)

    position = None if limits.position is None else (of(limits.position[0]), of(limits.position[1]))
    return replace(limits, position=position, **{name: of(getattr(limits, name)) for name in _PER_AXIS_LIMITS})
