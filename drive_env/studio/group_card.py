"""All axes on the page Axes: their table, and controls that enable, jog and stop a group of axes together."""

from __future__ import annotations

from nicegui import ui

from drive_env.studio import motion_jobs
from drive_env.studio.axis_states import MODE_NAMES, AxisState
from drive_env.studio.layout import LOOKS, state_name
from drive_env.studio.motion_cards import card
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

REFRESH = 0.2  # s


def group_card(session: Session, visitor: Visitor) -> None:
    """Build the card of all axes."""
    with card("All axes", "card-group"):
        with ui.element("div").classes("w-full studio-scroll"):
            table = ui.element("table").classes("studio-readout").props("data-test=axes")
        _power_row(session, visitor)
        ui.label("Jog together: as long as you hold; all stop where one is lost").classes("studio-label")
        with ui.row().classes("studio-buttons"):
            speed = ui.input("Jog speed of each", value=visitor.group_speed).props("dense outlined").classes("grow")
            speed.bind_value(visitor, "group_speed").props("data-test=group-speed")
            for text, icon, way in (("Backwards", "fast_rewind", -1), ("Forwards", "fast_forward", 1)):
                button = ui.button(text, icon=icon).props(f"no-caps outline data-jog={way} data-group=all")
                button.classes("studio-jog").props(f'aria-label="{text}, all axes of the group"')
    cells: list[list[ui.label]] = []

    def show() -> None:
        if not cells and session.axes[0].motion:
            with table:
                cells.extend(_rows(session, visitor))
        for labels, axis in zip(cells, session.axes, strict=False):
            for label, text in zip(labels, _texts(axis), strict=False):
                label.set_text(text)

    ui.timer(REFRESH, show)


def _rows(session: Session, visitor: Visitor) -> list[list[ui.label]]:
    """Build the rows of the table; return the labels of each axis."""

    def choose(axis: int, is_in: bool) -> None:
        visitor.group = visitor.group | {axis} if is_in else visitor.group - {axis}

    with ui.element("tr"):
        for text in (
            "In the group",
            "State",
            "Mode",
            *(one.label.removesuffix(" actual value") for one in session.axes[0].motion),
        ):
            with ui.element("th"):
                ui.label(text)
    made = []
    for axis in session.axes:
        with ui.element("tr"):
            with ui.element("th").props("scope=row"):
                box = ui.checkbox(axis.name, value=axis.axis in visitor.group).props(f"dense data-test=in-{axis.axis}")
                box.on_value_change(lambda event, number=axis.axis: choose(number, bool(event.value)))
            labels = []
            for _ in _texts(axis):
                with ui.element("td"):
                    labels.append(ui.label(""))
            made.append(labels)
    return made


def _texts(axis: AxisState) -> tuple[str, ...]:
    """Return state, mode and motion of an axis as texts."""
    sign = "?" if axis.state is None else LOOKS[axis.state][1]
    return f"{sign} {state_name(axis.state)}", axis.mode or "—", *(str(one) for one in axis.motion)


def _power_row(session: Session, visitor: Visitor) -> None:
    """Build the row that enables, disables and stops the axes of the group."""
    shared = [name for name in MODE_NAMES if all(name in axis.modes for axis in session.axes)]
    first = "pp" if "pp" in shared else shared[0]

    def of_group(what: str) -> list[int]:
        if not visitor.group:
            visitor.say(f"{what}: no axis is in the group; choose some in the table", "warning")
        return sorted(visitor.group)

    async def enable() -> None:
        if axes := of_group("Enable"):
            await visitor.do(motion_jobs.enable(axes, str(mode.value)), f"Enable {visitor.named(axes)}")

    async def disable() -> None:
        if axes := of_group("Disable"):
            await visitor.do(motion_jobs.disable(axes), f"Disable {visitor.named(axes)}")

    def stop() -> None:
        if axes := of_group("Stop"):
            mask = motion_jobs.masks_of(session.num_axes, axes)
            session.presence.stop(mask, f"the group of a page, {visitor.named(axes)}")

    with ui.row().classes("studio-buttons"):
        mode = ui.select(shared, value=first, label="Mode of operation").props("dense outlined").classes("grow")
        mode.props("data-test=group-mode")
        for text, icon, press, look in (
            ("Enable group", "power", enable, "unelevated color=positive"),
            ("Disable group", "power_off", disable, "outline"),
            ("Stop group", "front_hand", stop, "unelevated color=negative"),
        ):  # fmt: skip
            name = text.lower().replace(" ", "-")
            ui.button(text, icon=icon, on_click=press).props(f"no-caps {look} data-test={name}")
