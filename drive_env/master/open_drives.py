"""Drives on the fieldbus that a command's options name: the one place where programs choose a link."""

from __future__ import annotations

import os
from typing import Any

from drive_env.default_device import DEFAULT_DEVICE
from drive_env.master.bus_drives import BusDrives

ETHERCAT = ("ethercat", "ethercat-udp")  # interfaces; all others are python-can's
INTERFACE_VARIABLE = "DRIVE_ENV_INTERFACE"


def is_ethercat(interface: str | None) -> bool:
    """Return whether an interface, or the one in DRIVE_ENV_INTERFACE, is EtherCAT's."""
    return (interface or os.environ.get(INTERFACE_VARIABLE)) in ETHERCAT


def default_nodes(interface: str | None) -> tuple[int, ...]:
    """Return the default nodes: node-ID 1 on CAN, the first position on EtherCAT."""
    return (0,) if is_ethercat(interface) else (1,)


def open_drives(device: str = DEFAULT_DEVICE, **options: Any) -> BusDrives:
    """Open drives on CAN or EtherCAT, as `interface` says.

    Args:
        device: Name of a known device.
        options: Further arguments of `CanDrives` or `EtherCatDrives`; without `nodes`, the first node.

    Raises:
        BusError: If the bus cannot be opened, a node does not answer or is another device.
        ValueError: For an impossible argument.
    """
    interface = options.get("interface")
    if options.get("nodes") is None:
        options["nodes"] = default_nodes(interface)
    if is_ethercat(interface):
        from drive_env.master.ethercat_drives import EtherCatDrives

        return EtherCatDrives(device, **options | {"interface": interface or os.environ[INTERFACE_VARIABLE]})
    from drive_env.master.can_drives import CanDrives

    return CanDrives(device, **options)


def check_answers(device: str = DEFAULT_DEVICE, **options: Any) -> None:
    """Raise NoAnswerError for a silent node on CAN, without the NMT command that opening the drives would send.

    Args:
        device: Name of a known device.
        options: As for `open_drives`; used are those for the bus, the nodes and the EDS.
    """
    interface = options.get("interface")
    if is_ethercat(interface):
        return  # opening a segment changes its slaves' states in any case
    from drive_env.master.can_drives import check_nodes_answer

    asked = {key: options.get(key) for key in ("channel", "eds", "timeout", "bitrate")}
    check_nodes_answer(device, interface, options.get("nodes") or default_nodes(interface), **asked)
