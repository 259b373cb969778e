"""Cards that move the axis of a page, on the pages Axes and Scope: enable, jog, move, home, test signals."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from drive_env.studio import motion_jobs
from drive_env.studio.axis_states import MODE_NAMES, AxisState
from drive_env.studio.homing_sketch import homing_sketch
from drive_env.studio.motion_signals import SHAPES, SIGNALS, SignalSettings, play_signal, signals_of
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

REFRESH = 0.2  # s


def card(title: str, name: str) -> ui.card:
    """Return a card with a heading; `name` is its CSS class."""
    made = ui.card().classes(f"studio-card {name}")
    with made:
        ui.label(title).classes("studio-heading").props('role="heading" aria-level="2"')
    return made


def power_row(visitor: Visitor) -> None:
    """Build the row that chooses the mode, and enables and disables the axis of a page."""
    with ui.row().classes("studio-buttons"):
        modes = {name: f"{name}  {MODE_NAMES[name]}" for name in _modes(visitor.state)}
        first = _first_mode(visitor.state)
        mode = ui.select(modes, value=first, label="Mode of operation").props("dense outlined").classes("grow")
        mode.props("data-test=mode")

        async def enable() -> None:
            await visitor.do(motion_jobs.enable(visitor.axis, str(mode.value)), f"Enable axis {visitor.axis}")

        async def disable() -> None:
            await visitor.do(motion_jobs.disable(visitor.axis), f"Disable axis {visitor.axis}")

        async def select() -> None:
            await visitor.do(motion_jobs.select_mode(visitor.axis, str(mode.value)), f"Mode {mode.value}")

        def follow() -> None:
            """Update the choice when the axis has changed its mode, by this page or another one."""
            nonlocal first
            state = visitor.state
            if state is not None and state.mode != first and state.mode in modes:
                first = state.mode
                mode.set_value(first)

        ui.timer(REFRESH, follow)
        ui.button("Set mode", on_click=select).props("outline no-caps").props("data-test=set-mode")
        ui.button("Enable", icon="power", on_click=enable).props("unelevated no-caps color=positive").props(
            "data-test=enable"
        )
        ui.button("Disable", icon="power_off", on_click=disable).props("outline no-caps").props("data-test=disable")


def _modes(state: AxisState | None) -> tuple[str, ...]:
    return tuple(MODE_NAMES) if state is None else state.modes


def _first_mode(state: AxisState | None) -> str:
    """Return the mode of the axis if known, else pp, or the first mode without it."""
    modes = _modes(state)
    if state is not None and state.mode in modes:
        return state.mode
    return "pp" if "pp" in modes else modes[0]


def move_rows(session: Session, visitor: Visitor) -> None:
    """Build the rows that jog, move and home the axis of a page."""
    ui.label("Jog: as long as you hold").classes("studio-label")
    with ui.row().classes("studio-buttons"):
        speed = ui.input("Jog speed", value=visitor.jog_speed, placeholder="60 rpm").props("dense outlined")
        speed.classes("grow").bind_value(visitor, "jog_speed").props("data-test=jog-speed")
        speed.on("blur", lambda: visitor.set(jog_speed=speed.value))
        for text, icon, direction in (("Backwards", "fast_rewind", -1), ("Forwards", "fast_forward", 1)):
            button = ui.button(text, icon=icon).props(f"no-caps outline data-jog={direction}")
            button.classes("studio-jog").tooltip("Hold the button, or Enter while it has the focus")
    ui.label("Move to a place, or by a distance").classes("studio-label")
    with ui.row().classes("studio-buttons"):
        goal = (
            ui.input("Position or distance", value="1 rev")
            .props("dense outlined")
            .classes("grow")
            .props("data-test=goal")
        )
        rate = ui.input("Speed (empty: the drive's)", placeholder="300 rpm").props("dense outlined")
        rate.classes("grow").props("data-test=rate")

        async def go(relative: bool) -> None:
            what = f"Move axis {visitor.axis} {'by' if relative else 'to'} {goal.value}"
            job = motion_jobs.move(session, visitor.axis, goal.value, rate.value or "", relative=relative)
            await visitor.do(job, what)

        ui.button("Move to", on_click=lambda: go(False)).props("unelevated no-caps").props("data-test=move-to")
        ui.button("Move by", on_click=lambda: go(True)).props("unelevated no-caps").props("data-test=move-by")
    home_rows(session, visitor)
    ui.label("Units: rev, deg, rad; rpm, rev/s, rad/s; an integer alone is in the drive's own unit.").classes(
        "studio-hint"
    )


def home_rows(session: Session, visitor: Visitor) -> None:
    """Build the rows that home the axis of a page, by the method in 6098h or another one of the drive."""
    known = session.description
    with ui.row().classes("studio-buttons"):
        method = ui.select({0: "reading"}, value=0, label="Homing method").props("dense outlined").classes("grow")
        method.props("data-test=homing-method")

        async def home() -> None:
            job = motion_jobs.home(visitor.axis, int(method.value))
            await visitor.do(job, f"Home axis {visitor.axis}")

        ui.button("Home", icon="home", on_click=home).props("outline no-caps").props("data-test=home")
    told = ui.label("").classes("studio-hint").props("data-test=homing-told")
    picture = ui.html("", sanitize=False).classes("w-full")
    own = 0

    def show() -> None:
        picture.set_content(homing_sketch(int(method.value) or own, is_known=known.device is not None))

    async def load() -> None:
        nonlocal own
        found = await visitor.do(motion_jobs.homing_methods(known, visitor.axis), "Read the homing methods", quiet=True)
        if found is None:
            return
        own, texts = found
        first = f"{own}  the drive's (6098h)" if own else "none is chosen (6098h is 0)"
        method.set_options({0: first} | {number: f"{number}  {text}" for number, text in texts.items()})
        none = "The drive has no homing method chosen: take one of its list that fits the machine's switches."
        told.set_text("" if own else none if texts else "The drive has no homing (6098h).")
        show()

    method.on_value_change(lambda _: show())
    ui.timer(0.0, load, once=True)


def signal_rows(session: Session, visitor: Visitor) -> None:
    """Build the rows that play a test signal on the axis of a page."""
    titles = signals_of(_modes(visitor.state), session.description.has, session.plays)
    if not titles:
        ui.label("This drive has no mode in which set-points are played (csp, csv, cst).").classes("studio-hint")
        return
    defaults = SignalSettings(next(iter(titles)), "")
    kind = ui.select(titles, value=defaults.name, label="Signal").props("dense outlined").classes("w-full")
    kind.props("data-test=signal")
    texts, numbers = {}, {}
    with ui.row().classes("studio-buttons"):
        for name, label in (("height", "Height"), ("travel", "May go, each way"), ("speed", "May turn at")):
            texts[name] = ui.input(label, value=getattr(defaults, name), placeholder="the drive's limit")
            texts[name].props(f"dense outlined data-test=signal-{name}").classes("grow")
        for name, label in {name: label for shape in SHAPES.values() for name, label in shape.items()}.items():
            numbers[name] = ui.number(label, value=getattr(defaults, name), min=0).classes("grow")
            numbers[name].props(f"dense outlined data-test=signal-{name}")

    def choose() -> None:
        row = SIGNALS[str(kind.value)]
        texts["height"].set_value(row.height)
        for name, field in numbers.items():
            field.set_visibility(name in SHAPES[row.shape])
            if name in SHAPES[row.shape]:
                field.props(f'label="{SHAPES[row.shape][name]}"')

    async def play() -> None:
        asked: dict[str, Any] = {name: field.value or "" for name, field in texts.items()}
        asked |= {name: float(field.value or 0.0) for name, field in numbers.items()}
        settings = SignalSettings(str(kind.value), **asked)
        title = f"{SIGNALS[settings.name].title} of axis {visitor.axis}"
        if told := await visitor.do(play_signal(session, visitor.axis, settings), title):
            visitor.say(told, "warning")

    kind.on_value_change(choose)
    choose()
    ui.button("Play", icon="play_arrow", on_click=play).props("unelevated no-caps data-test=play-signal")
    ui.label(
        "Enable the axis first; it is at rest and in its mode of before afterwards. It is stopped where it leaves what "
        "it may, and with this page."
    ).classes("studio-hint")
