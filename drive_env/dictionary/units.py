"""Drive units to SI and back: the only border between the two.

A unit is a factor, SI per drive unit, that may differ from axis to axis (positions follow 2058h). `to_od` rounds to
the nearest integer and saturates at the range of the entry's type, as a converter in a drive does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
TWO_PI = 2.0 * np.pi


class Context(NamedTuple):
    """What factors depend on, one value per axis or one for all."""

    position_scaler: Floats | float  # [inc/rev], 2058h
    current_lsb: float  # [A] per LSB of the current loop


class Unit(NamedTuple):
    """A row: name, what it is, and SI per drive unit."""

    name: str
    meaning: str
    factor: Callable[[Context], Any]


RPM = TWO_PI / 60.0
PID_SUM_FRACTION = 256.0  # the loops' error sums are read with 8 fractional bits

# Gains (after the TMC4671 data sheet 2.08 with P as Q8.8, I as Q8.8/256 per sample, position P as Q4.12): an error in
# LSB of current, rpm or 1/65536 revolution gives duty, current or rpm in LSB.
UNITS: dict[str, Unit] = {
    unit.name: unit
    for unit in (
        Unit("raw", "as it is", lambda c: 1.0),
        Unit("mA", "milliamperes of peak i_q", lambda c: 1e-3),
        Unit("ms", "milliseconds", lambda c: 1e-3),
        Unit("inc", "increments of position, 2058h per revolution", lambda c: TWO_PI / c.position_scaler),
        Unit("0.1V", "tenths of a volt", lambda c: 0.1),
        Unit("pps", "increments per second", lambda c: TWO_PI / c.position_scaler),
        Unit("pps^2", "increments per second squared", lambda c: TWO_PI / c.position_scaler),
        Unit("rpm", "revolutions per minute", lambda c: RPM),
        Unit("rpm/s", "revolutions per minute, per second", lambda c: RPM),
        Unit("1/1000", "thousandths", lambda c: 1e-3),
        Unit("1/65536 rev", "1/65536 revolution", lambda c: TWO_PI / 65536.0),
        Unit("current P", "Q8.8: duty LSB per current LSB", lambda c: 1.0 / (256.0 * 32768.0 * c.current_lsb)),
        Unit("velocity P", "Q8.8: current LSB per rpm", lambda c: c.current_lsb / (256.0 * RPM)),
        Unit("I", "Q8.8 / 256: share of P e per sample", lambda c: 1.0 / 65536.0),
        Unit("position P", "Q4.12: rpm per 1/65536 revolution", lambda c: RPM / (4096.0 * TWO_PI / 65536.0)),
        Unit("duty sum", "1/256 duty LSB", lambda c: 1.0 / (32768.0 * PID_SUM_FRACTION)),
        Unit("current sum", "1/256 current LSB", lambda c: c.current_lsb / PID_SUM_FRACTION),
        Unit("ADC LSB", "step of the ADC register", lambda c: c.current_lsb),
        Unit("1/65536 turn", "electrical angle, wraps at half a turn", lambda c: TWO_PI / 65536.0),
    )
}
# Units whose factor follows 2058h: what is stored in them is kept in raw integers when the scaler changes.
SCALED_BY_POSITION = frozenset({"inc", "pps", "pps^2", "position window", "position limit"})
# Position counters go on past the end of their type, as a counter in a drive does; everything else saturates.
WRAPPING = frozenset({(0x6062, 0), (0x6063, 0), (0x6064, 0)})

NO_WINDOW = 0xFFFFFFFF  # 6067h: window control switched off


def from_od(unit: str, raw: NDArray[Any], context: Context) -> Floats:
    """Return SI values of integers on the wire; axes are the last dimension."""
    si: Floats = np.asarray(raw, np.float64) * UNITS[unit].factor(context)
    return si


def to_od(unit: str, value: NDArray[Any], context: Context, low: int, high: int) -> NDArray[np.int64]:
    """Return integers on the wire of SI values: rounded, saturated at low and high; nan gives 0."""
    raw = np.rint(np.asarray(value, np.float64) / UNITS[unit].factor(context))
    if unit == "1/65536 turn":
        raw = np.mod(raw + 32768.0, 65536.0) - 32768.0
    limited: Floats = np.nan_to_num(np.clip(raw, low, high))
    return limited.astype(np.int64)


def wrap(value: NDArray[Any], bits: int = 32) -> Floats:
    """Return increments [float] wrapped into the range of a signed counter."""
    half = 2.0 ** (bits - 1)
    return np.mod(np.asarray(value, np.float64) + half, 2.0 * half) - half


def limit_from_od(raw: NDArray[Any], context: Context) -> Floats:
    """Return a software limit [rad]; the ends of the type, which are the factory's, are no limits: infinite."""
    limit = from_od("inc", raw, context)
    limit = np.where(np.asarray(raw) >= 2**31 - 1, np.inf, limit)
    return np.where(np.asarray(raw) <= -(2**31), -np.inf, limit)


def limit_to_od(limit: NDArray[Any], context: Context) -> NDArray[np.int64]:
    """Return 607Dh of a software limit [rad]; infinite is the end of the type."""
    finite = np.where(np.isinf(limit), 0.0, limit)
    raw = to_od("inc", finite, context, -(2**31), 2**31 - 1)
    return np.where(np.isinf(limit), np.where(np.asarray(limit) > 0.0, 2**31 - 1, -(2**31)), raw)


def window_from_od(raw: NDArray[Any], context: Context) -> Floats:
    """Return a position window [rad]; FFFFFFFFh is inf, which switches the control off."""
    window = from_od("inc", raw, context)
    return np.where(np.asarray(raw) == NO_WINDOW, np.inf, window)


def window_to_od(window: NDArray[Any], context: Context) -> NDArray[np.int64]:
    """Return 6067h of a position window [rad]; inf is FFFFFFFFh."""
    raw = to_od("inc", np.where(np.isinf(window), 0.0, window), context, 0, NO_WINDOW - 1)
    return np.where(np.isinf(window), NO_WINDOW, raw)


# --- the same for one value, in plain floats: a fieldbus node converts a few values a thousand times a second ---------
def factor_of_one(unit: str, context: Context) -> float:
    """Return SI per drive unit of one axis, whose context holds plain floats; a scale of 0 gives inf, as above."""
    try:
        return float(UNITS["inc" if unit in ("position window", "position limit") else unit].factor(context))
    except ZeroDivisionError:
        return math.inf


def one_from_od(unit: str, raw: int, factor: float) -> float:
    """Return the SI value of one integer on the wire."""
    if unit == "position window" and raw == NO_WINDOW:
        return math.inf
    if unit == "position limit" and raw in (2**31 - 1, -(2**31)):
        return math.inf if raw > 0 else -math.inf
    return raw * factor


def one_to_od(unit: str, value: float, factor: float, low: int, high: int) -> int:
    """Return the integer on the wire of one SI value: rounded, saturated at low and high; nan gives 0."""
    if unit == "position window":
        if math.isinf(value):
            return NO_WINDOW
        high = NO_WINDOW - 1
    elif unit == "position limit" and math.isinf(value):
        return 2**31 - 1 if value > 0.0 else -(2**31)
    quotient = value / factor
    if quotient != quotient:
        return 0
    if math.isinf(quotient):
        return 0 if unit == "1/65536 turn" else high if quotient > 0.0 else low
    raw = round(quotient)
    if unit == "1/65536 turn":
        raw = (raw + 32768) % 65536 - 32768
    return low if raw < low else high if raw > high else raw


def one_wrapped(value: float, factor: float) -> int:
    """Return the increments of one SI value, wrapped as a counter of 32 bits; what is no number gives 0."""
    quotient = value / factor
    return (round(quotient) + 2**31) % 2**32 - 2**31 if math.isfinite(quotient) else 0
