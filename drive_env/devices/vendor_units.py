"""The units that a drive counts in, as its EDS tells them: scale of positions, speeds, accelerations, torques.

Positions follow 6092h over 6091h, or 608Fh; speeds and accelerations 60A9h and 60AAh, or the unit that the EDS writes
beside an object. Where nothing tells a unit it is the standard's: units of position per second, thousandths of the
rated torque.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from canopen.objectdictionary import ODVariable

from drive_env import cia402

Key = tuple[int, int]

COARSEST = 100.0  # units of position in a turn: a scale below is none that a position could be held by
# Codes of CiA 303-2 in 60A8h to 60AAh: powers of ten above, then numerator, denominator, and a byte that is 0.
REVOLUTIONS, INCREMENTS, PER_MINUTE = 0xB4, 0xB5, 0xC0
SECOND, MINUTE, SECOND_SQUARED = 0x03, 0x47, 0x57
_SPEEDS = {
    (REVOLUTIONS, MINUTE): (1.0, "rpm"),
    (REVOLUTIONS, SECOND): (60.0, "rpm"),
    (INCREMENTS, SECOND): (1.0, "pps"),
}
_ACCELERATIONS = {
    (PER_MINUTE, SECOND): (1.0, "rpm/s"),
    (REVOLUTIONS, SECOND_SQUARED): (60.0, "rpm/s"),
    (INCREMENTS, SECOND_SQUARED): (1.0, "pps^2"),
}
# Units as EDS files write them beside an object, spaces left out, in lower case.
_WRITTEN = {
    **dict.fromkeys(("rpm", "r/min", "rev/min", "1/min", "min-1", "min^-1", "u/min"), "rpm"),
    **dict.fromkeys(("rps", "rev/s", "r/s", "1/s"), "60 rpm"),
    **dict.fromkeys(("inc/s", "counts/s", "count/s", "cnt/s", "pps", "pulse/s", "pulses/s", "uu/s"), "pps"),
    **dict.fromkeys(("rpm/s", "r/min/s", "rev/min/s", "(r/min)/s", "1/min/s"), "rpm/s"),
    **dict.fromkeys(("rps/s", "rev/s^2", "rev/s2", "rps^2", "r/s^2"), "60 rpm/s"),
    **dict.fromkeys(("inc/s^2", "inc/s2", "counts/s^2", "counts/s2", "pps^2", "pps/s", "cnt/s^2", "uu/s^2"), "pps^2"),
    **dict.fromkeys(("ma",), "mA"),
    **dict.fromkeys(("1/1000", "permille", "0.1%", "perthousand", "1/1000rated"), "1/1000 rated"),
}
_PREFIXED = re.compile(r"(\d+(?:\.\d+)?)\*?([a-z(].*)$")


class VendorUnits(NamedTuple):
    """Units of a drive, and what says so.

    Attributes:
        velocity, acceleration, torque: Names of units (dictionary/units.py).
        scale: Name of a role -> object of the dictionary, of what makes the scale of positions; empty: nothing does.
        sources: Quantity -> where its unit stands; "" where it is the standard's.
    """

    velocity: str
    acceleration: str
    torque: str
    scale: dict[str, Key]
    sources: dict[str, str]


def vendor_units(types: Mapping[Key, ODVariable], velocity: str = "", acceleration: str = "") -> VendorUnits:
    """Return the units of an EDS.

    Args:
        types: Its entries.
        velocity: Unit of speeds that a person gave, before all others.
        acceleration: The same of accelerations.
    """
    sources = {}
    if velocity:
        sources["velocity"] = "given"
    else:
        velocity, sources["velocity"] = _told(
            types, cia402.VELOCITY_UNIT, _SPEEDS, ("rpm", "pps"),
            (cia402.VELOCITY_ACTUAL, cia402.TARGET_VELOCITY, cia402.PROFILE_VELOCITY),
        )  # fmt: skip
    if acceleration:
        sources["acceleration"] = "given"
    else:
        acceleration, sources["acceleration"] = _told(
            types, cia402.ACCELERATION_UNIT, _ACCELERATIONS, ("rpm/s", "pps^2"),
            (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION),
        )  # fmt: skip
    torque, sources["torque"] = _told(
        types, 0, {}, ("mA", "1/1000 rated"), (cia402.TORQUE_ACTUAL, cia402.TARGET_TORQUE)
    )
    if not acceleration:
        acceleration = "rpm/s" if velocity.endswith("rpm") else "pps^2"
    scale, sources["position"] = _scale(types)
    return VendorUnits(velocity or "pps", acceleration, torque or "1/1000 rated", scale, sources)


def _told(
    types: Mapping[Key, ODVariable],
    index: int,
    codes: Mapping[tuple[int, int], tuple[float, str]],
    bases: tuple[str, ...],
    objects: tuple[int, ...],
) -> tuple[str, str]:
    """Return a unit and where it stands: as an object's code, or beside an object; two empty texts for none."""
    coded = types.get((index, 0))
    if coded is not None and isinstance(coded.default, int):
        raw = coded.default & 0xFFFFFFFF
        power, parts = raw >> 24, (raw >> 16 & 0xFF, raw >> 8 & 0xFF)
        if parts in codes:
            number, base = codes[parts]
            return _times(number * 10.0 ** (power - 256 if power > 127 else power), base), f"{index:04X}h"
    for one in objects:
        variable = types.get((one, 0))
        unit = written_unit("" if variable is None else variable.unit or "")
        if unit.rpartition(" ")[2] in bases or unit in bases:
            return unit, f"the unit of {one:04X}h"
    return "", ""


def written_unit(text: str) -> str:
    """Return the name of a unit that an EDS writes beside an object: "0.1 r/min" is "0.1 rpm"; "" of one not known."""
    plain = re.sub(r"[\s\[\]]", "", text.lower())
    if plain in _WRITTEN:
        return _WRITTEN[plain]
    found = _PREFIXED.match(plain)
    if found is None or found[2] not in _WRITTEN:
        return ""
    inner = _WRITTEN[found[2]]
    number, _, base = inner.rpartition(" ")
    if base == "rated":
        return ""
    return _times(float(found[1]) * (float(number) if number else 1.0), base)


def _times(number: float, base: str) -> str:
    return base if number == 1.0 else f"{number:.12g} {base}"


def _scale(types: Mapping[Key, ODVariable]) -> tuple[dict[str, Key], str]:
    """Return the objects that say how many units of position a turn of the motor has, and which they are."""
    feed = {"feed": (cia402.FEED_CONSTANT, 1), "feed_turns": (cia402.FEED_CONSTANT, 2)}
    gear = {"gear_motor": (cia402.GEAR_RATIO, 1), "gear_shaft": (cia402.GEAR_RATIO, 2)}
    encoder = {"encoder_increments": (cia402.ENCODER_RESOLUTION, 1), "encoder_turns": (cia402.ENCODER_RESOLUTION, 2)}
    units, turns = _factory(types, feed)
    motor, shaft = _factory(types, gear) if all(key in types for key in gear.values()) else (1, 1)
    if units > 0 and turns > 0 and motor > 0 and shaft > 0 and units / turns * shaft / motor >= COARSEST:
        has_gear = all(key in types for key in gear.values())
        return feed | (gear if has_gear else {}), "6092h over 6091h" if has_gear else "6092h"
    if all(key in types for key in encoder.values()):
        return encoder, "608Fh"
    return {}, ""


def _factory(types: Mapping[Key, ODVariable], roles: Mapping[str, Key]) -> tuple[int, int]:
    values = [types[key].default if key in types else 0 for key in roles.values()]
    first, second = (value if isinstance(value, int) else 0 for value in values)
    return first, second
