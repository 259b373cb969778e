"""The state of the page Tune in a session: gains and their history, recordings, the present run of a tuner."""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drive_env.drives.interface import Drives, device_of
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.studio.runs_folder import RUNS
from mechanics.arrays import Floats, Integers
from tuning.runs.provenance import run_folder
from tuning.snapshot import Snapshot, check_place, load_snapshot, take_of
from tuning.target import Target, address_of, hold_to_travel, of_bus, of_machines

if TYPE_CHECKING:
    from drive_env.studio.session import Session
    from tuning.auto.soft_to_stiff import SoftToStiff
    from tuning.compare.side_by_side import AxisRules
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import MeasuredLoop


LAST = 5  # step responses shown below the present one
MOST_STEPS = 1000  # changes of gains that can be undone one by one


@dataclass(frozen=True)
class GainChange:
    """A change of an axis' gains that can be undone: raw integers before and after, and its name."""

    axis: int
    before: tuple[int, ...]
    after: tuple[int, ...]
    what: str


@dataclass(frozen=True, eq=False)
class StepRecording:
    """A step recorded with the gains at that time.

    Attributes:
        axis: Number of the axis.
        kind: "velocity" or "position".
        gains: Raw gains of the axis; empty for rejected ones.
        unit: Unit of demand and actual.
        t: Times [s], shape (n,).
        demand, actual: Set-point and actual value, shape (n,).
        current: Actual current [A], shape (n,).
        figures: Rise time, overshoot, settling time as text.
        source: Tuner that made the move; "" for a step requested on a page.
        at: Time of the recording [s since 1970].
    """

    axis: int
    kind: str
    gains: tuple[int, ...]
    unit: str
    t: Floats
    demand: Floats
    actual: Floats
    current: Floats
    figures: str
    source: str = ""
    at: float = field(default_factory=time.time)

    @property
    def name(self) -> str:
        """Time of day and gains, as a unique name."""
        gains = ", ".join(map(str, self.gains)) or "rejected gains"
        source = f"{self.source}: " if self.source else ""
        return f"{time.strftime('%H:%M:%S', time.localtime(self.at))}  {source}{gains}"


def reference_of(steps: Sequence[StepRecording]) -> StepRecording | None:
    """Return the newest step with other gains than the first; None without one. Steps must be sorted, newest first."""
    return next((step for step in steps if step.gains != steps[0].gains), None)


@dataclass(frozen=True)
class AxisVerdict:
    """The verdict of a run on an axis, for display."""

    axis: int
    verdict: str
    reason: str
    reservations: tuple[str, ...]
    notes: tuple[str, ...]
    before: tuple[int, ...]
    after: tuple[int, ...]


@dataclass
class TunerSession:
    """A running or finished run of a tuner.

    Attributes:
        title: Name of the tuner.
        folder: Folder of its files.
        lines: Its messages in order.
        columns: Titles of the table of trials.
        trials: Rows of this table so far.
        share: Share that is done.
        is_over: Whether it has ended.
        verdicts: Verdicts of the axes after a complete run.
        failure: Why it did not complete; "" otherwise.
    """

    title: str
    folder: Path
    lines: list[str] = field(default_factory=list)
    columns: tuple[str, ...] = ()
    trials: list[tuple[str, ...]] = field(default_factory=list)
    share: float = 0.0
    is_over: bool = False
    verdicts: tuple[AxisVerdict, ...] = ()
    failure: str = ""


@dataclass
class MachineEntries:
    """A user's entries about the machine: motor, travel, supply, and coupling of the axes."""

    motor: str = ""
    travel: str = ""
    supply: float | None = None
    axes: str = "apart"


class TuneDesk:
    """The state that the pages of one session share.

    Args:
        session: The drives.

    Attributes:
        entries: The user's entries about the machine.
        gains: Raw gains of every axis, last read or written, shape (num_axes, count); None before.
        changes: Changes of gains, the newest last.
        before: The parameters before the first change by this page; None before that.
        before_file: The file of these.
        version: Increases whenever displayed data change.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.entries = MachineEntries()
        self.gains: Integers | None = None
        self.changes: list[GainChange] = []
        self.before: Snapshot | None = None
        self.before_file: Path | None = None
        self.steps: deque[StepRecording] = deque(maxlen=10 * (LAST + 1))
        self.responses: dict[tuple[str, int], MeasuredLoop] = {}
        self.soft_to_stiff: dict[int, SoftToStiff | str] = {}  # by axis, or the reason for missing gains
        self.identified: list[Identification] = []
        self.rules: list[AxisRules] = []
        self.run: TunerSession | None = None
        self.version = 0
        self._lock = threading.Lock()

    @property
    def is_emulated(self) -> bool:
        """Whether the drives are emulated."""
        return self.session.is_emulated

    def touch(self) -> None:
        """Increase the version: displayed data have changed."""
        with self._lock:
            self.version += 1

    def last_steps(self, axis: int, kind: str) -> list[StepRecording]:
        """Return the present step of an axis and five before it, newest first, with the reference in second place.

        The reference is the newest step with other gains than the present one.
        """
        mine = [step for step in reversed(self.steps) if (step.axis, step.kind) == (axis, kind)]
        reference = reference_of(mine)
        if reference is not None:
            mine.remove(reference)
            mine.insert(1, reference)
        return mine[: LAST + 1]

    def note(self, axis: int, before: Sequence[int], after: Sequence[int], what: str) -> None:
        """Add a change to the history, unless the gains are equal."""
        old, new = tuple(map(int, before)), tuple(map(int, after))
        if old != new:
            self.changes.append(GainChange(axis, old, new, what))
            del self.changes[:-MOST_STEPS]
        self.touch()

    def last_change(self, axis: int) -> GainChange | None:
        """Return the newest change of an axis; None without one."""
        return next((change for change in reversed(self.changes) if change.axis == axis), None)

    # --- for jobs, in the thread of the drives ----------------------------------------------------------------------
    def address(self) -> Mapping[str, Any]:
        """Return the options that open the drives of the bus again; empty for emulated ones."""
        if self.is_emulated:
            return {}
        from drive_env.master.open_drives import default_nodes

        given = dict(self.session.address)
        interface = given.pop("interface", None)
        nodes = tuple(given.pop("nodes", None) or default_nodes(interface))
        return address_of(interface, given.pop("channel", None), nodes, given)

    def keep_before(self, drives: Drives) -> Snapshot:
        """Return the parameters before the first change; the first call reads them and saves them to a file."""
        if self.before is None or self.before_file is None:
            file = run_folder("studio", RUNS) / "before.toml"
            check_place(file)
            taken = take_of(drives, self.address())
            taken.save(file)
            self.before, self.before_file = load_snapshot(file), file
            self.touch()
        return self.before

    @contextmanager
    def target(self, drives: Drives) -> Iterator[Target]:
        """Yield the drives as a target; on a bus the envelope limits them to their travel during the block.

        Raises:
            ValueError: For an invalid motor, travel or coupling.
        """
        from tuning.commands.options import parse_travels

        entries, machine = self.entries, drives.machine
        ways = parse_travels(entries.travel) if entries.travel.strip() else None
        if machine is not None:
            yield of_machines(drives, emulated_of(drives), supply=entries.supply, travel=ways)
            return
        from drive_env.motors import find_motor

        if ways is None:
            raise ValueError("the travel is missing: give how far the motor may turn, LOW:HIGH in turns, or free")
        motor = find_motor(entries.motor or device_of(drives).default_motor)
        target = of_bus(drives, motor, self.address(), supply=entries.supply, travel=ways, axes=entries.axes)
        envelope = drives.safety
        limits = None if envelope is None else envelope.limits
        hold_to_travel(target)
        try:
            yield target
        finally:
            if envelope is not None and limits is not None:
                envelope.change(limits)


_desks: weakref.WeakKeyDictionary[Session, TuneDesk] = weakref.WeakKeyDictionary()


def desk_of(session: Session) -> TuneDesk:
    """Return the desk of a session, the same for all its pages."""
    if session not in _desks:
        _desks[session] = TuneDesk(session)
    return _desks[session]
