"""Trials of gains on the drives: lower ones until some pass, then their neighbours; the best are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.gains import write_gains
from tuning.auto.proving import ProvingGround
from tuning.auto.run import MOVE_TIME, TRIAL_TIME
from tuning.auto.trial_order import Ladder, Rung

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from tuning.auto.proving import Proof
    from tuning.auto.run import AutoRun

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

BY_TRIAL = "by a move, its reversal, and a move with 1.5 times velocity P"  # how gains are verified, at the least
LOUD = 0.06  # RMS increment of the current over the rated one, from which on an axis hunts at rest
WINDOW = 10  # following error that trips a trial, over its move: a slow loop lags by the whole of it


def prove(run: AutoRun) -> None:
    """Try the twins' gains on the drives; lower ones until some pass, then alternatives; the best are kept."""
    going = run.going
    if not going.any():
        return
    plants = [axis.plant for axis in run.axes]
    run.ground = ground = ProvingGround(run.target, plants, run.room(), run.fallbacks[-1], run.reference)
    watch_following(run, going)
    run.stop(going & ground.too_short(), "the travel is too short for a trial move")
    ladders = [Ladder(len(run.fallbacks), coupled=run.target.axes_per_machine > 1) for _ in run.axes]
    n = run.target.num_axes
    best, cost, last = run.fallbacks[-1].copy(), np.full(n, np.inf), [""] * n
    second = cost.copy()
    while True:
        _recover_from_faults(run, ground)
        passed = np.array([ladder.passed for ladder in ladders])
        open_ = run.going & np.array([ladder.rung is not None for ladder in ladders])
        # Time for a response and two moves is kept, unless there is nothing yet to make them with.
        then = np.where(passed, run.response_time + MOVE_TIME + run.look_back_time, 0.0)
        open_ &= run.affordable(TRIAL_TIME + ground.way_back() + then)
        if not open_.any():
            break
        meant = np.array([_meant(run, k, ladder.rung) for k, ladder in enumerate(ladders)])
        # What is through holds its place with its best, or goes along where it pulls at the same thing.
        tried = np.where(open_[:, None], meant, best)
        write_gains(run.target.drives, best, run.going & ~open_)
        with run.spending(run.target.together(open_)):
            proof = ground.run(tried, open_)
        better = open_ & proof.passed & (proof.cost < cost)
        # What was the best is the second best now; or what was tried is.
        spare = open_ & proof.passed & (better & (cost < np.inf) | ~better & (proof.cost < second))
        second = np.where(spare, np.where(better, cost, proof.cost), second)
        run.spare = np.where(spare[:, None], np.where(better[:, None], best, tried), run.spare)
        best, cost = np.where(better[:, None], tried, best), np.where(better, proof.cost, cost)
        # What another axis of its machine has stopped is tried again, and says nothing yet.
        for k in map(int, np.flatnonzero(open_ & ~(proof.stopped & ~_to_blame(run, proof, open_)))):
            if not proof.passed[k] and not ladders[k].passed:
                last[k] = proof.reason[k]
            ladders[k].step(bool(proof.passed[k]), bool(better[k]), bool(proof.ripple[k] > LOUD))
    for k in map(int, np.flatnonzero(run.going)):
        axis, ladder = run.axes[k], ladders[k]
        if not ladder.passed:
            why = last[k] or "there was no drive time left to try them"
            axis.reason = f"no gains passed the trial; the last ones: {why}"
            continue
        axis.proof, axis.verified = float(cost[k]), BY_TRIAL
        if ladder.failures:
            failed = ", ".join(rung.words for rung in ladder.failures)
            axis.notes.append(f"gains that failed in a trial before: {failed}; reason of the last: {last[k]}")
    run.gains = best


def _recover_from_faults(run: AutoRun, ground: ProvingGround) -> None:
    """Reset faults that have come since a trial; an axis that stays in one takes no further part."""
    faulted = np.isin(np.arange(run.target.num_axes), list(run.faults()))
    if faulted.any():
        with run.spending(run.target.together(faulted)):
            ground.recover(faulted)
        run.drop_faults("gains were tried, and the fault cannot be reset")


def _to_blame(run: AutoRun, proof: Proof, where: Mask) -> Mask:
    """Return the axes that stopped their machines; all of them if none of those tried did, or if they are linked."""
    culprit = where & proof.culprit
    if run.target.linked:
        return np.ones_like(where)
    known = culprit.reshape(-1, run.target.axes_per_machine).any(axis=1)
    return culprit | ~np.repeat(known, run.target.axes_per_machine)


def _meant(run: AutoRun, axis: int, rung: Rung | None) -> Integers:
    """Return the gains of a trial of an axis; any, if nothing is to be tried on it."""
    if rung is None:
        return np.asarray(run.fallbacks[-1, axis])
    if rung.fallback is not None:
        return np.asarray(run.fallbacks[rung.fallback, axis])
    if rung.other is not None:
        return np.asarray(run.others[rung.other, axis])
    return faster(run.target.device.gains, run.gains[axis], rung.factor)


def watch_following(run: AutoRun, where: Mask) -> None:
    """Set a following error limit that no normal trial reaches."""
    assert run.ground is not None, "proving makes it"
    drives = run.target.drives
    window = WINDOW * np.abs(run.ground.move.distance) + drives.read(Role.POSITION_SCALE)
    drives.write(cia402.FOLLOWING_WINDOW, window, where=where)


def faster(known: GainSet, gains: Integers, factor: float) -> Integers:
    """Return gains of shape (..., count) with those of the outer loops times a factor."""
    return known.scaled(gains, factor, known.columns_of("velocity", "position"))
