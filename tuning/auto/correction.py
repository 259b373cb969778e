"""Tries designed gains on the drives, verifies them, and designs them again from the measurements, at most twice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env.devices.gains import cascade_columns
from drive_env.drives.raw_gains import write_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.safety.envelope import SafetyError
from drive_env.trials.score import TRIP, robust_cost
from mechanics.arrays import Floats, Integers, Mask
from tuning.auto.bench import BY_TRIAL, MOVE_TIME, REDESIGNED, TRIAL_TIME
from tuning.auto.design import design_axes
from tuning.auto.loop_margins import MEASURED, OVERSHOOT_ERROR, measure, measured_axis
from tuning.auto.moves import STEP_TIME, load, record_final_move, step
from tuning.auto.proving import RESTLESS, ProvingGround
from tuning.auto.stages import RecordedGains

if TYPE_CHECKING:
    from drive_env.devices.gain_set import GainSet
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis
    from tuning.target import Target

SLOWER = 0.6  # factor by which gains that fail their trial are lowered
CORRECTIONS = 2
UNSEEN = "no loop was measured, so soft dynamics are asked of the model"
WITHIN = 0.03  # relative slack: less is missing than the certificate's margins may be off
NO_BETTER = "no better as measured: the old ones stay"
WORTH = 0.85  # of the robust cost on the twins: a smaller improvement is not worth a correction
SAME = 0.05  # relative difference of cost that two trials of the same gains may have
# Velocity P amplifies noise and resolution of the encoder to the current, whose ripple grows with about its square:
# factor limits of velocity P of an axis that is not at rest, and of position P if a step overshoots.
CALMER, LEAST_CALMER = 0.9, 0.5
# Factors of velocity P, velocity I and position P for lowered gains, if no time is left to design new ones.
LOWERED = np.array([(v, i, p) for v in (1.0, 0.85, 0.7, 0.55, 0.4, 0.25) for i in (1.0, 0.7, 0.5, 0.3)
                    for p in (1.0, 0.85, 0.7, 0.55, 0.4, 0.25, 0.15)])  # fmt: skip


def try_gains(bench: AutoBench, basis: Basis, gains: Integers, cost: Floats) -> RecordedGains:
    """Try designed gains on the drives; if they fail, lowered ones, then gains that are slow enough for any load.

    Args:
        bench: The drives.
        basis: The identified axes, with calm gains.
        gains: Designed gains, (num_axes, count).
        cost: Their robust cost on the digital twins, (num_axes,).
    """
    ground, n = proving_ground(bench, basis), bench.target.num_axes
    bench.watch_following(bench.going)
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


def between(known: GainSet, passed: Integers, stopped: Integers) -> Floats:
    """Return the velocity P half way between gains that passed a trial and stopped ones, raw, (num_axes,)."""
    column = known.column("velocity", "P")
    return np.asarray(np.floor(np.sqrt(passed[:, column].astype(float) * stopped[:, column])))


def faster(known: GainSet, gains: Integers, factor: float) -> Integers:
    """Scale the outer loops' gains, of shape (..., count), by a factor."""
    return known.scaled(gains, factor, known.columns_of("velocity", "position"))


def _most_velocity_p(bench: AutoBench, best: RecordedGains | None, recorded: RecordedGains) -> Floats:
    """Return the greatest allowed velocity P of axes: below the present one for axes not at rest, else infinite.

    Half way (geometrically) to gains with which the axis rests, if known: an oscillation in the backlash of a gear is
    no noise. Lowered twice as far (geometrically) if it did not rest before either: no third correction is left.
    """
    known = bench.target.device.gains
    present = recorded.gains[:, cascade_columns(bench.target.device)[2]]
    with np.errstate(divide="ignore"):
        factor = np.clip(CALMER * np.sqrt(RESTLESS / recorded.swing), LEAST_CALMER, CALMER)
    most = np.maximum(np.floor(factor * present), 1.0)
    if best is not None:
        halfway = np.minimum(between(known, best.gains, recorded.gains), np.floor(CALMER * present))
        most = np.where(best.swing <= RESTLESS, np.maximum(most, halfway), np.maximum(np.floor(factor * most), 1.0))
    return np.where(recorded.swing > RESTLESS, most, np.inf)


def correct(
    bench: AutoBench,
    basis: Basis,
    tried: RecordedGains,
    target: Target,
    say: Callable[[str, float], None],
    *,
    improves: bool = True,
) -> RecordedGains:
    """Verify gains by a move, a frequency response and a load step, and correct the design by their results.

    Args:
        bench: The drives.
        basis: The identified axes.
        tried: The gains, and the results of their trials.
        target: The drives with time that is not counted.
        say: Called with the present step and the share of the run that is done.
        improves: Whether gains that keep the dynamics are replaced by others that cost less on the digital twins.

    Returns:
        The best of the verified gains; axes whose gains failed are taken out of the run.
    """
    recorded, changed = tried, bench.going
    best: RecordedGains | None = None
    tried_before: list[Integers] = []
    most = tried.most  # greatest velocity P, lowered by gains that did not rest or were stopped
    for number in range(CORRECTIONS + 1):
        if changed.any():
            say("verifying gains on the drives", 0.72 + 0.08 * number)
            recorded = step(bench, record_final_move(bench, recorded, changed), changed)
            recorded = measure(bench, basis, recorded, changed)
            recorded = load(bench, basis, recorded, target, changed)
            most = np.where(changed, np.minimum(most, _most_velocity_p(bench, best, recorded)), most)
            if best is not None:
                # Corrected gains that are no better than the ones before them are taken back. If both keep the
                # dynamics and their trials differ by less than noise, the corrected ones stay.
                earlier, later = _cost(bench, best), _cost(bench, recorded)
                no_better = bench.whole_machines(np.where(later < TRIP, 1.0 + SAME, 1.0) * earlier <= later)
                # After gains that could not be measured those stay that were then designed for more margin.
                no_better &= ~bench.whole_machines((recorded.failed == "") & np.isnan(best.slack))
                for k in map(int, np.flatnonzero(changed & no_better)):
                    bench.journals[k].undo(recorded.gains[k], best.gains[k], NO_BETTER)
                recorded = recorded.mixed(best, changed & no_better)
            best = recorded
        if number == CORRECTIONS:
            break
        say("correcting the design", 0.76 + 0.08 * number)
        gains, why = _corrected(bench, basis, recorded, most, worth=WORTH if improves else 0.0)
        tried_before.append(recorded.gains)
        for k in map(int, np.flatnonzero(bench.going)):
            if any(np.array_equal(gains[k], rows[k]) for rows in tried_before):
                gains[k] = recorded.gains[k]
        # Change all axes of a machine if one of them gets other gains.
        changed = bench.going & ~bench.whole_machines((gains == recorded.gains).all(axis=1))
        changed &= bench.affordable(TRIAL_TIME + MOVE_TIME + STEP_TIME + bench.response_time)
        if not changed.any():
            break
        tried_before.append(gains.copy())
        passed_before = recorded.gains
        recorded, changed, stopped = _try(bench, recorded, gains, changed, why)
        halfway = between(bench.target.device.gains, passed_before, gains)
        most = np.where(stopped, np.minimum(most, halfway), most)
    final = recorded if best is None else best
    for k in map(int, np.flatnonzero(bench.going)):
        if final.failed[k]:
            bench.journals[k].stop(final.failed[k])
    return final


def _cost(bench: AutoBench, recorded: RecordedGains) -> Floats:
    """Return the cost of verified gains by J and margins, for each machine that of its worst axis, (num_axes,)."""
    # Gains that were not measured count as worse than gains measured to keep the dynamics.
    slack = np.where(np.isnan(recorded.slack), 0.0, recorded.slack) + MEASURED
    slack = np.fmin(slack, 1.0 - np.minimum(recorded.overshoot - OVERSHOOT_ERROR, 1.0) / bench.dynamics.overshoot)
    cost = robust_cost(np.nan_to_num(recorded.proof, nan=TRIP), slack)
    cost = np.where(recorded.failed != "", 2.0 * TRIP + recorded.swing, cost)
    per_machine = bench.target.axes_per_machine
    return np.asarray(np.repeat(cost.reshape(-1, per_machine).max(axis=1), per_machine))


def _corrected(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, most: Floats, worth: float
) -> tuple[Integers, list[str]]:
    """Return corrected gains, (num_axes, count), and why; axes that need no correction keep theirs."""
    known, why = bench.target.device.gains, [""] * bench.target.num_axes
    gains = recorded.gains.copy()
    if not bench.target.drives.time_waits:
        # The design on twins takes longer than an enabled axis may be left alone in real time.
        for k in map(int, np.flatnonzero(bench.going)):
            why[k] = _short(bench, recorded, k)
            if why[k]:
                gains[k] = _lowered(bench, basis, recorded, k, float(most[k]))
        return gains, why
    # Loops were not measured on machines that failed their move; axes whose measurement failed get more margin.
    looked_at = bench.going & bench.whole_machines(recorded.failed == "")
    blind = looked_at & np.array([measured_axis(bench, basis, recorded, k) is None for k in range(len(gains))])
    if not worth and not blind.any() and not any(_short(bench, recorded, int(k)) for k in np.flatnonzero(bench.going)):
        return gains, why
    designed, cost, present = design_axes(bench, basis, bench.going & ~blind, recorded=recorded, most=most)
    if blind.any():
        asked = find_dynamics("soft", bench.dynamics.inertia_range)
        soft, *more = design_axes(bench, basis, blind, recorded=recorded, dynamics=asked, most=most)
        designed = np.where(blind[:, None], soft, designed)
        cost, present = (np.where(blind, one, all_) for one, all_ in zip(more, (cost, present), strict=True))
    for k in map(int, np.flatnonzero(bench.going)):
        why[k] = _short(bench, recorded, k) or (UNSEEN if blind[k] else "")
        if not why[k] and cost[k] < worth * present[k]:
            why[k] = f"its twins, as measured, have a robust cost of {cost[k]:.2f} for {present[k]:.2f}"
        shoots_over = recorded.overshoot[k] > bench.dynamics.overshoot
        unlike = blind[k] and not np.array_equal(designed[k], recorded.gains[k])
        if shoots_over and not (recorded.failed[k] or recorded.slack[k] < 0.0 or unlike):
            # Only the step shows the cause of its overshoot: position P is lowered first.
            share = np.clip(CALMER * bench.dynamics.overshoot / recorded.overshoot[k], LEAST_CALMER, CALMER)
            gains[k] = known.scaled(gains[k], float(share), [cascade_columns(bench.target.device)[4]])
        elif why[k]:
            gains[k] = designed[k]
    return known.clipped(gains), why


def _short(bench: AutoBench, recorded: RecordedGains, k: int) -> str:
    """Return which requirement the gains of an axis fail; "" if they keep all."""
    if recorded.failed[k]:
        return str(recorded.failed[k])
    if recorded.slack[k] < -WITHIN:
        return f"its measured loops keep {100.0 * (1.0 + max(recorded.slack[k], -1.0)):.0f} % of the margins asked for"
    if recorded.overshoot[k] > bench.dynamics.overshoot:
        return f"a step of its set-point in csp overshoots by {100.0 * recorded.overshoot[k]:.0f} %"
    return ""


def _lowered(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, most: float) -> Integers:
    """Return lowered outer gains of an axis: the fastest whose measured loops keep the dynamics."""
    device, measured = bench.target.device, measured_axis(bench, basis, recorded, k)
    _, _, velocity_p, velocity_i, position_p = cascade_columns(device)
    outer = [velocity_p, velocity_i, position_p]
    rows = device.gains.scaled(recorded.gains[k], LOWERED, outer)
    every = rows[rows[:, velocity_p] <= most]
    if not len(every):
        every = rows[-1:]
    slack = np.zeros(len(every)) if measured is None else measured.slack(bench.dynamics, every)
    lively = (device.gains.strength(every, outer) ** (0.4, 0.4, 0.8)).prod(axis=1)
    return np.asarray(every[int(np.where(slack > 0.0, lively, slack - 1e9).argmax())])


def _try(
    bench: AutoBench, recorded: RecordedGains, gains: Integers, where: Mask, why: Sequence[str]
) -> tuple[RecordedGains, Mask, Mask]:
    """Try corrected gains; return the record with those that passed, the axes that have them, and stopped axes."""
    try:
        with bench.spending(bench.target.together(where)):
            proof = bench.ground.run(gains, where)
    except SafetyError as error:
        bench.note(where, f"the envelope stopped the trial of corrected gains: {error}")
        return recorded, np.zeros_like(where), where
    for k in map(int, np.flatnonzero(where & ~proof.passed)):
        bench.journals[k].note(f"corrected gains failed their trial: {proof.reason[k]}")
        bench.journals[k].correct(recorded.gains[k], gains[k], why[k], f"failed their trial: {proof.reason[k]}")
    passed = bench.whole_machines(proof.passed & where)
    for k in map(int, np.flatnonzero(passed)):
        reason = why[k] or "as its other axes were"
        bench.journals[k].note(f"{REDESIGNED}{reason}")
        bench.journals[k].correct(recorded.gains[k], gains[k], reason)
    fresh = replace(
        RecordedGains.only(gains), proof=proof.cost, verified=recorded.verified, unseen=recorded.unseen,
        loaded=recorded.loaded,
    )  # fmt: skip
    return recorded.mixed(fresh, passed), passed, where & proof.stopped
