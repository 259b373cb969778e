"""The frame of every page: navigation, the state of the axis, the present job, and the quick stop."""

from __future__ import annotations

import time
from collections.abc import Sequence

from nicegui import ui

from drive_env.cia402 import State
from drive_env.studio.axis_states import AxisState
from drive_env.studio.page import StudioPage
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

SCRIPTS = ("studio", "scope", "dictionary")
REFRESH = 0.2  # s between two readings of the session
# For each state: CSS class, and a sign that needs no colour.
LOOKS = {
    State.NOT_READY_TO_SWITCH_ON: ("is-off", "○"),
    State.SWITCH_ON_DISABLED: ("is-off", "○"),
    State.READY_TO_SWITCH_ON: ("is-ready", "◔"),
    State.SWITCHED_ON: ("is-ready", "◑"),
    State.OPERATION_ENABLED: ("is-on", "●"),
    State.QUICK_STOP_ACTIVE: ("is-stopping", "■"),
    State.FAULT_REACTION_ACTIVE: ("is-fault", "▲"),
    State.FAULT: ("is-fault", "▲"),
}
COLOURS = {  # Okabe and Ito's, which colour-blind users can distinguish
    "primary": "#0072B2", "secondary": "#56B4E9", "accent": "#CC79A7", "positive": "#009E73", "negative": "#C2410C",
    "warning": "#E69F00", "info": "#0072B2",
}  # fmt: skip


def state_name(state: State | None) -> str:
    """Return a state's name as in the standard."""
    return "unknown" if state is None else state.name.replace("_", " ").capitalize()


def frame(session: Session, visitor: Visitor, pages: Sequence[StudioPage], page: StudioPage) -> None:
    """Build a page: its frame, and its content once the drives are open."""
    ui.colors(**COLOURS)
    scripts = "".join(f'<script src="/studio/assets/{name}.js"></script>' for name in SCRIPTS)
    ui.add_head_html(f'<link rel="stylesheet" href="/studio/assets/studio.css">{scripts}')
    ui.run_javascript(f"studio.start({visitor.id!r})")
    drawer = _navigation(visitor, pages, page)
    _header(session, visitor, drawer, page)
    with ui.column().classes("studio-content w-full"):
        if session.state == "open":
            _content(session, visitor, page)
        else:
            _await_drives(session)
    _stop_button()
    _tell_events(session, visitor)


def _content(session: Session, visitor: Visitor, page: StudioPage) -> None:
    visitor.axis = min(visitor.axis, session.num_axes - 1)
    page.build(session, visitor)


def _await_drives(session: Session) -> None:
    """Show that the drives are being opened, or why that failed; then reload the page."""
    with ui.column().classes("w-full items-center studio-wait"):
        spinner = ui.spinner(size="lg")
        told = ui.label("Opening the drives. On a new computer the emulator is compiled first, which takes a minute.")

    def look() -> None:
        if session.state == "open":
            timer.deactivate()
            ui.navigate.reload()
        elif session.state != "opening":
            spinner.set_visibility(False)
            told.set_text(f"The drives cannot be used: {session.failure or 'they were closed'}")

    timer = ui.timer(REFRESH, look)


def _navigation(visitor: Visitor, pages: Sequence[StudioPage], page: StudioPage) -> ui.left_drawer:
    with ui.left_drawer(bordered=True).props("width=208 breakpoint=900").classes("studio-nav") as drawer:
        with ui.element("nav").props('aria-label="Pages"').classes("w-full"):
            for one in pages:
                link = ui.link(target=f"{one.path}?axis={visitor.axis}").classes("studio-link")
                if one is page:
                    link.classes("is-here").props('aria-current="page"')
                with link:
                    ui.icon(one.icon).props('aria-hidden="true"')
                    ui.label(one.title)
        ui.space()
        with ui.column().classes("studio-keys"):
            ui.label("Space: quick stop, on every page")
            ui.label("While you type a text: Ctrl + Space")
    return drawer


def _header(session: Session, visitor: Visitor, drawer: ui.left_drawer, page: StudioPage) -> None:
    with ui.header().classes("studio-header"):
        ui.button(icon="menu", on_click=drawer.toggle).props('flat dense aria-label="Pages"')
        with ui.column().classes("studio-title"):
            ui.label(page.title).classes("studio-page").props('role="heading" aria-level="1"')
            ui.label(session.title).classes("studio-what")
        ui.space()
        _job_chip(session)
        _axis_choice(session, visitor, page)
        chip = ui.element("div").classes("studio-chip is-off").props('role="status" aria-live="polite"')
        with chip:
            sign, text, mode = ui.label("○"), ui.label("opening"), ui.label("")
            sign.props('aria-hidden="true"')
            mode.classes("studio-mode")
        theme = ui.button(icon="brightness_6").props('flat dense aria-label="Light or dark"')
        theme.on("click", js_handler="() => studio.theme()").tooltip("Light, dark, or as the computer has it")

    def show() -> None:
        if session.state == "open":
            _show_state(visitor.state, chip, sign, text, mode)
        else:
            text.set_text({"opening": "opening", "failed": "no drives"}.get(session.state, "closed"))

    ui.timer(REFRESH, show)


def _show_state(state: AxisState | None, chip: ui.element, sign: ui.label, text: ui.label, mode: ui.label) -> None:
    if state is None:
        return
    look, mark = ("is-off", "?") if state.state is None else LOOKS[state.state]
    chip.classes(remove="is-off is-ready is-on is-stopping is-fault", add=look)
    sign.set_text(mark)
    text.set_text(state_name(state.state))
    mode.set_text(state.mode)


def _axis_choice(session: Session, visitor: Visitor, page: StudioPage) -> None:
    """Build the choice of the axis, if there are several."""
    if session.num_axes < 2:
        return
    names = {axis.axis: axis.name for axis in session.axes}
    chosen = ui.select(names, value=min(visitor.axis, session.num_axes - 1), label="Axis")
    chosen.props("dense outlined options-dense").classes("studio-axis")
    chosen.on_value_change(lambda event: ui.navigate.to(f"{page.path}?axis={event.value}"))


def _job_chip(session: Session) -> None:
    """Show the present job, with a button that ends it."""
    with ui.row().classes("studio-job") as row:
        ui.spinner(size="sm").props('aria-hidden="true"')
        text = ui.label("")
        end = ui.button("End", on_click=lambda: session.end_job("its job was ended from a page")).props("flat dense")
        end.tooltip("Stop the axes and end this job")
    row.set_visibility(False)

    def show() -> None:
        job = session.job
        row.set_visibility(job is not None and not job.quiet)
        if job is not None and not job.quiet:
            share = "" if job.progress is None else f" {100 * job.progress:.0f} %"
            text.set_text(f"{job.title}{share}{': ' + job.told if job.told else ''}")

    ui.timer(REFRESH, show)


def _stop_button() -> None:
    with ui.footer().classes("studio-footer"):  # it has its own area, so that it covers nothing
        button = ui.button("Quick stop", icon="dangerous", color=None).classes("studio-stop")
        button.props('unelevated no-caps aria-keyshortcuts="Space" aria-label="Quick stop (space bar)"')
        button.on("click", js_handler="() => studio.stop()")


def _tell_events(session: Session, visitor: Visitor) -> None:
    """Show new events on this page."""
    seen = session.num_events

    def look() -> None:
        nonlocal seen
        new = session.num_events - seen
        seen = session.num_events
        for event in list(session.events)[-new:] if new else []:
            when = time.strftime("%H:%M:%S", time.localtime(event.at))
            visitor.say(f"{when}  {event.text}", event.level)

    ui.timer(REFRESH, look)
