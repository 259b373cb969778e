"""Recorded moves with the new gains and the gains before, and the check that axes are at rest afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import cascade_columns, write_gains
from drive_env.safety.envelope import SafetyError
from tuning.auto.calmer_gains import calmer
from tuning.auto.load_step import NOISE, SWING, load_step
from tuning.auto.proving import RESTLESS, without_noise
from tuning.auto.run import MOVE_TIME, TRIAL_TIME
from tuning.auto.trials import faster

if TYPE_CHECKING:
    from tuning.auto.run import AutoRun
    from tuning.target import Target

Mask = NDArray[np.bool_]

SHOWINGS, AT_THE_EDGE = 3, 0.6  # moves for the record until one passes, and the factor of the gains between them
CALMING = 0.5  # s after a load step that did not end, with gains that hold
OVERTIME = 2.5  # s beyond the budget for axes that still shake: so near to the end they are not given up
# How often the gains of an axis that shook at rest are eased, and the least and greatest factor of its bandwidth. The
# noise of the encoder goes into the current by velocity P, so that it falls as the bandwidth does.
# What swings by more than LIMIT_CYCLE is no noise, and may swing more with less gain.
EASINGS, EASED_LEAST, EASED, EASED_TO, LIMIT_CYCLE = 3, 0.5, 0.8, 0.9, 0.2


def show(run: AutoRun, where: Mask | None = None) -> None:
    """Record a move with the new gains, of all axes or some; an axis that fails is rejected."""
    going = run.going if where is None else run.target.together(where)
    if not going.any():
        return
    assert run.ground is not None, "proving makes it"
    eased = np.zeros(run.target.num_axes, bool)
    for attempt in range(SHOWINGS):
        try:
            with run.spending(going):
                shown = run.ground.show(run.gains, going)
        except SafetyError as error:
            run.stop(going, f"the envelope stopped the move with the new gains: {error}")
            return
        run.shown = shown if run.shown is None else run.shown.replaced(shown)
        failed = going & np.array([bool(reason) for reason in shown.reason])
        last = attempt == SHOWINGS - 1
        # Time for a response, and for what may follow from it, is kept; what was calmed by one is not eased, too.
        later = run.response_time + TRIAL_TIME + MOVE_TIME + run.look_back_time
        again = going & ~failed & shown.restless & ~eased & run.affordable(MOVE_TIME + later) & (where is None)
        for k in map(int, np.flatnonzero(again)):
            _ease(run, k, *_shook(shown.swing[k], shown.noise[k], "at rest"))
        eased |= again
        for k in map(int, np.flatnonzero(failed)):
            axis, why = run.axes[k], shown.reason[k]
            if last or not run.affordable(MOVE_TIME)[k]:
                axis.reason = f"the move with the new gains failed: {why}"
                continue
            # What passed once and fails now is at its edge.
            if run.spare[k].any():
                run.gains[k], run.spare[k] = run.spare[k], 0
                axis.notes.append(f"the second best gains of the trial are kept: with the best, in another move, {why}")
            elif axis.eased and not np.array_equal(run.gains[k], run.reference[k]):
                run.gains[k] = run.reference[k]
                axis.notes.append(
                    f"the gains of the baseline rule are kept: with the lowered ones, in another move, {why}"
                )
            else:
                run.gains[k] = faster(run.target.device.gains, run.gains[k], AT_THE_EDGE)
                axis.notes.append(
                    f"gains lowered to {100.0 * AT_THE_EDGE:.0f} % after the trial: in another move, {why}"
                )
        # Axes of one machine pull at one load: one that is to move again has the others move with it.
        axes = run.target.axes_per_machine
        going = np.repeat((failed | again).reshape(-1, axes).any(axis=1), axes) & run.going
        if not going.any():
            break
    run.drop_faults("moving with the new gains")


def _ease(run: AutoRun, k: int, swing: float, why: str) -> None:
    """Take lower gains for an axis that shook: the same, lowered by as much as it shook, or the baseline rule's.

    Args:
        run: The run.
        k: The axis.
        swing: Of its current over the rated one, RMS.
        why: What it did, in words.
    """
    axis, rule = run.axes[k], run.reference[k]
    torque_p, _, velocity_p, *_ = cascade_columns(run.target.device)
    factor = float(np.clip(EASED_TO * RESTLESS / swing, EASED_LEAST, EASED))
    is_rule = np.array_equal(run.gains[k], rule)
    # What less velocity P has not calmed may be the current loop's doing.
    has_fast_current = axis.eased and run.gains[k, torque_p] > rule[torque_p]
    if not is_rule and (swing > LIMIT_CYCLE or has_fast_current):
        run.gains[k] = rule
        axis.notes.append(f"the gains of the baseline rule are kept: with faster ones {why}")
    else:
        before, run.gains[k] = run.gains[k, velocity_p], calmer(run, k, factor)
        share = 100.0 * run.gains[k, velocity_p] / before
        axis.notes.append(f"velocity P lowered to {share:.0f} %, the other gains with it: {why}")
    run.spare[k] = 0  # about as fast as the best, which shook
    axis.eased += 1


def _shook(swing: float, noise: float, when: str) -> tuple[float, str]:
    """Return by how much a current swings apart from the noise of its measurement, over the rated one; and in words."""
    alone = float(without_noise(swing, noise))
    told = f"its current swung by {100.0 * swing:.1f} % of the rated current (RMS) {when}"
    if noise > 0.0:
        told += f", {100.0 * alone:.1f} % without the noise of its measurement"
    return alone, f"{told}; {100.0 * RESTLESS:.0f} % is allowed"


def stand(run: AutoRun, target: Target) -> None:
    """Check that axes are at rest, on emulated machines after a load step too; lower gains or reject.

    Args:
        run: The run.
        target: Its target, whose time is not counted, since a load step is not part of tuning.
    """
    for attempt in range(EASINGS + 1):
        shaking = _shaking(run, target)
        last = attempt == EASINGS
        again = np.zeros(run.target.num_axes, bool)
        for k, (swing, why) in shaking.items():
            axis = run.axes[k]
            if last or axis.is_kept or not run.affordable(MOVE_TIME - OVERTIME)[k]:
                axis.reason = f"it does not come to rest: {why}"
            else:
                _ease(run, k, swing, why)
                again[k] = True
        if not again.any():
            break
        show(run, again & run.going)
    for k in np.flatnonzero(run.going).tolist():
        if run.shown is not None and run.shown.noise[k] > 0.0:
            _, told = _shook(run.shown.swing[k], run.shown.noise[k], "at rest")
            run.axes[k].notes.append(told)


def _shaking(run: AutoRun, target: Target) -> dict[int, tuple[float, str]]:
    """Return the axes that are not at rest: the swing of their current over the rated current, and a message."""
    going, shown = run.going, run.shown
    if shown is None or not going.any():
        return {}
    found = {}
    for k in np.flatnonzero(going & shown.restless).tolist():
        found[k] = _shook(shown.swing[k], shown.noise[k], "at rest")
    if target.drives.machine is not None:
        still = run.whole_machines(going & ~shown.restless)
        write_gains(target.drives, run.gains, still)
        run.loaded |= load_step(target, still)
        for k, (swing, noise) in _after_load_step(run, still).items():
            alone, why = _shook(swing, noise, "after a load step of 0.3 of the rated torque")
            if alone > RESTLESS:
                found[k] = alone, why
        shook = run.whole_machines(~np.isin(np.arange(run.target.num_axes), list(found)))
        if not shook[still].all():
            # What the load step has set swinging says nothing of the next gains.
            write_gains(target.drives, run.fallbacks[-1], still & ~shook)
            target.drives.advance(CALMING)
    return found


def _after_load_step(run: AutoRun, where: Mask) -> dict[int, tuple[float, float]]:
    """Return the axes whose current swings after it: by how much, and the noise in that, both over the rated one."""
    loaded = np.zeros(len(where))
    loaded[where] = [0.01 * run.loaded[k].figures[SWING] for k in map(int, np.flatnonzero(where))]
    large = loaded > RESTLESS
    if not large.any():
        return {}
    assert run.ground is not None, "proving makes it"
    noise = run.ground.noise(run.gains, large)
    found = {}
    for k in map(int, np.flatnonzero(large)):
        step = run.loaded[k]
        run.loaded[k] = replace(step, figures={**step.figures, NOISE: 100.0 * float(noise[k])})
        found[k] = float(loaded[k]), float(noise[k])
    return found


def look_back(run: AutoRun) -> None:
    """Record a move with the gains before, where they are safe by the model; keep them where they are better."""
    going = run.going
    late = going & ~run.affordable(run.look_back_time)
    reasons = [why or ("the drive time was used up" if late[k] else "") for k, why in enumerate(run.unsafe)]
    able = run.whole_machines(going & np.array([not why for why in reasons]))
    for k in map(int, np.flatnonzero(going & ~able)):
        why = reasons[k] or "another axis of its machine cannot make it"
        run.axes[k].notes.append(f"no comparison move with the gains before: {why}")
    if not able.any():
        return
    assert run.ground is not None, "proving makes it"
    try:
        with run.spending(able):
            run.earlier = earlier = run.ground.show(run.before, able)
    except SafetyError as error:
        run.note(able, f"the envelope stopped the move with the gains before: {error}")
        return
    failed = np.array([bool(reason) for reason in earlier.reason])
    for k, causes in run.faults().items():
        if able[k]:
            # That is those gains' doing, and speaks for the new ones.
            failed[k] = True
            run.axes[k].notes.append(f"the drive went into fault in the move with the gains before: {causes}")
        else:
            run.axes[k].reason = f"the drive went into fault while holding its position: {causes}"
    for k in map(int, np.flatnonzero(able & failed)):
        if earlier.reason[k]:
            run.axes[k].notes.append(f"in the move with the gains before, {earlier.reason[k]}")
    if (able & failed).any():
        with run.spending(able & failed):
            run.ground.recover(able & failed)
    _keep_what_is_better(run, run.whole_machines(able & ~failed) & run.going)


def _keep_what_is_better(run: AutoRun, where: Mask) -> None:
    """Keep the gains before on machines that moved better with them; a machine counts as its worst axis."""
    assert run.shown is not None and run.earlier is not None, "both moves are recorded"
    axes = run.target.axes_per_machine
    now, before = (np.repeat(m.cost.reshape(-1, axes).max(axis=1), axes) for m in (run.shown, run.earlier))
    # Gains with which an axis shakes at rest are nobody's choice.
    kept = where & (before < now) & ~np.repeat(run.earlier.restless.reshape(-1, axes).any(axis=1), axes)
    if not kept.any():
        return
    run.gains = np.where(kept[:, None], run.before, run.gains)
    run.shown = run.shown.replaced(run.earlier._replace(where=kept))
    run.earlier = run.earlier._replace(where=run.earlier.where & ~kept)
    for k in map(int, np.flatnonzero(kept)):
        axis = run.axes[k]
        axis.is_kept, axis.proof = True, float(before[k])
        axis.verified = "by a move, which was better than with the new ones: the gains before are kept"
        axis.notes.append(
            f"the gains before are kept: the measured cost J of a move was {now[k]:.2f} with the new gains and "
            f"{before[k]:.2f} with the gains before"
        )
