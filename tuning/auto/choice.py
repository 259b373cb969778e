"""Keep the better of the gains found and the baseline rule's, by digital twins, after slowing by the measured loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.safety.envelope import SafetyError
from tuning.auto.bench import MOVE_TIME
from tuning.auto.calmer_gains import cost_on_twins
from tuning.auto.measured_margins import SENSITIVITY, sensitivity
from tuning.auto.moves import show

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis, RecordedGains

Mask = NDArray[np.bool_]

BAD = 8.0  # measured cost J of a move, above which another is made with the rule's gains
CLEARLY = 0.98  # of the robust cost on the twins: what is less than that is worth another move


def choose(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Take the rule's gains where they are better on the twins and the measured loop is stable enough with them.

    The gains found are better on the twins before they are slowed; afterwards they need not be.
    """
    recorded = _try_rule_where_bad(bench, basis, recorded)
    better = _rule_is_better(bench, basis, recorded)
    for k in map(int, np.flatnonzero(better)):
        recorded = recorded.with_gains(k, basis.reference[k])
        bench.journals[k].note(
            "the gains of the baseline rule are kept: on the digital twins, the gains found by "
            "search are worse once slowed"
        )
    return show(bench, basis, recorded, better) if better.any() else recorded


def _try_rule_where_bad(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Record a move with the rule's gains on axes that moved badly, and keep what moved better."""
    shown = recorded.shown
    if shown is None or bench.ground is None:
        return recorded
    where = bench.going & shown.where & (shown.cost > BAD) & (recorded.gains != basis.reference).any(axis=1)
    where = bench.whole_machines(where & bench.affordable(MOVE_TIME))
    if not where.any():
        return recorded
    try:
        with bench.spending(where):
            with_rule = bench.ground.show(basis.reference, where)
    except SafetyError as error:
        bench.note(where, f"the envelope stopped the move with the baseline rule's gains: {error}")
        return recorded
    faulted = np.isin(np.arange(bench.target.num_axes), list(bench.faults()))
    if faulted.any():
        with bench.spending(bench.target.together(faulted)):
            bench.ground.recover(faulted)
        bench.drop_faults("moving with the baseline rule's gains, and the fault cannot be reset")
    passed = np.array([not reason for reason in with_rule.reason])
    better = bench.whole_machines(where & passed & ~with_rule.restless & (with_rule.cost < shown.cost))
    for k in map(int, np.flatnonzero(better)):
        recorded = recorded.with_gains(k, basis.reference[k])
        bench.journals[k].note(
            f"the gains of the baseline rule are kept: the measured cost J of a move was {with_rule.cost[k]:.2f} with "
            f"them and {shown.cost[k]:.2f} with the gains found by search"
        )
    return recorded.with_move(with_rule._replace(where=better))


def _rule_is_better(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> Mask:
    """Return the axes for which the rule's gains are better than the present ones, (num_axes,)."""
    target, response = bench.target, recorded.response
    better = np.zeros(target.num_axes, bool)
    differs = (recorded.gains != basis.reference).any(axis=1)
    affordable = bench.affordable(MOVE_TIME + basis.look_back_time(bench))
    chosen = np.flatnonzero(bench.going & ~recorded.unseen & np.isfinite(recorded.cost) & differs & affordable)
    if response is None or not chosen.size:
        return better
    axes = chosen.tolist()
    both = np.stack([recorded.gains[chosen], basis.reference[chosen]], axis=1)
    for k, (own, rule) in zip(axes, cost_on_twins(bench, basis, axes, both), strict=True):
        better[k] = rule < CLEARLY * own and (
            sensitivity(target, basis, response, basis.reference[k], k) <= SENSITIVITY
        )
    return better
