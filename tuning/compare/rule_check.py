"""Whether the baseline rule's own gains pass what a tuning must pass: only then it is a peer on that machine.

With gains that the rule computes from the true inertia an axis may shake at rest, or be nearer to instability than any
tuning may. A tuner that is held to that must be slower there, and worse by a score that does not count it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.loops.linear_model import Plant
from drive_env.safety.envelope import SafetyError
from drive_env.trials.positioning import wrapped
from tuning.auto.loop_margins import FREE_WINDOW, LEAST_WAY
from tuning.auto.measured_margins import SENSITIVITY, sensitivity
from tuning.auto.proving import ProvingGround
from tuning.auto.search import calm_gains
from tuning.auto.stages import Basis, IdentifiedAxes
from tuning.response.frequency_response import measure

if TYPE_CHECKING:
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


def rule_passes(target: Target, gains: Integers, inertia: Floats) -> Mask:
    """Return the machines on which gains pass a trial and a move, stand at rest, and are far from instability.

    It is what `drive-tune auto` asks of any gains on the drive: the last by the measured response of the velocity loop,
    where it can be measured.

    Args:
        target: The machines, fresh.
        gains: The baseline rule's, (num_axes, count).
        inertia: True total inertia [kg*m^2], (num_axes,).

    Returns:
        Shape (num_machines,).
    """
    origin = target.drives.read(cia402.POSITION_ACTUAL)
    plants = [
        Plant.from_data_sheet(target.device, target.motor, float(volts), float(J))
        for J, volts in zip(inertia, target.supply, strict=True)
    ]
    calm = np.array([calm_gains(target, plant) for plant in plants]).reshape(gains.shape)
    ground = ProvingGround(target, plants, (target.low, target.high), calm, gains)
    passed = ~ground.too_short()
    try:
        if passed.any():
            passed &= ground.run(gains, passed).passed
        if passed.any():
            shown = ground.show(gains, passed)
            passed &= ~shown.restless & np.array([not why for why in shown.reason])
        if passed.any():
            passed &= _far_from_instability(target, plants, gains, passed, origin)
    except SafetyError:
        passed[:] = False
    return np.asarray(passed.reshape(-1, target.axes_per_machine).all(axis=1))


def _far_from_instability(
    target: Target, plants: Sequence[Plant], gains: Integers, where: Mask, origin: Integers
) -> Mask:
    """Return the axes whose loops have Ms of no more than is allowed, as measured from where they are, (num_axes,)."""
    drives, far = target.drives, np.ones(target.num_axes, bool)
    moved = wrapped(drives.read(cia402.POSITION_ACTUAL) - origin) / target.increments()
    here = replace(target, low=np.minimum(target.low - moved, 0.0), high=np.maximum(target.high - moved, LEAST_WAY))
    drives.write(cia402.FOLLOWING_WINDOW, FREE_WINDOW * drives.read(Role.POSITION_SCALE), where=where)
    try:
        response = measure(here, "velocity", where=where)
    except (ValueError, RuntimeError):  # a travel too short for it, or an axis that does not follow
        return far
    known = IdentifiedAxes((None,) * len(plants), tuple(plants))
    basis = Basis(known, gains, gains, np.tile(gains, (3, 1, 1)), ("",) * len(plants))
    for k in map(int, np.flatnonzero(where)):
        far[k] = sensitivity(target, basis, response, gains[k], k) <= SENSITIVITY
    return far
