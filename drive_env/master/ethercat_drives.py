"""Drives on EtherCAT: real ones, or the emulator served on a segment."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from drive_env.dictionary.entries import ObjectName
from drive_env.drives.limits import Limits
from drive_env.fieldbus.description import check_timeout, describe
from drive_env.fieldbus.errors import OpenError
from drive_env.master.bus_drives import BusDrives, checked_limits
from drive_env.master.ethercat.ethercat_link import EtherCatLink
from drive_env.master.ethercat.ethercat_master import EtherCatMaster
from drive_env.master.pace import LockstepPace, Pace, RealTimePace, cycles_per_sync

if TYPE_CHECKING:
    from drive_env.master.ethercat.frame_master import FrameMaster
    from drive_env.master.ethercat.frame_ways import FrameWay

RAW, UDP = "ethercat", "ethercat-udp"
OF_CAN = ("bitrate", "bus", "dry_run", "token")  # options of `CanDrives` only


class EtherCatDrives(BusDrives):
    """Drives on EtherCAT, with the interface of `EmulatedDrives`: the same calls, the same integers.

    Axes are those of the first slave, then those of the second, and so on. All slaves of the segment are this
    program's: they are found and taken to Pre-Op when the drives are opened, to Op when process data or a watchdog need
    it, and to Init by `close`. `read` and `write` are SDO transfers (CoE). `record` samples and plays in the process
    images; a sample is the drive's value before it applied the row played with it. Images can be changed only in
    Pre-Op, where no motor runs: objects to record or play while an axis is enabled must be in them already, so record
    or play them once before.

    Args:
        device: Name of a known device; ignored with `eds`.
        eds: EDS of any other CiA 402 drive with CoE.
        interface: "ethercat": a network interface, by pysoem (extra `ethercat`); "ethercat-udp": EtherCAT over UDP on
            this computer, as served by `drive-env serve`.
        channel: The network interface, e.g. "eth1", or the UDP port; from DRIVE_ENV_CHANNEL if not given.
        nodes: Positions of the slaves in the line, from 0, all of this device.
        pace: "real-time": time passes by the clock, one frame per communication cycle. "lockstep": time passes by
            frames, for an emulator served with --lockstep.
        safety: Limits; False: no limits, which is for emulators.
        options: `sync0`, whether outputs take effect with SYNC0 of the distributed clocks, once a cycle; `master`, an
            `EtherCatMaster` in place of interface and channel; `cycle`, time between two frames in real time [s], whole
            communication cycles of the drives; `timeout`, longest wait for an answer [s], and `timeouts`, object -> the
            same for that object.

    Raises:
        BusError: If the segment cannot be opened, a slave does not answer or is another device.
        ValueError: For an unknown device, pace or option, an impossible position or time.
    """

    def __init__(
        self,
        device: str = "tmcm3313",
        *,
        eds: str | Path | None = None,
        interface: str = RAW,
        channel: str | None = None,
        nodes: Iterable[int] = (0,),
        pace: Literal["real-time", "lockstep"] = "real-time",
        safety: Limits | bool = True,
        **options: Any,
    ) -> None:
        master: EtherCatMaster | None = options.pop("master", None)
        cycle: float | None = options.pop("cycle", None)
        sync0 = bool(options.pop("sync0", False))
        timeout: float | None = options.pop("timeout", None)
        timeouts: Mapping[ObjectName, float] = options.pop("timeouts", None) or {}
        for option in options:
            of_can = f"{option} is for CAN; leave it out with interface={interface!r}"
            raise ValueError(of_can if option in OF_CAN else f"EtherCatDrives takes no {option!r}")
        description = describe(device, eds, on_ethercat=True)
        description.timeout = None if timeout is None else check_timeout(timeout)
        for name, value in timeouts.items():
            entry = description.dictionary.find(name)
            description.timeouts[entry.index, entry.sub] = check_timeout(value)
        positions = check_positions(nodes)
        if pace not in ("real-time", "lockstep"):
            raise ValueError(f"pace is 'real-time' or 'lockstep', not {pace!r}")
        checked_limits(safety)
        if cycle is not None:
            description.cycles_per_sync = cycles_per_sync(cycle, description.cycle, pace)
            description.cycle *= description.cycles_per_sync
        lockstep = pace == "lockstep"
        if master is None:
            master = open_master(interface, channel, description.answer_timeout if lockstep else None)
        link = EtherCatLink(master, positions, description, lockstep, sync0)
        phase = None if link.process.phase is None else link.process.phase.wait
        paced: Pace = LockstepPace() if lockstep else RealTimePace(description.cycle, phase)
        super().__init__(link, description, paced, safety)


def open_master(interface: str, channel: str | None, frame_timeout: float | None = None) -> EtherCatMaster:
    """Open a master on a network interface, or over UDP.

    Args:
        interface: "ethercat" or "ethercat-udp".
        channel: Network interface, or UDP port.
        frame_timeout: Longest wait for a frame over UDP [s].

    Raises:
        OpenError: If it cannot be opened.
        ValueError: For another interface, or an impossible channel.
    """
    name = channel if channel is not None else os.environ.get("DRIVE_ENV_CHANNEL")
    if interface == RAW:
        from drive_env.master.ethercat.soem_master import SoemMaster

        if not name:
            raise OpenError(f"interface={RAW!r} needs a channel, the network interface, e.g. eth1")
        return SoemMaster(name)
    return open_frames(interface, channel, frame_timeout)


def open_frames(interface: str | None, channel: str | None, frame_timeout: float | None = None) -> FrameMaster:
    """Open our own master, with arguments as `open_master`; on a network interface only to inspect a segment."""
    from drive_env.master.ethercat.frame_master import FRAME, FrameMaster

    return FrameMaster(_open_way(interface, channel), frame_timeout or FRAME)


def _open_way(interface: str | None, channel: str | None) -> FrameWay:
    from drive_env.ethercat.datagrams import PORT
    from drive_env.master.ethercat.frame_ways import RawWay, UdpWay

    kind = interface or os.environ.get("DRIVE_ENV_INTERFACE")
    name = channel if channel is not None else os.environ.get("DRIVE_ENV_CHANNEL")
    if kind == RAW:
        if not name:
            raise OpenError(f"interface={RAW!r} needs a channel, the network interface, e.g. eth1")
        return RawWay(name)
    if kind != UDP:
        raise ValueError(f"interface is {RAW!r} or {UDP!r} on EtherCAT, not {kind!r}")
    if name is not None and not (name.isdecimal() and 0 < int(name) <= 65_535):
        raise OpenError(f"channel {name!r} must be a UDP port, 1 to 65535; without it {UDP} takes {PORT}")
    return UdpWay(PORT if name is None else int(name))


def check_positions(nodes: Iterable[int]) -> tuple[int, ...]:
    """Return the positions; ValueError if one is impossible or given twice, or the list is empty."""
    positions = tuple(int(node) for node in nodes)
    if not positions or len(set(positions)) < len(positions) or min(positions) < 0:
        raise ValueError(f"nodes={list(positions)} must be positions in the line, from 0, each once")
    return positions
