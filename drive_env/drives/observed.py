"""Drives with observers: one wrapper, and observers that count, monitor, act, or hide something."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.roles import Role
from drive_env.drives.interface import Drives
from drive_env.drives.trace import Trace
from mechanics.arrays import Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.dictionary.entries import ObjectName
    from drive_env.drives.emergency import EmergencyMessage
    from drive_env.emulator.machine import Machines
    from drive_env.master.bus_drives import BusDrives
    from drive_env.safety.envelope import Envelope

CYCLE = 0.001  # s


class Observer:
    """An observer of drives; methods that it does not override do nothing.

    Attributes:
        objects: What it wants recorded, whenever time passes; with any, no time passes unseen.
        hides_machine: Whether who uses these drives is to see no emulated machine behind them.
    """

    objects: Sequence[ObjectName] = ()
    hides_machine = False

    def patience(self) -> int | None:
        """Return after how many cycles it wants to look, None for whenever a record is over."""
        return None

    def written(self, below: Drives, name: ObjectName, value: ArrayLike, where: Mask | None) -> None:
        """Take note of what was written."""

    def passes(self, duration: float) -> None:
        """Take note that time is about to pass [s]."""

    def passed(
        self,
        below: Drives,
        duration: float,
        trace: Trace,
        asked: Sequence[ObjectName],
        play: Mapping[ObjectName, ArrayLike] | None,
    ) -> None:
        """Look at what has passed.

        Args:
            below: The drives to act on.
            duration: How long [s].
            trace: What was recorded.
            asked: The objects that the caller wanted.
            play: What was played.
        """


class ObservedDrives:
    """Drives and who looks at them.

    Args:
        drives: The drives.
        observers: Who looks at them, one after the other.
    """

    def __init__(self, drives: Drives, *observers: Observer) -> None:
        self._drives = drives
        self._observers = observers

    @property
    def num_axes(self) -> int:
        """Number of axes."""
        return self._drives.num_axes

    @property
    def axis_numbers(self) -> Sequence[int]:
        """What each axis is called."""
        return self._drives.axis_numbers

    @property
    def device(self) -> Device | None:
        """What the drives are."""
        return self._drives.device

    @property
    def machine(self) -> Machines | None:
        """The emulated machines' side, unless somebody hides it."""
        return None if any(observer.hides_machine for observer in self._observers) else self._drives.machine

    @property
    def bus(self) -> BusDrives | None:
        """The same drives as those of a bus, unobserved."""
        return self._drives.bus

    @property
    def safety(self) -> Envelope | None:
        """What watches over drives that may be real."""
        return self._drives.safety

    @property
    def time_waits(self) -> bool:
        """Whether time stands still until it is asked to pass."""
        return self._drives.time_waits

    @property
    def observers(self) -> tuple[Observer, ...]:
        """Who looks at these drives, the innermost first."""
        return (*self._drives.observers, *self._observers)

    def read(self, name: ObjectName) -> Integers:
        """Return an object of every axis."""
        return self._drives.read(name)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object, and tell the observers."""
        self._drives.write(name, value, where=where)
        for observer in self._observers:
            observer.written(self._drives, name, value, where)

    def advance(self, duration: float) -> None:
        """Let time pass [s]."""
        if any(observer.objects for observer in self._observers):
            if duration > 0.0:
                self.record([], duration)
            return
        for observer in self._observers:
            observer.passes(duration)
        self._drives.advance(duration)

    def record(
        self,
        objects: ObjectName | Sequence[ObjectName],
        duration: float,
        play: Mapping[Any, ArrayLike] | None = None,
        period: float = CYCLE,
    ) -> Trace:
        """Let time pass while objects are recorded and played, and have observers look at it as it goes on."""
        asked: list[ObjectName] = [objects] if isinstance(objects, int | str | Role) else list(objects)
        wanted = list(asked)
        for observer in self._observers:
            observer.passes(duration)
            wanted += [name for name in observer.objects if name not in wanted]
        rows = {name: np.asarray(values) for name, values in (play or {}).items()}
        cycles, done, parts = round(duration / CYCLE), 0, []
        while done < cycles:
            patience = [cycles - done, *(n for n in (each.patience() for each in self._observers) if n is not None)]
            now = min(patience)
            part: Mapping[ObjectName, ArrayLike] | None = play
            if now < cycles:
                part = {name: values[done : done + now] for name, values in rows.items()} or None
            span = duration if now == cycles else now * CYCLE
            parts.append(self._drives.record(wanted, span, part, period))
            for observer in self._observers:
                observer.passed(self._drives, span, parts[-1], asked, part)
            done += now
        if not parts:
            return self._drives.record(asked, duration, play, period)
        return parts[0] if len(parts) == 1 else Trace.joined(parts, period)

    def emergencies(self) -> list[EmergencyMessage]:
        """Return what the drives have said by themselves since the last call."""
        return self._drives.emergencies()

    def reset_node(self, where: Mask | None = None) -> None:
        """Restart nodes, as after power-on."""
        self._drives.reset_node(where)

    def close(self) -> None:
        """Release what the drives hold."""
        self._drives.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._drives.__exit__(kind, error, traceback)
