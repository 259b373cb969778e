"""A call of `record` that repeats, prepared: what it plays and samples, with factors and limits, for compiled code.

An outer controller makes the same call a thousand times a second; looking names up and converting object by object
takes longer then than the drives' own millisecond.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import Entry, ObjectName
from drive_env.emulator.group import Channels
from mechanics.compiled import cached, stage

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Units whose conversion is more than a factor; their objects take the long way.
SPECIAL_UNITS = frozenset({"position window", "position limit", "1/65536 turn"})
# Fields that factors depend on: played, they would change between two rows.
SCALES = frozenset({"position_scaler"})


class Row(NamedTuple):
    """An object that is played or sampled: its factor of each axis [SI per drive unit], shape (num_axes,)."""

    entry: Entry
    binding: Binding
    factor: Floats
    wraps: bool
    low: int
    high: int


class ProcessImage:
    """What one call plays and samples.

    Args:
        played: Fields that rows go to, and their rows.
        sampled: Fields that are sampled, and their rows.
        scale_changes: Of the dictionary, when the factors were taken; they hold until it changes.
    """

    def __init__(
        self, played: tuple[Channels, list[Row]], sampled: tuple[Channels, list[Row]], scale_changes: int
    ) -> None:
        self.played, self.inputs = played
        self.sampled, outputs = sampled
        self.scale_changes = scale_changes
        self.keys = [(row.entry.index, row.entry.sub) for row in outputs]
        self.factors = np.array([row.factor for row in outputs], float).reshape(len(outputs), -1 if outputs else 0)
        limits = [(row.low, row.high) for row in outputs]
        self.limits = np.array(limits, float).reshape(len(outputs), 2)
        self.wraps = np.array([row.wraps for row in outputs], bool)

    def play(self, play: Mapping[ObjectName, ArrayLike], values: Floats) -> bool:
        """Fill in the SI values, shape (cycles, objects, num_axes); False for rows that the long way must refuse."""
        cycles, _, num_axes = values.shape
        for k, (row, given) in enumerate(zip(self.inputs, play.values(), strict=True)):
            raw = np.asarray(given)
            if raw.dtype != np.int64:
                if raw.dtype.kind not in "iu" or raw.dtype == np.uint64:
                    return False
                raw = raw.astype(np.int64)
            if raw.shape != (cycles, num_axes):
                if raw.shape != (cycles,):
                    return False
                raw = raw[:, None]
            if not from_od(np.ascontiguousarray(raw), row.factor, row.low, row.high, values, k):
                return False
        return True

    def read(self, samples: Floats) -> dict[tuple[int, int], Integers]:
        """Return the integers on the wire of SI samples, shape (rows, objects, num_axes)."""
        raw = np.empty((samples.shape[1], samples.shape[0], samples.shape[2]), np.int64)
        to_od(samples, self.factors, self.limits, self.wraps, raw)
        return dict(zip(self.keys, raw, strict=True))


@stage
def from_od_rows(raw: Any, factor: Any, low: Any, high: Any, values: Any, k: Any, first: Any, end: Any) -> Any:
    """Set SI values of object k, axes `first` up to `end`, as units.from_od does; False if an integer is out of range.

    `raw` has one column for each axis, or one for all.
    """
    for row in range(values.shape[0]):
        for axis in range(first, end):
            integer = raw[row, 0 if raw.shape[1] == 1 else axis]
            if integer < low or integer > high:
                return False
            values[row, k, axis] = integer * factor[axis]
    return True


@stage
def to_od_rows(samples: Any, factors: Any, limits: Any, wraps: Any, raw: Any, first: Any, end: Any) -> None:
    """Set integers of SI samples as units.to_od and, for counters of 32 bits that go on, units.wrap do."""
    half = 2.0**31
    for k in range(samples.shape[1]):
        low, high = limits[k, 0], limits[k, 1]
        for row in range(samples.shape[0]):
            for axis in range(first, end):
                value = np.rint(samples[row, k, axis] / factors[k, axis])
                if wraps[k]:
                    value = value - 2.0 * half * np.floor((value + half) / (2.0 * half)) if np.isfinite(value) else 0.0
                else:
                    value = low if value < low else high if value > high else value
                raw[k, row, axis] = 0 if np.isnan(value) else np.int64(value)


@cached()
def from_od(raw: Any, factor: Any, low: int, high: int, values: Any, k: int) -> Any:
    """Set SI values of object k; return False if an integer is out of range."""
    return from_od_rows(raw, factor, low, high, values, k, 0, values.shape[2])


@cached()
def to_od(samples: Any, factors: Any, limits: Any, wraps: Any, raw: Any) -> None:
    """Set integers of SI samples."""
    to_od_rows(samples, factors, limits, wraps, raw, 0, samples.shape[2])
