"""The card of identification and rules: values with their intervals, and the proposals of all rules."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nicegui import ui

from tuning.estimate import interval
from tuning.identify.identified_axis import TITLES
from tuning.identify.working_state import check_identifiable
from tuning.rules.rules_by_name import MEANINGS
from tuning.studio import tune_jobs
from tuning.studio.tune_panel import TunePanel, card

if TYPE_CHECKING:
    from tuning.compare.side_by_side import AxisRules
    from tuning.identify.identified_axis import Identification

LONG = 14  # least length of a cell that is laid out as text instead of a number


def identified_rows(found: Identification) -> list[tuple[str, str, str]]:
    """Return rows of title, value with unit, and interval or the reason of a refusal."""
    rows = []
    for name, estimate in found.estimates.items():
        if estimate.is_known:
            unit = "" if estimate.unit == "1" else f" {estimate.unit}"
            rows.append((TITLES[name], f"{estimate.value:.4g}{unit}", interval(estimate.low, estimate.high)))
        else:
            rows.append((TITLES[name], "not identified", estimate.reason))
    return rows


class RulesCard:
    """Identification and rules of the axis of one page.

    Args:
        panel: The page.
    """

    def __init__(self, panel: TunePanel) -> None:
        self._panel = panel
        self._seen: tuple[int, int] = (0, 0)

    def build(self) -> None:
        """Build the card."""
        panel = self._panel
        with card("Identification and rules", "rules"):
            try:
                check_identifiable(panel.device)
            except ValueError as error:
                ui.label(str(error)).classes("studio-hint")
                return
            with ui.row().classes("studio-buttons"):
                ui.button("Identify", icon="manage_search", on_click=self._identify).props(
                    "unelevated no-caps data-test=identify"
                )
                ui.label("The motor turns, up to its rated current and 0.7 of its rated speed.").classes("studio-hint")
            self._found = ui.element("div").classes("studio-scroll w-full").props("data-test=identified")
            self._rules = ui.element("div").classes("studio-scroll w-full").props("data-test=rules")

    async def _identify(self) -> None:
        panel = self._panel
        await panel.visitor.do(tune_jobs.identify_axes(panel.desk), "Identification", paced=False)

    def show(self) -> None:
        """Show the results."""
        desk, axis = self._panel.desk, self._panel.axis
        seen = id(desk.identified), id(desk.rules)
        if not hasattr(self, "_found") or seen == self._seen or axis >= len(desk.identified):
            return
        self._seen = seen
        self._found.clear()
        with self._found:
            table(("Parameter", "Value", "95 % interval, or the reason why there is none"),
                  identified_rows(desk.identified[axis]))  # fmt: skip
        self._rules.clear()
        with self._rules:
            self._show_rules(desk.rules[axis])

    def _show_rules(self, rules: AxisRules) -> None:
        from tuning.compare.side_by_side import outer_margins

        plant = rules.plant
        if isinstance(plant, str):
            ui.label(f"No rule proposes gains: {plant}")
            return
        known = self._panel.device
        ui.label("What each rule would give, with the margins of the velocity loop by the model").classes(
            "studio-label"
        )
        titles = (*known.gains.titles, "crossover [Hz]", "phase margin [°]", "gain margin [dB]")
        with ui.element("table").classes("studio-table"):
            with ui.element("thead"), ui.element("tr"):
                for text in ("Rule", *titles, ""):
                    with ui.element("th"):
                        ui.label(text)
            with ui.element("tbody"):
                for name, proposal in rules.rows.items():
                    found = outer_margins(known, plant, proposal.gains)["velocity"]
                    figures = [
                        f"{x:.0f}" if math.isfinite(x) else "-"
                        for x in (found.crossover_hz, found.phase_deg, found.gain_db)
                    ]
                    self._rule(name, proposal.gains, figures, proposal.notes)

    def _rule(self, name: str, gains: tuple[int, ...], figures: list[str], notes: tuple[str, ...]) -> None:
        with ui.element("tr"):
            with ui.element("th"):
                ui.label(name.replace("_", " ")).tooltip("; ".join((MEANINGS.get(name, ""), *notes)))
            for text in (*map(str, gains), *figures):
                with ui.element("td"):
                    ui.label(text)
            with ui.element("td"):
                button = ui.button("Apply", on_click=lambda: self._apply(name, gains)).props("outline dense no-caps")
                button.props(f'aria-label="Apply {name.replace("_", " ")}" data-test=apply-{name}')

    async def _apply(self, name: str, gains: tuple[int, ...]) -> None:
        panel, what = self._panel, f"gains of {name.replace('_', ' ')}"
        job = tune_jobs.set_gains(panel.desk, panel.axis, dict(enumerate(gains)), what)
        await panel.visitor.do(job, f"Apply {name.replace('_', ' ')}")


def table(head: Sequence[str], rows: Sequence[tuple[str, ...]]) -> None:
    """Build a table; the first column has the names of its rows."""
    with ui.element("table").classes("studio-table"):
        with ui.element("thead"), ui.element("tr"):
            for text in head:
                with ui.element("th"):
                    ui.label(text)
        with ui.element("tbody"):
            for first, *others in rows:
                with ui.element("tr"):
                    with ui.element("th"):
                        ui.label(first)
                    for text in others:
                        is_text = any(letter.isalpha() for letter in text) and len(text) > LONG
                        with ui.element("td").classes("text" if is_text else ""):
                            ui.label(text)
