"""`drive-tune rank`: compare all tuners on the same machines."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_names, print_table
from tuning.commands.options import (
    INTERRUPTED,
    Cluster,
    Json,
    Resume,
    Workers,
    check_seed,
    errors_as_exit_codes,
    fail,
    print_json,
    progress_bar,
    what_an_interrupt_leaves,
)


def rank(
    suite: Annotated[str, typer.Option(help="Machines: the name of a suite, or a TOML file like one.")] = "public",
    tuners: Annotated[
        list[str] | None,
        typer.Option(
            "--tuner", "-t", help="Tuner to compare; may be given several times.", show_default="all but the slow ones"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the tuners and of the randomly drawn machines.")] = 0,
    drawn: Annotated[
        bool, typer.Option("--drawn/--public-only", help="Also use the suite's randomly drawn machines.")
    ] = False,
    count: Annotated[
        int | None, typer.Option(help="Most machines to use, taken from all loads in turn.", show_default="all")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-compare")
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(help="Number of trials of the tuners that search by trials.", show_default="12 or 20, by tuner"),
    ] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    slow: Annotated[bool, typer.Option("--slow", help="Compare the slow tuners, too.")] = False,
    show: Annotated[bool, typer.Option("--list", help="List tuners and suites, and stop.")] = False,
    resume: Resume = False,
    json: Json = False,
) -> None:
    """Compare tuners: each tunes the same emulated machines, and its gains are scored by the robust cost.

    The robust cost counts speed, stiffness, noise, overshoot and robustness: the lower the better. It is given relative
        to that of the baseline rule with the true inertia, and machine by machine relative to the best other tuner.
        Writes tuners.csv, rivals.csv, machines.csv, comparison.png and settings.toml. A stopped run continues with
        --out and --resume, with identical results; also with --workers and --cluster.
    """
    with errors_as_exit_codes():
        if show:
            _list()
            return
        if resume and out is None:
            raise ValueError("--resume needs --out: the folder into which the comparison was to write")
        from tuning.runs import provenance

        folder = provenance.run_folder("rank") if out is None else out
        try:
            _compare(suite, tuners, seed, drawn, count, trials, folder, slow, resume, json, workers, cluster)
        except KeyboardInterrupt:
            fail(what_an_interrupt_leaves(folder), INTERRUPTED)


def _compare(
    suite: str,
    names: list[str] | None,
    seed: int,
    drawn: bool,
    count: int | None,
    trials: int | None,
    folder: Path,
    slow: bool,
    resume: bool,
    json: bool,
    workers: int | None,
    cluster: str | None,
) -> None:
    import hashlib
    from dataclasses import asdict

    from tuning.compare.against_best import all_rivals
    from tuning.compare.comparison import compare as run
    from tuning.compare.comparison_files import save, settings_text
    from tuning.compare.suite import groups, load_suite
    from tuning.compare.tuners import MissingTunerError, find_tuner, tuner_rows
    from tuning.runs import provenance, unfinished
    from tuning.runs.pools import open_pool

    check_seed(seed)
    if trials is not None and trials < 1:
        raise ValueError(f"--trials must be 1 or more, not {trials}")
    provenance.check_folder(folder)
    machines = load_suite(suite, seed if drawn else None, count)
    tuners, left_out = {}, []
    for name in names or [row.name for row in tuner_rows().values() if slow or not row.slow]:
        try:
            tuners[name] = find_tuner(name, trials)
        except MissingTunerError as error:
            if names:  # asked for by name
                raise
            left_out.append(str(error))
    settings = {"suite": suite, "tuners": list(tuners), "seed": seed, "drawn": drawn, "count": count}
    settings |= {"trials": trials}
    settings |= provenance.versions()
    # The machines themselves, not the suite's name alone: its file may have been edited since.
    run_text = settings_text(settings | {"machines": hashlib.sha256(repr(machines).encode()).hexdigest()})
    with unfinished.shard_log(folder, run_text, resume=resume) as log:
        if log.done:
            print(f"note: continues a stopped run; {len(log.done)} of {len(tuners) * len(groups(machines))} steps are "
                  f"done",
                  file=sys.stderr)  # fmt: skip
        with open_pool(workers, cluster) as pool:
            for line in pool.differences():
                print(f"note: {line}", file=sys.stderr)
            elsewhere = workers is not None or cluster is not None
            with progress_bar(f"{len(tuners)} tuners on {len(machines)} machines") as show:
                comparison = run(
                    machines, tuners, seed=seed, log=log, progress=lambda what, share: show(share),
                    pool=pool if elsewhere else None, trials=trials,
                )  # fmt: skip
    with provenance.new_folder(folder) as partial:
        save(comparison, partial, settings)
    unfinished.discard(folder)
    if json:
        rivals = [asdict(row) for row in all_rivals(comparison)]
        print_json({"tuners": [asdict(row) for row in comparison.tuners], "rivals": rivals, "folder": str(folder)})
        return
    _print(comparison, folder, left_out)


def _print(comparison: Any, folder: Path, left_out: list[str]) -> None:
    from tuning.compare.against_best import all_rivals

    machines = comparison.tuners[0].machines
    titles = ("median", "p95", "> 5 %\nworse", "time\n[s]", "moves", "stops", "violations", "gave\nup")
    rows = [
        (row.tuner, f"{row.median:.3f}", f"{row.p95:.2f}", f"{100.0 * row.worse:.0f} %", f"{row.drive_seconds:.2f}",
         f"{row.moves:.0f}", str(row.aborts), str(row.violations), str(row.failed))
        for row in comparison.tuners
    ]  # fmt: skip
    title = f"Robust cost relative to the baseline rule on {machines} machines"
    print_table([Column("tuner", "name"), *map(Column, titles)], rows, title)
    lines = ["Drive time and moves: median of a machine. Stops, limit violations, gave up: sum of all machines."]
    for row in all_rivals(comparison):
        lines.append(
            f"{row.tuner}: robust cost {row.median:.3f} times that of the best other tuner on the same machine "
            f"(median, 95 % interval {row.low:.3f} to {row.high:.3f}), best on {row.better} of {row.machines} machines"
        )
    lines += [f"left out: {text}" for text in left_out]
    failures = {(row.tuner, row.note) for row in comparison.rows if row.failed}
    lines += [f"{tuner} failed: {note}" for tuner, note in sorted(failures)]
    lines.append(f"written to {folder}: tuners.csv, rivals.csv, machines.csv, comparison.png, settings.toml")
    print_lines(lines)


def _list() -> None:
    from tuning.compare.suite import load_suite, suite_names
    from tuning.compare.tuners import tuner_rows

    print_names(
        {
            "tuners": {row.name: row.meaning + (" (slow)" if row.slow else "") for row in tuner_rows().values()},
            "suites": {name: f"{len(load_suite(name))} machines" for name in suite_names()},
        }
    )
