"""The limits that a commissioning sets: their objects, writing them, and checking that they fit the motor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary import quantities
from drive_env.dictionary.access import check_limits
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import read_current_limit

if TYPE_CHECKING:
    from mechanics.arrays import Integers
    from tuning.target import Target

PEAK = 3.0  # times the motor's rated current: a higher current limit is an error


class LimitRow(NamedTuple):
    """A limit: its objects or roles, its meaning, and whether it is a position relative to home."""

    objects: tuple[Key | Role, ...]
    meaning: str
    is_place: bool = False


LIMITS = {
    "current": LimitRow((Role.CURRENT_LIMIT, Role.CURRENT_LIMIT_NEGATIVE), "greatest current"),
    "speed": LimitRow(((cia402.MAX_PROFILE_VELOCITY, 0),), "greatest speed of a profile"),
    "quick-stop": LimitRow(((cia402.QUICK_STOP_DECELERATION, 0),), "deceleration of a quick stop"),
    "following-error": LimitRow(((cia402.FOLLOWING_WINDOW, 0),), "following error that stops the axis"),
    "lowest": LimitRow(((cia402.POSITION_LIMITS, 1),), "lowest position, from home", is_place=True),
    "highest": LimitRow(((cia402.POSITION_LIMITS, 2),), "highest position, from home", is_place=True),
}


def limits_of(target: Target) -> dict[str, list[Entry]]:
    """Return the limits that a drive has, by name, with the objects of each."""
    roles, dictionary = target.device.roles, target.device.new_dictionary()
    found = {}
    for name, row in LIMITS.items():
        keys = [roles.get(one) if isinstance(one, Role) else one for one in row.objects]
        if entries := [dictionary.find(key) for key in keys if key is not None and dictionary.has(key)]:
            found[name] = entries
    return found


def raw_limits(target: Target, wanted: Mapping[str, str]) -> list[tuple[str, Entry, Integers]]:
    """Convert limits from texts: name, object, and raw integers of all axes.

    Raises:
        ValueError: For a limit that the drive does not have, or a text with another unit.
    """
    there = limits_of(target)
    if unknown := next((name for name in wanted if name not in there), None):
        raise ValueError(f"there is no limit {unknown!r}: a {target.device.name} has {', '.join(there)}")
    scales = quantities.scales_of(target.drives, target.device.new_dictionary())
    return [(name, one, quantities.integers(text, one, scales)) for name, text in wanted.items() for one in there[name]]


def write_limits(target: Target, wanted: Mapping[str, str], *, places: bool) -> list[str]:
    """Write limits given as texts; return a line per object with its old and new values.

    Args:
        target: The drives.
        wanted: Texts by name of the limit; those of the other kind are ignored.
        places: True writes positions relative to home, False all other limits.

    Raises:
        ValueError: For a limit that the drive does not have, or an unsuitable text; nothing is written then.
    """
    drives = target.drives
    scales = quantities.scales_of(drives, target.device.new_dictionary())
    rows = [(entry, raw) for name, entry, raw in raw_limits(target, wanted) if LIMITS[name].is_place == places]
    for entry, raw in rows:
        for one in raw.tolist():
            check_limits(entry, one)
    told = []
    for entry, raw in rows:
        before = drives.read((entry.index, entry.sub))
        drives.write((entry.index, entry.sub), raw)
        then, now = (
            quantities.show(int(x[0]), entry, scales[0]) for x in (before, drives.read((entry.index, entry.sub)))
        )
        told.append(f"{entry.label} is {now}, and was {then}")
    return told


def check_limits_of_motor(target: Target) -> list[str]:
    """Check current limit and quick stop; return lines on how the limits protect the axes.

    Raises:
        ValueError: For a current limit too high for the motor, or a quick stop without deceleration.
    """
    drives, motor, told = target.drives, target.motor, []
    if Role.CURRENT_LIMIT in target.device.roles:
        current, most = float(read_current_limit(drives).max()), PEAK * motor.rated_current
        if current > most:
            raise ValueError(
                f"the current limit is {current:.3g} A, and {PEAK:g} times the rated current of {motor.name} are "
                f"{most:.3g} A; give a lower limit `current`"
            )
        told.append(f"current limit {current:.3g} A; rated current of the motor {motor.rated_current:.3g} A")
    dictionary, speed = target.device.new_dictionary(), target.speed / (2.0 * math.pi)
    entry, raw = dictionary.find(cia402.QUICK_STOP_DECELERATION), drives.read(cia402.QUICK_STOP_DECELERATION)
    ramps = quantities.in_unit(raw, entry, "rev/s^2", quantities.scales_of(drives, dictionary))
    for axis, ramp in zip(target.axis_numbers, ramps.tolist(), strict=True):
        if not ramp > 0.0:
            raise ValueError(f"axis {axis}: 6085h is 0, so its quick stop has no ramp; give the limit `quick-stop`")
        told.append(f"axis {axis}: a quick stop from {60.0 * speed:.0f} rpm takes {speed**2 / (2.0 * ramp):.3g} turns")
    return told


def check_place_of_axes(target: Target) -> None:
    """Raise ValueError if an axis is outside the drive's position limits, or the upper one not above the lower."""
    low, high = (cia402.POSITION_LIMITS, 1), (cia402.POSITION_LIMITS, 2)
    if not target.device.new_dictionary().has(low):
        return
    least, most, here = (target.drives.read(key) for key in (low, high, cia402.POSITION_ACTUAL))
    for axis, a, b, x in zip(target.axis_numbers, least.tolist(), most.tolist(), here.tolist(), strict=True):
        if a >= b and (a, b) != (0, 0):  # 0 and 0: no limits
            raise ValueError(
                f"axis {axis}: the highest position {b} is not above the lowest {a} (607Dh): give `lowest` and "
                "`highest` from home"
            )
        if a < b and not a <= x <= b:
            raise ValueError(
                f"axis {axis} stands at {x}, outside of {a} to {b} (607Dh): give `lowest` and `highest` from home, so "
                "that it stands between them"
            )
