"""The page Axes: state machine, mode, motion, faults with cause and remedy, switches and temperatures of one axis."""

from __future__ import annotations

import time

from nicegui import ui
from nicegui.events import GenericEventArguments

from drive_env import cia402
from drive_env.cia402 import State
from drive_env.drives.limit_at_rest import SAYS, SHARE
from drive_env.studio import motion_jobs
from drive_env.studio.axis_states import AxisState, ShownQuantity
from drive_env.studio.group_card import group_card
from drive_env.studio.motion_cards import card, move_rows, power_row
from drive_env.studio.page import StudioPage
from drive_env.studio.scope_page import live_plot
from drive_env.studio.session import Session
from drive_env.studio.state_diagram import ARROWS, diagram
from drive_env.studio.visitor import Visitor

REFRESH = 0.1  # s
BITS = (  # of the statusword, shown to users
    ("Target reached", cia402.TARGET_REACHED),
    ("Internal limit active", cia402.INTERNAL_LIMIT),
    ("Warning", cia402.WARNING),
    ("Takes commands (remote)", cia402.REMOTE),
)


def build(session: Session, visitor: Visitor) -> None:
    """Build the page."""
    if session.num_axes > 1:
        group_card(session, visitor)
    with ui.element("div").classes("studio-grid"):
        with ui.element("div").classes("studio-stack"):
            _state_card(visitor)
        with ui.element("div").classes("studio-stack"):
            _motion_card(session, visitor)
            with card("Move", "card-move"):
                move_rows(session, visitor)
        with ui.element("div").classes("studio-stack"):
            _fault_card(session, visitor)
            _around_card(visitor)
    ui.on("studio_command", lambda event: _command(event, visitor))


async def _command(event: GenericEventArguments, visitor: Visitor) -> None:
    word = int(event.args)
    await visitor.do(motion_jobs.command(visitor.axis, word), f"Controlword {word:02X}h")


def _state_card(visitor: Visitor) -> None:
    async def start() -> None:
        await visitor.do(motion_jobs.start_node(visitor.axis), f"Start the node of axis {visitor.axis}")

    with card("State (CiA 402)", "card-state"):
        picture = ui.html(diagram(None), sanitize=False).classes("w-full")
        power_row(visitor)
        silent = ui.element("div").classes("studio-fault").props('data-test=silent role="status"')
        with silent:
            ui.label("▲ The axis' node sends no process data: it has left operational, or has no power.").classes(
                "studio-strong"
            )
            ui.button("Start node", icon="play_circle", on_click=start).props("outline no-caps data-test=start-node")
            ui.label("The axis stays off: reset its fault, and enable it, afterwards.").classes("studio-hint")
        ui.label("Single transitions, also by a lit arrow:").classes("studio-label")
        single = ui.row().classes("studio-buttons")
    shown: list[object] = [object()]

    def show() -> None:
        state = visitor.state
        silent.set_visibility(state is not None and state.is_silent)
        if state is not None and state.state is not shown[0]:
            shown[0] = state.state
            picture.set_content(diagram(state.state))
            single.clear()
            with single:
                _single_transitions(state.state)

    ui.timer(REFRESH, show)


def _single_transitions(state: State | None) -> None:
    """Build a button for each transition that leaves a state by a command."""
    leaving = [arrow for arrow in ARROWS if arrow.start is state and arrow.word is not None]
    for arrow in leaving:
        button = ui.button(f"{arrow.numbers} {arrow.name}").props("outline no-caps dense").classes("studio-transition")
        button.props(f"data-command={arrow.word}")
    if not leaving:
        none = "No state is known." if state is None else "None from this state: the drive goes on by itself."
        ui.label(none).classes("studio-hint")


def _motion_card(session: Session, visitor: Visitor) -> None:
    with card("Motion", "card-motion"):
        values = _Values()
        share = ui.label("").classes("studio-share").props("data-test=current-share")
        live_plot(session, visitor)
        with ui.row().classes("studio-bits"):
            bits = [(ui.label(f"○ {name}").classes("studio-bit"), name, bit) for name, bit in BITS]
        with ui.element("div").classes("studio-fault").props('data-test=at-limit role="status"') as limit:
            ui.label(f"▲ {SAYS[0].upper()}{SAYS[1:]}.").classes("studio-strong")
        limit.set_visibility(False)

    def show() -> None:
        state = visitor.state
        if state is None:
            return
        values.show(state.motion)
        limit.set_visibility(state.is_at_limit)
        _show_share(share, state.current_share)
        for label, name, bit in bits:
            is_set = state.has_bit(bit)
            label.set_text(f"{'●' if is_set else '○'} {name}")
            label.classes(add="is-set" if is_set else "", remove="" if is_set else "is-set")

    ui.timer(REFRESH, show)


def _show_share(label: ui.label, share: float | None) -> None:
    """Show a current as a share of its limit, with colour and sign at the limit; nothing for None."""
    is_at = share is not None and share >= SHARE
    label.classes(add="is-at" if is_at else "", remove="" if is_at else "is-at")
    label.set_text("" if share is None else f"{'▲ ' if is_at else ''}Current: {100.0 * share:.0f} % of its limit")


class _Values:
    """A list of displayed quantities, each with label and unit."""

    def __init__(self) -> None:
        self._box = ui.element("div").classes("studio-values")
        self._rows: dict[str, tuple[ui.label, ui.label]] = {}

    def show(self, quantities: tuple[ShownQuantity, ...]) -> None:
        """Show quantities; labels of new ones are added."""
        for one in quantities:
            if one.label not in self._rows:
                with self._box:
                    ui.label(one.label).classes("name")
                    number, unit = ui.label("").classes("number"), ui.label(one.unit).classes("unit")
                self._rows[one.label] = number, unit
            number, unit = self._rows[one.label]
            number.set_text("—" if one.value is None else f"{one.value:,.3f}".rstrip("0").rstrip("."))
            unit.set_text(one.unit)


def _fault_card(session: Session, visitor: Visitor) -> None:
    with card("Faults", "card-faults"):
        box = ui.column().classes("w-full")

        async def reset() -> None:
            await visitor.do(motion_jobs.reset_fault(visitor.axis), f"Fault reset of axis {visitor.axis}")
            state = visitor.state
            if state is not None and not state.is_in_fault:
                session.forget_faults(visitor.axis)

        ui.button("Reset fault", icon="restart_alt", on_click=reset).props("outline no-caps").props("data-test=reset")
    shown: list[object] = [object()]

    def show() -> None:
        state = visitor.state
        if state is None or (state.faults, state.is_in_fault) == shown[0]:
            return
        shown[0] = (state.faults, state.is_in_fault)
        box.clear()
        with box:
            _faults(state)

    ui.timer(REFRESH, show)


def _faults(state: AxisState) -> None:
    if not state.faults:
        unseen = "The axis is in fault; it told the cause before this page looked." if state.is_in_fault else "None."
        ui.label(unseen).classes("studio-hint")
    for fault in state.faults:
        with ui.element("div").classes("studio-fault"):
            when = time.strftime("%H:%M:%S", time.localtime(fault.at))
            ui.label(f"▲ {fault.code:04X}h  {fault.text.name}  ({when})").classes("studio-strong")
            ui.label(f"Cause: {fault.text.cause}")
            ui.label(f"Remedy: {fault.text.remedy}")


def _around_card(visitor: Visitor) -> None:
    with card("Supply, temperature, switches", "card-around"):
        values = _Values()
        switches = ui.row().classes("studio-bits")
    labels: dict[str, ui.label] = {}

    def show() -> None:
        state = visitor.state
        if state is None:
            return
        values.show(state.slow)
        for name, is_active in state.inputs.items():
            if name not in labels:
                with switches:
                    labels[name] = ui.label("").classes("studio-bit")
            labels[name].set_text(f"{'●' if is_active else '○'} {name}")
            labels[name].classes(add="is-set" if is_active else "", remove="" if is_active else "is-set")

    ui.timer(5 * REFRESH, show)


page = StudioPage("/axes", "Axes", "settings_input_component", 10, build)
