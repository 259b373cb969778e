"""From identification to gains: the axis models, and the search on digital twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role
from drive_env.gains import bandwidth_gains, rule_gains
from drive_env.master.errors import BusError
from drive_env.safety.envelope import SafetyError, swinging_allowed
from tuning.auto.checks import sound_gains, unsafe_gains, wrong_wiring
from tuning.auto.trial_order import BOLD, SLIPPERY
from tuning.auto.twin import WORLDS, Known, Optimum, Twins, known_of, search
from tuning.identify.estimate import TITLES
from tuning.identify.working_state import cautious_bandwidth
from tuning.response.linear_model import Plant
from tuning.rules.rules_by_name import RULES, propose
from tuning.target import Target

if TYPE_CHECKING:
    from tuning.auto.run import AutoRun
    from tuning.identify.estimate import Identification

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Identify = Callable[[Target, NDArray[np.bool_]], "list[Identification]"]  # of the axes where the mask is true

SETS, GENERATIONS = 16, 24  # of a search on twins: sets of gains at once, and how often
SEARCHES = 3  # side by side
OTHER_GENERATIONS, OTHER_WIDTH = 12, 0.5  # of a search on other twins, from what was found, and how wide it begins
# Two short moves take for dry friction what is drag: an axis that is held by less of it hunts at rest.
SLIPPERY_WORLDS = tuple(world._replace(friction=0.02) for world in WORLDS)
SOFT = "margin_60"  # the rule that is tried when nothing faster passes: 60 degrees and 20 dB
# The calmest gains: of the current loop, and shares of the velocity loop of `cautious_gains` and of this one's own.
CALM_CURRENT_HZ, ROTOR_SHARE, POSITION_SHARE = 800.0, 0.6, 0.4


def identify(run: AutoRun, experiments: Identify) -> None:
    """Check the wiring and identify."""
    target = run.target
    if not run.going.any():
        return
    try:
        with run.spending(run.going), swinging_allowed(target.drives):
            found = experiments(target, run.going)
    except (SafetyError, RuntimeError, TimeoutError) as error:
        if isinstance(error, BusError):
            raise
        run.stop(run.going, f"identification was stopped: {error}")
        return
    for k in map(int, np.flatnonzero(run.going)):
        axis, identified = run.axes[k], found[k]
        axis.identified = identified
        axis.reason = wrong_wiring(target, identified)
        if not axis.reason:
            try:
                axis.plant = Plant.from_identification(target.device, target.motor, float(target.supply[k]), identified)
            except ValueError as error:
                axis.reason = str(error)
        unknown: dict[str, list[str]] = {}
        for name, estimate in identified.estimates.items():
            if estimate.reason and name not in ("inertia",):
                unknown.setdefault(estimate.reason, []).append(TITLES[name])
        axis.notes += [f"{', '.join(titles)} not identified: {reason}" for reason, titles in unknown.items()]


def prepare(run: AutoRun) -> None:
    """Set the reference gains, the fallback gains, and whether the gains before are safe."""
    target = run.target
    for axis in map(int, np.flatnonzero(run.going)):
        plant, before = run.axes[axis].plant, run.axes[axis].before
        assert plant is not None, "an axis in the run has one"
        fitted = rule_gains(target.device, target.motor, plant.inertia, supply=plant.supply)[0]
        run.unsafe[axis] = unsafe_gains(target.device, plant, before)
        # What the drive had may be better than what is only soft.
        soft = propose(SOFT, target.device, target.motor, plant).gains if run.unsafe[axis] else before
        run.fallbacks[:, axis] = fitted, soft, calm_gains(target, plant)
        run.reference[axis] = fitted


def compute(run: AutoRun) -> None:
    """Search gains on twins, from what the rules propose."""
    target = run.target
    chosen = np.flatnonzero(run.going)
    if not chosen.size:
        return
    room = run.room()
    reach = np.where(room[1] >= -room[0], room[1], room[0])
    known, starts = [], []
    for axis in chosen:
        plant, identified = run.axes[axis].plant, run.axes[axis].identified
        assert plant is not None and identified is not None, "an axis in the run has both"
        known.append(known_of(plant, identified, float(reach[axis])))
        proposals = (propose(name, target.device, target.motor, plant) for name in RULES)
        starts.append(np.array([run.reference[axis], *(proposal.gains for proposal in proposals)], np.int64))
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[chosen]
    found = _search_apart(run, known, np.array(starts), scaler)
    run.gains[chosen] = found.gains[:, 0]
    # What the drive itself then tells apart: what is best on other twins.
    for number, worlds in {BOLD: WORLDS[:1], SLIPPERY: SLIPPERY_WORLDS}.items():
        with Twins(target.device, target.motor, known, scaler, SETS, worlds=worlds) as twins:
            other = search(twins, found.gains, run.rng, generations=OTHER_GENERATIONS, width=OTHER_WIDTH)
        run.others[number, chosen] = other.gains[:, 0]
    for axis in chosen:
        plant = run.axes[axis].plant
        assert plant is not None, "an axis in the run has one"
        for rows in (run.gains, *run.others):
            rows[axis] = sound_gains(target.device, plant, tuple(map(int, rows[axis])))
    for axis, cost in zip(chosen, found.cost[:, 0], strict=True):
        run.axes[axis].twin = float(cost)


def _search_apart(run: AutoRun, known: Sequence[Known], starts: Integers, scaler: Floats) -> Optimum:
    """Run several searches at the same time, and return the best of each axis.

    On an elastic axis the robust cost has several local minima, and a search stays in the first that it reaches.
    """
    target, n = run.target, len(known)
    with Twins(target.device, target.motor, [*known] * SEARCHES, np.tile(scaler, SEARCHES), SETS) as twins:
        found = search(twins, np.tile(starts, (SEARCHES, 1, 1)), run.rng, generations=GENERATIONS)
    best = found.cost[:, 0].reshape(SEARCHES, n).argmin(axis=0) * n + np.arange(n)
    return Optimum(found.gains[best], found.cost[best], found.start[best])


def calm_gains(target: Target, plant: Plant) -> Integers:
    """Return gains stable with the rotor alone, too: within backlash, and above a resonance, it has no load."""
    velocity_hz = cautious_bandwidth(target.motor, plant.inertia) * ROTOR_SHARE
    return bandwidth_gains(
        target.device, target.motor, plant.inertia, current_hz=CALM_CURRENT_HZ, velocity_hz=velocity_hz,
        position_hz=POSITION_SHARE * velocity_hz, supply=plant.supply,
    )  # fmt: skip
