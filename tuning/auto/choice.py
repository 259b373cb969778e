"""Keep the better of the gains found and the baseline rule's, by digital twins, after slowing by the measured loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.safety.envelope import SafetyError
from tuning.auto.calmer_gains import cost_on_twins
from tuning.auto.measured_margins import SENSITIVITY, sensitivity
from tuning.auto.moves import show
from tuning.auto.run import MOVE_TIME

if TYPE_CHECKING:
    from tuning.auto.run import AutoRun

Mask = NDArray[np.bool_]

BAD = 8.0  # measured cost J of a move, above which another is made with the rule's gains
CLEARLY = 0.98  # of the robust cost on the twins: what is less than that is worth another move


def choose(run: AutoRun) -> None:
    """Take the rule's gains where they are better on the twins and the measured loop is stable enough with them.

    The gains found are better on the twins before they are slowed; afterwards they need not be.
    """
    _try_rule_where_bad(run)
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


def _try_rule_where_bad(run: AutoRun) -> None:
    """Record a move with the rule's gains on axes that moved badly, and keep what moved better."""
    if run.shown is None or run.ground is None:
        return
    where = run.going & run.shown.where & (run.shown.cost > BAD) & (run.gains != run.reference).any(axis=1)
    where = run.whole_machines(where & run.affordable(MOVE_TIME))
    if not where.any():
        return
    try:
        with run.spending(where):
            with_rule = run.ground.show(run.reference, where)
    except SafetyError as error:
        run.note(where, f"the envelope stopped the move with the baseline rule's gains: {error}")
        return
    faulted = np.isin(np.arange(run.target.num_axes), list(run.faults()))
    if faulted.any():
        with run.spending(run.target.together(faulted)):
            run.ground.recover(faulted)
        run.drop_faults("moving with the baseline rule's gains, and the fault cannot be reset")
    passed = np.array([not reason for reason in with_rule.reason])
    better = run.whole_machines(where & passed & ~with_rule.restless & (with_rule.cost < run.shown.cost))
    for k in map(int, np.flatnonzero(better)):
        run.gains[k], run.spare[k] = run.reference[k], 0
        run.axes[k].notes.append(
            f"the gains of the baseline rule are kept: the measured cost J of a move was {with_rule.cost[k]:.2f} with "
            f"them and {run.shown.cost[k]:.2f} with the gains found by search"
        )
    run.shown = run.shown.replaced(with_rule._replace(where=better))


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
    cost = cost_on_twins(run, axes, np.stack([run.gains[chosen], run.reference[chosen]], axis=1))
    for k, (own, rule) in zip(axes, cost, strict=True):
        better[k] = rule < CLEARLY * own and sensitivity(run, response, run.reference[k], k) <= SENSITIVITY
    return better
