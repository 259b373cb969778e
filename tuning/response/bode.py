"""Pictures of measured open loops: Bode diagram with coherence, and Nyquist diagram. Incoherent lines are grey dots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.loops.linear_model import Plant, position_open_loop, velocity_open_loop
from drive_env.whole_file import write_picture
from mechanics.arrays import Complex, Floats
from tuning.response.measured_loop import COHERENT, MeasuredLoop

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MEASURED, TRACED, MODEL, GREY = "#0b5cad", "#c2560c", "#222222", "#b5b5b5"
PHASES = (-270.0, 90.0)  # degrees shown: an anti-resonance, which adds phase, must not wrap near -180 degrees
_FINE = 600
_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 400, 1000)  # Hz


def bode_figure(response: MeasuredLoop, axis: int = 0) -> Figure:
    """Draw magnitude, phase and coherence of an axis over frequency, and the Nyquist curve around -1.

    The loop computed from the fitted plant with the same gains is drawn for comparison.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    fit = response.fits[axis]
    known = fit.plant if fit is not None and not fit.reason else None
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(3, 2), height_ratios=(3, 3, 1.4))
    magnitude = figure.add_subplot(grid[0, 0])
    phase = figure.add_subplot(grid[1, 0], sharex=magnitude)
    coherence = figure.add_subplot(grid[2, 0], sharex=magnitude)
    nyquist = figure.add_subplot(grid[:, 1])
    _draw_bode(magnitude, phase, response, axis, known)
    _draw_coherence(coherence, response, axis)
    _draw_nyquist(nyquist, response, axis, known)
    for plot in (magnitude, phase, coherence):
        plot.xaxis.set_major_formatter(ScalarFormatter())
        plot.xaxis.set_minor_formatter(NullFormatter())
        plot.tick_params(axis="x", labelbottom=plot is coherence)
    low, high = response.f[0], response.f[-1]
    coherence.set_xticks([tick for tick in _TICKS if 0.9 * low <= tick <= 1.1 * high])
    figure.suptitle(_title(response, axis), fontsize=11, x=0.01, ha="left")
    return figure


def write_bode(path: Path, response: MeasuredLoop, axis: int = 0) -> None:
    """Write `bode_figure` to a file; its suffix selects the format: .png, .svg, .pdf."""
    write_picture(path, bode_figure(response, axis), 120)


def _model(response: MeasuredLoop, axis: int, plant: Plant | None) -> tuple[Floats, Complex] | None:
    if plant is None:
        return None
    loop = {"velocity": velocity_open_loop, "position": position_open_loop}[response.loop]
    f = np.geomspace(response.f[0], response.f[-1], _FINE)
    return f, loop(response.device, plant, response.gains[axis], f)


def within_a_turn(phase: np.ndarray) -> np.ndarray:
    """Wrap phases [degrees] into PHASES: -540 degrees is as close to instability as -180 degrees."""
    return np.asarray((phase - PHASES[0]) % 360.0 + PHASES[0])


def draw_margins(
    magnitude: Axes, phase: Axes, phase_hz: float, phase_deg: float, gain_hz: float, gain_db: float, color: str
) -> None:
    """Draw the phase margin from -180 degrees and the gain margin from 0 dB, each at its frequency."""
    for axes, at, line, size in ((phase, phase_hz, -180.0, phase_deg), (magnitude, gain_hz, 0.0, -gain_db)):
        if np.isfinite(at) and np.isfinite(size):
            axes.plot([at, at], [line, line + size], color=color, linewidth=2.2, marker="_", solid_capstyle="butt")


def _draw_bode(magnitude: Any, phase: Any, response: MeasuredLoop, axis: int, plant: Plant | None) -> None:
    f, L = response.f, response.open_loop[:, axis]
    good = response.trusted[:, axis]
    seen = np.isfinite(L)
    level = np.full(f.shape, np.nan)
    level[seen] = 20.0 * np.log10(np.abs(L[seen]))
    turn = np.full(f.shape, np.nan)
    turn[seen] = _turns(L[seen])
    for plot, value in ((magnitude, level), (phase, turn)):
        plot.plot(f[~good], value[~good], ".", color=GREY, markersize=4, label="not coherent", zorder=1)
        for traced, colour, name in ((False, MEASURED, "on the bus, 1 kHz"), (True, TRACED, "emulator's trace, 5 kHz")):
            mine = good & (response.traced == traced)
            if mine.any():
                plot.plot(
                    *_without_jumps(f, np.where(mine, value, np.nan)),
                    ".-",
                    color=colour,
                    markersize=4,
                    linewidth=0.8,
                    label=name,
                    zorder=3,
                )
    if (model := _model(response, axis, plant)) is not None:
        magnitude.plot(model[0], 20.0 * np.log10(np.abs(model[1])), color=MODEL, linewidth=0.9, label="linear model")
        phase.plot(*_without_jumps(model[0], _turns(model[1])), color=MODEL, linewidth=0.9)
    found = response.margins(axis)
    magnitude.axhline(0.0, color="k", linewidth=0.5)
    phase.axhline(-180.0, color="k", linewidth=0.5)
    draw_margins(magnitude, phase, found.phase_hz, found.phase_deg, found.gain_hz, found.gain_db, "k")
    if response.traced.any():
        for plot in (magnitude, phase):
            plot.axvspan(f[response.traced].min(), f.max(), color=TRACED, alpha=0.07, linewidth=0)
    magnitude.set(xscale="log", ylabel="open loop [dB]")
    phase.set(ylabel="phase [deg]", ylim=PHASES, yticks=np.arange(PHASES[0], PHASES[1] + 1.0, 90.0))
    if good.any():
        magnitude.set_ylim(*_around(level[good], 6.0))
    magnitude.legend(fontsize=8, loc="lower left")
    for plot in (magnitude, phase):
        plot.grid(True, which="both", linewidth=0.3, alpha=0.6)


def _draw_coherence(plot: Any, response: MeasuredLoop, axis: int) -> None:
    good = response.trusted[:, axis]
    for chosen, colour in ((~good, GREY), (good & ~response.traced, MEASURED), (good & response.traced, TRACED)):
        plot.vlines(response.f[chosen], 0.0, response.coherence[chosen, axis], color=colour, linewidth=1.0)
    plot.axhline(COHERENT, color="k", linewidth=0.5, linestyle=":")
    plot.set(xscale="log", xlabel="frequency [Hz]", ylabel="coherence", ylim=(0.0, 1.05))
    plot.grid(True, which="both", linewidth=0.3, alpha=0.6)


def _draw_nyquist(plot: Any, response: MeasuredLoop, axis: int, plant: Plant | None) -> None:
    L, good = response.open_loop[:, axis], response.trusted[:, axis]
    if (model := _model(response, axis, plant)) is not None:
        plot.plot(model[1].real, model[1].imag, color=MODEL, linewidth=0.9)
    bad = ~good & np.isfinite(L)
    plot.plot(L[bad].real, L[bad].imag, ".", color=GREY, markersize=4)
    _, between, known = response.refined(axis)
    between = np.where(known, between, np.nan)
    plot.plot(between.real, between.imag, color=MEASURED, linewidth=0.7, alpha=0.6)
    for traced, colour in ((False, MEASURED), (True, TRACED)):
        mine = good & (response.traced == traced)
        plot.plot(L[mine].real, L[mine].imag, ".", color=colour, markersize=4)
    ms = response.margins(axis).ms
    circle = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 200))
    plot.plot(circle.real, circle.imag, color="k", linewidth=0.4, linestyle=":")
    if np.isfinite(ms):
        # The curve touches this circle at its point nearest to -1.
        plot.plot(-1.0 + circle.real / ms, circle.imag / ms, color="#a01030", linewidth=0.7)
        plot.annotate(f"1/Ms = {1.0 / ms:.2f}", (-1.0, 1.0 / ms), fontsize=8, color="#a01030", ha="center", va="bottom")
    plot.plot(-1.0, 0.0, "+", color="#a01030", markersize=9)
    plot.set(xlim=(-2.6, 1.4), ylim=(-3.2, 1.6), aspect="equal", xlabel="Re L", ylabel="Im L")
    plot.grid(True, linewidth=0.3, alpha=0.6)
    plot.set_title("Nyquist", fontsize=9)


def _title(response: MeasuredLoop, axis: int) -> str:
    found = response.margins(axis)
    gains = ", ".join(str(int(gain)) for gain in response.gains[axis])
    trusted = 100.0 * float(response.trusted[~response.traced, axis].mean())
    return (
        f"{response.loop} loop, axis {axis}, gains {gains}\n"
        f"phase margin {_text(found.phase_deg, '{:.1f} deg')}, gain margin {_text(found.gain_db, '{:.1f} dB')}, "
        f"crossover {_text(found.crossover_hz, '{:.1f} Hz')}, bandwidth {_text(found.bandwidth_hz, '{:.1f} Hz')}, "
        f"Ms {_text(found.ms, '{:.2f}')}; {trusted:.0f} % of the bus's bins coherent"
    )


def _text(value: float, form: str) -> str:
    return form.format(value) if np.isfinite(value) else "not measured"


def _turns(L: Complex) -> Floats:
    """Return the displayed phase in degrees."""
    return within_a_turn(np.degrees(np.angle(L)))


def _without_jumps(f: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Break a line where its phase wraps, by inserting nan."""
    jumps = np.flatnonzero(np.abs(np.diff(value)) > 180.0) + 1
    return np.insert(f, jumps, np.nan), np.insert(value, jumps, np.nan)


def _around(value: Floats, margin: float) -> tuple[float, float]:
    return float(value.min()) - margin, float(value.max()) + margin
