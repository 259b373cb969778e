"""Gains for an axis that shakes at rest: of those that amplify its noise less, the best on its digital twins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.gains import cascade_columns
from tuning.auto.checks import sound_gains
from tuning.auto.measured_margins import SENSITIVITY, sensitivity
from tuning.auto.trials import faster
from tuning.auto.twin import Twins

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis, RecordedGains

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Powers of the factor of velocity P by which velocity I and position P are lowered beside it.
INTEGRAL, POSITION = (0.0, 0.5, 1.0), (0.0, 0.5, 1.0, 1.5, 2.0, 4.0)
# Twins know less of an axis that shakes than of others: what was found by search on them must be better by this.
WELL = 0.95


def cost_on_twins(bench: AutoBench, basis: Basis, axes: Sequence[int], gains: Integers) -> Floats:
    """Return the robust cost of gains on the digital twins of axes.

    Args:
        bench: The drives.
        basis: What was identified.
        axes: Which; they are identified.
        gains: Raw integers, (axes, sets, count).

    Returns:
        Shape (axes, sets).
    """
    target, known = bench.target, basis.identified.twins(axes, bench.reach())
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[list(axes)]
    with Twins(target.device, target.motor, known, scaler, gains.shape[1]) as twins:
        return twins.score(gains)


def calmer(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, factor: float) -> Integers:
    """Return the best gains of an axis, by its twins, whose velocity P is a factor of the present one or less.

    An encoder's noise, and its counts at standstill, go into the current by velocity P. The other gains of the outer
    loops are lowered with it as far as that is better; those of the rule are looked at as well, with as much more
    velocity P as their current loop is slower.

    Where time does not wait all of the outer gains are lowered alike: twins take longer than an enabled axis may be
    left alone, and its voltage is not taken away, since it may still turn, or hold a weight.
    """
    target, device, (plant, _) = bench.target, bench.target.device, basis.identified.known(k)
    own, rule = recorded.gains[k], basis.reference[k]
    if not target.drives.time_waits:
        return faster(device.gains, own, factor)
    torque_p, _, velocity_p, velocity_i, position_p = cascade_columns(device)
    response = None if recorded.unseen[k] else recorded.response
    most = factor * own[velocity_p]
    rows = []
    for base in (own, rule):
        slower = max(1.0, own[torque_p] / base[torque_p])  # a current loop passes on less of the noise
        share = min(1.0, most * slower / base[velocity_p])
        for integral in INTEGRAL:
            for position in POSITION:
                row = base.astype(float)
                row[[velocity_p, velocity_i, position_p]] *= share, share**integral, share**position
                gains = tuple(map(int, np.maximum(np.rint(row), 1)))
                rows.append(gains if response is not None else sound_gains(device, plant, gains))
    # With those of the rule as they are the axis itself has stood, whatever their velocity P.
    if recorded.rule is not None and recorded.rule.passed[k]:
        rows.append(tuple(map(int, rule)))
    candidates = np.array(rows, np.int64)
    cost = cost_on_twins(bench, basis, [k], candidates[None])[0]
    if response is not None:  # it knows more than the model
        near = np.array([sensitivity(target, basis, response, row, k) > SENSITIVITY for row in candidates])
        cost = np.where(near & ~near.all(), np.inf, cost)
    count = len(INTEGRAL) * len(POSITION)
    of_own, of_rule = cost[:count], cost[count:]
    if of_own.min() < WELL * of_rule.min():
        return np.asarray(candidates[int(of_own.argmin())])
    return np.asarray(candidates[count + int(of_rule.argmin())])
