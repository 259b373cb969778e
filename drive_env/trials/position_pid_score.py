"""The robust cost of the gains of a stepper's position PID on emulated machines: a trial's move, and a load step.

The load step is a servo's, 0.3 of the rated torque: it turns the rotor in its field, and the PID brings it back. The
variant of the gains has P x 1.5, as the trial's probe.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drive_env import cia402
from drive_env.devices.gain_set import PID_ALONE, ClosedLoop
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.trials.open_loop import ENCODER, NO_WINDOW
from drive_env.trials.position_pid import PID_P, pid_terms, pid_time, steps_of
from drive_env.trials.positioning import power_up
from drive_env.trials.score import StepperScore, Terms
from mechanics.arrays import Floats, Integers, Mask

CLOSING = 0.01  # s: a PID has no initialisation


class PidScore(StepperScore):
    """`RobustScore` for steppers whose position a PID controls; swings of the current are nan, since none is measured.

    Args:
        loop: One of the device's PIDs.
        options: As in `RobustScore`.
    """

    def __init__(self, *args: Any, loop: ClosedLoop, **options: Any) -> None:
        self._loop = loop
        super().__init__(*args, **options)

    @staticmethod
    def _tries_current(is_open_loop: bool) -> bool:
        return False

    def _settling_scale(self, filters: Floats) -> Floats:
        if self._loop.kind == PID_ALONE:
            return np.full(np.shape(filters), pid_time(self._loop))
        return super()._settling_scale(filters)

    def _objects(self) -> list[ObjectName]:
        return [cia402.POSITION_ACTUAL, cia402.STATUSWORD]

    def _varied(self, gains: Integers) -> Integers:
        known = self._drives.device.gains
        column = known.column(*PID_P)
        assert column is not None, "a PID has a P part"
        return known.scaled(gains, self._factors[:, None], [column])

    def _get_ready(self) -> tuple[Integers, Mask]:
        drives = self._drives
        drives.write(cia402.SENSOR_SELECTION, ENCODER)
        drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
        power_up(drives)
        drives.write(Role.LOOP_MODE, self._loop.mode)
        drives.advance(CLOSING)
        return drives.read(cia402.POSITION_ACTUAL) + self._move.distance, np.zeros(drives.num_axes, bool)

    def _terms(
        self, free: Mapping[Any, Integers], loaded: Mapping[Any, Integers], target: Integers, used: Integers
    ) -> Any:
        move, position = self._move, free[cia402.POSITION_ACTUAL].astype(float)
        settling, noise, overshoot = pid_terms(
            position, np.zeros_like(position), move, self._t_0, target, np.where(move.distance < 0, -1, 1),
            steps_of(move, self._drives.motor),
        )  # fmt: skip
        return Terms(settling, np.ones_like(settling), noise, overshoot, np.zeros(len(settling), bool))
