"""Charts of the studio: lines over a linear or logarithmic axis, drawn by the ECharts library in NiceGUI.

They are drawn as SVG, so that the style sheet sets the colours of texts and lines in light and dark mode. Lines have
different dashes in addition to colours, which are Okabe and Ito's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import ui
from numpy.typing import ArrayLike

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6100", "#7f7f7f")
DASHES: tuple[str | list[int], ...] = ("solid", [8, 4], [3, 3], [10, 3, 3, 3], [1, 3], [14, 4])
# Grid lines, visible on white and on black.
SPLIT = {"show": True, "lineStyle": {"color": "#8a97a3", "opacity": 0.3}}
AXIS = {"lineStyle": {"color": "#8a97a3"}}
MOST_POINTS = 800  # of a line; more are not visible


@dataclass(frozen=True)
class ChartLine:
    """A line: name, x and y of shape (n,), panel from the top, numbers of colour and dashes, width [pixels].

    `fill` colours the area between it and 0.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    panel: int = 0
    colour: int = 0
    dashes: int = 0
    width: float = 2.0
    faint: bool = False
    fill: bool = False


@dataclass(frozen=True)
class ChartPanel:
    """A panel: title with unit of its y axis, and its fixed ends, None for automatic ones."""

    title: str
    low: float | None = None
    high: float | None = None


def options(
    panels: Sequence[ChartPanel],
    x_title: str,
    lines: Sequence[ChartLine],
    *,
    logarithmic: bool = False,
    hint: str = "",
) -> dict[str, Any]:
    """Return options of ECharts; panels share the x axis, and `hint` is shown if there are no lines."""
    count = max(1, len(panels))
    x_axis, y_axis, grid = [], [], []
    top, room = 10.0, 100.0 - 10.0 - 5.0
    for k, panel in enumerate(panels):
        height = room / count
        grid.append({"left": 66, "right": 14, "top": f"{top + k * height:.1f}%", "height": f"{height - 7.0:.1f}%"})
        last = k == count - 1
        x_axis.append(
            {
                "type": "log" if logarithmic else "value", "gridIndex": k, "name": x_title if last else "",
                "nameLocation": "middle", "nameGap": 24, "axisLabel": {"show": last and bool(lines)},
                "min": "dataMin" if lines else 1.0, "max": "dataMax" if lines else 10.0, "splitLine": SPLIT,
                "minorSplitLine": SPLIT | {"show": logarithmic}, "axisLine": AXIS,
            }
        )  # fmt: skip
        y_axis.append(
            {
                "type": "value", "gridIndex": k, "name": panel.title, "nameLocation": "middle", "nameGap": 50,
                "scale": True, "min": panel.low, "max": panel.high, "splitNumber": 4, "splitLine": SPLIT,
                "axisLine": AXIS, "axisLabel": {"show": bool(lines)},
            }
        )  # fmt: skip
    return {
        "animation": False,
        "title": {
            "text": "" if lines else hint, "left": "center", "top": "middle",
            "textStyle": {"fontSize": 14, "fontWeight": "normal", "width": 250, "overflow": "break",
                "lineHeight": 22},
        },
        "tooltip": {"trigger": "axis", "confine": True},
        "legend": {"type": "scroll", "top": 0, "data": list(dict.fromkeys(line.name for line in lines))},
        "grid": grid,
        "xAxis": x_axis,
        "yAxis": y_axis,
        "series": [_series(line) for line in lines],
    }  # fmt: skip


def _series(line: ChartLine) -> dict[str, Any]:
    colour = COLOURS[line.colour % len(COLOURS)]
    return {
        "name": line.name,
        "type": "line",
        "showSymbol": False,
        "xAxisIndex": line.panel,
        "yAxisIndex": line.panel,
        "data": points(line.x, line.y),
        "color": colour,
        "lineStyle": {
            "width": line.width, "color": colour, "type": DASHES[line.dashes % len(DASHES)],
            "opacity": 0.45 if line.faint else 1.0,
        },
        **({"areaStyle": {"color": colour, "opacity": 0.22, "origin": 0}} if line.fill else {}),
    }  # fmt: skip


def points(x: ArrayLike, y: ArrayLike) -> list[list[float | None]]:
    """Return points of a line for JSON, with fewer points if necessary; non-finite values are gaps."""
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    every = max(1, math.ceil(len(xs) / MOST_POINTS))
    return [
        [float(f"{a:.6g}"), float(f"{b:.6g}") if math.isfinite(b) else None]
        for a, b in zip(xs[::every].tolist(), ys[::every].tolist(), strict=True)
    ]


def chart(label: str, name: str) -> ui.echart:
    """Return an empty chart; `label` is its description for screen readers, `name` is used in tests."""
    made = ui.echart(options([ChartPanel("")], "", []), renderer="svg")
    made.classes("studio-chart w-full").style("height: clamp(280px, 42vh, 560px)")
    made.props(f'role="img" aria-label="{label}" data-test="{name}"')
    return made


def show(made: ui.echart, wanted: dict[str, Any]) -> None:
    """Replace the options of a chart."""
    made.options.clear()
    made.options.update(wanted)
    made.update()
