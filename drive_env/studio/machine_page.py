"""The page Machine: the moving emulated load, its parameters, external loads, supply and faults."""

from __future__ import annotations

import asyncio
import contextlib
import math
import weakref
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from nicegui import ui

from drive_env.faults.table import FAULTS, GROUPS, STEPS, FaultRow
from drive_env.studio import machine_jobs as jobs
from drive_env.studio.axis_states import AxisState
from drive_env.studio.layout import state_name
from drive_env.studio.machine_camera import MachineCamera
from drive_env.studio.page import StudioPage
from drive_env.studio.sentences import sentence
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

if TYPE_CHECKING:
    from drive_env.emulator.machine import Machines

REFRESH = 0.5  # s
STOPS = 200  # of a slider
TITLES = {"load": "Load and payload", "motor": "Motor", "stage": "Drive's power stage and sensors"}

_cameras: weakref.WeakKeyDictionary[Session, MachineCamera] = weakref.WeakKeyDictionary()


class KnownMachine(NamedTuple):
    """Constant properties of the machine: rows of parameters, meanings, possible faults, torque's unit and range."""

    rows: dict[str, Any]
    meanings: dict[str, str]
    faults: list[str]
    torque_unit: str
    torque: float
    supply: float


def attach(web: FastAPI, session: Session) -> None:
    """Add the websocket for pictures to the web application."""

    @web.websocket("/studio/machine")
    async def pictures(line: WebSocket) -> None:
        await line.accept()
        camera = _cameras.setdefault(session, MachineCamera(session))
        listener = asyncio.create_task(_until_closed(line))
        seen, told = 0, ""
        try:
            while not listener.done():
                loop = asyncio.get_running_loop()
                try:
                    seen, picture = await loop.run_in_executor(camera.thread, camera.picture, seen)
                except Exception as error:
                    await line.send_text(sentence(error))
                    await listener
                    return
                if picture:
                    await line.send_bytes(picture)
                rate, cost = 1.0 / camera.period, 1e3 * camera.cost
                now = f"{rate:.0f} pictures per second at most; one takes {cost:.0f} ms of a core"
                if now != told and camera.cost > 0.0:
                    told = now
                    await line.send_text(now)
                await asyncio.sleep(camera.period)
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            listener.cancel()


async def _until_closed(line: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError, KeyError):
        while True:
            await line.receive_text()


def know(machine: Machines) -> KnownMachine:
    """Read the properties of a machine that do not change."""
    from drive_env.pictures.demonstration import rated_load_torque

    meanings = {f"load.{one.name}": one.meaning for one in machine.load.parameters}
    return KnownMachine(
        dict(machine.parameter_rows), meanings, machine.possible_faults, machine.load.disturbance_unit,
        rated_load_torque(machine.inside), float(machine.supply[0]),
    )  # fmt: skip


def build(session: Session, visitor: Visitor) -> None:
    """Build the page."""
    ui.add_head_html('<link rel="stylesheet" href="/studio/assets/pages.css">')
    known = session.glimpse(know, 10.0)
    if known is None:
        with ui.card().classes("studio-card"):
            ui.label("Machine").classes("studio-heading")
            ui.label(
                "These drives are on a bus: their machine is real, and has no page. Start drive-env studio without "
                "--interface and --channel for an emulated one."
            ).props("data-test=no-machine")
        return
    MachinePanel(session, visitor, known).build()


class MachinePanel:
    """The controls of one page's machine.

    Args:
        session: The drives.
        visitor: The page.
        known: Properties of the machine.
    """

    def __init__(self, session: Session, visitor: Visitor, known: KnownMachine) -> None:
        self._session = session
        self._visitor = visitor
        self._known = known
        self._values = session.glimpse(lambda machine: machine.parameters) or {}
        self._rows: dict[str, tuple[ui.slider, ui.number]] = {}
        self._is_setting = False

    def build(self) -> None:
        """Build the page."""
        ui.add_head_html('<script src="/studio/assets/machine.js"></script>')
        with ui.element("div").classes("studio-machine"):
            with ui.element("div").classes("studio-stack"):
                self._picture_card()
                self._world_card()
            with ui.element("div").classes("studio-stack"):
                self._parameter_card()
                self._fault_card()
        ui.run_javascript("studioMachine.start()")

    def _card(self, title: str, name: str) -> ui.card:
        made = ui.card().classes(f"studio-card card-{name}")
        with made:
            ui.label(title).classes("studio-heading").props('role="heading" aria-level="2"')
        return made

    def _picture_card(self) -> None:
        with self._card("The load as it moves", "picture"):
            ui.html('<img class="studio-machine-picture" alt="The machine, drawn from its true joint positions">',
                    sanitize=False).classes("w-full")  # fmt: skip
            ui.label("").classes("studio-hint studio-machine-told")
            state = ui.label("").classes("studio-hint").props("data-test=truth")

        def show() -> None:
            found = self._session.glimpse(_truth, 0.05)
            if found is not None:
                state.set_text(found)

        ui.timer(REFRESH, show)

    # --- external quantities --------------------------------------------------------------------------------------
    def _world_card(self) -> None:
        known = self._known
        with self._card("What acts on it", "world"):
            unit, reach = known.torque_unit, 1.5 * known.torque
            self._control(
                f"{'Force' if unit == 'N' else 'Torque'} on the load", unit, 0.0, (-reach, reach), "load-torque",
                lambda value: self._do(jobs.act("load_torque", value), f"Load {value:.4g} {unit}"),
            )  # fmt: skip
            self._control(
                "Supply voltage", "V", known.supply, (0.0, 1.5 * known.supply), "supply",
                lambda value: self._do(jobs.act("supply", value), f"Supply {value:.4g} V"),
            )  # fmt: skip
            ui.label("The load goes up to 1.5 times what needs the motor's rated torque.").classes("studio-hint")

    def _control(
        self, title: str, unit: str, value: float, ends: tuple[float, float], name: str,
        act: Callable[[float], Any], meaning: str = "",
    ) -> tuple[ui.slider, ui.number]:  # fmt: skip
        """Build a slider and a number, each of which acts when it is released."""
        low, high = min(ends[0], value), max(ends[1], value)
        step = (high - low) / STOPS or 1.0
        with ui.element("div").classes("studio-param"):
            label = ui.label(title)
            if meaning:
                label.tooltip(meaning)
            slider = ui.slider(min=low, max=low + STOPS * step, value=value, step=step)
            slider.props(f'aria-label="{title} [{unit}]" data-test=slider-{name}')
            number = ui.number(value=float(f"{value:.6g}")).props("dense outlined")
            number.props(f'aria-label="{title} [{unit}]" data-test=value-{name}')
            ui.label("1" if unit == "1" else unit.replace("*", "·")).classes("unit")
        last = [value]

        def slides() -> None:
            if not self._is_setting:
                self._is_setting = True
                number.set_value(float(f"{slider.value:.4g}"))
                self._is_setting = False

        async def apply(wanted: float | None) -> None:
            if wanted is None or not math.isfinite(wanted) or wanted == last[0]:
                return
            last[0] = wanted
            await act(wanted)
            self._is_setting = True
            slider.set_value(min(max(wanted, low), high))
            number.set_value(float(f"{wanted:.6g}"))
            self._is_setting = False

        slider.on_value_change(slides)
        slider.on("change", lambda: apply(number.value))
        number.on("blur", lambda: apply(number.value))
        number.on("keydown.enter", lambda: apply(number.value))
        return slider, number

    async def _do(self, job: Callable[[Any], Any], title: str) -> Any:
        return await self._visitor.do(job, title)

    # --- parameters -----------------------------------------------------------------------------------------------
    def _parameter_card(self) -> None:
        with self._card("Parameters of the machine", "parameters"):
            for group, title in TITLES.items():
                rows = {name: row for name, row in self._known.rows.items() if name.startswith(f"{group}.")}
                if not rows:
                    continue
                with ui.expansion(title, value=group == "load").classes("w-full").props(f"data-test=group-{group}"):
                    for name, row in rows.items():
                        self._parameter(name, row)
                    ui.button("As built", icon="restart_alt", on_click=lambda rows=rows: self._defaults(rows)).props(
                        "outline no-caps"
                    ).tooltip("Give all of these their usual values")

    def _parameter(self, name: str, row: Any) -> None:
        value = float(self._values[name][0])
        title = name.partition(".")[2].replace("_", " ")
        ends = min(row.low, row.ideal, row.default), max(row.high, row.ideal, row.default)

        async def act(wanted: float) -> None:
            await self._do(jobs.set_parameters({name: wanted}), f"{name} {wanted:.4g} {row.unit}")

        self._rows[name] = self._control(
            title[:1].upper() + title[1:], row.unit, value, ends, name.replace(".", "-"), act,
            self._known.meanings.get(name, ""),
        )  # fmt: skip

    async def _defaults(self, rows: dict[str, Any]) -> None:
        values = {name: row.default for name, row in rows.items()}
        await self._do(jobs.set_parameters(values), "Parameters as built")
        now = self._session.glimpse(lambda machine: machine.parameters) or {}
        self._is_setting = True
        for name in rows:
            slider, number = self._rows[name]
            value = float(now[name][0])
            for control in (slider, number):
                control.set_value(value)
        self._is_setting = False

    # --- faults ---------------------------------------------------------------------------------------------------
    def _fault_card(self) -> None:
        with self._card("Faults", "faults"):
            ui.label("What fails here fails in the machine; below it stands what the drive makes of it.").classes(
                "studio-hint"
            )
            with ui.row().classes("studio-buttons"):
                lasts = ui.number("Lasts [s] (empty: until it is ended)", min=0.001).props("dense outlined")
                lasts.props("data-test=fault-duration").classes("grow")
                when = ui.input("Begins when (empty: now)", placeholder="enabled, or speed > 100").props(
                    "dense outlined data-test=fault-when"
                ).classes("grow")  # fmt: skip
                ui.button(
                    "End all", icon="healing", on_click=lambda: self._do(jobs.end_faults(None), "End all faults")
                ).props("outline no-caps data-test=end-faults")
            boxes: dict[str, ui.element] = {}
            self._reactions: dict[str, tuple[ui.element, ui.label]] = {}
            switches: dict[str, ui.switch] = {}
            present: set[str] = set()
            for group in GROUPS:
                names = [name for name in self._known.faults if FAULTS[name].group == group]
                if names:
                    with (
                        ui.expansion(group.capitalize(), value=group == "sensor")
                        .classes("w-full")
                        .props(f"data-test=faults-{group}"),
                        ui.element("div").classes("studio-faults"),
                    ):
                        for name in names:
                            boxes[name] = self._fault(FAULTS[name], lasts, when, switches, present)

        def show() -> None:
            faults = self._session.glimpse(lambda machine: machine.faults(), 0.05)
            if faults is None:
                return
            present.clear()
            present.update(fault.order.name for fault in faults if fault.active.any() or fault.waiting.any())
            active = {fault.order.name for fault in faults if fault.active.any()}
            self._is_setting = True
            shown = _shown(self._visitor.state)
            for name, box in boxes.items():
                is_on = name in active
                reaction, told = self._reactions[name]
                told.set_text(shown)
                if is_on:
                    reaction.set_visibility(True)
                box.classes(add="is-active" if is_on else "", remove="" if is_on else "is-active")
                if name in switches:
                    switches[name].set_value(name in present)
            self._is_setting = False

        ui.timer(REFRESH, show)

    def _fault(
        self, row: FaultRow, lasts: ui.number, when: ui.input, switches: dict[str, ui.switch],
        present: set[str],
    ) -> ui.element:  # fmt: skip
        fields: dict[str, ui.number] = {}
        with ui.element("div").classes("studio-fault-row") as box:
            with ui.row().classes("items-center w-full"):
                title = row.title[:1].upper() + row.title[1:]
                if row.once:
                    ui.button(title, icon="bolt", on_click=lambda: begin()).props("outline no-caps dense").props(
                        f"data-test=fault-{row.name}"
                    )
                else:
                    switch = ui.switch(title, on_change=lambda event: flip(bool(event.value)))
                    switch.props(f"data-test=fault-{row.name}")
                    switches[row.name] = switch
            with ui.row().classes("studio-buttons"):
                for key, parameter in row.parameters.items():
                    unit = parameter.unit
                    fields[key] = ui.number(
                        f"{key} [{unit}]", value=parameter.default, min=parameter.low, max=parameter.high
                    ).props("dense outlined")
                    fields[key].tooltip(f"{parameter.meaning}: {parameter.low:g} to {parameter.high:g}")
            ui.label(row.physics).classes("studio-hint")
            self._reaction(row)

        async def begin() -> None:
            given = {key: float(field.value) for key, field in fields.items() if field.value is not None}
            duration = None if row.once or not lasts.value else float(lasts.value)
            await self._do(jobs.begin_fault(row.name, duration, when.value or "", given), row.title)
            self._reactions[row.name][0].set_visibility(True)

        async def flip(is_on: bool) -> None:
            if self._is_setting or is_on == (row.name in present):
                return
            if is_on:
                await begin()
            else:
                await self._do(jobs.end_faults(row.name), f"End: {row.title}")

        return box

    def _reaction(self, row: FaultRow) -> None:
        """Show the expected reaction to a fault beside the real one, and the steps that end its effects."""
        device = self._session.description.device
        known = None if device is None else row.on_firmware(device.firmware_name)
        with ui.column().classes("w-full gap-2").props(f"data-test=reaction-{row.name}") as reaction:
            ui.label(f"Should show: {_expected(known)}").classes("studio-strong")
            told = ui.label("").props(f"data-test=shows-{row.name}")
            if known is not None:
                ui.label(known.drive).classes("studio-hint")
            with ui.row().classes("studio-buttons"):
                for number, step in enumerate(() if known is None else known.steps, 1):
                    text = f"{number} {STEPS[step]}"
                    if step == "home":
                        ui.link(text, f"/axes?axis={self._visitor.axis}")
                        continue
                    ui.button(text, on_click=partial(self._take, step, row)).props(
                        f"outline no-caps dense data-test=step-{row.name}-{step}"
                    )
        reaction.set_visibility(False)
        self._reactions[row.name] = reaction, told

    async def _take(self, step: str, row: FaultRow) -> None:
        axis = self._visitor.axis
        await self._do(jobs.take_step(step, row.name, axis), f"{STEPS[step]}, axis {axis}")
        if step != "end" and (state := self._visitor.state) is not None and not state.is_in_fault:
            self._session.forget_faults(axis)


def _expected(row: FaultRow | None) -> str:
    """Describe the emergency that a drive should send for a fault; None means that the table has no reaction."""
    if row is None:
        return "not known of this drive, what follows is its emulator's word alone"
    return "no emergency: this drive does not see it" if row.emergency is None else f"emergency {row.emergency:04X}h"


def _shown(state: AxisState | None) -> str:
    """Describe the emergencies of an axis since its last reset, and its state; "" without an axis."""
    if state is None:
        return ""
    codes = ", ".join(f"{fault.code:04X}h {fault.text.name}" for fault in state.faults) or "no emergency"
    return f"Shows: {codes}; {state_name(state.state)} (axis {state.axis})"


def _truth(machine: Machines) -> str:
    speeds = ", ".join(f"{60.0 * value / (2.0 * math.pi):.1f}" for value in machine.rotor_speed)
    torques = ", ".join(f"{value:.3f}" for value in machine.motor_torque)
    winding = ", ".join(f"{value:.0f}" for value in machine.temperatures[0])
    return f"True values: rotor {speeds} rpm, motor torque {torques} N·m, winding {winding} °C"


page = StudioPage("/machine", "Machine", "precision_manufacturing", 50, build, attach=attach)
