"""The page Scope: live at the communication rate, triggers, cursors, figures of a step, stored recordings."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from nicegui import run, ui
from nicegui.events import GenericEventArguments

from drive_env import cia402
from drive_env.dictionary import quantities
from drive_env.dictionary.access import fits_pdo
from drive_env.dictionary.entries import Entry
from drive_env.studio.motion_cards import card, move_rows, power_row, signal_rows
from drive_env.studio.page import StudioPage
from drive_env.studio.scope_export import as_csv, as_npz, as_png, in_words, measure_step
from drive_env.studio.scope_trigger import EDGES
from drive_env.studio.scope_view import (
    MODES,
    MOST_CHANNELS,
    WINDOWS,
    ScopeChannel,
    ScopeRecording,
    ScopeView,
    channel_of,
    with_channels,
    with_units,
)
from drive_env.studio.sentences import sentence
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor
from drive_env.studio.workspace import CHOICES, OF_VL, AxisSettings, object_key, object_name, trigger_of
from mechanics.reading.untrusted import parse_json

FRAME = 0.05  # s between two frames
LIVE = 5.0  # s across the plot on the page Axes
UNITS_REFRESH = 0.5  # s
FIRST = (  # objects listed first in the choice
    cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL, cia402.VELOCITY_DEMAND, cia402.VELOCITY_ACTUAL,
    cia402.TARGET_VELOCITY, cia402.TORQUE_DEMAND, cia402.TORQUE_ACTUAL, cia402.FOLLOWING_ERROR, cia402.STATUSWORD,
    cia402.DC_LINK_VOLTAGE, cia402.VL_TARGET_VELOCITY, *OF_VL,
)  # fmt: skip

_views: dict[str, ScopeView] = {}  # of each open page, by its visitor's id


def attach(web: FastAPI, session: Session) -> None:
    """Add the websocket for frames to the web application."""

    @web.websocket("/studio/scope")
    async def frames(line: WebSocket, page: str = "") -> None:
        await line.accept()
        view = _views.get(page)
        if view is None:
            await line.close()
            return
        listener = asyncio.create_task(_listen(line, view))
        try:
            while not listener.done():
                begun = time.monotonic()
                await line.send_bytes(view.frame())
                await asyncio.sleep(max(0.005, FRAME - (time.monotonic() - begun)))
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            listener.cancel()


async def _listen(line: WebSocket, view: ScopeView) -> None:
    """Receive the width of the picture."""
    with contextlib.suppress(WebSocketDisconnect, ValueError, KeyError, TypeError):
        while True:
            message = parse_json(await line.receive_text())
            view.columns = min(4000, max(50, int(message["columns"])))


def traces(visitor: Visitor, view: ScopeView, size: str = "") -> None:
    """Show the traces of a scope on a page; `size` is its CSS class."""
    _views[visitor.id] = view
    with ui.element("div").classes(f"studio-scope {size}"):
        ui.element("canvas").props('tabindex="0" role="img" aria-label="Traces of the chosen objects"')
    ui.run_javascript(f"studioScope.start({visitor.id!r}, {json.dumps(view.cursors)})")


def live_plot(session: Session, visitor: Visitor) -> None:
    """Plot the newest position, velocity and current of a page's axis, if they are sampled anyway."""
    known, view = session.description.dictionary, ScopeView(session.recorder)
    scale, units = session.scales[visitor.axis], session.workspace.units
    keys = [key for key in session.workspace.usual_channels if key in session.recorder.objects]

    def follow_units() -> None:
        now = tuple(channel_of(known.find(key), visitor.axis, scale, several=False, units=units) for key in keys)
        if now != view.channels:
            with_units(view, now)

    follow_units()
    view.window = LIVE
    traces(visitor, view, "studio-scope-small")
    ui.timer(UNITS_REFRESH, follow_units)
    visitor.client.on_delete(lambda: _views.pop(visitor.id, None))


def build(session: Session, visitor: Visitor) -> None:
    """Build the page."""
    ScopePanel(session, visitor).build()


class ScopePanel:
    """The controls of one page's scope.

    Args:
        session: The drives.
        visitor: The page.
    """

    def __init__(self, session: Session, visitor: Visitor) -> None:
        self._session = session
        self._visitor = visitor
        self._entries = _choices(session)
        self._view = session.scopes.get(visitor.axis) or self._view_of(session, visitor.axis)
        self._sampled = f"the scope of axis {visitor.axis}"

    def build(self) -> None:
        """Build the page."""
        self._visitor.client.on_delete(self._leave)
        self._want()
        with ui.element("div").classes("studio-scope-page"):
            with ui.card().classes("studio-card studio-scope-card"):
                self._bar()
                traces(self._visitor, self._view)
                self._readout()
            with ui.element("div").classes("studio-scope-side"):
                self._move_card()
                self._channel_card()
                self._trigger_card()
                self._figure_card()
        ui.on("scope_cursors", self._take_cursors)

    def _view_of(self, session: Session, axis: int) -> ScopeView:
        """Create the scope of an axis from its settings, with its trigger armed.

        Objects that cannot be sampled are omitted. A trigger with an invalid level is not set; the page reports it.
        """
        settings = session.workspace.of(axis)
        view = session.scopes[axis] = ScopeView(session.recorder)
        view.channels = tuple(self._channel(key, axis) for key in settings.channels if key in self._entries)
        view.window, view.before = settings.window, settings.before
        if settings.mode != "roll":
            try:
                view.trigger = trigger_of(settings, axis, self._level(settings))
                view.mode = settings.mode
            except ValueError as error:
                self._visitor.say(f"the trigger is not set: {error}", "warning")
        return view

    def _level(self, settings: AxisSettings) -> float:
        """Return the level of an edge as a raw integer; ValueError for an invalid text."""
        if settings.edge not in ("rising", "falling"):
            return 0.0
        if settings.source not in self._entries:
            raise ValueError(f"{object_name(settings.source)} cannot be sampled; choose another object")
        entry = self._session.description.dictionary.find(settings.source)
        return float(quantities.parse(settings.level, entry, self._session.scales[self._visitor.axis]))

    def _leave(self) -> None:
        """Stop sampling for the scope, unless it waits for its trigger or another page shows it."""
        _views.pop(self._visitor.id, None)
        if not self._view.is_armed and self._view not in _views.values():
            self._session.forget_samples(self._sampled)

    def _want(self) -> None:
        keys = [channel.key for channel in self._view.channels]
        if self._view.trigger is not None:
            keys.append(self._view.trigger.key)
        self._session.sample(self._sampled, keys)

    def _channel(self, key: tuple[int, int], axis: int) -> ScopeChannel:
        entry = self._session.description.dictionary.find(key)
        scale, units = self._session.scales[axis], self._session.workspace.units
        return channel_of(entry, axis, scale, several=self._session.num_axes > 1, units=units)

    # --- run and halt ---------------------------------------------------------------------------------------------
    def _bar(self) -> None:
        view = self._view
        with ui.row().classes("studio-buttons"):
            run_button = ui.button("Halt", icon="pause", on_click=lambda: toggle()).props("unelevated no-caps")
            run_button.props("data-test=run").classes("studio-run")
            ui.label("running").classes("studio-scope-status studio-bit").props('role="status"')
            ui.space()
            window = ui.select({one: f"{one:g} s" for one in WINDOWS}, value=view.window, label="Time across [s]")
            window.props("dense outlined options-dense").classes("studio-narrow")
            window.on_value_change(lambda event: self._set_window(float(event.value)))
            for text, icon, script, hint in (
                ("Cursors", "straighten", "() => studioScope.toggle()", "Two cursors: drag them, or a, b and arrows"),
                ("Fit", "fit_screen", "() => studioScope.fit()", "Scale every panel to what it shows"),
            ):
                ui.button(text, icon=icon).props("outline no-caps").on("click", js_handler=script).tooltip(hint)

        def toggle() -> None:
            if view.is_running:
                view.halt()
            else:
                view.run()

        late = ui.label("").classes("studio-hint studio-figures")
        late.tooltip("Times are the nominal ones of the SYNCs; a busy computer sends them late")

        def show() -> None:
            late.set_text(self._session.lateness)
            run_button.set_text("Halt" if view.is_running else "Run")
            run_button.set_icon("pause" if view.is_running else "play_arrow")

        ui.timer(0.2, show)

    def _set_window(self, window: float) -> None:
        self._view.window = window
        self._visitor.set(window=window)
        if self._view.is_running:
            self._view.run()

    def _readout(self) -> None:
        head = "".join(f"<th>{text}</th>" for text in ("Channel", "now", "A", "B", "B - A", "unit"))
        table = f'<table class="studio-readout"><thead><tr>{head}</tr></thead><tbody></tbody></table>'
        ui.html(table, sanitize=False).classes("w-full studio-scroll")

    def _move_card(self) -> None:
        """Build the cards that enable and move the axis beside its traces."""
        with card("Move", "card-move"):
            power_row(self._visitor)
            move_rows(self._session, self._visitor)
        with card("Test signal", "card-signal"):
            signal_rows(self._session, self._visitor)

    # --- channels -------------------------------------------------------------------------------------------------
    def _channel_card(self) -> None:
        with ui.card().classes("studio-card"):
            ui.label(f"Channels ({MOST_CHANNELS} at most)").classes("studio-heading")
            chips = ui.row().classes("studio-chips")
            options = {object_name(key): entry.label for key, entry in self._entries.items()}
            add = ui.select(options, label="Add an object, by index or name", with_input=True, clearable=True)
            add.props("dense outlined options-dense data-test=add-channel").classes("w-full")
            ui.label("Units of all axes, here and on the page Axes").classes("studio-label")
            with ui.row().classes("studio-buttons"):
                for dimension, units in CHOICES.items():
                    now = self._session.workspace.units[dimension]
                    unit = ui.select(list(units), value=now, label=dimension.capitalize()).classes("studio-unit")
                    unit.props(f"dense outlined options-dense data-test=unit-{dimension}")
                    unit.on_value_change(lambda event, dimension=dimension: show_in(dimension, str(event.value)))

        def draw() -> None:
            chips.clear()
            with chips:
                for channel in self._view.channels:
                    ui.chip(channel.label, removable=True, on_value_change=lambda _, one=channel: remove(one)).props(
                        "outline square"
                    )

        def remove(channel: ScopeChannel) -> None:
            change(tuple(one for one in self._view.channels if one != channel))

        def change(channels: tuple[ScopeChannel, ...]) -> None:
            try:
                with_channels(self._view, channels)
            except ValueError as error:
                self._visitor.say(str(error), "warning")
                return
            self._want()
            draw()
            self._visitor.set(channels=tuple(one.key for one in channels))

        def added() -> None:
            if not add.value:
                return
            channel = self._channel(object_key(str(add.value)), self._visitor.axis)
            add.set_value(None)
            if channel not in self._view.channels:
                change((*self._view.channels, channel))

        def show_in(dimension: str, unit: str) -> None:
            session = self._session
            self._visitor.keep(lambda: session.workspace.show_in(dimension, unit))
            for axis, view in session.scopes.items():
                with_units(view, tuple(self._channel(one.key, axis) for one in view.channels))
            draw()

        add.on_value_change(added)
        draw()

    # --- trigger --------------------------------------------------------------------------------------------------
    def _trigger_card(self) -> None:
        now = self._session.workspace.of(self._visitor.axis)
        with ui.card().classes("studio-card"):
            ui.label("Trigger").classes("studio-heading")
            with ui.row().classes("studio-buttons"):
                mode = ui.select(MODES, value=self._view.mode, label="Mode").props("dense outlined").classes("grow")
                mode.props("data-test=trigger-mode")
                kind = ui.select(EDGES, value=now.edge, label="On").props("dense outlined").classes("grow")
            options = {object_name(key): entry.label for key, entry in self._entries.items()}
            usual = object_name(now.source)
            source = ui.select(options, value=usual if usual in options else next(iter(options)), label="Of the object",
                               with_input=True).props("dense outlined options-dense").classes("w-full")  # fmt: skip
            with ui.row().classes("studio-buttons"):
                level = ui.input("Level, with its unit", value=now.level).props("dense outlined data-test=level")
                level.classes("grow")
                before = ui.number("Before the trigger [%]", value=100.0 * now.before, min=0, max=90).props(
                    "dense outlined"
                )
                before.classes("grow")
            button = ui.button("Arm", icon="bolt").props("outline no-caps data-test=arm")

        def apply() -> None:
            try:
                self._arm(str(mode.value), str(kind.value), str(source.value), level.value or "", before.value)
            except Exception as error:
                self._visitor.say(sentence(error), "error")

        def needed() -> None:
            has_level = kind.value in ("rising", "falling")
            source.set_enabled(has_level)
            level.set_enabled(has_level)

        needed()
        kind.on_value_change(needed)
        mode.on_value_change(apply)
        button.on_click(apply)

    def _arm(self, mode: str, kind: str, source: str, level: str, before: float | None) -> None:
        axis, view = self._visitor.axis, self._view
        share = min(0.9, max(0.0, (10.0 if before is None else float(before)) / 100.0))
        changes: dict[str, Any] = {
            "mode": mode,
            "edge": kind,
            "source": object_key(source),
            "level": level,
            "before": share,
        }
        settings = replace(self._session.workspace.of(axis), **changes)
        view.trigger = trigger_of(settings, axis, self._level(settings))
        view.before, view.mode = settings.before, settings.mode
        self._visitor.set(**changes)
        self._want()
        view.run()

    # --- figures, recordings, files -------------------------------------------------------------------------------
    def _figure_card(self) -> None:
        with ui.card().classes("studio-card"):
            ui.label("Recording").classes("studio-heading")
            with ui.row().classes("studio-buttons"):
                ui.button("Keep under the next", icon="layers", on_click=self._keep).props("outline no-caps")
                ui.button("Take away", icon="layers_clear", on_click=self._forget).props("outline no-caps")
            ui.label("Figures of a step (from cursor A to B, if they are shown)").classes("studio-label")
            with ui.row().classes("studio-buttons"):
                channel = ui.select({}, label="Channel").props("dense outlined options-dense").classes("grow")
                ui.button("Measure", icon="analytics", on_click=lambda: measure()).props(
                    "outline no-caps data-test=measure"
                )
            told = ui.label("").classes("studio-hint studio-figures")
            ui.label("Export what is shown, at every sample").classes("studio-label")
            with ui.row().classes("studio-buttons"):
                for text, suffix, make in (("CSV", "csv", as_csv), ("NumPy", "npz", as_npz)):
                    ui.button(text, icon="download", on_click=self._saver(suffix, make)).props("outline no-caps")
                ui.button("PNG", icon="image", on_click=self._saver("png", self._png)).props("outline no-caps")

        def measure() -> None:
            chosen = next((one for one in self._view.channels if one.label == channel.value), None)
            if chosen is None:
                told.set_text("Choose the channel whose step is meant.")
                return
            try:
                found = measure_step(self._view.shown(), chosen, *self._between())
                told.set_text(f"{chosen.name}: {in_words(found, chosen.unit)}")
            except ValueError as error:
                told.set_text(str(error))

        proposed: str | None = None

        def options() -> None:
            nonlocal proposed
            labels = [one.label for one in self._view.channels]
            if labels != channel.options:
                is_own = channel.value in labels and channel.value != proposed
                proposed = _response(labels)
                channel.set_options(labels, value=channel.value if is_own else proposed)

        ui.timer(0.5, options)

    def _between(self) -> tuple[float | None, float | None]:
        a, b = self._view.cursors
        return (None, None) if a is None or b is None else (min(a, b), max(a, b))

    def _take_cursors(self, event: GenericEventArguments) -> None:
        a, b = (None if one is None else float(one) for one in event.args)
        self._view.cursors = a, b

    def _keep(self) -> None:
        if not self._view.keep_as_reference():
            self._visitor.say("there is nothing to keep yet; run the scope first", "warning")

    def _forget(self) -> None:
        self._view.reference = None

    def _png(self, recording: ScopeRecording) -> bytes:
        return as_png(recording, self._view.reference)

    def _saver(self, suffix: str, make: Callable[[ScopeRecording], bytes]) -> Callable[[], Any]:
        async def save() -> None:
            recording = self._view.shown()
            if not len(recording.t) or not recording.values:
                self._visitor.say("there is nothing to save yet; run the scope first", "warning")
                return
            content = await run.io_bound(make, recording)
            assert content is not None
            ui.download(content, f"scope-{time.strftime('%Y%m%d-%H%M%S')}.{suffix}")

        return save


def _choices(session: Session) -> dict[tuple[int, int], Entry]:
    """Return the objects that a scope can show: numbers that can be sampled, the usual ones first."""
    known = session.description
    entries = [entry for entry in known.dictionary if fits_pdo(entry, transmit=True) and entry.bits is not None]
    entries.sort(key=lambda one: (one.index not in FIRST, one.index, one.sub))
    return {(entry.index, entry.sub): entry for entry in entries}


def _response(labels: list[str]) -> str | None:
    """Return the default channel for a step's figures: the actual position, else the first; None without channels."""
    return next((one for one in labels if "osition actual" in one), labels[0] if labels else None)


page = StudioPage("/scope", "Scope", "show_chart", 20, build, attach=attach)
