"""What the cards of one page Tune have in common: its drives, its axis, its motor."""

from __future__ import annotations

from typing import Any

import numpy as np
from nicegui import ui

from drive_env.motors import find_motor
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from tuning.studio.tune_desk import TuneDesk, desk_of


def card(title: str, name: str) -> ui.card:
    """Return a card with a heading."""
    made = ui.card().classes(f"studio-card card-{name}")
    with made:
        ui.label(title).classes("studio-heading").props('role="heading" aria-level="2"')
    return made


class TunePanel:
    """What the cards of one page get.

    Args:
        session: The drives, of a device that is known.
        visitor: The page.

    Attributes:
        device: What they are.
        desk: What all pages Tune know of them.
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
        """The motor that is turned, as far as it is known."""
        made = self.session.glimpse(lambda machine: machine.inside.motor)
        return made or find_motor(self.desk.entries.motor or self.device.default_motor)

    @property
    def supply(self) -> float:
        """Supply voltage [V] that gains in SI are computed with."""
        given = self.desk.entries.supply
        return float(self.device.supply_of(self.motor)) if given is None else given

    @property
    def rated_rpm(self) -> float:
        """Rated speed of the motor [rpm]."""
        return float(self.motor.rated_speed) * 60.0 / (2.0 * np.pi)
