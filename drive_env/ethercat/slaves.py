"""A world on EtherCAT from the description of a bus: each machine's devices are slaves, one behind the other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from drive_env.bus.config import BusConfigError, build_drives, check_seed, store_folder
from drive_env.devices import find_device
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld

if TYPE_CHECKING:
    from drive_env.bus.config import Bus


def build_ethercat_world(bus: Bus, *, lockstep: bool) -> EtherCatWorld:
    """Return the world of a bus on EtherCAT, its slaves not switched on yet.

    Args:
        bus: What it is made of; bit rate, node numbers and faults of the wire are CAN's, and count for nothing.
        lockstep: Time advances by process data.

    Raises:
        BusConfigError: If it cannot be.
    """
    from drive_env.bus.world import without_motors
    from drive_env.ethercat.coe_node import CoeNode

    check_seed(bus)
    world = EtherCatWorld(lockstep=lockstep, cycle_time=_cycle_time(bus))
    try:
        store = store_folder(bus)
        for k in range(len(bus.machines)):
            drives = build_drives(bus, k)
            per_slave = drives.device.num_axes
            for first in range(0, drives.num_axes, per_slave):
                position = len(world.segment.slaves)
                name = f"slave-{position}-{Path(drives.device.name).stem}.json"
                left_over = max(first + per_slave - drives.num_axes, 0)
                spare = without_motors(drives, left_over) if left_over else None
                device = CoeNode(
                    drives, first, spare=spare, store=None if store is None else store / name, serial=position + 1
                )
                world.add(EtherCatSlave(device, takes_time=not lockstep, epoch=position))
                world.drives += ([drives] if first == 0 else []) + ([] if spare is None else [spare])
    except (ValueError, OSError) as error:
        world.close()
        raise BusConfigError(str(error)) from None
    return world


def _cycle_time(bus: Bus) -> float:
    """Return the communication cycle of all machines [s]; BusConfigError where it is not the same."""
    try:
        rates = {row.device: find_device(row.device).communication_rate for row in bus.machines}
    except ValueError as error:
        raise BusConfigError(str(error)) from None
    if len(set(rates.values())) > 1:
        told = ", ".join(f"{name} has {1e3 / rate:g} ms" for name, rate in rates.items())
        raise BusConfigError(f"slaves of a segment have one communication cycle, and {told}; serve them apart")
    return 1.0 / next(iter(rates.values()))
