"""The slider from soft to stiff: sets all gains of a cascade by its measured velocity loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nicegui import ui

from drive_env.loops.dynamics import DEFAULT, find_dynamics, known_dynamics
from tuning.studio.response_charts import limits_of

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.soft_to_stiff import SoftToStiff
    from tuning.studio.gain_card import GainCard
    from tuning.studio.tune_panel import TunePanel

STOPS = 100


class StiffnessSlider:
    """The slider from soft to stiff for the axis of one page: moving it shows the gains, releasing it writes them.

    Args:
        panel: The page.
        gains: Card of the page's gains.
    """

    def __init__(self, panel: TunePanel, gains: GainCard) -> None:
        self._panel, self._gains = panel, gains
        self._place = list(known_dynamics()).index(DEFAULT) * STOPS // (len(known_dynamics()) - 1)
        self._seen: tuple[object, ...] = ()
        self._is_setting = False

    @property
    def designed(self) -> SoftToStiff | str:
        """The gains of the slider, or the reason why no gains were found."""
        desk, axis = self._panel.desk, self._panel.axis
        if ("velocity", axis) not in desk.responses:
            return "No response of the velocity loop yet: press Measure, and the slider has gains from soft to stiff."
        return desk.soft_to_stiff.get(axis, "No gains were designed by this response yet: press Measure.")

    @property
    def dynamics(self) -> Dynamics:
        """The dynamics at the slider's position; the default ones if it has no gains."""
        designed = self.designed
        return find_dynamics(DEFAULT) if isinstance(designed, str) else designed.dynamics(self._place / STOPS)

    def build(self) -> None:
        """Build the slider."""
        names = list(known_dynamics())
        with ui.element("div").classes("studio-stiffness"):
            self._slider = ui.slider(min=0, max=STOPS, value=self._place, step=1)
            self._slider.props(f'aria-label="Dynamics, {names[0]} to {names[-1]}" data-test=stiffness')
            self._slider.props["marker-labels"] = [
                {"value": k * STOPS / (len(names) - 1), "label": name} for k, name in enumerate(names)
            ]
        self._told = ui.label("").classes("studio-hint").props("data-test=stiffness-told role=status")
        self._slider.on_value_change(lambda event: self._slides(int(event.value)))
        self._slider.on("change", lambda event: self._apply(int(event.args)))

    def _at(self, place: int) -> tuple[int, ...]:
        designed, now = self.designed, self._gains.shown
        return () if isinstance(designed, str) or not now else designed.at(place / STOPS, now)

    def _slides(self, place: int) -> None:
        if self._is_setting or not self._at(place):
            return
        self._place = place
        self._tell()
        self._gains.preview(self._at(place))

    async def _apply(self, place: int) -> None:
        if gains := self._at(place):
            await self._gains.write(dict(enumerate(gains)), f"dynamics {self.dynamics.name}")
            self.show()

    def show(self) -> None:
        """Move the slider to the position of the present gains."""
        designed, now = self.designed, self._gains.shown
        if (id(designed), now) == self._seen:
            return
        self._seen = id(designed), now
        self._slider.set_enabled(not isinstance(designed, str))
        found = [place for place in range(STOPS + 1) if self._at(place) == now]
        if found and self._place not in found:
            self._place, self._is_setting = found[0], True
            self._slider.set_value(self._place)
            self._is_setting = False
        self._tell()

    def _tell(self) -> None:
        designed = self.designed
        if isinstance(designed, str):
            self._told.set_text(designed)
            return
        told = [f"Gains for {limits_of(self.dynamics)}."]
        if self._at(self._place) != self._gains.shown:
            told.append("Written when you let the slider go; the drive has others now.")
        names = [name for name, kept in zip(known_dynamics(), designed.slack, strict=True) if kept < 0.0]
        if names:
            told.append(
                f"No gains of this axis keep {' and '.join(names)} dynamics; there it has those that come nearest."
            )
        self._told.set_text(" ".join(told))
