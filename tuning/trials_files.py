"""The files of a search: every trial as a row, a picture of how it went, and the settings that repeat it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drive_env.gains import Gains
from tuning.optimise import COST, Optimised, Settings, objective_values
from tuning.toml_tables import toml
from tuning.trial_bench import OBJECTIVES

KEPT, STOPPED, FRONT = "#0072b2", "#d55e00", "black"
UNITS = {"speed": "ln t_s/t_0", "robustness": "ln J worst / J moves", "current": "ripple [% of rated]",
         COST: "ln J by measured terms"}  # fmt: skip


def save(found: Optimised, settings: Settings, folder: Path, versions: Mapping[str, str]) -> None:
    """Write trials.csv, trials.png and settings.toml into a folder that exists."""
    with (folder / "trials.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["search", "trial", "axis", *Gains._fields, "cost", *OBJECTIVES, "stopped"])
        for row in found.rows:
            figures = [f"{value:.6g}" for value in (row.cost, *row.objectives)]
            for axis, gains in enumerate(row.gains.tolist()):
                writer.writerow([row.search, row.number, axis, *gains, *figures, row.aborted])
    lines = []
    for name, value in (vars(settings) | {"journal": settings.journal and str(settings.journal)}).items():
        if isinstance(value, tuple):
            lines.append(f"{name} = [{', '.join(map(toml, value))}]")
        elif value is not None:
            lines.append(f"{name} = {str(value).lower() if isinstance(value, bool) else toml(value)}")
    lines += ["", "[versions]", *(f"{toml(name)} = {toml(value)}" for name, value in versions.items())]
    (folder / "settings.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    draw(found, settings, folder / "trials.png")


def draw(found: Optimised, settings: Settings, path: Path) -> None:
    """Draw the searches: cost by trial, or the first two objectives of every trial with the front."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = [row for row in found.rows if row.search == 0]
    stopped = np.array([row.aborted for row in rows])
    if len(settings.objectives) == 1:
        values = np.array([objective_values(row, settings.objectives)[0] for row in rows])
        number = np.array([row.number for row in rows])
        best = np.minimum.accumulate(np.where(stopped, np.inf, values))
        axes.step(number, np.where(np.isfinite(best), best, np.nan), where="post", color=FRONT, label="best so far")
        axes.set_xlabel("trial")
        axes.set_ylabel(f"{UNITS[settings.objectives[0]]}, less is better")
        x, y = number, values
    else:
        x, y = np.array([objective_values(row, settings.objectives)[:2] for row in rows]).T
        front = np.array([objective_values(row, settings.objectives)[:2] for row in found.front(settings.objectives)])
        if front.size:
            axes.plot(*front.T, color=FRONT, marker="o", markersize=9, fillstyle="none", linestyle="none",
                      label="beaten by none in every objective")  # fmt: skip
        axes.set_xlabel(f"{settings.objectives[0]}: {UNITS[settings.objectives[0]]}, less is better")
        axes.set_ylabel(f"{settings.objectives[1]}: {UNITS[settings.objectives[1]]}, less is better")
    axes.scatter(x[~stopped], y[~stopped], s=18, color=KEPT, label="trial")
    if stopped.any():
        axes.scatter(x[stopped], y[stopped], s=18, color=STOPPED, marker="x", label="stopped: it oscillated or tripped")
    axes.set_title(f"{settings.sampler}{', safe' if settings.safe else ''}, seed {settings.seed}", fontsize=10)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)
