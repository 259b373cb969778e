"""Checks of a program's writes and played rows against the limits, before they are sent."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.position_scale import TURN_INSIDE
from drive_env.dictionary.roles import Role
from drive_env.drives.limits import DEFAULT_SPEED, NO_LIMIT, given
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import (
    QUICK_STOP_DECELERATION,
    SLACK_TURNS,
    counts_per_limit,
    current_limits,
    current_scales,
    increments_per_count,
    read_own,
    read_vl_rate,
    speed_in,
    unit_of,
)
from drive_env.safety.errors import SafetyError
from drive_env.safety.limits_in_force import STOP_WITHIN, LimitsInForce, bound_text
from drive_env.safety.objects import (
    CONTROLWORD,
    CSV,
    DEMAND,
    HM,
    HOMING_SPEED_TO_SWITCH,
    HOMING_SPEED_TO_ZERO,
    INTERPOLATED_POSITION,
    LED_MODES,
    MODE,
    MOVING_SPEEDS,
    POSITION,
    POSITION_OFFSET,
    POSITIONING_OPTIONS,
    PP,
    PROFILE_VELOCITY,
    RUNNING_SPEEDS,
    TARGET_POSITION,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    TORQUE_OFFSET,
    UNRAMPED_MODES,
    VELOCITY_OFFSET,
    VL,
    VL_BRAKING,
    VL_QUICK_STOP,
    VL_REFERENCE,
    VL_TARGET,
    is_one_of,
)
from drive_env.safety.rotor import scale_objects
from drive_env.safety.stop_ends import LATENCY, outside, profile_way, ramp_way
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


# Objects whose magnitude is a command, and the limit that applies to it.
_MAGNITUDES = {
    TARGET_VELOCITY: "velocity",
    VL_TARGET: "velocity",
    PROFILE_VELOCITY: "velocity",
    HOMING_SPEED_TO_SWITCH: "velocity",
    HOMING_SPEED_TO_ZERO: "velocity",
    VELOCITY_OFFSET: "velocity",
    TARGET_TORQUE: "current",
    TORQUE_OFFSET: "current",
}
# Set-points that are added.
_PARTNERS = {
    TARGET_VELOCITY: VELOCITY_OFFSET,
    VELOCITY_OFFSET: TARGET_VELOCITY,
    TARGET_TORQUE: TORQUE_OFFSET,
    TORQUE_OFFSET: TARGET_TORQUE,
}


class Commands:
    """The set-points of some drives, and the checks of each command against the limits.

    Args:
        drives: The drives.
        axes: Their present state.
        limits: The limits in force.
        modes: Returns the mode of operation of every axis.
    """

    def __init__(self, drives: WatchedDrives, axes: Axes, limits: LimitsInForce, modes: Callable[[], Integers]) -> None:
        self._drives = drives
        self._known = drives.description.dictionary
        self._current_limits = current_limits(drives)
        self._is_stepped = drives.description.role(Role.MICROSTEPS) is not None
        self._scale_objects = scale_objects(drives.description)
        self._current_scales = current_scales(drives)
        self._axes = axes
        self._limits = limits
        self._modes = modes
        role = drives.description.role
        # Objects other than the controlword that enable: mask and value of the bits that do it.
        self._enables = {role(Role.SERVICE_COMMAND): (3, 1), role(Role.NATIVE_CONTROL): (2, 2)}
        self._target_inside = drives.description.role(Role.TARGET_INSIDE)
        self._set_points: dict[Key, Integers] = {}  # as written or read last

    def check_write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Raise SafetyError for a value that would pass a limit, or redefine positions at the wrong time."""
        self._check_value(entry, raw, where)
        self._check_meaning(entry, where)

    def check_play(self, played: Mapping[Entry, Integers], words: Integers | None) -> None:
        """Raise SafetyError for rows that would pass a limit; `words` are the controlwords among them."""
        has_target = self._drives.description.has(TARGET_POSITION)
        relative = has_target and words is not None and bool(np.any(words & cia402.RELATIVE))
        for entry, rows in played.items():
            key = (entry.index, entry.sub)
            if rows.shape[0] == 0:
                continue
            self._check_meaning(entry, self._axes.everywhere, is_played=True)
            if self._is_other_target(key):
                self._check_position(entry, self._target(key, rows), self._axes.everywhere, (PP, *LED_MODES))
            elif key in (TARGET_POSITION, POSITION_OFFSET):
                if not relative:
                    self._check_sum(entry, rows, played)
            elif key == MODE:
                self.check_modes(self._axes.everywhere, rows, played)  # other rows may enable
            elif key != CONTROLWORD:
                self._check_value(entry, rows, self._axes.everywhere, played)
        if relative:
            assert words is not None
            self._check_played_moves(words, played)

    def _is_other_target(self, key: Key) -> bool:
        """Return whether an object is a target position other than 607Ah."""
        return key in (INTERPOLATED_POSITION, self._target_inside)

    def _target(self, key: Key, raw: Integers) -> Integers:
        """Convert targets of another object than 607Ah to increments of 6064h, as counted now."""
        if key == INTERPOLATED_POSITION:
            return raw
        actual = self._drives.description.role(Role.POSITION_INSIDE)
        assert actual is not None, "a drive with a target inside has it"
        scale = self._axes.rotor.scale / TURN_INSIDE
        # 6064h is the lower 32 bits of the drive's internal position; the turns above are not readable.
        above = read_own(self._drives, actual, 0) * scale - read_own(self._drives, POSITION, 0)
        return np.rint(raw * scale - 2.0**32 * np.rint(above / 2.0**32)).astype(np.int64)

    def note(self, key: Key, raw: Integers, where: Mask) -> None:
        """Note a set-point that was written."""
        if self._is_other_target(key):
            self.forget(TARGET_POSITION)
            self._axes.led = np.where(where, math.nan, self._axes.led)
            return
        self._set_points[key] = np.where(where, raw, self._set_points.get(key, 0))
        if key in (TARGET_POSITION, POSITION_OFFSET):
            led = where & self._axes.live & is_one_of(self._axes.mode, LED_MODES)
            other = self._set_points.get(POSITION_OFFSET if key == TARGET_POSITION else TARGET_POSITION, 0)
            self._axes.led = np.where(led, self._set_points[key] + other, self._axes.led)
        if key in _PARTNERS:
            self.note_running(where, (key,))

    def note_running(self, where: Mask, keys: tuple[Key, ...] = (TARGET_VELOCITY, TARGET_TORQUE)) -> None:
        """Note that axes act on their stored set-points of speed and torque, by default on both."""
        for key in keys:
            asked = self._set_points.get(key, 0) + self._set_points.get(_PARTNERS[key], 0)
            if _MAGNITUDES[key] == "velocity":
                self._axes.asked_speed = np.where(where, asked * self._speed_count(), self._axes.asked_speed)
            else:
                self._axes.asked_current = np.where(where, asked, self._axes.asked_current)

    def _speed_count(self) -> Floats:
        """Return the increments per second of a count of 60FFh; 0 if its unit is unknown."""
        return np.nan_to_num(increments_per_count(unit_of(self._drives.description, TARGET_VELOCITY), self._axes.rotor))

    def forget(self, key: Key | None = None) -> None:
        """Forget a set-point, all by default, after a node reset or where the last write may not have arrived."""
        if key is None:
            self._set_points.clear()
        else:
            self._set_points.pop(key, None)

    def note_start(self, words: Integers, where: Mask) -> None:
        """Note the target of each move in pp that a controlword has started."""
        starts = where & cia402.may_enable(words) & (words & cia402.NEW_SET_POINT != 0) & (self._axes.mode == PP)
        target = self._set_points.get(TARGET_POSITION)
        for axis in np.flatnonzero(starts).tolist() if target is not None else ():
            base = self._axes.aim.get(axis, int(self._axes.position[axis])) if words[axis] & cia402.RELATIVE else 0
            self._axes.aim[axis] = base + int(target[axis])  # type: ignore[index]
            self._axes.moves[axis] = True

    def check_start(self, words: Integers, where: Mask) -> None:
        """Check a move when it is started: only then is it known whether it is relative, and how fast it will be."""
        starts = where & cia402.may_enable(words) & (words & cia402.NEW_SET_POINT != 0)
        bounds = self._limits.bounds()
        if not starts.any():
            return
        self._check_speeds(starts, self._modes(), MOVING_SPEEDS, bounds.velocity)
        if not bounds.has_position:
            return
        starts &= self._modes() == PP
        if not starts.any():
            return
        target = self._known.find(TARGET_POSITION)
        distance = self._drives.read_entry(target)
        self._set_points[TARGET_POSITION] = distance
        relative = words & cia402.RELATIVE != 0
        self._check_position(target, distance, starts & ~relative, (PP,))
        if np.any(starts & relative):
            for base in self._bases():
                self._check_position(target, base + distance, starts & relative, (PP,))

    def check_played_starts(self, words: Integers, played: Mapping[Entry, Integers]) -> None:
        """Raise SafetyError for moves that rows start at a speed, already set in the drive, beyond the limit."""
        starts = (cia402.may_enable(words) & (words & cia402.NEW_SET_POINT != 0)).any(axis=0)
        if starts.any():
            self._check_speeds(starts, self._modes(), MOVING_SPEEDS, self._limits.bounds().velocity, played)

    def _bases(self) -> list[Integers]:
        """Return the possible bases of relative moves (60F2h): the previous target, the demand, the actual position."""
        options = read_own(self._drives, POSITIONING_OPTIONS, 0) & 3
        demand = read_own(self._drives, DEMAND, 0)
        aims = np.array(
            [self._axes.aim.get(axis, int(demand[axis])) for axis in range(self._drives.num_axes)], np.int64
        )
        if not options.any():
            return [demand, aims]
        return [demand, aims, read_own(self._drives, POSITION, 0)]

    def _check_played_moves(self, words: Integers, played: Mapping[Entry, Integers]) -> None:
        """Check moves that rows start, each relative to the previous one."""
        bounds = self._limits.bounds()
        if not bounds.has_position:
            return
        target = self._known.find(TARGET_POSITION)
        now = self._drives.read_entry(target)
        rows = next((r for e, r in played.items() if e is target), np.broadcast_to(now, words.shape))
        rises = (words & cia402.NEW_SET_POINT != 0) & np.vstack(
            [np.ones((1, words.shape[1]), bool), words[:-1] & cia402.NEW_SET_POINT == 0]
        )
        relative = words & cia402.RELATIVE != 0
        absolute = np.where(rises & ~relative, rows, self._axes.position)
        self._check_position(target, absolute, self._axes.everywhere, (PP,))
        steps = np.where(rises & relative, rows, 0)
        for base in self._bases():
            self._check_position(target, base + np.cumsum(steps, axis=0), (rises & relative).any(axis=0), (PP,))

    def _check_sum(self, entry: Entry, rows: Integers, played: Mapping[Entry, Integers]) -> None:
        """Check the sum of target and offset in csp; in pp the target alone."""
        by_key = {(other.index, other.sub): values for other, values in played.items()}
        if (entry.index, entry.sub) == POSITION_OFFSET and TARGET_POSITION in by_key:
            return  # checked with the target
        target = by_key.get(TARGET_POSITION, self._last(TARGET_POSITION))
        offset = by_key.get(POSITION_OFFSET, self._last(POSITION_OFFSET))
        aim = target + offset
        if aim.shape != rows.shape:
            aim = np.broadcast_to(aim, rows.shape)
        self._check_position(entry, aim, self._axes.everywhere, LED_MODES)
        self._check_jumps(entry, aim, self._axes.everywhere)
        if (entry.index, entry.sub) == TARGET_POSITION:
            self._check_position(entry, rows, self._axes.everywhere, (PP,))

    def _check_value(
        self, entry: Entry, raw: Integers, where: Mask, played: Mapping[Entry, Integers] | None = None
    ) -> None:
        key = (entry.index, entry.sub)
        if key in self._enables and np.any((raw & self._enables[key][0] == self._enables[key][1]) & where):
            raise SafetyError(
                f"{entry.label} enables a motor beside the controlword, where limits and stops of this program do not "
                "reach it; nothing was sent. Enable by 6040h"
            )
        if self._is_other_target(key):
            self._check_position(entry, self._target(key, raw), where, LED_MODES)
        elif key in (TARGET_POSITION, POSITION_OFFSET):
            other = self._last(POSITION_OFFSET if key == TARGET_POSITION else TARGET_POSITION)
            if key == TARGET_POSITION or is_one_of(self._modes(), LED_MODES).any():
                self._check_position(entry, raw + other, where, LED_MODES)
                self._check_jumps(entry, raw + other, where)
        elif key == QUICK_STOP_DECELERATION:
            self._check_braking(entry, raw, where)
        elif key in VL_BRAKING:
            self._check_vl_braking(entry, raw, where)
        elif key == MODE:
            self.check_modes(where & self._axes.may_turn, raw)
            self._check_mode_room(raw, where & self._axes.live)
        else:
            self._check_magnitude(entry, raw, where, played or {})

    def _check_meaning(self, entry: Entry, where: Mask, *, is_played: bool = False) -> None:
        """Raise SafetyError for a write that would change the meaning of positions or currents at the wrong time."""
        key = (entry.index, entry.sub)
        holds = is_played or np.any(where & self._axes.may_turn) or self._limits.user.current is not None
        if key in self._current_scales and holds:
            raise SafetyError(
                f"{entry.label} changes the scale of currents, and the axis is enabled or Limits(current=...) hold; "
                "nothing was sent. Disable it, and write it without that limit"
            )
        moves_scale = key in self._scale_objects
        if moves_scale and is_played:
            raise SafetyError(f"{entry.label} changes the scale of positions, and is not played; write it")
        if moves_scale and np.any(where & self._axes.may_turn):
            raise SafetyError(
                f"{entry.label} changes the scale of positions, and the axis is enabled; nothing was sent. Disable "
                "it first"
            )
        hints = self._drives.description.hints
        if key in hints.unchecked_motion and (is_played or np.any(where & self._axes.may_turn)):
            raise SafetyError(
                f"{entry.label} changes speeds, ramps, counts or commutation past the checked objects of CiA 402, and "
                "the axis is enabled; nothing was sent. Disable it first, or write 60FFh, 6081h, 6083h or 6084h"
            )
        if key in hints.turns_positions_round and self._limits.user.position is not None:
            raise SafetyError(
                f"{entry.label} turns positions round, and Limits(position=...) hold for the present direction; "
                "nothing was sent. Write it without them, then open the drives with limits"
            )

    def _check_position(self, entry: Entry, aim: Integers, axes: Mask, modes: tuple[int, ...]) -> None:
        """Raise SafetyError for an aim, or rows of aims, beyond the limits of an axis in one of the modes."""
        bounds = self._limits.bounds()
        if not bounds.has_position:
            return
        outside = (aim < bounds.low) | (aim > bounds.high)
        if not outside.any():
            return
        # Reading the mode costs an SDO transfer (half a millisecond of a policy's cycle): only where it matters.
        rows, outside = np.atleast_2d(aim), np.atleast_2d(outside)
        if (wrong := np.flatnonzero(axes & outside.any(axis=0) & is_one_of(self._modes(), modes))).size:
            axis = int(wrong[0])
            farthest = rows[outside[:, axis], axis][0]
            origin = self._limits.origin(self._limits.user.position, "position", "607Dh")
            raise SafetyError(
                f"axis {axis}: {entry.label} would lead to {farthest}, beyond the limits "
                f"{bound_text(bounds.low[axis])} to {bound_text(bounds.high[axis])}; nothing was sent. Choose a target "
                f"inside (an axis that stands outside comes back in pp or pv), or widen {origin}"
            )

    def _check_jumps(self, entry: Entry, aim: Integers, axes: Mask) -> None:
        """Raise SafetyError for set-points of csp that jump faster than a stepper may turn.

        A stepper's field follows the set-point: after a jump the motor has lost steps, and its position is unknown.
        """
        if not self._is_stepped or not np.any(axes & self._axes.live):
            return
        bounds, led = self._limits.bounds(), self._axes.led
        begin = np.where(np.isnan(led), self._axes.position, led)
        jump = np.abs(np.diff(np.vstack([begin, np.atleast_2d(aim)]), axis=0)).max(axis=0)
        limit = np.nan_to_num(bounds.velocity * bounds.count, nan=np.inf)
        cycle = self._drives.description.cycle
        if np.all(jump <= limit * cycle):
            return
        period = np.maximum(self._interpolation_period(), cycle)
        wrong = axes & self._axes.live & (jump > limit * period) & is_one_of(self._modes(), LED_MODES)
        for axis in np.flatnonzero(wrong).tolist():
            raise SafetyError(
                f"axis {axis}: {entry.label} would jump by {jump[axis]:.0f} increments within "
                f"{1e3 * period[axis]:g} ms, {jump[axis] / period[axis]:.0f} a second, beyond the limit "
                f"{limit[axis]:.0f}: a stepper loses steps by it; nothing was sent. Lead it there in "
                f"smaller steps, or raise {self._velocity_origin(axis)}"
            )

    def _interpolation_period(self) -> Floats:
        """Return the time of interpolation between set-points of csp [s]; 0 if the drive does not report it."""
        value, index = (read_own(self._drives, (cia402.INTERPOLATION_PERIOD, sub), 0) for sub in (1, 2))
        return np.asarray(value * 10.0 ** index.astype(float), float)

    def _check_mode_room(self, modes: Integers, axes: Mask) -> None:
        """Raise SafetyError for a position mode in which an axis would not come to rest within its travel.

        In such a mode the demand is ahead of the axis, and pp without a set-point brakes by its profile's ramp. Homing
        begins from rest, since its moves cannot be checked in advance: an axis on its way to a distant set-point would
        be stopped for its speed, by a ramp longer than that way.
        """
        bounds, speed = self._limits.bounds(), self._axes.newest_speed()
        if not (bounds.has_position and axes.any()):
            return
        ramp = np.where(modes == PP, profile_way(bounds, speed), ramp_way(bounds, speed) + speed * bounds.lag)
        beyond = outside(bounds, self._axes.position + ramp)
        wrong = axes & is_one_of(modes, (PP, *LED_MODES)) & (np.abs(speed) > bounds.rest)
        wrong &= beyond > np.maximum(outside(bounds, self._axes.position), bounds.slack)
        behind = np.abs(np.nan_to_num(self._axes.led - self._axes.position)) > bounds.slack
        distant = behind & is_one_of(self._axes.mode, LED_MODES)
        moves = axes & (modes == HM) & ((np.abs(ramp) > bounds.slack) | distant)
        for axis in np.flatnonzero(moves & (self._modes() != modes)).tolist():
            raise SafetyError(
                f"axis {axis}: homing begins from rest, and it moves by {abs(speed[axis]):.0f} increments a second or "
                "is on its way to a set-point; nothing was sent. Bring it to rest first"
            )
        for axis in np.flatnonzero(wrong & (self._modes() != modes)).tolist():
            raise SafetyError(
                f"axis {axis}: in mode {modes[axis]} it would come to rest {beyond[axis]:.0f} increments beyond the "
                f"limits {bound_text(bounds.low[axis])} to {bound_text(bounds.high[axis])}, from its "
                f"{abs(speed[axis]):.0f} increments a second; nothing was sent. Slow it down first"
            )

    def _check_braking_room(self, entry: Entry, value: Integers, where: Mask) -> None:
        """Raise SafetyError for a set-point of csv from whose speed a quick stop would end outside the travel."""
        bounds, axes = self._limits.bounds(), self._axes
        if not bounds.has_position:
            return
        speed = np.atleast_2d(value)[0] * self._speed_count()
        faster = (np.abs(speed) > np.abs(axes.asked_speed)) | (speed * axes.asked_speed < 0.0)
        end = axes.position + ramp_way(bounds, speed) + speed * LATENCY
        beyond = outside(bounds, end)
        wrong = where & axes.live & faster & (beyond > np.maximum(outside(bounds, axes.position), bounds.slack))
        if not wrong.any():
            return
        for axis in np.flatnonzero(wrong & (self._modes() == CSV)).tolist():
            raise SafetyError(
                f"axis {axis}: from {entry.label} = {np.atleast_2d(value)[0][axis]} a quick stop would end "
                f"{beyond[axis]:.0f} increments beyond the limits {bound_text(bounds.low[axis])} to "
                f"{bound_text(bounds.high[axis])}; nothing was sent. Choose less, raise 6085h, or widen "
                f"{self._limits.origin(self._limits.user.position, 'position', '607Dh')}"
            )

    def _check_magnitude(self, entry: Entry, raw: Integers, where: Mask, played: Mapping[Entry, Integers]) -> None:
        key = (entry.index, entry.sub)
        if key in self._current_limits:
            limit, raw = self._own_current_limit(), np.floor(raw * counts_per_limit(self._drives)).astype(np.int64)
        elif key in _MAGNITUDES:
            limit = getattr(self._limits.bounds(), _MAGNITUDES[key])
            limit = self._speed_in(key, limit) if _MAGNITUDES[key] == "velocity" else limit
        else:
            return
        name = _MAGNITUDES.get(key, "current")
        partner = _PARTNERS.get(key)
        value = raw
        if partner is not None:
            added = next((rows for e, rows in played.items() if (e.index, e.sub) == partner), self._last(partner))
            value = raw + added
        if key in (TARGET_VELOCITY, VELOCITY_OFFSET):
            self._check_braking_room(entry, value, where)
        above = np.maximum(np.abs(raw), np.abs(value)) > limit
        if not above.any():
            return
        shown = np.where(np.abs(raw) > np.abs(value), raw, value)  # one alone may exceed the limit, the sum not
        rows, above = np.atleast_2d(np.broadcast_to(shown, above.shape)), np.atleast_2d(above)
        wrong = np.flatnonzero(where & above.any(axis=0))
        if wrong.size:
            axis = int(wrong[0])
            largest = rows[above[:, axis], axis][0]
            remedy = self._velocity_origin(axis) if name == "velocity" else self._current_origin(key)
            raise SafetyError(
                f"axis {axis}: {entry.label} = {largest} is beyond the limit {limit[axis]}; nothing was sent. Choose "
                f"less, or raise {remedy}"
            )

    def _speed_in(self, key: Key, limit: NDArray[Any]) -> NDArray[Any]:
        """Convert a speed limit [counts of the object that shows the speed] to counts of another object."""
        return speed_in(key, limit, self._limits.bounds(), self._drives, self._axes.rotor)

    def _own_current_limit(self) -> Integers:
        """Return the highest value allowed for the drive's own current limit: the user's limit, or unlimited."""
        user = given(self._limits.user.current, self._drives.num_axes)
        return np.where(np.isnan(user) | np.isinf(user), NO_LIMIT, np.nan_to_num(user, posinf=0.0)).astype(np.int64)

    def _check_braking(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Raise SafetyError for a ramp that is too slow to stop an axis that is turning."""
        count = increments_per_count(entry.unit, self._axes.rotor)
        where = where & ~np.isnan(count)
        if not where.any():
            return
        raw = np.atleast_2d(raw).min(axis=0)
        ramp: Floats = np.asarray(raw * np.nan_to_num(count), float)
        self._check_stops_turning(entry, raw, ramp, where)
        axes = where & self._axes.may_turn
        if np.any(slow := axes & (ramp < self._unramped_ramp())):
            self._refuse_mode(slow & is_one_of(self._modes(), UNRAMPED_MODES), ramp)
        in_vl = np.any(read_vl_rate(self._drives, VL_QUICK_STOP, self._axes.rotor) > 0.0)  # vl has its own ramp
        modes = np.where(in_vl & (self._modes() == VL), 0, self._modes())
        self._check_speeds(axes, modes, {**RUNNING_SPEEDS, **MOVING_SPEEDS}, raw * STOP_WITHIN)

    def _check_vl_braking(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Raise SafetyError for a quick-stop ramp in vl that is too slow to stop an axis that is turning."""
        key = entry.index, entry.sub
        raw = np.atleast_2d(raw)
        raw = raw.min(axis=0) if key in (VL_QUICK_STOP[0], VL_REFERENCE) else raw.max(axis=0)
        ramp = read_vl_rate(self._drives, VL_QUICK_STOP, self._axes.rotor, {key: raw})
        where = where & (self._modes() == VL) & np.isfinite(ramp)
        self._check_stops_turning(entry, raw, ramp, where)
        count = np.nan_to_num(self._limits.bounds().count, nan=1.0)
        limit = np.floor(np.where(where, ramp, 0.0) * STOP_WITHIN / count + 1e-6).astype(np.int64)
        self._check_speeds(where & self._axes.may_turn, self._modes(), {VL: RUNNING_SPEEDS[VL]}, limit)

    def _check_stops_turning(self, entry: Entry, raw: Integers, ramp: Floats, where: Mask) -> None:
        """Raise SafetyError for a ramp [inc/s^2] that does not stop a turning axis within STOP_WITHIN."""
        wrong = np.flatnonzero(where & self._axes.live & (ramp * STOP_WITHIN < np.abs(self._axes.velocity)))
        if wrong.size:
            axis = int(wrong[0])
            raise SafetyError(
                f"axis {axis}: {entry.label} = {raw[axis]} would not stop it within {STOP_WITHIN:g} s from its "
                f"{abs(self._axes.velocity[axis]):.0f} pps; nothing was sent. Choose more, or stop it first"
            )

    def check_modes(
        self, axes: Mask, modes: Integers | None = None, played: Mapping[Entry, Integers] | None = None
    ) -> None:
        """Raise SafetyError for axes that would be too fast in their mode as soon as they are enabled.

        The speeds stored in the drive are checked against the limit. Torques and set-points of csp have no such speed:
        only a quick stop's ramp of sufficient size brings the axis to rest, so that ramp is checked instead.

        Args:
            axes: Axes that may be enabled.
            modes: The modes that they will have; their present modes by default.
            played: Rows played with them, which are checked separately.
        """
        if not axes.any():
            return
        now = np.atleast_2d(self._modes() if modes is None else modes)
        bounds = self._limits.bounds()
        self._check_resolution(axes)
        known, key = self._drives.description, QUICK_STOP_DECELERATION
        if known.has(key):
            slow = axes & ~np.isnan(self._ramp_count()) & (bounds.braking < self._unramped_ramp())
            self._refuse_mode(slow & is_one_of(now, UNRAMPED_MODES).any(axis=0), bounds.braking)
        for row in np.unique(now, axis=0):
            self._check_speeds(axes, row, RUNNING_SPEEDS, bounds.velocity, played)

    def check_turning(self, axes: Mask) -> None:
        """Raise SafetyError for axes that turn while switched off, faster than their limit once enabled.

        An axis that coasts or is pulled has a speed that no set-point shows, and a quick stop's ramp may be too slow
        for it.
        """
        if not axes.any():
            return
        bounds = self._limits.bounds()
        shows = self._axes.velocity_object
        speed = np.abs(read_own(self._drives, shows, 0))
        wrong = axes & ((speed > bounds.velocity) | (np.abs(self._axes.speed) > bounds.speed))
        for axis in np.flatnonzero(wrong).tolist():
            raise SafetyError(
                f"axis {axis}: it turns though it is off, {speed[axis]} by {shows[0]:04X}h, beyond the limit "
                f"{int(bounds.velocity[axis])}; it was not enabled. Wait until it is slower, or raise "
                f"{self._velocity_origin(axis)}"
            )

    def _check_resolution(self, axes: Mask) -> None:
        """Raise SafetyError for axes whose positions are too coarse for their travel to be watched."""
        scale = self._axes.rotor.scale
        coarse = axes & self._limits.bounds().given & self._axes.has_scale & (scale * SLACK_TURNS < 1.0)
        for axis in np.flatnonzero(coarse).tolist():
            keys = scale_objects(self._drives.description)
            names = ", ".join(f"{index:04X}h" for index in dict.fromkeys(index for index, _ in keys))
            raise SafetyError(
                f"axis {axis}: a revolution has {scale[axis]:g} increments ({names}), too few to monitor its travel; "
                f"nothing was sent. Set {1.0 / SLACK_TURNS:.0f} or more, or open the drives without position limits"
            )

    def _check_speeds(
        self,
        axes: Mask,
        modes: Integers,
        speeds: Mapping[int, tuple[tuple[Key, ...], ...]],
        limit: NDArray[Any],
        played: Mapping[Entry, Integers] | None = None,
    ) -> None:
        """Raise SafetyError for axes whose drive has, for their mode, a stored speed beyond the limit."""
        played_keys = {(entry.index, entry.sub) for entry in played or {}}
        for mode, sums in speeds.items():
            if not np.any(chosen := axes & (modes == mode)):
                continue
            for keys in sums:
                if played_keys & set(keys):
                    continue
                value = sum((read_own(self._drives, key, 0) for key in keys), np.zeros(len(axes), np.int64))
                most = self._speed_in(keys[0], limit)
                for axis in np.flatnonzero(chosen & (np.abs(value) > most)).tolist():
                    names = " + ".join(self._known.find(key).label for key in keys if self._drives.description.has(key))
                    raise SafetyError(
                        f"axis {axis}: its drive has {names} = {value[axis]}, beyond the limit {int(most[axis])}; "
                        f"nothing was sent. Write less there first, or raise {self._velocity_origin(axis)}"
                    )

    def _unramped_ramp(self) -> Floats:
        """Return the slowest quick-stop ramp allowed in modes without a speed limit [inc/s^2]."""
        scale = self._axes.rotor.scale
        return np.where(scale > 1.0, DEFAULT_SPEED * scale / STOP_WITHIN, 0.0)

    def _ramp_count(self) -> Floats:
        """Return the increments per second squared of a count of 6085h; nan if its unit is unknown."""
        return increments_per_count(self._known.find(QUICK_STOP_DECELERATION).unit, self._axes.rotor)

    def _refuse_mode(self, wrong: Mask, ramp: Integers | Floats) -> None:
        for axis in np.flatnonzero(wrong).tolist():
            count = self._ramp_count()[axis]
            raise SafetyError(
                f"axis {axis}: nothing limits the speed in ip, csp, tq or cst, and a quick stop's ramp of 6085h = "
                f"{ramp[axis] / count:.0f} is too slow for it; nothing was sent. Have 6085h at "
                f"{math.ceil(self._unramped_ramp()[axis] / count)} or more, or choose another mode"
            )

    def _current_origin(self, key: Key) -> str:
        is_its_own = not self._current_limits or key in self._current_limits
        own = "the drive's" if is_its_own else f"{self._current_limits[0][0]:04X}h"
        return self._limits.origin(self._limits.user.current, "current", own)

    def _velocity_origin(self, axis: int) -> str:
        bounds = self._limits.bounds()
        by_ramp = bounds.braking[axis] * STOP_WITHIN / np.nan_to_num(bounds.count[axis], nan=1.0)
        if 0.0 < by_ramp <= bounds.velocity[axis] + 1e-6:
            own = next((key[0] for key in VL_BRAKING[::2] if self._drives.description.has(key)), None)
            in_vl = "" if own is None else f" (in vl {own:04X}h)"
            return f"the quick stop's ramp, 6085h: no axis may be faster than it{in_vl} stops within {STOP_WITHIN:g} s"
        if bounds.default_speed[axis]:
            return "Limits(velocity=...): this drive has no limit of its own; 6,000 rpm is used"
        return self._limits.origin(self._limits.user.velocity, "velocity", "607Fh")

    def _last(self, key: Key) -> Integers:
        if key not in self._set_points:
            self._set_points[key] = read_own(self._drives, key, 0)
        return self._set_points[key]
