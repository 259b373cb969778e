"""What the stages of auto share: the axes that are tuned, the state of each, and the drive time used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.gains import read_gains
from drive_env.trials.positioning import wrapped
from tuning.auto.result import AxisRun, Result
from tuning.auto.trial_order import OTHERS
from tuning.identify.wiring import Key, write_wiring
from tuning.stop_causes import UNTOLD, stop_causes

if TYPE_CHECKING:
    from tuning.auto.proving import ProvingGround, Shown
    from tuning.certificate.certificate import StepResponse
    from tuning.response.measured_loop import MeasuredLoop
    from tuning.target import DriveTime, Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Drive time of the parts [s]: a frequency response of an axis; a trial, with what recovery takes; a move for the
# record; and one from where a response has ended.
RESPONSE_TIME, TRIAL_TIME, MOVE_TIME, LOOK_BACK_TIME = 2.3, 0.85, 0.8, 1.3


class AutoRun:
    """One run of auto; each stage takes out the axes that fail in it.

    Args:
        target: What is tuned; its time is counted.
        seed: Of the search on twins.
        clock: That counts the target's time.
        budget: Most time that may pass on the drives [s].

    Attributes:
        axes: What became of every axis.
        before: Raw gains of the drives before the run, (num_axes, count).
        gains: The best so far, likewise.
        others: Other gains that were found, (2, num_axes, count): the best for the axis exactly as identified, and for
            less friction.
        spare: The second best that passed a trial, likewise; zeros where none did.
        reference: Those of the baseline rule, likewise.
        fallbacks: What is tried when the twin's gains fail, (3, num_axes, count): the baseline rule's; those before, or
            the soft rule's; and those that are slow enough for any load, with which what is stopped goes on.
        modes: 6060h as the drives came, (num_axes,).
        unsafe: Why an axis must not be moved with the gains before, "" where it may.
        fresh: Axes that came fresh from the factory, (num_axes,).
        ground: Where gains are tried, None before.
        shown, earlier, response, loaded: As in `Result`.
        unseen: Axes without a usable frequency response, (num_axes,).
        response_time: Drive time of a frequency response of all axes of a machine [s].
        spent: Of each axis, what passed while it took part [s]: axes that are through wait for others at no cost of
            their own.
    """

    def __init__(self, target: Target, seed: int, clock: DriveTime, budget: float) -> None:
        drives, n = target.drives, target.num_axes
        self.target = target
        self.rng = np.random.default_rng(seed)
        self.before: Integers = read_gains(drives)
        self.axes = [AxisRun(tuple(map(int, row)), tuple(map(int, row))) for row in self.before]
        shape = n, target.device.gains.count
        self.gains, self.reference = (np.ones(shape, np.int64) for _ in range(2))
        self.others = np.ones((len(OTHERS), *shape), np.int64)
        self.spare: Integers = np.zeros_like(self.gains)
        self.fallbacks = np.ones((3, *shape), np.int64)
        self.unsafe = ["not checked"] * n
        self.modes: Integers = drives.read(cia402.MODE)
        self.fresh: Mask = np.zeros(n, bool)
        self.ground: ProvingGround | None = None
        self.shown: Shown | None = None
        self.earlier: Shown | None = None
        self.response: MeasuredLoop | None = None
        self.unseen: Mask = np.zeros(n, bool)
        self.loaded: dict[int, StepResponse] = {}
        # Axes of one machine are shaken one after the other.
        self.response_time = RESPONSE_TIME * target.axes_per_machine
        self.spent: Floats = np.zeros(n)
        self._origin = drives.read(cia402.POSITION_ACTUAL)
        # What one axis has, its machine's others have too: they are shaken one after the other.
        self._clock, self._budget = clock, budget * target.axes_per_machine

    @property
    def going(self) -> Mask:
        """Which axes nothing has stopped, nor another axis of their machine, (num_axes,)."""
        alone = np.array([axis.accepted for axis in self.axes])
        return self.whole_machines(alone)

    def whole_machines(self, where: Mask) -> Mask:
        """Return the axes of machines all of whose axes are chosen, (num_axes,)."""
        axes = self.target.axes_per_machine
        return np.asarray(np.repeat(where.reshape(-1, axes).all(axis=1), axes))

    def stop(self, where: Mask, reason: str) -> None:
        """Take axes out of the run; the first reason of an axis counts."""
        for axis in np.flatnonzero(where):
            self.axes[axis].reason = self.axes[axis].reason or reason

    def note(self, where: Mask, text: str) -> None:
        """Add a note to axes."""
        for axis in np.flatnonzero(where):
            self.axes[axis].notes.append(text)

    def reserve(self, where: Mask, text: str) -> None:
        """Add a reservation to axes."""
        for axis in np.flatnonzero(where):
            self.axes[axis].reservations.append(text)

    def room(self) -> tuple[Floats, Floats]:
        """Return how far the rotors may turn from where they are now [rad], down and up, each (num_axes,)."""
        target = self.target
        here = wrapped(target.drives.read(cia402.POSITION_ACTUAL) - self._origin) / target.increments()
        return np.minimum(target.low - here, 0.0), np.maximum(target.high - here, 0.0)

    def wire(self, values: Sequence[Mapping[Key, int]]) -> None:
        """Write the settings that wirings need, of every axis; travel and origin become those that are counted then."""
        self.target, self._origin = write_wiring(self.target, self._origin, values)

    @property
    def look_back_time(self) -> Floats:
        """The time that a move with the gains before takes [s], 0 where none is made, (num_axes,)."""
        safe = self.whole_machines(np.array([not why for why in self.unsafe]))
        return np.where(safe, LOOK_BACK_TIME, 0.0)

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
        if self.ground is not None:  # which has read those of its last trial
            both = zip(causes, self.ground.causes, strict=True)
            causes = [before if cause == UNTOLD else cause for cause, before in both]
        return {axis: causes[axis] for axis in map(int, np.flatnonzero(faulted))}

    def drop_faults(self, meanwhile: str) -> None:
        """Take axes that went into fault out of the run, with the reason."""
        for axis, causes in self.faults().items():
            self.axes[axis].reason = f"the drive went into fault while {meanwhile}: {causes}"

    def result(self, file: Path, kept: bool) -> Result:
        """Return the result."""
        ground, zero = self.ground, np.zeros(self.target.num_axes, np.int64)
        counts = (zero, zero, zero) if ground is None else (ground.moves, ground.aborts, ground.violations)
        return Result(
            tuple(self.axes), self.spent, *counts, self.shown, self.earlier, self.response, self.loaded, file, kept
        )
