"""Calmer gains for an axis that shakes or is too near to instability: of those calm enough, the best on its twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.gains import cascade_columns
from tuning.auto.checks import sound_gains
from tuning.auto.measured_margins import SENSITIVITY, SOUGHT, sensitivity
from tuning.auto.trials import faster
from tuning.auto.twin import SLIPPERY_WORLDS, WORLDS, Twins, search

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.target import Target

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Powers of the factor of velocity P by which velocity I and position P are lowered beside it.
INTEGRAL, POSITION = (0.0, 0.5, 1.0), (0.0, 0.5, 1.0, 1.5, 2.0, 4.0)
# Twins know less of an axis that shakes than of others: what was found by search on them must be better by this.
WELL = 0.95
# What velocity P, velocity I, position P and torque P are lowered to, in all combinations but that of none.
LOWERED = np.array(list(product((1.0, 0.8, 0.6, 0.45), (1.0, 0.5), (1.0, 0.8, 0.6), (1.0, 0.6)))[1:])
# A search for gains far from instability: sets at once, generations, how wide it begins, and runs of each set with
# noises of their own.
SETS, GENERATIONS, WIDTH, RUNS = 16, 12, 0.5, 2
# By which power of the sensitivity peak over the one sought gains cost more that are too near to instability by the
# measured response.
NEAR = 2.0
# One run on a twin says partly what its noise did: the best of it is run again so often, each time with another noise.
REPEATS = 8

Score = Callable[[Integers], Floats]  # costs (n, sets) of raw gains (n, sets, count)


def cost_on_twins(
    bench: AutoBench, basis: Basis, axes: Sequence[int], gains: Integers, repeats: int = REPEATS
) -> Floats:
    """Return the robust cost of gains on the digital twins of axes.

    Args:
        bench: The drives.
        basis: What was identified.
        axes: Which; they are identified.
        gains: Raw integers, (axes, sets, count).
        repeats: Runs of each set on each twin, with a noise of their own, whose costs are averaged.

    Returns:
        Shape (axes, sets).
    """
    target, known = bench.target, basis.identified.twins(axes, basis.trial_reach(bench))
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[list(axes)]
    with Twins(target.device, target.motor, known, scaler, gains.shape[1], repeats=repeats) as twins:
        return twins.score(gains)


def searches_all(target: Target) -> bool:
    """Return whether all gains of an axis that shakes are searched on its twins.

    Of what other axes pull at it these know nothing; and they take longer than an axis may be left alone in real time.
    """
    return target.drives.time_waits and target.axes_per_machine == 1


def twins_tell(bench: AutoBench, basis: Basis, k: int) -> bool:
    """Return whether twins tell which gains are better: all are searched on them, and they are of the axis as it is."""
    return searches_all(bench.target) and not basis.identified.doubtful[k]


def far_enough(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int) -> Integers | None:
    """Return the best gains of an axis by its twins whose measured loops are far enough from instability, None if none.

    Which gain brings a loop too near depends on the axis: less velocity P beside the same integral part may be worse.
    """
    peaks = _peaks(bench, basis, recorded, k)
    assert recorded.response is not None, "it was measured"
    with _twins_of(bench, basis, k, SETS, RUNS) as twins:

        def score(gains: Integers) -> Floats:
            return np.asarray(twins.score(gains) * np.maximum(peaks(gains[0])[None] / SOUGHT, 1.0) ** NEAR)

        starts = np.array([[recorded.gains[k], basis.reference[k]]])
        found = search(twins, starts, bench.rng, generations=GENERATIONS, width=WIDTH, score=score).gains[0]
    far = peaks(found)
    found = found[far <= (SOUGHT if (far <= SOUGHT).any() else SENSITIVITY)]
    if not len(found):
        return None
    return np.asarray(found[int(cost_on_twins(bench, basis, [k], found[None])[0].argmin())])


def nearby(target: Target, gains: Integers) -> Integers:
    """Return gains with some of those of an axis lowered, shape (sets, count); as they are is not among them."""
    torque_p, _, velocity_p, velocity_i, position_p = cascade_columns(target.device)
    rows = np.tile(gains.astype(float), (len(LOWERED), 1))
    rows[:, [velocity_p, velocity_i, position_p, torque_p]] *= LOWERED
    return np.asarray(np.maximum(np.rint(rows), 1), np.int64)


def standing(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, swing: float, allowed: float, near: Integers
) -> Integers:
    """Return gains for an axis that shook at rest: near to some known, the best by its twins of those that swing less.

    What makes an axis swing twins know too little of for a search: noise and the counts of the encoder, which velocity
    P passes on, a fast current loop, or friction that sticks. By how much less gain each of these becomes less they
    tell well, and what it costs. An axis that shakes is held by less friction than was found, so twins with hardly any
    tell how much it swings.

    Args:
        bench: The drives.
        basis: What was identified.
        recorded: The present gains; with the measured response, where there is one, gains stay far from instability.
        k: The axis.
        swing: Of its current at rest with the present gains, over the rated one (RMS).
        allowed: What it may be.
        near: Gains that are looked at, beside those near the present ones, (sets, count).
    """
    target, own = bench.target, recorded.gains[k]
    every = np.concatenate([nearby(target, own), near])
    every = every[(every != own).any(axis=1)]
    if recorded.unseen[k] or recorded.response is None:  # the model tells what is far enough from instability
        plant, _ = basis.identified.known(k)
        every = np.array([sound_gains(target.device, plant, tuple(map(int, row))) for row in every], np.int64)
    with _twins_of(bench, basis, k, len(every) + 1, RUNS, slippery=True) as twins:
        rest = twins.cost_and_rest(np.concatenate([own[None], every])[None])[1][0]
    with _twins_of(bench, basis, k, len(every), RUNS) as twins:
        cost: Floats = twins.score(every[None])[0]
    cost = cost * np.maximum(_peaks(bench, basis, recorded, k)(every) / SOUGHT, 1.0) ** NEAR
    swings = swing * rest[1:] / max(float(rest[0]), 1e-6)
    if recorded.rule is not None and recorded.rule.passed[k]:  # the axis itself has stood with them
        swings[(every == recorded.rule.gains[k]).all(axis=1)] = 0.0
    if (swings <= allowed).any():
        cost = np.where(swings <= allowed, cost, np.inf)
        return np.asarray(every[int(cost.argmin())])
    return np.asarray(every[int(swings.argmin())])


def _twins_of(bench: AutoBench, basis: Basis, k: int, sets: int, repeats: int, *, slippery: bool = False) -> Twins:
    """Return the twins of an axis."""
    target, known = bench.target, basis.identified.twins([k], basis.trial_reach(bench))
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[[k]]
    worlds = SLIPPERY_WORLDS if slippery else WORLDS
    return Twins(target.device, target.motor, known, scaler, sets, worlds=worlds, repeats=repeats)


def _peaks(bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int) -> Callable[[Integers], Floats]:
    """Return what gives Ms of gains of an axis, (sets, count), by its measured response; 0 where there is none."""
    response = None if recorded.unseen[k] else recorded.response

    def peaks(gains: Integers) -> Floats:
        if response is None:
            return np.zeros(len(gains))
        return np.array([sensitivity(bench.target, basis, response, row, k) for row in gains])

    return peaks


def calmer(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, factor: float, swing: float, allowed: float
) -> Integers:
    """Return gains for an axis that shook at rest.

    On a machine of one axis they are the best, by its twins, of those with which these stand. On others they are the
    best whose velocity P is a factor of the present one or less: an encoder's noise, and its counts at standstill, go
    into the current by velocity P. The other gains of the outer loops are lowered with it as far as that is better;
    those of the rule are looked at as well, with as much more velocity P as their current loop is slower.

    Where time does not wait all of the outer gains are lowered alike: twins take longer than an enabled axis may be
    left alone, and its voltage is not taken away, since it may still turn, or hold a weight.
    """
    target, device, (plant, _) = bench.target, bench.target.device, basis.identified.known(k)
    own, rule = recorded.gains[k], basis.reference[k]
    if not target.drives.time_waits:
        return faster(device.gains, own, factor)
    if searches_all(target):
        return standing(bench, basis, recorded, k, swing, allowed, np.concatenate([rule[None], nearby(target, rule)]))
    torque_p, _, velocity_p, velocity_i, position_p = cascade_columns(device)
    response = None if recorded.unseen[k] else recorded.response
    rows = []
    for base in (own, rule):
        slower = max(1.0, own[torque_p] / base[torque_p])  # a current loop passes on less of the noise
        share = min(1.0, factor * own[velocity_p] * slower / base[velocity_p])
        for integral in INTEGRAL:
            for position in POSITION:
                row = base.astype(float)
                row[[velocity_p, velocity_i, position_p]] *= share, share**integral, share**position
                gains = tuple(map(int, np.maximum(np.rint(row), 1)))
                rows.append(gains if response is not None else sound_gains(device, plant, gains))
    # With those of the rule as they are the axis itself has stood, whatever their velocity P.
    if recorded.rule is not None and recorded.rule.passed[k]:
        rows.append(tuple(map(int, recorded.rule.gains[k])))
    candidates = np.array(rows, np.int64)
    cost = cost_on_twins(bench, basis, [k], candidates[None])[0]
    if response is not None:  # it knows more than the model
        far = _peaks(bench, basis, recorded, k)(candidates)
        for limit in (SENSITIVITY, SOUGHT):
            near = (far > limit) | np.isinf(cost)
            cost = np.where(near & ~near.all(), np.inf, cost)
    count = len(INTEGRAL) * len(POSITION)
    of_own, of_rule = cost[:count], cost[count:]
    if of_own.min() < WELL * of_rule.min():
        return np.asarray(candidates[int(of_own.argmin())])
    return np.asarray(candidates[count + int(of_rule.argmin())])
