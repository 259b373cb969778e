"""`drive-tune auto`: identify an axis, find its gains, verify and store them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_table
from tuning.commands.dry_run import check_can_be_told, tell_plan
from tuning.commands.methods import DESIGN, SEARCH_FILES, SEARCHES, By, MethodOptions, OpenedMethod, open_method
from tuning.commands.options import (
    REFUSED,
    DynamicsOption,
    InertiaRangeOption,
    Json,
    TargetOptions,
    asked_dynamics,
    errors_as_exit_codes,
    print_json,
    progress_bar,
    takes,
)

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.stages import AxisResult, Result
    from tuning.stepper.result import StepperResult
    from tuning.target import Target


@takes
def auto(
    drive: TargetOptions,
    method: MethodOptions,
    by: By = DESIGN,
    dynamics: DynamicsOption = None,
    inertia_range: InertiaRangeOption = None,
    store: Annotated[
        bool,
        typer.Option("--store/--no-store", help="Drives on a bus store the gains, so that they survive a power cycle."),
    ] = True,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print what would be read, moved and written; drives on a bus are only read."),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-auto")
    ] = None,
    json: Json = False,
) -> None:
    """Tune a drive: identify, find gains, try, verify and store them; an axis that fails a check is rolled back.

    `--by` says how gains are found; all else is the same: the state before is saved, what was found is tried, corrected
    by what is measured, and certified.

    Of an open-loop stepper it sets the phase currents, the StallGuard threshold and CoolStep, and writes
    stepper-certificate.json in place of certificate.json and report.html.

    The motor turns, for 9 to 20 s an axis, longer where a stepper's loop is closed or an agent makes its trials. The
    verdict is accepted, accepted with reservations, which are listed, or rejected. Writes before.toml, with which
    `drive-tune undo` restores the state before, certificate.json and report.html. Exit code 1 if an axis was rejected;
    the reason is printed.
    """
    with errors_as_exit_codes():
        from tuning.auto_to_files import BEFORE
        from tuning.runs import provenance
        from tuning.way_back import way_back

        method.check(by)
        if by in SEARCHES:
            _search(by, drive, method, dynamics, inertia_range, out=out, store=store, dry_run=dry_run, json=json)
            return
        asked = asked_dynamics(dynamics, drive.device, inertia_range)  # checked before anything is done
        tell: Callable[[str], None] = (lambda line: None) if json else print
        how = open_method(by, method, drive.device, dynamics, None if drive.bus else drive.load, tell)
        folder = provenance.run_folder("auto") if out is None else out
        provenance.check_folder(folder)
        if dry_run:
            check_can_be_told(drive.device)
            with drive.open_to_read() as target:
                how.method(target)  # an agent prints what it was not trained for
                tell_plan(target, how, folder, keep=store, json=json)
            return
        file = folder / BEFORE if drive.bus else None
        with way_back(file, "drive-tune"), drive.open() as target:
            result = _run(target, how, folder, asked, seed=drive.seed, store=store, json=json)
        if not result.accepted.all():
            raise typer.Exit(REFUSED)


def _run(
    target: Target, how: OpenedMethod, folder: Path, dynamics: Dynamics, *, seed: int, store: bool, json: bool
) -> Result | StepperResult:
    from tuning.auto_to_files import auto_to_files, commission_to_files

    if target.device.gains.is_open_loop:
        with progress_bar("commissioning") as show:
            commissioned = commission_to_files(target, folder, lambda what, share: show(share), keep=store)
        _report_stepper(target, commissioned, folder, json)
        return commissioned
    with progress_bar("tuning") as show:
        result = auto_to_files(
            target, folder, lambda what, share: show(share), seed=seed, keep=store, dynamics=dynamics,
            method=how.method(target),
        )  # fmt: skip
    _report(target, result, folder, json)
    return result


def _search(
    by: str,
    drive: TargetOptions,
    method: MethodOptions,
    dynamics: str | None,
    inertia_range: str | None,
    *,
    out: Path | None,
    store: bool,
    dry_run: bool,
    json: bool,
) -> None:
    """Tune drives by a search, and print the result; if no certificate is possible, only search."""
    from tuning.auto_to_files import BEFORE, auto_to_files
    from tuning.commands.search import open_search
    from tuning.runs import provenance, unfinished
    from tuning.way_back import way_back

    search = open_search(by, drive, method, dynamics=dynamics, inertia_range=inertia_range, out=out)
    folder = search.folder
    if dry_run:
        check_can_be_told(drive.device)
        with drive.open_to_read() as target:
            how = OpenedMethod(search.plan, math.inf, lambda target: search.method(folder), SEARCH_FILES)
            tell_plan(target, how, folder, keep=store, json=json)
        return
    if not search.is_certified:
        search.alone(json)
        return
    asked = asked_dynamics(dynamics, drive.device, inertia_range)
    before = folder / BEFORE if drive.bus else None
    place = nullcontext(folder) if drive.bus else provenance.new_folder(folder)
    with unfinished.telling_what_is_kept(folder), search.telling_what_is_lost(), way_back(before, "drive-tune"):
        if not drive.bus:
            search.on_machine()
        with replace(drive, machines=None).open() as target:
            with place as here, progress_bar(search.plan) as show:
                result = auto_to_files(
                    target, here, lambda what, share: show(share), seed=drive.seed, keep=store, dynamics=asked,
                    method=search.method(here),
                )  # fmt: skip
            searched = None if search.done is None else {"search": search.as_dict(before)}  # axes rejected before it
            if searched is not None and not json:
                search.print(before)
            _report(target, result._replace(file=folder / BEFORE), folder, json, searched)
    unfinished.discard(folder)
    if not result.accepted.all():
        raise typer.Exit(REFUSED)


def _report_stepper(target: Target, result: StepperResult, folder: Path, json: bool) -> None:
    from drive_env.trials.open_loop import unmeasured
    from tuning.stepper.result import CERTIFICATE

    files = {"snapshot": str(result.file), "certificate": str(folder / CERTIFICATE)}
    if json:
        print_json(result.as_dict() | files)
        return
    names = [title.replace(" ", "\n") for title in target.device.gains.titles]
    rows = [
        (str(k), name, *map(str, gains.values()))
        for k, axis in zip(target.axis_numbers, result.axes, strict=True)
        for name, gains in (("before", axis.before), ("after", axis.after))
    ]
    print_table((Column("axis"), Column("", "name"), *map(Column, names)), rows)
    lines = []
    for k, axis in zip(target.axis_numbers, result.axes, strict=True):
        if not axis.accepted:
            lines.append(f"axis {k}: rejected, and its settings from before are restored: {axis.reason}")
            continue
        lines.append(f"axis {k}: {axis.verdict}")
        lines += [f"axis {k}: {name}: {'not measured' if v is None else f'{v:g}'}" for name, v in axis.figures.items()]
        lines += [
            f"axis {k}: {name.replace(':', 'h:')}: {values['before']} before, {values['after']} now"
            for name, values in axis.settings.items()
        ]
        lines += [f"axis {k}: reservation: {reservation}" for reservation in axis.reservations]
    lines.append(
        f"not measured: current and load step ({unmeasured(target.device)}), frequency response and margins (open loop)"
    )
    kept = "; the settings are stored in the drive" if result.kept else _not_kept(target)
    lines.append(f"{result.drive_seconds:.1f} s of drive time{kept}")
    lines.append(f"written to {folder}: before.toml, {CERTIFICATE}")
    if target.bus:
        lines.append(f"drive-tune undo {result.file} restores the state before")
    print_lines(lines)


def _not_kept(target: Target) -> str:
    """Return the note on settings that a drive on a bus cannot store; "" if it can."""
    from tuning.snapshot import can_store

    if not target.bus or can_store(target):
        return ""
    return "; the drive has no 1010h, and loses the settings with its power (`drive-env parameters backup` keeps them)"


def _report(target: Target, result: Result, folder: Path, json: bool, search: Mapping[str, Any] | None = None) -> None:
    if json:
        names = target.device.gains.names
        rows = [
            {
                "axis": target.axis_numbers[k],
                "verdict": axis.verdict,
                "accepted": axis.accepted,
                "reservations": axis.reservations,
                "reason": axis.reason,
                "verified": axis.verified,
                "J": axis.proof if math.isfinite(axis.proof) else None,
                "before": dict(zip(names, axis.before, strict=True)),
                "after": dict(zip(names, axis.after, strict=True)),
                "notes": axis.notes,
            }
            for k, axis in enumerate(result.axes)
        ]
        summary = {"drive seconds": result.drive_seconds.tolist(), "stored": result.kept}
        written = {"certificate": "certificate.json", "report": "report.html"}
        files = {"snapshot": str(result.file)} | {what: str(folder / name) for what, name in written.items()}
        print_json({"axes": rows} | summary | files | dict(search or {}))
        return
    known = target.device.gains
    loops = list(dict.fromkeys(row.loop for row in known.rows))
    heads = [_head(loop, [known.rows[k].title for k in known.columns_of(loop)]) for loop in loops]
    columns = [Column("axis"), Column("", "name"), *(Column(head, "name") for head in heads)]
    columns += [Column("velocity\nloop", "name"), Column("position\nloop", "name")]
    cells: list[tuple[str, ...]] = []
    numbers = target.axis_numbers
    for k, axis in zip(numbers, result.axes, strict=True):
        for name, gains in (("before", axis.before), ("after", axis.after)):
            told = name == "after" and axis.accepted
            margins = [_margins(axis, loop) if told else "" for loop in ("velocity", "position")]
            by_loop = [", ".join(str(gains[column]) for column in known.columns_of(loop)) for loop in loops]
            cells.append((str(k), name, *by_loop, *margins))
    print_table(columns, cells)
    lines = []
    for k, axis, seconds in zip(numbers, result.axes, result.drive_seconds, strict=True):
        if not axis.accepted and axis.identified is None and seconds == 0.0:  # refused before its first move
            lines.append(f"axis {k} was not tuned: {axis.reason}")
        elif not axis.accepted:
            lines.append(f"axis {k}: rejected, and its gains from before are restored: {axis.reason}")
        else:
            lines.append(f"axis {k}: {axis.verdict}; the gains were verified {axis.verified}")
            lines += [f"axis {k}: reservation: {reservation}" for reservation in axis.reservations]
        lines += [f"axis {k}: {note}" for note in axis.notes]
    kept = "; the gains are stored in the drive" if result.kept else _not_kept(target)
    stopped = int(result.aborts.sum())
    lines.append(
        f"{result.drive_seconds.max():.1f} s of drive time, {stopped} trial{'s' * (stopped != 1)} stopped{kept}"
    )
    left = ("before.toml", "certificate.json", "report.html", *(() if search is None else SEARCH_FILES))
    lines.append(f"written to {folder}: {', '.join(left)}")
    if target.bus:
        lines.append(f"drive-tune undo {result.file} restores the state before")
    print_lines(lines)


def _head(loop: str, titles: list[str]) -> str:
    """Return a column's head: the titles' common first words, else the loop; below it, the rest of each title."""
    shared = titles[0].rpartition(" ")[0]
    return f"{shared or loop}\n{', '.join(title.removeprefix(shared).strip() for title in titles)}"


def _margins(axis: AxisResult, loop: str) -> str:
    """Format phase and gain margin of a loop; a lower bound if one was not measured."""
    found, least = axis.margins.get(loop), axis.at_least.get(loop)
    texts = []
    for key, unit in (("phase_deg", "°"), ("gain_db", " dB")):
        seen = math.nan if found is None else getattr(found, key)
        bound = math.nan if least is None else getattr(least, key)
        if math.isfinite(seen):
            texts.append(f"{seen:.0f}{unit}")
        else:
            texts.append(f"≥{bound:.0f}{unit}" if math.isfinite(bound) else "?")
    return ", ".join(texts) if texts != ["?", "?"] else "not measured"
