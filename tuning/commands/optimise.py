"""`drive-tune optimise`: gains found by trials, on emulated machines or on a bus."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.commands.options import (
    Bitrate,
    Bus,
    Channel,
    Cluster,
    DeviceName,
    Interface,
    Json,
    LoadName,
    MotorName,
    Nodes,
    Resume,
    Seed,
    Supply,
    TravelRange,
    Workers,
    errors_as_exit_codes,
    open_target,
    parse_travel,
    print_json,
    progress_bar,
)

STALL = 60.0  # s: so long a sampler may think while an axis stands still, enabled


def optimise(
    sampler: Annotated[str, typer.Option(help="random, grid, tpe, cmaes or gp.")] = "tpe",
    trials: Annotated[int, typer.Option(help="Trials of the search; each takes 0.75 s of drive time.")] = 30,
    objectives: Annotated[
        list[str] | None,
        typer.Option(
            "--objective",
            help="cost, or several of speed, robustness and current: then the front of what none beats is kept.",
            show_default="cost",
        ),
    ] = None,
    gains: Annotated[
        list[str] | None,
        typer.Option(
            "--gain",
            help="Gain that is searched, again for another.",
            show_default="velocity_p, velocity_i, position_p",
        ),
    ] = None,
    safe: Annotated[
        bool | None,
        typer.Option(
            "--safe/--bold",
            help="Start from slow gains that are proved first, and go on from what was proved in small steps.",
            show_default="safe on a bus",
        ),
    ] = None,
    lanes: Annotated[int, typer.Option(help="Emulated machine: its twins side by side, a generation.")] = 8,
    searches: Annotated[
        int, typer.Option(help="Emulated machine: searches with a seed each; the best one counts.")
    ] = 1,
    workers: Workers = None,
    cluster: Cluster = None,
    resume: Resume = False,
    journal: Annotated[
        Path | None, typer.Option(help="File of Optuna's journal: the search is kept there, and goes on from there.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-optimise"),
    ] = None,
    device: DeviceName = "tmcm1636",
    motor: MotorName = "qbl4208",
    load: LoadName = "two_mass",
    seed: Seed = 0,
    bus: Bus = False,
    interface: Interface = None,
    channel: Channel = None,
    nodes: Nodes = None,
    bitrate: Bitrate = None,
    supply: Supply = None,
    travel: TravelRange = None,
    json: Json = False,
) -> None:
    """Search gains by trials: a move, its reversal, and the move with more gain, costed from what the drive shows.

    What oscillates is stopped within 50 ms and gets the last good gains back. Afterwards the drive has the best gains;
    trials.csv, trials.png and settings.toml are written, and on a bus before.toml, from which drive-tune restore brings
    back what was.
    """
    with errors_as_exit_codes():
        if lanes < 1:
            raise ValueError(f"--lanes must be 1 or more, not {lanes}")
        from tuning import provenance, unfinished
        from tuning.optimise import Settings

        folder = provenance.run_folder("optimise") if out is None else out
        provenance.check_folder(folder)
        chosen: dict[str, Any] = {"gains": tuple(gains)} if gains else {}
        settings = Settings(
            sampler=sampler,
            trials=trials,
            objectives=tuple(objectives) if objectives else ("cost",),
            safe=bus if safe is None else safe,
            seed=seed,
            journal=journal,
            **chosen,
        )
        where = "the bus" if bus else f"an emulated {load}"
        if not bus:
            if nodes or bitrate is not None:
                raise ValueError("--node and --bitrate are of drives on a bus; add --bus, or leave them out")
            ends = None if travel is None else parse_travel(travel)
            machine = {
                "device": device, "load": load, "motor": motor, "num_machines": lanes, "seed": seed, "supply": supply,
                "travel": ends,
            }  # fmt: skip
            found = _search_machine(machine, settings, searches, folder, workers, cluster, resume)
            _report(found, settings, folder, None, where, json)
            unfinished.discard(folder)
            return
        if searches != 1 or workers is not None or cluster is not None or resume:
            raise ValueError(
                "--searches, --workers, --cluster and --resume are of emulated machines; a search on a bus goes on "
                "from its --journal"
            )
        target = open_target(
            bus=bus,
            device=device,
            motor=motor,
            seed=seed,
            interface=interface,
            channel=channel,
            nodes=nodes,
            bitrate=bitrate,
            supply=supply,
            travel=travel,
        )
        with target:
            found, before = _search_bus(target, settings, folder)
        _report(found, settings, folder, before, where, json)


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
    from tuning import provenance, searches, unfinished
    from tuning.pools import open_pool

    shards = searches.searches(machine, settings, count)
    versions = "".join(f"{name} = {version}\n" for name, version in provenance.versions().items())
    what = f"{settings.trials} trials by {settings.sampler}" + (f", {count} times" if count > 1 else "")
    with (
        unfinished.shard_log(folder, searches.description(shards) + versions, resume=resume) as log,
        open_pool(workers, cluster) as pool,
    ):
        for line in pool.differences():
            print(f"note: {line}", file=sys.stderr)
        elsewhere = workers is not None or cluster is not None
        with progress_bar(what) as show:
            return searches.joined(searches.run(shards, pool if elsewhere else None, log, show))


def _search_bus(target: Any, settings: Any, folder: Path) -> tuple[Any, Path]:
    """Search on a bus inside a transaction; return what was found, and the file that leads back."""
    from tuning.optimise import optimise as search
    from tuning.snapshot import Transaction

    leave_oscillations_to_trials(target.drives)
    before = folder.with_name(f"{folder.name}-before.toml")
    with (
        Transaction(target, before) as transaction,
        progress_bar(f"{settings.trials} trials by {settings.sampler}") as show,
    ):
        found = search(target, settings, progress=show)
        transaction.commit()
    return found, before


def leave_oscillations_to_trials(drives: Any) -> None:
    """Have the envelope not end a search for what a trial stops itself, nor for a sampler that thinks."""
    from dataclasses import replace

    from drive_env.safety import Envelope

    if drives.safety is not None:
        drives.safety = Envelope(replace(drives.safety.limits, oscillation=False, stall=STALL), drives)


def _report(found: Any, settings: Any, folder: Path, before: Path | None, where: str, json: bool) -> None:
    from dataclasses import asdict

    from tuning import provenance
    from tuning.trials_files import save

    with provenance.new_folder(folder) as partial:
        save(found, settings, partial, provenance.versions())
    if json:
        print_json(
            {
                "gains": found.gains.tolist(), "rule": found.rule.tolist(), "cost": found.cost.tolist(),
                "drive_seconds": found.drive_seconds, "aborts": int(found.aborts.sum()), "notes": list(found.notes),
                "settings": asdict(settings), "folder": str(folder), "before": str(before) if before else None,
            }
        )  # fmt: skip
        return
    _print(found, settings, folder, before, where)


def _print(found: Any, settings: Any, folder: Path, before: Path | None, where: str) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from drive_env.gains import Gains
    from tuning.optimise import COST

    console = Console()
    searches = sorted({row.search for row in found.rows})
    axes = len(found.gains) // max(len(searches), 1)
    kind = "Axis" if before is not None else "Search"
    for search in searches:
        rows = found.front(settings.objectives, search)[:10] if settings.objectives != (COST,) else []
        table = Table(
            title=f"{kind} {search} of {where}" if len(searches) > 1 else f"Gains of {where}", box=box.SIMPLE_HEAD
        )
        table.add_column("", no_wrap=True)
        for name in (*Gains._fields, "ln J"):
            table.add_column(name.replace("_", "\n"), justify="right", no_wrap=True)
        first = next((row for row in found.rows if row.search == search), None)
        if first is not None:
            table.add_row(
                "safe start" if settings.safe else "fitted rule", *map(str, first.gains[0]), f"{first.cost:.2f}"
            )
        for row in rows:
            table.add_row(f"front, trial {row.number}", *map(str, row.gains[0]), f"{row.cost:.2f}")
        cost = found.cost[search if len(found.cost) == len(searches) else 0]
        table.add_row("[bold]best", *map(str, found.gains[search * axes]), f"{cost:.2f}")
        console.print(table)
    stopped = sum(row.aborted for row in found.rows)
    lines = [f"{len(found.rows)} trials, {stopped} of them stopped, in {found.drive_seconds:.1f} s of drive time."]
    lines += sorted({note for note in found.notes if note})
    lines.append(f"written to {folder}: trials.csv, trials.png, settings.toml")
    if before is not None:
        lines.append(f"drive-tune restore {before} brings back what the drives had")
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)
