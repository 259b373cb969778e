"""Bindings: which object of the dictionary is which field of the drive record, in which unit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Binding:
    """A row of a device's table of bindings.

    `event` names what a write sets off in the firmware: "controlword", "mode", "set_point", "whole_set_point" (of a
    position by all of its bits) or nothing. `part` chooses
    in a deep field. An object that `shows` a field is not the one whose stored value a restart puts there.
    """

    index: int
    sub: int
    field: str
    unit: str = "raw"
    part: int = 0
    event: str = ""
    shows: bool = False
