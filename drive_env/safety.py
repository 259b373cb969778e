"""The envelope around whatever acts on drives of a bus: limits, an oscillation detector, stops.

Three lines of defence, each for the failure of the one before:
- what the program commands is refused before it is sent (`before_write`, `before_play`);
- what the drives do is watched at every SYNC, and they are quick-stopped (`observe`);
- a program that stalls is noticed by a thread, one that dies by the drive itself (`master/lifeline.py`).

A program that touches no limit sees the same integers with the envelope and without.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.access import ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.master.bounds import (
    FOLLOWING_WINDOW,
    MAX_PROFILE_VELOCITY,
    NO_LIMIT,
    POSITION_HIGH,
    POSITION_LOW,
    Bounds,
    Limits,
    read_bounds,
)
from drive_env.master.description import Key
from drive_env.master.errors import BusError
from drive_env.master.lifeline import ErrorControl, Lifeline
from drive_env.master.oscillation import SWING, SWING_WINDOW, SWINGS, Swings

if TYPE_CHECKING:
    from drive_env.can_drives import CanDrives

logger = logging.getLogger(__name__)

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

CONTROLWORD, STATUSWORD, MODE_DISPLAY = (0x6040, 0), (0x6041, 0), (0x6061, 0)
TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE = (0x607A, 0), (0x60FF, 0), (0x6071, 0)
PROFILE_VELOCITY = (0x6081, 0)
POSITION, DEMAND, VELOCITY, CURRENT = (0x6064, 0), (0x6062, 0), (0x606C, 0), (0x6077, 0)

ENABLE_OPERATION, QUICK_STOP, DISABLE_VOLTAGE = 0x0F, 0x02, 0x00
NEW_SET_POINT, RELATIVE = 0x10, 0x40
PP, HM, CSP = 1, 6, 8
OPERATION_ENABLED, QUICK_STOP_ACTIVE = (0x6F, 0x27), (0x6F, 0x07)

STOP_TIMEOUT = 2.0  # for the ramp of a quick stop [s]
# A current above its limit is no accident until it lasts: noise and overshoot are within this.
CURRENT_MARGIN, CURRENT_CYCLES = 1.25, 10


class SafetyError(RuntimeError):
    """The envelope refused a command, or stopped the drives; the message names value, limit and remedy."""


class Envelope:
    """The limits at work on some drives.

    Args:
        limits: What the program may do.
        drives: The drives.
    """

    def __init__(self, limits: Limits, drives: CanDrives) -> None:
        self.limits = limits
        self._drives = drives
        self._known = drives.description.dictionary
        self._current_limit = drives.description.hints.current_limit
        self._bounds: Bounds | None = None
        self._watched: tuple[Bounds, list[Entry]] | None = None
        self._everywhere = np.ones(drives.num_axes, bool)
        self._enabled = np.zeros(drives.num_axes, bool)  # watched
        self._live = np.zeros(drives.num_axes, bool)  # to be switched off at the end
        self._mode = np.zeros(drives.num_axes, np.int64)
        self._outside = np.full(drives.num_axes, -1, np.int64)  # how far when enabled, or since; -1: not seen yet
        self._over_current = np.zeros(drives.num_axes, np.int64)
        self._swings = [Swings() for _ in range(drives.num_axes)]
        self._controls: list[ErrorControl] = []
        self._lifeline: Lifeline | None = None

    # --- what CanDrives calls -------------------------------------------------------------------------------------
    def enter(self) -> None:
        """Take note that the program does something; raise SafetyError once after it had stalled."""
        if self._lifeline is None:
            return
        self._lifeline.alive()
        stalled, self._lifeline.stalled_for = self._lifeline.stalled_for, None
        if stalled is not None:
            self._enabled[:] = False
            raise SafetyError(
                f"the drives were quick-stopped: the program made no call for {stalled:.2f} s with an axis enabled; "
                f"the limit is {self.limits.stall:g} s; disable the drives before long work, or set Limits(stall=...)"
            )

    def alive(self) -> None:
        """Take note that the program waits for an answer."""
        if self._lifeline is not None:
            self._lifeline.alive()

    def before_write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Raise SafetyError for a value that would pass a limit; make ready for motion before an enabling write."""
        key = (entry.index, entry.sub)
        if key == CONTROLWORD and np.any(_enables(raw) & where):
            self._arm()
            self._check_start(raw, where)
        elif key == TARGET_POSITION:
            self._check_position(entry, raw, where, (CSP,))
        else:
            self._check_magnitude(entry, raw, where)

    def after_write(self, entry: Entry, raw: Integers, where: Mask) -> None:
        """Take note of what was written."""
        key = (entry.index, entry.sub)
        if key == CONTROLWORD:
            begins = where & _enables(raw) & ~self._enabled
            self._outside = np.where(begins, -1, self._outside)
            self._enabled = np.where(where, _enables(raw), self._enabled)
            self._live = np.where(where, _enables(raw), self._live)
            self._watch()
        elif key in (POSITION_LOW, POSITION_HIGH, FOLLOWING_WINDOW, MAX_PROFILE_VELOCITY, self._current_limit):
            self._bounds = None

    def before_play(self, played: Mapping[Entry, Integers]) -> None:
        """Raise SafetyError for rows that would pass a limit."""
        words = next((rows for entry, rows in played.items() if (entry.index, entry.sub) == CONTROLWORD), None)
        if words is not None and np.any(_enables(words)):
            self._arm()
        for entry, rows in played.items():
            if rows.shape[0] == 0:
                continue
            if (entry.index, entry.sub) == TARGET_POSITION:
                relative = words is not None and np.any(words & RELATIVE)
                if not relative:
                    self._check_position(entry, rows, self._everywhere, (PP, CSP))
            else:
                self._check_magnitude(entry, rows, self._everywhere)

    def after_play(self, played: Mapping[Entry, Integers]) -> None:
        """Take note of what was played."""
        for entry, rows in played.items():
            self.after_write(entry, rows[-1], self._everywhere)

    def after_reset(self, nodes: Sequence[int]) -> None:
        """Take note that nodes, by position, were reset: their axes are off and their error control is their own."""
        per_node = self._drives.description.num_axes
        for k in nodes:
            self._enabled[k * per_node : (k + 1) * per_node] = False
            self._live[k * per_node : (k + 1) * per_node] = False
            if self._controls:
                self._controls[k].forget()
        self._bounds = None
        self._disarm()

    def watched(self) -> list[Entry]:
        """Return what is to be sampled at every SYNC, the most important first: the same list while limits are."""
        bounds = self._limits_now()
        if self._watched is not None and self._watched[0] is bounds:
            return self._watched[1]
        keys = []
        if np.any(bounds.current < NO_LIMIT):
            keys.append(CURRENT)
        if bounds.has_position or np.any(bounds.following < NO_LIMIT):
            keys.append(POSITION)
        if np.any(bounds.velocity < NO_LIMIT):
            keys.append(VELOCITY)
        if np.any(bounds.following < NO_LIMIT):
            keys.append(DEMAND)
        entries = [self._known.find(key) for key in keys if self._drives.description.has(key)]
        self._watched = (bounds, [entry for entry in entries if entry.pdo_mappable])
        return self._watched[1]

    def observe(self, rows: Mapping[Key, Integers]) -> None:
        """Look at samples, each object of shape (rows, num_axes); quick-stop and raise SafetyError beyond a limit."""
        self.alive()
        if not self._enabled.any():
            return
        bounds = self._limits_now()
        if VELOCITY in rows:
            fastest = np.abs(rows[VELOCITY]).max(axis=0)
            self._trip(fastest, bounds.velocity, VELOCITY, "lower the profile velocity or the target")
        if POSITION in rows and bounds.has_position:
            self._observe_position(rows[POSITION], bounds)
        if POSITION in rows and DEMAND in rows:
            self._observe_following(rows[DEMAND] - rows[POSITION], bounds)
        if CURRENT in rows:
            self._observe_current(rows[CURRENT], bounds)

    def stop(self, reason: str) -> None:
        """Quick-stop what is enabled, wait for the ramp, and switch the voltage off; failures are logged.

        A second Ctrl-C ends the waiting.
        """
        if not self._live.any():
            return
        logger.warning("stopping the drives: %s", reason)
        axes = self._live
        self._live, self._enabled = np.zeros_like(axes), np.zeros_like(axes)
        self._each(axes, lambda axis: self._command(axis, QUICK_STOP))
        self._each(axes, self._end_ramp)
        self._each(axes, lambda axis: self._command(axis, DISABLE_VOLTAGE))
        self._watch()

    def close(self) -> None:
        """Stop what is enabled, end the lifeline and put the drives' error control back."""
        self.stop("the drives are closed while enabled")
        # Before the heartbeats end: a drive that waits for them would stop meanwhile, and answer no more.
        for control in self._controls:
            with _logged():
                control.restore()
        self._disarm()

    # --- commands -------------------------------------------------------------------------------------------------
    def _check_start(self, words: Integers, where: Mask) -> None:
        """Check the target of a move in pp when it is started: only then is it known whether it is relative."""
        starts = where & _enables(words) & (words & NEW_SET_POINT != 0)
        bounds = self._limits_now()
        if not bounds.has_position or not starts.any():
            return
        starts &= self._modes() == PP
        if not starts.any():
            return
        target = self._known.find(TARGET_POSITION)
        aim = self._drives.read_entry(target)
        relative = words & RELATIVE != 0
        if np.any(starts & relative):
            aim = np.where(relative, aim + self._drives.read_entry(self._known.find(DEMAND)), aim)
        self._check_position(target, aim, starts, (PP,))

    def _check_position(self, entry: Entry, aim: Integers, axes: Mask, modes: tuple[int, ...]) -> None:
        """Raise SafetyError for an aim, or rows of aims, beyond the limits of an axis in one of the modes."""
        bounds = self._limits_now()
        if not bounds.has_position:
            return
        outside = (aim < bounds.low) | (aim > bounds.high)
        if not outside.any():
            return
        # The mode is an SDO transfer away, half a millisecond of a policy's cycle: asked for only where it matters.
        rows, outside = np.atleast_2d(aim), np.atleast_2d(outside)
        if (wrong := np.flatnonzero(axes & outside.any(axis=0) & np.isin(self._modes(), modes))).size:
            axis = int(wrong[0])
            farthest = rows[outside[:, axis], axis][0]
            raise SafetyError(
                f"axis {axis}: {entry.label} would lead to {farthest}, beyond the limits {_text(bounds.low[axis])} to "
                f"{_text(bounds.high[axis])}; nothing was sent. Choose a target inside, or widen "
                f"{self._origin(self.limits.position, 'position', '607Dh')}"
            )

    def _check_magnitude(self, entry: Entry, raw: Integers, where: Mask) -> None:
        key = (entry.index, entry.sub)
        bounds = self._limits_now() if key in _MAGNITUDES or key == self._current_limit else None
        if bounds is None:
            return
        if key == self._current_limit:
            if self.limits.current is None:
                return
            name, own = "current", "the drive's"
        else:
            name = _MAGNITUDES[key]
            own = f"{self._current_limit[0]:04X}h" if name == "current" else "607Fh"
        limit = getattr(bounds, name)
        above = np.abs(raw) > limit
        if not above.any():
            return
        rows, above = np.atleast_2d(raw), np.atleast_2d(above)
        wrong = np.flatnonzero(where & above.any(axis=0))
        if wrong.size:
            axis = int(wrong[0])
            largest = rows[above[:, axis], axis][0]
            raise SafetyError(
                f"axis {axis}: {entry.label} = {largest} is beyond the limit {limit[axis]}; nothing was sent. Choose "
                f"less, or raise {self._origin(getattr(self.limits, name), name, own)}"
            )

    def _origin(self, given: Any, name: str, own: str) -> str:
        return f"Limits({name}=...)" if given is not None else f"the drive's own limit, {own}"

    # --- samples --------------------------------------------------------------------------------------------------
    def _observe_position(self, position: Integers, bounds: Bounds) -> None:
        if ((position >= bounds.low) & (position <= bounds.high)).all():
            self._outside[:] = 0
            return
        below = np.where(bounds.low > -NO_LIMIT, bounds.low - position, 0)
        above = np.where(bounds.high < NO_LIMIT, position - bounds.high, 0)
        outside = np.maximum(np.maximum(below, above), 0)
        # An axis that was enabled outside may come back, though not go further out.
        self._outside = np.where(self._outside < 0, outside[0], self._outside)
        allowed = np.maximum(self._outside, 0) + _POSITION_SLACK
        farthest = outside.max(axis=0)
        self._outside = np.minimum(self._outside, outside[-1])
        wrong = (farthest > allowed) & self._enabled
        if wrong.any() and np.any(wrong & (self._modes() != HM)):
            axis = int(np.flatnonzero(wrong)[0])
            self._stop_for(
                f"axis {axis}: the position is {farthest[axis]} beyond the limits {_text(bounds.low[axis])} to "
                f"{_text(bounds.high[axis])}",
                f"move it back, or widen {self._origin(self.limits.position, 'position', '607Dh')}",
            )

    def _observe_following(self, error: Integers, bounds: Bounds) -> None:
        wrapped = (error + 2**31) % 2**32 - 2**31  # positions count on past the end of their type
        largest: Integers = np.abs(wrapped).max(axis=0)
        # The mode is an SDO transfer away: asked for only where it matters.
        if not np.any(self._enabled & (largest > bounds.following)):
            return
        follows = np.isin(self._modes(), (PP, CSP))
        self._trip(
            np.where(follows, largest, 0),
            bounds.following,
            DEMAND,
            "move more gently, or tune the loops, or raise "
            + self._origin(self.limits.following_error, "following_error", "6065h"),
            "the following error",
        )

    def _observe_current(self, current: Integers, bounds: Bounds) -> None:
        above = np.abs(current) > CURRENT_MARGIN * bounds.current
        if above.any():
            self._count_over_current(current, above, bounds)
        else:
            self._over_current[:] = 0
        if not self.limits.oscillation:
            return
        for axis in map(int, np.flatnonzero(self._enabled & (bounds.current < NO_LIMIT))):
            swings, threshold = self._swings[axis], SWING * float(bounds.current[axis])
            for value in current[:, axis].tolist():
                if swings.count(value, threshold) >= SWINGS:
                    self._swings[axis] = Swings()
                    self._stop_for(
                        f"axis {axis} oscillates: its current swung {SWINGS} times past plus and minus "
                        f"{threshold:.0f} within {SWING_WINDOW} cycles",
                        "lower the velocity loop's gains, or set Limits(oscillation=False) for an excitation",
                    )

    def _count_over_current(self, current: Integers, above: Mask, bounds: Bounds) -> None:
        for row, too_high in zip(current, above, strict=True):
            self._over_current = np.where(too_high, self._over_current + 1, 0)
            late = np.flatnonzero(self._enabled & (self._over_current >= CURRENT_CYCLES))
            if late.size:
                axis = int(late[0])
                self._stop_for(
                    f"axis {axis}: the current is {row[axis]} for {CURRENT_CYCLES} cycles, and its limit is "
                    f"{bounds.current[axis]}",
                    "check the current loop's gains 2041h and the motor's wiring",
                )

    def _trip(self, value: Integers, limit: Integers, key: Key, remedy: str, what: str | None = None) -> None:
        wrong = np.flatnonzero(self._enabled & (value > limit))
        if wrong.size:
            axis = int(wrong[0])
            name = what or self._known.find(key).label
            self._stop_for(f"axis {axis}: {name} is {value[axis]}, and its limit is {limit[axis]}", remedy)

    def _stop_for(self, what: str, remedy: str) -> None:
        self._quick_stop()
        self._enabled[:] = False
        self._watch()
        raise SafetyError(f"{what}: the drives were quick-stopped; {remedy}")

    # --- limits ---------------------------------------------------------------------------------------------------
    def _limits_now(self) -> Bounds:
        if self._bounds is None:
            self._bounds = read_bounds(self.limits, self._drives)
        return self._bounds

    def _modes(self) -> Integers:
        if self._drives.description.has(MODE_DISPLAY):
            self._mode = self._drives.read_entry(self._known.find(MODE_DISPLAY))
        return self._mode

    # --- stops ----------------------------------------------------------------------------------------------------
    def _arm(self) -> None:
        """Make ready for motion: nodes operational, limits read, the drives watching over this process."""
        self._drives.start()
        self._limits_now()
        if self._lifeline is not None or self._drives.time_waits or self.limits.silence is None:
            return
        if not self._controls:
            self._controls = [
                ErrorControl(node, self._drives.sdo(k), self._drives.description, self.limits.silence)
                for k, node in enumerate(self._drives.nodes)
            ]
        for control in self._controls:
            control.configure()
        self._lifeline = Lifeline(
            self._drives.port,
            self._controls,
            self._drives.nodes,
            self.limits.silence,
            self.limits.stall,
            self._quick_stop,
        )
        self._lifeline.start()

    def _disarm(self) -> None:
        if self._lifeline is not None:
            self._lifeline.close()
            self._lifeline = None

    def _watch(self) -> None:
        if self._lifeline is not None:
            self._lifeline.watch(bool(self._enabled.any()))

    def _quick_stop(self) -> None:
        """Send quick stop to every enabled axis without waiting for an answer: this may be the lifeline's thread."""
        entry = self._known.find(CONTROLWORD)
        per_node = self._drives.description.num_axes
        for axis in np.flatnonzero(self._enabled):
            node, part = divmod(int(axis), per_node)
            index, sub = self._drives.description.key(entry, part)
            self._drives.sdo(node).send_request(bytes((0x2B, index & 0xFF, index >> 8, sub, QUICK_STOP, 0, 0, 0)))

    def _command(self, axis: int, word: int) -> None:
        self._drives.write_axis(self._known.find(CONTROLWORD), axis, word)

    def _end_ramp(self, axis: int) -> None:
        """Wait until the axis has left its ramp: it is off, or stands still in quick stop active."""
        status, velocity = self._known.find(STATUSWORD), self._known.find(VELOCITY)
        slow = None
        for _ in range(round(STOP_TIMEOUT / self._drives.description.cycle)):
            word = self._drives.read_axis(status, axis)
            if not any(word & mask == value for mask, value in (OPERATION_ENABLED, QUICK_STOP_ACTIVE)):
                return
            speed = abs(self._drives.read_axis(velocity, axis))
            slow = max(speed // 100, 1) if slow is None else slow
            if word & QUICK_STOP_ACTIVE[0] == QUICK_STOP_ACTIVE[1] and speed <= slow:
                return
            self._drives.pass_cycle()
        logger.error("axis %d is still turning %g s after its quick stop: voltage off", axis, STOP_TIMEOUT)

    def _each(self, axes: Mask, act: Callable[[int], None]) -> None:
        for axis in np.flatnonzero(axes):
            with _logged():
                act(int(axis))


@contextlib.contextmanager
def swinging_allowed(drives: Any) -> Iterator[None]:
    """Have the envelope of drives, if they have one, take current that swings for intended; its other limits stay."""
    envelope = getattr(drives, "safety", None)
    if envelope is None:
        yield
        return
    limits = envelope.limits
    envelope.limits = replace(limits, oscillation=False)
    try:
        yield
    finally:
        envelope.limits = limits


# Objects whose magnitude is a command, and which limit holds it.
_MAGNITUDES = {
    TARGET_VELOCITY: "velocity",
    PROFILE_VELOCITY: "velocity",
    (0x60B1, 0): "velocity",
    TARGET_TORQUE: "current",
    (0x60B2, 0): "current",
}
_POSITION_SLACK = 200  # [inc]; a settled axis swings by some counts around its target


def _enables(words: Integers) -> Any:
    """Return where a controlword enables operation (or keeps it so)."""
    return (words & 0x8F) == ENABLE_OPERATION


def _text(bound: Any) -> str:
    return "(none)" if abs(int(bound)) >= NO_LIMIT else str(int(bound))


@contextlib.contextmanager
def _logged() -> Any:
    """Log what fails while stopping, and go on: the other axes must be stopped, too."""
    try:
        yield
    except (BusError, ObjectAccessError) as error:
        logger.error("%s", error)
