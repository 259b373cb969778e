"""The drive record: all variables of a drive, eight drives side by side, SI units throughout.

A field is an array of 8 lanes, so that a stage is one loop over lanes that the compiler turns into vector
instructions. Parameters come from the object dictionary through `dictionary/units.py`, from the motor's row and from
the device's data; nothing in the firmware knows an object index.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

LANES = 8
EMERGENCY_QUEUE = 8
MAX_SUBSTEPS = 8


class Field(NamedTuple):
    """One field of the record: `kind` is "f8" or "i4"; `depth` above 1 gives (depth, 8) values.

    Fields that a vectorised lane loop reads are "f8" even for whole numbers: LLVM cannot separate stores of one width
    from loads of another in the same record, and would leave the loop scalar.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    initial: float = 0.0
    depth: int = 1


CACHE_LINE = 64


class RecordLayout:
    """The fields of a device's drive records, and their memory layout.

    Doubles first and the whole padded to cache lines: a field of doubles is then one aligned 64-byte line.

    Attributes:
        parameters: Fields set by the dictionary, the device and the machine.
        state: Fields that change while the drive runs.
        fields: Both.
        dtype: Type of one record of 8 lanes.
    """

    def __init__(self, parameters: Sequence[Field], state: Sequence[Field]) -> None:
        self.parameters, self.state = tuple(parameters), tuple(state)
        self.fields = self.parameters + self.state
        ordered = sorted(self.fields, key=lambda field: field.kind != "f8")
        packed = np.dtype([(f.name, f.kind, (LANES,) if f.depth == 1 else (f.depth, LANES)) for f in ordered])
        padding = -packed.itemsize % CACHE_LINE
        pad = [("padding", "u1", (padding,))] if padding else []
        self.dtype = np.dtype([*((name, packed[name]) for name in packed.names or ()), *pad])

    def new_records(self, num_axes: int) -> NDArray[np.void]:
        """Return records for `num_axes` axes, shape (ceil(num_axes / 8),), every field at its initial value.

        Lanes after the last axis are computed, since a vector instruction computes all eight, but ignored.
        """
        num_blocks = -(-num_axes // LANES)
        size = self.dtype.itemsize
        buffer = np.zeros(num_blocks * size + CACHE_LINE, np.uint8)
        start = -buffer.ctypes.data % CACHE_LINE
        memory = buffer[start : start + num_blocks * size]
        # One record is filled field by field, the others are its copies: many times faster for thousands.
        first = np.zeros(1, self.dtype)
        for field in self.fields:
            first[field.name] = field.initial
        memory.reshape(num_blocks, size)[:] = first.view(np.uint8)
        records = memory.view(self.dtype)
        set_lanes(records, "live", np.ones(num_axes, np.int32))
        return records

    def has(self, name: str) -> bool:
        """Return whether the records have a field of that name."""
        return name in (self.dtype.names or ())

    def place(self, name: str, part: int = 0) -> tuple[bool, int]:
        """Return whether a field is real, and the index of its lane 0 among the record's numbers of that type."""
        dtype, start = self.dtype.fields[name][:2]  # type: ignore[index]
        return dtype.base.kind == "f", start // dtype.base.itemsize + part * LANES


def get_lanes(records: NDArray[np.void], name: str, num_axes: int, part: int = 0) -> NDArray[np.generic]:
    """Return a field of the first `num_axes` axes as a copy, shape (num_axes,); `part` chooses in a deep field."""
    field = records[name]
    block = field[:, part, :] if field.ndim == 3 else field
    return block.reshape(-1)[:num_axes].copy()


def set_lanes(
    records: NDArray[np.void], name: str, values: ArrayLike, where: NDArray[np.bool_] | None = None, part: int = 0
) -> None:
    """Set a field of the axes from 0 on that `values`, shape (n,), covers; only those where the mask is true."""
    chosen = np.asarray(values).reshape(-1)
    field = records[name]
    block = field[:, part, :] if field.ndim == 3 else field
    if where is None or np.all(where):
        whole, rest = divmod(len(chosen), LANES)
        block[:whole] = chosen[: whole * LANES].reshape(whole, LANES)
        if rest:
            block[whole, :rest] = chosen[whole * LANES :]
        return
    axes = np.flatnonzero(where)
    block[axes // LANES, axes % LANES] = chosen[axes]
