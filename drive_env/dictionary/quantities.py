"""Quantities as people write them (`1000 rpm`, `7 A`, `0.5 rev`), and the drive's integers for them.

The EDS names the unit of each object (`Entry.unit`). Most drives count positions and speeds in increments of a
revolution; some have a unit of velocity of their own (6094h), or give torques relative to the motor's peak current.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.dictionary.axis_objects import AxisObjects
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.dictionary.position_scale import position_scale, set_point_ratio, velocity_ratio
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import MILLIAMPERE, split_unit
from mechanics.arrays import Floats, Integers, Mask


class EnteredUnit(NamedTuple):
    """A unit: its dimension, and its size in the dimension's own unit (rev, rev/s, rev/s^2, A, V, s)."""

    dimension: str
    factor: float


class AxisScale(NamedTuple):
    """The scales of an axis' units, each None if it is not known.

    These are position increments of a revolution, rpm of a velocity unit, the motor's peak and nominal current [A], and
    velocity units of a target of vl.
    """

    increments: float | None = None
    rpm: float | None = None
    peak_current: float | None = None
    nominal_current: float | None = None
    set_point: float | None = None


# The scales that the units of an axis follow: for most drives only the increments per revolution. None: unknown.
Scale = AxisScale | float | None

UNITS = {
    "rev": EnteredUnit("angle", 1.0),
    "deg": EnteredUnit("angle", 1.0 / 360.0),
    "rad": EnteredUnit("angle", 0.5 / math.pi),
    "1/65536 rev": EnteredUnit("angle", 1.0 / 65536.0),
    "1/2^32 rev": EnteredUnit("angle", 2.0**-32),
    "rev/s": EnteredUnit("speed", 1.0),
    "rpm": EnteredUnit("speed", 1.0 / 60.0),
    "rad/s": EnteredUnit("speed", 0.5 / math.pi),
    "deg/s": EnteredUnit("speed", 1.0 / 360.0),
    "rev/s^2": EnteredUnit("acceleration", 1.0),
    "rpm/s": EnteredUnit("acceleration", 1.0 / 60.0),
    "rad/s^2": EnteredUnit("acceleration", 0.5 / math.pi),
    "A": EnteredUnit("current", 1.0),
    "mA": EnteredUnit("current", 1e-3),
    "V": EnteredUnit("voltage", 1.0),
    "0.1V": EnteredUnit("voltage", 0.1),
    "s": EnteredUnit("time", 1.0),
    "ms": EnteredUnit("time", 1e-3),
    "10ms": EnteredUnit("time", 1e-2),
    "512 clocks": EnteredUnit("time", 512.0 / 16e6),
    "100us": EnteredUnit("time", 1e-4),
    "us": EnteredUnit("time", 1e-6),
}
# Units that follow increments per revolution, rpm of a velocity unit, or a current of the motor.
_INCREMENTAL = {"inc": "angle", "pps": "speed", "pps^2": "acceleration"}
_BY_RATIO = {"velocity unit": "rpm", "velocity unit/s": "rpm/s", "set-point unit": "rpm"}
# Field of the scale that a current is relative to, and its fraction.
_OF_CURRENT = {
    "1/32767 M-Ipeak": ("peak_current", 1.0 / 32767.0),
    **dict.fromkeys(("1/1000 of M-Inull", "1/1000 M-Inull"), ("nominal_current", 1e-3)),
}
SHOWN = {"angle": "rev", "speed": "rpm", "acceleration": "rev/s^2", "current": "A", "voltage": "V", "time": "s"}
CHARACTERS = "chars"  # four of a text, the first one in the lowest byte
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*$")


def find_unit(name: str, scale: Scale) -> EnteredUnit | None:
    """Return a unit by name; None for an unknown unit, or one with an unknown scale."""
    known = scale if isinstance(scale, AxisScale) else AxisScale(scale)
    if name in _INCREMENTAL:
        return EnteredUnit(_INCREMENTAL[name], 1.0 / known.increments) if known.increments else None
    if name in _BY_RATIO:
        unit = UNITS[_BY_RATIO[name]]
        ratio = known.rpm if name != "set-point unit" else (known.rpm or 0.0) * (known.set_point or 0.0)
        return unit._replace(factor=ratio * unit.factor) if ratio else None
    if name in _OF_CURRENT:
        field, part = _OF_CURRENT[name]
        whole = getattr(known, field)
        return EnteredUnit("current", whole * part) if whole else None
    if name in UNITS:
        return UNITS[name]
    number, base = split_unit(name)
    row = None if base == name else find_unit(base, scale)
    return None if row is None else row._replace(factor=number * row.factor)


def follows_scale(name: str) -> bool:
    """Return whether a unit follows a scale of its axis, which must then be read from the drive."""
    return split_unit(name)[1] in (*_INCREMENTAL, *_BY_RATIO, *_OF_CURRENT)


def scales_of(drives: AxisObjects, known: ObjectDictionary) -> list[Scale]:
    """Return the scale of every axis' units, as far as the drive reports it.

    Args:
        drives: Emulated, or on a bus.
        known: Their objects.
    """
    increments, roles = _increments_of(drives, known), known.roles
    ratio, of_targets = velocity_ratio(roles), set_point_ratio(roles)
    if ratio is None and Role.PEAK_CURRENT not in roles:
        return list(increments)
    unknown: list[float | None] = [None] * drives.num_axes
    rpm, set_point = (
        unknown if one is None else one.increments([drives.read(key).astype(float) for key in one.keys])
        for one in (ratio, of_targets)
    )
    peak, nominal = (
        MILLIAMPERE * drives.read(role).astype(float) if role in roles else unknown
        for role in (Role.PEAK_CURRENT, Role.NOMINAL_CURRENT)
    )
    return [AxisScale(*one) for one in zip(increments, rpm, peak, nominal, set_point, strict=True)]


def _increments_of(drives: AxisObjects, known: ObjectDictionary) -> list[float | None]:
    """Return the position increments per revolution of every axis; None if the drive does not report them."""
    encoder = (cia402.ENCODER_RESOLUTION, 1)
    own = position_scale(known.roles) is not None
    if not own and not known.has(encoder):
        return [None] * drives.num_axes
    return [float(value) or None for value in drives.read(Role.POSITION_SCALE if own else encoder)]


def parse(text: str, entry: Entry, scale: Scale) -> int:
    """Return the integer for an object that is written as text: a plain integer (also 0x...), or a quantity.

    Args:
        text: The text.
        entry: The object.
        scale: The scale of the axis' units.

    Raises:
        ValueError: For text without a number, or a unit that does not fit the object.

    For an object of four characters of text the text is padded with blanks; in quotation marks digits are characters.
    """
    try:
        return int(text, 0)
    except ValueError:
        pass
    if entry.unit == CHARACTERS:
        return _characters(text, entry)
    found = _QUANTITY.match(text)
    if found is None:
        raise ValueError(f"{text!r} is not a number for {entry.label}; give an integer, or a number and a unit")
    number, name = float(found[1]), found[2]
    if not math.isfinite(number):
        raise ValueError(_too_large(text, entry))
    if name is None or name == entry.unit:
        if number != int(number):
            raise ValueError(
                f"{entry.label} takes integers{_counted(entry)}; {text} is not one, choose {round(number)}"
            )
        return int(number)
    count = number / _factor(entry, name, scale)
    if not math.isfinite(count):
        raise ValueError(_too_large(text, entry))
    return round(count)


def _characters(text: str, entry: Entry) -> int:
    """Return four characters as an integer, the first one in the lowest byte."""
    inner = text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"" else text
    if len(inner) > 4 or any(ord(letter) > 0xFF for letter in inner):
        raise ValueError(
            f"{text!r} is not a text of up to four Latin-1 characters for {entry.label}; write what follows to the "
            "next register"
        )
    return int.from_bytes(inner.ljust(4).encode("latin-1"), "little")


def is_quantity(value: object) -> bool:
    """Return whether a value is text with a number and a unit."""
    if not isinstance(value, str) or re.fullmatch(r"\s*0[xob]\w+\s*", value, re.IGNORECASE):
        return False
    found = _QUANTITY.match(value)
    return found is not None and found[2] is not None


def integers(text: str, entry: Entry, scale: Sequence[Scale], where: Mask | None = None) -> Integers:
    """Return the integer of each axis for an object written as a quantity; 0 where the mask is false.

    Args:
        text: As for `parse`.
        entry: The object.
        scale: The scale of each axis' units.
        where: The mask of axes; None: all.

    Raises:
        ValueError: As `parse` does.
    """
    chosen = np.ones(len(scale), bool) if where is None else where
    found = [parse(text, entry, one) if mine else 0 for one, mine in zip(scale, chosen, strict=True)]
    try:
        return np.array(found, np.int64)
    except OverflowError:
        raise ValueError(_too_large(text, entry)) from None


def in_unit(raw: Integers, entry: Entry, unit: str, scale: Sequence[Scale]) -> Floats:
    """Return integers of an object in a unit, of the same shape; axes are the last dimension.

    Args:
        raw: Integers on the bus.
        entry: The object.
        unit: A unit of the table, or the object's own.
        scale: The scale of each axis' units.

    Raises:
        ValueError: For a unit that does not fit the object.
    """
    if unit == entry.unit:
        return np.asarray(raw, np.float64)
    return np.asarray(raw * np.array([_factor(entry, unit, one) for one in scale]), np.float64)


def _factor(entry: Entry, name: str, scale: Scale) -> float:
    """Return one count of an object in a unit."""
    own, given = find_unit(entry.unit, scale), find_unit(name, scale)
    if own is None:
        raise ValueError(f"{entry.label} has no unit that {name} could be turned into; give its integer")
    if given is None or given.dimension != own.dimension:
        fitting = dict.fromkeys([entry.unit, *(key for key, unit in UNITS.items() if unit.dimension == own.dimension)])
        raise ValueError(f"{entry.label} is not a quantity in {name!r}; it takes {', '.join(fitting)}")
    return own.factor / given.factor


def parse_raw(text: str, entry: Entry) -> int:
    """Parse a plain integer; ValueError for other text."""
    try:
        return int(text, 0)
    except ValueError:
        raise ValueError(
            f"{text!r} is not an integer for {entry.label}; --raw takes integers, as 1000 or 0x3E8"
        ) from None


def show(raw: int, entry: Entry, scale: Scale) -> str:
    """Return an integer with its unit and, if useful, as a quantity or text: `1092267 pps (1000 rpm)`."""
    text = f"{raw} {entry.unit}".rstrip()
    if entry.unit == CHARACTERS:
        return f"{text} ({raw.to_bytes((raw.bit_length() + 7) // 8, 'little').decode('latin-1')!r})"
    unit = find_unit(entry.unit, scale)
    if unit is None or SHOWN[unit.dimension] == entry.unit:
        return text
    shown = SHOWN[unit.dimension]
    return f"{text} ({raw * unit.factor / UNITS[shown].factor:.6g} {shown})"


def _too_large(text: str, entry: Entry) -> str:
    return f"{text!r} is beyond any number; {entry.label} takes {entry.low} to {entry.high}{_counted(entry)}"


def _counted(entry: Entry) -> str:
    return f" in {entry.unit}" if entry.unit else ""
