"""Trials of designed gains on the drives, and of lower gains if they fail."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from mechanics.arrays import Floats, Integers, Mask
from tuning.auto.bench import TRIAL_TIME
from tuning.auto.proving import ProvingGround
from tuning.auto.stages import RecordedGains

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis

BY_TRIAL = "by a move, its reversal, and a move with 1.5 times velocity P"  # how gains are verified at least
SLOWER = 0.6  # factor by which gains that fail their trial are lowered
WINDOW = 10  # following error that trips a trial, over its move: a slow loop lags by the whole move


def try_gains(bench: AutoBench, basis: Basis, gains: Integers, cost: Floats) -> RecordedGains:
    """Try designed gains on the drives; if they fail, lowered ones, then gains that are slow enough for any load.

    Args:
        bench: The drives.
        basis: The identified axes, with calm gains.
        gains: Designed gains, (num_axes, count).
        cost: Their robust cost on the digital twins, (num_axes,).
    """
    ground, n = proving_ground(bench, basis), bench.target.num_axes
    watch_following(bench, bench.going)
    bench.stop(bench.going & ground.too_short(), "the travel is too short for a trial move")
    known = bench.target.device.gains
    # Position P is lowered most: on an axis with more inertia than identified its loop would be too fast for the inner
    # one.
    slower = known.scaled(faster(known, gains, SLOWER), SLOWER, known.columns_of("position"))
    best, proof, last = basis.calm.copy(), np.full(n, np.nan), [""] * n
    stopped = np.zeros(n, bool)  # with the designed gains
    attempts = (
        ("the designed gains", gains),
        (f"these lowered to {100.0 * SLOWER:.0f} %", slower),
        ("gains that are slow enough for any load", basis.calm),
    )
    for words, tried in attempts:
        bench.recover_faults(bench.faults(), "gains were tried")
        open_ = bench.going & np.isnan(proof) & bench.affordable(TRIAL_TIME + ground.way_back())
        if not open_.any():
            break
        write_gains(bench.target.drives, best, bench.going & ~open_)
        with bench.spending(bench.target.together(open_)):
            found = ground.run(np.where(open_[:, None], tried, best), open_)
        passed = bench.whole_machines(found.passed | ~open_) & open_
        best = np.where(passed[:, None], tried, best)
        proof = np.where(passed, found.cost, proof)
        stopped |= open_ & found.stopped & (tried is gains)
        for k in map(int, np.flatnonzero(open_)):
            journal = bench.journals[k]
            if not passed[k]:
                last[k] = found.reason[k] or "another axis of its machine did not pass"
                if tried is not basis.calm:
                    journal.note(f"{words} failed their trial: {last[k]}")
            elif tried is not gains:
                journal.correct(gains[k], tried[k], f"the designed gains failed their trial: {last[k]}")
    for k in map(int, np.flatnonzero(bench.going & np.isnan(proof))):
        why = last[k] or "there was no drive time left to try them"
        bench.journals[k].stop(f"no gains passed the trial; the last ones: {why}")
    verified = np.where(bench.going, BY_TRIAL, "").astype(object)
    cost = np.where((best == gains).all(axis=1), cost, np.nan)
    most = np.where(stopped, between(known, best, gains), np.inf)
    return replace(RecordedGains.only(best), proof=proof, verified=verified, cost=cost, most=most)


def proving_ground(bench: AutoBench, basis: Basis) -> ProvingGround:
    """Create the proving ground with the present positions of the axes, and store it in the bench."""
    plants = basis.identified.plants
    bench.ground = ProvingGround(bench.target, plants, bench.room(), basis.calm, basis.reference, basis.held())
    return bench.ground


def watch_following(bench: AutoBench, where: Mask) -> None:
    """Set a following error window that no normal trial exceeds."""
    drives = bench.target.drives
    window = WINDOW * np.abs(bench.ground.move.distance) + drives.read(Role.POSITION_SCALE)
    drives.write(cia402.FOLLOWING_WINDOW, window, where=where)


def between(known: GainSet, passed: Integers, stopped: Integers) -> Floats:
    """Return the velocity P half way between gains that passed a trial and stopped ones, raw, (num_axes,)."""
    column = known.column("velocity", "P")
    return np.asarray(np.floor(np.sqrt(passed[:, column].astype(float) * stopped[:, column])))


def faster(known: GainSet, gains: Integers, factor: float) -> Integers:
    """Scale the outer loops' gains, of shape (..., count), by a factor."""
    return known.scaled(gains, factor, known.columns_of("velocity", "position"))
