"""Bindings: objects of the dictionary with their fields of the drive record and their units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Binding:
    """A row of a device's table of bindings.

    `event` names what a write triggers in the firmware: "controlword", "mode", "set_point", "whole_set_point" (of a
    position with all of its bits) or nothing. `part` selects an element of a deep field. If an object only `shows` a
    field, a restart does not restore the field from it.
    """

    index: int
    sub: int
    field: str
    unit: str = "raw"
    part: int = 0
    event: str = ""
    shows: bool = False
