"""Drives with observers: a wrapper whose observers count, monitor, act, or hide something."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.roles import Role
from drive_env.drives.drives_proxy import DrivesProxy
from drive_env.drives.interface import CYCLE, Drives, MachineSide, Observer
from drive_env.drives.trace import Trace
from mechanics.arrays import Mask

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName, ObjectNames, Rows


class ObservedDrives(DrivesProxy):
    """Drives with observers.

    Args:
        drives: The drives.
        observers: The observers, called one after the other.
    """

    def __init__(self, drives: Drives, *observers: Observer) -> None:
        super().__init__(drives)
        self._observers = observers

    @property
    def machine(self) -> MachineSide | None:
        """The emulated machines' side; None on a bus, or if an observer hides it."""
        return None if any(observer.hides_machine for observer in self._observers) else self._drives.machine

    @property
    def observers(self) -> tuple[Observer, ...]:
        """The observers of these drives, the innermost first."""
        return (*self._drives.observers, *self._observers)

    def write(self, name: ObjectName, value: ArrayLike, where: Mask | None = None) -> None:
        """Write an object, and notify the observers."""
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

    def record(self, objects: ObjectNames, duration: float, play: Rows = None, period: float = CYCLE) -> Trace:
        """Let time pass while objects are recorded and played, and call the observers meanwhile."""
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
            part: Rows = play
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
