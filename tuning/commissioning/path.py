"""The path of a commissioning: its steps in order, the state of each, going back, and the state before.

The state before is saved to a file before the first step. An error of the bus, a stop, or the end of the path restores
it unless the parameters were stored. If a step fails, its writes are undone, and it can be repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from drive_env import cia402, motion
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.safety.envelope import SafetyError
from mechanics.arrays import Integers
from tuning.commissioning.bench import CommissioningBench, CommissioningPlan
from tuning.commissioning.steps import STEPS, Say
from tuning.identify.wiring import findings
from tuning.snapshot import Snapshot, Transaction, check_place, switch_off, take, undisturbed

if TYPE_CHECKING:
    from tuning.target import Target

PENDING, RUNNING, DONE, FAILED, SKIPPED = "pending", "running", "done", "failed", "skipped"
LAST = "store"  # the step after which nothing is undone
REST, PIECE = 3.0, 0.02  # s that axes get to come to rest, and between two checks of it
BEFORE = "before.toml"


@dataclass(frozen=True)
class StepState:
    """The state of a step, and its result: lines for the user, or one line with the reason of a failure or a skip."""

    state: str = PENDING
    lines: tuple[str, ...] = ()


def check_off(target: Target) -> None:
    """Raise RuntimeError if an axis is enabled: a commissioning begins with all axes switched off."""
    live = np.flatnonzero([cia402.is_live(int(word)) for word in target.drives.read(cia402.STATUSWORD)])
    if live.size:
        number = target.axis_numbers[int(live[0])]
        raise RuntimeError(f"axis {number} is enabled, perhaps by another program; a commissioning begins with it off")


class CommissioningPath:
    """A commissioning; entering saves the state before, leaving restores it unless the parameters were stored.

    Args:
        target: The drives, all of them switched off; its travel counts from the present angles of the rotors.
        plan: The user's plan; it may change between steps.
        folder: New or empty folder for the state before and the certificate.

    Attributes:
        states: State of every step, by name.
    """

    def __init__(self, target: Target, plan: CommissioningPlan, folder: Path) -> None:
        self.bench = CommissioningBench(target, plan, folder)
        self.states = dict.fromkeys(STEPS, StepState())
        for name, step in STEPS.items():
            if why := step.unfit(target):
                self.states[name] = StepState(SKIPPED, (why,))
        check_place(folder / BEFORE)
        self._transaction = Transaction(target, folder / BEFORE)
        self._modes: Integers = target.drives.read(cia402.MODE)
        self._earlier: dict[str, Snapshot] = {}

    @property
    def file(self) -> Path:
        """The file with the state before."""
        return self._transaction.path

    @property
    def is_kept(self) -> bool:
        """Whether the parameters stay for good: they are no longer rolled back."""
        return self.bench.is_kept

    @property
    def next(self) -> str | None:
        """The step that comes next, None after the last one."""
        return next((name for name, one in self.states.items() if one.state in (PENDING, FAILED)), None)

    def __enter__(self) -> Self:
        check_off(self.bench.target)
        self._transaction.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self.is_kept:
            self._transaction.__exit__(None, None, None)
            return
        with undisturbed(), self._counting_as(self._transaction.before):
            self._transaction.__exit__(kind, error, traceback)

    def run(self, name: str, say: Say) -> StepState:
        """Run a step; afterwards its state is done or failed.

        Raises:
            BusError: If the drives can no longer be reached; the path must be left then.
            ValueError: For a step that is done.
        """
        step, bench = STEPS[name], self.bench
        if self.states[name].state == DONE:
            raise ValueError(f"{step.title} is done; go back to it to do it again")
        try:
            check_off(bench.target)
        except RuntimeError as error:
            self.states[name] = StepState(FAILED, (str(error),))
            return self.states[name]
        self.states[name] = StepState(RUNNING)
        self._earlier[name] = take(bench.target)
        try:
            with bench.held():
                lines = step.run(bench, say)
        except (RuntimeError, TimeoutError, ValueError, ObjectAccessError) as error:
            self._return_to(self._earlier[name])
            self.states[name] = StepState(FAILED, (str(error),))
            return self.states[name]
        except BaseException:
            self.states[name] = StepState(FAILED, ("stopped",))
            raise
        if name == LAST:
            self._transaction.commit()
            self.bench.is_kept = True
        self.states[name] = StepState(DONE, tuple(lines))
        return self.states[name]

    def skip(self, name: str, why: str = "left out") -> None:
        """Skip a step; skipping tuning or storing also skips the certificate, which needs both."""
        self.states[name] = StepState(SKIPPED, (why,))
        if name in ("tune", LAST):
            self.states["certificate"] = StepState(SKIPPED, (f"{STEPS[name].title} was left out",))

    def back_to(self, name: str) -> None:
        """Go back to a step: restore the parameters from before it, and mark it and all later steps as pending.

        Raises:
            ValueError: If the parameters are already stored.
        """
        if self.is_kept:
            raise ValueError(f"the parameters are kept; drive-tune undo {self.file} restores the state before")
        names = list(STEPS)
        later = names[names.index(name) :]
        first = next((self._earlier[one] for one in later if one in self._earlier), None)
        if first is not None:
            self._return_to(first)
        for one in later:
            self._earlier.pop(one, None)
            if not STEPS[one].unfit(self.bench.target):
                self.states[one] = StepState()
        if "tune" in later:
            self.bench.result = None

    def _return_to(self, earlier: Snapshot) -> None:
        """Bring the axes to rest, switch them off, and restore earlier parameters."""
        with undisturbed(), self._counting_as(earlier):
            self._transaction.roll_back(to=earlier)

    @contextmanager
    def _counting_as(self, earlier: Snapshot) -> Iterator[None]:
        """Bring axes to rest, switch them off and restore their counting, for a block that restores parameters."""
        bench = self.bench
        self._come_to_rest()
        with bench.counting_anew():
            keys = findings(bench.target.device)
            bench.wire([{key: one[key] for key in keys if key in one} for one in earlier.axes] if keys else [])
            yield
        other = (self._modes != 0) & (bench.target.drives.read(cia402.MODE) != self._modes)
        if other.any():  # 0, no mode, is the value before the first mode; it cannot be written
            bench.target.drives.write(cia402.MODE, self._modes, where=other)

    def _come_to_rest(self) -> None:
        drives = self.bench.target.drives
        with suppress(SafetyError):  # after a stop by the envelope the first call reports it
            drives.read(cia402.STATUSWORD)
        on = np.asarray(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED))
        if on.any():
            motion.quick_stop(drives, where=on)
            for _ in range(round(REST / PIECE)):
                if not motion.is_turning(drives, on, PIECE):
                    break
        switch_off(drives, np.ones(drives.num_axes, bool))
