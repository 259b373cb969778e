"""Temporarily changes an object while an axis moves, and restores it afterwards."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from drive_env.drives.arguments import checked_mask
from drive_env.drives.interface import Drives
from drive_env.held_signals import held_signals
from mechanics.arrays import Mask

logger = logging.getLogger(__name__)


@contextmanager
def lent(drives: Drives, index: int, value: int, where: Mask | None = None) -> Iterator[None]:
    """Change an object of axes while a block runs.

    However the block ends, the object is restored; if that fails, a line in the log names the axis and the remedy.

    Args:
        drives: The drives.
        index: The object, sub-index 0.
        value: The integer on the bus.
        where: Axes; all by default.
    """
    before = drives.read(index)
    try:
        drives.write(index, value, where=where)
        yield
    finally:
        with held_signals() as noted:  # a second Ctrl-C does not interrupt this
            try:
                drives.write(index, before, where=where)
            except Exception:
                for axis in np.flatnonzero(checked_mask(where, drives.num_axes)):
                    logger.warning(
                        "axis %d: %04Xh may be %d still, and was %d; drive-env set %04X %d --raw restores it",
                        axis, index, value, before[axis], index, before[axis],
                    )  # fmt: skip
                raise
        if noted:
            raise KeyboardInterrupt
