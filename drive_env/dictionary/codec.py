"""Integers on the bus to SI and back: one row for each object that is a field of the drive record.

All conversions read the same row: arrays of all axes (`decode`, `encode`), a fieldbus node that converts a few values
of one axis a thousand times a second (`decode_one`, `encode_one`), and compiled code (emulator/prepared_record).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.units import Context, find_unit
from mechanics.arrays import Floats, Integers


class Code(NamedTuple):
    """The conversion between an object's integers and a field's SI values.

    Attributes:
        field, part: The field of the record, and the element of a deep one.
        unit: Name of a unit (`find_unit`), whose factor is SI per integer.
        event: What a write triggers in the firmware, as in the binding. low, high: Least and greatest integer; others
            saturate, except those of `specials`.
        period: Number of integers of a counter that wraps at the end of its type; 0 for one that saturates.
        specials: Integers with an SI value that does not follow from the factor, and that value.
        follows_scale: Whether the factor follows the scale of positions.
    """

    field: str
    part: int
    unit: str
    event: str
    low: int
    high: int
    period: float
    specials: tuple[tuple[int, float], ...]
    follows_scale: bool

    def factor(self, context: Context) -> Any:
        """Return SI per integer, for one axis or all; a scale of 0 gives infinity."""
        try:
            return find_unit(self.unit).factor(context)
        except ZeroDivisionError:
            return math.inf

    @property
    def least(self) -> int:
        """Least integer that is converted by the factor."""
        return self.low + any(raw == self.low for raw, _ in self.specials) if self.specials else self.low

    @property
    def greatest(self) -> int:
        """Greatest integer that is converted by the factor."""
        return self.high - any(raw == self.high for raw, _ in self.specials) if self.specials else self.high


def code_of(entry: Entry, binding: Binding) -> Code:
    """Return the conversion row of a bound object."""
    assert entry.low is not None and entry.high is not None, "only numbers are bound"
    unit = find_unit(binding.unit)
    return Code(binding.field, binding.part, binding.unit, binding.event, entry.low, entry.high, unit.period,
                unit.specials, unit.follows_scale)  # fmt: skip


def decode(code: Code, raw: NDArray[Any], factor: Any) -> Floats:
    """Return SI values of integers; axes are the last dimension."""
    si: Floats = np.asarray(raw, np.float64) * factor
    for integer, value in code.specials:
        si = np.where(np.asarray(raw) == integer, value, si)
    return si


def encode(code: Code, value: NDArray[Any], factor: Any) -> Integers:
    """Return integers of SI values: rounded, saturated or wrapped; nan gives 0."""
    si = np.asarray(value, np.float64)
    raw = np.rint(si / factor)
    if code.period:
        raw = np.where(np.isfinite(raw), raw, 0.0)
        raw = np.mod(raw + 0.5 * code.period, code.period) - 0.5 * code.period
    raw = np.nan_to_num(np.clip(raw, code.least, code.greatest))
    for integer, special in code.specials:
        raw = np.where(si == special, integer, raw)
    return np.asarray(raw, np.int64)


def decode_one(code: Code, raw: int, factor: float) -> float:
    """Return the SI value of one integer."""
    for integer, special in code.specials:
        if raw == integer:
            return special
    return raw * factor


def encode_one(code: Code, value: float, factor: float) -> int:
    """Return the integer of one SI value, as `encode` does."""
    for integer, special in code.specials:
        if value == special:
            return integer
    quotient = value / factor
    if quotient != quotient:
        return 0
    if math.isinf(quotient):
        return 0 if code.period else code.greatest if quotient > 0.0 else code.least
    raw = round(quotient)
    if code.period:
        raw = (raw + int(code.period) // 2) % int(code.period) - int(code.period) // 2
    least, greatest = code.least, code.greatest
    return least if raw < least else greatest if raw > greatest else raw


# Columns of a row in compiled code.
LOW, HIGH, PERIOD, SPECIAL_RAW, SPECIAL_SI = 0, 1, 2, 3, 5
SPECIALS = 2  # at most, of a unit


def compiled_rows(codes: Sequence[Code], *, decoded: bool) -> Floats:
    """Return rows as numbers, shape (n, 7): limits, period, special integers and their values; nan for a missing one.

    The limits are those for decoding, or for encoding by the factor.
    """
    rows = np.full((len(codes), SPECIAL_SI + SPECIALS), math.nan)
    for row, code in zip(rows, codes, strict=True):
        row[LOW], row[HIGH] = (code.low, code.high) if decoded else (code.least, code.greatest)
        row[PERIOD] = code.period
        for k, (integer, value) in enumerate(code.specials):
            row[SPECIAL_RAW + k], row[SPECIAL_SI + k] = integer, value
    return rows
