"""The robust cost of an open-loop stepper's currents on emulated machines; J is that of `open_loop.py`.

The load step is on the machine, as for servo drives: E_d is what it turns the rotor by in its field, and a current that
loses steps by it scores as a fault. The variant of the currents is a run current of 0.8 times, as that of a cascade is
velocity P x 1.5: both ask how far the limit is.
"""

from __future__ import annotations

import warnings

import numpy as np

from drive_env import cia402
from drive_env.gains import write_gains
from drive_env.phase_current import swing_period
from drive_env.trials.open_loop import (
    ENCODER,
    LOST,
    TOOTH,
    OpenLoopTerms,
    effort,
    open_loop_cost,
    open_loop_terms,
    with_run_current,
)
from drive_env.trials.positioning import CYCLE, SETTLED, TRIAL, power_up, start, wrapped, write_profile
from drive_env.trials.score import CurrentSwings, Scores, StepperScore
from mechanics.arrays import Floats, Integers


class OpenLoopScore(StepperScore):
    """As `RobustScore`, of open-loop steppers; it has no swings of a measured current, which are nan."""

    def _settling_scale(self, filters: Floats) -> Floats:
        return np.full(np.shape(filters), swing_period(self._drives.motor))

    def _run(self, gains: Integers) -> tuple[OpenLoopTerms, Floats, CurrentSwings]:  # type: ignore[override]
        """Return the terms of every axis without E_d/E_0, E_d [rad s], no swing, (machines, runs, axes) each."""
        drives, move, motor = self._drives, self._move, self._drives.motor
        drives.machine.load_torque = self._constant
        drives.machine.reset()
        used = self._spread(np.asarray(gains, np.int64))
        used = np.where((self._factors != 1.0)[:, None], with_run_current(drives.device, used, self._factors), used)
        write_gains(drives, used)
        write_profile(drives, move)
        objects = [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.STATUSWORD]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
            drives.write(cia402.SENSOR_SELECTION, ENCODER)
            power_up(drives)
            start(drives, move.distance)
            free = drives.record(objects, SETTLED * CYCLE)
            drives.machine.load_torque = self._constant + self._load_torque
            loaded = drives.record(objects, (TRIAL - SETTLED) * CYCLE)
        full_step = 2.0 * np.pi * move.increments / (TOOTH * motor.n_p)
        lags = [wrapped(part[cia402.POSITION_DEMAND] - part[cia402.POSITION_ACTUAL]) for part in (free, loaded)]
        direction = np.where(move.distance < 0, -1, 1)
        settling, vibration, overshoot, angle = open_loop_terms(
            free[cia402.POSITION_ACTUAL].astype(float), lags[0], move, self._t_0, move.distance, direction, full_step
        )
        lost = (np.abs(np.concatenate(lags)) > LOST * full_step).any(axis=0)
        tripped = (
            ~cia402.matches(loaded[cia402.STATUSWORD][-1], cia402.OPERATION_ENABLED)
            | np.repeat(drives.machine.diverged, self._axes[2])
            | lost
        )
        error = np.abs(wrapped(move.distance - loaded[cia402.POSITION_ACTUAL])).sum(axis=0) * CYCLE / move.increments
        terms = OpenLoopTerms(
            settling, np.ones_like(settling), vibration, overshoot, tripped, angle, effort(drives.device, motor, used)
        )
        return (
            terms.each(lambda value: value.reshape(self._axes)),
            np.maximum(error, move.least_error).reshape(self._axes),
            CurrentSwings(np.full(self._axes, np.nan), np.full(self._axes, np.nan)),
        )

    def _scores(self, terms: OpenLoopTerms, disturbance: Floats, swings: CurrentSwings) -> Scores:  # type: ignore[override]
        terms = terms._replace(disturbance=disturbance / self._reference[:, None])
        return self._averaged(terms, open_loop_cost(terms), swings)
