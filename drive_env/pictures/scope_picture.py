"""The scope beside the machine: position, velocity and current of a recording, drawn once and shown up to a time.

Drawing with matplotlib takes a tenth of a second; copying the columns of the finished picture up to a time takes less
than a thousandth of that, so that a film needs one drawing only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from mechanics.arrays import Floats, Image

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from drive_env.pictures.recording import Recording


MAX_AXES = 6  # traces that can still be told apart
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
DEMAND = "0.45"
LOAD = "#fdebd3"
CURSOR = (200, 30, 30)
DOTS_PER_INCH = 100
ANGLE_STEPS = [1, 1.5, 3, 4.5, 6, 9, 10]  # ticks at 45°, 90°, 180° where they fit
RPM = 30.0 / math.pi


class Panel(NamedTuple):
    """One diagram of the scope: title, unit, demand and actual values in that unit, each of shape (n, A)."""

    name: str
    unit: str
    demand: Floats
    actual: Floats


def panels(recording: Recording) -> list[Panel]:
    """Return the scope's panels; positions as the load's axes have them."""
    if all(recording.linear):
        factor, unit = 1e3 / recording.gears, "mm"
    elif not any(recording.linear):
        factor, unit = 180.0 / math.pi / recording.gears, "°"
    else:
        factor, unit = np.full(len(recording.linear), 0.5 / math.pi), "turns"
    return [
        Panel("position", unit, recording.position_demand * factor, recording.position * factor),
        Panel("velocity", "rpm", recording.velocity_demand * RPM, recording.velocity * RPM),
        Panel("current", "A", recording.current_demand, recording.current)
        if recording.lag is None
        else Panel("lag", "full steps", np.full_like(recording.lag, np.nan), recording.lag),
    ]


class ScopePicture:
    """The scope of a recording, drawn once with all traces and once without: `until` combines both at a time.

    Args:
        recording: The run.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        scale: Of text and lines; 1 suits 480 pixels.
    """

    def __init__(self, recording: Recording, width: int = 480, height: int = 480, scale: float = 1.0) -> None:
        dots = DOTS_PER_INCH * scale
        figure = Figure(figsize=(width / dots, height / dots), dpi=dots)
        canvas = FigureCanvasAgg(figure)
        rows = figure.subplots(3, 1, sharex=True)
        shown = min(len(recording.linear), MAX_AXES)
        hidden: list[Artist] = []
        for axes, panel in zip(rows, panels(recording), strict=True):
            hidden += _draw_panel(axes, recording.t, panel, shown)
            hidden += [axes.axvline(t, color="0.55", linewidth=0.8, linestyle=":") for t, _ in recording.events[1:]]
            hidden += _shade_load(axes, recording)
        rows[-1].set_xlabel("time [s]")
        rows[0].set_xlim(0.0, float(recording.t[-1]) or 1.0)
        figure.align_ylabels()
        _legend(rows[0], shown, len(recording.linear), bool(recording.load_torque.any()))
        figure.subplots_adjust(left=84 * scale / width, right=1.0 - 16 * scale / width, bottom=46 * scale / height,
                               top=1.0 - 34 * scale / height, hspace=0.12)  # fmt: skip
        self._full = _pixels(canvas)
        for artist in hidden:
            artist.set_visible(False)
        self._empty = _pixels(canvas)
        box = rows[0].get_window_extent()
        self._left, self._right = box.x0, box.x1
        self._rows = [
            slice(round(height - b.y1), round(height - b.y0)) for b in (axes.get_window_extent() for axes in rows)
        ]
        self._last = rows[0].get_xlim()[1]

    def until(self, t: float) -> Image:
        """Return the scope with the traces up to t [s], uint8 of shape (height, width, 3)."""
        share = min(max(t / self._last, 0.0), 1.0)
        column = round(self._left + share * (self._right - self._left))
        image = self._empty.copy()
        image[:, : column + 1] = self._full[:, : column + 1]
        for rows in self._rows:
            image[rows, max(column, 0)] = CURSOR
        return image


def _draw_panel(axes: Axes, t: Floats, panel: Panel, shown: int) -> list[Line2D]:
    """Draw the traces of a panel and return them."""
    lines: list[Line2D] = []
    single = shown == 1
    for axis in range(shown):
        demand = panel.demand[:, axis]
        if np.isfinite(demand).any():
            color = DEMAND if single else COLORS[axis]
            lines += axes.plot(t, demand, color=color, linewidth=1.1, linestyle="--", alpha=0.9)
        lines += axes.plot(t, panel.actual[:, axis], color=COLORS[axis], linewidth=1.3)
    axes.margins(y=0.08)
    axes.set_ylabel(f"{panel.name} [{panel.unit}]", fontsize=9)
    steps = ANGLE_STEPS if panel.unit == "°" else None
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=steps))
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.label_outer()
    return lines


def _shade_load(axes: Axes, recording: Recording) -> list[Artist]:
    """Shade the times with a load torque."""
    pushes = np.diff((recording.load_torque != 0.0).astype(int), prepend=0, append=0)
    times = np.append(recording.t, recording.t[-1])
    starts, ends = times[np.flatnonzero(pushes > 0)], times[np.flatnonzero(pushes < 0)]
    return [axes.axvspan(a, b, color=LOAD, linewidth=0, zorder=0) for a, b in zip(starts, ends, strict=True)]


def _legend(axes: Axes, shown: int, total: int, with_load: bool) -> None:
    handles: list[Artist]
    if shown == 1:
        handles = [Line2D([], [], color=DEMAND, linestyle="--", label="demand"),
                   Line2D([], [], color=COLORS[0], label="actual")]  # fmt: skip
    else:
        more = f" of {total}" if total > shown else ""
        handles = [Line2D([], [], color=COLORS[k], label=str(k)) for k in range(shown)]
        handles[0].set_label(f"axis 0{more}")
        handles.append(Line2D([], [], color=DEMAND, linestyle="--", label="demand"))
    if with_load:
        handles.append(Patch(facecolor=LOAD, label="load pushes"))
    narrow = len(handles) > 4  # of the usual width they would not fit
    axes.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        borderaxespad=0.2,
        handlelength=1.0 if narrow else 1.4,
        columnspacing=0.6 if narrow else 0.9,
    )


def _pixels(canvas: FigureCanvasAgg) -> Image:
    drawn: Any = canvas  # its methods have no types
    drawn.draw()
    return np.array(drawn.buffer_rgba(), np.uint8)[:, :, :3]
