"""Charts of a measured response: Bode, Nichols with the forbidden region of the open loop, predicted step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.studio import charts
from tuning.response.measured_loop import Loops
from tuning.response.predicted_step import predicted_step

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drive_env.loops.dynamics import Dynamics
    from tuning.response.measured_loop import MeasuredLoop

COLOURS = {"velocity": 0, "position": 2}  # of the loops
PHASES, GAINS = (-300.0, -60.0), (-30.0, 30.0)  # of Nichols' chart [degrees], [dB]


def loops_of(measured: MeasuredLoop, axis: int, sets: Mapping[str, Sequence[int]]) -> dict[str, Loops]:
    """Return the loops with sets of gains; a measured position loop is returned as it is."""
    if measured.fits[axis] is None:
        f, L, trusted = measured.refined(axis)
        return {"": Loops(f, np.full(len(f), np.nan, complex), L, trusted)}
    return {told: measured.loops(gains, axis) for told, gains in sets.items()}


def bode(sets: Mapping[str, Loops]) -> dict[str, Any]:
    """Return the options of a Bode chart; loops of the second set are dashed."""
    lines = []
    for dashes, (told, one) in enumerate(sets.items()):
        for name, colour in COLOURS.items():
            gain, phase = _in_decibels(getattr(one, name), one.trusted)
            phase = np.where(np.abs(np.diff(phase, prepend=phase[:1])) > 180.0, np.nan, phase)  # a gap at each wrap
            for panel, values in enumerate((gain, phase)):
                lines.append(charts.ChartLine(f"{name} loop{told}", one.f, values, panel, colour, dashes))
    ends = next(iter(sets.values())).f[[0, -1]]
    for panel, level in ((0, 0.0), (1, -180.0)):
        lines.append(charts.ChartLine("0 dB, -180°", ends, [level, level], panel, 7, 2, 1.0))
    panels = [charts.ChartPanel("gain [dB]"), charts.ChartPanel("phase [°]", -360.0, 0.0)]
    return charts.options(panels, "frequency [Hz]", lines, logarithmic=True)


def nichols(sets: Mapping[str, Loops], dynamics: Dynamics) -> dict[str, Any]:
    """Return the options of a Nichols chart, with the region that dynamics forbid around 0 dB and -180 degrees."""
    phase, gain = dynamics.region()
    title = f"forbidden by {limits_of(dynamics)}"
    half = len(phase) // 2
    lines = [
        charts.ChartLine(title, phase[part] - 180.0, gain[part], 0, 1, 0, 1.5, fill=True)
        for part in (slice(0, half + 1), slice(half, None))
    ]
    for dashes, (told, one) in enumerate(sets.items()):
        for name, colour in COLOURS.items():
            gain, phase = _in_decibels(getattr(one, name), one.trusted)
            outside = (phase < PHASES[0]) | (phase > PHASES[1]) | (np.abs(gain) > GAINS[1])
            jumps = np.abs(np.diff(phase, prepend=phase[:1])) > 180.0
            gain = np.where(outside | jumps, np.nan, gain)
            lines.append(charts.ChartLine(f"{name} loop{told}", np.clip(phase, *PHASES), gain, 0, colour, dashes))
    lines.append(charts.ChartLine("0 dB", PHASES, [0.0, 0.0], 0, 7, 2, 1.0))
    lines.append(charts.ChartLine("0 dB", [-180.0, -180.0], GAINS, 0, 7, 2, 1.0))
    found = charts.options([charts.ChartPanel("gain [dB]", *GAINS)], "phase [°]", lines)
    return found | {"tooltip": {"show": False}}  # a curve that goes back and forth has no unique value at a phase


def step(measured: MeasuredLoop, axis: int, sets: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """Return the chart of the predicted steps with sets of gains; a set with an unstable loop has none."""
    lines = []
    for dashes, (told, gains) in enumerate(sets.items()):
        found = predicted_step(measured, gains, axis)
        if found is None:
            continue
        for panel, (name, colour) in enumerate(COLOURS.items()):
            answer = getattr(found, name)
            lines.append(charts.ChartLine(f"{name}{told}", 1e3 * found.t, answer, panel, colour, dashes))
            lines.append(charts.ChartLine("set-point", 1e3 * found.t[[0, -1]], [1.0, 1.0], panel, 7, 2, 1.0))
    panels = [charts.ChartPanel("velocity"), charts.ChartPanel("position")]
    return charts.options(panels, "t [ms]", lines, hint="With these gains a loop would be unstable: there is no step.")


def limits_of(dynamics: Dynamics) -> str:
    """Return the margins that dynamics ask for, as text."""
    name = "" if "/" in dynamics.name else f"{dynamics.name}: "
    return f"{name}{dynamics.phase_deg:.3g}°, {dynamics.gain_db:.3g} dB, Ms {dynamics.ms:.3g}"


def _in_decibels(open_loop: Any, trusted: Any) -> tuple[Any, Any]:
    """Return gain [dB] and phase [degrees], -360 to 0, of an open loop; nan where it is not trusted."""
    L = np.where(trusted & np.isfinite(open_loop) & (open_loop != 0.0), open_loop, np.nan)
    with np.errstate(invalid="ignore"):
        return 20.0 * np.log10(np.abs(L)), (np.degrees(np.angle(L)) + 360.0) % 360.0 - 360.0
