"""The limits of every axis as integers of its drive, at the scale and zero that it has now."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices.gains import PI, loop_scales
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import Context, find_unit, split_unit
from drive_env.drives.limits import DEFAULT_SPEED, NO_LIMIT, Limits, given
from drive_env.fieldbus.errors import RefusedError
from drive_env.safety.objects import CURRENT, POSITION, VELOCITY, VL_BY_TIME, VL_QUICK_STOP, VL_TARGET, VL_VELOCITY
from drive_env.safety.rotor import HOME_OFFSET, RotorAngle
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.fieldbus.description import Description
    from drive_env.safety.watched_drives import WatchedDrives


POSITION_LOW, POSITION_HIGH, FOLLOWING_WINDOW = (
    (cia402.POSITION_LIMITS, 1),
    (cia402.POSITION_LIMITS, 2),
    (cia402.FOLLOWING_WINDOW, 0),
)
MAX_PROFILE_VELOCITY, MAX_MOTOR_SPEED = (cia402.MAX_PROFILE_VELOCITY, 0), (cia402.MAX_MOTOR_SPEED, 0)
ACCELERATION, DECELERATION, QUICK_STOP_DECELERATION = (
    (cia402.PROFILE_ACCELERATION, 0),
    (cia402.PROFILE_DECELERATION, 0),
    (cia402.QUICK_STOP_DECELERATION, 0),
)
COUNTED = "pps"  # speeds in increments per second
BY_RATIO = ("velocity unit", "velocity unit/s")  # of which two objects say how many rpm they are
TARGET_UNIT = "set-point unit"  # of which two more say how many of those it is
VL_SPEEDS = (*range(cia402.VL_TARGET_VELOCITY, cia402.VL_QUICK_STOP + 1), cia402.VL_REFERENCE)  # of the standard
BY_MINUTE = ("rpm", "rpm/s")  # which the scale of positions turns into increments; other units are not set off
# A settled axis swings by some counts around its target [inc], though by no more than so much of a turn [rev].
SETTLED, SETTLED_TURNS = 200.0, 0.02
SLACK_TURNS = 0.02  # besides, of a move that is meant to end at a limit: noise and overshoot may take it past [rev]


@dataclass
class Bounds:
    """Limits of every axis, shape (num_axes,) each.

    Attributes:
        low: Lowest position [inc]; -NO_LIMIT for none.
        high: Highest position [inc].
        given: Whether the user gave the position limits, which then hold in homing, too.
        settled: How far a settled axis swings around its place [inc].
        slack: How far beyond them is no leaving [inc].
        velocity: Highest speed [unit of 606Ch].
        count: Increments a second of a count of 606Ch; nan where its unit tells none.
        current: Highest current [unit of 6077h].
        following: Largest following error [inc].
        braking: Deceleration of a quick stop [inc/s^2]; 0 where it is not known.
        profile: Highest deceleration of a profile [inc/s^2], or `braking`.
        slowing: Deceleration of a profile that ends, or has no set-point any more [inc/s^2]; 0 where it is not known.
        rest: Speed below which an axis is at rest [inc/s].
        default_speed: Whether the speed limit is ours, for want of another.
        speed: Highest speed by positions [inc/s], where 606Ch does not count increments; else infinite.
        lag: Of the position loop: what the demand is ahead of an axis, over its speed [s]; 0 where it is not known.
        windup: How far an axis goes on by what the integral of its velocity loop holds, of a count of 6077h [inc]; 0
            where it is not known.
    """

    low: Integers
    high: Integers
    given: Mask
    settled: Floats
    slack: Floats
    velocity: Integers
    count: Floats
    current: Integers
    following: Integers
    braking: Floats
    profile: Floats
    slowing: Floats
    rest: Floats
    default_speed: Mask
    speed: Floats
    lag: Floats
    windup: Floats
    has_position: bool = field(init=False)

    def __post_init__(self) -> None:
        self.has_position = bool(np.any((self.low > -NO_LIMIT) | (self.high < NO_LIMIT)))


@dataclass(frozen=True)
class RotorLimits:
    """The user's limits in revolutions of the rotor, which no scale moves, shape (num_axes,) each; nan without a limit.

    Attributes:
        low: Lowest place [rev].
        high: Highest place [rev].
        velocity: Highest speed [rev/s]; nan, too, where a count of 606Ch is not known.
        following: Largest following error [rev]; nan, too, where the scale is not known.
    """

    low: Floats
    high: Floats
    velocity: Floats
    following: Floats


def rotor_limits(limits: Limits, drives: WatchedDrives, rotor: RotorAngle, here: Integers) -> RotorLimits:
    """Return the user's limits as rotor angles and speeds of now.

    Args:
        limits: The user's.
        drives: The drives.
        rotor: Where their rotors are.
        here: What 6064h shows [inc].
    """
    count = drives.num_axes
    low, high = (None, None) if limits.position is None else limits.position
    turns = rotor.turns(here)
    scale = np.where(rotor.scale > 1.0, rotor.scale, np.nan)
    return RotorLimits(
        turns + (given(low, count) - here) / rotor.scale,
        turns + (given(high, count) - here) / rotor.scale,
        given(limits.velocity, count) * increments_per_count(_speed_unit(drives), rotor) / scale,
        given(limits.following_error, count) / scale,
    )


def velocity_object(description: Description) -> Key:
    """Return the object that shows the speed: 606Ch, or 6044h of a drive of vl alone, whose unit is known anyway."""
    has = description.has
    return VL_VELOCITY if has(VL_VELOCITY) and not (has(POSITION) and has(VELOCITY)) else VELOCITY


def unit_of(description: Description, key: Key) -> str:
    """Return the unit of a speed or an acceleration; "" where the drive has no such object."""
    if key[0] in VL_SPEEDS:
        return TARGET_UNIT if key == VL_TARGET else BY_RATIO[0]
    return description.dictionary.find(key).unit if description.has(key) else ""


def speed_in(key: Key, speed: Integers, bounds: Bounds, drives: WatchedDrives, rotor: RotorAngle) -> Integers:
    """Return a limit of speed [counts of the object that shows it] in counts of another object.

    As it is where both have one unit. Where their ratio is not known, what positions may show at most counts, and what
    the drive shows is held against the limit all the same.
    """
    shown, own = velocity_object(drives.description), unit_of(drives.description, key)
    if (shown != VL_VELOCITY and key[0] not in VL_SPEEDS) or own == unit_of(drives.description, shown):
        return speed
    count = increments_per_count(own, rotor)
    ratio = bounds.count / count
    known = np.isfinite(ratio) & (speed < NO_LIMIT)
    by_position = np.nan_to_num(bounds.speed / count, nan=np.inf)
    limit = np.where(known, np.floor(speed * np.where(known, ratio, 1.0) + 1e-6), float(NO_LIMIT))
    return np.minimum(np.minimum(limit, np.floor(by_position)), float(NO_LIMIT)).astype(np.int64)


def _speed_unit(drives: WatchedDrives) -> str:
    return unit_of(drives.description, velocity_object(drives.description))


def read_bounds(
    limits: Limits, drives: WatchedDrives, rotor: RotorAngle, of_rotors: RotorLimits, in_vl: Mask | None = None
) -> Bounds:
    """Return the limits of every axis; those that the user left open are read from the drives.

    Args:
        limits: The user's.
        drives: The drives.
        rotor: Where their rotors are.
        of_rotors: The user's, as the rotors'.
        in_vl: Axes in vl, of drives that have a ramp of its own for quick stops in it.
    """
    low, high = _own_range(drives)
    ends = (of_rotors.low, of_rotors.high)
    is_given = ~(np.isnan(ends[0]) & np.isnan(ends[1]))
    # Only the user's: a drive's own range is widened by who homes it, and the user's place is not.
    bottom, top = (np.nan_to_num(rotor.increments(end), nan=0.0, posinf=2.0**61, neginf=-(2.0**61)) for end in ends)
    low = np.where(np.isnan(ends[0]), np.where(is_given, -NO_LIMIT, low), np.floor(bottom)).astype(np.int64)
    high = np.where(np.isnan(ends[1]), np.where(is_given, NO_LIMIT, high), np.ceil(top)).astype(np.int64)
    low = np.where(low <= -(2**60), -NO_LIMIT, low)
    high = np.where(high >= 2**60, NO_LIMIT, high)

    known_scale = rotor.scale > 1.0
    unit = _speed_unit(drives)
    count = increments_per_count(unit, rotor)
    told = ~np.isnan(count)
    top = _at_scale(given(limits.velocity, drives.num_axes), of_rotors.velocity * rotor.scale / count)
    velocity = _magnitude(drives, top, MAX_PROFILE_VELOCITY)
    ours = (velocity >= NO_LIMIT) & known_scale & told
    default = np.rint(DEFAULT_SPEED * rotor.scale / np.where(told, count, 1.0))
    velocity = np.where(ours, default, velocity).astype(np.int64)
    braking = _braking(drives, rotor, in_vl)
    # The scale of a revolution may be mistaken: a speed in rpm is checked by positions, too.
    by_position = np.where(told & (velocity < NO_LIMIT), velocity * np.nan_to_num(count), 0.0)
    settled = np.where(known_scale, np.minimum(SETTLED, SETTLED_TURNS * rotor.scale), SETTLED)
    return Bounds(
        low,
        high,
        is_given,
        settled,
        settled + np.where(known_scale, SLACK_TURNS * rotor.scale, 0.0),
        velocity,
        count,
        _current(drives, given(limits.current, drives.num_axes)),
        _magnitude(
            drives,
            _at_scale(given(limits.following_error, drives.num_axes), of_rotors.following * rotor.scale),
            FOLLOWING_WINDOW,
        ),
        braking,
        np.maximum.reduce([braking, *(_rate(drives, key, rotor) for key in (ACCELERATION, DECELERATION))]),
        _slowing(drives, rotor),
        np.where(known_scale, REST_TURNS * rotor.scale, REST_INCREMENTS),
        ours,
        np.where(known_scale & (unit != COUNTED), np.maximum(DEFAULT_SPEED * rotor.scale, by_position), np.inf),
        *_loops(drives, rotor),
    )


def motion_gains(device: Device | None) -> dict[tuple[str, str], Key]:
    """Return the gains of velocity and position loop by loop and part, of a device whose cascade we know."""
    if device is None or device.gains.cascade != PI:
        return {}
    return {(row.loop, row.part): row.key for row in device.gains.rows if row.loop in ("velocity", "position")}


def _loops(drives: WatchedDrives, rotor: RotorAngle) -> tuple[Floats, Floats]:
    """Return by how much a demand is ahead, of the speed [s], and the way that a count of current holds [inc]."""
    device, none = drives.device, np.zeros(drives.num_axes)
    keys = motion_gains(device)
    if device is None or not keys:
        return none, none
    scales = dict(zip(device.gains.keys, loop_scales(device), strict=True))
    gain = {part: scales[key].value(read_own(drives, key, 0)) for part, key in keys.items()}
    # The integral, in A, is P I f times the angle by which the axis is behind.
    per_rad = gain.get(("velocity", "P"), none) * gain.get(("velocity", "I"), none) * device.velocity_rate
    return (
        _reciprocal(gain.get(("position", "P"), none)),
        _reciprocal(per_rad) * _ampere(drives) * np.where(rotor.scale > 1.0, rotor.scale, 0.0) / (2.0 * np.pi),
    )


def _reciprocal(value: Floats) -> Floats:
    return np.asarray(np.where(value > 0.0, 1.0 / np.where(value > 0.0, value, 1.0), 0.0), float)


def _ampere(drives: WatchedDrives) -> Floats:
    """Return how many amperes a count of 6077h is; 0 where its unit tells none."""
    known, device = drives.description, drives.device
    if device is None or CURRENT not in device.bindings or not known.has(CURRENT):
        return np.zeros(drives.num_axes)
    keys = known.role(Role.PEAK_CURRENT), known.role(Role.NOMINAL_CURRENT)
    unknown = np.full(drives.num_axes, np.nan)
    peak, nominal = (unknown if key is None else read_own(drives, key, 0) * 1e-3 for key in keys)
    context = Context(np.nan, np.nan, peak_current=peak, nominal_motor_current=nominal)
    factor = np.asarray(find_unit(device.bindings[CURRENT].unit).factor(context), float)
    return np.asarray(np.nan_to_num(np.broadcast_to(factor, (drives.num_axes,))), float)


def current_limits(drives: WatchedDrives) -> tuple[Key, ...]:
    """Return the objects that limit a drive's current: none, one, or one for each sign."""
    role = drives.description.role
    found = (role(Role.CURRENT_LIMIT), role(Role.CURRENT_LIMIT_NEGATIVE))
    return tuple(key for key in found if key is not None)


def current_scales(drives: WatchedDrives) -> tuple[Key, ...]:
    """Return the objects that say what a count of a current is: none, or the motor's peak and nominal current."""
    found = (drives.description.role(role) for role in (Role.PEAK_CURRENT, Role.NOMINAL_CURRENT))
    return tuple(key for key in found if key is not None)


def counts_per_limit(drives: WatchedDrives) -> Floats:
    """Return how many counts of 6077h one of the current limit is: 1, unless it counts parts of the nominal current."""
    key, ampere = drives.description.role(Role.NOMINAL_CURRENT), _ampere(drives)
    if key is None:
        return np.ones(drives.num_axes)
    return np.asarray(read_own(drives, key, 0) * 1e-6 / np.where(ampere > 0.0, ampere, np.inf), float)


def _current(drives: WatchedDrives, user: Floats) -> Integers:
    """Return the greatest current [counts of 6077h]: the user's, or the drive's, of two signs the lower one."""
    counts, keys = counts_per_limit(drives), current_limits(drives)
    found = [_magnitude(drives, user, key, counts) for key in keys] or [_magnitude(drives, user, None)]
    return np.asarray(np.min(found, axis=0), np.int64)


REST_TURNS, REST_INCREMENTS = 0.15, 2000.0  # rev/s, inc/s: what a velocity filter may show of a rotor at rest


def _own_range(drives: WatchedDrives) -> tuple[Integers, Integers]:
    """Return 607Dh, corrected by the home offset (CiA 402); an empty range is no limit."""
    low, high = read_own(drives, POSITION_LOW, -NO_LIMIT), read_own(drives, POSITION_HIGH, NO_LIMIT)
    # The ends of the type, which are the factory's, are no limits; neither is an empty range.
    empty = low >= high
    offset = read_own(drives, HOME_OFFSET, 0)
    return (
        np.where(empty | (low <= -(2**31)), -NO_LIMIT, low - offset),
        np.where(empty | (high >= 2**31 - 1), NO_LIMIT, high - offset),
    )


def read_own(drives: WatchedDrives, key: Key, absent: int) -> Integers:
    """Return an object of every axis, or what stands for it where the drive does not have it, whatever its EDS says."""
    if drives.description.has(key):
        with contextlib.suppress(RefusedError):
            found: Integers = drives.read_entry(drives.description.dictionary.find(key))
            return found
    return np.full(drives.num_axes, absent, np.int64)


def _at_scale(user: Floats, now: Floats) -> Floats:
    """Return the user's limit in whole counts of today's scale; as it was given where the scale is not known."""
    return np.where(np.isfinite(now), np.maximum(np.floor(now + 1e-6), 1.0), user)


def _magnitude(drives: WatchedDrives, user: Floats, key: Key | None, counts: Floats | float = 1.0) -> Integers:
    """Return the user's limit, or the drive's if it has one; 0 and the end of the type switch the drive's off.

    One of the drive's is `counts` of the user's.
    """
    if np.isnan(user).any() and key is not None:
        found = read_own(drives, key, NO_LIMIT)
        own = np.where((found <= 0) | (found >= 2**31 - 1), NO_LIMIT, np.floor(found * counts)).astype(np.int64)
    else:
        own = np.full(len(user), NO_LIMIT, np.int64)
    chosen = np.where(np.isnan(user) | np.isinf(user), 0.0, user).astype(np.int64)
    result: Integers = np.where(np.isnan(user), own, np.where(np.isinf(user), NO_LIMIT, chosen))
    return result


def increments_per_count(unit: str, rotor: RotorAngle) -> Floats:
    """Return the increments a second (or second squared) of a count of a speed (or an acceleration), nan if unknown.

    Args:
        unit: As the EDS names it.
        rotor: Its scale: increments of a revolution, 1 and less where they are not known.
    """
    number, base = split_unit(unit)
    scale = rotor.scale
    if base in (COUNTED, f"{COUNTED}^2"):
        return np.full(len(scale), number)
    if base in (*BY_RATIO, TARGET_UNIT):
        ratio = rotor.ratio * (rotor.set_point_ratio if base == TARGET_UNIT else 1.0)
        return np.where(scale > 1.0, number * scale / 60.0 * ratio, np.nan)
    return np.where(scale > 1.0, number * scale / 60.0, np.nan) if base in BY_MINUTE else np.full(len(scale), np.nan)


def _slowing(drives: WatchedDrives, rotor: RotorAngle) -> Floats:
    """Return 6084h, where that is 0 6083h [inc/s^2]."""
    down = _rate(drives, DECELERATION, rotor)
    return np.where(down > 0.0, down, _rate(drives, ACCELERATION, rotor))


def _rate(drives: WatchedDrives, key: Key, rotor: RotorAngle) -> Floats:
    """Return a deceleration [inc/s^2]; 0 where the drive has none, or counts it in units that we do not know."""
    known = drives.description
    if not known.has(key):
        return np.zeros(drives.num_axes)
    count = increments_per_count(unit_of(known, key), rotor)
    if np.isnan(count).all():
        return np.zeros(drives.num_axes)
    return np.asarray(read_own(drives, key, 0) * np.nan_to_num(count), float)


def read_vl_rate(
    drives: WatchedDrives, keys: tuple[Key, Key], rotor: RotorAngle, written: Mapping[Key, Integers] | None = None
) -> Floats:
    """Return the deceleration of a ramp of vl [inc/s^2]; 0 where drive or scale have none, infinite without a time.

    Args:
        drives: The drives.
        keys: The ramp, a speed and a time in s; where it has no speed, that of 604Eh counts.
        rotor: Their scale.
        written: Values that some of these objects will have, (num_axes,) each.
    """
    count = np.nan_to_num(increments_per_count(BY_RATIO[0], rotor))
    found, written = np.zeros(drives.num_axes), written or {}
    for pair, per_second in ((keys, 1.0), (VL_BY_TIME[keys], 1e3)):
        if not all(drives.description.has(key) for key in pair):
            continue
        speed, time = (written[key] if key in written else read_own(drives, key, 0) for key in pair)
        rate = np.where(time > 0, speed * count * per_second / np.maximum(time, 1), np.where(speed > 0, np.inf, 0.0))
        found = np.where(found > 0.0, found, rate)
    return found


def _braking(drives: WatchedDrives, rotor: RotorAngle, in_vl: Mask | None) -> Floats:
    """Return the deceleration of a quick stop [inc/s^2]: 6085h, in vl 604Ah or 6051h where set; 0: not known."""
    ramp = _rate(drives, QUICK_STOP_DECELERATION, rotor)
    if in_vl is None:
        return ramp
    own = read_vl_rate(drives, VL_QUICK_STOP, rotor)
    return np.where(in_vl & (own > 0.0), np.where(np.isfinite(own), own, 0.0), ramp)
