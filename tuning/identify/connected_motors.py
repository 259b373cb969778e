"""Detects axes of a module without a motor: a module may have more axes than motors, and a bus cannot read which."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from drive_env import cia402, motion
from drive_env.drives.interface import Drives, device_of
from mechanics.arrays import Mask

OPEN_LOAD = "open_load"  # first part of the names of emergencies for a phase without current
HELD = 0.2  # s at rest with current: a driver reports an open phase within a quarter of it


def check_motors(drives: Drives) -> None:
    """Raise RuntimeError, with their numbers, if axes of a module have no motor; all axes are then disabled again.

    A stepper's phases carry current as soon as the axis is enabled, and a driver without current reports an open load
    (1000h). Nothing moves: an axis in pp stands while its new set-point bit is low. If all axes have motors they stay
    enabled. Drives in this process are not checked: each of their axes has a motor.
    """
    bus = drives.bus
    if bus is None or drives.num_axes == 1 or not any(n.startswith(OPEN_LOAD) for n in device_of(drives).emergencies):
        return
    off = ~np.array([cia402.is_live(int(word)) for word in drives.read(cia402.STATUSWORD)])
    modes = drives.read(cia402.MODE)
    drives.emergencies()
    with suppress(RuntimeError, TimeoutError):  # without a motor it may go into fault before the last is enabled
        motion.enable(drives, mode="pp", where=off)
    drives.advance(HELD)
    without = np.zeros(drives.num_axes, bool)
    for message in drives.emergencies():
        without[message.axis] |= message.code != 0 and message.name.startswith(OPEN_LOAD)
    without &= off
    if not without.any():
        return
    motion.disable(drives, where=off & ~without)
    motion.reset_fault(drives, where=without)
    drives.write(cia402.MODE, modes, where=off & (modes != drives.read(cia402.MODE)))
    _name(drives, without)


def _name(drives: Drives, without: Mask) -> None:
    count = drives.bus.description.num_axes if drives.bus is not None else drives.num_axes
    numbers = [drives.axis_numbers[int(k)] for k in np.flatnonzero(without)]
    others = {drives.axis_numbers[int(k)] % count for k in np.flatnonzero(~without)} - {k % count for k in numbers}
    raise RuntimeError(
        f"{'axes' if len(numbers) > 1 else 'axis'} {', '.join(map(str, numbers))}: a phase carries no current (1000h, "
        "open load), so no motor is connected there, or its cable is broken; look at the cable, or tune the other axes "
        f"alone ({' '.join(f'--axis {k}' for k in sorted(others)) or 'there are none'})"
    )
