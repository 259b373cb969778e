"""The plot of a training: the returns of its episodes, and the terms of its reward, over the steps."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from drive_env.whole_file import write_picture
from mechanics.reading.untrusted import MOST_RECORDING, read_text

TERM = "term "  # prefix of columns of reward terms
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")


def draw_learning_curve(table: Path, picture: Path, title: str) -> None:
    """Draw training.csv as a PNG; no file if the table has no rows yet.

    Args:
        table: Rows of `timesteps`, `return` (mean of the last episodes) and terms of the reward, mean per step.
        picture: The file, replaced only by a complete one.
        title: Title of the plot.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not table.is_file():
        return
    rows = list(csv.DictReader(io.StringIO(read_text(table, MOST_RECORDING))))
    if not rows:
        return
    steps = [int(row["timesteps"]) for row in rows]
    terms = [name for name in rows[0] if name.startswith(TERM)]
    figure = Figure(figsize=(8.0, 6.0 if terms else 3.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2 if terms else 1, 1, sharex=True, squeeze=False)[:, 0]
    marker = "o" if len(rows) < 3 else None  # a line of one point is invisible
    panels[0].plot(steps, [_number(row.get("return")) for row in rows], color=COLORS[0], marker=marker)
    panels[0].set_ylabel("return of an episode, mean")
    panels[0].set_title(title, fontsize=10)
    for name, color in zip(terms, COLORS * len(terms), strict=False):
        panels[-1].plot(steps, [_number(row.get(name)) for row in rows], color=color, marker=marker,
                        label=name.removeprefix(TERM))  # fmt: skip
    if terms:
        panels[-1].set_ylabel("terms of the reward, mean per step")
        panels[-1].legend(fontsize=8, ncols=2)
    panels[-1].set_xlabel("steps of all environments together")
    for panel in panels:
        panel.grid(color="0.9")
        panel.set_axisbelow(True)
    write_picture(picture, figure, 120)


def _number(text: str | None) -> float:
    return float(text) if text else math.nan
