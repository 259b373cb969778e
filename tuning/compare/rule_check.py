"""Whether the baseline rule's own gains pass what a tuning must pass: only then it is a peer on that machine.

With gains that the rule computes from the true inertia an axis may shake at rest. A tuner that is held to standing
still must be slower there, and worse by a score that does not count it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.safety.envelope import SafetyError
from tuning.auto.proving import ProvingGround
from tuning.auto.search import calm_gains
from tuning.response.linear_model import Plant

if TYPE_CHECKING:
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


def rule_passes(target: Target, gains: Integers, inertia: Floats) -> Mask:
    """Return the machines on which gains pass a trial and a move, and stand at rest afterwards, (num_machines,).

    It is what `drive-tune auto` asks of any gains on the drive.

    Args:
        target: The machines, fresh.
        gains: The baseline rule's, (num_axes, count).
        inertia: True total inertia [kg*m^2], (num_axes,).
    """
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
    except SafetyError:
        passed[:] = False
    return np.asarray(passed.reshape(-1, target.axes_per_machine).all(axis=1))
