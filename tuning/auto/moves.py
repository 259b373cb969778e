"""Recorded moves with the new gains and the gains before, and whether axes are at rest afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env.drives.raw_gains import write_gains
from drive_env.safety.envelope import SafetyError
from mechanics.arrays import Mask
from tuning.auto.bench import PREVIOUS_GAINS_TIME
from tuning.auto.load_step import NOISE, SWING, load_step
from tuning.auto.loop_margins import measured_axis
from tuning.auto.loop_model import loop_models
from tuning.auto.proving import RESTLESS, without_noise

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.target import Target

STEP_TIME = 1.0  # s of drive time for a step of the set-point
CALMING = 0.5  # s for an oscillation after a load step to decay with calm gains
BY_COMPARISON = "by a move, which was better than with the new ones: the gains before are kept"


def record_final_move(bench: AutoBench, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Record a move of axes with their gains, and check whether they are at rest afterwards."""
    going = bench.target.together(where & bench.going)
    if not going.any():
        return recorded
    failed = recorded.failed.copy()
    try:
        with bench.spending(going):
            shown = bench.ground.show(recorded.gains, going)
    except SafetyError as error:
        bench.recover(going)
        failed[going] = f"the envelope stopped the move with the new gains: {error}"
        return replace(recorded, failed=failed)
    swing = np.where(going, without_noise(shown.swing, shown.noise), recorded.swing)
    faults = bench.faults()
    for k in map(int, np.flatnonzero(going)):
        failed[k] = f"the move with the new gains failed: {shown.reason[k]}" if shown.reason[k] else ""
        if k in faults:
            failed[k] = f"the drive went into fault in the move with the new gains: {faults[k]}"
        elif not failed[k] and shown.restless[k]:
            failed[k] = f"it does not come to rest: {_shook(shown.swing[k], shown.noise[k], 'at rest')}"
    bench.recover_faults(faults, "moving with the new gains")
    shown = shown if recorded.shown is None else recorded.shown.replaced(shown)
    return replace(recorded, shown=shown, failed=failed, swing=swing)


def step(bench: AutoBench, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Make a small step of the set-point in csp with the gains of axes, and record the overshoot."""
    going = bench.whole_machines(where & bench.going & (recorded.failed == "")) & bench.affordable(STEP_TIME)
    if not going.any():
        return recorded
    try:
        with bench.spending(going):
            overshoot = bench.ground.step(recorded.gains, going)
    except SafetyError as error:
        bench.note(going, f"the envelope stopped a step of the set-point in csp: {error}")
        bench.recover(going)
        overshoot = np.full(len(going), np.nan)
    return replace(recorded, overshoot=np.where(going, overshoot, recorded.overshoot))


def _shook(swing: float, noise: float, when: str) -> str:
    """Describe the swing of a current over the rated one."""
    told = f"its current swung by {100.0 * swing:.1f} % of the rated current (RMS) {when}"
    if noise > 0.0:
        alone = float(without_noise(swing, noise))
        told += f", {100.0 * alone:.1f} % without the noise of its measurement"
    return f"{told}; {100.0 * RESTLESS:.0f} % is allowed"


def load(bench: AutoBench, basis: Basis, recorded: RecordedGains, target: Target, where: Mask) -> RecordedGains:
    """Make a load step on emulated machines: axes that oscillate after it fail.

    Args:
        bench: The drives.
        basis: Has gains that damp an oscillation.
        recorded: The gains, and their move.
        target: The drives with time that is not counted, since a load step is not part of tuning.
        where: Axes to check, (num_axes,).
    """
    still = bench.whole_machines(where & bench.going & (recorded.failed == ""))
    if target.drives.machine is None or not still.any():
        return recorded
    write_gains(target.drives, recorded.gains, still)
    loaded = {**recorded.loaded, **load_step(target, still)}
    swing, failed, most = np.zeros(len(still)), recorded.failed.copy(), recorded.swing.copy()
    swing[still] = [0.01 * loaded[int(k)].figures[SWING] for k in np.flatnonzero(still)]
    if (large := swing > RESTLESS).any():
        noise = bench.ground.noise(recorded.gains, large)
        alone = without_noise(swing, noise)
        shook = large & (alone > RESTLESS)
        for k in map(int, np.flatnonzero(large)):
            loaded[k] = replace(loaded[k], figures={**loaded[k].figures, NOISE: 100.0 * float(noise[k])})
        for k in map(int, np.flatnonzero(shook)):
            told = _shook(swing[k], noise[k], "after a load step of 0.3 of the rated torque")
            failed[k], most[k] = f"it does not come to rest: {told}", alone[k]
        if shook.any():
            # The oscillation must have decayed before the next gains are judged.
            write_gains(target.drives, basis.calm, bench.target.together(shook))
            target.drives.advance(CALMING)
    return replace(recorded, loaded=loaded, failed=failed, swing=most)


def record_previous_gains(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Record a move with the gains before if these are safe by the model; keep them if they are better."""
    going = bench.going
    late = ~bench.affordable(PREVIOUS_GAINS_TIME)
    why = np.where((basis.unsafe == "") & late, "the drive time was used up", basis.unsafe)
    able = bench.whole_machines(going & (why == ""))
    for k in map(int, np.flatnonzero(going & ~able)):
        told = why[k] or "another axis of its machine cannot make it"
        bench.journals[k].note(f"no comparison move with the gains before: {told}")
    if not able.any():
        return recorded
    try:
        with bench.spending(able):
            earlier = bench.ground.show(basis.before, able)
    except SafetyError as error:
        bench.note(able, f"the envelope stopped the move with the gains before: {error}")
        return recorded
    failed = able & (np.array(earlier.reason, object) != "")
    for k, causes in bench.faults().items():
        if able[k]:
            # The gains before caused the fault, which favours the new ones.
            failed[k] = True
            bench.journals[k].note(f"the drive went into fault in the move with the gains before: {causes}")
        else:
            bench.journals[k].stop(f"the drive went into fault while holding its position: {causes}")
    for k in map(int, np.flatnonzero(failed)):
        if earlier.reason[k]:
            bench.journals[k].note(f"in the move with the gains before, {earlier.reason[k]}")
    if failed.any():
        bench.recover(failed)
    comparable = bench.whole_machines(able & ~failed) & bench.going
    return keep_what_is_better(bench, basis, replace(recorded, earlier=earlier), comparable)


def keep_what_is_better(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Keep the gains before on machines whose loops keep the dynamics at least as well with them and that moved better.

    The worst axis of a machine counts. Loops are judged as measured, and by the model in all variants; if they were not
    measured, the new gains stay. Measurement errors are the same for both gains, so they are ignored.
    """
    assert recorded.shown is not None and recorded.earlier is not None, "both moves are recorded"
    shown, earlier, axes = recorded.shown, recorded.earlier, bench.target.axes_per_machine
    slack = np.full(len(where), np.nan)
    for k in map(int, np.flatnonzero(where)):
        if (measured := measured_axis(bench, basis, recorded, k)) is not None:
            slack[k] = measured.slack(bench.dynamics, basis.before[k][None])[0]
    of_before, of_new = slack.copy(), recorded.slack.copy()
    for model, own in loop_models(bench.target, basis.identified, recorded, where, bench.dynamics):
        for known, gains in ((of_before, basis.before), (of_new, recorded.gains)):
            known[own] = np.minimum(known[own], model.slack(bench.dynamics, gains[own][None])[0])
    now, before = (np.repeat(one.cost.reshape(-1, axes).max(axis=1), axes) for one in (shown, earlier))
    # Gains with which an axis oscillates at rest are never kept.
    kept = where & (before < now) & ~np.repeat(earlier.restless.reshape(-1, axes).any(axis=1), axes)
    kept = bench.whole_machines(kept & (of_before >= np.fmin(of_new, 0.0)))
    if not kept.any():
        return recorded
    for k in map(int, np.flatnonzero(kept)):
        bench.journals[k].undo(recorded.gains[k], basis.before[k], "the gains before are kept")
        bench.journals[k].note(
            f"the gains before are kept: the measured cost J of a move was {now[k]:.2f} with the new gains and "
            f"{before[k]:.2f} with the gains before"
        )
    return replace(
        recorded,
        gains=np.where(kept[:, None], basis.before, recorded.gains),
        proof=np.where(kept, earlier.cost, recorded.proof),
        slack=np.where(kept, slack, recorded.slack),
        overshoot=np.where(kept, np.nan, recorded.overshoot),
        verified=np.where(kept, BY_COMPARISON, recorded.verified),
        shown=shown.replaced(earlier._replace(where=kept)),
        earlier=earlier._replace(where=earlier.where & ~kept),
        kept=kept,
    )
