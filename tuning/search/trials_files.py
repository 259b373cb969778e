"""The files of a search: all trials as rows, a picture of its progress, and the settings that repeat it."""

from __future__ import annotations

import csv
import io
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.devices import find_device
from drive_env.whole_file import write_picture, write_whole
from mechanics.reading.untrusted import read_toml
from tuning.runs.inputs import Input, as_kept, found_again, inputs_in, table_of, write_inputs
from tuning.search.optimise import COST, Optimised, Settings, TrialRow, pareto
from tuning.search.trial_bench import OBJECTIVES
from tuning.toml_tables import check_keys, toml

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT, STOPPED, FRAGILE, FRONT = "#0072b2", "#d55e00", "#cc79a7", "black"
# Titles of the objectives; smaller is better. The search itself uses logarithms of the first three.
TITLES = {COST: "J", "speed": "settles [ms]", "robustness": "worst J over J", "current": "ripple [%]"}
MEANINGS = {
    COST: "J by measured terms",
    "speed": "settling time, the slower of move and reversal [ms]",
    "robustness": "J of the worst phase over that of the moves",
    "current": "ripple of the current [% of rated]",
}

# Of an open loop, whose drives measure no current: J lacks two terms, and the current is the set one.
OPEN_LOOP_TITLES = TITLES | {"current": "current [%]"}
OPEN_LOOP_MEANINGS = MEANINGS | {
    COST: "J by measured terms, without load step and ripple of the current",
    "current": "RMS of the currents that are set [% of rated]",
}

# Of a stepper's position PID, which does not commutate: no torque current is measured; the encoder's vibration counts.
PID_TITLES = TITLES | {"current": "vibration [%]"}
PID_MEANINGS = MEANINGS | {
    COST: "J by measured terms, without load step and ripple of the current",
    "current": "vibration of the encoder, as J counts a ripple of so much [%]",
}

HEADER = "# All settings of the search. To repeat it: drive-tune auto --config settings.toml\n"
_SEARCH = ("sampler", "trials", "objectives", "gains", "width", "safe", "seed", "dynamics", "inertia_range")
_MACHINE = ("device", "motor", "load", "supply", "travel", "axis", "machines", "searches", "interface", "channel",
            "nodes", "bitrate", "lockstep", "pace")  # fmt: skip


def save(
    found: Optimised, settings: Settings, folder: Path, machine: Mapping[str, Any], versions: Mapping[str, str]
) -> None:
    """Write trials.csv, trials.png, settings.toml and inputs/ into an existing folder.

    Args:
        found: Result of the search.
        settings: Settings of the search.
        folder: The folder.
        machine: The searched machine as options of the command, by the names of `load_options`.
        versions: Versions of the packages used.

    Raises:
        OSError: If a file cannot be written, with its name and the reason.
    """
    table = io.StringIO()
    writer = csv.writer(table)
    told = titles(machine["device"], settings.gains)
    names, known = (COST, *OBJECTIVES), find_device(machine["device"]).gains.names
    figures_told = (told[name] for name in names)
    writer.writerow(["search", "trial", "axis", *known, *figures_told, "stopped", "fragile", "cause", "slack"])
    for row in found.rows:
        values = [f"{value:.6g}" for value in figures(row, names, found.t_0)]
        for axis, gains in zip(axis_numbers(machine, len(row.gains)), row.gains.tolist(), strict=True):
            writer.writerow([row.search, row.number, axis, *gains, *values, row.aborted, row.fragile, row.cause,
                             "" if math.isinf(row.slack) else f"{row.slack:.4g}"])  # fmt: skip
    write_whole(folder / "trials.csv", table.getvalue())
    lines = _lines({name: getattr(settings, name) for name in _SEARCH})
    if settings.journal is not None:
        lines.append(f"# journal: {settings.journal}")
    lines += ["", "[machine]", *_lines(as_kept(machine))]
    lines += table_of(inputs := inputs_in(machine))
    write_inputs(folder, inputs)
    lines += ["", "[versions]", *(f"{toml(name)} = {toml(value)}" for name, value in versions.items())]
    write_whole(folder / "settings.toml", HEADER + "\n".join(lines) + "\n")
    write_picture(folder / "trials.png", trials_figure(found, settings, machine["device"]), 120)


def titles(device: str, gains: tuple[str, ...] | None) -> dict[str, str]:
    """Return the title of each objective for gains of a device."""
    if is_tried_open(device, gains):
        return OPEN_LOOP_TITLES
    return PID_TITLES if is_tried_by_pid(device, gains) else TITLES


def is_tried_open(device: str, gains: tuple[str, ...] | None) -> bool:
    """Return whether gains of a device are tried in open loop: those of a stepper except its closed loop's."""
    known = find_device(device)
    return known.gains.is_open_loop and known.gains.loop_of(gains or ()) is None


def is_tried_by_pid(device: str, gains: tuple[str, ...] | None) -> bool:
    """Return whether gains of a device belong to a stepper's position PID, which measures no torque current."""
    loop = find_device(device).gains.loop_of(gains or ())
    return loop is not None and loop.is_pid


def figures(row: TrialRow, objectives: Sequence[str], t_0: float) -> list[float]:
    """Convert a trial's objectives to the units of `TITLES`; `t_0` is that of the search [s]."""
    scales = {COST: 1.0, "speed": 1e3 * t_0, "robustness": 1.0}
    told = dict(zip((COST, *OBJECTIVES), (row.cost, *row.objectives), strict=True))
    return [scales[name] * math.exp(told[name]) if name in scales else told[name] for name in objectives]


def load_options(path: str | Path) -> dict[str, Any]:
    """Read the options of `drive-tune auto` that repeat a search from its settings.toml.

    --bus is not among them: the user must give it again before a motor turns.

    Raises:
        ValueError: If the file cannot be read, or is not of a search.
    """
    try:
        table = read_toml(path)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; give settings.toml of drive-tune auto") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is not TOML: {error}; give settings.toml of drive-tune auto") from None
    if "machine" not in table:
        raise ValueError(f"{path} is not from a search; give settings.toml of drive-tune auto")
    check_keys(str(path), table, [*_SEARCH, "machine", "inputs", "versions"], optional=["inputs", "versions", *_SEARCH])
    machine = dict(table["machine"]) if isinstance(table["machine"], dict) else {}
    for before in ("lanes", "copies"):  # names in versions before 0.2
        if before in machine:
            machine["machines"] = machine.pop(before)
    check_keys(f"{path}: machine", machine, list(_MACHINE), optional=_MACHINE)
    machine.pop("pace", None)  # `lockstep` has the same information
    kept = found_again(machine, table.get("inputs"), Path(path).parent)
    machine = {name: value.given if isinstance(value, Input) else value for name, value in kept.items()}
    settings = {name: table[name] for name in _SEARCH if name in table}
    return {"by" if name == "sampler" else name: value for name, value in settings.items()} | machine


def axis_numbers(machine: Mapping[str, Any], count: int) -> list[int]:
    """Return the numbers of a search's axes in results: of chosen axes those among all axes of the nodes."""
    from drive_env.devices import find_device

    parts = machine.get("axis")
    if not parts:
        return list(range(count))
    total = find_device(machine["device"]).num_axes
    return [k // len(parts) * total + parts[k % len(parts)] for k in range(count)]


def _lines(values: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {toml(value)}" for name, value in values.items() if value is not None]


def trials_figure(found: Optimised, settings: Settings, device: str) -> Figure:
    """Draw the searches: cost by trial, or the first two objectives of every trial with the Pareto front."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    is_open_loop = is_tried_open(device, settings.gains)
    meanings = PID_MEANINGS if is_tried_by_pid(device, settings.gains) else MEANINGS
    meanings = OPEN_LOOP_MEANINGS if is_open_loop else meanings
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows, names = list(found.rows), settings.objectives
    searches = [[row for row in rows if row.search == k] for k in sorted({row.search for row in rows})]
    values = np.array([figures(row, names[:2], found.t_0) for row in rows])
    if len(names) == 1:
        for k, own in enumerate(searches):
            label = "best accepted so far" + (", of each search" if len(searches) > 1 else "")
            cost = [value for row in own for value in figures(row, names, found.t_0)]
            _draw_best(axes, own, cost, label if k == 0 else None)
        axes.set_xlabel("trial")
        x, y = np.array([row.number for row in rows]), values.ravel()
        _scale(axes.yaxis, axes.set_yscale, *names)
    else:
        x, y = values.T
        front = [figures(row, names[:2], found.t_0) for row in pareto([row for row in rows if row.accepted], names)]
        if front:
            axes.plot(*np.array(front).T, color=FRONT, marker="o", markersize=9, fillstyle="none", linestyle="none",
                      label="accepted, on the Pareto front")  # fmt: skip
        axes.set_xlabel(meanings[names[0]])
        _scale(axes.xaxis, axes.set_xscale, names[0])
        _scale(axes.yaxis, axes.set_yscale, names[1])
    axes.set_ylabel(meanings[names[:2][-1]])
    stopped, fragile = (np.array([getattr(row, name) for row in rows]) for name in ("aborted", "fragile"))
    for where, color, marker, label in (
        (~stopped & ~fragile, KEPT, "o", "trial"),
        (stopped, STOPPED, "x", f"stopped: it {'lost steps' if is_open_loop else 'oscillated'} or went into fault"),
        (fragile & ~stopped, FRAGILE, "s", "not kept: it did not stop oscillating after a disturbance"),
    ):
        if where.any():
            axes.scatter(x[where], y[where], s=18, color=color, marker=marker, label=label)
    several = f", {len(searches)} searches" if len(searches) > 1 else ""
    title = f"{settings.sampler}{', safe' if settings.safe else ''}, seed {settings.seed}{several}; less is better"
    axes.set_title(title, fontsize=10)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(fontsize=8)
    return figure


def _scale(axis: Any, set_scale: Any, name: str) -> None:
    """Scale an axis of a picture: ratios logarithmically, with plain numbers at the ticks."""
    if name == "current":
        return
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _draw_best(axes: Any, rows: list[TrialRow], values: list[float], label: str | None) -> None:
    """Draw the best accepted trial so far of a search, by trials."""
    least, best, shown = math.inf, [], math.nan
    for row, value in zip(rows, values, strict=True):
        if row.accepted and row.robust_cost < least:
            least, shown = row.robust_cost, value
        best.append(shown)
    axes.step([row.number for row in rows], best, where="post", color=FRONT,
              linewidth=1.2, alpha=0.8, label=label)  # fmt: skip
