"""Checks of samples against the limits: speed, position, following error, current and its swings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NoReturn

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import Bounds
from drive_env.safety.limits_in_force import LimitsInForce, bound_text
from drive_env.safety.objects import CURRENT, DEMAND, HM, LED_MODES, POSITION, PP, STATUSWORD, is_one_of
from drive_env.safety.oscillation import SWING, SWING_WINDOW, SWINGS, Swings
from drive_env.safety.rotor import wrapped
from drive_env.safety.stop_ends import StopEnds, by_position, ends_by_itself, is_led, sees_demand
from mechanics.arrays import Floats, Integers, Mask

# A current above its limit is an accident only if it lasts: noise and overshoot are shorter.
CURRENT_MARGIN, CURRENT_CYCLES = 1.25, 10
MODE_SETTLES = 0.05  # s after a mode was written, during which a drive may ignore commands


class Judging:
    """Checks whether samples are within the limits.

    Args:
        known: The drives' objects.
        axes: Their present state.
        limits: The limits in force.
        modes: Returns the mode of operation of every axis.
        stop_for: Stops the drives, and raises SafetyError with the cause and a remedy.
        mode_gate: The manufacturer's mode object, if the drive ignores commands unless it matches the mode of
            operation; else None.
    """

    def __init__(
        self,
        known: ObjectDictionary,
        axes: Axes,
        limits: LimitsInForce,
        modes: Callable[[], Integers],
        stop_for: Callable[[str, str], NoReturn],
        mode_gate: Entry | None = None,
    ) -> None:
        self._known = known
        self._axes = axes
        self._limits = limits
        self._modes = modes
        self._stop_for = stop_for
        self._mode_gate = mode_gate
        count = len(axes.everywhere)
        self._over_current = np.zeros(count, np.int64)
        self._stop_ends = StopEnds(axes)
        self._swings = [Swings() for _ in range(count)]

    def judge(self, rows: Mapping[Key, Integers], judged: Mask) -> None:
        """Compare samples, each object of shape (rows, num_axes), with the limits of some axes."""
        if not judged.any():
            return
        bounds = self._limits.bounds()
        if (shows := self._axes.velocity_object) in rows:
            fastest = np.abs(rows[shows]).max(axis=0)
            self._trip(judged, fastest, bounds.velocity, shows, "lower the profile velocity or the target")
        if POSITION in rows:
            self._judge_speed(judged, bounds)
        self._stop_ends.take(rows, bounds)
        if POSITION in rows and bounds.has_position:
            self._judge_position(judged, rows[POSITION], bounds)
        if POSITION in rows and DEMAND in rows:
            self._judge_following(judged, rows[DEMAND] - rows[POSITION], bounds)
        if CURRENT in rows:
            self._judge_current(judged, rows[CURRENT], bounds)

    def judge_heard(self, rows: Mapping[Key, Integers], were_judged: Mask) -> None:
        """Stop axes that no longer take commands because another program has changed one of their modes.

        Such an axis may stop or run on: the drive's manual may not say which.

        Args:
            rows: Samples, each object of shape (rows, num_axes).
            were_judged: Axes that were live, and not stopping, before these samples or by them.
        """
        if self._mode_gate is None or STATUSWORD not in rows:
            return
        ignores = np.any(rows[STATUSWORD] & cia402.REMOTE.mask != cia402.REMOTE.value, axis=0)
        settled = self._axes.now() - self._axes.mode_written > MODE_SETTLES
        for axis in np.flatnonzero(were_judged & ignores & settled).tolist():
            self._stop_for(
                f"axis {axis} has ceased to take commands (bit 9 of 6041h is 0): {self._mode_gate.label} does not fit "
                "its mode of operation",
                "end what has changed either, another master or the service program, then enable again",
            )

    def _judge_speed(self, judged: Mask, bounds: Bounds) -> None:
        """Check speeds computed from positions, for drives whose own unit of speed is unknown."""
        if (wrong := np.flatnonzero(judged & (np.abs(self._axes.speed) > bounds.speed))).size:
            axis = int(wrong[0])
            self._stop_for(
                f"axis {axis} turns by {abs(self._axes.speed[axis]):.0f} increments a second, and its limit is "
                f"{bounds.speed[axis]:.0f} (6,000 rpm of the rotor, or what its travel allows)",
                "lower the profile velocity or the target",
            )

    def _judge_position(self, judged: Mask, position: Integers, bounds: Bounds) -> None:
        ends = np.stack([position[-1] + way for way in self._ways(bounds)])
        low, high = (
            np.minimum(position.min(axis=0), ends.min(axis=0)),
            np.maximum(position.max(axis=0), ends.max(axis=0)),
        )
        if ((low >= bounds.low) & (high <= bounds.high)).all():
            self._axes.outside[:] = 0
            return
        below = np.where(bounds.low > -NO_LIMIT, bounds.low - position, 0)
        above = np.where(bounds.high < NO_LIMIT, position - bounds.high, 0)
        outside = np.maximum(np.maximum(below, above), 0)
        will_be = np.maximum(
            np.where(bounds.low > -NO_LIMIT, bounds.low - low, 0),
            np.where(bounds.high < NO_LIMIT, high - bounds.high, 0),
        )
        # An axis that was enabled outside its limits may come back, but not go further out.
        self._axes.outside = np.where(self._axes.outside < 0, outside[0], self._axes.outside)
        slack = np.where(will_be > outside.max(axis=0), bounds.slack, bounds.settled)
        allowed = self._axes.outside + slack
        farthest = np.maximum(outside.max(axis=0), will_be)
        self._axes.outside = np.minimum(self._axes.outside, outside[-1])
        wrong = (farthest > allowed) & judged
        if wrong.any() and np.any(wrong & (bounds.given | (self._modes() != HM))):
            axis = int(np.flatnonzero(wrong & (bounds.given | (self._axes.mode != HM)))[0])
            there = outside.max(axis=0)[axis] > bounds.settled[axis] + self._axes.outside[axis]
            what = "the position is" if there else "its stop would end"
            by = outside.max(axis=0)[axis] if there else farthest[axis]
            self._stop_for(
                f"axis {axis}: {what} {int(by)} increments beyond the limits {bound_text(bounds.low[axis])} to "
                f"{bound_text(bounds.high[axis])}",
                f"move it back, or widen {self._limits.origin(self._limits.user.position, 'position', '607Dh')}",
            )

    def _ways(self, bounds: Bounds) -> tuple[Floats, Floats]:
        """Return how far the axes go on if stopped now [inc]: by their actual speed, and by their commanded speed."""
        axes, speed = self._axes, self._stop_ends.speed
        own, asked = self._stop_ends.ways(bounds)
        # An axis that ends at its set-point needs only the way of its profile's steepest ramp, not that of a stop.
        known = bounds.profile > 0.0
        profile = np.sign(speed) * speed**2 / (2.0 * np.where(known, bounds.profile, 1.0)) * known
        ends = ends_by_itself(axes, bounds)
        led = is_led(axes)
        own = np.where(ends | (led & ~sees_demand(axes)), profile, own)
        own = np.where(led & ends, 0.0, own)
        return own, np.where(by_position(axes), own, asked)

    def _judge_following(self, judged: Mask, error: Integers, bounds: Bounds) -> None:
        largest: Integers = np.abs(wrapped(error)).max(axis=0)
        # Reading the mode costs an SDO transfer: only where it matters.
        if not np.any(judged & (largest > bounds.following)):
            return
        follows = is_one_of(self._modes(), (PP, *LED_MODES))
        self._trip(
            judged,
            np.where(follows, largest, 0),
            bounds.following,
            DEMAND,
            "move more gently, or tune the loops, or raise "
            + self._limits.origin(self._limits.user.following_error, "following_error", "6065h"),
            "the following error",
        )

    def _judge_current(self, judged: Mask, current: Integers, bounds: Bounds) -> None:
        above = np.abs(current) > CURRENT_MARGIN * bounds.current
        if above.any():
            self._count_over_current(judged, current, above, bounds)
        else:
            self._over_current[judged] = 0
        if not self._limits.user.oscillation:
            return
        for axis in map(int, np.flatnonzero(judged & (bounds.current < NO_LIMIT))):
            swings, threshold = self._swings[axis], SWING * float(bounds.current[axis])
            for value in current[:, axis].tolist():
                if swings.count(value, threshold) >= SWINGS:
                    self._swings[axis] = Swings()
                    self._stop_for(
                        f"axis {axis} oscillates: its current swung {SWINGS} times past plus and minus "
                        f"{threshold:.0f} within {SWING_WINDOW} cycles",
                        "lower the velocity loop's gains, or set Limits(oscillation=False) for an excitation",
                    )

    def _count_over_current(self, judged: Mask, current: Integers, above: Mask, bounds: Bounds) -> None:
        for row, too_high in zip(current, above, strict=True):
            self._over_current = np.where(judged, np.where(too_high, self._over_current + 1, 0), self._over_current)
            late = np.flatnonzero(judged & (self._over_current >= CURRENT_CYCLES))
            if late.size:
                axis = int(late[0])
                self._stop_for(
                    f"axis {axis}: the current is {row[axis]} for {CURRENT_CYCLES} cycles, and its limit is "
                    f"{bounds.current[axis]}",
                    "check the gains of the current loop and the motor's wiring",
                )

    def _trip(
        self, judged: Mask, value: Integers, limit: Integers, key: Key, remedy: str, what: str | None = None
    ) -> None:
        wrong = np.flatnonzero(judged & (value > limit))
        if wrong.size:
            axis = int(wrong[0])
            name = what or self._known.find(key).label
            self._stop_for(f"axis {axis}: {name} is {value[axis]}, and its limit is {limit[axis]}", remedy)
