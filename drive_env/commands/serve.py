"""`drive-env serve`: emulated drives on a CAN bus that any master can join, or as slaves of an EtherCAT master."""

from __future__ import annotations

import logging
import os
import secrets
import signal
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from drive_env.commands.options import REFUSED, USER_ERROR, check_free, fail
from drive_env.commands.ready_file import can_address, ethercat_address, told_ready

# The compiler and MuJoCo take long to import: --help should not wait for them.
if TYPE_CHECKING:
    from drive_env.bus.config import Bus
    from drive_env.bus.fault_control import Control
    from drive_env.bus.server import Server
    from drive_env.bus.transport import Transport
    from drive_env.ethercat.beside_can import BesideCan
    from drive_env.ethercat.ethercat_server import EtherCatServer

PORT = 29636  # not a registered service, and no system assigns it to others
LOOPBACK = "127.0.0.1"
AUTO = "auto"  # as --token
NAMES = {"nodes": "--node", "device": "a device", "commissioned": "--factory"}  # of fields with another option name
NEEDS_CHANNEL = ("socketcan",)  # python-can opens it without one and then receives nothing
ETHERCAT = ("ethercat", "ethercat-udp")
TOKEN_BYTES = 12  # random bytes: 16 characters
# SDO requests for any CiA 402 drive: read the statusword and the device name, write the controlword, make TPDO 1
# synchronous.
WARM_UP_REQUESTS = tuple(
    bytes.fromhex(text)
    for text in ("4041600000000000", "4008100000000000", "6000000000000000", "2B40600006000000", "2F00180201000000")
)


def serve(
    device: Annotated[str | None, typer.Argument(help="Device, e.g. tmcm1636 (the default).")] = None,
    load: Annotated[str | None, typer.Option(help="Load on the motor; two_mass by default.")] = None,
    motor: Annotated[
        str | None, typer.Option(help="Motor, a name or a TOML file; the device's usual one by default.")
    ] = None,
    factory: Annotated[
        bool, typer.Option("--factory", help="Drives with factory values, not commissioned for their motor.")
    ] = False,
    node: Annotated[
        list[int] | None,
        typer.Option("--node", "-n", help="Node identifier, 1 by default; once per drive that the machine needs."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Several drives on one bus (TOML), as examples/bus.toml.")] = None,
    port: Annotated[int, typer.Option(help="TCP port of the hub; 0 for a free one.")] = PORT,
    listen: Annotated[
        str, typer.Option(help="Address of the hub; anything but loopback lets the network in and needs --token.")
    ] = LOOPBACK,
    token: Annotated[
        str | None,
        typer.Option(help="What clients of the hub must present: 8 to 48 letters, digits, - and _; auto: makes one."),
    ] = None,
    interface: Annotated[
        str | None,
        typer.Option(
            "--interface",
            "-i",
            help="Instead of the hub: ethercat, ethercat-udp, or one of python-can, e.g. socketcan.",
        ),
    ] = None,
    channel: Annotated[
        str | None, typer.Option("--channel", "-c", help="Channel of that interface, e.g. vcan0; veth1; a UDP port.")
    ] = None,
    bitrate: Annotated[int | None, typer.Option(help="Bit rate of the bus [bit/s]; 1,000,000 by default.")] = None,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time/--lockstep",
            help="Time passes in real time, or by 1 ms with each SYNC or, on EtherCAT, process data (lockstep).",
        ),
    ] = True,
    store: Annotated[
        Path | None,
        typer.Option(help="Folder for the values stored in the nodes; without it they are lost at the end."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    stats: Annotated[
        bool, typer.Option("--stats", help="Print at the end how late cycles were and how busy the bus was.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(help="Stop after this time [s]; otherwise stop with Ctrl-C.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="Inject a fault: 'encoder_stuck at=2 duration=0.1 node=1'; may be repeated."),
    ] = None,
    control: Annotated[int | None, typer.Option(help="Loopback port for `drive-env fault`; 0 for a free one.")] = None,
    pcap: Annotated[
        Path | None, typer.Option(help="Write all frames to this file, for Wireshark; on EtherCAT alone.")
    ] = None,
    ready_file: Annotated[
        Path | None, typer.Option(help="JSON for scripts: written once the drives can be reached, removed at the end.")
    ] = None,
) -> None:
    """Put emulated drives on a CAN bus for python-can, python-canopen and drive-env, or on EtherCAT for its masters."""
    server: list[Server | EtherCatServer] = []
    previous = [(number, signal.signal(number, _ender(server))) for number in (signal.SIGINT, signal.SIGTERM)]
    logging.basicConfig(format="drive-env: %(message)s", level=logging.WARNING)
    try:
        machine: dict[str, Any] = {
            "device": device, "load": load, "motor": motor, "nodes": tuple(node) if node else None,
            "commissioned": False if factory else None,
        }  # fmt: skip
        bus = _bus(machine, config, bitrate, store, seed)
        if duration is not None and not duration > 0.0:
            _fail(f"--duration {duration:g} s must be above 0 s")
        for file in (pcap, ready_file):
            _check_new(file)
        if interface in ETHERCAT:
            theirs = {"node": node, "token": token, "bitrate": bitrate, "fault": fault, "control": control}
            _serve_ethercat(server, bus, real_time, interface, channel, duration, pcap, stats, ready_file, theirs)
            return
        if pcap is not None:
            _fail(f"--pcap {pcap} is for --interface ethercat; on CAN drive-env frames log writes frames")
        if token == AUTO:
            token = secrets.token_urlsafe(TOKEN_BYTES)
        made = _server(bus, real_time, port, listen, token, interface, channel)
        server.append(made)
        control_ports, beside = _faults(made, fault or [], control), _beside(made, bus, real_time)
        controls: list[Control | BesideCan] = [*control_ports, *beside]
        ready = can_address(made.transport, interface, channel) | {
            "control": next((one.port for one in control_ports), None), "token": token,
            "ethercat": next((ethercat_address(one.way, bus.ethercat_interface) for one in beside), None),
        }  # fmt: skip
        _announce(made, bus, real_time, token, interface, channel)
        try:
            with told_ready(ready_file, ready, _fail):
                made.run(duration)
        except _can_error() as error:
            _fail(f"the interface {interface} failed: {error}", REFUSED)
        finally:
            for one in controls:
                one.close()
            made.close()
            made.world.close()
        if stats:
            print(_statistics(made), flush=True)
        print("drive-env: stopped", flush=True)
    finally:
        for number, handler in previous:
            signal.signal(number, handler)


def _check_new(file: Path | None) -> None:
    """End the command if a file to be written exists already, or its folder does not."""
    if file is None:
        return
    try:
        check_free(file)
    except ValueError as error:
        _fail(str(error))
    if not file.absolute().parent.is_dir():
        _fail(f"{file}: there is no folder {file.parent}; make it, or choose another file")


def _bus(one: Mapping[str, Any], config: Path | None, bitrate: int | None, store: Path | None, seed: int | None) -> Bus:
    """Return the bus of the arguments; `one` are those of its one machine, None for those not given."""
    from drive_env.bus.config import Bus, BusConfigError, Machine, load_bus

    one = {key: value for key, value in one.items() if value is not None}
    every: dict[str, Any] = {"bit_rate": bitrate, "store": str(store) if store else None, "seed": seed}
    every = {key: value for key, value in every.items() if value is not None}
    try:
        if config is None:
            return replace(Bus(machines=(Machine(**one),)), **every)
        bus = load_bus(config)
        if one and len(bus.machines) > 1:
            name = next(iter(one))
            flag = NAMES.get(name, f"--{name}")
            _fail(f"{config} has {len(bus.machines)} machines, so {flag} is ambiguous; change the file")
        return replace(bus, machines=tuple(replace(row, **one) for row in bus.machines), **every)
    except BusConfigError as error:
        _fail(str(error))


def _serve_ethercat(
    server: list[Server | EtherCatServer],
    bus: Bus,
    real_time: bool,
    interface: str,
    channel: str | None,
    duration: float | None,
    pcap: Path | None,
    stats: bool,
    ready_file: Path | None,
    of_can: Mapping[str, object],
) -> None:
    """Serve on EtherCAT; `of_can` are options that it does not have."""
    from drive_env.commands.serve_ethercat import open_ethercat, run_ethercat

    if bus.has_both:
        _fail(
            f"machines of this bus are on CAN, too: leave --interface {interface} out; the file says where EtherCAT is"
        )
    for name, value in of_can.items():
        if value is not None and value != []:
            _fail(f"--{name} is for CAN; a slave on --interface {interface} has none: leave it out")
    made = open_ethercat(bus, real_time, interface, channel, _fail)
    server.append(made)
    with told_ready(ready_file, ethercat_address(made.way, interface), _fail):
        run_ethercat(made, bus, duration, pcap, stats)
    print("drive-env: stopped", flush=True)


def _server(
    bus: Bus, real_time: bool, port: int, listen: str, token: str | None, interface: str | None, channel: str | None
) -> Server:
    """Return the server of a bus, its kernels compiled, its transport open."""
    from drive_env.bus.config import BusConfigError, build_world
    from drive_env.bus.hub import Hub
    from drive_env.bus.server import Server

    if interface is None and channel is not None:
        _fail(f"--channel {channel} needs --interface, e.g. --interface socketcan")
    if interface is not None and token is not None:
        _fail(f"--token is for the hub; --interface {interface} has no tokens")
    if not listen:  # the system would use it for every address
        _fail(f"--listen must be an address, e.g. {LOOPBACK}; 0.0.0.0 lets the whole network in")
    if not 0 <= port <= 65_535:
        _fail(f"--port {port} must be 0 to 65535")
    try:
        world = build_world(bus, lockstep=not real_time, own_wire=interface is None)
    except BusConfigError as error:
        _fail(str(error))

    def open_transport() -> Transport:
        if interface is not None:
            return _can_port(interface, channel, bus.bit_rate)
        try:
            return Hub(port, listen, bus.bit_rate, token=token)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            _fail(f"cannot listen on {listen}:{port}: {reason}; choose another --port (0: a free one) or --listen")
        except ValueError as error:
            _fail(f"{error}; give --token auto, --token TEXT of 8 characters or more, or --listen {LOOPBACK}")

    # Opened for a moment, so that mistakes are reported before a minute of compiling; then only when drives answer:
    # otherwise a master would take the drives for silent, and its frames would pile up.
    open_transport().close()
    _warm_up(bus)
    return Server(world, open_transport())


def _beside(server: Server, bus: Bus, real_time: bool) -> list[BesideCan]:
    """Return the EtherCAT side of a bus that has drives on both; [] without one."""
    from drive_env.commands.serve_ethercat import open_beside

    if not bus.has_both:
        return []
    if not real_time:
        _fail("drives on CAN and EtherCAT at once have one time, that of the clock: leave --lockstep out")
    return [open_beside(server, bus, _fail)]


def _faults(server: Server, orders: list[str], port: int | None) -> list[Control]:
    """Schedule faults, and return the control socket if one is requested."""
    from drive_env.bus.bus_faults import BusFaults
    from drive_env.bus.fault_control import Control
    from drive_env.faults.schedule import parse_order

    if not orders and port is None:
        return []
    faults = BusFaults(server.world)
    try:
        for order in orders:
            faults.add(parse_order(order))
        if port is None:
            return []
        if not 0 <= port <= 65_535:
            raise ValueError(f"--control {port} must be 0 to 65535")
        control = Control(faults, port)
    except (ValueError, OSError) as error:
        server.close()
        server.world.close()
        if isinstance(error, OSError):
            why = os.strerror(error.errno or 0)
            _fail(f"cannot listen on {LOOPBACK}:{port}: {why}; choose another --control (0: a free one)")
        _fail(f"--fault: {error}" if orders else str(error))
    print(f"drive-env: inject faults with: drive-env fault NAME --control {control.port}")
    return [control]


def _can_port(interface: str, channel: str | None, bit_rate: int) -> Transport:
    import can

    from drive_env.bus.can_port import CanPort

    if interface in NEEDS_CHANNEL and not (channel or can.util.load_config(config={"interface": interface})["channel"]):
        _fail(f"--interface {interface} needs --channel, e.g. --channel vcan0; without one no master could reach it")
    try:
        return CanPort(can.Bus(interface=interface, channel=channel, bitrate=bit_rate))
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError, ImportError) as error:
        _fail(f"cannot open --interface {interface} --channel {channel}: {error}")


def _warm_up(bus: Bus) -> None:
    """Do the work of serving once on temporary drives: the first time compiles or loads for long."""
    from drive_env.bus.config import build_world
    from drive_env.canopen.frames import NMT, SDO_REQUEST, SYNC, Frame

    row = bus.machines[0]
    world = build_world(replace(bus, machines=(row,), store=None), lockstep=True)
    world.power_on()
    for data in WARM_UP_REQUESTS:
        world.receive(Frame(SDO_REQUEST + row.nodes[0], data))
    world.receive(Frame(NMT, bytes((1, row.nodes[0]))))
    for _ in range(3):
        world.receive(Frame(SYNC))
    world.close()


def _announce(
    server: Server, bus: Bus, real_time: bool, token: str | None, interface: str | None, channel: str | None
) -> None:
    from drive_env.bus.hub import Hub

    nodes = ", ".join(
        f"node {', '.join(_booted(server, node) for node in row.nodes)} ({row.device}, {row.motor_name}, {row.load}"
        f"{f'; {len(row.on_ethercat)} on EtherCAT' if row.on_ethercat else ''}"
        f"{'' if row.commissioned else '; factory values, not commissioned'})"
        for row in bus.machines
    )
    pace = "in real time" if real_time else "in lockstep: each SYNC is 1 ms"
    print(f"drive-env: {nodes}, {bus.bit_rate / 1e3:g} kbit/s, {pace}; stop with Ctrl-C")
    hub = server.transport
    if isinstance(hub, Hub):
        if hub.is_public:
            print(
                f"drive-env: {hub.host}:{hub.port} is open to the network: any program that can reach it and has "
                "the token may read and move these drives. Token and frames travel as plain text; where others listen, "
                f"serve on {LOOPBACK} and use an SSH tunnel."
            )
        print("import can")
        print(f'bus = can.Bus(interface="slcan", channel="{hub.channel}", sleep_after_open=0)')
        if token is not None:
            print(f'bus.serialPortOrig.write(b"K{token}\\r"); bus.open()')
            print(f"drive-env: programs of drive-env take the token from the environment: DRIVE_ENV_TOKEN={token}")
    else:
        print(f"on {interface} {channel or ''}".rstrip())
    sys.stdout.flush()


def _booted(server: Server, given: int) -> str:
    """Return the node-ID with which a node boots, with the given one if its store has another."""
    from drive_env.canopen.node import Node

    node = server.world.nodes.get(given)  # a node without a node-ID has another key
    booted = node.node_id if isinstance(node, Node) else given
    return f"{booted}" if booted == given else f"{booted} (in its store; {given} was given)"


def _statistics(server: Server) -> str:
    """Return the lines of --stats."""
    world, late = server.world, server.lateness
    counts = world.wire.statistics
    lost = counts.lost + getattr(server.transport, "lost", 0)
    rate = f" = {counts.frames / world.time:.0f}/s" if world.time else ""
    lines = [
        f"{counts.frames} frames in {world.time:.3f} s of the drives' time{rate}, {counts.errors} error frames, "
        f"{lost} lost",
        f"bus load {100 * world.load():.1f} %, at most {counts.most_waiting} frames waiting",
    ]
    if late.count:
        p50, p99 = late.percentile(0.5), late.percentile(0.99)
        lines.insert(
            0,
            f"lateness of {late.count} cycles of 1 ms: p50 {1e3 * p50:.3f} ms, p99 {1e3 * p99:.3f} ms, "
            f"max {1e3 * late.largest:.3f} ms, {server.skipped:.3f} s skipped",
        )
    return "\n".join(lines)


def _ender(server: list[Server | EtherCatServer]) -> Any:
    """Return a signal handler that ends the server, or the process if the server does not exist yet."""

    def end(*_: object) -> None:
        if server:
            server[0].stop()
        else:  # not by an exception, which would be lost while the compiler calls back into Python
            print("drive-env: stopped before it began to serve", flush=True)
            os._exit(0)

    return end


def _can_error() -> type[Exception]:
    import can

    error: type[Exception] = can.CanError
    return error


def _fail(message: str, code: int = USER_ERROR) -> NoReturn:
    fail(message, code)
