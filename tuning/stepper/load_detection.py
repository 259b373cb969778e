"""Finds StallGuard threshold and CoolStep settings for the load of an axis by moves at the working speed.

The threshold shifts the load reading. In spread cycle the reading is nearly linear in the voltage u that a falling
phase feeds back against its current i at speed w, with the load angle d (electrical):

    u = L i n_p w + n_p psi w (cos d - sin d) - R i

The reading per volt is not published; moves at two speeds give it, since L and psi are known from the data sheet. Then
the threshold is raised until the reading at the axis' own load equals the difference between the readings at its load
angle and at `STALL_ANGLE`: the reading falls to 0 there, before the motor loses steps at 90 degrees. CoolStep lowers
the current until the load angle is `COOL_ANGLE`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np

from drive_env.devices.gain_set import GainSet
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import Drives, device_of
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from drive_env.phase_current import run_and_standby
from drive_env.trials.load_reading import (
    DOWN,
    FULL_READING,
    LEAST,
    LIFT,
    LOWER,
    SLOW,
    STALL_ANGLE,
    THRESHOLD,
    UP,
    WIDTH,
    falls,
    flux,
    has_coolstep,
    volts,
)
from drive_env.trials.working_moves import Steady, WorkingMoves
from mechanics.arrays import Floats, Integers, Mask
from tuning.stop_causes import stop_causes, told_causes

COOL_ANGLE = math.radians(30.0)  # load angle up to which CoolStep reduces the current
CLEAR = 3.0  # standard deviations that a reading must be above 0
LEAST_MARGIN = 16.0  # counts of the reading that an axis' own load must be above 0
SHARE_AT_STOP_SPEED = 0.5  # of the margin that must be left at the speed above which a stall stops the axis
LEAST_STOP_SPEED = 0.5  # of the working speed
COOL_UNIT = 32.0  # counts of the reading per step of CoolStep's thresholds
COOL_WIDTH, COOL_DOWN, COOL_UP = 2, 2, 3  # width of the band, 2 readings per step down, 8 steps up per reading below it
COOL_RAISES = 3  # of the lower threshold, if steps were lost


@dataclass
class Found:
    """The settings found for the axes, each of shape (num_axes,); nan without a result.

    per_volt: Counts of the reading per volt fed back.
    margin: Reading at the axis' own load with the threshold.
    wanted: Wanted margin.
    speed: Working speed [rad/s].
    angle: Load angle at the working speed [rad].
    stop_speed: Speed above which a stall stops the axis [rad/s].
    saved: Share of the current that CoolStep saved, computed from the load angles.
    reasons: Why axes were rejected, "" for others.
    """

    speed: Floats
    per_volt: Floats
    margin: Floats
    wanted: Floats
    angle: Floats
    stop_speed: Floats
    saved: Floats
    cooled_angle: Floats
    reasons: list[str]
    reservations: list[list[str]] = field(default_factory=list)

    @classmethod
    def nothing(cls, count: int) -> Found:
        """Return an instance without results."""
        s, a, b, c, d, e, f, g = (np.full(count, np.nan) for _ in range(8))
        return cls(s, a, b, c, d, e, f, g, [""] * count, [[] for _ in range(count)])

    def going(self) -> Mask:
        """Return which axes have not been rejected."""
        return np.array([not reason for reason in self.reasons])

    def reject(self, where: Mask, reason: str) -> None:
        """Reject axes with a reason, except those already rejected."""
        for k in map(int, np.flatnonzero(where & self.going())):
            self.reasons[k] = reason


class LoadDetection:
    """Finds the settings of drives in moves; `gains` are the drives' present ones, raw, shape (num_axes, count)."""

    def __init__(self, drives: Drives, motor: Motor, moves: WorkingMoves, gains: Integers, speed: float) -> None:
        self.gains = gains.copy()
        self.found = Found.nothing(drives.num_axes)
        self.found.speed[:] = speed
        moves.trials.acts_by_load = True  # from now on load detection is active in moves
        self._drives, self._motor, self._moves, self._speed = drives, motor, moves, speed
        self._known: GainSet = device_of(drives).gains
        self._run, _ = run_and_standby(device_of(drives), gains)

    def take(self, other: LoadDetection, where: Mask) -> None:
        """Replace the results of some axes by those of other moves."""
        self.gains = np.where(where[:, None], other.gains, self.gains)
        self._run = np.where(where, other._run, self._run)
        for row in fields(Found):
            own, new = getattr(self.found, row.name), getattr(other.found, row.name)
            if isinstance(own, list):
                setattr(self.found, row.name, [b if take else a for a, b, take in zip(own, new, where, strict=True)])
            else:
                setattr(self.found, row.name, np.where(where, new, own))

    # --- the threshold ------------------------------------------------------------------------------------------------
    def find_threshold(self) -> None:
        """Set the threshold for a reading of 0 at `STALL_ANGLE`, and the speed above which a stall stops the axis."""
        found = self.found
        self._write_stop_speed(np.zeros_like(self._run))
        if has_coolstep(device_of(self._drives)):
            self._set(LOWER, np.zeros(len(self._run)))
        self._set(THRESHOLD, np.zeros(len(self._run)))
        slow = self._lifted(SLOW * self._speed)
        fast = self._run_moves(self._speed)
        found.angle = fast.angle
        given = volts(self._motor, self._run, self._speed, fast.angle) - volts(
            self._motor, self._run, SLOW * self._speed, slow.angle
        )
        found.per_volt = (fast.reading - slow.reading) / given
        found.reject(
            ~(found.per_volt > 0.0) | (fast.reading >= FULL_READING),
            "the load reading does not rise with the speed, as the back-EMF has it: it tells nothing of the load here; "
            "let the axis go faster, and check that the chopper is a spread cycle",
        )
        per_angle = found.per_volt * flux(self._motor, self._run) * self._speed
        found.wanted = per_angle * (falls(fast.angle) - falls(STALL_ANGLE))
        self._raise_threshold(fast)
        slope = (fast.reading - slow.reading) / ((1.0 - SLOW) * self._speed)
        stop = self._speed - SHARE_AT_STOP_SPEED * found.margin / slope
        found.stop_speed = np.maximum(stop, LEAST_STOP_SPEED * self._speed)
        self._write_stop_speed(np.where(found.going(), found.stop_speed, 0.0))

    def _lifted(self, speed: float) -> Steady:
        """Move at a speed with the threshold so high that no reading is 0, and return the result."""
        column = self._column(THRESHOLD)
        while True:
            steady = self._run_moves(speed)
            low = self.found.going() & (steady.lowest <= 0.0)
            highest = self._known.rows[column].highest
            self.found.reject(
                low & (self.gains[:, column] >= highest),
                f"the load reading is 0 at {speed:.3g} rad/s even with the highest threshold: too slow for the "
                "back-EMF of this motor; let the axis go faster (--travel)",
            )
            low &= self.found.going()
            if not low.any():
                return steady
            self._set(THRESHOLD, np.where(low, self.gains[:, column] + LIFT, self.gains[:, column]))

    def _raise_threshold(self, fast: Steady) -> None:
        """Find the smallest threshold with the wanted reading; one step of it shifts all readings equally."""
        found, column = self.found, self._column(THRESHOLD)
        row = self._known.rows[column]
        first = self.gains[:, column].astype(float)
        other = np.where(first + LIFT <= row.highest, first + LIFT, first - LIFT)
        self._set(THRESHOLD, other)
        per_step = (self._run_moves(self._speed).reading - fast.reading) / (other - first)
        found.reject(~(per_step > 0.0), "the load reading does not follow its threshold: check the chopper's mode")
        threshold = np.ceil(first + (found.wanted - fast.reading) / np.where(per_step > 0.0, per_step, 1.0))
        found.reject(
            threshold > row.highest,
            f"the load reading cannot be raised enough: a threshold of {row.highest} is the highest; let the axis go "
            "faster",
        )
        self._set(THRESHOLD, np.nan_to_num(threshold))
        last = self._run_moves(self._speed)
        found.margin = last.reading
        for k in map(int, np.flatnonzero(found.going())):
            if last.lowest[k] <= 0.0 or last.reading[k] < max(CLEAR * last.spread[k], LEAST_MARGIN):
                found.reasons[k] = (
                    f"the load reading of the axis' own load is {last.reading[k]:.0f}, {last.lowest[k]:.0f} at least: "
                    "too near to 0, where it would stop; raise the run current or lower the load"
                )

    # --- CoolStep -----------------------------------------------------------------------------------------------------
    def find_coolstep(self) -> None:
        """Set CoolStep so that it lowers the current of the axis' own load without a lost step, and prove it."""
        found = self.found
        counts = found.per_volt * flux(self._motor, self._run) * self._speed * (falls(COOL_ANGLE) - falls(STALL_ANGLE))
        highest = self._known.rows[self._column(LOWER)].highest
        lower = np.clip(np.ceil(np.nan_to_num(counts, nan=COOL_UNIT) / COOL_UNIT), 1, highest)
        for part, value in ((WIDTH, COOL_WIDTH), (LEAST, 0), (DOWN, COOL_DOWN), (UP, COOL_UP)):
            self._set(part, np.full(len(lower), value))
        self._write_speed(Role.COOLSTEP_SPEED, np.where(found.going(), found.stop_speed, 0.0))
        plain = self._run_moves(self._speed)
        for _ in range(COOL_RAISES):
            self._set(LOWER, np.where(found.going(), lower, 0))
            cooled = self._move(self._speed)
            failed = found.going() & (cooled.failed | (cooled.settled > STALL_ANGLE))
            if not failed.any():
                break
            self._moves.trials.recover(found.going())
            lower = np.where(failed, np.minimum(lower + 1, highest), lower)
        else:
            self._set(LOWER, np.where(failed, 0, lower))
            for k in map(int, np.flatnonzero(failed)):
                found.reservations[k].append("CoolStep is left off: with it the axis lost steps or stopped")
        found.cooled_angle = np.where(failed, np.nan, cooled.settled)
        # The torque is the same: the current falls as the sine of the load angle rises.
        found.saved = np.where(failed, np.nan, 1.0 - np.sin(plain.settled) / np.sin(cooled.settled))
        for k in map(int, np.flatnonzero(found.going() & ~failed & ~(found.saved > 0.05))):
            found.reservations[k].append(
                "CoolStep does not lower the current at the working speed: the load reading leaves it no room"
            )

    def leave_coolstep_off(self, where: Mask, why: str) -> None:
        """Switch CoolStep off, with a reservation."""
        self._set(LOWER, np.where(where, 0, self.gains[:, self._column(LOWER)]))
        for k in map(int, np.flatnonzero(where)):
            self.found.reservations[k].append(f"CoolStep is left off: {why}")
            self.found.saved[k] = np.nan

    # --- drives -------------------------------------------------------------------------------------------------------
    def prove(self) -> None:
        """Move with all settings active: reject an axis that stops or loses steps."""
        where = self.found.going()
        last = self._move(self._speed)
        self._reject_stopped(where & last.stopped, "it was stopped in a move with its own load")
        self.found.reject(where & last.lost, "it lost steps in a move with its own load")

    def _run_moves(self, speed: float) -> Steady:
        going = self.found.going()
        steady = self._move(speed)
        self.found.reject(going & steady.lost, f"it lost steps at {speed:.3g} rad/s with its run current")
        self._reject_stopped(going & steady.stopped, f"it went into fault at {speed:.3g} rad/s")
        return steady

    def _move(self, speed: float) -> Steady:
        told_causes(self._drives)  # discards earlier ones
        return self._moves.run(speed, self.found.going())

    def _reject_stopped(self, where: Mask, reason: str) -> None:
        """Reject axes that went into fault in the last move, with their drives' emergencies."""
        causes = stop_causes(self._drives) if where.any() else []
        for k in np.flatnonzero(where):
            self.found.reject(np.arange(len(where)) == k, f"{reason}: {causes[k]}")

    def _column(self, part: tuple[str, str]) -> int:
        column = self._known.column(*part)
        assert column is not None, f"a device with load detection has {' '.join(part)}"
        return column

    def _set(self, part: tuple[str, str], value: Floats) -> None:
        column = self._column(part)
        row = self._known.rows[column]
        self.gains[:, column] = np.clip(np.rint(value), row.lowest, row.highest)
        write_gains(self._drives, self.gains, self.found.going())

    def _write_stop_speed(self, speed: Floats) -> None:
        self._write_speed(Role.STALL_SPEED, speed)

    def _write_speed(self, role: Role, speed: Floats) -> None:
        drives = self._drives
        key = device_of(drives).roles[role]
        raw = np.ceil(speed * self._moves.increments * per_increment(drives, key)).astype(np.int64)
        drives.write(role, raw, where=self.found.going())
