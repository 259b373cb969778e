"""Pictures of a sweep: the score over the grid, and the best response."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator

from mechanics.arrays import Floats, Integers
from mechanics.loads import find_load
from tuning.runs import metrics
from tuning.runs.experiment import SweptObject
from tuning.runs.inputs import as_kept
from tuning.runs.metrics import MoveRecording

if TYPE_CHECKING:
    from tuning.runs.sweep import SweepResult

NO_FIGURE = "#f8ddc4"
# Why a point has no score, worst first: column of the table, colour, and name in the legend.
REASONS = (
    ("diverged", "#3a3a3a", "diverged"),
    ("fault", "#9a9a9a", "in fault"),
    ("oscillates", "#d8d8d8", "oscillating"),
)
BEST: dict[str, Any] = {
    "marker": "*",
    "markersize": 17,
    "markerfacecolor": "#e6194b",
    "markeredgecolor": "white",
    "linestyle": "none",
}
DPI = 150


def heat_map(result: SweepResult) -> Figure:
    """Draw the score over the grid: a line for one swept object, a map for two.

    With more objects the map is over the first two, and each cell shows the best over the others.
    """
    figure = Figure(figsize=(8.0, 6.0), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    if len(result.objects) == 1:
        _line(axes, result)
    else:
        _map(figure, axes, result)
    figure.suptitle(_title(result), fontsize=11)
    return figure


def best_response(result: SweepResult) -> Figure:
    """Draw set-point and velocity, current and load torque of the best point over time."""
    recording, excitation = result.response, result.experiment.excitation
    figure = Figure(figsize=(8.0, 7.0), dpi=DPI, layout="constrained")
    speed, current, load = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1))
    t = 1e3 * recording.t
    speed.plot(t, recording.speed_rpm[:, 0], color="#0072b2", linewidth=1.4, label="actual")
    speed.plot(t, recording.reference_rpm, color="black", linewidth=1.0, linestyle="--", label="set-point")
    speed.set_ylabel("velocity [rpm]")
    speed.legend(loc="lower right")
    if recording.lag is not None:
        current.plot(t, recording.lag[:, 0], color="#d55e00", linewidth=1.2)
        current.set_ylabel(f"{'load angle' if recording.is_open_loop else 'following error'} [full steps]")
    else:
        _draw_current(current, t, recording)
    torque = np.where(recording.t >= recording.t_load - 1e-9, excitation.load_torque, 0.0)
    load.plot(t, torque, color="#009e73", linewidth=1.4, drawstyle="steps-post")
    unit = find_load(result.experiment.load).disturbance_unit
    load.set_ylabel(f"load\n{'force' if unit == 'N' else 'torque'} [{unit.replace('*', '·')}]")
    load.set_xlabel("time [ms]")
    load.set_xlim(0.0, 1e3 * excitation.duration)
    load.margins(y=0.2)
    for axes in (speed, current, load):
        axes.grid(color="0.9")
        for event in (recording.t_step, recording.t_load):
            axes.axvline(1e3 * event, color="0.6", linewidth=0.8)
    figure.align_ylabels()
    figure.suptitle(_title(result), fontsize=11)
    return figure


def _draw_current(current: Axes, t: Floats, recording: MoveRecording) -> None:
    """Draw the measured current, and its limit if the current comes close to it."""
    current.plot(t, recording.current[:, 0], color="#d55e00", linewidth=1.2, label="actual current")
    limit = float(recording.current_limit[0])
    if np.abs(recording.current[:, 0]).max() > 0.7 * limit:
        for sign in (1.0, -1.0):
            current.axhline(sign * limit, color="black", linewidth=0.8, linestyle=":",
                            label="current limit" if sign > 0 else None)  # fmt: skip
        current.legend(loc="best")
    current.set_ylabel("current i_q [A]")


def _title(result: SweepResult) -> str:
    experiment, row = result.experiment, result.best(1)[0]
    metric = experiment.metric.name
    point = ", ".join(f"{name} = {row[name]}" for name in result.objects)
    others = [name for name in ("settling", "overshoot", "dip") if name != metric]
    values = [row[result.score_column], *(row[f"{name} [{metrics.unit_of(name)}]"] for name in others)]
    figures = ", ".join(
        f"{name} {_number(value, metrics.unit_of(name))}" for name, value in zip([metric, *others], values, strict=True)
    )
    first = "best" if np.isfinite(row[result.score_column]) else "no usable point; first"
    return (
        f"{as_kept(experiment.device)}, {as_kept(experiment.motor)}, {as_kept(experiment.load)}, "
        f"seed {experiment.seed}{f', the worst of {experiment.machines} machines' * (experiment.machines > 1)}: "
        f"{len(result.order)} points\n{first}: {point}\n{figures}"
    )


def _number(value: float, unit: str) -> str:
    if unit == "s" and np.isfinite(value):
        return f"{1e3 * value:.3g} ms"
    return f"{value:.3g} {unit}" if np.isfinite(value) else "none"


def _scale(result: SweepResult) -> tuple[float, str]:
    """Return factor and label of the score in pictures: seconds are shown as milliseconds."""
    name = result.experiment.metric.name
    unit = metrics.unit_of(name)
    return (1e3, f"{name} [ms]") if unit == "s" else (1.0, f"{name} [{unit}]")


def _line(axes: Axes, result: SweepResult) -> None:
    swept = result.experiment.sweep[0]
    factor, text = _scale(result)
    values, score, edges = swept.values(), factor * result.score, _edges(swept)
    valued = np.isfinite(score)
    reasons, colours = _reasons(result), _colours()
    for k in np.flatnonzero(~valued):
        axes.axvspan(edges[k], edges[k + 1], color=colours[reasons[k]], linewidth=0, zorder=0)
    axes.plot(values, np.where(valued, score, np.nan), color="#0072b2", marker="o", markersize=4)
    axes.set_xscale("log" if swept.spacing == "log" else "linear")
    axes.set_xlim(edges[0], edges[-1])
    _label(axes.xaxis, f"{result.names[0]} [raw]", swept.spacing == "log")
    wide = _wide(score[valued])
    axes.set_yscale("log" if wide else "linear")
    _label(axes.yaxis, f"{text}, less is better", wide)
    if valued.any():
        axes.plot(values[result.order[0]], score[result.order[0]], **BEST)
    else:
        axes.set_yticks([])
    axes.grid(color="0.9")
    _legend(axes, result)


def _map(figure: Figure, axes: Axes, result: SweepResult) -> None:
    first, second = result.experiment.sweep[:2]
    factor, text = _scale(result)
    shape = result.experiment.shape()
    # The best over the other objects; a cell has no score if all its points have none.
    score = factor * result.score.reshape(*shape[:2], -1).min(axis=2)
    valued = np.isfinite(score)
    x, y = _edges(first), _edges(second)
    axes.set_xscale("log" if first.spacing == "log" else "linear")
    axes.set_yscale("log" if second.spacing == "log" else "linear")
    colours = _colours()
    reasons = _reasons(result).reshape(*shape[:2], -1).min(axis=2)
    axes.pcolormesh(x, y, reasons.T, cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5)
    if valued.any():
        low, high = float(score[valued].min()), float(score[valued].max())
        wide = _wide(score[valued])
        norm = LogNorm(low, high) if wide else Normalize(low, max(high, low + 1e-12))
        mesh = axes.pcolormesh(x, y, np.ma.masked_where(~valued, score).T, norm=norm, cmap=colormaps["viridis_r"])
        bar = figure.colorbar(mesh, ax=axes)
        _label(bar.ax.yaxis, f"{text}, less is better", wide)
        best = np.unravel_index(int(result.order[0]), shape)
        axes.plot(first.values()[best[0]], second.values()[best[1]], **BEST)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    _label(axes.xaxis, f"{result.names[0]} [raw]", first.spacing == "log")
    _label(axes.yaxis, f"{result.names[1]} [raw]", second.spacing == "log")
    if len(shape) > 2:
        axes.set_title(f"each cell: the best over {', '.join(result.objects[2:])}", fontsize=10)
    _legend(axes, result)


def _legend(axes: Axes, result: SweepResult) -> None:
    handles: list[Any] = []
    if np.isfinite(result.score).any():
        handles.append(Line2D([], [], **BEST, label="best"))
    steps = " or steps lost" if result.response.is_open_loop else ""
    names = [f"no {result.experiment.metric.name}", *(name for *_, name in reversed(REASONS))]
    without = _reasons(result)[~np.isfinite(result.score)]
    for number, (colour, name) in enumerate(zip(_colours(), names, strict=True)):
        if count := int((without == number).sum()):
            text = f"{name}{steps if name == 'in fault' else ''} ({count} points)"
            handles.append(Patch(facecolor=colour, edgecolor="0.6", label=text))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)


def _colours() -> list[str]:
    """Return the colours of points without a score, by the numbers of `_reasons`."""
    return [NO_FIGURE, *(colour for _, colour, _ in reversed(REASONS))]


def _reasons(result: SweepResult) -> Integers:
    """Return why each point has no score, shape (points,): 0 for a missing metric, higher for worse failures."""
    reasons = np.zeros(len(result.order), np.int64)
    for number, (flag, _, _) in enumerate(reversed(REASONS), 1):
        reasons[result.columns[flag]] = number
    return reasons


def _label(axis: Any, text: str, log: bool) -> None:
    """Label an axis; ticks of a logarithmic one are at 1, 2 and 5."""
    axis.set_label_text(text)
    if log:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")


def _edges(swept: SweptObject) -> Floats:
    """Return the edges of the cells around the values, in the middle between neighbours on the axis' scale."""
    values = swept.values().astype(float)
    on_scale = np.log(values) if swept.spacing == "log" else values
    if len(values) == 1:
        half = 0.5
        edges = np.array([on_scale[0] - half, on_scale[0] + half])
    else:
        middle = 0.5 * (on_scale[1:] + on_scale[:-1])
        edges = np.concatenate(([2 * on_scale[0] - middle[0]], middle, [2 * on_scale[-1] - middle[-1]]))
    return np.exp(edges) if swept.spacing == "log" else edges


def _wide(score: Floats) -> bool:
    return bool(score.size and score.min() > 0.0 and score.max() > 5.0 * score.min())
