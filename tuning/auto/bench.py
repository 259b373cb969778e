"""The data that all stages of auto share: the drives, their drive time, and a journal of each axis.

Only this bench changes during a run; the stages hand on immutable results (stages.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import read_gains
from mechanics.arrays import Floats, Integers, Mask
from tuning.certificate.certificate import TAKEN, Correction
from tuning.identify.wiring import write_wiring
from tuning.stop_causes import stop_causes

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.proving import ProvingGround
    from tuning.target import DriveTime, Target

# Drive time of the parts [s]: a frequency response of an axis; a trial with recovery; a recorded move; and a recorded
# move that begins where a response has ended.
RESPONSE_TIME, TRIAL_TIME, MOVE_TIME, PREVIOUS_GAINS_TIME = 2.3, 0.85, 0.8, 1.3

BY_TRIAL = "by a move, its reversal, and a move with 1.5 times velocity P"  # how gains are verified at least
WINDOW = 10  # following error that trips a trial, over its move: a slow loop lags by the whole move
REDESIGNED = "gains designed again from what was measured: "  # first words of the note on such gains


class Journal:
    """The remarks on one axis; they are only added, never removed.

    Attributes:
        reason: Why the axis was taken out of the run; "" while it takes part.
        reservations: Checks that were impossible or are close to a limit; with any of them the certificate says
            "accepted with reservations".
        notes: Further remarks.
        corrections: Replaced gains.
    """

    def __init__(self) -> None:
        self.reason = ""
        self.reservations: list[str] = []
        self.notes: list[str] = []
        self.corrections: list[Correction] = []

    def stop(self, reason: str) -> None:
        """Take the axis out of the run; the first reason stays."""
        self.reason = self.reason or reason

    def note(self, text: str) -> None:
        """Add a note."""
        self.notes.append(text)

    def reserve(self, text: str) -> None:
        """Add a reservation."""
        self.reservations.append(text)

    def correct(self, old: Integers, new: Integers, reason: str, outcome: str = TAKEN) -> None:
        """Record that gains, raw, shape (count,), were replaced; nothing if both are equal."""
        if not np.array_equal(old, new):
            self.corrections.append(Correction(tuple(map(int, old)), tuple(map(int, new)), reason, outcome))

    def undo(self, new: Integers, old: Integers, outcome: str) -> None:
        """Record why the last redesigned gains, raw, shape (count,), were taken back; nothing if both are equal."""
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
        target: The target to tune, with counted time.
        clock: Clock of the target's time.
        budget: Greatest drive time per axis of a machine [s].
        dynamics: Requirements on the loops.

    Attributes:
        journals: The remarks on each axis.
        before: Raw gains of the drives before the run, shape (num_axes, count).
        modes: 6060h before the run, shape (num_axes,).
        ground: Runs the trials; set by the stage "try".
        response_time: Drive time of a frequency response of all axes of a machine [s].
        spent: Drive time of each axis [s]: time passed while it took part. Waiting for other axes does not count.
    """

    ground: ProvingGround

    def __init__(self, target: Target, clock: DriveTime, budget: float, dynamics: Dynamics) -> None:
        drives = target.drives
        self.target = target
        self.dynamics = dynamics
        self.journals = tuple(Journal() for _ in range(target.num_axes))
        self.before: Integers = read_gains(drives)
        self.modes: Integers = drives.read(cia402.MODE)
        # Axes of one machine are excited one after the other.
        self.response_time = RESPONSE_TIME * target.axes_per_machine
        self.spent: Floats = np.zeros(target.num_axes)
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        # The budget is that of the whole machine: its axes are excited one after the other.
        self._clock, self._budget = clock, budget * target.axes_per_machine

    @property
    def going(self) -> Mask:
        """Axes of machines none of whose axes was taken out of the run, shape (num_axes,)."""
        return self.whole_machines(np.array([not journal.reason for journal in self.journals]))

    def whole_machines(self, where: Mask) -> Mask:
        """Return the axes of machines all of whose axes are chosen, shape (num_axes,)."""
        axes = self.target.axes_per_machine
        return np.asarray(np.repeat(where.reshape(-1, axes).all(axis=1), axes))

    def stop(self, where: Mask, reason: str) -> None:
        """Take axes out of the run; the first reason of an axis stays."""
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
        """Return the signed angles that the rotors may still turn [rad], down and up, each shape (num_axes,)."""
        return self.target.travel_left(self._origin)

    def wire(self, values: Sequence[Mapping[Key, int]]) -> None:
        """Write the wiring settings of every axis, and convert travel and origin to the positions that they give."""
        self.target, self._origin = write_wiring(self.target, self._origin, values)

    def affordable(self, seconds: float | Floats) -> Mask:
        """Return which axes have this much drive time left, shape (num_axes,)."""
        return np.asarray(self.spent + seconds <= self._budget)

    @contextmanager
    def spending(self, where: Mask) -> Iterator[None]:
        """Count the time of the block as drive time of some axes."""
        before = self._clock.seconds
        try:
            yield
        finally:
            self.spent[where] += self._clock.seconds - before

    def faults(self) -> dict[int, str]:
        """Return axes in the run that went into fault, by number, with their faults as text."""
        drives = self.target.drives
        faulted = self.going & cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
        causes = stop_causes(drives)
        return {axis: causes[axis] for axis in map(int, np.flatnonzero(faulted))}

    def watch_following(self, where: Mask) -> None:
        """Set a following error window that no normal trial exceeds."""
        drives = self.target.drives
        window = WINDOW * np.abs(self.ground.move.distance) + drives.read(Role.POSITION_SCALE)
        drives.write(cia402.FOLLOWING_WINDOW, window, where=where)

    def recover(self, where: Mask) -> None:
        """Reset faults of axes, and hold them with stable gains."""
        with self.spending(self.target.together(where)):
            self.ground.recover(where)

    def recover_faults(self, faults: Mapping[int, str], meanwhile: str) -> None:
        """Reset faults of axes; take an axis out of the run, with the reason, if its fault cannot be reset."""
        if faults:
            self.recover(np.isin(np.arange(self.target.num_axes), list(faults)))
            self.drop_faults(f"{meanwhile}, and the fault cannot be reset")

    def drop_faults(self, meanwhile: str) -> None:
        """Take axes in fault out of the run, with the reason."""
        for axis, causes in self.faults().items():
            self.journals[axis].stop(f"the drive went into fault while {meanwhile}: {causes}")
