"""One trial of StallGuard threshold and CoolStep: moves at a working speed without CoolStep, with it, and a probe.

The aims are no false stall by the axis' own load, a stall detected before steps are lost, and less current. The axis
need not be loaded for this: the load reading is nearly linear in cos d - sin d of the load angle d (`load_reading.py`),
so that a move gives the angle at which it would fall to 0; and at equal torque, the currents with and without CoolStep
are inversely proportional to the sines of their load angles. Stop on stall is off during the trial.

J is that of the open loop with these terms: settling and overshoot are 1 and 0; load angle is that with CoolStep;
effort is the current that CoolStep leaves; instead of the vibration counts the distance from `STALL_ANGLE` at which a
stall would be detected. A trial counts as stopped if steps are lost, or if the axis' own load would be detected as a
stall.
"""

from __future__ import annotations

import math

import numpy as np

from drive_env import cia402
from drive_env.devices import Device
from drive_env.devices.gain_set import LOAD_DETECTION
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import Drives, axis_number, device_of
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from drive_env.phase_current import holding_torque, run_and_standby
from drive_env.trials.gain_trial import PHASES, Identified
from drive_env.trials.load_reading import FULL_READING, LIFT, SLOW, STALL_ANGLE, THRESHOLD, angle_of, falls, flux, volts
from drive_env.trials.open_loop import (
    PROBE,
    VIBRATION,
    OpenLoopTerms,
    OpenLoopTrial,
    OpenLoopTrials,
    encoder_age,
    with_run_current,
)
from drive_env.trials.positioning import TRIAL, Move
from drive_env.trials.working_moves import Steady, WorkingMoves
from mechanics.arrays import Floats, Integers, Mask

WORKING_SHARE, RAMP_SHARE = 0.5, 0.15  # of the motor's corner speed; of the holding torque at the run current
REACH_SHARE, LONGEST = 0.9, 100.0  # of the travel, and at most [rad]
MOST_ACCELERATION = 2000.0  # rad/s^2
MISSED = math.radians(10.0)  # error of a stall's angle that counts like a vibration of 0.1 full steps
SEEN_LATEST = math.radians(80.0)  # beyond this angle steps are lost before the stall is detected
ON_FROM = 0.8  # of the working speed, from which CoolStep acts in a trial


class LoadDetectionTrials(OpenLoopTrials):
    """Runs trials of load detection settings, as `Trials` does of loops; every trial ends where it began."""

    STATE = (*OpenLoopTrials.STATE, "_away", "_acceleration", "_per_volt")
    returns = True

    def __init__(self, drives: Drives, motor: Motor, axes: int, t_0: float) -> None:
        super().__init__(drives, motor, axes, t_0)
        count = drives.num_axes if drives is not None else 0
        self._speed = WORKING_SHARE * motor.rated_speed
        self._away, self._acceleration, self._per_volt = np.ones((3, count))

    def identify(self, reach: Floats, where: Mask) -> tuple[Identified, Integers]:
        """Identify the axes, and the counts of the reading per volt.

        Raises:
            RuntimeError: If the travel is too short for the working speed, or the reading does not change with the
                speed.
        """
        found, origin = super().identify(reach, where)
        drives, motor = self._drives, self._motor
        gains = read_gains(drives)
        run, _ = run_and_standby(device_of(drives), gains)
        torque = RAMP_SHARE * holding_torque(motor, run)
        away = np.clip(REACH_SHARE * np.nan_to_num(reach, posinf=LONGEST, neginf=-LONGEST), -LONGEST, LONGEST)
        self._away = np.where(where, away, self._away)
        self._acceleration = np.where(where, np.minimum(torque / found.inertia, MOST_ACCELERATION), self._acceleration)
        moves = self._moves(origin)
        if np.any(short := where & (np.abs(away) < moves.least_reach(self._speed))):
            k = int(np.flatnonzero(short)[0])
            raise RuntimeError(
                f"axis {axis_number(drives, k)}: the travel is too short for trials of the load detection: "
                f"{abs(away[k]):.2g} rad to go, and {moves.least_reach(self._speed)[k]:.2g} rad are needed for the "
                f"load reading at {self._speed:.3g} rad/s; allow more with --travel"
            )
        column = device_of(drives).gains.column(*THRESHOLD)
        assert column is not None, "a device with load detection has a threshold"
        highest = device_of(drives).gains.rows[column].highest
        lifted = gains.copy()
        lifted[where, column] = 0
        while True:
            write_gains(drives, lifted, where)
            slow, fast = (moves.run(share * self._speed, where) for share in (SLOW, 1.0))
            low = where & ((slow.lowest <= 0.0) | np.isnan(slow.lowest)) & (lifted[:, column] < highest)
            if not low.any():
                break
            lifted[low, column] = np.minimum(lifted[low, column] + 2 * LIFT, highest)
        write_gains(drives, gains, where)
        change = volts(motor, run, self._speed, fast.angle) - volts(motor, run, SLOW * self._speed, slow.angle)
        per_volt = (fast.reading - slow.reading) / change
        # An axis with an unusable reading is scored as one whose stall is never detected.
        known = np.isfinite(per_volt) & (per_volt > 0.0) & (fast.reading < FULL_READING)
        self._per_volt = np.where(where, np.where(known, per_volt, 0.0), self._per_volt)
        self.recover(where)
        return found, origin

    def run(  # type: ignore[override]
        self, gains: Integers, incumbent: Integers, move: Move, origin: Integers, direction: Integers, where: Mask
    ) -> OpenLoopTrial:
        """Try settings in moves there and back; as `Trials.run`, but the trial ends where it began."""
        drives, device = self._drives, device_of(self._drives)
        run, _ = run_and_standby(device, gains)
        moves = self._moves(origin)
        stages = []
        for tried, is_cool in ((gains, False), (gains, True), (with_run_current(device, gains, PROBE), True)):
            write_gains(drives, tried, where)
            self._cool(is_cool, where)
            stages.append(moves.run(self._speed, where))
            if np.any(failed := where & stages[-1].failed):
                write_gains(drives, incumbent, failed)
                self._cool(False, where)
                self._start_anew(failed, self._full_step())
        self._cool(False, where)
        plain, cooled, probe = stages
        missed = self._stall_angle(plain, run)
        terms = [self._terms(gains, plain, cool, missed) for cool in (cooled, cooled, probe)]
        joined = OpenLoopTerms(*(np.stack(values) for values in zip(*terms, strict=True)))
        wrong = plain.failed | (plain.lowest <= 0.0) | ~(missed < SEEN_LATEST)
        own = [wrong | stage.failed | ~(stage.settled < STALL_ANGLE) for stage in (cooled, cooled, probe)]
        aborted = self._machines(np.stack(own) & where)
        shape = (len(PHASES), drives.num_axes)
        return OpenLoopTrial(
            joined._replace(tripped=aborted), np.full(shape, 0.5), aborted, np.zeros((TRIAL, drives.num_axes)),
            where & np.any(own, axis=0), np.stack([stage.lost for stage in (plain, cooled, probe)]),
        )  # fmt: skip

    def _machines(self, axes: Mask) -> Mask:
        return np.stack([self._whole_lanes(phase) for phase in axes])

    def _stall_angle(self, plain: Steady, run: Floats) -> Floats:
        """Return the load angle at which the reading would fall to 0 [rad]; nan if it never does."""
        per_angle = self._per_volt * flux(self._motor, run) * self._speed
        left = falls(plain.angle) - plain.reading / np.where(per_angle > 0.0, per_angle, np.nan)
        seen = np.isfinite(left) & (plain.reading < FULL_READING)
        return np.where(seen, angle_of(np.where(seen, left, 0.0)), np.nan)

    def _terms(self, gains: Integers, plain: Steady, cooled: Steady, seen: Floats) -> OpenLoopTerms:
        """Return the terms of a phase, (num_axes,) each; missing samples get the worst possible values."""
        one = np.ones(len(gains))
        angle = np.nan_to_num(cooled.settled, nan=0.5 * math.pi)
        left = np.sin(np.abs(plain.settled)) / np.maximum(np.sin(np.clip(np.abs(angle), 1e-3, 0.5 * math.pi)), 1e-3)
        saved = np.clip(np.nan_to_num(left, nan=1.0), 0.05, 1.0)
        missed = np.nan_to_num(np.abs(seen - STALL_ANGLE), nan=0.5 * math.pi)
        run, _ = run_and_standby(device_of(self._drives), gains)
        spent = (run / self._motor.rated_current * saved) ** 2
        return OpenLoopTerms(
            one, one, missed / MISSED * VIBRATION, 0.0 * one, cooled.failed, np.abs(angle) / (0.5 * math.pi), spent
        )

    def _cool(self, on: bool, where: Mask) -> None:
        drives = self._drives
        if (key := device_of(drives).roles.get(Role.COOLSTEP_SPEED)) is not None:
            counts = ON_FROM * self._speed * self._increments() * per_increment(drives, key)
            beyond = device_of(drives).new_dictionary().find(key).high
            value = np.ceil(counts).astype(np.int64) if on else np.full(drives.num_axes, beyond, np.int64)
            drives.write(Role.COOLSTEP_SPEED, value, where=where)

    def _moves(self, origin: Integers) -> WorkingMoves:
        drives = self._drives
        entry = device_of(drives).new_dictionary().find(cia402.PROFILE_ACCELERATION)
        counts = self._increments() * per_increment(drives, cia402.PROFILE_ACCELERATION)
        most = np.inf if entry.high is None else 0.95 * entry.high / counts
        return WorkingMoves(
            drives, self._motor, self, origin, self._away, np.minimum(self._acceleration, most), self._increments(),
            encoder_age(device_of(drives)),
        )  # fmt: skip

    def _increments(self) -> Floats:
        return np.asarray(self._drives.read(Role.POSITION_SCALE), float) / (2.0 * np.pi)

    def _full_step(self) -> Floats:
        return 2.0 * np.pi * self._increments() / (4.0 * self._motor.n_p)


def is_load_detection(device: Device, names: tuple[str, ...]) -> bool:
    """Return whether gains of these names are settings of load detection or CoolStep."""
    rows = {row.name: row.loop for row in device.gains.rows}
    return bool(names) and any(rows.get(name) in LOAD_DETECTION for name in names)
