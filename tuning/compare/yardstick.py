"""Judges gains on machines with known parameters: robust performance, constraints, and margins of the loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drive_env.devices.gains import has_linear_model, rule_gains
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import machine_of
from drive_env.loops.dynamics import DEFAULT, Dynamics
from drive_env.loops.sampled import CascadeGains, LoopRates
from drive_env.loops.true_plant import true_machines
from drive_env.loops.worst_margins import WorstMargins, worst_margins
from drive_env.trials.positioning import highest_ramp, longer_way, plan_move
from drive_env.trials.score import RobustScore, Scores
from mechanics.arrays import Floats, Integers
from tuning.compare.suite import SuiteMachine, open_group
from tuning.identify.moved_inertia import true_inertia

# Number of runs of every machine and variant, each with its own noise, whose scores are averaged: with one run, the
# score of the same gains differs by 10 % on some machines.
REPEATS = 16
REST = 0.3  # s


class Yardstick:
    """Judges gains on the machines of a group with their true parameters.

    Args:
        group: Machines of one kind.
        num_threads: As in `EmulatedDrives`.
        repeats: As in `RobustScore`.
        copies: Consecutive copies of each machine; each may have its own gains.
        dynamics: Requirements on the loops.
    """

    def __init__(
        self,
        group: Sequence[SuiteMachine],
        num_threads: int | None,
        repeats: int = REPEATS,
        copies: int = 1,
        dynamics: str | Dynamics = DEFAULT,
    ) -> None:
        device, load, motor, friction = group[0].kind
        count = len(group) * copies
        self._score = RobustScore(
            device,
            load,
            motor,
            count,
            num_threads=num_threads,
            friction=friction,
            repeats=repeats,
            dynamics=dynamics,
            rest=REST,
        )
        self.dynamics = self._score.dynamics
        with open_group(group, num_threads) as target:
            self.axes, self.device, self.motor = target.axes_per_machine, target.device, target.motor

            def each(values: NDArray[Any]) -> NDArray[Any]:
                return np.repeat(np.asarray(values).reshape(len(group), -1), copies, axis=0).reshape(-1)

            inertia = true_inertia(target)
            self.parameters = {name: each(value) for name, value in machine_of(target.drives).parameters.items()}
            self.supply = each(target.supply)
            self._score.set_machines(self.parameters, self.supply.reshape(count, -1)[:, 0])
            scale, reach = target.drives.read(Role.POSITION_SCALE), longer_way(target.low, target.high)
            ramp = highest_ramp(target.device)
            self._score.set_moves(
                plan_move(target.motor, each(target.slowest(inertia)), each(scale), each(reach), ramp)
            )
            self._linear = true_machines(target.drives) if has_linear_model(target.device) else None
        self.rule_gains = np.concatenate(
            [
                rule_gains(self.device, self.motor, J, supply=float(volts))
                for J, volts in zip(each(inertia), self.supply, strict=True)
            ]
        )

    def score(self, gains: Integers) -> Scores:
        """Return the scores of every copy for raw gains, shape (num_machines * axes, count)."""
        return self._score.score(gains)

    def loop_slack(self, gains: Integers) -> Floats:
        """Return the slack of the loops to the constraints on the nominal machines; infinite without a linear model."""
        if self._linear is None:
            return np.full(len(gains) // self.axes, np.inf)
        return self._score.loop_slack(gains, nominal=True)

    def margins(self, gains: Integers) -> WorstMargins:
        """Return the true margins of every machine of the group, without copies; nan without a linear model."""
        count = len(gains) // self.axes
        if self._linear is None:
            return WorstMargins(*np.full((3, count), np.nan))
        raw = gains.reshape(count, self.axes, -1)
        return worst_margins(LoopRates.of(self.device), self._linear, CascadeGains.of(self.device, raw))

    def close(self) -> None:
        """Close the machines."""
        self._score.close()
