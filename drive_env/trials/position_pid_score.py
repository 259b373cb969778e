"""The robust cost of the gains of a stepper's position PID on emulated machines: a trial's move, and a load step.

The load step is a servo's, 0.3 of the rated torque: the rotor turns in its field, and the PID brings it back. The
variant of the gains is P x 1.5, as the trial's probe has it.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from drive_env import cia402
from drive_env.devices.gain_set import PID_ALONE, ClosedLoop
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.gains import write_gains
from drive_env.phase_current import swing_period
from drive_env.trials.open_loop import ENCODER, NO_WINDOW
from drive_env.trials.position_pid import PID_P, pid_terms, pid_time, steps_of
from drive_env.trials.positioning import CYCLE, SETTLED, TRIAL, power_up, start, wrapped, write_profile
from drive_env.trials.score import CurrentSwings, StepperScore, Terms
from mechanics.arrays import Floats, Integers

CLOSING = 0.01  # s: a PID has no initialisation


class PidScore(StepperScore):
    """As `RobustScore`, of steppers whose position a PID regulates; they have no swing of a measured current: nan.

    Args:
        loop: Which of the device's PIDs.
        options: As `RobustScore` has them.
    """

    def __init__(self, *args: Any, loop: ClosedLoop, **options: Any) -> None:
        self._loop = loop
        super().__init__(*args, **options)

    @staticmethod
    def _tries_current(is_open_loop: bool) -> bool:
        return False

    def _settling_scale(self, filters: Floats) -> Floats:
        alone = self._loop.kind == PID_ALONE
        return np.full(np.shape(filters), pid_time(self._loop) if alone else swing_period(self._drives.motor))

    def _run(self, gains: Integers) -> tuple[Terms, Floats, CurrentSwings]:
        """Return the terms of every axis without E_d/E_0, E_d [rad s], no swings, (machines, runs, axes) each."""
        drives, move = self._drives, self._move
        drives.machine.load_torque = self._constant
        drives.machine.reset()
        column = drives.device.gains.column(*PID_P)
        assert column is not None, "a PID has a P part"
        used = drives.device.gains.scaled(self._spread(np.asarray(gains, np.int64)), self._factors[:, None], [column])
        write_gains(drives, used)
        write_profile(drives, move)
        objects: list[ObjectName] = [cia402.POSITION_ACTUAL, cia402.STATUSWORD]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
            drives.write(cia402.SENSOR_SELECTION, ENCODER)
            drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
            power_up(drives)
            drives.write(Role.LOOP_MODE, self._loop.mode)
            drives.advance(CLOSING)
            target = drives.read(cia402.POSITION_ACTUAL) + move.distance
            start(drives, target)
            free = drives.record(objects, SETTLED * CYCLE)
            drives.machine.load_torque = self._constant + self._load_torque
            loaded = drives.record(objects, (TRIAL - SETTLED) * CYCLE)
        position = free[cia402.POSITION_ACTUAL].astype(float)
        settling, noise, overshoot = pid_terms(
            position, np.zeros_like(position), move, self._t_0, target, np.where(move.distance < 0, -1, 1),
            steps_of(move, drives.motor),
        )  # fmt: skip
        enabled = cia402.matches(loaded[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
        tripped = ~enabled | np.repeat(drives.machine.diverged, self._axes[2])
        error = np.abs(wrapped(target - loaded[cia402.POSITION_ACTUAL])).sum(axis=0) * CYCLE / move.increments
        terms = Terms(settling, np.ones_like(settling), noise, overshoot, tripped)
        nothing = np.full(self._axes, np.nan)
        return (
            terms.each(lambda value: value.reshape(self._axes)),
            np.maximum(error, move.least_error).reshape(self._axes),
            CurrentSwings(nothing, nothing),
        )
