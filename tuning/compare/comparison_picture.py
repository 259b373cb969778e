"""The picture of a comparison: robust performance over the oracle's, phase margins, drive time and violations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drive_env.whole_file import write_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from tuning.compare.comparison import Comparison

KEPT, BROKEN, MARK = "#0072b2", "#d55e00", "black"
ROW = 0.36  # inches per tuner


def draw(comparison: Comparison, path: Path) -> None:
    """Draw a comparison to a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    tuners = list(reversed(comparison.tuners))  # the best at the top
    figure = Figure(figsize=(12.5, 1.9 + ROW * max(len(tuners), 4)), layout="constrained")
    FigureCanvasAgg(figure)
    score, phase, time, trouble = figure.subplots(1, 4, sharey=True, width_ratios=(5, 3, 2, 2))
    for place, tuner in enumerate(tuners):
        rows = comparison.of(tuner.tuner)
        # Machines with equal values are drawn side by side, in the order of the suite: the picture has no random part.
        aside = place + 0.5 * (np.arange(len(rows)) % 7 / 6.0 - 0.5)
        kept = np.array([row.kept for row in rows])
        for axes, values in ((score, [row.relative for row in rows]), (phase, [row.phase_deg for row in rows])):
            known = np.array([np.nan if value is None else value for value in values], float)
            for where, color in ((kept, KEPT), (~kept, BROKEN)):
                axes.scatter(known[where], aside[where], s=14, color=color, alpha=0.55, linewidths=0)
        for axes, middle, tail in ((score, tuner.median, tuner.p95), (phase, tuner.phase_deg, tuner.phase_p5)):
            if middle is not None and tail is not None:
                axes.plot([middle, tail], [place, place], color=MARK, linewidth=1.2)
                axes.plot([middle], [place], marker="|", color=MARK, markersize=15, markeredgewidth=2.2)
                axes.plot([tail], [place], marker="|", color=MARK, markersize=8)
    score.set_xscale("log")
    ticks = FixedLocator([a * b for a in (0.001, 0.01, 0.1, 1.0, 10.0) for b in (1.0, 2.0, 5.0)])
    score.xaxis.set(major_locator=ticks, major_formatter=FuncFormatter(lambda value, _: f"{value:g}"))
    score.xaxis.set_minor_locator(NullLocator())
    score.axvline(1.0, color="0.5", linewidth=0.8, zorder=0)
    score.set_yticks(range(len(tuners)), [f"{one.tuner}, {100.0 * one.kept:.0f} % keep them" for one in tuners])
    score.set_xlabel("robust performance over the oracle's, less is better\nlong mark: median, short: 95 %")
    phase.set_xlabel("phase margin, worst loop [°]\nlong mark: median, short: 5 %")
    machines = tuners[0].machines if tuners else 0
    score.set_title(f"{machines} machines; orange: breaks a constraint", fontsize=10)
    _bars(time, [tuner.drive_seconds for tuner in tuners], "drive time [s]\nmedian machine")
    _bars(trouble, [float(tuner.violations) for tuner in tuners], "violations\nall machines", whole=True)
    for axes in (score, phase, time, trouble):
        axes.grid(axis="x", color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    score.set_ylim(-0.6, len(tuners) - 0.4)
    write_picture(path, figure, 120)


def _bars(axes: Axes, values: list[float], label: str, *, whole: bool = False) -> None:
    axes.barh(range(len(values)), values, height=0.55, color="0.65")
    top = max(values, default=0.0) or 1.0
    for place, value in enumerate(values):
        axes.text(value + 0.02 * top, place, f"{value:.0f}" if whole else f"{value:.3g}", va="center", fontsize=8)
    axes.set_xlim(0.0, 1.25 * top)
    axes.set_xlabel(label)
