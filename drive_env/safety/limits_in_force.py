"""The limits in force: the user's, as rotor positions, and the drives' own; the tighter ones are lent to the drives."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from drive_env.cia402 import Key
from drive_env.drives.limits import NO_LIMIT, Limits
from drive_env.fieldbus.errors import RefusedError
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import (
    FOLLOWING_WINDOW,
    MAX_MOTOR_SPEED,
    MAX_PROFILE_VELOCITY,
    POSITION_HIGH,
    POSITION_LOW,
    Bounds,
    RotorLimits,
    counts_per_limit,
    current_limits,
    read_bounds,
    read_own,
    rotor_limits,
    speed_in,
)
from drive_env.safety.lending import Lending
from drive_env.safety.objects import POSITION, VL, VL_BRAKING, VL_MAX
from drive_env.safety.rotor import HOME_OFFSET, read_ratios, read_scale
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


STOP_WITHIN = 1.0  # s from the highest allowed speed by the quick stop's ramp; a slower ramp lowers that speed


def bound_text(bound: np.int64) -> str:
    """Return one end of a range as text for a message."""
    return "(none)" if abs(int(bound)) >= NO_LIMIT else str(int(bound))


class LimitsInForce:
    """The limits of the axes at their present scale and zero.

    Args:
        user: The user's limits.
        drives: The drives.
        axes: Their present state.
        lending: Lends the drives limits that are tighter than their own.

    Attributes:
        user: The user's limits.
        latest: The limits as last read; None after a change of an object that they depend on.
    """

    def __init__(self, user: Limits, drives: WatchedDrives, axes: Axes, lending: Lending) -> None:
        self.user = user
        self.latest: Bounds | None = None
        self._generation = 0
        self._must_place = False  # before the next use of a limit
        self._drives = drives
        self._axes = axes
        self._lending = lending
        self._has_vl_ramp = any(drives.description.has(key) for key in VL_BRAKING)
        self._in_vl = np.zeros(drives.num_axes, bool)  # when the limits were last read
        self._of_rotors = self._capture()

    def change(self, user: Limits) -> None:
        """Replace the user's limits, converted to revolutions at the present scale and zero."""
        self.user = user
        self._of_rotors = self._capture()
        self.forget()
        if self._axes.is_armed:
            self.lend()

    def forget(self) -> None:
        """Have the limits read anew before their next use."""
        self._generation += 1
        self.latest = None

    def keep_place(self) -> None:
        """Keep the rotor angles before an object is written that changes the scale; `place` is called after it."""
        position, scale = read_own(self._drives, POSITION, 0), read_scale(self._drives)
        ratios = read_ratios(self._drives)
        with self._axes.lock:
            self._axes.rotor.ratio, self._axes.rotor.set_point_ratio = ratios
            self._axes.place(position, scale)
            self._axes.keep_place()

    def place_again(self) -> None:
        """Have the rotor angles read anew before a limit is used: the scale of a drive may have changed."""
        self._must_place = True
        self.forget()

    def _capture(self) -> RotorLimits:
        """Return the user's limits in revolutions, at the present scale and zero."""
        user = self.user
        if not self._drives.description.has(POSITION):
            for name, value in (("position", user.position), ("following_error", user.following_error)):
                if value is not None:
                    raise ValueError(
                        f"Limits({name}=...): the drive shows no position (it has no 6064h), so that nothing could be "
                        "held against it; leave it out, and give Limits(velocity=...)"
                    )
        if not (user.position is None and user.velocity is None and user.following_error is None):
            self.place()
        return rotor_limits(user, self._drives, self._axes.rotor, self._axes.position)

    def place(self) -> None:
        """Read positions and scales; a change of scale or zero has not moved the rotors."""
        position = read_own(self._drives, POSITION, 0)
        scale, ratios = read_scale(self._drives), read_ratios(self._drives)
        with self._axes.lock:
            self._axes.rotor.ratio, self._axes.rotor.set_point_ratio = ratios
            self._axes.place(position, scale)
            self._must_place = False
            self.forget()
        if self._axes.is_armed:
            self.lend()

    def bounds(self) -> Bounds:
        """Return the limits of every axis as integers of its drive; the drives' own where the user gave none."""
        bounds, generation = self.latest, self._generation
        if self._has_vl_ramp and np.any(self._in_vl != (self._axes.mode == VL)):
            bounds, self._in_vl = None, self._axes.mode == VL
        if bounds is None:
            if self._must_place or not self._axes.rotor.is_placed:
                self.place()
            in_vl = self._in_vl if self._has_vl_ramp else None
            bounds = read_bounds(self.user, self._drives, self._axes.rotor, self._of_rotors, in_vl)
            # The limit is a whole number of counts, except for rounding if it is in rpm.
            counts = np.floor(bounds.braking * STOP_WITHIN / np.nan_to_num(bounds.count, nan=1.0) + 1e-6)
            ramp = np.where(bounds.braking > 0.0, counts, float(NO_LIMIT))
            bounds.velocity = np.minimum(bounds.velocity, np.minimum(ramp, float(NO_LIMIT)).astype(np.int64))
            if generation == self._generation:  # otherwise something changed while another thread's answers were read
                self.latest = bounds
                self._axes.speed_count = bounds.count
        return bounds

    def lend(self) -> None:
        """Lend the drives the limits that are tighter than their own."""
        bounds = self.bounds()
        offset = self._last_offset()
        wanted: dict[Key, tuple[Floats, bool]] = {}
        if self.user.position is not None:
            wanted[POSITION_LOW] = (
                np.where(bounds.low > -NO_LIMIT, bounds.low - bounds.slack + offset, -math.inf),
                False,
            )
            wanted[POSITION_HIGH] = (
                np.where(bounds.high < NO_LIMIT, bounds.high + bounds.slack + offset, math.inf),
                True,
            )
        counts = counts_per_limit(self._drives)
        in_its_unit = np.where(bounds.current < NO_LIMIT, np.floor(bounds.current / counts), NO_LIMIT)
        for key, limit, highest in (
            *((key, self.user.current, in_its_unit) for key in current_limits(self._drives)),
            (FOLLOWING_WINDOW, self.user.following_error, bounds.following),
            (MAX_PROFILE_VELOCITY, self.user.velocity, bounds.velocity),
        ):
            if limit is not None:
                wanted[key] = (np.where(highest < NO_LIMIT, highest, math.inf), True)
        if self.user.velocity is not None:
            most = speed_in(VL_MAX, bounds.velocity, bounds, self._drives, self._axes.rotor)
            wanted[VL_MAX] = (np.where(most < NO_LIMIT, most, math.inf), True)
        if self.user.velocity is not None and self._axes.is_counted and np.all(self._axes.rotor.scale > 1.0):
            wanted[MAX_MOTOR_SPEED] = (np.ceil(60.0 * bounds.velocity / self._axes.rotor.scale), True)
        for key, (value, is_upper) in wanted.items():
            if self._drives.description.has(key):
                for axis in range(self._drives.num_axes):
                    self._lend_one(key, axis, float(value[axis]), is_upper)

    def _lend_one(self, key: Key, axis: int, limit: float, is_upper: bool) -> None:
        entry = self._drives.description.dictionary.find(key)
        assert entry.low is not None and entry.high is not None, "a limit is a number"
        try:
            own = int(self._drives.read_axis(entry, axis))
        except RefusedError:  # the EDS lists an object that the drive lacks: the envelope alone monitors this limit
            return
        switched_off = own == 0 and key in (FOLLOWING_WINDOW, MAX_PROFILE_VELOCITY, MAX_MOTOR_SPEED)
        # Lending one end alone could leave the range empty: the other is lent, too, if need be as its type's end.
        no_range = key in (POSITION_LOW, POSITION_HIGH) and self._has_no_range(axis)
        value = max(min(limit, float(entry.high)), float(entry.low))
        tighter = value < own if is_upper else value > own
        if no_range or ((switched_off or tighter) and math.isfinite(limit)):
            self._lending.lend(key, axis, round(value))
        elif self._lending.is_lent(key, axis):
            self._lending.lend(key, axis, own)

    def _has_no_range(self, axis: int) -> bool:
        """Return whether the range of an axis is empty, so that any travel is tighter."""
        known = self._drives.description.dictionary
        if not all(self._drives.description.has(key) for key in (POSITION_LOW, POSITION_HIGH)):
            return False
        try:
            low, high = (int(self._drives.read_axis(known.find(key), axis)) for key in (POSITION_LOW, POSITION_HIGH))
        except RefusedError:
            return False
        return low >= high

    def _last_offset(self) -> Integers:
        if self.user.position is None:
            return np.zeros(self._drives.num_axes, np.int64)
        return read_own(self._drives, HOME_OFFSET, 0)

    def origin(self, value: object, name: str, own: str) -> str:
        """Return the source of a limit, for a message: the user's `value` by `name`, or the object of the drive."""
        return f"Limits({name}=...)" if value is not None else f"the drive's own limit, {own}"
