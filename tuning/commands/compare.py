"""`drive-tune compare`: every tuner on the same machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.commands.options import Json, errors_as_exit_codes, print_json, progress_bar


def compare(
    suite: Annotated[str, typer.Option(help="Machines: a suite by name, or a TOML file like one.")] = "public",
    tuners: Annotated[
        list[str] | None,
        typer.Option("--tuner", "-t", help="Tuner by name, again for another.", show_default="all but the slow ones"),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the tuners, and of the suite's part that is drawn.")] = 0,
    drawn: Annotated[
        bool, typer.Option("--drawn/--public-only", help="Draw the suite's other part for the seed, too.")
    ] = False,
    count: Annotated[
        int | None, typer.Option(help="Machines at most, of all loads in turn.", show_default="all")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-compare")
    ] = None,
    slow: Annotated[bool, typer.Option("--slow", help="Compare the slow tuners, too.")] = False,
    show: Annotated[bool, typer.Option("--list", help="List tuners and suites, and stop.")] = False,
    json: Json = False,
) -> None:
    """Have every tuner tune the same emulated machines, and score what it finds by hidden J.

    Hidden J counts speed, stiffness, noise, overshoot and robustness; it is given relative to that of the fitted rule
    with the true inertia. Writes tuners.csv, machines.csv, comparison.png and settings.toml.
    """
    with errors_as_exit_codes():
        if show:
            _list()
            return
        _compare(suite, tuners, seed, drawn, count, out, slow, json)


def _compare(
    suite: str,
    names: list[str] | None,
    seed: int,
    drawn: bool,
    count: int | None,
    out: Path | None,
    slow: bool,
    json: bool,
) -> None:
    from dataclasses import asdict

    from tuning import provenance
    from tuning.compare import compare as run
    from tuning.compare import save
    from tuning.suite import load_suite
    from tuning.tuners import MissingTunerError, find_tuner, tuner_rows

    if seed < 0:
        raise ValueError(f"--seed must be 0 or more, not {seed}")
    folder = provenance.run_folder("compare") if out is None else out
    provenance.check_folder(folder)
    machines = load_suite(suite, seed if drawn else None, count)
    tuners, left_out = {}, []
    for name in names or [row.name for row in tuner_rows().values() if slow or not row.slow]:
        try:
            tuners[name] = find_tuner(name)
        except MissingTunerError as error:
            if names:  # asked for by name
                raise
            left_out.append(str(error))
    with progress_bar(f"{len(tuners)} tuners on {len(machines)} machines") as show:
        comparison = run(machines, tuners, seed=seed, progress=lambda what, share: show(share))
    settings = {"suite": suite, "tuners": list(tuners), "seed": seed, "drawn": str(drawn).lower(), "count": count}
    with provenance.new_folder(folder) as partial:
        save(comparison, partial, settings | provenance.versions())
    if json:
        print_json({"tuners": [asdict(row) for row in comparison.tuners], "folder": str(folder)})
        return
    _print(comparison, folder, left_out)


def _print(comparison: Any, folder: Path, left_out: list[str]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    machines = comparison.tuners[0].machines
    table = Table(
        title=f"Hidden J over the fitted rule's on {machines} machines",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("tuner", no_wrap=True)
    for title in ("median", "p95", "> 5 %\nworse", "time\n\\[s]", "moves", "stops", "vio-\nlations", "gave\nup"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in comparison.tuners:
        table.add_row(
            row.tuner, f"{row.median:.3f}", f"{row.p95:.2f}", f"{100.0 * row.worse:.0f} %", f"{row.drive_seconds:.2f}",
            f"{row.moves:.0f}", str(row.aborts), str(row.violations), str(row.failed),
        )  # fmt: skip
    console.print(table)
    lines = ["Drive time and moves: median of a machine; stops, violations, gave up: all machines."]
    lines += [f"left out: {text}" for text in left_out]
    failures = {(row.tuner, row.note) for row in comparison.rows if row.failed}
    lines += [f"{tuner} failed: {note}" for tuner, note in sorted(failures)]
    lines.append(f"written to {folder}: tuners.csv, machines.csv, comparison.png, settings.toml")
    console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


def _list() -> None:
    from rich.console import Console
    from rich.table import Table

    from tuning.suite import load_suite, suite_names
    from tuning.tuners import tuner_rows

    console = Console()
    tables = {
        "tuners": [(row.name, row.meaning + (" (slow)" if row.slow else "")) for row in tuner_rows().values()],
        "suites": [(name, f"{len(load_suite(name))} machines") for name in suite_names()],
    }
    for title, rows in tables.items():
        table = Table(title=title, title_justify="left", box=None, show_header=False, pad_edge=False)
        for name, meaning in rows:
            table.add_row(name, meaning)
        console.print(table)
        console.print()
