"""The files of a search: every trial as a row, a picture of how it went, and the settings that repeat it."""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.gains import Gains
from drive_env.whole_file import write_whole
from mechanics.untrusted import read_toml
from tuning.optimise import COST, Optimised, Row, Settings, objective_values, pareto
from tuning.toml_tables import check_keys, toml
from tuning.trial_bench import OBJECTIVES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT, STOPPED, FRONT = "#0072b2", "#d55e00", "black"
UNITS = {"speed": "ln t_s/t_0", "robustness": "ln J worst / J moves", "current": "ripple [% of rated]",
         COST: "ln J by measured terms"}  # fmt: skip


HEADER = "# The whole search. It repeats from this file: drive-tune optimise --config settings.toml\n"
_SEARCH = ("sampler", "trials", "objectives", "gains", "width", "safe", "seed")
_MACHINE = ("device", "motor", "load", "supply", "travel", "lanes", "searches", "interface", "channel", "nodes",
            "bitrate", "lockstep", "pace")  # fmt: skip


def save(
    found: Optimised, settings: Settings, folder: Path, machine: Mapping[str, Any], versions: Mapping[str, str]
) -> None:
    """Write trials.csv, trials.png and settings.toml into a folder that exists.

    Args:
        found: What was found.
        settings: How it was searched.
        folder: Where to write.
        machine: What was searched: options of the command, by the names of `load_options`.
        versions: What computed it.

    Raises:
        OSError: If one cannot be written, with its name and the reason.
    """
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(["search", "trial", "axis", *Gains._fields, "cost", *OBJECTIVES, "stopped"])
    for row in found.rows:
        figures = [f"{value:.6g}" for value in (row.cost, *row.objectives)]
        for axis, gains in enumerate(row.gains.tolist()):
            writer.writerow([row.search, row.number, axis, *gains, *figures, row.aborted])
    write_whole(folder / "trials.csv", table.getvalue())
    lines = _lines({name: getattr(settings, name) for name in _SEARCH})
    if settings.journal is not None:
        lines.append(f"# journal: {settings.journal}")
    lines += ["", "[machine]", *_lines(machine)]
    lines += ["", "[versions]", *(f"{toml(name)} = {toml(value)}" for name, value in versions.items())]
    write_whole(folder / "settings.toml", HEADER + "\n".join(lines) + "\n")
    picture = io.BytesIO()
    trials_figure(found, settings).savefig(picture, dpi=120)
    write_whole(folder / "trials.png", picture.getvalue())


def load_options(path: str | Path) -> dict[str, Any]:
    """Return the options of `drive-tune optimise` by which a search repeats, from its settings.toml.

    Whether the drives are on a bus is not among them: a motor turns only if --bus is said again.

    Raises:
        ValueError: If the file cannot be read, or is not of a search.
    """
    try:
        table = read_toml(path)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; give settings.toml of drive-tune optimise") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is no TOML: {error}; give settings.toml of drive-tune optimise") from None
    if "machine" not in table:
        raise ValueError(f"{path} is of no search; give settings.toml of drive-tune optimise")
    check_keys(str(path), table, [*_SEARCH, "machine", "versions"], optional=["versions", *_SEARCH])
    machine = dict(table["machine"]) if isinstance(table["machine"], dict) else {}
    check_keys(f"{path}: machine", machine, list(_MACHINE), optional=_MACHINE)
    machine.pop("pace", None)  # what lockstep says
    return {name: table[name] for name in _SEARCH if name in table} | machine


def _lines(values: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_text(value)}" for name, value in values.items() if value is not None]


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(toml, value))}]" if isinstance(value, tuple | list) else toml(value)


def trials_figure(found: Optimised, settings: Settings) -> Figure:
    """Return the searches as a picture: cost by trial, or the first two objectives of every trial with the front."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = list(found.rows)
    searches = [[row for row in rows if row.search == k] for k in sorted({row.search for row in rows})]
    stopped = np.array([row.aborted for row in rows])
    if len(settings.objectives) == 1:
        for k, own in enumerate(searches):
            _draw_best(axes, own, settings, "best so far" + (", of each search" if len(searches) > 1 else ""), k == 0)
        axes.set_xlabel("trial")
        axes.set_ylabel(f"{UNITS[settings.objectives[0]]}, less is better")
        x = np.array([row.number for row in rows])
        y = np.array([objective_values(row, settings.objectives)[0] for row in rows])
    else:
        x, y = np.array([objective_values(row, settings.objectives)[:2] for row in rows]).T
        kept = [row for row in rows if not row.aborted]
        best = np.array([objective_values(row, settings.objectives)[:2] for row in pareto(kept, settings.objectives)])
        if best.size:
            axes.plot(*best.T, color=FRONT, marker="o", markersize=9, fillstyle="none", linestyle="none",
                      label="beaten by none in every objective")  # fmt: skip
        axes.set_xlabel(f"{settings.objectives[0]}: {UNITS[settings.objectives[0]]}, less is better")
        axes.set_ylabel(f"{settings.objectives[1]}: {UNITS[settings.objectives[1]]}, less is better")
    axes.scatter(x[~stopped], y[~stopped], s=18, color=KEPT, label="trial")
    if stopped.any():
        axes.scatter(x[stopped], y[stopped], s=18, color=STOPPED, marker="x", label="stopped: it oscillated or tripped")
    several = f", {len(searches)} searches" if len(searches) > 1 else ""
    title = f"{settings.sampler}{', safe' if settings.safe else ''}, seed {settings.seed}{several}"
    axes.set_title(title, fontsize=10)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(fontsize=8)
    return figure


def _draw_best(axes: Any, rows: list[Row], settings: Settings, label: str, named: bool) -> None:
    """Draw what a search had found by each of its trials."""
    value = [np.inf if row.aborted else objective_values(row, settings.objectives)[0] for row in rows]
    best = np.minimum.accumulate(value)
    axes.step([row.number for row in rows], np.where(np.isfinite(best), best, np.nan), where="post", color=FRONT,
              linewidth=1.2, alpha=0.8, label=label if named else None)  # fmt: skip
