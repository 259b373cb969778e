"""The card of step responses: a step recorded with the present gains, above the last five."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from drive_env.studio import charts
from tuning.studio import tune_jobs
from tuning.studio.tune_desk import LAST, StepRecording, reference_of
from tuning.studio.tune_panel import TunePanel, card

KINDS = {"velocity": ("csv", "Velocity step"), "position": ("pp", "Move")}


def step_chart(steps: list[StepRecording]) -> dict[str, Any]:
    """Return the chart of steps, the newest first: strong, the reference dashed, older ones faint."""
    if not steps:
        panels = [charts.ChartPanel("actual value"), charts.ChartPanel("current [A]")]
        return charts.options(panels, "t [s]", [], hint="Press Record: a step with the present gains.")
    newest, reference = steps[0], reference_of(steps)
    what = "speed" if newest.kind == "velocity" else "position"
    panels = [charts.ChartPanel(f"{what} [{newest.unit}]"), charts.ChartPanel("current [A]")]
    lines = [charts.ChartLine("demand", newest.t, newest.demand, 0, 7, 2, 1.5)]
    for age, step in enumerate(steps[: LAST + 1]):
        for panel, values in enumerate((step.actual, step.current)):
            strong = step in (newest, reference)
            lines.append(
                charts.ChartLine(step.name, step.t, values, panel, age, age, 2.4 if strong else 1.2, faint=not strong)
            )
    return charts.options(panels, "t [s]", lines)


class StepCard:
    """The steps of the axis of one page.

    Args:
        panel: The page.
    """

    def __init__(self, panel: TunePanel) -> None:
        self._panel = panel
        self._seen: tuple[Any, ...] = (None,)
        self._newest: StepRecording | None = None

    def build(self) -> None:
        """Build the card."""
        panel = self._panel
        state = panel.visitor.state
        modes = () if state is None else state.modes
        kinds = {kind: title for kind, (mode, title) in KINDS.items() if mode in modes}
        with card(f"Step response, over the last {LAST}", "step"):
            if not kinds:
                ui.label("This drive has neither csv nor pp, in which steps are recorded.").classes("studio-hint")
                return
            with ui.row().classes("studio-buttons"):
                self._kind = ui.select(kinds, value=next(iter(kinds)), label="Step").props("dense outlined")
                self._kind.props("data-test=step-kind")
                rated = panel.rated_rpm
                self._rpm = ui.number("Height [rpm]", value=round(0.1 * rated), min=1).props("dense outlined")
                self._hold = ui.number("Held [ms]", value=100, min=10, max=5000).props("dense outlined")
                self._turns = ui.number("Distance [turns]", value=0.5, min=0.001).props("dense outlined")
                self._rpm.props("data-test=step-rpm")
                self._hold.props("data-test=step-hold")
                self._turns.props("data-test=step-turns")
                ui.button("Record", icon="fiber_manual_record", on_click=self._record).props(
                    "unelevated no-caps data-test=record-step"
                )
            self._kind.on_value_change(self._choose)
            self._choose()
            self._chart = charts.chart("Step responses: demand, actual value and current", "step-chart")
            self._told = ui.column().classes("studio-steps").props("data-test=step-figures")
            ui.label("The motor turns: there and back, from where it stands.").classes("studio-hint")

    def _choose(self) -> None:
        velocity = self._kind.value == "velocity"
        for control in (self._rpm, self._hold):
            control.set_visibility(velocity)
        self._turns.set_visibility(not velocity)
        if hasattr(self, "_chart"):
            self.show()

    async def _record(self) -> None:
        panel, kind = self._panel, str(self._kind.value)
        if kind == "velocity":
            if not self._rpm.value or not self._hold.value:
                panel.visitor.say("a step needs a height and a time", "warning")
                return
            job = tune_jobs.record_velocity_step(
                panel.desk, panel.axis, float(self._rpm.value), 1e-3 * round(float(self._hold.value))
            )
        else:
            if not self._turns.value:
                panel.visitor.say("a move needs a distance", "warning")
                return
            job = tune_jobs.record_move(panel.desk, panel.axis, float(self._turns.value))
        await panel.visitor.do(job, f"Step of axis {panel.axis}")

    def show(self) -> None:
        """Show the recorded steps."""
        if not hasattr(self, "_chart"):
            return
        desk, axis = self._panel.desk, self._panel.axis
        newest = next(
            (step for step in reversed(desk.steps) if step.axis == axis and step.kind in self._kind.options), None
        )
        if newest is not None and newest is not self._newest:
            self._newest = newest
            self._kind.set_value(newest.kind)  # select the kind of the last recording
        steps = desk.last_steps(axis, str(self._kind.value))
        seen = (self._kind.value, *(step.at for step in steps))
        if seen == self._seen:
            return
        self._seen = seen
        charts.show(self._chart, step_chart(steps))
        self._told.clear()
        with self._told:
            reference = reference_of(steps)
            for age, step in enumerate(steps):
                before = "before, " if step is reference else ""
                with ui.element("div").classes("studio-step"):
                    ui.html(_sample(age), sanitize=False)
                    ui.label(f"{before}{step.name}: {step.figures}").classes(
                        "studio-strong" if age == 0 else "studio-hint"
                    )


def _sample(age: int) -> str:
    """Return an SVG sample of a line in the chart."""
    dashes = charts.DASHES[age % len(charts.DASHES)]
    array = "" if isinstance(dashes, str) else f' stroke-dasharray="{" ".join(map(str, dashes))}"'
    return (
        f'<svg width="34" height="8" aria-hidden="true"><line x1="0" y1="4" x2="34" y2="4" stroke-width="2.5" '
        f'stroke="{charts.COLOURS[age % len(charts.COLOURS)]}"{array}/></svg>'
    )
