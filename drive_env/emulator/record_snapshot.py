"""Values of many fields of drive records, written to some axes at once, as by a reset or a restart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drive_env.emulator.group import channels
from drive_env.firmware import cycle
from drive_env.firmware.record import LANES, RecordLayout
from mechanics.arrays import Floats, Mask

_AT_ONCE = 4096  # axes whose memory addresses are computed together: those of 65,536 would take 100 MB


class RecordSnapshot:
    """Fields with their values.

    Args:
        layout: The records' layout.
        records: The records, contiguous.
        fields: Pairs of field and part.
        values: One row per field, with one value for all axes or one per axis.
    """

    def __init__(
        self, layout: RecordLayout, records: NDArray[np.void], fields: Sequence[tuple[str, int]], values: Floats
    ) -> None:
        memory = records.view(np.uint8).reshape(len(records), layout.dtype.itemsize)
        kinds, offsets = channels(layout, list(fields))
        real = kinds == cycle.REAL
        self._reals, self._integers = memory.view(np.float64), memory.view(np.int32)
        self._real_offsets, self._integer_offsets = offsets[real], offsets[~real]
        self._real_values = np.ascontiguousarray(values[real].T)
        self._integer_values = np.ascontiguousarray(values[~real].T.astype(np.int32))

    def restore(self, where: Mask) -> None:
        """Set the fields of the axes where the mask is true, shape (num_axes,)."""
        every = np.flatnonzero(where)
        for first in range(0, len(every), _AT_ONCE):
            axes = every[first : first + _AT_ONCE]
            blocks, lanes = (axes // LANES)[:, None], (axes % LANES)[:, None]
            for memory, offsets, values in (
                (self._reals, self._real_offsets, self._real_values),
                (self._integers, self._integer_offsets, self._integer_values),
            ):
                memory[blocks, offsets + lanes] = values if len(values) == 1 else values[axes]
