"""Calmer gains for an axis that shakes or is too near to instability: of those calm enough, the best on its twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
# A search for calm gains: sets at once, generations, how wide it begins, and runs of each set with noises of their own.
SETS, GENERATIONS, WIDTH, RUNS = 16, 12, 0.5, 2
# By which power of the sensitivity peak over the one sought, and of the swing at rest over the allowed one, gains cost
# more that are too near to instability by the measured response, or that shake at rest.
NEAR, SHAKING = 2.0, 4.0
# How far the swing of twins at rest may be from that of their axis, either way, to be taken for its measure.
ALIKE = 2.0
# One run on a twin says partly what its noise did: the best of it are run again so often, each time with another noise.
FEW, REPEATS = 8, 8

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
    target, known = bench.target, basis.identified.twins(axes, bench.reach())
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


def standing(
    bench: AutoBench, basis: Basis, recorded: RecordedGains, k: int, swing: float, allowed: float, others: Integers
) -> Integers:
    """Return gains for an axis that shook at rest: the best by its twins of those with which these swing less.

    An axis that shakes is held by less friction than was found, so these are twins with hardly any. How much more or
    less than they the axis itself swings is known of its present gains, and taken to hold for others.

    Args:
        bench: The drives.
        basis: What was identified.
        recorded: The present gains; with the measured response, where there is one, gains stay far from instability.
        k: The axis.
        swing: Of its current at rest with the present gains, over the rated one (RMS).
        allowed: What it may be.
        others: Gains that are looked at, too, (sets, count).
    """
    target, own, rule = bench.target, recorded.gains[k], basis.reference[k]
    stands = recorded.rule is not None and bool(recorded.rule.passed[k])
    peaks = _peaks(bench, basis, recorded, k)

    def worth(twins: Twins, limit: float, gains: Integers) -> Floats:
        cost, rest = twins.cost_and_rest(gains)
        shaking = np.maximum(rest / limit, 1.0)
        if stands:  # of the rule's as they are the axis itself has shown it
            shaking[(gains == rule).all(axis=-1)] = 1.0
        cost = cost * shaking**SHAKING * np.maximum(peaks(gains[0])[None] / SOUGHT, 1.0) ** NEAR
        return np.where((gains == own).all(axis=-1), np.inf, cost)

    with _twins_of(bench, basis, k, 1, REPEATS, slippery=True) as twins:
        seen = float(twins.cost_and_rest(own[None, None])[1][0, 0])
    limit = allowed * float(np.clip(seen / swing, 1.0 / ALIKE, ALIKE))
    with _twins_of(bench, basis, k, SETS, RUNS, slippery=True) as twins:
        found = search(
            twins, np.array([[own, rule]]), bench.rng, generations=GENERATIONS, width=WIDTH,
            score=lambda gains: worth(twins, limit, gains),
        ).gains[0]  # fmt: skip
    if recorded.unseen[k] or recorded.response is None:  # the model tells what is far enough from instability
        plant, _ = basis.identified.known(k)
        found = np.array([sound_gains(target.device, plant, tuple(map(int, row))) for row in found], np.int64)
    every = np.concatenate([found, others])
    with _twins_of(bench, basis, k, len(every), RUNS, slippery=True) as twins:
        few = every[worth(twins, limit, every[None])[0].argsort(kind="stable")[:FEW]]
    with _twins_of(bench, basis, k, len(few), REPEATS, slippery=True) as twins:
        return np.asarray(few[int(worth(twins, limit, few[None])[0].argmin())])


def _twins_of(bench: AutoBench, basis: Basis, k: int, sets: int, repeats: int, *, slippery: bool = False) -> Twins:
    """Return the twins of an axis."""
    target, known = bench.target, basis.identified.twins([k], bench.reach())
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
        rows.append(tuple(map(int, rule)))
    candidates = np.array(rows, np.int64)
    if searches_all(target):
        return standing(bench, basis, recorded, k, swing, allowed, candidates)
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
