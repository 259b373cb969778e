"""The wiring of a motor's cable as measured with a turning field, and the settings of a drive that compensate for it.

The field turns in open loop and moves the rotor; the signals of encoder and halls then show how they are wired. One
object compensates for a reversed encoder, one for halls with inverted level, one for halls in reverse order.
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


# Description of a wiring that differs from the drive's setting.
FINDINGS = {
    Role.ENCODER_DIRECTION: "encoder reversed",
    Role.HALL_POLARITY: "hall levels inverted",
    Role.HALL_DIRECTION: "halls in reverse order",
}
SETTLED = 0.002  # s after which a position is read in the new direction

LEAST_HALL_TURN = 2.6  # electrical rad of the field: at least two edges, from any start
HALL_SLACK = 0.5  # greatest relative difference between the turns of halls and field: one sector of three
CLEAR = np.radians(60.0)  # of their angle's error: beyond half a sector plus the effect of friction on the rotor


class Halls(NamedTuple):
    """The halls of one axis: whether they count against the field, and are opposite to it; None if unknown."""

    reversed: bool | None = None
    inverted: bool | None = None
    reason: str = ""


class Setting(NamedTuple):
    """An object's present value, and the one that the wiring needs."""

    has: int
    needs: int


Settings = Mapping[Key, Setting]


def findings(device: Device) -> dict[Key, str]:
    """Return the possible wiring errors of a device, by the object that compensates each."""
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
        reads: Present values of the objects.
        encoder: 1 if the encoder counts with the field, -1 if against it, nan if unknown.
        halls: Result of `judge_halls`.
    """
    found = {
        Role.ENCODER_DIRECTION: None if np.isnan(encoder) else encoder < 0.0,
        Role.HALL_POLARITY: halls.inverted,
        Role.HALL_DIRECTION: halls.reversed,
    }
    known = {device.roles[role]: wrong for role, wrong in found.items() if role in device.roles and wrong is not None}
    return {key: Setting(reads[key], reads[key] ^ wrong) for key, wrong in known.items()}


def changes(settings: Settings) -> dict[Key, int]:
    """Return the values to write by object; empty if all are correct."""
    return {key: one.needs for key, one in settings.items() if one.has != one.needs}


def finding(device: Device, settings: Settings) -> list[str]:
    """Describe the wiring errors with their remedy: "encoder reversed: write 2080h:01 = 1"."""
    return [f"{findings(device)[key]}: write {named(key)} = {value}" for key, value in changes(settings).items()]


def corrected(device: Device, settings: Settings) -> list[str]:
    """Describe the corrected wiring errors: "encoder reversed: 2080h:01 is 1 now, and was 0"."""
    wrong = changes(settings)
    what = findings(device)
    return [f"{what[key]}: {named(key)} is {wrong[key]} now, and was {settings[key].has}" for key in wrong]


def named(key: Key) -> str:
    """Format an object like the manual does."""
    return f"{key[0]:04X}h:{key[1]:02d}"


def write_wiring(target: Target, origin: Integers, values: Sequence[Mapping[Key, int]]) -> tuple[Target, Integers]:
    """Write wiring settings of axes that are off; return the target and its rotors' origin [inc] in the new counting.

    A drive that counts in the other direction shows another position at the same place, and it is unknown in which
        direction a travel was meant: only what is free to both sides remains.

    Args:
        target: The axes.
        origin: Their positions when the travel was given.
        values: Values to write, by object, for every axis.
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
    # Extended to both sides, so that the travel still contains the present position.
    here = np.abs(gone) / increments
    room = np.where(turned, np.maximum(free, here), np.inf)
    narrowed = replace(target, low=np.maximum(target.low, -room), high=np.minimum(target.high, room))
    return narrowed, np.where(turned, now, origin)


def _wrapped(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
