"""How a motor's cable is wired, as the field shows it, and the settings with which a drive makes up for that.

The field turns in open loop and takes the rotor along; the signals of encoder and halls then show how they are wired.
One object makes up for a reversed encoder, one for halls of inverted level, one for halls in reverse order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from drive_env.safety.rotor import wrapped
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from drive_env.devices import Device
    from tuning.target import Target


# What is wrong with a cable where the drive is set otherwise than it is wired.
FINDINGS = {
    Role.ENCODER_DIRECTION: "encoder reversed",
    Role.HALL_POLARITY: "hall levels inverted",
    Role.HALL_DIRECTION: "halls in reverse order",
}
SETTLED = 0.002  # s after which a position is read in the new direction

LEAST_HALL_TURN = 2.6  # electrical rad of the field: two edges at least, from wherever it begins
HALL_SLACK = 0.5  # by which their way may differ from the field's: a sector of three
CLEAR = np.radians(60.0)  # of what their angle is off: beyond half a sector and what friction holds the rotor back


class Halls(NamedTuple):
    """The halls of one axis: whether they count against the field, and stand opposite to it; None unknown."""

    reversed: bool | None = None
    inverted: bool | None = None
    reason: str = ""


class Setting(NamedTuple):
    """An object's value, and the one that the wiring needs."""

    has: int
    needs: int


Settings = Mapping[Key, Setting]


def findings(device: Device) -> dict[Key, str]:
    """Return the possible mistakes in wiring, by the object that compensates each, as far as the device has them."""
    return {device.roles[role]: text for role, text in FINDINGS.items() if role in device.roles}


def judge_halls(field: Floats, halls: Floats) -> Halls:
    """Judge the halls by angles of field and halls [electrical rad], shape (n,), read while the field turns."""

    def turned(angle: Floats) -> float:
        return float(_wrapped(np.diff(angle)).sum())

    way = turned(field)
    if abs(way) < LEAST_HALL_TURN:
        return Halls(reason=f"the field turned {abs(way):.2g} rad, and {LEAST_HALL_TURN:g} are needed for the halls")
    ratio = turned(halls) / way
    if abs(abs(ratio) - 1.0) > HALL_SLACK:
        return Halls(reason=f"the halls turned {ratio:.2g} times as far as the field: check whether they are connected")
    backwards = ratio < 0.0
    off = float(np.angle(np.exp(1j * (halls - np.sign(ratio) * field)).mean()))
    if CLEAR < abs(off) < np.pi - CLEAR:
        return Halls(backwards, None, f"the halls are off by {np.degrees(off):.0f} degrees: correct their offset")
    return Halls(backwards, abs(off) > 0.5 * np.pi)


def needed(device: Device, reads: Mapping[Key, int], encoder: float, halls: Halls) -> Settings:
    """Return the settings that a wiring needs, as far as it is known.

    Args:
        device: The drive.
        reads: The objects as they are.
        encoder: 1 where the encoder counts with the field, -1 against it, nan where it is not known.
        halls: What they say.
    """
    found = {
        Role.ENCODER_DIRECTION: None if np.isnan(encoder) else encoder < 0.0,
        Role.HALL_POLARITY: halls.inverted,
        Role.HALL_DIRECTION: halls.reversed,
    }
    known = {device.roles[role]: wrong for role, wrong in found.items() if role in device.roles and wrong is not None}
    return {key: Setting(reads[key], reads[key] ^ wrong) for key, wrong in known.items()}


def changes(settings: Settings) -> dict[Key, int]:
    """Return the values to write."""
    return {key: one.needs for key, one in settings.items() if one.has != one.needs}


def finding(device: Device, settings: Settings) -> list[str]:
    """Return the mistake in words, with the remedy: "encoder reversed: write 2080h:01 = 1"."""
    return [f"{findings(device)[key]}: write {named(key)} = {value}" for key, value in changes(settings).items()]


def corrected(device: Device, settings: Settings) -> list[str]:
    """Return the corrected mistake in words: "encoder reversed: 2080h:01 is 1 now, and was 0"."""
    wrong = changes(settings)
    what = findings(device)
    return [f"{what[key]}: {named(key)} is {wrong[key]} now, and was {settings[key].has}" for key in wrong]


def named(key: Key) -> str:
    """Return an object as the manual writes it."""
    return f"{key[0]:04X}h:{key[1]:02d}"


def write_wiring(target: Target, origin: Integers, values: Sequence[Mapping[Key, int]]) -> tuple[Target, Integers]:
    """Write settings of axes that are off, and return the target and where its rotors had begun [inc], as then counted.

    A drive that counts the other way shows another position where the rotor is, and it is unknown whether a travel was
    meant in the old direction or in the new: what is left is free to both sides.

    Args:
        target: The axes.
        origin: Their positions where the travel was given.
        values: What to write, by object, of every axis.
    """
    if not any(values):
        return target, origin
    drives, increments = target.drives, target.increments()
    before, counted = drives.read(cia402.POSITION_ACTUAL), drives.read(Role.ENCODER_DIRECTION)
    for key in findings(target.device):
        where = np.array([key in axis for axis in values])
        if where.any():
            drives.write(key, np.array([axis.get(key, 0) for axis in values], np.int64), where=where)
    turned = drives.read(Role.ENCODER_DIRECTION) != counted
    if not turned.any():
        return target, origin
    drives.advance(SETTLED)
    gone = wrapped(before - origin)
    now = wrapped(drives.read(cia402.POSITION_ACTUAL) + gone)
    free = np.minimum(-target.low, target.high)
    # A place to either side, so that the travel still holds where the rotor stands.
    here = np.abs(gone) / increments
    room = np.where(turned, np.maximum(free, here), np.inf)
    narrowed = replace(target, low=np.maximum(target.low, -room), high=np.minimum(target.high, room))
    return narrowed, np.where(turned, now, origin)


def _wrapped(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
