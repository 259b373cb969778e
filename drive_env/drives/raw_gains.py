"""The raw gains that drives have, in the order of their device's gain set."""

from __future__ import annotations

from drive_env.drives.interface import Drives, device_of
from mechanics.arrays import Integers, Mask


def write_gains(drives: Drives, gains: Integers, where: Mask | None = None) -> None:
    """Write raw gains of shape (num_axes, gains), in the order of the device's gain set."""
    device_of(drives).gains.write(drives, gains, where)


def read_gains(drives: Drives) -> Integers:
    """Return the raw gains that drives have, shape (num_axes, gains)."""
    return device_of(drives).gains.read(drives)
