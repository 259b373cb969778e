"""State and controls that the cards of one page Tune share: drives, axis, motor."""

from __future__ import annotations

from typing import Any

import numpy as np
from nicegui import ui

from drive_env.motors import MOTORS, find_motor
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from tuning.studio.tune_desk import TuneDesk, desk_of
from tuning.target import AXES

COUPLING = {
    "apart": "separate machines", "coupled": "joints of one machine", "linked": "they drive one part, as a gantry",
}  # fmt: skip
assert tuple(COUPLING) == AXES


def card(title: str, name: str) -> ui.element:
    """Return a section with a heading that folds it."""
    with ui.element("details").classes(f"studio-card studio-fold card-{name}").props("open"):
        with ui.element("summary"):
            ui.label(title).classes("studio-heading").props('role="heading" aria-level="2"')
        return ui.element("div").classes("studio-fold-content")


class TunePanel:
    """The state that the cards of one page share.

    Args:
        session: The drives, of a known device.
        visitor: The page.

    Attributes:
        device: Device of the drives.
        desk: State that all pages Tune share.
    """

    def __init__(self, session: Session, visitor: Visitor) -> None:
        assert session.description.device is not None
        self.device = session.description.device
        self.session = session
        self.visitor = visitor
        self.desk: TuneDesk = desk_of(session)

    @property
    def axis(self) -> int:
        """The axis of the page."""
        return self.visitor.axis

    @property
    def motor(self) -> Any:
        """The motor: the emulated one, else the user's choice, else the device's usual one."""
        made = self.session.glimpse(lambda machine: machine.inside.motor)
        return made or find_motor(self.desk.entries.motor or self.device.default_motor)

    @property
    def supply(self) -> float:
        """Supply voltage for gains in SI units [V]."""
        given = self.desk.entries.supply
        return float(self.device.supply_of(self.motor)) if given is None else given

    @property
    def rated_rpm(self) -> float:
        """Rated speed of the motor [rpm]."""
        return float(self.motor.rated_speed) * 60.0 / (2.0 * np.pi)


def machine_card(panel: TunePanel) -> None:
    """Build the card for data that cannot be read from a bus: motor, travel, supply, coupling."""
    desk = panel.desk
    emulated = desk.is_emulated
    with card("Machine", "machine"):
        with ui.row().classes("studio-buttons"):
            if not emulated:
                names, usual = sorted(MOTORS), panel.device.default_motor
                now = desk.entries.motor or usual
                motor = ui.select([*names, *({now} - {*names})], value=now, label="Motor, or the path of its file",
                                  with_input=True, new_value_mode="add-unique")  # fmt: skip
                motor.props("dense outlined data-test=motor").classes("grow")
                motor.on_value_change(lambda event: choose(str(event.value or usual)))
            travel = ui.input(
                "Travel [turns]", value=desk.entries.travel, placeholder="the load's" if emulated else "-0.5:0.5"
            ).props("dense outlined data-test=travel").classes("grow")  # fmt: skip
            travel.on_value_change(lambda event: setattr(desk.entries, "travel", str(event.value or "")))
            if not emulated and panel.session.num_axes > 1:
                axes = ui.select(COUPLING, value=desk.entries.axes, label="Axes").props("dense outlined")
                axes.on_value_change(lambda event: setattr(desk.entries, "axes", str(event.value)))
            if not emulated:
                supply = ui.number("Supply [V]", value=panel.supply, min=1).props("dense outlined data-test=supply")
                supply.on_value_change(lambda event: setattr(desk.entries, "supply", event.value))
        own = "; empty: as far as the load lets it" if emulated else ""
        ui.label(f"How far the rotor may turn from where it stands: LOW:HIGH, as -0.5:0.5, or free{own}.").classes(
            "studio-hint"
        )

    def choose(name: str) -> None:
        """Select a motor, and show its supply voltage if the user gave none."""
        _choose_motor(panel, name)
        if desk.entries.supply is None:
            supply.set_value(panel.supply)
            desk.entries.supply = None  # the displayed value was not entered by the user


def _choose_motor(panel: TunePanel, name: str) -> None:
    """Select a motor of the catalogue, or the user's own by its file."""
    try:
        find_motor(name)
    except (ValueError, OSError) as error:
        panel.visitor.say(f"{panel.desk.entries.motor or panel.device.default_motor} stays: {error}", "error")
        return
    panel.desk.entries.motor = name
