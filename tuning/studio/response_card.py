"""The card of the frequency response: Bode as measured, and as the present gains would make it, with margins."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from drive_env.devices.gains import check_linear_model
from drive_env.loops.margins import Margins, margins
from drive_env.studio import charts
from tuning.studio import tune_jobs
from tuning.studio.tune_panel import TunePanel, card

if TYPE_CHECKING:
    from tuning.response.measured_loop import MeasuredLoop

ROWS = (  # of the table: title, unit, field, digits
    ("Phase margin", "°", "phase_deg", 1),
    ("Gain margin", "dB", "gain_db", 1),
    ("Crossover", "Hz", "crossover_hz", 1),
    ("Bandwidth (-3 dB)", "Hz", "bandwidth_hz", 1),
    ("Greatest sensitivity Ms", "1", "ms", 2),
)


def curve(name: str, f: Any, open_loop: Any, trusted: Any, colour: int, dashes: int) -> list[charts.ChartLine]:
    """Return the two lines of an open loop: gain [dB] and phase [degrees] where it is trusted."""
    L = np.where(trusted & np.isfinite(open_loop) & (open_loop != 0.0), open_loop, np.nan)
    with np.errstate(invalid="ignore"):
        gain, phase = 20.0 * np.log10(np.abs(L)), (np.degrees(np.angle(L)) + 360.0) % 360.0 - 360.0
    phase = np.where(np.abs(np.diff(phase, prepend=phase[:1])) > 180.0, np.nan, phase)  # where it wraps
    return [
        charts.ChartLine(name, f, gain, 0, colour, dashes), charts.ChartLine(name, f, phase, 1, colour, dashes),
    ]  # fmt: skip


def bode(measured: MeasuredLoop, axis: int, gains: tuple[int, ...]) -> tuple[dict[str, Any], dict[str, Margins]]:
    """Return the chart of a response, and margins by name.

    Args:
        measured: What was measured.
        axis: Of it.
        gains: The present ones, or those that a slider stands for: a velocity loop that was measured tells what they
            make of it, and of the position loop.
    """
    panels = [charts.ChartPanel("gain [dB]"), charts.ChartPanel("phase [°]", -360.0, 0.0)]
    f, L, trusted = measured.refined(axis)
    own = tuple(map(int, measured.gains[axis]))
    lines = curve(f"{measured.loop} loop, measured", f, L, trusted, 0, 0)
    found = {f"{measured.loop} loop, measured": measured.margins(axis)}
    if measured.fits[axis] is not None:
        loops = measured.loops(gains, axis)
        for k, (name, now) in enumerate((("velocity", loops.velocity), ("position", loops.position)), 1):
            if name == measured.loop and gains == own:
                continue
            title = f"{name} loop, present gains"
            lines += curve(title, loops.f, now, loops.trusted, k, k)
            found[title] = margins(loops.f, now, loops.trusted)
    low, high = float(f[0]), float(f[-1])
    for panel, level in ((0, 0.0), (1, -180.0)):
        lines.append(charts.ChartLine("0 dB, -180°", [low, high], [level, level], panel, 7, 2, 1.0))
    return charts.options(panels, "frequency [Hz]", lines, logarithmic=True), found


def margin_text(value: float, digits: int, unit: str) -> str:
    """Return a margin for people."""
    if math.isnan(value):
        return "not measured"
    tail = "" if unit == "1" else f" {unit}" if unit != "°" else "°"
    return "infinite" if math.isinf(value) else f"{value:.{digits}f}{tail}"


class ResponseCard:
    """The frequency response of the axis of one page.

    Args:
        panel: The page.
    """

    def __init__(self, panel: TunePanel) -> None:
        self._panel = panel
        self._seen: tuple[Any, ...] = ()

    def build(self) -> None:
        """Make it."""
        panel = self._panel
        with card("Frequency response", "response"):
            try:
                check_linear_model(panel.device)
            except ValueError as error:
                ui.label(str(error)).classes("studio-hint")
                return
            with ui.row().classes("studio-buttons"):
                loops = {"velocity": "Velocity loop", "position": "Position loop"}
                self._loop = ui.select(loops, value="velocity", label="Loop").props("dense outlined")
                ui.button("Measure", icon="graphic_eq", on_click=self._measure).props(
                    "unelevated no-caps data-test=measure-response"
                )
            self._chart = charts.chart("Bode diagram: gain and phase of the open loop", "bode-chart")
            self._table = ui.element("div").classes("studio-scroll w-full").props("data-test=margins")
            self._told = ui.label(
                "The motor turns for about two seconds. Then margins follow the gains, also while a slider moves."
            ).classes("studio-hint")

    async def _measure(self) -> None:
        panel, loop = self._panel, str(self._loop.value)
        job = tune_jobs.measure_response(panel.desk, panel.axis, loop)
        await panel.visitor.do(job, f"Frequency response of axis {panel.axis}", paced=False)

    def show(self, gains: tuple[int, ...]) -> None:
        """Show the response with gains."""
        if not hasattr(self, "_chart"):
            return
        desk, axis, loop = self._panel.desk, self._panel.axis, str(self._loop.value)
        measured = desk.responses.get((loop, axis))
        seen = (loop, id(measured), gains)
        if seen == self._seen:
            return
        self._seen = seen
        if measured is None or not gains:
            charts.show(self._chart, charts.options([charts.ChartPanel("gain [dB]")], "frequency [Hz]", []))
            self._table.clear()
            return
        wanted, found = bode(measured, axis, gains)
        charts.show(self._chart, wanted)
        self._table.clear()
        with self._table:
            _margin_table(found)
        notes = "; ".join(measured.notes[axis])
        coherent = 100.0 * float(measured.trusted[~measured.traced, axis].mean())
        self._told.set_text(
            f"{coherent:.0f} % of the frequencies are coherent; {measured.drive_time:.1f} s of drive time"
            f"{'; ' + notes if notes else ''}"
        )


def _margin_table(found: dict[str, Margins]) -> None:
    with ui.element("table").classes("studio-table"):
        with ui.element("thead"), ui.element("tr"):
            for text in ("", *found):
                with ui.element("th"):
                    ui.label(text)
        with ui.element("tbody"):
            for title, unit, field, digits in ROWS:
                with ui.element("tr"):
                    with ui.element("th"):
                        ui.label(title)
                    for one in found.values():
                        with ui.element("td"):
                            ui.label(margin_text(getattr(one, field), digits, unit))
