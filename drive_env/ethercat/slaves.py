"""A world on EtherCAT from the description of a bus: each machine's devices are slaves in a line."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from drive_env.bus.config import BusConfigError, build_drives, check_seed, store_folder
from drive_env.devices import find_device
from drive_env.drives.interface import CYCLE
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld

if TYPE_CHECKING:
    from drive_env.bus.config import Bus
    from drive_env.bus.world import World
    from drive_env.emulator.emulated_drives import EmulatedDrives


def build_ethercat_world(bus: Bus, *, lockstep: bool) -> EtherCatWorld:
    """Return the world of a bus on EtherCAT, its slaves not switched on yet.

    Args:
        bus: Its configuration; bit rate, node-IDs and faults of the wire apply only to CAN.
        lockstep: Whether time advances only with process data.

    Raises:
        BusConfigError: If the bus is impossible.
    """
    check_seed(bus)
    world = EtherCatWorld(lockstep=lockstep, cycle_time=_cycle_time(bus))
    try:
        store = store_folder(bus)
        for k in range(len(bus.machines)):
            drives = build_drives(bus, k)
            world.drives += [drives, *add_slaves(world, drives, store)]
    except (ValueError, OSError) as error:
        world.close()
        raise BusConfigError(str(error)) from None
    return world


def build_beside(bus: Bus, world: World) -> EtherCatWorld:
    """Return the slaves of a bus whose other devices are nodes of a CAN world; they follow that world's time.

    Raises:
        BusConfigError: If the bus is impossible.
    """
    beside = EtherCatWorld(lockstep=world.lockstep, cycle_time=_cycle_time(bus))
    try:
        if beside.cycle_time != CYCLE:
            raise ValueError(f"beside CAN a communication cycle is {1e3 * CYCLE:g} ms, not {1e3 * beside.cycle_time:g}")
        store = store_folder(bus)
        for drives, row in zip(world.machines, bus.machines, strict=True):
            world.drives += add_slaves(beside, drives, store, row.on_ethercat)
    except (ValueError, OSError) as error:
        raise BusConfigError(str(error)) from None
    world.beside = beside
    return beside


def add_slaves(
    world: EtherCatWorld, drives: EmulatedDrives, store: Path | None, devices: Collection[int] | None = None
) -> list[EmulatedDrives]:
    """Put devices of a machine at the end of the line.

    Args:
        world: The world with the line.
        drives: The machine's drives.
        store: Folder of the slaves' stored values.
        devices: Numbers of the devices, from 0 in the order of the axes; all by default.

    Returns:
        Drives of the last device's axes beyond the machine's, which have no motor connected; they must advance, too.
    """
    from drive_env.bus.world import without_motors
    from drive_env.ethercat.coe_node import CoeNode

    per_slave, spares = drives.device.num_axes, []
    number = -(-drives.num_axes // per_slave)
    for k in range(number) if devices is None else sorted(devices):
        first, position = k * per_slave, len(world.segment.slaves)
        name = f"slave-{position}-{Path(drives.device.name).stem}.json"
        left_over = max(first + per_slave - drives.num_axes, 0)
        spare = without_motors(drives, left_over) if left_over else None
        spares += [] if spare is None else [spare]
        node = CoeNode(drives, first, spare=spare, store=None if store is None else store / name, serial=position + 1)
        world.add(EtherCatSlave(node, takes_time=not world.lockstep, epoch=position))
    return spares


def _cycle_time(bus: Bus) -> float:
    """Return the communication cycle of all machines [s]; BusConfigError if they differ."""
    try:
        rates = {row.device: find_device(row.device).communication_rate for row in bus.machines}
    except ValueError as error:
        raise BusConfigError(str(error)) from None
    if len(set(rates.values())) > 1:
        told = ", ".join(f"{name} has {1e3 / rate:g} ms" for name, rate in rates.items())
        raise BusConfigError(f"slaves of a segment have one communication cycle, and {told}; serve them apart")
    return 1.0 / next(iter(rates.values()))
