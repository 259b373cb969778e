"""What all stages of auto work on: the drives, their drive time, and a journal of each axis.

It is all of a run that changes; what a stage finds it hands on to the next (stages.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.drives.raw_gains import read_gains
from mechanics.arrays import Floats, Integers, Mask
from tuning.certificate.certificate import TAKEN, Correction
from tuning.identify.wiring import write_wiring
from tuning.stop_causes import stop_causes

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.proving import ProvingGround
    from tuning.target import DriveTime, Target

# Drive time of the parts [s]: a frequency response of an axis; a trial, with what recovery takes; a move for the
# record; and one from where a response has ended.
RESPONSE_TIME, TRIAL_TIME, MOVE_TIME, LOOK_BACK_TIME = 2.3, 0.85, 0.8, 1.3

REDESIGNED = "gains designed again from what was measured: "  # how the note on them begins


class Journal:
    """The remarks about one axis; none is taken back.

    Attributes:
        reason: Why it stopped; "" while it goes on.
        reservations: Checks that could not be made or are near a limit; with any of them the certificate is not a plain
            accept.
        notes: Further remarks.
        corrections: Gains that gave way to others.
    """

    def __init__(self) -> None:
        self.reason = ""
        self.reservations: list[str] = []
        self.notes: list[str] = []
        self.corrections: list[Correction] = []

    def stop(self, reason: str) -> None:
        """Take the axis out of the run; its first reason counts."""
        self.reason = self.reason or reason

    def note(self, text: str) -> None:
        """Add a note."""
        self.notes.append(text)

    def reserve(self, text: str) -> None:
        """Add a reservation."""
        self.reservations.append(text)

    def correct(self, old: Integers, new: Integers, reason: str, outcome: str = TAKEN) -> None:
        """Add that gains, raw, (count,), gave way to others, unless they are the same."""
        if not np.array_equal(old, new):
            self.corrections.append(Correction(tuple(map(int, old)), tuple(map(int, new)), reason, outcome))

    def undo(self, new: Integers, old: Integers, outcome: str) -> None:
        """Say why gains designed again last, raw, (count,), gave way to others, unless they are the same."""
        last = self.corrections[-1] if self.corrections else None
        if last is None or last.outcome != TAKEN or np.array_equal(new, old):
            return
        self.corrections[-1] = replace(last, outcome=outcome)
        for k in reversed(range(len(self.notes))):
            if self.notes[k] == f"{REDESIGNED}{last.reason}":
                self.notes[k] += f"; {outcome}"
                break


class AutoBench:
    """The drives of one run of auto; each stage takes out the axes that fail in it.

    Args:
        target: What is tuned; its time is counted.
        clock: That counts the target's time.
        budget: Most time that may pass on the drives [s].
        dynamics: What the loops must keep.

    Attributes:
        journals: The remarks about each axis.
        before: Raw gains of the drives before the run, (num_axes, count).
        modes: 6060h as the drives came, (num_axes,).
        ground: Where gains are tried; there is none before.
        response_time: Drive time of a frequency response of all axes of a machine [s].
        spent: Of each axis, what passed while it took part [s]: axes that are through wait for others at no cost of
            their own.
    """

    ground: ProvingGround

    def __init__(self, target: Target, clock: DriveTime, budget: float, dynamics: Dynamics) -> None:
        drives = target.drives
        self.target = target
        self.dynamics = dynamics
        self.journals = tuple(Journal() for _ in range(target.num_axes))
        self.before: Integers = read_gains(drives)
        self.modes: Integers = drives.read(cia402.MODE)
        # Axes of one machine are shaken one after the other.
        self.response_time = RESPONSE_TIME * target.axes_per_machine
        self.spent: Floats = np.zeros(target.num_axes)
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        # What one axis has, its machine's others have too: they are shaken one after the other.
        self._clock, self._budget = clock, budget * target.axes_per_machine

    @property
    def going(self) -> Mask:
        """Which axes nothing has stopped, nor another axis of their machine, (num_axes,)."""
        return self.whole_machines(np.array([not journal.reason for journal in self.journals]))

    def whole_machines(self, where: Mask) -> Mask:
        """Return the axes of machines all of whose axes are chosen, (num_axes,)."""
        axes = self.target.axes_per_machine
        return np.asarray(np.repeat(where.reshape(-1, axes).all(axis=1), axes))

    def stop(self, where: Mask, reason: str) -> None:
        """Take axes out of the run; the first reason of an axis counts."""
        for axis in np.flatnonzero(where):
            self.journals[axis].stop(reason)

    def note(self, where: Mask, text: str) -> None:
        """Add a note to axes."""
        for axis in np.flatnonzero(where):
            self.journals[axis].note(text)

    def reserve(self, where: Mask, text: str) -> None:
        """Add a reservation to axes."""
        for axis in np.flatnonzero(where):
            self.journals[axis].reserve(text)

    def room(self) -> tuple[Floats, Floats]:
        """Return how far the rotors may turn from where they are now [rad], down and up, each (num_axes,)."""
        return self.target.travel_left(self._origin)

    def wire(self, values: Sequence[Mapping[Key, int]]) -> None:
        """Write the settings that wirings need, of every axis; travel and origin become those that are counted then."""
        self.target, self._origin = write_wiring(self.target, self._origin, values)

    def affordable(self, seconds: float | Floats) -> Mask:
        """Return which axes have this much drive time left, (num_axes,)."""
        return np.asarray(self.spent + seconds <= self._budget)

    @contextmanager
    def spending(self, where: Mask) -> Iterator[None]:
        """Count the time that passes as drive time of some axes."""
        before = self._clock.seconds
        try:
            yield
        finally:
            self.spent[where] += self._clock.seconds - before

    def faults(self) -> dict[int, str]:
        """Return the axes that went into fault while they took part, and which faults."""
        drives = self.target.drives
        faulted = self.going & cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
        causes = stop_causes(drives)
        return {axis: causes[axis] for axis in map(int, np.flatnonzero(faulted))}

    def recover(self, where: Mask) -> None:
        """Reset faults of axes, and hold them with gains known to be stable."""
        with self.spending(self.target.together(where)):
            self.ground.recover(where)

    def recover_faults(self, faults: Mapping[int, str], meanwhile: str) -> None:
        """Reset faults of axes; one that stays in its fault is taken out of the run, with the reason."""
        if faults:
            self.recover(np.isin(np.arange(self.target.num_axes), list(faults)))
            self.drop_faults(f"{meanwhile}, and the fault cannot be reset")

    def drop_faults(self, meanwhile: str) -> None:
        """Take axes that went into fault out of the run, with the reason."""
        for axis, causes in self.faults().items():
            self.journals[axis].stop(f"the drive went into fault while {meanwhile}: {causes}")
