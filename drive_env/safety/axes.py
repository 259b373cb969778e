"""State of the axes as last observed: whether each is live, its position, its speed, and when it was seen."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.safety.bounds import COUNTED, velocity_object
from drive_env.safety.objects import CURRENT, DEMAND, HM, POSITION, STATUSWORD, VELOCITY
from drive_env.safety.rotor import RotorAngle, wrapped
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from drive_env.safety.watched_drives import WatchedDrives


BASELINE = 0.008  # s, the shortest time between two positions from which a speed is computed
# A step in homing is a new zero, not a movement, if it exceeds JUMP_TURNS [rev] (at least JUMP_COUNTS [inc]) plus
# JUMP_SHARE times the step that the speed explains.
JUMP_TURNS, JUMP_COUNTS, JUMP_SHARE = 0.003, 1.5, 2.0
CURRENT_MEMORY = 0.03  # s


class Axes:
    """State of every axis as last observed; arrays have shape (num_axes,).

    Args:
        drives: The drives.

    Attributes:
        lock: Held while this state changes, and while a stop begins or takes a step.
        epoch: Grows with every controlword: samples of an earlier epoch do not show its effect.
        is_armed: Whether everything is ready for motion: watchdogs set, limits lent to the drives, every axis seen.
        live: Whether an axis may turn, by its statusword, or by a frame that could have enabled it.
        assumed: Whether an axis is taken for live until a sample of this epoch shows its state.
        in_flight: Whether an enabling frame was sent and the drive has not yet confirmed it.
        lost: Axes that could not be proved off.
        outside: The least distance outside its limits since the axis became live [inc]; -1 before the first sample.
        aim: Axis to its previous target in pp, the base of relative moves [inc].
        moves: Whether a move to `aim` was started in the present mode.
        led: The last set-point of csp in the present mode [inc]; nan before the first.
        demand: Position demand [inc].
        demand_seen: When `demand` was last received [s].
        asked_speed: The sum of the velocity set-points [inc/s]; of the next row while rows are played.
        asked_current: The sum of the torque set-points [unit of 6077h].
        velocity: As the drive reports it [inc/s].
        told_speed: As a drive with another unit of speed reports it, converted by the scale of positions [inc/s].
        speed_count: Increments a second of a count of 606Ch; nan if its unit cannot be converted.
        speed: Computed from positions [inc/s]; as reported by a drive without positions.
        has_scale: Whether the drive reports its increments per revolution.
        mean_current: Over the last 30 ms [unit of 6077h].
        seen: When the statusword was last received [s].
        mode_written: When the program last wrote the mode of operation, or the manufacturer's mode that must match it
            [s].
        clock: Time in lockstep [s].
        velocity_object: The object that shows the speed: 606Ch, or 6044h of a drive of vl alone.
        is_counted: Whether the unit of 606Ch is that of 6064h per second.
    """

    def __init__(self, drives: WatchedDrives) -> None:
        self._drives = drives
        known = drives.description
        self.velocity_object = velocity_object(known)
        self.is_counted = self.velocity_object == VELOCITY and known.has(VELOCITY)
        self.is_counted = self.is_counted and known.dictionary.find(VELOCITY).unit == COUNTED
        self._has_position = known.has(POSITION)
        count = drives.num_axes
        self.lock = threading.RLock()
        self.everywhere = np.ones(count, bool)
        self.epoch = 0
        self.is_armed = False
        self.live = np.zeros(count, bool)
        self.assumed = np.zeros(count, bool)
        self.in_flight = np.zeros(count, bool)
        self.lost: set[int] = set()
        self.status = np.zeros(count, np.int64)
        self.mode = np.zeros(count, np.int64)
        self.outside = np.full(count, -1, np.int64)
        self.aim: dict[int, int] = {}
        self.moves = np.zeros(count, bool)
        self.led = np.full(count, math.nan)
        self.demand = np.zeros(count, np.int64)
        self.asked_speed, self.asked_current = np.zeros(count), np.zeros(count)
        self.demand_seen = np.full(count, -math.inf)
        self.position = np.zeros(count, np.int64)
        self.velocity = np.zeros(count)
        self.told_speed, self.speed_count = np.zeros(count), np.full(count, math.nan)
        self.speed = np.zeros(count)
        self.mean_current = np.zeros(count)
        self.seen = np.full(count, -math.inf)
        self.mode_written = np.full(count, -math.inf)
        self.clock = 0.0
        self.rotor = RotorAngle(count)
        self._placed = np.zeros(count, bool)  # whether a position was seen
        self._kept: Floats | None = None  # rotor angles before a write that changes the scale [rev]
        self.has_scale = np.zeros(count, bool)
        self._position_time = np.full(count, -math.inf)  # of `position` [s]
        self._current_time = np.zeros(count)  # [s]
        # The position and its time from which the speed is computed.
        self._base = np.zeros(count, np.int64)
        self._base_time = np.full(count, -math.inf)
        self._step_speed = np.zeros(count)  # of the newest two positions [inc/s]
        self._was_enabled = np.zeros(count, bool)  # in the sample before

    def now(self) -> float:
        """Return the time of samples [s]: that of the cycles in lockstep, otherwise the monotonic clock's."""
        return self.clock if self._drives.time_waits else time.monotonic()

    @property
    def may_turn(self) -> Mask:
        """Which axes count as live."""
        return self.live | self.assumed

    def is_enabled(self) -> Mask:
        """Return which axes were in operation enabled when they were seen last."""
        return np.asarray(cia402.matches(self.status, cia402.OPERATION_ENABLED))

    def of_nodes(self, nodes: Sequence[int]) -> Mask:
        """Return which axes belong to nodes, by position."""
        per_node = self._drives.description.num_axes
        axes = np.zeros(self._drives.num_axes, bool)
        for k in nodes:
            axes[k * per_node : (k + 1) * per_node] = True
        return axes

    def newest_speed(self) -> Floats:
        """Return the speeds that the drives report [inc/s]: a speed from positions is some milliseconds late."""
        return np.where(np.abs(self.told_speed) > np.abs(self.velocity), self.told_speed, self.velocity)

    def assume(self, axes: Mask) -> None:
        """Count axes as live from now on: a frame that could enable them is about to be sent."""
        with self.lock:
            self.epoch += 1
            begins = axes & ~self.live
            self.outside = np.where(begins, -1, self.outside)
            self.forget_motion(begins)
            self.assumed |= axes
            self.in_flight |= axes
            self.live |= axes

    def forget_motion(self, axes: Mask) -> None:
        """Note that no position set-point moves these axes any more: the program must give a new one."""
        self.moves = self.moves & ~axes
        self.led = np.where(axes, math.nan, self.led)

    def take_for_off(self, axes: Mask) -> None:
        """Mark axes as off, once their statuswords have proved it."""
        with self.lock:
            for mask in (self.live, self.assumed, self.in_flight):
                mask &= ~axes

    def keep_place(self) -> None:
        """Keep the present rotor angles for the next `place`: samples until then may be in another scale."""
        self._kept = self.rotor.turns(self.position)

    def place(self, position: Integers, scale: Floats) -> None:
        """Store positions [inc] and scales [inc/rev] just read; a change of scale or zero has not moved the rotors.

        Args:
            position: The present values of 6064h.
            scale: Increments of a revolution; nan where the drive does not say.
        """
        turns, self._kept = self._kept, None
        if turns is None and self.rotor.is_placed and self._placed.any():
            turns = np.where(self._placed, self.rotor.turns(self.position), 0.0)
        self.has_scale = ~np.isnan(scale)
        self.rotor.place(position, np.where(self.has_scale, scale, 1.0), turns)
        self.position = position.copy()
        self._base_time[:] = -math.inf
        self._placed[:] = True

    def take(self, rows: Mapping[Key, Integers], epoch: int, where: Mask) -> bool:
        """Keep the newest samples.

        Args:
            rows: The samples, each object of shape (rows, num_axes).
            epoch: The epoch in which they were requested.
            where: The axes that they belong to.

        Returns:
            Whether homing has set a new zero, so that limits count from there.
        """
        now = self.now()
        has_new_zero = False
        if STATUSWORD in rows:
            self._was_enabled = np.where(where, self.is_enabled(), self._was_enabled)
            self.status = np.where(where, rows[STATUSWORD][-1], self.status)
            shown = cia402.is_live(self.status)
            current = where & (epoch >= self.epoch) & ~self.in_flight
            was = self.live
            self.assumed &= ~current
            self.live = np.where(where, shown | self.assumed, self.live)
            self.outside = np.where(self.live & ~was, -1, self.outside)
            if self.aim:
                for axis in np.flatnonzero(was & ~self.live):
                    self.aim.pop(int(axis), None)
            self.seen = np.where(where, now, self.seen)
        if CURRENT in rows:
            # Weighted by the time since the last sample: a run gives one row per cycle, a look one now and then.
            span = np.minimum(np.maximum(now - self._current_time, self._drives.description.cycle), CURRENT_MEMORY)
            share = np.where(where, span / CURRENT_MEMORY, 0.0)
            mean = rows[CURRENT].mean(axis=0) if len(rows[CURRENT]) > 1 else rows[CURRENT][0]
            self.mean_current += share * (mean - self.mean_current)
            self._current_time = np.where(where, now, self._current_time)
        shows = self.velocity_object
        if shows in rows and self.is_counted:
            self.velocity = np.where(where, rows[shows][-1], self.velocity).astype(float)
        elif shows in rows:
            self.told_speed = np.where(where, rows[shows][-1] * np.nan_to_num(self.speed_count), self.told_speed)
            if not self._has_position:
                self.speed = self.velocity = self.told_speed
        if DEMAND in rows:
            self.demand = np.where(where, rows[DEMAND][-1], self.demand)
            self.demand_seen = np.where(where, now, self.demand_seen)
        if POSITION in rows:
            has_new_zero = self._take_position(rows[POSITION], now, where)
        if POSITION in rows and not (shows in rows and self.is_counted):
            self.velocity = np.where(where, self.speed, self.velocity)
        return has_new_zero

    def _take_position(self, rows: Integers, now: float, where: Mask) -> bool:
        before = self.position
        self.position = np.where(where, rows[-1], self.position)
        has_new_zero = self._find_jumps(before, rows, now, where)
        self._position_time = np.where(where, now, self._position_time)
        old = where & (now - self._base_time >= BASELINE)
        span = np.maximum(now - self._base_time, BASELINE)
        speed = wrapped(self.position - self._base) / span
        known = old & np.isfinite(self._base_time) & (now - self._base_time < 10 * BASELINE)
        self.speed = np.where(known, speed, np.where(old, self.velocity, self.speed))
        self._base = np.where(old, self.position, self._base)
        self._base_time = np.where(old, now, self._base_time)
        self._placed |= where
        return has_new_zero

    def _find_jumps(self, before: Integers, rows: Integers, now: float, where: Mask) -> bool:
        """Return whether homing has set a new zero: positions jump although the rotor, and so its limits, did not move.

        Only an axis in operation enabled homes, and a step that its speed explains is a movement: an axis that
        something else accelerates in homing mode has not got a new zero.
        """
        elapsed = np.minimum(np.maximum((now - self._position_time) / len(rows), self._drives.description.cycle), 1.0)
        last = wrapped(rows[-1] - (rows[-2] if len(rows) > 1 else before))
        known_speed, self._step_speed = self._step_speed, np.where(where, last / elapsed, self._step_speed)
        homes = self.mode == HM
        if not homes.any():  # as in every cycle of a policy
            return False
        homing = where & self._placed & homes & (self.is_enabled() | self._was_enabled)
        if not homing.any():
            return False
        path: Integers = np.vstack([before, rows])
        steps = wrapped(np.diff(path, axis=0))
        before_it = np.vstack([known_speed * elapsed, steps[:-1]])  # the step before each
        speed = np.maximum(np.abs(self.velocity) * elapsed, np.abs(before_it))
        explained = np.maximum(JUMP_TURNS * self.rotor.scale, JUMP_COUNTS) + JUMP_SHARE * speed
        jumps = np.where(homing & (np.abs(steps) > explained), steps, 0).sum(axis=0)
        if not jumps.any() or not self.rotor.is_placed:
            return False
        self._step_speed = np.where(jumps != 0, known_speed, self._step_speed)
        turns = self.rotor.turns(self.position) - jumps / self.rotor.scale
        turns = np.where(jumps != 0, turns, self.rotor.turns(self.position))
        self.rotor.place(self.position, self.rotor.scale, turns)
        self._base_time = np.where(jumps != 0, -math.inf, self._base_time)
        return True
