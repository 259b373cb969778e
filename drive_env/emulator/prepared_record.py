"""Prepared form of a repeated call of `record` for compiled code: its objects with factors and limits.

An outer controller makes the same call a thousand times a second; looking up names and converting object by object
would take longer than emulating the millisecond.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.codec import HIGH, LOW, PERIOD, SPECIAL_RAW, SPECIAL_SI, SPECIALS, Code, compiled_rows
from drive_env.dictionary.entries import ObjectName
from drive_env.emulator.group import Channels
from mechanics.arrays import Floats, Integers
from mechanics.kernels.compiled import cached, stage

# Fields that factors depend on: if played, they would change between two rows.
SCALE_FIELD = "position_scaler"  # increments per revolution
RATIO_FIELD = "velocity_ratio"  # rpm of a velocity unit, if the drive has one
SET_POINT_FIELD = "set_point_ratio"  # velocity units of a target velocity of vl, if the drive has them
PEAK_FIELD = "peak_current"  # of the motor [A], if torques are relative to it
NOMINAL_FIELD = "nominal_motor_current"  # [A]; likewise, for thousandths
PROFILE_FIELD = "profile_bits"  # for drives whose profile generator has its own increments
SCALES = frozenset({SCALE_FIELD, RATIO_FIELD, SET_POINT_FIELD, PEAK_FIELD, NOMINAL_FIELD, PROFILE_FIELD})


class PreparedObject(NamedTuple):
    """A played or sampled object with its factor for each axis [SI per drive unit], shape (num_axes,)."""

    key: tuple[int, int]
    code: Code
    factor: Floats


class PreparedRecord:
    """The objects that one call plays and samples.

    Args:
        played: Played fields, and their conversions.
        sampled: Sampled fields, and their conversions.
        scale_changes: The dictionary's count when the factors were read; they are valid until it changes.
    """

    def __init__(
        self,
        played: tuple[Channels, list[PreparedObject]],
        sampled: tuple[Channels, list[PreparedObject]],
        scale_changes: int,
    ) -> None:
        self.played, self.inputs = played
        self.sampled, outputs = sampled
        self.scale_changes = scale_changes
        self.keys = [row.key for row in outputs]
        self.factors = np.array([row.factor for row in outputs], float).reshape(len(outputs), -1 if outputs else 0)
        self.codes = compiled_rows([row.code for row in outputs], decoded=False)
        self.input_codes = compiled_rows([row.code for row in self.inputs], decoded=True)

    def play(self, play: Mapping[ObjectName, ArrayLike], values: Floats) -> bool:
        """Fill in the SI values, shape (cycles, objects, num_axes); False for rows that the normal call must refuse."""
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
            if not from_od(np.ascontiguousarray(raw), row.factor, self.input_codes[k], values, k):
                return False
        return True

    def read(self, samples: Floats) -> dict[tuple[int, int], Integers]:
        """Return the integers on the bus of SI samples, shape (rows, objects, num_axes)."""
        raw = np.empty((samples.shape[1], samples.shape[0], samples.shape[2]), np.int64)
        to_od(samples, self.factors, self.codes, raw)
        return dict(zip(self.keys, raw, strict=True))


@stage
def from_od_rows(raw: Any, factor: Any, code: Any, values: Any, k: Any, first: Any, end: Any) -> Any:
    """Set SI values of object k, axes `first` up to `end`, as codec.decode does; False if an integer is out of range.

    `raw` has one column for each axis, or one for all; `code` is a row of `compiled_rows`.
    """
    for row in range(values.shape[0]):
        for axis in range(first, end):
            integer = raw[row, 0 if raw.shape[1] == 1 else axis]
            if integer < code[LOW] or integer > code[HIGH]:
                return False
            value = integer * factor[axis]
            for special in range(SPECIALS):
                if integer == code[SPECIAL_RAW + special]:
                    value = code[SPECIAL_SI + special]
            values[row, k, axis] = value
    return True


@stage
def to_od_rows(samples: Any, factors: Any, codes: Any, raw: Any, first: Any, end: Any) -> None:
    """Set integers of SI samples as codec.encode does."""
    for k in range(samples.shape[1]):
        low, high, period = codes[k, LOW], codes[k, HIGH], codes[k, PERIOD]
        for row in range(samples.shape[0]):
            for axis in range(first, end):
                si = samples[row, k, axis]
                value = np.rint(si / factors[k, axis])
                if period != 0.0:
                    half = 0.5 * period
                    value = value - period * np.floor((value + half) / period) if np.isfinite(value) else 0.0
                value = low if value < low else high if value > high else value
                for special in range(SPECIALS):
                    if si == codes[k, SPECIAL_SI + special]:
                        value = codes[k, SPECIAL_RAW + special]
                raw[k, row, axis] = 0 if np.isnan(value) else np.int64(value)


@cached()
def from_od(raw: Any, factor: Any, code: Any, values: Any, k: int) -> Any:
    """Set SI values of object k; return False if an integer is out of range."""
    return from_od_rows(raw, factor, code, values, k, 0, values.shape[2])


@cached()
def to_od(samples: Any, factors: Any, codes: Any, raw: Any) -> None:
    """Set integers of SI samples."""
    to_od_rows(samples, factors, codes, raw, 0, samples.shape[2])
