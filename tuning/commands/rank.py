"""`drive-tune rank`: compare all tuners on the same machines."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.tables import Column, print_lines, print_names, print_table
from tuning.commands.options import (
    INTERRUPTED,
    Cluster,
    DynamicsOption,
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

if TYPE_CHECKING:
    from tuning.compare.comparison import Comparison
    from tuning.compare.suite import SuiteMachine
    from tuning.outcome import Tuner


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
        Path | None, typer.Option(help="Folder for the results, new or empty.", show_default="runs/<timestamp>-rank")
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(help="Number of trials of the tuners that search by trials.", show_default="12 or 20, by tuner"),
    ] = None,
    dynamics: DynamicsOption = None,
    workers: Workers = None,
    cluster: Cluster = None,
    slow: Annotated[bool, typer.Option("--slow", help="Compare the slow tuners, too.")] = False,
    show: Annotated[bool, typer.Option("--list", help="List tuners and suites, and stop.")] = False,
    resume: Resume = False,
    json: Json = False,
) -> None:
    """Compare tuners: each tunes the same emulated machines, and its gains are judged on the true machine.

    Robust performance counts speed, stiffness, noise and overshoot on the machine and its variants: the lower the
    better. It is given over that of the oracle, the best gains of that machine that keep the constraints. The share of
    machines that keep them and the true margins of the loops are given, too. --dynamics says what the constraints are,
    and auto and the searches keep them; oracles for other than standard ones are searched first. Writes tuners.csv,
    rivals.csv, machines.csv, comparison.png and settings.toml, and copies files of your own (suite, motors, loads) to
    inputs/. A stopped run continues with --out and --resume, with identical results; also with --workers and --cluster.
    """
    with errors_as_exit_codes():
        if show:
            _list()
            return
        if resume and out is None:
            raise ValueError("--resume needs --out: the folder into which the comparison was to write")
        from tuning.runs import provenance, unfinished

        folder = provenance.run_folder("rank") if out is None else out
        try:
            from drive_env.loops.dynamics import DEFAULT, find_dynamics
            from tuning.compare.comparison_files import save
            from tuning.compare.suite import load_suite, suite_input

            check_seed(seed)
            if trials is not None and trials < 1:
                raise ValueError(f"--trials must be 1 or more, not {trials}")
            provenance.check_folder(folder)
            asked = find_dynamics(DEFAULT if dynamics is None else dynamics).name
            machines = load_suite(suite, seed if drawn else None, count)
            suite = suite_input(suite)
            compared, left_out = _find_tuners(tuners, trials, asked, slow)
            settings: dict[str, Any] = {
                "suite": suite,
                "tuners": list(compared),
                "seed": seed,
                "drawn": drawn,
                "count": count,
                "trials": trials,
                "dynamics": asked,
            } | provenance.versions()
            with unfinished.telling_what_is_kept(folder):
                comparison = _compare(machines, compared, settings, folder, resume, workers, cluster)
                with provenance.new_folder(folder) as partial:
                    save(comparison, partial, settings)
            unfinished.discard(folder)
            _report(comparison, asked, folder, left_out, json)
        except KeyboardInterrupt:
            fail(what_an_interrupt_leaves(folder), INTERRUPTED)


def _find_tuners(
    names: list[str] | None, trials: int | None, dynamics: str, slow: bool
) -> tuple[dict[str, Tuner], list[str]]:
    """Return the tuners to compare, and messages on those that were left out because a package is not installed."""
    from tuning.compare.tuners import MissingTunerError, find_tuner, tuner_rows

    tuners, left_out = {}, []
    for name in names or [row.name for row in tuner_rows().values() if slow or not row.slow]:
        try:
            tuners[name] = find_tuner(name, trials, dynamics)
        except MissingTunerError as error:
            if names:  # the user asked for it by name
                raise
            left_out.append(str(error))
    return tuners, left_out


def _compare(
    machines: Sequence[SuiteMachine],
    tuners: Mapping[str, Tuner],
    settings: Mapping[str, Any],
    folder: Path,
    resume: bool,
    workers: int | None,
    cluster: str | None,
) -> Comparison:
    """Compare tuners on machines; finished results of a run that is stopped are kept beside the folder."""
    import hashlib

    from tuning.compare.comparison import compare, so_far
    from tuning.compare.comparison_files import settings_text
    from tuning.compare.oracle import are_kept, find_oracles
    from tuning.runs import unfinished
    from tuning.runs.inputs import inputs_in
    from tuning.runs.pools import open_pool

    # The content of the machines is part of the settings, since the suite's file may change.
    known = {"machines": hashlib.sha256(repr(machines).encode()).hexdigest(), "steps": "a tuner on a machine"}
    run_text = settings_text({**settings, **known})
    with unfinished.shard_log(folder, run_text, resume=resume, inputs=inputs_in(settings)) as log:
        if log.done:
            steps = len(tuners) * len(machines)
            print(f"note: continues a stopped run; {len(log.done)} of {steps} steps are done", file=sys.stderr)
        with open_pool(workers, cluster) as pool:
            for line in pool.differences():
                print(f"note: {line}", file=sys.stderr)
            elsewhere = workers is not None or cluster is not None
            dynamics = settings["dynamics"]
            if not are_kept(dynamics):
                print(f"note: no oracles for {dynamics} dynamics are kept; they are searched first: 10 to 40 s for "
                      "each machine, longer for robots", file=sys.stderr)  # fmt: skip
            with progress_bar(f"oracles of {len(machines)} machines") as show:
                oracles = find_oracles(machines, progress=show, dynamics=dynamics)
            try:
                with progress_bar(f"{len(tuners)} tuners on {len(machines)} machines") as show:
                    return compare(
                        machines, tuners, seed=settings["seed"], log=log, progress=lambda what, share: show(share),
                        pool=pool if elsewhere else None, trials=settings["trials"], oracles=oracles, dynamics=dynamics,
                    )  # fmt: skip
            except KeyboardInterrupt:
                if (done := so_far(machines, list(tuners), log)) is not None:
                    print_lines([f"interrupted: of {len(machines)} machines these are done"])
                    _print_figures(done, dynamics)
                raise


def _report(comparison: Comparison, dynamics: str, folder: Path, left_out: list[str], json: bool) -> None:
    from dataclasses import asdict

    from tuning.compare.against_best import all_rivals

    if not json:
        _print(comparison, dynamics, folder, left_out)
        return
    rivals = [asdict(row) for row in all_rivals(comparison)]
    tuners = [asdict(row) for row in comparison.tuners]
    print_json({"dynamics": dynamics, "tuners": tuners, "rivals": rivals, "folder": str(folder)})


def _print(comparison: Comparison, dynamics: str, folder: Path, left_out: list[str]) -> None:
    _print_figures(comparison, dynamics)
    lines = [f"left out: {text}" for text in left_out]
    failures = {(row.tuner, row.note) for row in comparison.rows if row.failed}
    lines += [f"{tuner} failed: {note}" for tuner, note in sorted(failures)]
    lines.append(f"written to {folder}: tuners.csv, rivals.csv, machines.csv, comparison.png, settings.toml")
    print_lines(lines)


def _print_figures(comparison: Comparison, dynamics: str) -> None:
    """Print the table of tuners, and that of their costs by machine."""
    from tuning.compare.against_best import all_rivals

    machines = comparison.tuners[0].machines
    titles = ("median", "p95", "keep\nall", "near", "phase [°]\nmedian, 5 %", "gain\n[dB]", "Ms\nmedian, 95 %",
              "accepted,\nreserved", "time\n[s]", "violations", "gave\nup")  # fmt: skip
    rows = [
        (row.tuner, f"{row.median:.2f}", f"{row.p95:.2f}", _percent(row.kept), _percent(row.near),
         f"{_figure(row.phase_deg, 0)}, {_figure(row.phase_p5, 0)}", _figure(row.gain_db, 1),
         f"{_figure(row.ms, 2)}, {_figure(row.ms_p95, 1)}", f"{_percent(row.accepted)}, {_percent(row.reserved)}",
         f"{row.drive_seconds:.2f}", str(row.violations), str(row.failed))
        for row in comparison.tuners
    ]  # fmt: skip
    title = f"Robust performance over the constrained oracle's on {machines} machines, {dynamics} dynamics"
    print_table([Column("tuner", "name"), *map(Column, titles)], rows, title)
    lines = [
        "keep all: machines on which the gains keep every constraint (margins, variants, csp step, rest). near: true "
        "phase and gain margins are within 5° and 1 dB of those demanded. Margins: true ones of the worst outer loop.",
        "Ratios below 1 are of gains that break a constraint. Reserved: accepted with reservations. Time: median of a "
        "machine. Violations, gave up: sum.",
    ]
    for row in all_rivals(comparison):
        lines.append(
            f"{row.tuner}: robust cost {row.median:.3f} times that of the best other tuner on the same machine "
            f"(median, 95 % interval {row.low:.3f} to {row.high:.3f}), best on {row.better} of {row.machines} machines"
        )
    print_lines(lines)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _list() -> None:
    from tuning.compare.suite import load_suite, suite_names
    from tuning.compare.tuners import tuner_rows

    print_names(
        {
            "tuners": {row.name: row.meaning + (" (slow)" if row.slow else "") for row in tuner_rows().values()},
            "suites": {name: f"{len(load_suite(name))} machines" for name in suite_names()},
        }
    )
