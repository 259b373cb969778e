"""Recorded moves with the new gains and the gains before, and the check that axes are at rest afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import cascade_columns, write_gains
from drive_env.safety.envelope import SafetyError
from tuning.auto.bench import MOVE_TIME, TRIAL_TIME
from tuning.auto.calmer_gains import calmer, searches_all
from tuning.auto.load_step import NOISE, SWING, load_step
from tuning.auto.proving import RESTLESS, without_noise
from tuning.auto.stages import RecordedGains
from tuning.auto.trials import faster

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis
    from tuning.target import Target

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

SHOWINGS, AT_THE_EDGE = 3, 0.6  # moves for the record until one passes, and the factor of the gains between them
CALMING = 0.5  # s after a load step that did not end, with gains that hold
OVERTIME = 5.0  # s beyond the budget for axes that still shake: so near to the end they are not given up
# How often the gains of an axis that shook at rest are eased, and the least and greatest factor of its bandwidth. The
# noise of the encoder goes into the current by velocity P, so that it falls as the bandwidth does.
# What swings by more than LIMIT_CYCLE is no noise, and may swing more with less gain.
EASINGS, EASED_LEAST, EASED, EASED_TO, LIMIT_CYCLE = 3, 0.5, 0.8, 0.9, 0.2
BY_COMPARISON = "by a move, which was better than with the new ones: the gains before are kept"


def show(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask | None = None) -> RecordedGains:
    """Return what a recorded move with the gains shows, of all axes or some; an axis that fails is rejected."""
    going = bench.going if where is None else bench.target.together(where)
    if not going.any():
        return recorded
    assert bench.ground is not None, "proving makes it"
    eased = np.zeros(bench.target.num_axes, bool)
    for attempt in range(SHOWINGS):
        try:
            with bench.spending(going):
                shown = bench.ground.show(recorded.gains, going)
        except SafetyError as error:
            stopped_by = f"the envelope stopped the move with the new gains: {error}"
            if attempt == SHOWINGS - 1 or not bench.affordable(MOVE_TIME)[going].all():
                bench.stop(going, stopped_by)
                return recorded
            # It stops all axes, whichever it was.
            with bench.spending(going):
                bench.ground.recover(going)
            for k in map(int, np.flatnonzero(going)):
                recorded = _after_failure(bench, basis, recorded, k, stopped_by)
            continue
        recorded = recorded.with_move(shown)
        failed = going & np.array([bool(reason) for reason in shown.reason])
        # Time for a response, and for what may follow from it, is kept; what was calmed by one is not eased, too.
        later = bench.response_time + TRIAL_TIME + MOVE_TIME + basis.look_back_time(bench)
        again = going & ~failed & shown.restless & ~eased & bench.affordable(MOVE_TIME + later) & (where is None)
        for k in map(int, np.flatnonzero(again)):
            recorded = ease(bench, basis, recorded, k, *_shook(shown.swing[k], shown.noise[k], "at rest"))
        eased |= again
        for k in map(int, np.flatnonzero(failed)):
            if attempt == SHOWINGS - 1 or not bench.affordable(MOVE_TIME)[k]:
                bench.journals[k].stop(f"the move with the new gains failed: {shown.reason[k]}")
            else:
                recorded = _after_failure(bench, basis, recorded, k, shown.reason[k])
        # Axes of one machine pull at one load: one that is to move again has the others move with it.
        axes = bench.target.axes_per_machine
        going = np.repeat((failed | again).reshape(-1, axes).any(axis=1), axes) & bench.going
        if not going.any():
            break
    bench.drop_faults("moving with the new gains")
    return recorded


def _after_failure(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, why: str) -> RecordedGains:
    """Take other gains for an axis whose move failed: what passed once and fails now is at its edge."""
    journal, gains = bench.journals[k], recorded.gains[k]
    if recorded.spare[k].any() and not np.array_equal(recorded.spare[k], gains):
        journal.note(f"the second best gains of the trial are kept: with the best, in another move, {why}")
        return recorded.with_gains(k, recorded.spare[k])
    if recorded.eased[k] and not np.array_equal(gains, basis.reference[k]):
        journal.note(f"the gains of the baseline rule are kept: with the lowered ones, in another move, {why}")
        return recorded.with_gains(k, basis.reference[k])
    journal.note(f"gains lowered to {100.0 * AT_THE_EDGE:.0f} % after the trial: in another move, {why}")
    return recorded.with_gains(k, faster(bench.target.device.gains, gains, AT_THE_EDGE))


def ease(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, swing: float, why: str) -> RecordedGains:
    """Take lower gains for an axis that shook: the same, lowered by as much as it shook, or the baseline rule's.

    Args:
        bench: The drives.
        basis: What to fall back on.
        recorded: The present gains.
        k: The axis.
        swing: Of its current over the rated one, RMS.
        why: What it did, in words.
    """
    journal, own, rule = bench.journals[k], recorded.gains[k], basis.reference[k]
    torque_p, _, velocity_p, *_ = cascade_columns(bench.target.device)
    factor = float(np.clip(EASED_TO * RESTLESS / swing, EASED_LEAST, EASED))
    # What less velocity P has not calmed may be the current loop's doing, whose gains are searched on twins as well.
    has_fast_current = recorded.eased[k] and own[torque_p] > rule[torque_p] and not searches_all(bench.target)
    failed = recorded.rule is not None and recorded.rule.where[k] and not recorded.rule.passed[k]
    if not np.array_equal(own, rule) and not failed and (swing > LIMIT_CYCLE or has_fast_current):
        gains = rule
        journal.note(f"the gains of the baseline rule are kept: with faster ones {why}")
    else:
        gains = calmer(bench, basis, recorded, k, factor, swing, EASED_TO * RESTLESS)
        share = gains[velocity_p] / own[velocity_p]
        if share < 1.0:
            journal.note(f"velocity P lowered to {100.0 * share:.0f} %, the others chosen for it: {why}")
        else:
            journal.note(f"gains taken with which its digital twins swing less at rest: {why}")
    # The second best are about as fast as the best, which shook.
    return replace(recorded.with_gains(k, gains), eased=recorded.eased + (np.arange(len(recorded.eased)) == k))


def _shook(swing: float, noise: float, when: str) -> tuple[float, str]:
    """Return by how much a current swings apart from the noise of its measurement, over the rated one; and in words."""
    alone = float(without_noise(swing, noise))
    told = f"its current swung by {100.0 * swing:.1f} % of the rated current (RMS) {when}"
    if noise > 0.0:
        told += f", {100.0 * alone:.1f} % without the noise of its measurement"
    return alone, f"{told}; {100.0 * RESTLESS:.0f} % is allowed"


def stand(bench: AutoBench, basis: Basis, recorded: RecordedGains, target: Target) -> RecordedGains:
    """Check that axes are at rest, on emulated machines after a load step too; lower gains or reject.

    Args:
        bench: The drives.
        basis: What to fall back on.
        recorded: The gains, and their move.
        target: The drives, whose time is not counted, since a load step is not part of tuning.
    """
    for attempt in range(EASINGS + 2):
        recorded, restless = shaking(bench, basis, recorded, target)
        again = np.zeros(bench.target.num_axes, bool)
        for k, (swing, why) in restless.items():
            last = attempt >= EASINGS or recorded.kept[k] or not bench.affordable(MOVE_TIME - OVERTIME)[k]
            if last and attempt <= EASINGS and rule_stands(recorded, k) and not is_rule(recorded, k):
                recorded = with_rule(bench, recorded, k)
                assert recorded.rule is not None, "it stands"
                bench.journals[k].note(f"{recorded.rule.title(k)} are kept: with faster ones {why}")
                again[k] = True
            elif last:
                bench.journals[k].stop(f"it does not come to rest: {why}")
            else:
                recorded = ease(bench, basis, recorded, k, swing, why)
                again[k] = True
        if not again.any():
            break
        recorded = show(bench, basis, recorded, again & bench.going)
    for k in np.flatnonzero(bench.going).tolist():
        if recorded.shown is not None and recorded.shown.noise[k] > 0.0:
            _, told = _shook(recorded.shown.swing[k], recorded.shown.noise[k], "at rest")
            bench.journals[k].note(told)
    return recorded


def rule_stands(recorded: RecordedGains, k: int) -> bool:
    """Return whether the baseline rule's gains, or those lowered, have passed and stood on the machine of an axis."""
    return recorded.rule is not None and bool(recorded.rule.passed[k])


def is_rule(recorded: RecordedGains, k: int) -> bool:
    """Return whether an axis has the baseline rule's gains as they were tried."""
    return recorded.rule is not None and np.array_equal(recorded.gains[k], recorded.rule.gains[k])


def with_rule(bench: AutoBench, recorded: RecordedGains, k: int) -> RecordedGains:
    """Return the baseline rule's gains on all axes of a machine, as they have stood there, of which one is given."""
    assert recorded.rule is not None, "it was tried"
    lanes = bench.target.axes_per_machine
    first = k - k % lanes
    for axis in range(first, first + lanes):
        recorded = recorded.with_gains(axis, recorded.rule.gains[axis])
    here = np.arange(len(recorded.gains)) // lanes == k // lanes
    return replace(recorded, kept=recorded.kept & ~here)


def shaking(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, target: Target, where: Mask | None = None
) -> tuple[RecordedGains, dict[int, tuple[float, str]]]:
    """Return the axes that are not at rest: the swing of their current over the rated current, and a message.

    Args:
        bench: The drives.
        basis: What to fall back on.
        recorded: The gains, and their move.
        target: The drives, whose time is not counted.
        where: Axes that are looked at, (num_axes,); those that go on by default.
    """
    going, shown = bench.going if where is None else where, recorded.shown
    if shown is None or not going.any():
        return recorded, {}
    found = {}
    for k in np.flatnonzero(going & shown.restless).tolist():
        found[k] = _shook(shown.swing[k], shown.noise[k], "at rest")
    if target.drives.machine is not None:
        still = bench.whole_machines(going & ~shown.restless)
        write_gains(target.drives, recorded.gains, still)
        recorded = replace(recorded, loaded={**recorded.loaded, **load_step(target, still)})
        recorded, swings = _after_load_step(bench, recorded, still)
        for k, (swing, noise) in swings.items():
            alone, why = _shook(swing, noise, "after a load step of 0.3 of the rated torque")
            if alone > RESTLESS:
                found[k] = alone, why
        shook = bench.whole_machines(~np.isin(np.arange(bench.target.num_axes), list(found)))
        if not shook[still].all():
            # What the load step has set swinging says nothing of the next gains.
            write_gains(target.drives, basis.fallbacks[-1], still & ~shook)
            target.drives.advance(CALMING)
    return recorded, found


def _after_load_step(
    bench: AutoBench, recorded: RecordedGains, where: Mask
) -> tuple[RecordedGains, dict[int, tuple[float, float]]]:
    """Return the axes whose current swings after it: by how much, and the noise in that, both over the rated one."""
    swing = np.zeros(len(where))
    swing[where] = [0.01 * recorded.loaded[k].figures[SWING] for k in map(int, np.flatnonzero(where))]
    large = swing > RESTLESS
    if not large.any():
        return recorded, {}
    assert bench.ground is not None, "proving makes it"
    noise = bench.ground.noise(recorded.gains, large)
    chosen, loaded = [int(k) for k in np.flatnonzero(large)], dict(recorded.loaded)
    for k in chosen:
        loaded[k] = replace(loaded[k], figures={**loaded[k].figures, NOISE: 100.0 * float(noise[k])})
    return replace(recorded, loaded=loaded), {k: (float(swing[k]), float(noise[k])) for k in chosen}


def look_back(bench: AutoBench, basis: Basis, recorded: RecordedGains) -> RecordedGains:
    """Record a move with the gains before, where they are safe by the model; keep them where they are better."""
    going = bench.going
    late = going & ~bench.affordable(basis.look_back_time(bench))
    reasons = [why or ("the drive time was used up" if late[k] else "") for k, why in enumerate(basis.unsafe)]
    able = bench.whole_machines(going & np.array([not why for why in reasons]))
    for k in map(int, np.flatnonzero(going & ~able)):
        why = reasons[k] or "another axis of its machine cannot make it"
        bench.journals[k].note(f"no comparison move with the gains before: {why}")
    if not able.any():
        return recorded
    assert bench.ground is not None, "proving makes it"
    try:
        with bench.spending(able):
            earlier = bench.ground.show(basis.before, able)
    except SafetyError as error:
        bench.note(able, f"the envelope stopped the move with the gains before: {error}")
        return recorded
    failed = np.array([bool(reason) for reason in earlier.reason])
    for k, causes in bench.faults().items():
        if able[k]:
            # That is those gains' doing, and speaks for the new ones.
            failed[k] = True
            bench.journals[k].note(f"the drive went into fault in the move with the gains before: {causes}")
        else:
            bench.journals[k].stop(f"the drive went into fault while holding its position: {causes}")
    for k in map(int, np.flatnonzero(able & failed)):
        if earlier.reason[k]:
            bench.journals[k].note(f"in the move with the gains before, {earlier.reason[k]}")
    if (able & failed).any():
        with bench.spending(able & failed):
            bench.ground.recover(able & failed)
    comparable = bench.whole_machines(able & ~failed) & bench.going
    return keep_what_is_better(bench, basis, replace(recorded, earlier=earlier), comparable)


def keep_what_is_better(bench: AutoBench, basis: Basis, recorded: RecordedGains, where: Mask) -> RecordedGains:
    """Keep the gains before on machines that moved better with them; a machine counts as its worst axis."""
    assert recorded.shown is not None and recorded.earlier is not None, "both moves are recorded"
    shown, earlier, axes = recorded.shown, recorded.earlier, bench.target.axes_per_machine
    now, before = (np.repeat(m.cost.reshape(-1, axes).max(axis=1), axes) for m in (shown, earlier))
    # Gains with which an axis shakes at rest are nobody's choice.
    kept = where & (before < now) & ~np.repeat(earlier.restless.reshape(-1, axes).any(axis=1), axes)
    if not kept.any():
        return recorded
    for k in map(int, np.flatnonzero(kept)):
        bench.journals[k].note(
            f"the gains before are kept: the measured cost J of a move was {now[k]:.2f} with the new gains and "
            f"{before[k]:.2f} with the gains before"
        )
    return replace(
        recorded,
        gains=np.where(kept[:, None], basis.before, recorded.gains),
        proof=np.where(kept, before, recorded.proof),
        verified=tuple(BY_COMPARISON if one else words for one, words in zip(kept, recorded.verified, strict=True)),
        shown=shown.replaced(earlier._replace(where=kept)),
        earlier=earlier._replace(where=earlier.where & ~kept),
        kept=kept,
    )
