"""From identification to gains: the axis models, and the search on digital twins."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.gains import bandwidth_gains, rule_gains
from drive_env.loops.linear_model import Plant
from drive_env.master.errors import BusError
from drive_env.safety.envelope import SafetyError, swinging_allowed
from tuning.auto.calmer_gains import REPEATS
from tuning.auto.checks import sound_gains, unsafe_gains, wrong_wiring
from tuning.auto.stages import Basis, Candidates, IdentifiedAxes
from tuning.auto.trial_order import BOLD, OTHERS, SLIPPERY
from tuning.auto.twin import SLIPPERY_WORLDS, WORLDS, Known, Optimum, Twins, search
from tuning.identify.estimate import TITLES
from tuning.identify.working_state import cautious_bandwidth
from tuning.rules.rules_by_name import RULES, propose
from tuning.target import Target

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.identify.estimate import Identification

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Identify = Callable[[Target, NDArray[np.bool_]], "list[Identification]"]  # of the axes where the mask is true

SETS, GENERATIONS = 16, 24  # of a search on twins: sets of gains at once, and how often
SEARCHES = 3  # side by side
FINALISTS = 4  # of each of them, that are scored again
OTHER_GENERATIONS, OTHER_WIDTH = 12, 0.5  # of a search on other twins, from what was found, and how wide it begins
RUNS = GENERATIONS + 2 + 2 * (OTHER_GENERATIONS + 1)  # of twins in all, for who waits
SOFT = "margin_60"  # the rule that is tried when nothing faster passes: 60 degrees and 20 dB
# The calmest gains: of the current loop, and shares of the velocity loop of `cautious_gains` and of this one's own.
CALM_CURRENT_HZ, ROTOR_SHARE, POSITION_SHARE = 800.0, 0.6, 0.4


def identify(bench: AutoBench, experiments: Identify) -> IdentifiedAxes:
    """Check the wiring and identify; take out axes that cannot be tuned."""
    target, going = bench.target, bench.going
    found: list[Identification | None] = [None] * target.num_axes
    plants: list[Plant | None] = [None] * target.num_axes
    if not going.any():
        return IdentifiedAxes(tuple(found), tuple(plants))
    try:
        with bench.spending(going), swinging_allowed(target.drives):
            every = experiments(target, going)
    except (SafetyError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        bench.stop(bench.going, f"identification was stopped: {error}")
        return IdentifiedAxes(tuple(found), tuple(plants))
    for k in map(int, np.flatnonzero(going)):
        journal, found[k] = bench.journals[k], every[k]
        journal.stop(wrong_wiring(target, every[k]))
        if not journal.reason:
            try:
                plants[k] = Plant.from_identification(target.device, target.motor, float(target.supply[k]), every[k])
            except ValueError as error:
                journal.stop(str(error))
        unknown: dict[str, list[str]] = {}
        for name, estimate in every[k].estimates.items():
            if estimate.reason and name not in ("inertia",):
                unknown.setdefault(estimate.reason, []).append(TITLES[name])
        for reason, titles in unknown.items():
            journal.note(f"{', '.join(titles)} not identified: {reason}")
    return IdentifiedAxes(tuple(found), tuple(plants))


def prepare(bench: AutoBench, identified: IdentifiedAxes) -> Basis:
    """Return the reference gains, the fallback gains, and whether the gains before are safe."""
    target = bench.target
    reference = np.ones_like(bench.before)
    fallbacks, unsafe = np.tile(reference, (3, 1, 1)), ["not checked"] * target.num_axes
    for axis in map(int, np.flatnonzero(bench.going)):
        (plant, found), before = identified.known(axis), bench.before[axis]
        inertia = found.together if math.isfinite(found.together) else plant.inertia
        reference[axis] = rule_gains(target.device, target.motor, inertia, supply=plant.supply)[0]
        unsafe[axis] = unsafe_gains(target.device, plant, before)
        # What the drive had may be better than what is only soft.
        soft = propose(SOFT, target.device, target.motor, plant).gains if unsafe[axis] else before
        fallbacks[:, axis] = reference[axis], soft, calm_gains(target, plant)
    return Basis(identified, bench.before, reference, fallbacks, tuple(unsafe))


def compute(bench: AutoBench, basis: Basis, progress: Callable[[float], None] = lambda share: None) -> Candidates:
    """Search gains on twins, from what the rules propose.

    Args:
        bench: The drives.
        basis: What is known of them.
        progress: Called between two runs of the twins with the share done; what it raises ends the search.
    """
    told = _Told(progress)
    target, chosen = bench.target, np.flatnonzero(bench.going).tolist()
    known = basis.identified.twins(chosen, basis.trial_reach(bench))
    starts = []
    for axis in chosen:
        plant, _ = basis.identified.known(axis)
        proposals = (propose(name, target.device, target.motor, plant) for name in RULES)
        starts.append(np.array([basis.reference[axis], *(proposal.gains for proposal in proposals)], np.int64))
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[chosen]
    found = _search_apart(bench, known, np.array(starts), scaler, told)
    gains, cost = np.ones_like(bench.before), np.full(target.num_axes, np.nan)
    others = np.tile(gains, (len(OTHERS), 1, 1))
    gains[chosen], cost[chosen] = found.gains[:, 0], found.cost[:, 0]
    # What the drive itself then tells apart: what is best on other twins.
    for number, worlds in {BOLD: WORLDS[:1], SLIPPERY: SLIPPERY_WORLDS}.items():
        with Twins(target.device, target.motor, known, scaler, SETS, worlds=worlds) as twins:
            other = search(
                twins, found.gains, bench.rng, generations=OTHER_GENERATIONS, width=OTHER_WIDTH,
                score=told.of(twins),
            )  # fmt: skip
        others[number, chosen] = other.gains[:, 0]
    for axis in chosen:
        plant, _ = basis.identified.known(axis)
        for rows in (gains, *others):
            rows[axis] = sound_gains(target.device, plant, tuple(map(int, rows[axis])))
    return Candidates(gains, others, cost)


class _Told:
    """Tells how much of a search is done, whenever twins have run."""

    def __init__(self, progress: Callable[[float], None]) -> None:
        self._progress = progress
        self._runs = 0

    def of(self, twins: Twins) -> Callable[[Integers], Floats]:
        """Return what scores gains on twins, and tells."""

        def score(gains: Integers) -> Floats:
            self._progress(min(1.0, self._runs / RUNS))
            self._runs += 1
            return twins.score(gains)

        return score


def _search_apart(bench: AutoBench, known: Sequence[Known], starts: Integers, scaler: Floats, told: _Told) -> Optimum:
    """Run several searches at the same time, and return the best of each axis.

    On an elastic axis the robust cost has several local minima, and a search stays in the first that it reaches.
    """
    target, n = bench.target, len(known)
    with Twins(target.device, target.motor, [*known] * SEARCHES, np.tile(scaler, SEARCHES), SETS) as twins:
        every = np.tile(starts, (SEARCHES, 1, 1))
        found = search(twins, every, bench.rng, generations=GENERATIONS, score=told.of(twins))
    # The least cost of hundreds of runs is partly luck: the best few of each search are run again with other noises.
    by_axis = found.gains[:, :FINALISTS].reshape(SEARCHES, n, -1, found.gains.shape[-1]).swapaxes(0, 1)
    few = by_axis.reshape(n, -1, found.gains.shape[-1])
    with Twins(target.device, target.motor, known, scaler, few.shape[1], repeats=REPEATS) as twins:
        cost = told.of(twins)(few)
    order = cost.argsort(axis=1, kind="stable")
    start = found.start.reshape(SEARCHES, n).min(axis=0)
    return Optimum(np.take_along_axis(few, order[:, :, None], axis=1), np.take_along_axis(cost, order, axis=1), start)


def calm_gains(target: Target, plant: Plant) -> Integers:
    """Return gains stable with the rotor alone, too: within backlash, and above a resonance, it has no load."""
    velocity_hz = cautious_bandwidth(target.motor, plant.inertia) * ROTOR_SHARE
    return bandwidth_gains(
        target.device, target.motor, plant.inertia, current_hz=CALM_CURRENT_HZ, velocity_hz=velocity_hz,
        position_hz=POSITION_SHARE * velocity_hz, supply=plant.supply,
    )  # fmt: skip
