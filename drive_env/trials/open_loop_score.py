"""The robust cost of an open-loop stepper's currents on emulated machines; J is that of `open_loop.py`.

The load step is applied as for servo drives: E_d is the integral of the rotor's deflection in its field, and a current
that loses steps scores like a fault. The variant of the currents has 0.8 times the run current, as the variant of a
cascade has velocity P x 1.5: both test the distance from the limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drive_env import cia402
from drive_env.dictionary.entries import ObjectName
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
from drive_env.trials.positioning import power_up, wrapped
from drive_env.trials.score import StepperScore
from mechanics.arrays import Integers, Mask


class OpenLoopScore(StepperScore):
    """`RobustScore` for open-loop steppers; swings of the current are nan, since none is measured."""

    _cost = staticmethod(open_loop_cost)

    def _objects(self) -> list[ObjectName]:
        return [cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.STATUSWORD]

    def _varied(self, gains: Integers) -> Integers:
        less = with_run_current(self._drives.device, gains, self._factors)
        return np.where((self._factors != 1.0)[:, None], less, gains)

    def _get_ready(self) -> tuple[Integers, Mask]:
        self._drives.write(cia402.SENSOR_SELECTION, ENCODER)
        power_up(self._drives)
        return self._move.distance, np.zeros(self._drives.num_axes, bool)

    def _terms(
        self, free: Mapping[Any, Integers], loaded: Mapping[Any, Integers], target: Integers, used: Integers
    ) -> Any:
        move, motor = self._move, self._drives.motor
        full_step = 2.0 * np.pi * move.increments / (TOOTH * motor.n_p)
        lags = [wrapped(part[cia402.POSITION_DEMAND] - part[cia402.POSITION_ACTUAL]) for part in (free, loaded)]
        direction = np.where(move.distance < 0, -1, 1)
        settling, vibration, overshoot, angle = open_loop_terms(
            free[cia402.POSITION_ACTUAL].astype(float), lags[0], move, self._t_0, target, direction, full_step
        )
        lost = np.asarray((np.abs(np.concatenate(lags)) > LOST * full_step).any(axis=0))
        spent = effort(self._drives.device, motor, used)
        return OpenLoopTerms(settling, np.ones_like(settling), vibration, overshoot, lost, angle, spent)
