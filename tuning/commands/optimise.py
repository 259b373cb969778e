"""`drive-tune optimise`: search gains by trials, on emulated machines or on a bus."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_table
from tuning.commands.options import (
    INTERRUPTED,
    Cluster,
    DriveOptions,
    DynamicsOption,
    InertiaRangeOption,
    Json,
    Resume,
    Workers,
    asked_dynamics,
    check_machines,
    check_seed,
    errors_as_exit_codes,
    fail,
    print_json,
    progress_bar,
    takes,
    what_an_interrupt_leaves,
)

if TYPE_CHECKING:
    from tuning.search.optimise import Settings

MOST_SEARCHES = 10_000
OUTER_LOOPS, MARGINS = ("velocity", "position"), ("phase_deg", "gain_db", "ms")  # of `Optimised.margins`


def _from_file(context: typer.Context, path: Path | None) -> Path | None:
    """Take the defaults of all other options from settings.toml of a search."""
    if path is not None:
        with errors_as_exit_codes():
            from tuning.search.trials_files import load_options

            context.default_map = load_options(path)
    return path


@takes
def optimise(
    drive: DriveOptions,
    config: Annotated[
        Path | None,
        typer.Option(
            is_eager=True,
            callback=_from_file,
            help="settings.toml of a search, which is repeated; other options replace what it says.",
        ),
    ] = None,
    dynamics: DynamicsOption = None,
    inertia_range: InertiaRangeOption = None,
    sampler: Annotated[str, typer.Option(help="random, grid, tpe, cmaes or gp.")] = "tpe",
    trials: Annotated[int, typer.Option(help="Trials of the search; each takes 0.75 s of drive time.")] = 30,
    objectives: Annotated[
        list[str] | None,
        typer.Option(
            "--objective",
            help="cost, or several of speed, robustness and current: the Pareto front of trials is then shown.",
            show_default="cost",
        ),
    ] = None,
    gains: Annotated[
        list[str] | None,
        typer.Option(
            "--gain",
            help="Gain to search; may be given several times.",
            show_default="those of the velocity and position loop",
        ),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(
            help="The search covers the rule's gains divided by e^WIDTH to multiplied by e^WIDTH.", show_default="ln 6"
        ),
    ] = None,
    safe: Annotated[
        bool | None,
        typer.Option(
            "--safe/--bold",
            help="Start from slow gains, and go on in small steps from gains that were tried without oscillation.",
            show_default="safe on a bus",
        ),
    ] = None,
    copies: Annotated[
        int, typer.Option(help="Emulated machine: copies that try a generation of gains at the same time.")
    ] = 8,
    searches: Annotated[
        int, typer.Option(help="Emulated machine: number of searches, each with its own seed; the best is taken.")
    ] = 1,
    workers: Workers = None,
    cluster: Cluster = None,
    resume: Resume = False,
    journal: Annotated[
        Path | None,
        typer.Option(help="Journal file of Optuna, which keeps the search and from which it can be continued."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-optimise"),
    ] = None,
    json: Json = False,
) -> None:
    """Search gains by trials: a move, its reversal, and the move with more gain, with a cost from the drive's signals.

    The axes are identified first. Gains that break the dynamics by the model of their axis are not tried.

    An axis that oscillates is stopped within 50 ms and gets the last good gains back. Afterwards the drive has the best
    gains. Writes trials.csv, trials.png and settings.toml, with which `drive-tune optimise --config settings.toml`
    repeats the search (files of your own are copied to inputs/ beside it), and on a bus OUT-before.toml, with which
    `drive-tune undo` restores the state before.
    """
    with errors_as_exit_codes():
        check_seed(drive.seed)
        check_machines("--copies", copies)
        if not 1 <= searches <= MOST_SEARCHES:
            raise ValueError(f"--searches must be 1 or more, and {MOST_SEARCHES} at most, not {searches}")
        if resume and out is None:
            raise ValueError("--resume needs --out: the folder into which the search was to write")
        if drive.bus and (searches != 1 or workers is not None or cluster is not None or resume):
            raise ValueError(
                "--searches, --workers, --cluster and --resume are for emulated machines only; a search on a bus is "
                "continued with --journal"
            )
        from drive_env.devices import find_device
        from tuning.runs import provenance
        from tuning.search.optimise import Settings

        drive.check()
        given, drive = drive, drive.with_inputs()
        folder = provenance.run_folder("optimise") if out is None else out
        if resume:
            _check_unfinished(folder, journal)
        provenance.check_folder(folder)
        from drive_env.devices.gains import has_linear_model
        from drive_env.trials.method import check_tried

        device = find_device(drive.device)
        searched = tuple(gains) if gains else device.gains.outer
        check_tried(device, searched)  # before anything moves
        asked = asked_dynamics(dynamics, drive.device, inertia_range)
        settings = Settings(
            sampler=sampler,
            trials=trials,
            objectives=tuple(objectives) if objectives else ("cost",),
            gains=searched,
            safe=drive.bus if safe is None else safe,
            seed=drive.seed,
            journal=journal,
            subject=_subject(drive),
            dynamics=asked.name if has_linear_model(device) else None,
            inertia_range=inertia_range,
            **({} if width is None else {"width": width}),
        )
        if drive.bus:
            _on_bus(given, drive, settings, folder, json)
        else:
            _on_machine(drive, settings, copies, searches, folder, workers, cluster, resume, json)


def _on_machine(
    drive: DriveOptions,
    settings: Settings,
    copies: int,
    searches: int,
    folder: Path,
    workers: int | None,
    cluster: str | None,
    resume: bool,
    json: bool,
) -> None:
    """Search on an emulated machine, write and print the result."""
    from tuning.runs import unfinished
    from tuning.runs.inputs import as_kept

    machine = drive.machine() | {"num_machines": copies}
    options = _named(drive) | {"load": drive.load, "copies": copies, "searches": searches}
    with unfinished.telling_what_is_kept(folder):
        try:
            found = _search_machine(machine, settings, searches, folder, workers, cluster, resume)
        except KeyboardInterrupt:
            kept = what_an_interrupt_leaves(folder) if settings.journal is None else _kept_in(settings.journal)
            fail(kept, INTERRUPTED)
        _save(found, settings, folder, options)
    _report(found, settings, folder, None, f"an emulated {as_kept(drive.load)}", options, json)
    unfinished.discard(folder)


def _on_bus(given: DriveOptions, drive: DriveOptions, settings: Settings, folder: Path, json: bool) -> None:
    """Search on the drives of a bus, write and print the result.

    They are opened as they were given: the state before names their device for a later undo.
    """
    from tuning.snapshot import file_before
    from tuning.way_back import way_back

    before = file_before("optimise", folder)
    try:
        with way_back(before, "drive-tune"), given.open() as target:
            bus = {"nodes": drive.nodes or [1], "bitrate": drive.bitrate, "lockstep": drive.lockstep}
            options = _named(drive) | bus | {key: value for key, value in target.bus.items() if key != "axes"}
            found = _search_bus(target, settings, before, folder, options)
    except KeyboardInterrupt:
        lost = "interrupted; the trials made so far are lost: on a bus they are kept only with --journal FILE"
        fail(lost if settings.journal is None else _kept_in(settings.journal), INTERRUPTED)
    _report(found, settings, folder, before, "the bus", options, json)


def _subject(drive: DriveOptions) -> str:
    """Return the subject of a journal: the drive, and a machine's load, with hashes of the user's files."""
    from tuning.runs.inputs import as_kept, table_of

    named = _named(drive) | ({} if drive.bus else {"load": drive.load})
    return "\n".join([*(f"{name} = {value}" for name, value in as_kept(named).items()), *table_of(drive.inputs())])


def _named(drive: DriveOptions) -> dict[str, Any]:
    """Return the entries of settings.toml that any drive has."""
    named = {"device": drive.device, "motor": drive.motor_name, "supply": drive.supply, "travel": drive.travel}
    return named | ({"axis": sorted(set(drive.axis))} if drive.axis else {})


def _search_machine(
    machine: dict[str, Any],
    settings: Any,
    count: int,
    folder: Path,
    workers: int | None,
    cluster: str | None,
    resume: bool,
) -> Any:
    """Search on an emulated machine; return all searches as one."""
    from tuning.runs import provenance, unfinished
    from tuning.runs.inputs import inputs_in, table_of
    from tuning.runs.pools import open_pool
    from tuning.search import searches
    from tuning.toml_tables import toml

    shards = searches.searches(machine, settings, count)
    inputs = inputs_in(machine)
    versions = "".join(f"{name} = {toml(version)}\n" for name, version in provenance.versions().items())
    described = searches.description(shards) + versions + "\n".join(table_of(inputs)) + "\n"
    what = f"{settings.trials} trials by {settings.sampler}" + (f", {count} times" if count > 1 else "")
    with (
        unfinished.shard_log(folder, described, resume=resume, inputs=inputs) as log,
        open_pool(workers, cluster) as pool,
    ):
        if log.done or unfinished.has_parts(log):
            print(f"note: continues a stopped run; {len(log.done)} of {count} searches are complete", file=sys.stderr)
        for line in pool.differences():
            print(f"note: {line}", file=sys.stderr)
        elsewhere = workers is not None or cluster is not None
        with progress_bar(what) as show:
            return searches.joined(searches.run(shards, pool if elsewhere else None, log, show))


def _check_unfinished(folder: Path, journal: Path | None) -> None:
    """Raise ValueError where there is no search to continue. A journal has its own check."""
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
    return f"interrupted; the trials made are in {journal}: the same command continues from there"


def _search_bus(target: Any, settings: Any, before: Path, folder: Path, options: dict[str, Any]) -> Any:
    """Search on a bus, with the state before in a file; a failed search is undone, and the message names that file.

    A search whose results cannot be written has failed.
    """
    from tuning.search.optimise import optimise as search
    from tuning.search.trial_bench import leave_oscillations_to_trials
    from tuning.snapshot import Transaction

    leave_oscillations_to_trials(target.drives)
    with (
        Transaction(target, before) as transaction,
        progress_bar(f"{settings.trials} trials by {settings.sampler}") as show,
    ):
        try:
            found = search(target, settings, progress=show)
        except OSError as error:
            if error.errno is None or settings.journal is None:  # a drive's, or a file of which it says the name
                raise
            raise OSError(error.errno, error.strerror, str(settings.journal)) from error
        _save(found, settings, folder, options)
        transaction.commit()
    return found


def _save(found: Any, settings: Any, folder: Path, options: dict[str, Any]) -> None:
    from tuning.runs import provenance
    from tuning.search.trials_files import save

    with provenance.new_folder(folder) as partial:
        save(found, settings, partial, options, provenance.versions())


def _report(
    found: Any,
    settings: Any,
    folder: Path,
    before: Path | None,
    where: str,
    options: dict[str, Any],
    json: bool,
) -> None:
    from dataclasses import asdict

    if json:
        from tuning.runs.inputs import as_kept

        print_json(
            {
                "gains": found.gains.tolist(), "rule": found.rule.tolist(), "cost": found.cost.tolist(),
                "margins": [_as_dicts(axis) for axis in found.margins.tolist()], "untried": found.untried,
                "drive_seconds": found.drive_seconds, "aborts": int(found.aborts.sum()), "notes": list(found.notes),
                "settings": asdict(settings), "machine": as_kept(options), "folder": str(folder),
                "before": str(before) if before else None,
            }
        )  # fmt: skip
        return
    _print(found, settings, folder, before, where, options)


def _print(found: Any, settings: Any, folder: Path, before: Path | None, where: str, options: dict[str, Any]) -> None:
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
    lines.append(f"written to {folder}: trials.csv, trials.png, settings.toml")
    if before is not None:
        lines.append(f"drive-tune undo {before} restores the drives' state before")
    print_lines(lines)


def _margins_by_model(found: Any, axes: Sequence[str]) -> list[str]:
    """Return the margins of the outer loops with the best gains, for people; `axes` are the axes' names."""
    lines = []
    for where, axis in zip(axes, found.margins.tolist(), strict=True):
        told = [
            f"{name} loop {phase:.0f}°, {gain:.1f} dB, Ms {ms:.1f}"
            for name, (phase, gain, ms) in zip(OUTER_LOOPS, axis, strict=True)
        ]
        lines.append(f"{where}: by the identified model, not measured: {'; '.join(told)}")
    return lines


def _as_dicts(axis: list[list[float]]) -> dict[str, dict[str, float | None]]:
    """Return the margins of an axis by the model, for JSON."""
    return {
        loop: {name: value if math.isfinite(value) else None for name, value in zip(MARGINS, values, strict=True)}
        for loop, values in zip(OUTER_LOOPS, axis, strict=True)
    }


def _what_counts(device: str, gains: tuple[str, ...] | None) -> list[str]:
    """Return the terms of J that a stepper has in place of a servo's, for people; [] for a servo."""
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
    """Return a title with its unit, or its second half, below."""
    return title.replace(" [", "\n[").replace(" over ", "\nover ")


def _told(row: Any, objectives: Sequence[str], t_0: float) -> list[str]:
    from tuning.search.trials_files import figures

    return [f"{value:.3g}" for value in figures(row, objectives, t_0)]


def _cells(name: str, numbers: Sequence[int], gains: Any, told: list[str]) -> list[tuple[str, ...]]:
    """Return the rows of a machine's gains, one for each of its axes; its figures stand in the first."""
    first = name if list(numbers) == list(range(len(numbers))) else f"{name}, axis {numbers[0]}"
    return [
        (first if k == 0 else f"  axis {axis}", *map(str, row), *(told if k == 0 else [""] * len(told)))
        for k, (axis, row) in enumerate(zip(numbers, gains, strict=True))
    ]
