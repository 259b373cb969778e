"""The robust cost of the gains of a stepper's closed loop on emulated machines: a trial's move, and an overload.

In place of a servo's load step, which the field holds by itself, the axis gets `PUSH` times the torque that the trial's
run current holds, for as long as takes it away by `AWAY` full steps. E_d is the integral of its error from there on.
The variant of the gains is a run current of 0.8 times, as in open loop.
"""

from __future__ import annotations

import warnings

import numpy as np

from drive_env import cia402
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count
from drive_env.gains import write_gains
from drive_env.phase_current import swing_period
from drive_env.trials.closed_loop import CLOSING, OVERLOAD, full_step, held_in_trial
from drive_env.trials.open_loop import ENCODER, NO_WINDOW, with_run_current
from drive_env.trials.positioning import (
    CYCLE,
    SETTLED,
    TRIAL,
    Move,
    move_terms,
    power_up,
    start,
    wrapped,
    write_profile,
)
from drive_env.trials.score import LOAD_SHARE, CurrentSwings, StepperScore, Terms, swings
from mechanics.arrays import Floats, Integers, Mask

PUSH = 1.3  # torque over what the trial's run current holds
AWAY = 4.0  # full steps
LONGEST_PUSH = 30  # ms


class ClosedLoopScore(StepperScore):
    """As `RobustScore`, of steppers whose loop is closed."""

    def set_moves(self, move: Move, where: Mask | None = None) -> None:
        """Take the move of every axis, and the share of the run current that belongs to it."""
        lanes = np.ones(self.num_machines, bool) if where is None else where
        before = np.broadcast_to(self._move.share, self._drives.num_axes)
        super().set_moves(move, where)
        each = np.repeat(lanes, len(self.variants) * self._axes[2])
        share = self._spread(np.broadcast_to(np.asarray(move.share, float), move.distance.shape))
        self._move = self._move._replace(share=np.where(each, share, before))

    def _settling_scale(self, filters: Floats) -> Floats:
        return np.full(np.shape(filters), swing_period(self._drives.motor))

    def _pushes(self) -> tuple[Floats, Integers]:
        """Return the torque of every machine [N m], signed as `machine.load_torque`, and for how many ms it acts."""
        drives, move = self._drives, self._move
        motor = drives.motor
        held = held_in_trial(drives.device, motor, np.asarray(move.share, float))
        # The plan of the move tells the inertia: it asks for so many times the torque that is there.
        inertia = OVERLOAD * held * move.increments / np.maximum(move.acceleration, 1)
        time = np.sqrt(2.0 * AWAY * full_step(motor) * inertia / ((PUSH - 1.0) * held))
        machines = (self.num_machines * self._runs, self._axes[2])
        torque = self._load_torque / (LOAD_SHARE * motor.rated_torque) * PUSH * held.reshape(machines).max(axis=1)
        lasts = np.clip(np.rint(time.reshape(machines).max(axis=1) / CYCLE), 1, LONGEST_PUSH).astype(np.int64)
        return torque, lasts

    def _close(self) -> Mask:
        """Enable the drives at rest and close their loops; return of which axes they are closed."""
        drives = self._drives
        closed = drives.device.gains.loop_of_kind(LOAD_ANGLE)
        assert closed is not None, "a drive that closes such a loop"
        drives.write(cia402.SENSOR_SELECTION, ENCODER)
        drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
        power_up(drives)
        drives.write(Role.LOOP_MODE, closed.mode)
        drives.advance(CLOSING)
        return np.asarray(drives.read(Role.LOOP_INITIALISED) != 0)

    def _run(self, gains: Integers) -> tuple[Terms, Floats, CurrentSwings]:
        """Return the terms of every axis without E_d/E_0, E_d [rad s] and swings, (machines, variants, axes) each."""
        drives, move = self._drives, self._move
        drives.machine.load_torque = self._constant
        drives.machine.reset()
        share = self._factors * np.asarray(move.share, float)
        write_gains(drives, with_run_current(drives.device, self._spread(np.asarray(gains, np.int64)), share))
        write_profile(drives, move)
        objects: list[ObjectName] = [cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL, cia402.STATUSWORD]
        torque, lasts = self._pushes()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
            is_closed = self._close()
            target = drives.read(cia402.POSITION_ACTUAL) + move.distance
            start(drives, target)
            free = drives.record(objects, SETTLED * CYCLE)
            pushed = []
            for k in range(LONGEST_PUSH):
                drives.machine.load_torque = self._constant + np.where(k < lasts, torque, 0.0)
                pushed.append(drives.record(objects, CYCLE))
            drives.machine.load_torque = self._constant
            pushed.append(drives.record(objects, (TRIAL - SETTLED - LONGEST_PUSH) * CYCLE))
        position = np.concatenate([part[cia402.POSITION_ACTUAL] for part in pushed])
        current = free[cia402.TORQUE_ACTUAL] * ampere_per_count(drives)
        settling, noise, overshoot = move_terms(
            free[cia402.POSITION_ACTUAL].astype(float), np.asarray(current, float), move, self._t_0,
            drives.motor.rated_current, target, np.where(move.distance < 0, -1, 1),
        )  # fmt: skip
        enabled = cia402.matches(pushed[-1][cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
        tripped = ~enabled | ~is_closed | np.repeat(drives.machine.diverged, self._axes[2])
        error = np.abs(wrapped(target - position)).sum(axis=0) * CYCLE / move.increments
        terms = Terms(settling, np.ones_like(settling), noise, overshoot, tripped)
        return (
            terms.each(lambda value: value.reshape(self._axes)),
            np.maximum(error, move.least_error).reshape(self._axes),
            swings(np.asarray(current, float), drives.motor.rated_current, self._axes),
        )
