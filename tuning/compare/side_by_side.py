"""Compares rules: the proposal of each for an identified axis, with its margins by the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.linear_model import OPEN_LOOPS, Plant
from drive_env.loops.margins import margins
from drive_env.safety.envelope import swinging_allowed
from tuning.rules.rules_by_name import propose

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.margins import Margins
    from tuning.identify.identified_axis import Identification, Progress
    from tuning.rules.proposal import Proposal
    from tuning.target import Target

POINTS = 1500  # frequencies at which margins are computed


@dataclass
class AxisRules:
    """The results of an axis: its model, or the reason for a missing one, and the rules' proposals.

    unswung: Why the relay experiment has no result.
    """

    plant: Plant | str
    rows: dict[str, Proposal] = field(default_factory=dict)
    unswung: str = ""


def identified_plants(target: Target, progress: Progress) -> tuple[list[Identification], list[Plant | str]]:
    """Identify axes; return the identifications and their models, or the reason for a missing one (no inertia)."""
    from tuning.identify.identification import identify

    with swinging_allowed(target.drives):
        found = identify(target, progress=progress)
    plants: list[Plant | str] = []
    for axis, one in enumerate(found):
        try:
            supply = float(target.supply[axis])
            plants.append(Plant.from_identification(target.device, target.motor, supply, one))
        except ValueError as error:
            plants.append(str(error))
    return found, plants


def proposals(target: Target, plant: Plant, names: Sequence[str]) -> dict[str, Proposal]:
    """Compute the proposals of rules by name."""
    return {name: propose(name, target.device, target.motor, plant) for name in names}


def swung_proposals(target: Target, plants: Sequence[Plant]) -> list[Proposal | str]:
    """Run relay experiments with the rule's current loops; return their proposals, or the reason for a missing one."""
    from tuning.rules.relay import gains_from_swing, relay_experiment, relay_rule

    before = read_gains(target.drives)
    gains = [relay_rule(target.device, target.motor, plant).gains for plant in plants]
    write_gains(target.drives, np.array(gains, np.int64))
    try:
        swing = relay_experiment(target)
    finally:
        write_gains(target.drives, before)
    found: list[Proposal | str] = []
    for axis, plant in enumerate(plants):
        try:
            if reason := swing.reason[axis]:
                raise ValueError(reason)
            found.append(gains_from_swing(target.device, plant, float(swing.slope[axis]), swing.ultimate(axis)))
        except ValueError as error:  # raised also by gains_from_swing: it was the load's resonance that oscillated
            found.append(str(error))
    return found


def outer_margins(device: Device, plant: Plant, gains: Sequence[int]) -> dict[str, Margins]:
    """Compute the margins of velocity and position loop with the model and gains."""
    f = np.geomspace(0.5, 0.49 * device.velocity_rate, POINTS)
    return {loop: margins(f, OPEN_LOOPS[loop](device, plant, gains, f)) for loop in ("velocity", "position")}


def slacks(target: Target, plant: Plant, rows: Mapping[str, Proposal], dynamics: Dynamics) -> dict[str, float]:
    """Return the relative slack of proposals to the dynamics, by the model of the axis and its variants, by name."""
    from tuning.auto.loop_model import model_of

    gains = np.array([row.gains for row in rows.values()], np.int64)
    slack = model_of(target.device, target.motor, plant, dynamics).slack(dynamics, gains[:, None])
    return dict(zip(rows, slack.tolist(), strict=True))
