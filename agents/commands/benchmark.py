"""`drive-agent benchmark`: agents of several seeds, or a submitted policy, against baselines on tasks of the suite."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agents.commands.options import (
    INTERRUPTED,
    REFUSED,
    Cluster,
    Out,
    Steps,
    Trust,
    Workers,
    elsewhere,
    errors_as_exit_codes,
    fail,
    new_folder,
    progress_bar,
)
from agents.commands.train import given_options
from tuning.commands.options import Resume

if TYPE_CHECKING:
    from agents.benchmark.results import Row
    from agents.benchmark.runs import BenchmarkRun

AGAIN = "continue with --resume and the same --out"


def benchmark(
    context: typer.Context,
    task: Annotated[
        list[str] | None, typer.Option("--task", help="Task of the suite; may be repeated.", show_default="all of them")
    ] = None,
    algorithm: Annotated[
        list[str] | None,
        typer.Option("--algorithm", "-a", help="What trains agents; may be repeated.", show_default="ppo"),
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", help="Trainings of each algorithm on each task.")] = 5,
    steps: Steps = None,
    submit: Annotated[
        str | None,
        typer.Option("--submit", help="Judge this policy on --task: a file (as evaluate takes it) or module:function."),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Run the episodes of a row (result.json) again, and say whether it holds."),
    ] = None,
    out: Out = None,
    resume: Resume = False,
    workers: Workers = None,
    cluster: Cluster = None,
    trust: Trust = False,
) -> None:
    """Train agents on tasks of the suite and judge them, beside the baselines, in the same held-out episodes.

    Writes results.md and results.json (interquartile mean and probability of improvement over the expert, each with its
    95 % interval; CPU minutes), a folder for each run, and learning curves for each task. What --submit judges becomes
    a row of the table, which --check proves.
    """
    with errors_as_exit_codes():
        from agents.benchmark.report import write_report
        from agents.benchmark.runs import make

        if check is not None:
            _check(context, check, trust)
            return
        if resume and out is None:
            raise ValueError("--resume continues the benchmark in a folder; give it with --out")
        if submit is None:
            runs = _trainings(task, algorithm or ["ppo"], seeds, steps, trust)
        else:
            runs = _submission(context, task, submit, trust)
        folder = out if resume and out is not None else new_folder(out, "benchmark")

        def tell(run: BenchmarkRun, row: Row) -> None:
            mean = sum(row.scores) / len(row.scores)
            print(f"{run.folder}: {mean:.3f} in {len(row.scores)} episodes, mean", file=sys.stderr, flush=True)

        try:
            with elsewhere(workers, cluster, AGAIN) as pool, progress_bar(f"{len(runs)} runs") as share:
                make(runs, folder, pool=pool, told=tell, share=share)
        except KeyboardInterrupt:
            fail(f"interrupted; the runs that are complete are in {folder}: {AGAIN}", INTERRUPTED)
        print(write_report(folder), end="")
        print(f"written to {folder}")


def _trainings(
    tasks: list[str] | None, algorithms: list[str], seeds: int, steps: int | None, trust: bool
) -> list[BenchmarkRun]:
    from agents.benchmark.results import TRAINED
    from agents.benchmark.runs import BenchmarkRun, baseline_runs, suite_task
    from agents.training import hyperparameters
    from drive_env.envs.suite import TASKS

    if trust:
        raise ValueError("--trust is for --submit and --check, since a training loads nothing; leave it out")
    for name, value in (("--seeds", seeds), ("--steps", steps)):
        if value is not None and value < 1:
            raise ValueError(f"{name} {value} must be 1 or more")
    runs: list[BenchmarkRun] = []
    for task in dict.fromkeys(map(suite_task, tasks or TASKS)):
        runs += baseline_runs(task)
        for algorithm in dict.fromkeys(algorithms):
            given = hyperparameters.load(task, algorithm)
            if steps is not None:
                given["n_timesteps"] = steps
            runs += [BenchmarkRun(task, algorithm, TRAINED, seed, given) for seed in range(seeds)]
    return runs


def _submission(context: typer.Context, tasks: list[str] | None, submit: str, trust: bool) -> list[BenchmarkRun]:
    """Return the runs of baselines and of a submitted policy."""
    from agents.benchmark.runs import baseline_runs, submitted_run, suite_task

    _check_alone(context, "--submit", ("--algorithm", "--seeds", "--steps"))
    if not tasks or len(tasks) != 1:
        raise ValueError("--submit judges a policy on one task; give --task once")
    task = suite_task(tasks[0])
    return [*baseline_runs(task), submitted_run(task, submit, trust)]


def _check(context: typer.Context, path: Path, trust: bool) -> None:
    """Print whether running a row's episodes again confirms its scores; exit code 1 if it does not."""
    from agents.benchmark.runs import check

    others = ("--task", "--algorithm", "--seeds", "--steps", "--submit", "--out", "--resume", "--workers", "--cluster")
    _check_alone(context, "--check", others)
    found = check(path, trust=trust)
    print(f"{path} {'holds' if found.holds else 'does not hold'}: {found.says}")
    print("This proves that the policy has these scores, not who made either.")
    if not found.holds:
        raise typer.Exit(REFUSED)


def _check_alone(context: typer.Context, name: str, others: tuple[str, ...]) -> None:
    """Raise ValueError if the user gave one of the options `others`: with option `name` these have no effect."""
    given = [one for one in given_options(context) if one in others]
    if given:
        raise ValueError(f"{name} takes no {', '.join(given)}; leave it out")
