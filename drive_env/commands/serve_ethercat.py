"""`drive-env serve --interface ethercat`: emulated drives as slaves of an EtherCAT master."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from drive_env.bus.config import Bus
    from drive_env.bus.server import Server
    from drive_env.ethercat.beside_can import BesideCan
    from drive_env.ethercat.ethercat_server import EtherCatServer
    from drive_env.ethercat.ways import EtherCatWay
    from drive_env.ethercat.world import EtherCatWorld

RAW, UDP = "ethercat", "ethercat-udp"
WARM_UP_CYCLES = 3


def open_ethercat(
    bus: Bus, real_time: bool, interface: str, channel: str | None, fail: Callable[[str], NoReturn]
) -> EtherCatServer:
    """Return the server of a bus on EtherCAT, its kernels compiled, its transport open; `fail` ends the command."""
    from drive_env.bus.config import BusConfigError
    from drive_env.ethercat.ethercat_server import EtherCatServer
    from drive_env.ethercat.slaves import build_ethercat_world

    def open_way() -> EtherCatWay:
        try:
            return _way(interface, channel, fail)
        except OSError as error:
            fail(str(error))

    def build(which: Bus, lockstep: bool) -> EtherCatWorld:
        try:
            return build_ethercat_world(which, lockstep=lockstep)
        except BusConfigError as error:
            fail(str(error))

    open_way().close()  # mistakes are reported before a minute of compiling
    world = build(bus, not real_time)
    first = build(replace(bus, machines=bus.machines[:1], store=None), True)
    first.power_on()
    for _ in range(WARM_UP_CYCLES):
        first.cycle()
    first.close()
    return EtherCatServer(world, open_way())


def open_beside(server: Server, bus: Bus, fail: Callable[[str], NoReturn]) -> BesideCan:
    """Serve the EtherCAT slaves of a bus that also has drives on CAN; `fail` ends the command."""
    from drive_env.bus.config import BusConfigError
    from drive_env.ethercat.beside_can import BesideCan
    from drive_env.ethercat.slaves import build_beside

    if bus.ethercat_interface not in (RAW, UDP):
        fail(f"ethercat_interface = {bus.ethercat_interface!r} must be {RAW} or {UDP}")
    try:
        beside = BesideCan(
            server, build_beside(bus, server.world), _way(bus.ethercat_interface, bus.ethercat_channel, fail)
        )
    except (BusConfigError, OSError) as error:
        fail(str(error))
    beside.start()
    number = len(beside.world.segment.slaves)
    print(f"drive-env: {number} slave{'s' if number > 1 else ''} on {beside.way.name}, beside the nodes on CAN")
    return beside


def run_ethercat(server: EtherCatServer, bus: Bus, duration: float | None, pcap: Path | None, stats: bool) -> None:
    """Serve until `duration` [s] is over or a signal ends it, printing lines for the user."""
    from drive_env.ethercat.pcap_log import PcapLog

    log = None
    if pcap is not None:
        log = PcapLog(pcap)
        server.world.segment.listeners.append(log.add)
    _announce(server, bus)
    try:
        server.run(duration)
    finally:
        server.close()
        server.world.close()
        if log is not None:
            log.close()
    if stats:
        print(_statistics(server), flush=True)


def _way(interface: str, channel: str | None, fail: Callable[[str], NoReturn]) -> EtherCatWay:
    from drive_env.ethercat.datagrams import PORT
    from drive_env.ethercat.ways import RawSocket, UdpSocket

    if interface == RAW:
        if channel is None:
            fail(f"--interface {RAW} needs --channel, the network interface, e.g. --channel veth1")
        return RawSocket(channel)
    if channel is not None and not (channel.isdecimal() and int(channel) <= 65_535):
        fail(f"--channel {channel} must be a UDP port, 0 to 65535; without it {UDP} takes {PORT}")
    return UdpSocket(PORT if channel is None else int(channel))


def _announce(server: EtherCatServer, bus: Bus) -> None:
    names = ", ".join(f"{row.device}, {row.motor_name}, {row.load}" for row in bus.machines)
    number = len(server.world.segment.slaves)
    cycle = f"in lockstep: each frame with process data is {1e3 * server.world.cycle_time:g} ms"
    pace = cycle if server.world.lockstep else "in real time"
    print(
        f"drive-env: {number} slave{'s' if number > 1 else ''} ({names}) on {server.way.name}, {pace}; stop with Ctrl-C"
    )
    sys.stdout.flush()


def _statistics(server: EtherCatServer) -> str:
    """Return the lines of --stats."""
    world, way = server.world, server.way
    lines = [f"{way.answered} frames answered in {world.time:.3f} s of the drives' time, {way.lost} lost"]
    for name, late in (("cycles", server.lateness), ("answers", server.answer_times)):
        if late.count:
            p50, p99 = late.percentile(0.5), late.percentile(0.99)
            lines.append(
                f"lateness of {late.count} {name}: p50 {1e3 * p50:.3f} ms, p99 {1e3 * p99:.3f} ms, "
                f"max {1e3 * late.largest:.3f} ms"
            )
    return "\n".join(lines)
