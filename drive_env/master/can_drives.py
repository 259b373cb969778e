"""Drives on a CAN bus: real ones, or the emulator served on a bus."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import can

from drive_env.default_device import DEFAULT_DEVICE
from drive_env.dictionary.entries import ObjectName
from drive_env.drives.limits import Limits
from drive_env.fieldbus.description import check_timeout, describe
from drive_env.master.bus_drives import BusDrives, checked_limits
from drive_env.master.can.bus_time import BIT_RATE, BusTime
from drive_env.master.can.can_link import CanLink
from drive_env.master.can.dry_run import DryPort
from drive_env.master.can.network import check_nodes
from drive_env.master.can.port import Port, open_bus
from drive_env.master.can.sdo import SdoClient
from drive_env.master.pace import LockstepPace, Pace, RealTimePace, cycles_per_sync

TWIN_TIME = 0.005  # s by which a second node with the same node-ID may answer later: both are of one kind


class CanDrives(BusDrives):
    """Drives on a CAN bus, with the interface of `EmulatedDrives`: the same calls, the same integers.

    Axes are those of the first node, then those of the second, and so on. Nodes are started (NMT) when PDOs or a
    watchdog need it; `close` restores PDO mapping and error control. `record` samples in synchronous TPDOs and plays in
    synchronous RPDOs, or in others if a drive has none. PDOs of further axes without an identifier borrow those of the
    node-IDs above (`borrowed_identifiers.py`).

    Args:
        device: Name of a known device; ignored with `eds`.
        eds: EDS of any other CiA 402 drive; cp1252 files are read, too.
        interface: The name in python-can; from DRIVE_ENV_INTERFACE if not given.
        channel: The channel, e.g. "can0" or "socket://127.0.0.1:PORT"; from DRIVE_ENV_CHANNEL if not given.
        nodes: Node-IDs, all of this device.
        pace: "real-time": time passes by the clock, one SYNC per communication cycle. "lockstep": time passes by SYNC,
            for an emulator served with --lockstep.
        cycle: Time between two SYNCs in real time [s]: whole communication cycles of the drives, one by default. Many
            axes need a longer one: frames that do not fit into it are refused. Set 60C2h to it for csp and csv;
            durations of `advance` and `period` of `record` are multiples of it.
        bus: An open python-can bus in place of interface and channel; it stays open afterwards.
        timeout: Longest wait for an answer [s]; the device's own by default.
        timeouts: Object -> time-out [s], for objects that need another.
        safety: Limits; False: no limits, which is for emulators.
        dry_run: Print frames and send none: answers are the dictionary's defaults. A function takes the lines instead.
        options: Further options of the interface, e.g. `bitrate=1_000_000`; `token` for a hub that requires one (from
            DRIVE_ENV_TOKEN if not given).

    Raises:
        BusError: If the bus cannot be opened, a node does not answer or is another device, or two nodes have one
            node-ID.
        ValueError: For an unknown device or pace, an impossible node-ID or time-out.
    """

    def __init__(
        self,
        device: str = DEFAULT_DEVICE,
        *,
        eds: str | Path | None = None,
        interface: str | None = None,
        channel: str | None = None,
        nodes: Iterable[int] = (1,),
        pace: Literal["real-time", "lockstep"] = "real-time",
        cycle: float | None = None,
        bus: can.BusABC | None = None,
        timeout: float | None = None,
        timeouts: Mapping[ObjectName, float] | None = None,
        safety: Limits | bool = True,
        dry_run: bool | Callable[[str], None] = False,
        **options: Any,
    ) -> None:
        description = describe(device, eds)
        description.timeout = None if timeout is None else check_timeout(timeout)
        for name, value in (timeouts or {}).items():
            entry = description.dictionary.find(name)
            check_timeout(value)
            description.timeouts[entry.index, entry.sub] = value
        node_ids = check_nodes(nodes)
        if pace not in ("real-time", "lockstep"):
            raise ValueError(f"pace is 'real-time' or 'lockstep', not {pace!r}")
        checked_limits(safety)
        if cycle is not None:
            description.cycles_per_sync = cycles_per_sync(cycle, description.cycle, pace)
            description.cycle *= description.cycles_per_sync
        # Nor does a dry run have anything to wait for.
        by_sync = pace == "lockstep" or bool(dry_run)
        paced: Pace = LockstepPace() if by_sync else RealTimePace(description.cycle)
        port: Port
        if dry_run:
            port = DryPort(dry_run if callable(dry_run) else print)
        elif bus is not None:
            port = Port(bus, owned=False)
        else:
            port = Port(open_bus(interface, channel, **options))
        self._port = port
        bus_time = BusTime() if by_sync else BusTime(float(options.get("bitrate") or BIT_RATE), description.cycle)
        link = CanLink(port, node_ids, description, bus_time, 0.0 if by_sync else TWIN_TIME)
        super().__init__(link, description, paced, safety)

    @property
    def port(self) -> Port:
        """The bus."""
        return self._port


def check_nodes_answer(
    device: str,
    interface: str | None,
    nodes: Iterable[int],
    *,
    channel: Any = None,
    eds: str | Path | None = None,
    timeout: float | None = None,
    bitrate: int | None = None,
) -> None:
    """Raise NoAnswerError for a silent node, without an NMT command; the arguments are those of `CanDrives`."""
    patience = describe(device, eds).answer_timeout if timeout is None else timeout
    port = Port(open_bus(interface, channel, **({} if bitrate is None else {"bitrate": bitrate})))
    try:
        for node in nodes:
            SdoClient(port, node).read(0x1000, 0, "1000h:00 Device type", patience)
    finally:
        port.close()
