"""Draws the state machine of CiA 402: the present state is lit, and transitions can be pressed."""

from __future__ import annotations

from typing import NamedTuple

from drive_env import cia402
from drive_env.cia402 import State

LEFT, WIDTH, HEIGHT = -46, 580, 458
BOX = (168, 42)


class DiagramPlace(NamedTuple):
    """The position of a state: the centre of its box."""

    x: int
    y: int
    text: str


class Arrow(NamedTuple):
    """A transition: its numbers in the standard, from and to, controlword (None: made by the drive itself), path."""

    numbers: str
    start: State | None
    end: State
    word: int | None
    name: str
    path: str
    label: tuple[int, int]


PLACES = {
    State.NOT_READY_TO_SWITCH_ON: DiagramPlace(110, 36, "Not ready to switch on"),
    State.SWITCH_ON_DISABLED: DiagramPlace(110, 126, "Switch on disabled"),
    State.READY_TO_SWITCH_ON: DiagramPlace(110, 226, "Ready to switch on"),
    State.SWITCHED_ON: DiagramPlace(110, 326, "Switched on"),
    State.OPERATION_ENABLED: DiagramPlace(110, 420, "Operation enabled"),
    State.QUICK_STOP_ACTIVE: DiagramPlace(440, 420, "Quick stop active"),
    State.FAULT_REACTION_ACTIVE: DiagramPlace(440, 226, "Fault reaction active"),
    State.FAULT: DiagramPlace(440, 126, "Fault"),
}
ARROWS = (
    Arrow("1", State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, None, "", "M110 57V103", (96, 82)),
    Arrow("2", State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, cia402.SHUTDOWN, "Shutdown",
          "M80 147V203", (72, 178)),
    Arrow("7", State.READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, cia402.DISABLE_VOLTAGE, "Disable voltage",
          "M140 205V149", (148, 178)),
    Arrow("3", State.READY_TO_SWITCH_ON, State.SWITCHED_ON, cia402.SWITCH_ON, "Switch on", "M80 247V303", (72, 278)),
    Arrow("6", State.SWITCHED_ON, State.READY_TO_SWITCH_ON, cia402.SHUTDOWN, "Shutdown", "M140 305V249", (148, 278)),
    Arrow("4", State.SWITCHED_ON, State.OPERATION_ENABLED, cia402.ENABLE_OPERATION, "Enable operation",
          "M80 347V397", (72, 376)),
    Arrow("5", State.OPERATION_ENABLED, State.SWITCHED_ON, cia402.SWITCH_ON, "Disable operation",
          "M140 399V349", (148, 376)),
    Arrow("11", State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, cia402.QUICK_STOP, "Quick stop",
          "M194 412H354", (274, 405)),
    Arrow("16", State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED, cia402.ENABLE_OPERATION, "Enable operation",
          "M356 432H196", (274, 448)),
    Arrow("12", State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED, cia402.DISABLE_VOLTAGE, "Disable voltage",
          "M440 399V330Q440 300 400 300H300Q262 300 262 262V150Q262 126 238 126H196", (330, 293)),
    Arrow("15", State.FAULT, State.SWITCH_ON_DISABLED, cia402.FAULT_RESET, "Fault reset", "M356 112H196", (274, 105)),
    Arrow("14", State.FAULT_REACTION_ACTIVE, State.FAULT, None, "", "M440 205V149", (454, 180)),
)  # fmt: skip


def diagram(state: State | None) -> str:
    """Return the SVG with a state lit."""
    arrows = "".join(_arrow(arrow, state) for arrow in ARROWS)
    boxes = "".join(_box(one, place, one is state) for one, place in PLACES.items())
    marker = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="6.5" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0 0 8 4 0 8z" fill="context-stroke"/></marker></defs>'
    )
    lit = "unknown" if state is None else PLACES[state].text
    return (
        f'<svg class="studio-diagram" viewBox="{LEFT} 8 {WIDTH} {HEIGHT}" role="group" '
        f'aria-label="State machine of CiA 402; the present state is {lit}">{marker}{arrows}{boxes}</svg>'
    )


def _box(state: State, place: DiagramPlace, is_lit: bool) -> str:
    width, height = BOX
    lit = " is-lit" if is_lit else ""
    return (
        f'<g class="state state-{int(state)}{lit}"><rect x="{place.x - width // 2}" y="{place.y - height // 2}" '
        f'width="{width}" height="{height}" rx="8"/><text x="{place.x}" y="{place.y + 5}">{place.text}</text></g>'
    )


def _arrow(arrow: Arrow, state: State | None) -> str:
    """Draw an arrow; it can be pressed if it leaves the present state by a command."""
    can = arrow.word is not None and arrow.start is state
    x, y = arrow.label
    sideways = "start" if x in (148, 454) else "end" if x in (72, 96) else "middle"
    text = f"{arrow.numbers} {arrow.name}".strip()
    pressed = (
        f' role="button" tabindex="0" data-command="{arrow.word}" aria-label="{text}, transition of the present state"'
        if can
        else ""
    )
    return (
        f'<g class="arrow{" can" if can else ""}"{pressed}><path class="hit" d="{arrow.path}"/>'
        f'<path class="line" d="{arrow.path}" marker-end="url(#tip)"/>'
        f'<text x="{x}" y="{y}" text-anchor="{sideways}">{text}</text></g>'
    )
