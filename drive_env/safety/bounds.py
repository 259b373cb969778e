"""The limits of every axis as integers of its drive, at its present scale and zero."""

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
BY_RATIO = ("velocity unit", "velocity unit/s")  # two objects give their ratio to rpm
TARGET_UNIT = "set-point unit"  # two more objects give its ratio to velocity units
VL_SPEEDS = (*range(cia402.VL_TARGET_VELOCITY, cia402.VL_QUICK_STOP + 1), cia402.VL_REFERENCE)  # of the standard
BY_MINUTE = ("rpm", "rpm/s")  # converted by the scale of positions; any other unit is not checked
# A settled axis swings around its target by at most SETTLED [inc], and at most SETTLED_TURNS [rev].
SETTLED, SETTLED_TURNS = 200.0, 0.02
SLACK_TURNS = 0.02  # rev, added for a move that ends at a limit: noise and overshoot may take it past


@dataclass
class Bounds:
    """Limits of every axis, shape (num_axes,) each.

    Attributes:
        low: Lowest position [inc]; -NO_LIMIT without a limit.
        high: Highest position [inc].
        given: Whether the user gave the position limits; those hold in homing, too.
        settled: How far a settled axis swings around its target [inc].
        slack: How far beyond its limits an axis may go without being stopped [inc].
        velocity: Highest speed [unit of 606Ch].
        count: Increments a second of a count of 606Ch; nan if its unit cannot be converted.
        current: Highest current [unit of 6077h].
        following: Largest following error [inc].
        braking: Deceleration of a quick stop [inc/s^2]; 0 if unknown.
        profile: Highest deceleration of a profile [inc/s^2], or `braking`.
        slowing: Deceleration of a profile that ends or has lost its set-point [inc/s^2]; 0 if unknown.
        rest: Speed below which an axis is at rest [inc/s].
        default_speed: Whether the speed limit is this library's default, since neither user nor drive has one.
        speed: Highest speed computed from positions [inc/s], if 606Ch does not count increments; else infinite.
        lag: Distance of the position demand ahead of an axis, divided by its speed [s]; 0 if unknown.
        windup: How far an axis goes on per count of 6077h that the integral of its velocity loop holds [inc]; 0 if
            unknown.
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
    """The user's limits in revolutions of the rotor (independent of the scale), shape (num_axes,); nan without a limit.

    Attributes:
        low: Lowest position [rev].
        high: Highest position [rev].
        velocity: Highest speed [rev/s]; nan, too, if the unit of 606Ch is unknown.
        following: Largest following error [rev]; nan, too, if the scale is unknown.
    """

    low: Floats
    high: Floats
    velocity: Floats
    following: Floats


def rotor_limits(limits: Limits, drives: WatchedDrives, rotor: RotorAngle, here: Integers) -> RotorLimits:
    """Return the user's limits as rotor angles and speeds, at the present scale and zero.

    Args:
        limits: The user's limits.
        drives: The drives.
        rotor: Their rotor angles.
        here: The present values of 6064h [inc].
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
    """Return the object that shows the speed: 606Ch, or 6044h of a drive with vl alone, whose unit is always known."""
    has = description.has
    return VL_VELOCITY if has(VL_VELOCITY) and not (has(POSITION) and has(VELOCITY)) else VELOCITY


def unit_of(description: Description, key: Key) -> str:
    """Return the unit of a speed or an acceleration; "" if the drive has no such object."""
    if key[0] in VL_SPEEDS:
        return TARGET_UNIT if key == VL_TARGET else BY_RATIO[0]
    return description.dictionary.find(key).unit if description.has(key) else ""


def speed_in(key: Key, speed: Integers, bounds: Bounds, drives: WatchedDrives, rotor: RotorAngle) -> Integers:
    """Convert a speed limit from counts of the object that shows the speed to counts of another object.

    Unchanged if both have the same unit. If their ratio is unknown, the limit of the speed from positions applies; the
    speed that the drive shows is checked against the limit in any case.
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
    """Return the limits of every axis; limits that the user left open are read from the drives.

    Args:
        limits: The user's limits.
        drives: The drives.
        rotor: Their rotor angles.
        of_rotors: The user's limits in revolutions.
        in_vl: Axes in vl, if the drive has a separate ramp for quick stops in that mode.
    """
    low, high = _own_range(drives)
    ends = (of_rotors.low, of_rotors.high)
    is_given = ~(np.isnan(ends[0]) & np.isnan(ends[1]))
    # A limit is "given" only by the user: homing widens the drive's own range, but not the user's.
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
    # The scale may be wrong: a speed in rpm is checked by positions, too.
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
    """Map loop and part to the gain objects of velocity and position loop; empty if the device's cascade is unknown."""
    if device is None or device.gains.cascade != PI:
        return {}
    return {(row.loop, row.part): row.key for row in device.gains.rows if row.loop in ("velocity", "position")}


def _loops(drives: WatchedDrives, rotor: RotorAngle) -> tuple[Floats, Floats]:
    """Return the lag of the position loop [s], and the distance per count of 6077h held in the integral [inc]."""
    device, none = drives.device, np.zeros(drives.num_axes)
    keys = motion_gains(device)
    if device is None or not keys:
        return none, none
    scales = dict(zip(device.gains.keys, loop_scales(device), strict=True))
    gain = {part: scales[key].value(read_own(drives, key, 0)) for part, key in keys.items()}
    # The integral [A] is P I f times the angle by which the axis lags.
    per_rad = gain.get(("velocity", "P"), none) * gain.get(("velocity", "I"), none) * device.velocity_rate
    return (
        _reciprocal(gain.get(("position", "P"), none)),
        _reciprocal(per_rad) * _ampere(drives) * np.where(rotor.scale > 1.0, rotor.scale, 0.0) / (2.0 * np.pi),
    )


def _reciprocal(value: Floats) -> Floats:
    return np.asarray(np.where(value > 0.0, 1.0 / np.where(value > 0.0, value, 1.0), 0.0), float)


def _ampere(drives: WatchedDrives) -> Floats:
    """Return the amperes of a count of 6077h; 0 if its unit is unknown."""
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
    """Return the objects that limit a drive's current: zero, one, or two (one for each sign)."""
    role = drives.description.role
    found = (role(Role.CURRENT_LIMIT), role(Role.CURRENT_LIMIT_NEGATIVE))
    return tuple(key for key in found if key is not None)


def current_scales(drives: WatchedDrives) -> tuple[Key, ...]:
    """Return the objects that scale a drive's current: the motor's peak and nominal current, or empty."""
    found = (drives.description.role(role) for role in (Role.PEAK_CURRENT, Role.NOMINAL_CURRENT))
    return tuple(key for key in found if key is not None)


def counts_per_limit(drives: WatchedDrives) -> Floats:
    """Return the counts of 6077h per count of the current limit: 1 unless it is relative to the nominal current."""
    key, ampere = drives.description.role(Role.NOMINAL_CURRENT), _ampere(drives)
    if key is None:
        return np.ones(drives.num_axes)
    return np.asarray(read_own(drives, key, 0) * 1e-6 / np.where(ampere > 0.0, ampere, np.inf), float)


def _current(drives: WatchedDrives, user: Floats) -> Integers:
    """Return the highest current [counts of 6077h]: the user's, or the drive's (the lower one of its two signs)."""
    counts, keys = counts_per_limit(drives), current_limits(drives)
    found = [_magnitude(drives, user, key, counts) for key in keys] or [_magnitude(drives, user, None)]
    return np.asarray(np.min(found, axis=0), np.int64)


REST_TURNS, REST_INCREMENTS = 0.15, 2000.0  # rev/s, inc/s: a velocity filter may show this of a rotor at rest


def _own_range(drives: WatchedDrives) -> tuple[Integers, Integers]:
    """Return 607Dh corrected by the home offset (CiA 402); without a limit if the range is empty."""
    low, high = read_own(drives, POSITION_LOW, -NO_LIMIT), read_own(drives, POSITION_HIGH, NO_LIMIT)
    # The ends of the type are the factory's default, not limits.
    empty = low >= high
    offset = read_own(drives, HOME_OFFSET, 0)
    return (
        np.where(empty | (low <= -(2**31)), -NO_LIMIT, low - offset),
        np.where(empty | (high >= 2**31 - 1), NO_LIMIT, high - offset),
    )


def read_own(drives: WatchedDrives, key: Key, absent: int) -> Integers:
    """Return an object of every axis; `absent` if the drive lacks or refuses it, even if its EDS lists it."""
    if drives.description.has(key):
        with contextlib.suppress(RefusedError):
            found: Integers = drives.read_entry(drives.description.dictionary.find(key))
            return found
    return np.full(drives.num_axes, absent, np.int64)


def _at_scale(user: Floats, now: Floats) -> Floats:
    """Return the user's limit in whole counts of the present scale; unconverted if the scale is unknown."""
    return np.where(np.isfinite(now), np.maximum(np.floor(now + 1e-6), 1.0), user)


def _magnitude(drives: WatchedDrives, user: Floats, key: Key | None, counts: Floats | float = 1.0) -> Integers:
    """Return the user's limit, otherwise the drive's; NO_LIMIT if that is 0 or the end of its type.

    One count of the drive's limit is `counts` counts of the user's.
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
    """Return the increments per second (or second squared) of a count of a speed (or an acceleration); nan if unknown.

    Args:
        unit: The unit's name in the EDS.
        rotor: Gives the increments per revolution; 1 and less if unknown.
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
    """Return 6084h [inc/s^2], or 6083h if 6084h is 0."""
    down = _rate(drives, DECELERATION, rotor)
    return np.where(down > 0.0, down, _rate(drives, ACCELERATION, rotor))


def _rate(drives: WatchedDrives, key: Key, rotor: RotorAngle) -> Floats:
    """Return a deceleration [inc/s^2]; 0 if the drive has none or its unit is unknown."""
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
    """Return the deceleration of a ramp of vl [inc/s^2]; 0 if ramp or scale is missing, infinite if its time is 0.

    Args:
        drives: The drives.
        keys: The ramp's objects: a speed and a time in s; if its speed is 0, that of 604Eh counts.
        rotor: Gives their scale.
        written: Values about to be written to some of these objects, (num_axes,) each.
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
    """Return the deceleration of a quick stop [inc/s^2]: 6085h, or 604Ah or 6051h in vl if set; 0 if unknown."""
    ramp = _rate(drives, QUICK_STOP_DECELERATION, rotor)
    if in_vl is None:
        return ramp
    own = read_vl_rate(drives, VL_QUICK_STOP, rotor)
    return np.where(in_vl & (own > 0.0), np.where(np.isfinite(own), own, 0.0), ramp)
