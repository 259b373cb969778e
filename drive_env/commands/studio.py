"""`drive-env studio`: a web page for drives, emulated or on a bus."""

from __future__ import annotations

import importlib.util
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drive_env.commands.options import (
    Eds,
    NodesOptions,
    check_time,
    cycle_for,
    errors_as_exit_codes,
    grouped,
    names_a_bus,
    was_typed,
)
from drive_env.commands.scope import refuse_other_masters

if TYPE_CHECKING:
    from drive_env.drives.interface import Drives
    from drive_env.fieldbus.description import Description

OF_EMULATED = ("load", "motor", "seed", "factory")
LOOK = 0.02  # s between two checks whether the bus is open


@grouped
def studio(
    context: typer.Context,
    *,
    bus: NodesOptions,
    eds: Eds = None,
    load: Annotated[str, typer.Option(help="Load of the emulated machine, a name or an MJCF file.")] = "two_mass",
    motor: Annotated[
        str | None, typer.Option(help="Its motor, a name or a TOML file; the device's usual one by default.")
    ] = None,
    factory: Annotated[bool, typer.Option("--factory", help="Emulated drives with factory values.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of everything random in the emulated machine.")] = 0,
    port: Annotated[int, typer.Option(help="TCP port of the page; 0 for a free one.")] = 29640,
    listen: Annotated[
        str, typer.Option(help="Address of the page; any but loopback lets the network in, with a token.")
    ] = "127.0.0.1",
    token: Annotated[
        str | None, typer.Option(help="Token of other addresses, 12 letters or more; one is made if none is given.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Stop after this time [s]; otherwise stop with Ctrl-C.")
    ] = None,
    workspace: Annotated[
        Path | None,
        typer.Option(help="TOML with channels, triggers and jog speeds of the pages; made, and kept up to date."),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show drives on a local web page: state, motion, scope, dictionary; and what tuning and agents add.

    Emulated drives, unless --interface, --channel or --node names those of a bus. On a bus the safety envelope is on.
    Quick stop is a button and the space bar of every page; a page that is closed, or asleep, stops what it moves.
    """
    with errors_as_exit_codes():
        check_extra()
        from drive_env.fieldbus.description import describe
        from drive_env.master.open_drives import is_ethercat
        from drive_env.studio import server
        from drive_env.studio.gate import checked_token, is_loopback, new_token
        from drive_env.studio.pages import studio_pages
        from drive_env.studio.session import Session
        from drive_env.studio.workspace import Workspace

        check_time("--duration", duration)
        is_bus = names_a_bus(context) or eds is not None
        if wrong := [name for name in OF_EMULATED if was_typed(context, name) and is_bus]:
            raise ValueError(f"--{wrong[0]} is of an emulated machine, and a bus is named: leave one of them out")
        if not 0 <= port <= 65_535:
            raise ValueError(f"--port {port} must be 0 to 65535")
        if not listen:
            raise ValueError("--listen must be an address, e.g. 127.0.0.1; 0.0.0.0 lets the whole network in")
        device = bus.device
        described = describe(device, eds, is_bus and is_ethercat(bus.interface))
        opener = _bus(described, bus, eds) if is_bus else _machine(device, load, motor, factory, seed)
        title = _title(described, bus) if is_bus else f"{device}, emulated, load {load}"
        named = {"interface": bus.interface, "channel": bus.channel, "nodes": bus.node, "bitrate": bus.bitrate}
        address = named if is_bus else {}
        given = {name: one for name, one in address.items() if one is not None}
        session = Session(opener, title, described, given, Workspace(described, workspace))
        pages = studio_pages(emulated=not is_bus)
        if is_loopback(listen) and token is None:
            ticket = None
        else:
            ticket = new_token() if token is None else checked_token(token)
        sock = server.listen(listen, port)
        url = server.address(listen, sock.getsockname()[1], ticket)

        def ready() -> None:
            while is_bus and session.state == "opening":  # an emulator may compile for a minute: its page shows it
                time.sleep(LOOK)
            if session.state == "failed":
                return
            print(f"drive-env: {title}: {url}", flush=True)
            print("drive-env: stop with Ctrl-C", flush=True)
            if browser:
                webbrowser.open(url)

        server.serve_studio(session, pages, sock, server.ServingTerms(listen, ticket, duration), ready)
        if session.error is not None:
            raise session.error
        if session.failure:
            raise RuntimeError(session.failure)
        print("drive-env: stopped", flush=True)


def check_extra() -> None:
    """Raise ValueError if the studio's packages are not installed."""
    if importlib.util.find_spec("nicegui") is None:
        raise ValueError("the studio needs NiceGUI, which is not installed: pip install 'drive-env[studio]'")


def _machine(device: str, load: str, motor: str | None, factory: bool, seed: int) -> Callable[[], Drives]:
    """Return a function that opens an emulated machine; ValueError if it cannot be opened."""
    from drive_env.devices import find_device
    from drive_env.motors import find_motor
    from mechanics.loads import find_load

    known = find_device(device)
    known.check_motor(find_motor(known.default_motor if motor is None else motor))
    find_load(load)

    def open_machine() -> Drives:
        from drive_env.emulator.emulated_drives import EmulatedDrives

        return EmulatedDrives(device, load, motor, seed=seed, commissioned=not factory)

    return open_machine


def _bus(described: Description, bus: NodesOptions, eds: Path | None) -> Callable[[], Drives]:
    """Return a function that opens drives of a bus with the envelope; it raises if another master commands them."""

    def open_bus() -> Drives:
        refuse_other_masters(bus.interface, bus.channel, bus.nodes, bus.bitrate)
        return bus.connect(eds, cycle=cycle_for(described))

    return open_bus


def _title(described: Description, bus: NodesOptions) -> str:
    from drive_env.master.open_drives import default_nodes

    where = " ".join(filter(None, (bus.interface, bus.channel))) or "the bus"
    numbers = ", ".join(map(str, bus.nodes or default_nodes(bus.interface)))
    return f"{described.name}, node {numbers} on {where}"
