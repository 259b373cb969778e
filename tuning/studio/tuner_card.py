"""The cards of automatic tuners: start, progress, trials, verdict, certificate."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import ui

from drive_env.devices.gains import has_linear_model
from drive_env.loops.dynamics import DEFAULT, known_dynamics
from drive_env.studio.parts import studio_parts
from drive_env.studio.runs_folder import RUNS, url_of
from tuning.runs.provenance import run_folder
from tuning.studio import tune_jobs
from tuning.studio.rules_card import table
from tuning.studio.tune_desk import AxisVerdict, TunerSession
from tuning.studio.tune_panel import TunePanel, card

if TYPE_CHECKING:
    from tuning.target import Target

Work = Callable[["Target", TunerSession, Callable[[str, float], None]], Any]

# For each verdict: CSS class, and a sign that needs no colour.
LOOKS = {
    "accepted": ("is-accepted", "✓"),
    "accepted with reservations": ("is-reserved", "!"),
    "rejected": ("is-rejected", "✕"),
}
LINES = 12  # messages of a run that are shown


class TunerCard:
    """Starts tuners, and shows the present or last run; parts of other packages get it.

    Args:
        panel: The page.
    """

    def __init__(self, panel: TunePanel) -> None:
        self.panel = panel
        self._seen: tuple[Any, ...] = ()

    def build(self) -> None:
        """Build the card, and the parts of other packages."""
        panel = self.panel
        with card("Tune automatically", "tuner"):
            ui.label(
                "auto identifies the axes, searches gains, tries and verifies them; gains that fail a check are rolled "
                "back. The motor turns for 9 to 20 s an axis. Quick stop ends it, and the gains before come back."
            ).classes("studio-hint")
            with ui.row().classes("studio-buttons"):
                ui.button("Run auto", icon="auto_fix_high", on_click=self._auto).props(
                    "unelevated no-caps data-test=run-auto"
                )
                ui.button("Stop and roll back", icon="stop", on_click=self._stop).props(
                    "outline no-caps color=negative data-test=stop-run"
                )
                self._dynamics = ui.select(list(known_dynamics()), value=DEFAULT, label="Dynamics")
                self._dynamics.props("dense outlined data-test=dynamics")
                self._dynamics.set_visibility(has_linear_model(panel.device))
                self._store = ui.checkbox("Store the gains in the drive", value=not panel.desk.is_emulated)
                self._store.set_visibility(not panel.desk.is_emulated)
            for part in studio_parts("/tune"):
                part.build(self)

    def build_run(self) -> None:
        """Build the card of the present or last run."""
        with card("Run", "run"):
            self._head = ui.label("No run yet.").classes("studio-strong").props("role=status data-test=run-head")
            self._bar = ui.linear_progress(value=0.0, show_value=False).props('aria-label="Progress of the run"')
            self._bar.set_visibility(False)
            self._lines = ui.column().classes("studio-lines").props("data-test=run-lines")
            self._trials = ui.element("div").classes("studio-scroll w-full").props("data-test=run-trials")
            self._verdicts = ui.column().classes("w-full").props("data-test=run-verdicts")

    async def _auto(self) -> None:
        store = bool(self._store.value)
        dynamics = str(self._dynamics.value)
        title = f"auto, {dynamics} dynamics" if has_linear_model(self.panel.device) else "auto"
        await self.start(title, "auto", tune_jobs.auto(store, dynamics))

    async def start(self, title: str, kind: str, work: Work, columns: tuple[str, ...] = ()) -> None:
        """Run a tuner; `kind` is part of its folder's name, `columns` are the titles of its trials."""
        panel = self.panel
        if panel.desk.run is not None and not panel.desk.run.is_over:
            panel.visitor.say(f"{panel.desk.run.title} is under way; stop it first", "warning")
            return
        run = TunerSession(title, run_folder(kind, RUNS), columns=columns)
        await panel.visitor.do(tune_jobs.run_tuner(panel.desk, run, work), title, paced=False)

    def _stop(self) -> None:
        run = self.panel.desk.run
        if run is None or run.is_over:
            self.panel.visitor.say("no tuner is running", "info")
            return
        self.panel.session.end_job(f"{run.title} was stopped from a page")

    def show(self) -> None:
        """Show the progress of the run."""
        run = self.panel.desk.run
        if run is None:
            return
        seen = (id(run), len(run.lines), len(run.trials), round(run.share, 2), run.is_over)
        if seen == self._seen:
            return
        self._seen = seen
        self._bar.set_visibility(not run.is_over)
        self._bar.set_value(run.share)
        state = f"{100.0 * run.share:.0f} %" if not run.is_over else run.failure or "done"
        self._head.set_text(f"{run.title}: {state}")
        self._lines.clear()
        with self._lines:
            for k, text in enumerate(run.lines[-LINES:], max(1, len(run.lines) - LINES + 1)):
                ui.label(f"{k}. {text}").classes("studio-hint")
        self._trials.clear()
        if run.trials:
            with self._trials:
                table(run.columns, run.trials)
        self._verdicts.clear()
        with self._verdicts:
            for verdict in run.verdicts:
                _verdict(verdict)
            if run.verdicts:
                _certificate(run)


def _verdict(found: AxisVerdict) -> None:
    look, sign = LOOKS[found.verdict]
    with ui.element("div").classes(f"studio-verdict {look}").props(f"data-test=verdict-{found.axis}"):
        ui.label(f"{sign} axis {found.axis}: {found.verdict}").classes("studio-strong")
        if found.reason:
            ui.label(f"{found.reason}; the gains from before are in the drive")
        for one in found.reservations:
            ui.label(f"Reservation: {one}")
        ui.label(f"Before: {', '.join(map(str, found.before))}. Now: {', '.join(map(str, found.after))}.")
        for note in found.notes:
            ui.label(note).classes("studio-hint")


def _certificate(run: TunerSession) -> None:
    name = run.folder.name
    with ui.row().classes("studio-buttons"):
        ui.link("Open the run", f"/runs?run={name}").classes("studio-open").props("data-test=open-run")
        if (Path(run.folder) / "report.html").is_file():
            ui.link("Certificate in a tab of its own", url_of(name, "report.html"), new_tab=True).classes("studio-open")
    if (Path(run.folder) / "report.html").is_file():
        frame = ui.element("iframe").classes("studio-report")
        frame.props["sandbox"] = ""  # no script, no form
        frame.props["src"], frame.props["title"] = url_of(name, "report.html"), f"Certificate of {run.title}"
        frame.props("data-test=report")
