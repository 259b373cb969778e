"""Pictures of a certificate: a move with the gains before and after, and the Bode diagram of an open loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from tuning.response.bode import PHASES, draw_margins, within_a_turn

if TYPE_CHECKING:
    from tuning.certificate.certificate import FrequencyResponse, StepResponse

TRUSTED = 0.95  # coherence; samples below are drawn in grey
BEFORE, AFTER, DOUBTFUL = "#d55e00", "#0072b2", "#b8b8b8"
DPI = 110
MARGINS = ("phase margin at [Hz]", "phase margin [deg]", "gain margin at [Hz]", "gain margin [dB]")


def step_picture(steps: Sequence[StepResponse]) -> Figure:
    """Draw set-point, actual value and current of one move, recorded with one or several sets of gains."""
    figure = Figure(figsize=(8.0, 4.8), dpi=DPI, layout="constrained")
    motion, current = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for step in steps:
        color, label = _style(step.tuned)
        motion.plot(1e3 * step.t, step.actual, color=color, linewidth=1.3, label=label)
        current.plot(1e3 * step.t, step.current, color=color, linewidth=1.0)
    shown = steps[-1]
    motion.plot(1e3 * shown.t, shown.reference, color="black", linestyle="--", linewidth=0.9, label="set-point")
    motion.set_ylabel(f"actual [{shown.unit}]")
    motion.legend(loc="best")
    current.set_ylabel("current [A]")
    current.set_xlabel("time [ms]")
    for axes in (motion, current):
        axes.grid(True, alpha=0.3)
    return figure


def bode_picture(responses: Sequence[FrequencyResponse]) -> Figure:
    """Draw a Bode diagram with coherence; the curves are grey where the coherence is below TRUSTED."""
    figure = Figure(figsize=(8.0, 6.6), dpi=DPI, layout="constrained")
    magnitude, phase, coherence = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1.5))
    doubtful = False
    for found in responses:
        color, label = _style(found.tuned)
        with np.errstate(invalid="ignore"):
            trusted = np.isnan(found.coherence) | (found.coherence >= TRUSTED)
        doubtful = doubtful or not trusted.all()
        _curve(magnitude, found.frequency, found.magnitude_db, trusted, color, label)
        turn = within_a_turn(found.phase_deg)
        jumps = np.flatnonzero(np.abs(np.diff(turn)) > 180.0) + 1
        f, turn = np.insert(found.frequency, jumps, np.nan), np.insert(turn, jumps, np.nan)
        _curve(phase, f, turn, np.insert(trusted, jumps, False), color, label)
        coherence.plot(found.frequency, found.coherence, color=color, linewidth=1.0)
        read = [found.margins.get(name, np.nan) for name in MARGINS]
        draw_margins(magnitude, phase, read[0], read[1], read[2], read[3], color)
    magnitude.axhline(0.0, color="black", linewidth=0.8)
    phase.axhline(-180.0, color="black", linewidth=0.8)
    coherence.axhline(TRUSTED, color="black", linewidth=0.8, linestyle="--")
    if doubtful:
        magnitude.plot([], [], color=DOUBTFUL, label=f"coherence below {TRUSTED:g}")
    magnitude.set_xscale("log")
    coherence.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    coherence.xaxis.set_major_formatter("{x:g}")
    magnitude.set_ylabel("magnitude [dB]")
    magnitude.legend(loc="best")
    phase.set_ylabel("phase [°]")
    phase.set_ylim(*PHASES)
    phase.set_yticks(range(int(PHASES[0]), int(PHASES[1]) + 1, 90))
    coherence.set_ylabel("coherence")
    coherence.set_ylim(0.0, 1.05)
    coherence.set_xlabel("frequency [Hz]")
    for axes in (magnitude, phase, coherence):
        axes.grid(True, which="both", alpha=0.25)
    return figure


def _curve(axes: Axes, f: np.ndarray, y: np.ndarray, trusted: np.ndarray, color: str, label: str) -> None:
    axes.plot(f, y, color=DOUBTFUL, linewidth=1.0)
    axes.plot(f, np.where(trusted, y, np.nan), color=color, linewidth=1.4, label=label)


def _style(tuned: bool) -> tuple[str, str]:
    return (AFTER, "new gains") if tuned else (BEFORE, "gains before")
