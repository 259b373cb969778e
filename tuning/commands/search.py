"""`drive-tune auto --by tpe`, or another sampler: search gains by trials, on emulated machines or on a bus."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drive_env.commands.tables import Column, print_lines, print_table
from tuning.commands.methods import SEARCH_FILES
from tuning.commands.options import (
    INTERRUPTED,
    check_machines,
    check_seed,
    fail,
    print_json,
    progress_bar,
    what_an_interrupt_leaves,
)

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives
    from tuning.auto.bench import AutoBench
    from tuning.auto.one_button import Method, Progress
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.commands.methods import MethodOptions
    from tuning.commands.options import TargetOptions
    from tuning.search.optimise import Optimised, Settings
    from tuning.target import Target

MOST_SEARCHES = 10_000
COPIES, TRIALS = 8, 30  # defaults
OUTER_LOOPS, MARGINS = ("velocity", "position"), ("phase_deg", "gain_db", "ms")  # axes of `Optimised.margins`


@dataclass
class SearchRun:
    """A search of gains by trials, from its options to its files.

    Attributes:
        given: The drives' options as typed: the state before names the device for a later undo.
        drive: The same, with the content of the user's files.
        options: Options of the method.
        settings: Settings of the search.
        folder: Folder for its files.
        done: The result; None until the search is done.
        machine: The searched machine for settings.toml; complete when the drives of a bus are open.
    """

    given: TargetOptions
    drive: TargetOptions
    options: MethodOptions
    settings: Settings
    folder: Path
    done: Optimised | None
    machine: dict[str, Any]

    @property
    def found(self) -> Optimised:
        """The result; the search must be done."""
        assert self.done is not None, "it was searched on the bus, or on copies before"
        return self.done

    @property
    def is_certified(self) -> bool:
        """Whether auto can verify the gains: it needs a linear model of the loops, which steppers do not have."""
        return self.settings.dynamics is not None

    @property
    def copies(self) -> int:
        """Number of emulated machines that try a generation of gains at the same time."""
        return COPIES if self.drive.machines is None else self.drive.machines

    def on_machine(self) -> None:
        """Run all searches on an emulated machine, and join their results."""
        self.done = self._search_machine()

    @contextmanager
    def telling_what_is_lost(self) -> Iterator[None]:
        """On Ctrl-C, exit with a message on whether the trials are kept."""
        try:
            yield
        except KeyboardInterrupt:
            lost = "interrupted; the trials made so far are lost: on a bus they are kept only with --journal FILE"
            told = lost if self.drive.bus else what_an_interrupt_leaves(self.folder)
            fail(told if self.settings.journal is None else _kept_in(self.settings.journal), INTERRUPTED)

    def on_bus(self, target: Target, folder: Path, show: Any) -> None:
        """Search on the drives of a bus, leave the best gains in them, and write the files."""
        from tuning.search.optimise import optimise

        bus = {"nodes": self.drive.nodes or [1], "bitrate": self.drive.bitrate, "lockstep": self.drive.lockstep}
        self.machine |= bus | {key: value for key, value in target.bus.items() if key != "axes"}
        journal = self.settings.journal
        try:
            self.done = optimise(target, self.settings, progress=show)
        except OSError as error:
            if error.errno is None or journal is None:  # an error of a drive, or one that names its file
                raise
            raise OSError(error.errno, error.strerror, str(journal)) from error
        self.save(folder)

    def alone(self, json: bool) -> None:
        """Search gains of drives that auto cannot certify; write and print the result."""
        from tuning.auto_to_files import BEFORE
        from tuning.runs import provenance, unfinished
        from tuning.snapshot import Transaction
        from tuning.way_back import way_back

        if not self.drive.bus:
            with unfinished.telling_what_is_kept(self.folder), self.telling_what_is_lost():
                self.on_machine()
                with provenance.new_folder(self.folder) as folder:
                    self.save(folder)
            self.report(None, json=json)
            unfinished.discard(self.folder)
            return
        before = self.folder / BEFORE
        with (
            self.telling_what_is_lost(), way_back(before, "drive-tune"), self.given.open() as target,
            Transaction(target, before) as transaction, progress_bar(self.plan) as show, left_to_trials(target.drives),
        ):  # fmt: skip
            self.on_bus(target, self.folder, show)
            transaction.commit()
        self.report(before, json=json)

    def method(self, folder: Path) -> Method:
        """Return the method for a run of auto: search on the drives of a bus, or use the emulated machine's result.

        Args:
            folder: Folder for the files of the search.
        """
        from tuning.auto.one_button import Method

        return Method(f"search by {self.settings.sampler}", partial(self._find, folder), math.inf, improves=False)

    def _find(self, folder: Path, bench: AutoBench, basis: Basis, say: Progress) -> RecordedGains:
        import numpy as np

        from tuning.auto.correction import try_gains
        from tuning.auto.stages import RecordedGains

        target, every = bench.target, np.ones(bench.target.num_axes, bool)
        if not bench.going.all():
            bench.stop(bench.going, "another axis was rejected, and a search tunes all of them or none")
            return RecordedGains.only(basis.before)
        if self.done is None:
            low, high = bench.room()
            with bench.spending(every), left_to_trials(target.drives):
                self.on_bus(
                    replace(target, low=low, high=high), folder, lambda share: say(self.plan, 0.3 + 0.35 * share)
                )
        else:
            self.save(folder)
        gains, cost, notes = self._answer(target.axes_per_machine)
        for k, journal in enumerate(bench.journals):
            if math.isnan(cost[k]):
                journal.stop(notes[k] or "the search found no gains")
            elif notes[k]:
                journal.note(notes[k])
        if not bench.going.any():
            return RecordedGains.only(basis.before)
        return try_gains(bench, basis, gains, np.full(target.num_axes, np.nan))

    def _answer(self, lanes: int) -> tuple[Any, list[float], list[str]]:
        """Return gains, cost and note of every axis; of several searches on an emulated machine those of the best."""
        found = self.found
        machines = range(len(found.gains) // lanes)
        if not self.drive.bus:
            accepted = [row for row in found.rows if row.accepted]
            machines = range(best := min(accepted, key=lambda row: row.robust_cost).search if accepted else 0, best + 1)
        axes = [machine * lanes + lane for machine in machines for lane in range(lanes)]
        every = [axis // lanes for axis in axes]
        return found.gains[axes], [float(found.cost[k]) for k in every], [found.notes[k] for k in every]

    @property
    def plan(self) -> str:
        """Description of the search in a few words."""
        count = self.options.searches
        return f"{self.settings.trials} trials by {self.settings.sampler}" + (f", {count} times" if count > 1 else "")

    def save(self, folder: Path) -> None:
        """Write trials.csv, trials.png and settings.toml into an existing folder."""
        from tuning.runs import provenance
        from tuning.search.trials_files import save

        save(self.found, self.settings, folder, self.machine, provenance.versions())

    def as_dict(self, before: Path | None) -> dict[str, Any]:
        """Return the result for JSON; `before` is the file with the state before, None for emulated drives."""
        from dataclasses import asdict

        from tuning.runs.inputs import as_kept

        found = self.found
        return {
            "gains": found.gains.tolist(), "rule": found.rule.tolist(), "cost": found.cost.tolist(),
            "margins": [_as_dicts(axis) for axis in found.margins.tolist()], "untried": found.untried,
            "drive_seconds": found.drive_seconds, "aborts": int(found.aborts.sum()), "notes": list(found.notes),
            "settings": asdict(self.settings), "machine": as_kept(self.machine), "folder": str(self.folder),
            "before": str(before) if before else None,
        }  # fmt: skip

    def report(self, before: Path | None, *, json: bool) -> None:
        """Print the result of a search without certificate; arguments as in `as_dict`."""
        if json:
            print_json(self.as_dict(before))
            return
        self.print(before)
        written = [f"written to {self.folder}: {', '.join(SEARCH_FILES)}"]
        if before is not None:
            written.append(f"drive-tune undo {before} restores the drives' state before")
        print_lines(written)

    def print(self, before: Path | None) -> None:
        """Print the result; arguments as in `as_dict`."""
        from tuning.runs.inputs import as_kept

        where = "the bus" if self.drive.bus else f"an emulated {as_kept(self.drive.load)}"
        _print(self.found, self.settings, before, where, self.machine)

    def _search_machine(self) -> Optimised:
        """Run all searches on an emulated machine, and return their joined result."""
        from tuning.runs import provenance, unfinished
        from tuning.runs.inputs import inputs_in, table_of
        from tuning.runs.pools import open_pool
        from tuning.search import searches
        from tuning.toml_tables import toml

        options, settings, count = self.options, self.settings, self.options.searches
        machine = self.drive.machine() | {"num_machines": self.copies}
        shards = searches.searches(machine, settings, count)
        inputs = inputs_in(machine)
        versions = "".join(f"{name} = {toml(version)}\n" for name, version in provenance.versions().items())
        described = searches.description(shards) + versions + "\n".join(table_of(inputs)) + "\n"
        with (
            unfinished.shard_log(self.folder, described, resume=options.resume, inputs=inputs) as log,
            open_pool(options.workers, options.cluster) as pool,
        ):
            if log.done or unfinished.has_parts(log):
                print(
                    f"note: continues a stopped run; {len(log.done)} of {count} searches are complete", file=sys.stderr
                )
            for line in pool.differences():
                print(f"note: {line}", file=sys.stderr)
            elsewhere = options.workers is not None or options.cluster is not None
            with progress_bar(self.plan) as show:
                return searches.joined(searches.run(shards, pool if elsewhere else None, log, show))


def open_search(
    by: str,
    drive: TargetOptions,
    options: MethodOptions,
    *,
    dynamics: str | None,
    inertia_range: str | None,
    out: Path | None,
) -> SearchRun:
    """Create a search from valid options; no drive is opened yet.

    Raises:
        ValueError: For invalid options.
    """
    from drive_env.devices import find_device
    from drive_env.devices.gains import has_linear_model
    from drive_env.trials.method import check_tried
    from tuning.commands.options import asked_dynamics
    from tuning.identify.working_state import check_identifiable
    from tuning.runs import provenance
    from tuning.search.optimise import Settings

    _check(drive, options, out)
    given, drive = drive, drive.with_inputs()
    folder = provenance.run_folder("auto") if out is None else out
    if options.resume:
        _check_unfinished(folder, options.journal)
    provenance.check_folder(folder)
    device = find_device(drive.device)
    searched = tuple(options.gains) if options.gains else device.gains.outer
    check_tried(device, searched)  # checked before anything moves
    if has_linear_model(device):
        check_identifiable(device)
    asked = asked_dynamics(dynamics, drive.device, inertia_range)
    settings = Settings(
        sampler=by,
        trials=TRIALS if options.trials is None else options.trials,
        objectives=tuple(options.objectives) if options.objectives else ("cost",),
        gains=searched,
        safe=drive.bus if options.safe is None else options.safe,
        seed=drive.seed,
        journal=options.journal,
        subject=_subject(drive),
        dynamics=asked.name if has_linear_model(device) else None,
        inertia_range=inertia_range,
        **({} if options.width is None else {"width": options.width}),
    )
    machine = _named(drive)
    search = SearchRun(given, drive, options, settings, folder, None, machine)
    if not drive.bus:
        machine |= {"load": drive.load, "machines": search.copies, "searches": options.searches}
    return search


def _check(drive: TargetOptions, options: MethodOptions, out: Path | None) -> None:
    """Raise ValueError for options that exclude each other or are out of range."""
    check_seed(drive.seed)
    if drive.machines is not None:
        check_machines("--machines", drive.machines)
    if not 1 <= options.searches <= MOST_SEARCHES:
        raise ValueError(f"--searches must be 1 or more, and {MOST_SEARCHES} at most, not {options.searches}")
    if options.resume and out is None:
        raise ValueError("--resume needs --out: the folder into which the search was to write")
    if drive.randomise:
        raise ValueError("--randomise has no meaning in a search by trials: its machines are copies of one")
    away = options.searches != 1 or options.workers is not None or options.cluster is not None or options.resume
    if drive.bus and away:
        raise ValueError(
            "--searches, --workers, --cluster and --resume are for emulated machines only; a search on a bus is "
            "continued with --journal"
        )
    drive.check()


@contextmanager
def left_to_trials(drives: Drives) -> Iterator[None]:
    """In a block, let trials stop an oscillating axis instead of the envelope, and give the sampler time to compute."""
    from tuning.search.trial_bench import leave_oscillations_to_trials

    limits = None if drives.safety is None else drives.safety.limits
    leave_oscillations_to_trials(drives)
    try:
        yield
    finally:
        if drives.safety is not None and limits is not None:
            drives.safety.change(limits)


def _subject(drive: TargetOptions) -> str:
    """Return the subject of a journal: drive and load, with hashes of the user's files."""
    from tuning.runs.inputs import as_kept, table_of

    named = _named(drive) | ({} if drive.bus else {"load": drive.load})
    return "\n".join([*(f"{name} = {value}" for name, value in as_kept(named).items()), *table_of(drive.inputs())])


def _named(drive: TargetOptions) -> dict[str, Any]:
    """Return the entries of settings.toml that apply to every drive."""
    named = {"device": drive.device, "motor": drive.motor_name, "supply": drive.supply, "travel": drive.travel}
    return named | ({"axis": sorted(set(drive.axis))} if drive.axis else {})


def _check_unfinished(folder: Path, journal: Path | None) -> None:
    """Raise ValueError if there is no search to continue. A journal is checked separately."""
    from tuning.runs import unfinished

    if (folder / "trials.csv").is_file():
        raise ValueError(f"the search in {folder} is finished, and its results are there: nothing is left to resume")
    if journal is None and not unfinished.unfinished_folder(folder).is_dir():
        raise ValueError(
            f"there is no search to resume: {unfinished.unfinished_folder(folder)} does not exist; correct --out, or "
            "leave --resume out to begin a new one"
        )


def _kept_in(journal: Path) -> str:
    """Return the message of an interrupted search with a journal."""
    return f"interrupted; the trials made are in {journal}: the same command, with a new --out, continues from there"


def _print(found: Any, settings: Any, before: Path | None, where: str, options: dict[str, Any]) -> None:
    import numpy as np

    from drive_env.devices import find_device
    from tuning.search.optimise import COST
    from tuning.search.trials_files import axis_numbers
    from tuning.search.trials_files import titles as titles_of

    device = options["device"]
    searches = sorted({row.search for row in found.rows})
    axes = len(found.gains) // max(len(searches), 1)
    numbers = axis_numbers(options, axes)
    kind = "Axis" if before is not None else "Search"
    several = settings.objectives != (COST,)
    shown = (COST, *(name for name in settings.objectives if name != COST))
    titles = [name.replace("_", "\n") for name in find_device(device).gains.names] + [
        _on_two_lines(titles_of(device, settings.gains)[name]) for name in shown
    ]
    columns = [Column("", "name"), *map(Column, titles)]
    for search in searches:
        own = [row for row in found.rows if row.search == search]
        rows = []
        if own:
            rule = found.rule[search * axes : (search + 1) * axes]
            first = "safe start" if settings.safe else "the rule"
            first = first if settings.safe or np.array_equal(own[0].gains, rule) else "slower rule"
            rows += _cells(first, numbers, own[0].gains, _told(own[0], shown, found.t_0))
        for row in found.front(settings.objectives, search)[:10] if several else []:
            rows += _cells(f"trial {row.number}", numbers, row.gains, _told(row, shown, found.t_0))
        best = found.gains[search * axes : (search + 1) * axes]
        cost = found.cost[search if len(found.cost) == len(searches) else 0]
        row = next((row for row in own if row.cost == cost and np.array_equal(row.gains, best)), None)
        rows += _cells("best", numbers, best, [""] * len(shown) if row is None else _told(row, shown, found.t_0))
        title = f"{kind} {search} of {where}" if len(searches) > 1 else f"Gains of {where}"
        print_table(columns, rows, title + ", with the Pareto front of the trials" * several)
    stopped = sum(row.aborted for row in found.rows)
    lines = [f"{len(found.rows)} trials, {stopped} of them stopped, in {found.drive_seconds:.1f} s of drive time."]
    if settings.dynamics is not None:
        lines.append(
            f"{found.untried} more gains were not tried: they break {settings.dynamics} dynamics by the model."
        )
        axes_told = (
            [f"axis {k}" for k in axis_numbers(options, len(found.gains))]
            if before is not None or len(searches) == 1
            else [f"search {search}, axis {k}" for search in searches for k in numbers]
        )
        lines += _margins_by_model(found, axes_told)
    for row in found.rows:
        if row.cause:
            which = f"search {row.search}, trial" if len(searches) > 1 else "trial"
            lines.append(f"{which} {row.number} was stopped: the drive reported {row.cause}")
    lines += sorted({note for note in found.notes if note})
    lines += _what_counts(device, settings.gains)
    accepted = [row for row in found.rows if row.accepted]
    if before is None and len(searches) > 1 and accepted:
        lines.append(f"search {min(accepted, key=lambda row: row.robust_cost).search} found the best gains")
    print_lines(lines)


def _margins_by_model(found: Any, axes: Sequence[str]) -> list[str]:
    """Format the outer loops' margins by the model with the best gains; `axes` are the axes' names."""
    lines = []
    for where, axis in zip(axes, found.margins.tolist(), strict=True):
        told = [
            f"{name} loop {phase:.0f}°, {gain:.1f} dB, Ms {ms:.1f}"
            for name, (phase, gain, ms) in zip(OUTER_LOOPS, axis, strict=True)
        ]
        lines.append(f"{where}: by the identified model, not measured: {'; '.join(told)}")
    return lines


def _as_dicts(axis: list[list[float]]) -> dict[str, dict[str, float | None]]:
    """Convert the margins of an axis by the model to JSON types."""
    return {
        loop: {name: value if math.isfinite(value) else None for name, value in zip(MARGINS, values, strict=True)}
        for loop, values in zip(OUTER_LOOPS, axis, strict=True)
    }


def _what_counts(device: str, gains: tuple[str, ...] | None) -> list[str]:
    """Explain the terms of J that differ for a stepper; empty for a servo."""
    from drive_env.devices import find_device
    from drive_env.trials.open_loop import unmeasured
    from tuning.search.trials_files import is_tried_by_pid, is_tried_open

    if is_tried_by_pid(device, gains):
        return [
            "The PID regulated the position in trials, at the motor's rated current. J has no load step and no ripple "
            "of the current here: a PID does not commutate, 6077h is the size of the current that is set. E_d/E_0 "
            "follows from the gains, and has 1 + b/t_0 beside it, b the integral of |demand - encoder|; in place of "
            "the ripple stands the vibration of the encoder."
        ]
    if not is_tried_open(device, gains) and find_device(device).gains.is_open_loop:
        return [
            "The loop was closed in trials, at the motor's rated current or less: the ramp asks for more than the "
            "motor gives, and in place of E_d/E_0 J has 1 + b/t_0, b the time for which the axis is behind its demand."
        ]
    if find_device(device).gains.is_open_loop:
        return [
            "J has no load step and no ripple of the current here: no torque current is measured "
            f"({unmeasured(find_device(device))}). E_d/E_0 follows from the standby current, effort from the settings; "
            "settling, load angle, vibration and lost steps are the encoder's."
        ]
    return []


def _on_two_lines(title: str) -> str:
    """Break a title before its unit, or before "over"."""
    return title.replace(" [", "\n[").replace(" over ", "\nover ")


def _told(row: Any, objectives: Sequence[str], t_0: float) -> list[str]:
    from tuning.search.trials_files import figures

    return [f"{value:.3g}" for value in figures(row, objectives, t_0)]


def _cells(name: str, numbers: Sequence[int], gains: Any, told: list[str]) -> list[tuple[str, ...]]:
    """Return the table rows of a machine's gains, one per axis; its results are in the first."""
    first = name if list(numbers) == list(range(len(numbers))) else f"{name}, axis {numbers[0]}"
    return [
        (first if k == 0 else f"  axis {axis}", *map(str, row), *(told if k == 0 else [""] * len(told)))
        for k, (axis, row) in enumerate(zip(numbers, gains, strict=True))
    ]
