"""The page Tune of the studio."""

from __future__ import annotations

import asyncio
import contextlib

from nicegui import ui

from drive_env.studio.page import StudioPage
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from tuning.studio import tune_jobs
from tuning.studio.gain_card import GainCard
from tuning.studio.response_card import ResponseCard
from tuning.studio.rules_card import RulesCard
from tuning.studio.step_card import StepCard
from tuning.studio.stiffness_slider import StiffnessSlider
from tuning.studio.tune_panel import TunePanel, card, machine_card
from tuning.studio.tuner_card import TunerCard

REFRESH = 0.2  # s
# On a narrow page all cards except machine and gains begin folded: their headings are then visible.
FOLD = """
if (innerWidth <= 600)
  for (const one of [...document.querySelectorAll(".studio-fold")].slice(2)) one.open = false;
"""
REREAD = 2.0  # s between two readings of the gains, which another page or master may write


def build(session: Session, visitor: Visitor) -> None:
    """Build the page, or explain why these drives cannot be tuned."""
    if session.description.device is not None:
        TunePage(TunePanel(session, visitor)).build()
        return
    with card("Tune", "unknown"):
        ui.label(
            f"{session.description.name} is known by its EDS alone, which says neither which objects are gains nor in "
            "what units it counts: there is no tuning for it. Make it a device (the page on file formats, section "
            "Device), and start the studio with --device."
        ).props("data-test=no-tuning")


class TunePage:
    """The controls of one page.

    Args:
        panel: State and drives that its cards share.
    """

    def __init__(self, panel: TunePanel) -> None:
        self.panel = panel
        self.gains, self.step = GainCard(panel, self._gains_slide), StepCard(panel)
        self.response = ResponseCard(panel, StiffnessSlider(panel, self.gains))
        self.rules, self.tuner = RulesCard(panel), TunerCard(panel)
        self._seen = -1

    def build(self) -> None:
        """Build the page."""
        ui.add_head_html('<link rel="stylesheet" href="/studio/assets/pages.css">')
        with ui.element("div").classes("studio-tune"):
            with ui.element("div").classes("studio-stack"):
                machine_card(self.panel)
                self.gains.build()
                self.tuner.build()
            with ui.element("div").classes("studio-stack"):
                self.step.build()
                self.response.build()
            with ui.element("div").classes("studio-stack"):
                self.tuner.build_run()
                self.rules.build()
        ui.run_javascript(FOLD)
        self.panel.visitor.hand_in(tune_jobs.look(self.panel.desk), "Read the gains")
        ui.timer(REFRESH, self._show)
        ui.timer(REREAD, self._reread)

    def _gains_slide(self) -> None:
        """Show the response with the gains of the sliders."""
        self.response.show(tuple(self.gains.wanted))

    def _show(self) -> None:
        if self.panel.desk.version == self._seen:
            return
        self._seen = self.panel.desk.version
        self.gains.show()
        self.step.show()
        self.response.show(tuple(self.gains.wanted))
        self.rules.show()
        self.tuner.show()

    async def _reread(self) -> None:
        """Read the gains again, unless another job runs."""
        session, page = self.panel.session, self.panel.visitor.id
        if session.job is None and not session.waiting:
            future = session.do(tune_jobs.look(self.panel.desk), "Read the gains", page=page, quiet=True)
            with contextlib.suppress(Exception):  # the next reading may succeed; other pages show the error
                await asyncio.wrap_future(future)


page = StudioPage("/tune", "Tune", "tune", 40, build)
