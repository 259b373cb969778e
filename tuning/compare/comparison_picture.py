"""The picture of a comparison: robust cost over the baseline rule's for each tuner, drive time and violations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drive_env.whole_file import write_picture
from tuning.compare.comparison import WORSE as WORSE_FROM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from tuning.compare.comparison import Comparison

BETTER, WORSE, MARK = "#0072b2", "#d55e00", "black"
ROW = 0.36  # inches of a tuner


def draw(comparison: Comparison, path: Path) -> None:
    """Draw a comparison into a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    tuners = list(reversed(comparison.tuners))  # the best at the top
    figure = Figure(figsize=(11.0, 1.9 + ROW * max(len(tuners), 4)), layout="constrained")
    FigureCanvasAgg(figure)
    score, time, trouble = figure.subplots(1, 3, sharey=True, width_ratios=(6, 2, 2))
    for place, tuner in enumerate(tuners):
        relative = np.array([row.relative for row in comparison.of(tuner.tuner)])
        # Machines side by side where they agree, in the order of the suite: nothing is drawn at random.
        aside = place + 0.5 * (np.arange(len(relative)) % 7 / 6.0 - 0.5)
        worse = relative > WORSE_FROM
        score.scatter(relative[~worse], aside[~worse], s=14, color=BETTER, alpha=0.55, linewidths=0)
        score.scatter(relative[worse], aside[worse], s=14, color=WORSE, alpha=0.55, linewidths=0)
        score.plot([tuner.median, tuner.p95], [place, place], color=MARK, linewidth=1.2)
        score.plot([tuner.median], [place], marker="|", color=MARK, markersize=15, markeredgewidth=2.2)
        score.plot([tuner.p95], [place], marker="|", color=MARK, markersize=8)
    score.set_xscale("log")
    ticks = FixedLocator([a * b for a in (0.001, 0.01, 0.1, 1.0, 10.0) for b in (1.0, 2.0, 5.0)])
    score.xaxis.set(major_locator=ticks, major_formatter=FuncFormatter(lambda value, _: f"{value:g}"))
    score.xaxis.set_minor_locator(NullLocator())
    score.axvline(1.0, color="0.5", linewidth=0.8, zorder=0)
    score.set_yticks(range(len(tuners)), [f"{tuner.tuner}, median {tuner.median:.2f}" for tuner in tuners])
    score.set_xlabel("robust cost relative to the baseline rule, less is better\nlong mark: median, short: 95 %")
    machines = tuners[0].machines if tuners else 0
    score.set_title(f"{machines} machines; orange: more than 5 % worse than the rule", fontsize=10)
    _bars(time, [tuner.drive_seconds for tuner in tuners], "drive time of a machine [s]\nmedian")
    _bars(trouble, [float(tuner.violations) for tuner in tuners], "violations\nall machines", whole=True)
    for axes in (score, time, trouble):
        axes.grid(axis="x", color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    score.set_ylim(-0.6, len(tuners) - 0.4)
    write_picture(path, figure, 120)


def _bars(axes: Axes, values: list[float], label: str, *, whole: bool = False) -> None:
    axes.barh(range(len(values)), values, height=0.55, color="0.65")
    top = max([*values, 1e-9])
    for place, value in enumerate(values):
        axes.text(value + 0.02 * top, place, f"{value:.0f}" if whole else f"{value:.3g}", va="center", fontsize=8)
    axes.set_xlim(0.0, 1.25 * top)
    axes.set_xlabel(label)
