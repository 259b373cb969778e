"""The card of gains: slider, number and SI value of each, undo, and restoring the state before."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from nicegui import ui

from drive_env.devices.gain_set import FEED_FORWARD
from drive_env.devices.gains import gains_in_si
from tuning.certificate.certificate import SI_UNITS
from tuning.studio import tune_jobs
from tuning.studio.tune_panel import TunePanel, card

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gain_set import Gain

STOPS = 400  # of a slider, logarithmic from the least to the greatest integer


def place_of(value: int, highest: int) -> int:
    """Return the slider position for a gain; 0 is the gain 0, the others are logarithmic from 1."""
    if value <= 0:
        return 0
    return 1 + round((STOPS - 1) * math.log(min(value, highest)) / math.log(max(2, highest)))


def value_at(place: int, highest: int) -> int:
    """Return the gain for a slider position: the inverse of `place_of`, except for rounding."""
    if place <= 0:
        return 0
    return min(highest, round(math.exp((place - 1) / (STOPS - 1) * math.log(max(2, highest)))))


def si_texts(device: Device, supply: float, gains: tuple[int, ...]) -> list[str]:
    """Format each gain in SI units; "" for gains that cannot be converted."""
    try:
        values = dict(zip(SI_UNITS, gains_in_si(device, supply, gains), strict=True))
    except (ValueError, ZeroDivisionError):
        return [""] * len(gains)
    texts = []
    for part, raw in zip([(row.loop, row.part) for row in device.gains.rows], gains, strict=True):
        if part == FEED_FORWARD:
            texts.append(f"{0.1 * raw:g} %")
            continue
        value, unit = values[part], SI_UNITS[part]
        what = "T_i = " if part[1] == "I" else ""
        texts.append(f"{what}{value:.4g} {unit}" if math.isfinite(value) else "off" if value == math.inf else "")
    return texts


class GainCard:
    """The gains of the axis of one page.

    Args:
        panel: The page.
        slid: Called when a slider has moved.
    """

    def __init__(self, panel: TunePanel, slid: Callable[[], None]) -> None:
        self._panel = panel
        self._slid = slid
        self._device = panel.device
        self.shown: tuple[int, ...] = ()  # gains in the drive
        self._is_setting = False
        self.wanted: list[int] = []  # values of the sliders, before they are released
        self._moved: set[int] = set()  # columns of sliders that are being moved: readings do not change them
        self._controls: list[tuple[Gain, ui.slider, ui.number, ui.label]] = []

    def build(self) -> None:
        """Build the card."""
        with card("Gains", "gains"):
            with ui.element("div").classes("studio-gains"):
                for column, gain in enumerate(self._device.gains.rows):
                    self._row(column, gain)
            with ui.row().classes("studio-buttons"):
                self._undo = ui.button("Undo", icon="undo", on_click=self._undo_last).props("outline no-caps")
                self._undo.props("data-test=undo")
                self._back = ui.button("State before", icon="settings_backup_restore", on_click=self._restore)
                self._back.props("outline no-caps data-test=restore-before")
                self._back.tooltip(
                    "Stop and switch off the axes, and restore all parameters to before the first change"
                )
            self._told = ui.label("").classes("studio-hint").props("data-test=gain-history")

    def _row(self, column: int, gain: Gain) -> None:
        name = f"{gain.title}, raw"
        with ui.element("div").classes("studio-gain"):
            ui.label(gain.title).classes("name")
            slider = ui.slider(min=0, max=STOPS, value=0, step=1)
            slider.props["aria-label"], slider.props["data-test"] = name, f"slider-{gain.name}"
            number = ui.number("raw", min=0, max=gain.highest, step=1, format="%d").props("dense outlined")
            number.props["aria-label"], number.props["data-test"] = f"{name}, 0 to {gain.highest}", f"gain-{gain.name}"
            unit = ui.label("").classes("unit")
        slider.on_value_change(lambda event: self._slides(column, int(event.value)))
        slider.on("change", lambda event: self._apply(column, value_at(int(event.args), gain.highest)))
        number.on("blur", lambda: self._apply(column, number.value))
        number.on("keydown.enter", lambda: self._apply(column, number.value))
        self._controls.append((gain, slider, number, unit))

    def _slides(self, column: int, place: int) -> None:
        if self._is_setting or not self.wanted:
            return
        value = value_at(place, self._controls[column][0].highest)
        self.preview((*self.wanted[:column], value, *self.wanted[column + 1 :]), slid=column)

    def preview(self, gains: tuple[int, ...], slid: int | None = None) -> None:
        """Show gains while a slider is moved (written on release); `slid` is its column, None on another card."""
        self._is_setting = True
        for column, (value, (gain, slider, number, _)) in enumerate(zip(gains, self._controls, strict=True)):
            if value != self.wanted[column] or column == slid:
                self.wanted[column] = value
                self._moved.add(column)
                number.set_value(value)
                if column != slid:
                    slider.set_value(place_of(value, gain.highest))
        self._is_setting = False
        self._units(gains)
        self._slid()

    async def _apply(self, column: int, value: float | None) -> None:
        if not self._is_setting and value is not None and self.shown:
            await self.write({column: int(value)})

    async def write(self, gains: dict[int, int], what: str = "") -> None:
        """Write gains by column as one change; `what` names it, by default the gain with its old and new value."""
        panel, changed = self._panel, {k: value for k, value in gains.items() if value != self.shown[k]}
        if changed:
            titles = [f"{self._controls[k][0].title} {self.shown[k]} to {value}" for k, value in changed.items()]
            self.wanted = [changed.get(k, value) for k, value in enumerate(self.wanted)]
            job = tune_jobs.set_gains(panel.desk, panel.axis, changed, what or titles[0])
            await panel.visitor.do(job, what or titles[0])
        # A slider that was moved again during the writing is not reset.
        self._moved -= {k for k, value in gains.items() if self.wanted[k] == value}
        if changed:
            self.show(force=True)

    async def _undo_last(self) -> None:
        panel = self._panel
        what = await panel.visitor.do(tune_jobs.undo(panel.desk, panel.axis), "Undo")
        if what is not None:
            panel.visitor.say(f"taken back: {what}", "done")

    async def _restore(self) -> None:
        panel = self._panel
        count = await panel.visitor.do(tune_jobs.restore_before(panel.desk), "Restore the state before")
        if count is not None:
            panel.visitor.say(f"{count} parameters restored; the axes are off", "done")

    def show(self, *, force: bool = False) -> None:
        """Show the present gains."""
        desk, axis = self._panel.desk, self._panel.axis
        if desk.gains is None or axis >= len(desk.gains):
            return
        now = tuple(map(int, desk.gains[axis]))
        if now != self.shown or force:
            old = self.wanted or list(now)
            self.shown = now
            self.wanted = [old[k] if k in self._moved else value for k, value in enumerate(now)]
            self._is_setting = True
            for column, (gain, slider, number, _) in enumerate(self._controls):
                if column not in self._moved:
                    slider.set_value(place_of(now[column], gain.highest))
                    number.set_value(now[column])
            self._is_setting = False
            self._units(tuple(self.wanted))
        change = desk.last_change(axis)
        self._undo.set_enabled(change is not None)
        self._back.set_enabled(desk.before is not None)
        kept = "" if desk.before_file is None else f" The state before is in {desk.before_file}."
        count = sum(one.axis == axis for one in desk.changes)
        last = (
            "Nothing changed yet."
            if change is None
            else f"{count} change{'s' * (count != 1)}; the last: {change.what}."
        )
        self._told.set_text(last + kept)

    def _units(self, gains: tuple[int, ...]) -> None:
        for (*_, unit), text in zip(self._controls, si_texts(self._device, self._panel.supply, gains), strict=True):
            unit.set_text(text)
