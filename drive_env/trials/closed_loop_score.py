"""The robust cost of the gains of a stepper's closed loop on emulated machines: a trial's move, and an overload.

Instead of a servo's load step, which the field would hold by itself, the axis gets `PUSH` times the torque that the
trial's run current holds, until it has moved by `AWAY` full steps. E_d is the integral of its error from then on. The
variant of the gains has 0.8 times the run current, as in open loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drive_env import cia402
from drive_env.devices.gain_set import LOAD_ANGLE
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE
from drive_env.trials.closed_loop import CLOSING, OVERLOAD, full_step, held_in_trial
from drive_env.trials.open_loop import ENCODER, NO_WINDOW, with_run_current
from drive_env.trials.positioning import SETTLED, TRIAL, Move, power_up
from drive_env.trials.score import LOAD_SHARE, StepperScore
from mechanics.arrays import Floats, Integers, Mask

PUSH = 1.3  # torque over that which the trial's run current holds
AWAY = 4.0  # full steps
LONGEST_PUSH = 30  # ms


class ClosedLoopScore(StepperScore):
    """`RobustScore` for steppers with closed loop."""

    def set_moves(self, move: Move, where: Mask | None = None) -> None:
        """Set the move of every axis, with its share of the run current."""
        lanes = np.ones(self.num_machines, bool) if where is None else where
        before = np.broadcast_to(self._move.share, self._drives.num_axes)
        super().set_moves(move, where)
        each = np.repeat(lanes, len(self.variants) * self._axes[2])
        share = self._spread(np.broadcast_to(np.asarray(move.share, float), move.distance.shape))
        self._move = self._move._replace(share=np.where(each, share, before))

    def _pushes(self) -> tuple[Floats, Integers]:
        """Return the torque of every machine [N m], with the sign of `machine.load_torque`, and its duration [ms]."""
        drives, move = self._drives, self._move
        motor = drives.motor
        held = held_in_trial(drives.device, motor, np.asarray(move.share, float))
        # The inertia follows from the move, which was planned for `OVERLOAD` times the available torque.
        inertia = OVERLOAD * held * move.increments / np.maximum(move.acceleration, 1)
        time = np.sqrt(2.0 * AWAY * full_step(motor) * inertia / ((PUSH - 1.0) * held))
        machines = (self.num_machines * self._runs, self._axes[2])
        torque = self._load_torque / (LOAD_SHARE * motor.rated_torque) * PUSH * held.reshape(machines).max(axis=1)
        lasts = np.clip(np.rint(time.reshape(machines).max(axis=1) / CYCLE), 1, LONGEST_PUSH).astype(np.int64)
        return torque, lasts

    def _varied(self, gains: Integers) -> Integers:
        return with_run_current(self._drives.device, gains, self._factors * np.asarray(self._move.share, float))

    def _get_ready(self) -> tuple[Integers, Mask]:
        """Enable the drives at rest and close their loops; return targets [inc], and axes whose loop stayed open."""
        drives = self._drives
        closed = drives.device.gains.loop_of_kind(LOAD_ANGLE)
        assert closed is not None, "a drive that closes such a loop"
        drives.write(cia402.SENSOR_SELECTION, ENCODER)
        drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
        power_up(drives)
        drives.write(Role.LOOP_MODE, closed.mode)
        drives.advance(CLOSING)
        is_open = np.asarray(drives.read(Role.LOOP_INITIALISED) == 0)
        return drives.read(cia402.POSITION_ACTUAL) + self._move.distance, is_open

    def _load_step(self, objects: list[ObjectName]) -> Mapping[Any, Integers]:
        """Record the axes while they are pushed away and return."""
        drives, pushed = self._drives, []
        torque, lasts = self._pushes()
        for k in range(LONGEST_PUSH):
            drives.machine.load_torque = self._constant + np.where(k < lasts, torque, 0.0)
            pushed.append(drives.record(objects, CYCLE))
        drives.machine.load_torque = self._constant
        pushed.append(drives.record(objects, (TRIAL - SETTLED - LONGEST_PUSH) * CYCLE))
        return {name: np.concatenate([part[name] for part in pushed]) for name in objects}
