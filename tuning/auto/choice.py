"""Keep the better of the gains found and the baseline rule's, by digital twins, after slowing by the measured loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from tuning.auto.loop_margins import SENSITIVITY, sensitivity
from tuning.auto.moves import show
from tuning.auto.run import MOVE_TIME
from tuning.auto.twin import Twins, known_of

if TYPE_CHECKING:
    from tuning.auto.run import AutoRun

Mask = NDArray[np.bool_]

CLEARLY = 0.98  # of the robust cost on the twins: what is less than that is worth another move


def choose(run: AutoRun) -> None:
    """Take the rule's gains where they are better on the twins and the measured loop is stable enough with them.

    The gains found are better on the twins before they are slowed; afterwards they need not be.
    """
    better = _rule_is_better(run)
    if not better.any():
        return
    for k in map(int, np.flatnonzero(better)):
        run.gains[k], run.spare[k] = run.reference[k], 0
        run.axes[k].notes.append(
            "the gains of the baseline rule are kept: on the digital twins, the gains found by "
            "search are worse once slowed"
        )
    show(run, better)


def _rule_is_better(run: AutoRun) -> Mask:
    """Return the axes for which the rule's gains are better than the present ones, (num_axes,)."""
    target, response = run.target, run.response
    better = np.zeros(target.num_axes, bool)
    found_on_twins = np.array([np.isfinite(axis.twin) for axis in run.axes])
    differs = (run.gains != run.reference).any(axis=1)
    open_ = run.going & ~run.unseen & found_on_twins & differs & run.affordable(MOVE_TIME + run.look_back_time)
    chosen = np.flatnonzero(open_)
    if response is None or not chosen.size:
        return better
    axes = chosen.tolist()
    low, high = run.room()
    reach = np.where(high >= -low, high, low)
    known = []
    for k in axes:
        plant, identified = run.axes[k].plant, run.axes[k].identified
        assert plant is not None and identified is not None, "an axis in the run has both"
        known.append(known_of(plant, identified, float(reach[k])))
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[chosen]
    with Twins(target.device, target.motor, known, scaler, 2) as twins:
        cost = twins.score(np.stack([run.gains[chosen], run.reference[chosen]], axis=1))
    for k, (own, rule) in zip(axes, cost, strict=True):
        better[k] = rule < CLEARLY * own and sensitivity(run, response, run.reference[k], k) <= SENSITIVITY
    return better
