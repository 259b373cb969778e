"""Drive units to SI and back: the only border between the two.

A unit is a factor, SI per drive unit, which may differ from axis to axis (positions follow their scale), and further
properties. `codec.py` converts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from mechanics.reading.near_names import did_you_mean

TWO_PI = 2.0 * np.pi
MILLIAMPERE = 1e-3  # [A]


class Context(NamedTuple):
    """The values on which factors depend, one per axis or one for all."""

    position_scaler: Any  # [inc/rev]
    current_lsb: float  # [A] per LSB of the current loop
    rated_current: float = math.nan  # [A] of peak i_q, to which CiA 402's thousandths refer
    velocity_ratio: Any = 1.0  # rpm of a velocity unit (6094h, or 604Ch)
    set_point_ratio: Any = 1.0  # velocity units of a target velocity of vl (604Bh)
    peak_current: Any = math.nan  # of the motor [A], to which torques refer
    nominal_motor_current: Any = math.nan  # of the motor [A], to whose thousandths torques refer on some drives
    profile_bits: Any = 16.0  # increments of a profile generator per revolution, as a power of two


class Unit(NamedTuple):
    """A row: name, quantity, and SI per drive unit.

    Attributes:
        period: Number of integers of a counter that wraps at the end of its type; 0 for one that saturates.
        specials: Integers with an SI value that does not follow from the factor, and that value.
        follows_scale: Whether the factor follows a scale of positions, velocities or torques: stored values keep their
            raw integers when that scale changes.
    """

    name: str
    meaning: str
    factor: Callable[[Context], Any]
    period: float = 0.0
    specials: tuple[tuple[int, float], ...] = ()
    follows_scale: bool = False


def _angle(context: Context) -> Any:
    return TWO_PI / context.position_scaler


def _profile_angle(context: Context) -> Any:
    return TWO_PI / 2.0**context.profile_bits


RPM = TWO_PI / 60.0
PID_SUM_FRACTION = 256.0  # the loops' error sums are read with 8 fractional bits

# Gains (after the TMC4671 data sheet 2.08 with P as Q8.8, I as Q8.8/256 per sample, position P as Q4.12): an error in
# LSB of current, rpm or 1/65536 revolution gives duty, current or rpm in LSB.
UNITS: dict[str, Unit] = {
    unit.name: unit
    for unit in (
        Unit("raw", "as it is", lambda c: 1.0),
        Unit("mA", "milliamperes of peak i_q", lambda c: 1e-3),
        Unit("s", "seconds", lambda c: 1.0),
        Unit("ms", "milliseconds", lambda c: 1e-3),
        Unit("10ms", "hundredths of a second", lambda c: 1e-2),
        Unit("512 clocks", "512 clocks of a ramp generator at 16 MHz", lambda c: 512.0 / 16e6),
        Unit("inc", "increments of position, as many a revolution as the scale has", _angle, follows_scale=True),
        Unit(
            "counter",
            "increments of a position that is counted on past the end of its type",
            _angle,
            period=2.0**32,
            follows_scale=True,
        ),
        Unit(
            "position window",
            "increments; the greatest integer switches the window off",
            _angle,
            specials=((0xFFFFFFFF, math.inf),),
            follows_scale=True,
        ),
        Unit(
            "position limit",
            "increments; the ends of the type, which are the factory's, are no limits",
            _angle,
            specials=((2**31 - 1, math.inf), (-(2**31), -math.inf)),
            follows_scale=True,
        ),
        Unit("1/1000 rated", "thousandths of the rated current or torque", lambda c: 1e-3 * c.rated_current),
        Unit("0.1V", "tenths of a volt", lambda c: 0.1),
        Unit("mV", "millivolts", lambda c: 1e-3),
        Unit("pps", "increments per second", _angle, follows_scale=True),
        Unit("pps^2", "increments per second squared", _angle, follows_scale=True),
        Unit("pps^3", "increments per second cubed", _angle, follows_scale=True),
        Unit("rpm", "revolutions per minute", lambda c: RPM),
        Unit("rpm/s", "revolutions per minute, per second", lambda c: RPM),
        Unit(
            "velocity unit",
            "rpm times numerator over divisor of the velocity encoder resolution",
            lambda c: RPM * c.velocity_ratio,
            follows_scale=True,
        ),
        Unit("velocity unit/s", "velocity units per second", lambda c: RPM * c.velocity_ratio, follows_scale=True),
        Unit(
            "set-point unit",
            "velocity units times numerator over denominator of the set-point factor",
            lambda c: RPM * c.velocity_ratio * c.set_point_ratio,
            follows_scale=True,
        ),
        Unit("pginc/s", "increments of the profile generator per second", _profile_angle, follows_scale=True),
        Unit("pginc/s^2", "increments of the profile generator per second squared", _profile_angle, follows_scale=True),
        Unit(
            "1/32767 M-Ipeak",
            "parts of the motor's peak current, of which 32767 are the whole",
            lambda c: c.peak_current / 32767.0,
            follows_scale=True,
        ),
        Unit(
            "1/1000 of M-Inull",
            "thousandths of the motor's nominal current, as a current",
            lambda c: 1e-3 * c.nominal_motor_current,
            follows_scale=True,
        ),
        Unit("1/2^32 rev", "increments of the position inside, 2^32 a revolution", lambda c: TWO_PI / 2.0**32),
        Unit("1/1000 M-Inull", "thousandths of the motor's nominal current", lambda c: 1e-3),
        Unit("rev", "revolutions", lambda c: TWO_PI),
        Unit("1/1000", "thousandths", lambda c: 1e-3),
        Unit("V", "volts", lambda c: 1.0),
        Unit("100us", "tenths of a millisecond", lambda c: 1e-4),
        Unit("us", "microseconds", lambda c: 1e-6),
        Unit("percent", "hundredths", lambda c: 1e-2),
        Unit("mV/A", "millivolts per ampere, where 32 V are the whole link", lambda c: 1e-3 / 32.0),
        Unit("mA/1000rpm", "milliamperes per 1000 rpm", lambda c: 1e-6 / RPM),
        Unit("1/65536 rev", "1/65536 revolution", lambda c: TWO_PI / 65536.0),
        Unit("current P", "Q8.8: duty LSB per current LSB", lambda c: 1.0 / (256.0 * 32768.0 * c.current_lsb)),
        Unit("velocity P", "Q8.8: current LSB per rpm", lambda c: c.current_lsb / (256.0 * RPM)),
        Unit("I", "Q8.8 / 256: share of P e per sample", lambda c: 1.0 / 65536.0),
        Unit("position P", "Q4.12: rpm per 1/65536 revolution", lambda c: RPM / (4096.0 * TWO_PI / 65536.0)),
        Unit("duty sum", "1/256 duty LSB", lambda c: 1.0 / (32768.0 * PID_SUM_FRACTION)),
        Unit("current sum", "1/256 current LSB", lambda c: c.current_lsb / PID_SUM_FRACTION),
        Unit("ADC LSB", "step of the ADC register", lambda c: c.current_lsb),
        Unit("1/65536 turn", "electrical angle, wraps at half a turn", lambda c: TWO_PI / 65536.0, period=65536.0),
    )
}


def split_unit(name: str) -> tuple[float, str]:
    """Split a unit into a factor and a base: "0.1 rpm" into 0.1 and "rpm", a plain unit into 1 and itself."""
    number, _, base = name.partition(" ")
    if name in UNITS or base not in UNITS:
        return 1.0, name
    try:
        return float(number), base
    except ValueError:
        return 1.0, name


@cache
def find_unit(name: str) -> Unit:
    """Return a unit by its name, or a multiple of one: "0.1 rpm", "10 pps^2".

    Raises:
        ValueError: For an unknown unit, with a similar name.
    """
    if name in UNITS:
        return UNITS[name]
    number, base = split_unit(name)
    if base not in UNITS or not 0.0 < number < math.inf or UNITS[base].specials or UNITS[base].period:
        raise ValueError(f"there is no unit {name!r}{did_you_mean(base, UNITS)}")
    row = UNITS[base]
    return Unit(
        name, f"{number:g} times: {row.meaning}", lambda c: number * row.factor(c), follows_scale=row.follows_scale
    )
