"""Moves for the record: with the new gains, and with those before, which are kept where they do better."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.safety.envelope import SafetyError
from tuning.auto_run import MOVE_TIME, TRIAL_TIME
from tuning.auto_trials import faster
from tuning.proving import RESTLESS

if TYPE_CHECKING:
    from tuning.auto_run import Run

Mask = NDArray[np.bool_]

SHOWINGS, AT_THE_EDGE = 3, 0.6  # moves for the record until one passes, and the factor of the gains between them
EASED = 0.8  # the factor of gains with which an axis shook at rest


def show(run: Run, where: Mask | None = None) -> None:
    """Record a move with the new gains, of all axes or some; one that fails is refused."""
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
        for k in map(int, np.flatnonzero(going & ~failed & shown.restless)):
            _ease(run, k, float(shown.swing[k]), bool(again[k]))
        eased |= again
        for k in map(int, np.flatnonzero(failed)):
            axis, why = run.axes[k], shown.reason[k]
            if last or not run.affordable(MOVE_TIME)[k]:
                axis.reason = f"the move with the new gains failed: {why}"
                continue
            # What passed once and fails now is at its edge.
            if run.spare[k].any():
                run.gains[k], run.spare[k] = run.spare[k], 0
                axis.notes.append(f"the second best of the trial: with the best, in one more move {why}")
            else:
                run.gains[k] = faster(run.gains[k], AT_THE_EDGE)
                axis.notes.append(f"slowed to {100.0 * AT_THE_EDGE:.0f} % after the trial: in one more move {why}")
        # Axes of one machine pull at one load: one that is to move again has the others move with it.
        lanes = run.target.axes_per_machine
        going = np.repeat((failed | again).reshape(-1, lanes).any(axis=1), lanes) & run.going
        if not going.any():
            break
    run.drop_faults("it moved with the new gains")


def _ease(run: Run, k: int, swing: float, again: bool) -> None:
    """Say that an axis shook at rest; where there is another move for it, take calmer gains for that."""
    shook = f"its current swung by {100.0 * swing:.0f} % of the rated one (RMS) at rest"
    if not again:
        run.axes[k].notes.append(f"it shakes at rest: {shook}; {100.0 * RESTLESS:.0f} % is still")
    elif run.spare[k].any():
        run.gains[k], run.spare[k] = run.spare[k], 0
        run.axes[k].notes.append(f"the second best of the trial: with the best, {shook}")
    else:
        run.gains[k] = faster(run.gains[k], EASED)
        run.axes[k].notes.append(f"slowed to {100.0 * EASED:.0f} % after the trial: {shook}")


def look_back(run: Run) -> None:
    """Record a move with the gains before, where they are safe by the model; keep them where they do better."""
    going = run.going
    late = going & ~run.affordable(run.look_back_time)
    reasons = [why or ("the drive time was used up" if late[k] else "") for k, why in enumerate(run.unsafe)]
    able = run.whole_machines(going & np.array([not why for why in reasons]))
    for k in map(int, np.flatnonzero(going & ~able)):
        why = reasons[k] or "another axis of its machine could not make it"
        run.axes[k].notes.append(f"no move with the gains before, for comparison: {why}")
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
            run.axes[k].notes.append(f"the drive went into fault as it moved with the gains before: {causes}")
        else:
            run.axes[k].reason = f"the drive went into fault while it held its place: {causes}"
    for k in map(int, np.flatnonzero(able & failed)):
        if earlier.reason[k]:
            run.axes[k].notes.append(f"the move with the gains before: {earlier.reason[k]}")
    if (able & failed).any():
        with run.spending(able & failed):
            run.ground.recover(able & failed)
    _keep_what_is_better(run, run.whole_machines(able & ~failed) & run.going)


def _keep_what_is_better(run: Run, where: Mask) -> None:
    """Keep the gains before on machines that moved better with them; one of several axes is as good as its worst."""
    assert run.shown is not None and run.earlier is not None, "both moves are recorded"
    lanes = run.target.axes_per_machine
    now, before = (np.repeat(m.cost.reshape(-1, lanes).max(axis=1), lanes) for m in (run.shown, run.earlier))
    kept = where & (before < now)
    if not kept.any():
        return
    run.gains = np.where(kept[:, None], run.before, run.gains)
    run.shown = run.shown.replaced(run.earlier._replace(where=kept))
    run.earlier = run.earlier._replace(where=run.earlier.where & ~kept)
    for k in map(int, np.flatnonzero(kept)):
        axis = run.axes[k]
        # What was measured with the new gains says nothing of these.
        axis.is_kept, axis.margins, axis.proof = True, None, float(before[k])
        axis.verified = "by a move, which was better than with the new ones: they are those before"
        axis.notes.append(
            f"the gains before are kept: J by the measured terms of a move was {now[k]:.2f} with the new ones, and "
            f"{before[k]:.2f} with those before"
        )
