"""Trials of gains on the drives: lower ones until some pass, then their neighbours; the best are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.gains import write_gains
from tuning.auto.bench import MOVE_TIME, TRIAL_TIME
from tuning.auto.proving import ProvingGround
from tuning.auto.stages import TriedGains
from tuning.auto.trial_order import Ladder, Rung

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import Proof
    from tuning.auto.stages import Basis, Candidates

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

BY_TRIAL = "by a move, its reversal, and a move with 1.5 times velocity P"  # how gains are verified, at the least
LOUD = 0.06  # RMS increment of the current over the rated one, from which on an axis hunts at rest
WINDOW = 10  # following error that trips a trial, over its move: a slow loop lags by the whole of it


def prove(bench: AutoBench, basis: Basis, candidates: Candidates) -> TriedGains:
    """Try the twins' gains on the drives; lower ones until some pass, then alternatives; the best are kept."""
    slowest, ground = basis.fallbacks[-1], proving_ground(bench, basis)
    watch_following(bench, bench.going)
    bench.stop(bench.going & ground.too_short(), "the travel is too short for a trial move")
    n = bench.target.num_axes
    ladders = [Ladder(len(basis.fallbacks), coupled=bench.target.axes_per_machine > 1) for _ in range(n)]
    best, cost, last = slowest.copy(), np.full(n, np.inf), [""] * n
    spare, second = np.zeros_like(best), cost.copy()
    while True:
        _recover_from_faults(bench, ground)
        passed = np.array([ladder.passed for ladder in ladders])
        open_ = bench.going & np.array([ladder.rung is not None for ladder in ladders])
        # Time for a response and two moves is kept, unless there is nothing yet to make them with.
        then = np.where(passed, bench.response_time + MOVE_TIME + basis.look_back_time(bench), 0.0)
        open_ &= bench.affordable(TRIAL_TIME + ground.way_back() + then)
        if not open_.any():
            break
        meant = np.array([_meant(bench, basis, candidates, k, ladder.rung) for k, ladder in enumerate(ladders)])
        # What is through holds its place with its best, or goes along where it pulls at the same thing.
        tried = np.where(open_[:, None], meant, best)
        write_gains(bench.target.drives, best, bench.going & ~open_)
        with bench.spending(bench.target.together(open_)):
            proof = ground.run(tried, open_)
        better = open_ & proof.passed & (proof.cost < cost)
        # What was the best is the second best now; or what was tried is.
        next_ = open_ & proof.passed & (better & (cost < np.inf) | ~better & (proof.cost < second))
        next_ &= (tried != best).any(axis=1)  # two ways may lead to the same gains
        second = np.where(next_, np.where(better, cost, proof.cost), second)
        spare = np.where(next_[:, None], np.where(better[:, None], best, tried), spare)
        best, cost = np.where(better[:, None], tried, best), np.where(better, proof.cost, cost)
        # What another axis of its machine has stopped is tried again, and says nothing yet.
        for k in map(int, np.flatnonzero(open_ & ~(proof.stopped & ~_to_blame(bench, proof, open_)))):
            if not proof.passed[k] and not ladders[k].passed:
                last[k] = proof.reason[k]
            ladders[k].step(bool(proof.passed[k]), bool(better[k]), bool(proof.ripple[k] > LOUD))
    verified = [""] * n
    for k in map(int, np.flatnonzero(bench.going)):
        journal, ladder = bench.journals[k], ladders[k]
        if not ladder.passed:
            why = last[k] or "there was no drive time left to try them"
            journal.stop(f"no gains passed the trial; the last ones: {why}")
            continue
        verified[k] = BY_TRIAL
        if ladder.failures:
            failed = ", ".join(rung.words for rung in ladder.failures)
            journal.note(f"gains that failed in a trial before: {failed}; reason of the last: {last[k]}")
    proven = np.where([bool(words) for words in verified], cost, np.nan)
    return TriedGains(best, spare, proven, tuple(verified), candidates.cost)


def proving_ground(bench: AutoBench, basis: Basis) -> ProvingGround:
    """Set and return where gains are tried, from where the axes are now."""
    plants = basis.identified.plants
    bench.ground = ProvingGround(bench.target, plants, bench.room(), basis.fallbacks[-1], basis.reference, basis.held())
    return bench.ground


def _recover_from_faults(bench: AutoBench, ground: ProvingGround) -> None:
    """Reset faults that have come since a trial; an axis that stays in one takes no further part."""
    faulted = np.isin(np.arange(bench.target.num_axes), list(bench.faults()))
    if faulted.any():
        with bench.spending(bench.target.together(faulted)):
            ground.recover(faulted)
        bench.drop_faults("gains were tried, and the fault cannot be reset")


def _to_blame(bench: AutoBench, proof: Proof, where: Mask) -> Mask:
    """Return the axes that stopped their machines; all of them if none of those tried did, or if they are linked."""
    culprit = where & proof.culprit
    if bench.target.linked:
        return np.ones_like(where)
    known = culprit.reshape(-1, bench.target.axes_per_machine).any(axis=1)
    return culprit | ~np.repeat(known, bench.target.axes_per_machine)


def _meant(bench: AutoBench, basis: Basis, candidates: Candidates, axis: int, rung: Rung | None) -> Integers:
    """Return the gains of a trial of an axis; any, if nothing is to be tried on it."""
    if rung is None:
        return np.asarray(basis.fallbacks[-1, axis])
    if rung.fallback is not None:
        return np.asarray(basis.fallbacks[rung.fallback, axis])
    if rung.other is not None:
        return np.asarray(candidates.others[rung.other, axis])
    return faster(bench.target.device.gains, candidates.gains[axis], rung.factor)


def watch_following(bench: AutoBench, where: Mask) -> None:
    """Set a following error limit that no normal trial reaches."""
    assert bench.ground is not None, "proving makes it"
    drives = bench.target.drives
    window = WINDOW * np.abs(bench.ground.move.distance) + drives.read(Role.POSITION_SCALE)
    drives.write(cia402.FOLLOWING_WINDOW, window, where=where)


def faster(known: GainSet, gains: Integers, factor: float) -> Integers:
    """Return gains of shape (..., count) with those of the outer loops times a factor."""
    return known.scaled(gains, factor, known.columns_of("velocity", "position"))
