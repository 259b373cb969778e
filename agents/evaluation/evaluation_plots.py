"""Pictures of an evaluation: the distribution of the figures, and the best, median and worst episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.evaluation import Evaluation
from drive_env.whole_file import write_picture

BINS = 20
# Environment -> entry of the observation that is drawn over time, and its title; None draws the reward.
TRACES: dict[str, tuple[int, str]] = {
    "ServoDrive/Tracking-v0": (0, "reference - position of axis 0 [of the amplitude]"),
    "ServoDrive/GainScheduling-v0": (0, "error of axis 0 [of its scale]"),
}


def save(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write figures.png and episodes.png to a folder and return their paths."""
    import matplotlib

    matplotlib.use("Agg")
    return [_figures(evaluation, folder / "figures.png"), _episodes(evaluation, folder / "episodes.png")]


def save_gap(first: Evaluation, second: Evaluation, folder: Path) -> Path:
    """Write gap.png to a folder, the score of every episode on one side over that on the other; return its path."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    one, two = (np.array(side.values[first.score]) for side in (first, second))
    figure, axis = pyplot.subplots(figsize=(4.8, 4.8), layout="constrained")
    axis.scatter(one, two, s=18, color="C0", alpha=0.7, linewidths=0)
    ends = [float(np.nanmin([one, two])), float(np.nanmax([one, two]))]
    axis.plot(ends, ends, color="0.5", linewidth=0.8, zorder=0)
    axis.scatter([np.nanmedian(one)], [np.nanmedian(two)], marker="+", s=160, color="black", label="medians")
    axis.set(xlabel=f"{first.score}, {first.side}", ylabel=f"{second.score}, {second.side}",
             title=f"{first.policy}, {len(one)} machines")  # fmt: skip
    if ends[0] > 0.0 and ends[1] > 5.0 * ends[0]:
        axis.set(xscale="log", yscale="log")
        for side in (axis.xaxis, axis.yaxis):
            side.set(
                major_locator=LogLocator(subs=(1.0, 2.0, 5.0)),
                major_formatter=FuncFormatter(lambda value, _: f"{value:g}"),
            )
            side.set_minor_locator(NullLocator())
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    path = folder / "gap.png"
    write_picture(path, figure, 120)
    pyplot.close(figure)
    return path


def _figures(evaluation: Evaluation, path: Path) -> Path:
    from matplotlib import pyplot

    names = list(evaluation.values)
    figure, axes = pyplot.subplots(1, len(names), figsize=(4.0 * len(names), 3.2), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], names, strict=True):
        values = np.array(evaluation.values[name])
        found = evaluation.interval(name)
        axis.hist(values[np.isfinite(values)], bins=BINS, color="0.7")
        axis.axvline(found.mean, color="C0")
        axis.axvspan(found.low, found.high, color="C0", alpha=0.2)
        axis.set(xlabel=name, ylabel="episodes", title=f"mean {found.mean:.4g}")
    figure.suptitle(f"{evaluation.policy} on {evaluation.side}: mean and its 95 % interval", fontsize=10)
    write_picture(path, figure, 120)
    pyplot.close(figure)
    return path


def _episodes(evaluation: Evaluation, path: Path) -> Path:
    from matplotlib import pyplot

    values = np.array(evaluation.values[evaluation.score])
    order = np.argsort(np.where(np.isfinite(values), values, np.inf))
    if not evaluation.lower_is_better[evaluation.score]:
        order = order[::-1]
    chosen: dict[str, Any] = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
    figure, axis = pyplot.subplots(figsize=(8.0, 3.6), layout="constrained")
    for name, k in chosen.items():
        episode = evaluation.episodes[k]
        if evaluation.environment in TRACES:
            entry, label = TRACES[evaluation.environment]
            rows = episode.observations[1:, entry]
        else:
            rows, label = np.cumsum(episode.rewards), "sum of rewards"
        axis.plot(np.arange(1, len(rows) + 1), rows, label=f"{name}, seed {episode.seed}", linewidth=1.0)
    axis.set_ylabel(label, fontsize=8)
    axis.set(xlabel="step", title=f"{evaluation.policy} on {evaluation.side}")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    write_picture(path, figure, 120)
    pyplot.close(figure)
    return path
