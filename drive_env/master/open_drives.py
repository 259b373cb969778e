"""Drives on the fieldbus that a command's options name: the one place where programs choose a link."""

from __future__ import annotations

from typing import Any

from drive_env.master.bus_drives import BusDrives
from drive_env.master.can_drives import CanDrives


def open_drives(device: str = "tmcm1636", **options: Any) -> BusDrives:
    """Open drives on a bus; CAN is the one there is.

    Args:
        device: Name of a known device.
        options: What `CanDrives` takes besides.

    Raises:
        BusError: If the bus cannot be opened, a node does not answer or is another device.
        ValueError: For what cannot be.
    """
    return CanDrives(device, **options)
