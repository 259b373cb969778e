"""The report of a benchmark's rows: `results.json`, `results.md`, and learning curves of each task."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.benchmark.results import RESULT, TRAINED, Row
from agents.benchmark.statistics import ScoreEstimate, interquartile_mean, probability_of_improvement
from agents.training.learning_curve import COLORS
from agents.training.training_run import TABLE
from drive_env.envs.suite import TASKS
from drive_env.whole_file import write_picture, write_whole
from mechanics.arrays import Floats
from mechanics.reading.untrusted import read_rows as read_rows_of

TEXT, NUMBERS, CURVES = "results.md", "results.json", "learning_curves.png"
EXPERT, ALL = "expert", "all tasks"
POINTS = 100  # points of a curve


@dataclass(frozen=True)
class Standing:
    """A policy's row of the table.

    Attributes:
        task: Name of the task, or ALL.
        policy: Its name.
        kind: As in the rows.
        seeds: Number of trainings.
        score: Interquartile mean over seeds and episodes.
        mean: Mean of all scores, which includes rare failures outside the middle half.
        improvement: Probability that it is better than the expert in an episode; None for the expert.
        ended_early: Share of the episodes that a fall or a trip ended.
        steps: Steps of a training.
        cpu_minutes: CPU minutes of a training, mean over the seeds.
    """

    task: str
    policy: str
    kind: str
    seeds: int
    score: ScoreEstimate
    mean: float
    improvement: ScoreEstimate | None
    ended_early: float
    steps: int
    cpu_minutes: float


def read_rows(folder: Path) -> dict[str, dict[str, list[Row]]]:
    """Return a folder's rows of each task and policy, by seed.

    Raises:
        RowError: For a file that is not a row, or was changed.
        ValueError: If rows of a task are from different episodes.
    """
    found: dict[str, dict[str, list[Row]]] = {}
    for path in sorted(folder.glob(f"*/*/*/{RESULT}")):
        row = Row.load(path)
        found.setdefault(row.task, {}).setdefault(row.policy, []).append(row)
        first = next(iter(found[row.task].values()))[0]
        if row.seeds != first.seeds:
            raise ValueError(
                f"{path} has the episodes {row.seeds}, other rows of {row.task} {first.seeds}: they cannot be "
                "compared; remove either"
            )
    return {task: found[task] for task in TASKS if task in found}


def standings(rows: Mapping[str, Mapping[str, Sequence[Row]]]) -> list[Standing]:
    """Return the table: the policies of each task, best first, and those with results in all of several tasks."""
    table: list[Standing] = []
    for task, policies in rows.items():
        own = [_standing(task, {task: policies}, policy) for policy in policies]
        table += sorted(own, key=lambda row: -row.score.value)
    if len(rows) > 1:
        everywhere = set.intersection(*(set(policies) for policies in rows.values()))
        own = [_standing(ALL, rows, policy) for policy in sorted(everywhere)]
        table += sorted(own, key=lambda row: -row.score.value)
    return table


def _standing(name: str, rows: Mapping[str, Mapping[str, Sequence[Row]]], policy: str) -> Standing:
    own = [row for policies in rows.values() for row in policies[policy]]
    tables = [_scores(policies[policy]) for policies in rows.values()]
    improvement = None
    if policy != EXPERT and all(EXPERT in policies for policies in rows.values()):
        improvement = probability_of_improvement(tables, [_scores(policies[EXPERT])[0] for policies in rows.values()])
    return Standing(
        name, policy, own[0].kind, min(len(table) for table in tables), interquartile_mean(tables),
        float(np.mean([row.scores for row in own])), improvement,
        sum(row.ended_early for row in own) / sum(len(row.scores) for row in own), max(row.steps for row in own),
        float(np.mean([row.cpu_seconds["training"] for row in own])) / 60.0,
    )  # fmt: skip


def _scores(rows: Sequence[Row]) -> Floats:
    """Return the scores of a policy's rows, shape (seeds, episodes)."""
    return np.array([row.scores for row in rows])


def write_report(folder: Path) -> str:
    """Write results.json, results.md and the curves of the folder's rows, and return the text."""
    rows = read_rows(folder)
    table = standings(rows)
    for task, policies in rows.items():
        _draw(folder, task, policies)
    write_whole(folder / NUMBERS, json.dumps([_plain(row) for row in table], indent=1))
    text = _text(rows, table)
    write_whole(folder / TEXT, text)
    return text


def _plain(row: Standing) -> dict[str, Any]:
    improvement = None if row.improvement is None else row.improvement._asdict()
    return {**vars(row), "score": row.score._asdict(), "improvement": improvement}


def _text(rows: Mapping[str, Mapping[str, Sequence[Row]]], table: Sequence[Standing]) -> str:
    """Return the table as Markdown."""
    first = next(iter(next(iter(rows.values())).values()))[0]
    lines = [
        "# Benchmark",
        "",
        f"Score: the sum of rewards over the horizon, 0 to 1, in {len(first.scores)} held-out episodes (seeds "
        f"{first.seeds[0]} to {first.seeds[1]}). Interquartile mean over seeds and episodes, and the probability of "
        "being better than the expert in an episode, each with a 95 % bootstrap interval (Agarwal et al., 2021).",
        "",
        "| task | policy | seeds | score | mean | better than the expert | ended early | steps | CPU minutes |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in table:
        better = "" if row.improvement is None else _interval(row.improvement)
        trained = (f"{row.steps:,}", f"{row.cpu_minutes:.1f}") if row.kind == TRAINED else ("", "")
        lines.append(
            f"| {_short(row.task)} | {row.policy} | {row.seeds if row.kind == TRAINED else ''} "
            f"| {_interval(row.score)} | {row.mean:.3f} | {better} "
            f"| {row.ended_early:.0%} | {trained[0]} | {trained[1]} |"
        )
    made = sorted({f"drive-env {row.versions.get('drive-env')}, sources {row.versions.get('sources')}"
                   for policies in rows.values() for each in policies.values() for row in each})  # fmt: skip
    pictures = [
        f"![learning curves of {_short(task)}]({_short(task)}/{CURVES})" for task in rows if _curves(rows[task])
    ]
    return "\n".join([*lines, "", f"Made with {'; '.join(made)}.", *(f"\n{one}" for one in pictures), ""])


def _interval(found: ScoreEstimate) -> str:
    return f"{found.value:.3f} ({found.low:.3f} to {found.high:.3f})"


def _short(task: str) -> str:
    return task.rpartition("/")[2]


def _curves(policies: Mapping[str, Sequence[Row]]) -> list[str]:
    return [policy for policy, rows in policies.items() if rows[0].kind == TRAINED]


def _draw(folder: Path, task: str, policies: Mapping[str, Sequence[Row]]) -> None:
    """Draw a task's trainings, with 95 % intervals over seeds, and all held-out scores; nothing without a training."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    trained = _curves(policies)
    if not trained:
        return
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    colors = dict(zip(policies, COLORS * len(policies), strict=False))
    for policy in trained:
        curves = [_curve(folder / _short(task) / policy / str(row.seed) / TABLE, task) for row in policies[policy]]
        curves = [curve for curve in curves if len(curve)]
        if not curves:
            continue
        begin, end = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
        steps = np.linspace(begin, end, POINTS)
        values = np.array([np.interp(steps, curve[:, 0], curve[:, 1]) for curve in curves])
        middle = [interquartile_mean([column[:, None]]) for column in values.T]
        axes.fill_between(steps / 1e6, [one.low for one in middle], [one.high for one in middle],
                          color=colors[policy], alpha=0.2, linewidth=0)  # fmt: skip
        axes.plot(steps / 1e6, [one.value for one in middle], color=colors[policy], label=f"{policy}, training")
    for policy, rows in policies.items():
        value = interquartile_mean([_scores(rows)]).value
        style = ":" if policy in trained else "--"
        label = f"{policy}, held out: {value:.3f}"
        axes.axhline(value, color=colors[policy], linestyle=style, linewidth=1.0, label=label)
    axes.set_ylim(0.0, 1.0)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("steps of all environments together, millions")
    axes.set_ylabel("return of an episode, of the horizon")
    figure.suptitle(f"{task}\ntraining, with exploration: interquartile mean over seeds, 95 % interval", fontsize=10)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    write_picture(folder / _short(task) / CURVES, figure, 120)


def _curve(table: Path, task: str) -> Floats:
    """Return steps and return over the horizon, shape (rows, 2), of the rows of a training that have a return."""
    names, *rows = read_rows_of(table)
    step, total = names.index("timesteps"), names.index("return")
    points = [(float(row[step]), float(row[total] or "nan") / TASKS[task].steps) for row in rows]
    found = np.array([point for point in points if np.isfinite(point[1])])
    return found.reshape(-1, 2)
