"""The page Commission of the studio: the steps from the motor's data to the certificate, with the state of each."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from drive_env.devices.gains import has_linear_model
from drive_env.loops.dynamics import known_dynamics
from drive_env.studio.homing_sketch import homing_sketch
from drive_env.studio.page import StudioPage
from drive_env.studio.runs_folder import url_of
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from tuning.commissioning.axis_limits import LIMITS, limits_of
from tuning.commissioning.path import CommissioningPath, StepState
from tuning.commissioning.steps import STEPS, CommissioningStep
from tuning.studio.commissioning_jobs import room_of
from tuning.studio.tune_panel import TunePanel, card, machine_card

REFRESH = 0.2  # s
SIGNS = {  # for each state: a sign that needs no colour, and a CSS class
    "pending": ("○", ""), "running": ("◔", "is-lit"), "done": ("✓", "is-accepted"), "failed": ("✕", "is-rejected"),
    "skipped": ("»", ""),
}  # fmt: skip


def build(session: Session, visitor: Visitor) -> None:
    """Build the page, or explain why these drives cannot be commissioned."""
    if session.description.device is not None:
        CommissioningPage(TunePanel(session, visitor)).build()
        return
    with card("Commission", "unknown"):
        ui.label(
            f"{session.description.name} is known by its EDS alone, which does not say where a motor's data go. Make "
            "it a device (the page on file formats, section Device), and start the studio with --device."
        ).props("data-test=no-commissioning")


class CommissioningPage:
    """The controls of one page.

    Args:
        panel: Drives and state of the page.
    """

    def __init__(self, panel: TunePanel) -> None:
        self.panel = panel
        self.room = room_of(panel.session)
        self._seen: Any = None

    def build(self) -> None:
        """Build the page."""
        ui.add_head_html('<link rel="stylesheet" href="/studio/assets/pages.css">')
        with ui.element("div").classes("studio-commission"):
            with ui.element("div").classes("studio-stack"):
                machine_card(self.panel)
                self._path_card()
            with card("Steps", "steps"):
                self._steps = ui.element("div").classes("studio-path").props("data-test=steps")
        visitor = self.panel.visitor
        visitor.client.on_delete(lambda: self.room.leave(visitor.id, "its page was closed"))
        ui.timer(REFRESH, self._show)

    def _path_card(self) -> None:
        with card("Commissioning", "path"):
            ui.label(
                "One path from the motor's data to the certificate. The state before is saved first. Until the step "
                "Store is done, Stop and restore, a quick stop in a step, and leaving this page switch the drives off "
                "and give them their parameters from before."
            ).classes("studio-hint")
            with ui.row().classes("studio-buttons"):
                ui.button("Begin", icon="play_arrow", on_click=self._begin).props("unelevated no-caps data-test=begin")
                ui.button("Stop and restore", icon="settings_backup_restore", on_click=self._stop).props(
                    "outline no-caps color=negative data-test=stop-path"
                )
            self._told = ui.label("").classes("studio-strong").props("role=status data-test=path-told")

    async def _begin(self) -> None:
        visitor = self.panel.visitor
        await visitor.do(self.room.begin(visitor.id), "Begin a commissioning")

    async def _stop(self) -> None:
        session = self.panel.session
        if session.job is not None and not session.job.quiet:  # it restores everything when it ends
            session.end_job("the commissioning was stopped from a page")
            return
        await self.panel.visitor.do(lambda drives: self.room.end("it was stopped"), "End of the commissioning")

    def _show(self) -> None:
        """Draw the steps again if the state of one has changed."""
        path, room = self.room.path, self.room
        states = None if path is None else tuple(path.states.values())
        seen = (id(path), states, room.told)
        if seen == self._seen:
            return
        self._seen = seen
        under_way = "" if path is None else f"Under way; the state before is in {path.file}."
        if path is not None and path.is_kept:
            under_way = f"Kept; the state before is in {path.file}."
        self._told.set_text(under_way or room.told or "Say what the machine is, and begin.")
        self._steps.clear()
        with self._steps:
            for number, (name, step) in enumerate(STEPS.items(), 1):
                state = StepState() if path is None else path.states[name]
                self._step(number, step, state, path)

    def _step(self, number: int, step: CommissioningStep, state: StepState, path: CommissioningPath | None) -> None:
        sign, look = SIGNS[state.state]
        is_next = path is not None and path.next == step.name
        here = "is-next" if is_next else ""
        with ui.element("div").classes(f"studio-verdict {look} {here}").props(f"data-test=step-{step.name}"):
            ui.label(f"{sign} {number}. {step.title}: {state.state}").classes("studio-strong")
            for line in state.lines:
                ui.label(line).classes("" if state.state == "failed" else "studio-hint")
            if is_next and path is not None:
                self._details(step, path)
            elif path is not None and self._can_go_back(step, path):
                back = ui.button("Back to here", on_click=lambda: self._back(step)).props("flat dense no-caps")
                back.props(f"data-test=back-{step.name}").classes("studio-back")
            if step.name == "certificate" and state.state == "done" and path is not None:
                self._certificate(path)

    def _can_go_back(self, step: CommissioningStep, path: CommissioningPath) -> bool:
        is_over = path.states[step.name].state in ("done", "skipped") and not path.is_kept
        return is_over and not step.unfit(path.bench.target)

    def _details(self, step: CommissioningStep, path: CommissioningPath) -> None:
        """Describe the next step, ask for its settings, and offer to run it."""
        moves = "The motor turns." if step.moves else "Nothing moves."
        ui.label(f"Look at: {step.look}{'' if step.look.endswith('?') else '.'}")
        ui.label(f"Measured: {step.measured}. {moves}")
        keys = ", ".join(f"{index:04X}h:{sub:02X}" for index, sub in step.writes(path.bench.target))
        ui.label(f"Written: {keys or 'nothing that stays'}.").classes("studio-hint")
        if step.name == "limits":
            self._limits(path, places=False)
        elif step.name == "homing":
            self._methods()
            self._limits(path, places=True)
        elif step.name == "tune" and has_linear_model(self.panel.device):
            chosen = ui.select(list(known_dynamics()), value=str(self.room.plan.dynamics), label="Dynamics")
            chosen.props("dense outlined data-test=path-dynamics").classes("studio-field")
            chosen.on_value_change(lambda event: setattr(self.room.plan, "dynamics", str(event.value)))
        with ui.row().classes("studio-buttons"):
            ui.button("Do it", icon="play_arrow", on_click=lambda: self._run(step)).props(
                f"unelevated no-caps data-test=do-{step.name}"
            )
            ui.button("Leave it out", on_click=lambda: self._skip(step)).props(
                f"outline no-caps data-test=skip-{step.name}"
            )

    def _limits(self, path: CommissioningPath, *, places: bool) -> None:
        with ui.element("div").classes("studio-limits"):
            for name, entries in limits_of(path.bench.target).items():
                if LIMITS[name].is_place == places:
                    field = ui.input(LIMITS[name].meaning.capitalize(), value=self.room.plan.limits.get(name, ""))
                    field.props(f"dense outlined data-test=limit-{name}").tooltip(entries[0].label)
                    field.on_value_change(lambda event, name=name: self._limit(name, str(event.value or "")))
        ui.label(
            "As 3 A, 3000 rpm, 500 rev/s^2, 2 rev, or an integer in the drive's unit. Empty stays as it is."
        ).classes("studio-hint")

    def _limit(self, name: str, text: str) -> None:
        others = {one: value for one, value in self.room.plan.limits.items() if one != name}
        self.room.plan.limits = others | ({name: text} if text.strip() else {})

    def _methods(self) -> None:
        """Offer the homing methods of the drive, each with its sketch."""
        plan = self.room.plan
        choices = {0: "Leave 6098h as it is"} | {number: f"Method {number}" for number in self.room.methods}
        chosen = ui.radio(choices, value=plan.method or 0).props("inline data-test=methods")
        chosen.on_value_change(lambda event: setattr(plan, "method", int(event.value) or None))
        with ui.element("div").classes("studio-methods"):
            for number, text in self.room.methods.items():
                with ui.element("figure"):
                    ui.html(homing_sketch(number, is_known=True), sanitize=False)
                    with ui.element("figcaption"):
                        ui.label(f"{number}: {text}")

    def _certificate(self, path: CommissioningPath) -> None:
        name = path.bench.folder.name
        with ui.row().classes("studio-buttons"):
            ui.link("Open the run", f"/runs?run={name}").classes("studio-open").props("data-test=open-run")
            if (path.bench.folder / "report.html").is_file():
                ui.link("Certificate", url_of(name, "report.html"), new_tab=True).classes("studio-open")

    async def _run(self, step: CommissioningStep) -> None:
        await self.panel.visitor.do(self.room.run(step.name), step.title, paced=False)

    def _skip(self, step: CommissioningStep) -> None:
        if self.room.path is not None:
            self.room.path.skip(step.name)

    async def _back(self, step: CommissioningStep) -> None:
        await self.panel.visitor.do(self.room.back_to(step.name), f"Back to {step.title}")


page = StudioPage("/commission", "Commission", "checklist", 35, build)
