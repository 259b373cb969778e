"""Exports a scope's recording as table, arrays or image, and computes the figures of a step in it."""

from __future__ import annotations

import csv
import io
import math
from typing import NamedTuple

import numpy as np

from drive_env.studio.scope_view import ScopeChannel, ScopeRecording
from drive_env.trials.response import step_metrics

COLOURS = ("#0072b2", "#d55e00", "#007a59", "#a3447f", "#8a6100", "#1f1f1f", "#3a86b8", "#7a3b12")

LEAST_STEP = 0.3  # of a channel's range between the cursors: a smaller change is a pulse or noise, not a step


def as_csv(recording: ScopeRecording) -> bytes:
    """Return a CSV table: times [s], then a column for each channel in its unit."""
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow(["t [s]", *(channel.label for channel, _ in recording.values)])
    columns = [values.tolist() for _, values in recording.values]
    rows = zip((f"{time:.6f}" for time in recording.t), *columns, strict=True)
    writer.writerows([time, *(f"{value:.9g}" for value in values)] for time, *values in rows)
    return file.getvalue().encode()


def as_npz(recording: ScopeRecording) -> bytes:
    """Return a NumPy file: `t` [s], `values` of shape (channels, n), `names`, `units`, `objects` (index, sub, axis)."""
    file = io.BytesIO()
    channels = [channel for channel, _ in recording.values]
    values = np.array([values for _, values in recording.values]).reshape(len(channels), len(recording.t))
    np.savez_compressed(
        file, t=recording.t, values=values,
        names=np.array([one.name for one in channels], str), units=np.array([one.unit for one in channels], str),
        objects=np.array([(*one.key, one.axis) for one in channels], np.int64).reshape(-1, 3),
    )  # fmt: skip
    return file.getvalue()


def as_png(recording: ScopeRecording, under: ScopeRecording | None = None) -> bytes:
    """Return an image with a panel for each unit, and another recording dashed below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    units = list(dict.fromkeys(channel.unit for channel, _ in recording.values)) or [""]
    figure = Figure(figsize=(10.0, 1.2 + 2.4 * len(units)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for panel, unit in zip(panels, units, strict=True):
        for k, (channel, values) in enumerate(recording.values):
            if channel.unit != unit:
                continue
            colour = COLOURS[k % len(COLOURS)]
            panel.plot(recording.t, values, color=colour, linewidth=1.2, drawstyle="steps-post", label=channel.name)
            before = None if under is None else under.of(channel)
            if under is not None and before is not None:
                panel.plot(under.t, before, color=colour, linewidth=0.9, linestyle="--", alpha=0.6)
        panel.set_ylabel(unit or "integer")
        panel.grid(alpha=0.3)
        panel.margins(x=0)
        if any(channel.unit == unit for channel, _ in recording.values):
            panel.legend(loc="upper right", fontsize="small")
        if len(recording.t) and recording.t[0] < 0.0 < recording.t[-1]:
            panel.axvline(0.0, color="0.4", linewidth=0.8, linestyle="--")
    panels[-1].set_xlabel("t [s]")
    file = io.BytesIO()
    figure.savefig(file, dpi=110, format="png")
    return file.getvalue()


class StepFigures(NamedTuple):
    """The figures of a step, nan for one that does not exist; times in s, overshoot as a share of the step."""

    at: float
    height: float
    rise: float
    overshoot: float
    settling: float
    oscillates: bool


def measure_step(
    recording: ScopeRecording, channel: ScopeChannel, begin: float | None, end: float | None
) -> StepFigures:
    """Return the figures of the step of a channel.

    Args:
        recording: The recording.
        channel: The response.
        begin: Begin of the evaluation [s]; None: begin of the recording. The step is at the trigger, if that lies
            inside, else where the channel first leaves its first value.
        end: End of the evaluation [s]; None: end of the recording.

    Raises:
        ValueError: If there is no step.
    """
    values, t = recording.of(channel), recording.t
    if values is None or len(t) < 10:
        raise ValueError(f"{channel.name} is not in the picture, or there are too few samples; record a step first")
    first = 0 if begin is None else int(np.searchsorted(t, begin, side="right")) - 1
    last = len(t) if end is None else int(np.searchsorted(t, end, side="right"))
    first = max(0, first)
    if last - first < 10:
        raise ValueError("there are fewer than 10 samples between the cursors; place them farther apart")
    first = _start(t, values, first, last)
    final = float(np.mean(values[max(first, last - max(3, (last - first) // 20)) : last]))
    height = final - float(values[first])
    if abs(height) <= max(LEAST_STEP * float(np.ptp(values[first:last])), 1e-12):
        raise ValueError(
            f"{channel.name} makes no step there: it ends where it began; place cursor A before a step, and B where it "
            "has settled, or choose another channel"
        )
    found = step_metrics(t[:last], values[:last], final, t_step=float(t[first]), initial=float(values[first]))
    return StepFigures(
        float(t[first]), height, float(found.rise_time), float(found.overshoot), float(found.settling_time),
        bool(found.oscillating),
    )  # fmt: skip


def _start(t: np.ndarray, values: np.ndarray, first: int, last: int) -> int:
    """Return the sample at the trigger, or the last one before the channel leaves its first value."""
    if t[first] < 0.0 < t[last - 1]:
        return int(np.searchsorted(t, 0.0, side="right")) - 1
    shown = values[first:last]
    away = np.abs(shown - shown[0]) > 0.02 * float(np.ptp(shown))
    return first + max(0, int(np.argmax(away)) - 1)


def in_words(figures: StepFigures, unit: str) -> str:
    """Format the figures as a line."""

    def time_text(value: float) -> str:
        return "none" if math.isnan(value) else f"{1e3 * value:.4g} ms"

    over = "none" if math.isnan(figures.overshoot) else f"{100.0 * figures.overshoot:.3g} %"
    return (
        f"step of {figures.height:.5g} {unit} at {figures.at:.4g} s: rise (10 to 90 %) {time_text(figures.rise)}, "
        f"overshoot {over}, settling (2 %) {time_text(figures.settling)}{', oscillates' if figures.oscillates else ''}"
    )
