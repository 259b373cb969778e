"""The card of the frequency response: Bode, Nichols, predicted step and margins, as measured and with other gains."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from nicegui import ui

from drive_env.studio import charts
from tuning.auto.loop_margins import AskedMargin, asked_margins
from tuning.studio import response_charts, tune_jobs
from tuning.studio.rules_card import table
from tuning.studio.tune_panel import TunePanel, card
from tuning.target import check_measurable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.margins import Margins
    from tuning.response.measured_loop import Loops, MeasuredLoop
    from tuning.studio.stiffness_slider import StiffnessSlider

ROWS = (  # of the table: title, unit, field, digits
    ("Phase margin", "°", "phase_deg", 1),
    ("Gain margin", "dB", "gain_db", 1),
    ("Greatest sensitivity Ms", "1", "ms", 2),
    ("Crossover", "Hz", "crossover_hz", 1),
    ("Bandwidth (-3 dB)", "Hz", "bandwidth_hz", 1),
)
HINT = "Press Measure: the motor turns for about two seconds."


def margin_text(value: float, digits: int, unit: str) -> str:
    """Format a margin for display."""
    if math.isnan(value):
        return "not measured"
    tail = "" if unit == "1" else f" {unit}" if unit != "°" else "°"
    return "infinite" if math.isinf(value) else f"{value:.{digits}f}{tail}"


def margin_rows(sets: Mapping[str, Loops], dynamics: Dynamics) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return titles and rows of margins by loop, with those before; values below the dynamics are marked by a cross."""
    found: dict[str, Margins] = {}
    for name in response_charts.COLOURS:
        for told, loops in reversed([*sets.items()]):
            found[f"{name} loop{told}"] = loops.margins()[name]
    asked: dict[str, AskedMargin] = {one.field: one for one in asked_margins(dynamics)}
    rows = []
    for title, unit, field, digits in ROWS:
        row, limit = [], asked.get(field)
        for one in found.values():
            value = getattr(one, field)
            row.append(f"{'✕ ' * bool(limit and limit.missed(value))}{margin_text(value, digits, unit)}")
        wanted = "" if limit is None else f"{'≥' if limit.sign > 0.0 else '≤'} {margin_text(limit.limit, digits, unit)}"
        rows.append((title, *row, wanted))
    return ["", *found, "asked for"], rows


class ResponseCard:
    """The frequency response of the axis of one page.

    Args:
        panel: The page.
        stiffness: The slider from soft to stiff.
    """

    def __init__(self, panel: TunePanel, stiffness: StiffnessSlider) -> None:
        self._panel, self._stiffness = panel, stiffness
        self._seen: tuple[Any, ...] = (None,)

    def build(self) -> None:
        """Build the card."""
        panel = self._panel
        with card("Frequency response, soft to stiff", "response"):
            try:
                check_measurable(panel.device, ("csv",))
            except ValueError as error:
                ui.label(str(error)).classes("studio-hint")
                return
            with ui.row().classes("studio-buttons"):
                loops = {"velocity": "Velocity loop", "position": "Position loop"}
                self._loop = ui.select(loops, value="velocity", label="Loop").props("dense outlined")
                ui.button("Measure", icon="graphic_eq", on_click=self._measure).props(
                    "unelevated no-caps data-test=measure-response"
                )
            self._stiffness.build()
            with ui.element("div").classes("studio-charts"):
                self._bode = charts.chart("Bode diagram: gain and phase of the open loops", "bode-chart")
                self._nichols = charts.chart(
                    "Nichols chart: the open loops and their forbidden region", "nichols-chart"
                )
                self._step = charts.chart("Step that the response predicts: velocity and position", "predicted-step")
                self._table = ui.element("div").classes("studio-scroll w-full").props("data-test=margins")
            self._told = ui.label("").classes("studio-hint")

    async def _measure(self) -> None:
        panel, loop = self._panel, str(self._loop.value)
        job = tune_jobs.measure_response(panel.desk, panel.axis, loop)
        await panel.visitor.do(job, f"Frequency response of axis {panel.axis}", paced=False)

    def _sets(self, gains: tuple[int, ...]) -> dict[str, Sequence[int]]:
        """Return gains and those to compare: the present ones under a slider, else those before the last change."""
        desk, axis = self._panel.desk, self._panel.axis
        present = gains if desk.gains is None else tuple(map(int, desk.gains[axis]))
        if present != gains:
            return {"": gains, ", before": present}
        change = desk.last_change(axis)
        return {"": gains} if change is None or change.after != present else {"": gains, ", before": change.before}

    def show(self, gains: tuple[int, ...]) -> None:
        """Show the response with gains."""
        if not hasattr(self, "_bode"):
            return
        self._stiffness.show()
        desk, axis, loop = self._panel.desk, self._panel.axis, str(self._loop.value)
        measured, dynamics = desk.responses.get((loop, axis)), self._stiffness.dynamics
        gains_by_set = self._sets(gains)
        seen = (loop, id(measured), dynamics, *gains_by_set.values())
        if seen == self._seen:
            return
        self._seen = seen
        self._table.clear()
        if measured is None or not gains:
            panels = [charts.ChartPanel("gain [dB]"), charts.ChartPanel("phase [°]")]
            steps = [charts.ChartPanel("velocity"), charts.ChartPanel("position")]
            charts.show(self._bode, charts.options(panels, "frequency [Hz]", [], hint=HINT))
            charts.show(self._nichols, charts.options(panels[:1], "phase [°]", [], hint=HINT))
            charts.show(self._step, charts.options(steps, "t [ms]", [], hint=HINT))
            self._told.set_text("Then margins and the predicted step follow the gains, also while a slider moves.")
            return
        self._draw(measured, gains_by_set, dynamics)

    def _draw(self, measured: MeasuredLoop, gains: Mapping[str, Sequence[int]], dynamics: Dynamics) -> None:
        axis = self._panel.axis
        sets = response_charts.loops_of(measured, axis, gains)
        charts.show(self._bode, response_charts.bode(sets))
        charts.show(self._nichols, response_charts.nichols(sets, dynamics))
        fit = measured.fits[axis]
        if fit is not None and fit.is_good:
            charts.show(self._step, response_charts.step(measured, axis, gains))
        else:
            why = "A step is predicted from a velocity loop that a model fits."
            charts.show(self._step, charts.options([charts.ChartPanel("velocity")], "t [ms]", [], hint=why))
        own = tuple(map(int, measured.gains[axis]))
        with self._table:
            table(*margin_rows(sets, dynamics))
            shown = [(f"gains{told or ', now'}", *map(str, one)) for told, one in reversed([*gains.items()])]
            table(("", *self._panel.device.gains.titles), shown)
        coherent = 100.0 * float(measured.trusted[~measured.traced, axis].mean())
        how = "" if own == gains[""] else "; what is shown is computed from it"
        told = [f"Measured with the gains {', '.join(map(str, own))}{how}", f"{coherent:.0f} % of the frequencies are "
                f"coherent; {measured.drive_time:.1f} s of drive time", *measured.notes[axis]]  # fmt: skip
        self._told.set_text("; ".join(told))
