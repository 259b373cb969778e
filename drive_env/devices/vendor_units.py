"""The units of a drive according to its EDS: scale of positions, speeds, accelerations, torques.

Positions follow 6092h over 6091h, an angle in 60A8h, or 608Fh; speeds and accelerations 60A9h and 60AAh, or the unit
that the EDS gives for an object. By default the unit is the standard's: units of position per second, thousandths of
the rated torque. Angles are those of the shaft of 6092h, rpm those of the motor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from canopen.objectdictionary import ODVariable

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.position_scale import COARSEST, FINEST, is_scale

# Codes of CiA 303-2 in 60A8h to 60AAh: powers of ten above, then numerator, denominator, and a byte that is 0.
RADIAN, GRADIAN, DEGREE, ARC_MINUTE, ARC_SECOND = 0x10, 0x40, 0x41, 0x42, 0x43
DIMENSIONLESS, REVOLUTIONS, INCREMENTS, PER_MINUTE = 0x00, 0xB4, 0xB5, 0xC0
SECOND, MINUTE, HOUR, SECOND_SQUARED = 0x03, 0x47, 0x48, 0x57
ANGLES = {  # in revolutions
    RADIAN: 0.5 / math.pi,
    GRADIAN: 1.0 / 400.0,
    DEGREE: 1.0 / 360.0,
    ARC_MINUTE: 1.0 / 21_600.0,
    ARC_SECOND: 1.0 / 1_296_000.0,
    REVOLUTIONS: 1.0,
}
TIMES = {SECOND: 1.0, MINUTE: 60.0, HOUR: 3600.0}  # in seconds
# Units in EDS files, without spaces, in lower case.
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
_ANGLE = re.compile(r"(\d+(?:\.\d+)?)?\*?(m?)(deg|degree|degrees|\u00b0|rad)(/s|/min|/s\^?2|/s\u00b2)$")


class Feed(NamedTuple):
    """Position units per turn of the shaft of 6092h, and their source; 0 and "" if unknown."""

    units: float
    source: str


class VendorUnits(NamedTuple):
    """Units of a drive, and their sources.

    Attributes:
        velocity, acceleration, torque: Names of units (dictionary/units.py).
        scale: Name of a role -> object, for the objects that give the position scale; empty: there are none.
        increments: Position units per turn of the motor if they are known but in no object, else 0.
        sources: Quantity -> source of its unit; "" if it is the standard's.
        notes: Ignored entries of the file: object, and reason.
    """

    velocity: str
    acceleration: str
    torque: str
    scale: dict[str, Key]
    increments: int
    sources: dict[str, str]
    notes: tuple[tuple[str, str], ...]


def vendor_units(types: Mapping[Key, ODVariable], velocity: str = "", acceleration: str = "") -> VendorUnits:
    """Return the units of an EDS.

    Args:
        types: Its entries.
        velocity: The user's unit of speeds, which has precedence.
        acceleration: The user's unit of accelerations, likewise.
    """
    notes: list[tuple[str, str]] = []
    scale, increments, feed = _scale(types, notes)
    sources = {"position": feed.source}
    if velocity:
        sources["velocity"] = "given"
    else:
        velocity, sources["velocity"] = _told(
            types, cia402.VELOCITY_UNIT, ("rpm", "pps"), feed, notes,
            (cia402.VELOCITY_ACTUAL, cia402.TARGET_VELOCITY, cia402.PROFILE_VELOCITY),
        )  # fmt: skip
    if acceleration:
        sources["acceleration"] = "given"
    else:
        acceleration, sources["acceleration"] = _told(
            types, cia402.ACCELERATION_UNIT, ("rpm/s", "pps^2"), feed, notes,
            (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION),
        )  # fmt: skip
    torque, sources["torque"] = _told(
        types, 0, ("mA", "1/1000 rated"), feed, notes, (cia402.TORQUE_ACTUAL, cia402.TARGET_TORQUE)
    )
    if not acceleration:
        acceleration = "rpm/s" if velocity.endswith("rpm") else "pps^2"
    return VendorUnits(
        velocity or "pps", acceleration, torque or "1/1000 rated", scale, increments, sources, tuple(notes)
    )


class UnitCode(NamedTuple):
    """The unit code in an object of 60A8h to 60AAh."""

    prefix: float
    numerator: int
    denominator: int

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle, which is known without an encoder."""
        return self.numerator in ANGLES and self.denominator == DIMENSIONLESS


def _code(types: Mapping[Key, ODVariable], index: int) -> UnitCode | None:
    """Return the unit code of an object; None if the object is missing, or 0."""
    variable = types.get((index, 0))
    if variable is None or not isinstance(variable.default, int) or variable.default & 0xFFFFFFFF == 0:
        return None
    raw = variable.default & 0xFFFFFFFF
    power = raw >> 24
    return UnitCode(10.0 ** (power - 256 if power > 127 else power), raw >> 16 & 0xFF, raw >> 8 & 0xFF)


def _rate(code: UnitCode, bases: tuple[str, ...], feed: Feed, position: UnitCode | None) -> str:
    """Return the unit of a speed's or an acceleration's code; "" for an unknown code."""
    by_minute, counted = bases
    is_speed = by_minute == "rpm"
    if not is_speed and code.numerator == PER_MINUTE and code.denominator == SECOND:
        return _times(code.prefix, by_minute)
    seconds = TIMES.get(code.denominator) if is_speed else 1.0 if code.denominator == SECOND_SQUARED else None
    if seconds is None:
        return ""
    if code.numerator == REVOLUTIONS:
        return _times(code.prefix * 60.0 / seconds, by_minute)
    if code.numerator in ANGLES:
        return _of_angle(code.prefix * ANGLES[code.numerator] / seconds, bases, feed)
    if code.numerator in (INCREMENTS, DIMENSIONLESS):
        return _times(code.prefix / seconds, counted)
    if position is not None and code.numerator == position.numerator:
        return _times(code.prefix / position.prefix / seconds, counted)  # metres: the same units as positions
    return ""


def _of_angle(turns: float, bases: tuple[str, ...], feed: Feed) -> str:
    """Return the unit of an angular rate [turns of the shaft/s^n]: in position units if they are known, else rpm."""
    by_minute, counted = bases
    return _times(turns * feed.units, counted) if feed.units else _times(60.0 * turns, by_minute)


def _told(
    types: Mapping[Key, ODVariable],
    index: int,
    bases: tuple[str, ...],
    feed: Feed,
    notes: list[tuple[str, str]],
    objects: tuple[int, ...],
) -> tuple[str, str]:
    """Return a unit and its source, an object's code or the text at an object; two empty texts without one."""
    code = _code(types, index)
    if code is not None:
        unit = _rate(code, bases, feed, _code(types, cia402.POSITION_UNIT))
        if unit:
            return unit, f"{index:04X}h"
        notes.append((f"{index:04X}h", f"{_shown(types, index)} is a code of CiA 303-2 that is not known here"))
    for one in objects:
        variable = types.get((one, 0))
        text = "" if variable is None else variable.unit or ""
        unit = written_unit(text)
        if unit.rpartition(" ")[2] in bases or unit in bases:
            return unit, f"the unit of {one:04X}h"
        turns, power = written_angle(text)
        if power and bases[0] == ("rpm", "rpm/s")[power - 1]:
            return _of_angle(turns, bases, feed), f"the unit of {one:04X}h"
    return "", ""


def _shown(types: Mapping[Key, ODVariable], index: int) -> str:
    return f"{int(types[index, 0].default) & 0xFFFFFFFF:08X}h"


def written_angle(text: str) -> tuple[float, int]:
    """Parse an angle per second, or second squared, as in an EDS: revolutions, and the power of the second.

    "0.1 deg/s" is (0.1 / 360, 1), "rad/s^2" is (0.5 / pi, 2); (0.0, 0) for other text.
    """
    found = _ANGLE.match(re.sub(r"[\s\[\]]", "", text.lower()))
    if found is None:
        return 0.0, 0
    number, milli, angle, per = found.groups()
    turns = ANGLES[RADIAN if angle == "rad" else DEGREE] * float(number or 1.0) * (1e-3 if milli else 1.0)
    return (turns / 60.0, 1) if per == "/min" else (turns, 1 if per == "/s" else 2)


def written_unit(text: str) -> str:
    """Return the name of a unit as given in an EDS: "0.1 r/min" is "0.1 rpm"; "" if unknown."""
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


def _scale(types: Mapping[Key, ODVariable], notes: list[tuple[str, str]]) -> tuple[dict[str, Key], int, Feed]:
    """Return the objects that give position units per turn of the motor, or that number; and the feed."""
    feed = {"feed": (cia402.FEED_CONSTANT, 1), "feed_turns": (cia402.FEED_CONSTANT, 2)}
    gear = {"gear_motor": (cia402.GEAR_RATIO, 1), "gear_shaft": (cia402.GEAR_RATIO, 2)}
    encoder = {"encoder_increments": (cia402.ENCODER_RESOLUTION, 1), "encoder_turns": (cia402.ENCODER_RESOLUTION, 2)}
    has_gear = all(key in types for key in gear.values())
    units, turns = _factory(types, feed)
    motor, shaft = _factory(types, gear) if has_gear else (1, 1)
    geared = shaft / motor if motor > 0 and shaft > 0 else 0.0
    position = _code(types, cia402.POSITION_UNIT)
    angle = 1.0 / (position.prefix * ANGLES[position.numerator]) if position is not None and position.is_angle else 0.0
    if units > 0 and turns > 0:
        if is_scale(units / turns * geared):
            if angle and not math.isclose(angle, units / turns, rel_tol=1e-3):
                said = f"{_shown(types, cia402.POSITION_UNIT)} says {angle:g}"
                notes.append(("60A8h", f"6092h counts, {units / turns:g} units a turn; {said}"))
            source = "6092h over 6091h" if has_gear else "6092h"
            return feed | (gear if has_gear else {}), 0, Feed(units / turns, source)
        notes.append(
            (
                "6092h over 6091h" if has_gear else "6092h",
                _no_scale(f"{units * shaft} : {turns * motor}", units / turns * geared),
            )
        )
    if is_scale(round(angle * geared)):
        if has_gear:
            notes.append(("6091h", f"its factory's ratio is in the scale that 60A8h gives, {angle:g} units a turn of "
                                   "the shaft; another ratio that is written changes nothing"))  # fmt: skip
        if not math.isclose(round(angle * geared), angle * geared, rel_tol=1e-9):
            notes.append(("60A8h", f"{angle * geared:.9g} units a turn are taken as {round(angle * geared)}"))
        return {}, round(angle * geared), Feed(angle, "60A8h")
    if angle:
        notes.append(("60A8h", _no_scale(f"{angle * geared:g} : 1", angle * geared)))
    if position is not None and not angle and position.numerator not in (INCREMENTS, DIMENSIONLESS):
        why = "is no angle: how many of it a turn has only 6092h tells"
        notes.append(("60A8h", f"{_shown(types, cia402.POSITION_UNIT)} {why}"))
    if has_gear:
        why = "without a feed in 6092h positions are counts of the encoder at the motor: a gear changes nothing"
        notes.append(("6091h", why))
    if all(key in types for key in encoder.values()):
        counts, per = _factory(types, encoder)
        if counts <= 0 or per <= 0 or is_scale(counts / per):
            return encoder, 0, Feed(0.0, "608Fh")
        notes.append(("608Fh", _no_scale(f"{counts} : {per}", counts / per)))
    return {}, 0, Feed(0.0, "")


def _no_scale(ratio: str, units: float) -> str:
    if units > FINEST:
        return f"{ratio} is not taken: positions of 32 bits hold fewer than 8 turns of more than {FINEST:.0f} units"
    return f"{ratio} is not taken: a position cannot be held by fewer than {COARSEST:g} units a turn"


def _factory(types: Mapping[Key, ODVariable], roles: Mapping[str, Key]) -> tuple[int, int]:
    values = [types[key].default if key in types else 0 for key in roles.values()]
    first, second = (value if isinstance(value, int) else 0 for value in values)
    return first, second
