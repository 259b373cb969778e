"""Design of an axis' gains: the best performance among the gains that keep the constraints, on its digital twin.

The design has no random part: the gains of the current loop follow from the winding and its lags, those of the outer
loops from a grid in units of the axis (bandwidth times lags, integration time and position gain over bandwidth). The
margins of the whole grid are computed on the twin as a linear machine; the performance of the most promising gains is
measured on the twin as an emulated machine, with friction, noise and encoder resolution; then the neighbours of the
best are searched.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.devices.gain_set import FEED_FORWARD
from drive_env.devices.gains import Part, cascade_columns, si_scales, small_time_constants
from drive_env.dictionary.roles import Role
from drive_env.trials.score import robust_cost
from mechanics.arrays import Floats, Integers, Mask
from tuning.auto.loop_margins import MEASURED, measured_axis
from tuning.auto.loop_model import fitted_plant, loop_models, model_of
from tuning.auto.proving import RESTLESS
from tuning.auto.twin import WORLDS, Known, Twins, gain_bounds, known_of

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from tuning.auto.bench import AutoBench
    from tuning.auto.loop_model import LinkedAxis, LoopModel
    from tuning.auto.measured_margins import MeasuredAxis
    from tuning.auto.stages import Basis, RecordedGains
    from tuning.target import Target

# The grid of the outer loops: bandwidth of the velocity loop times the small lags, integration time times the
# bandwidth,
# position gain over the bandwidth; and torque P over its greatest value.
BANDWIDTHS = np.geomspace(0.01, 1.2, 20)
INTEGRATIONS = (0.8, 1.1, 1.5, 2.0, 3.0, 4.5, 7.0, 12.0)
POSITIONS = (0.08, 0.12, 0.18, 0.25, 0.33, 0.42, 0.55, 0.75, 1.0)
TORQUES = (1.0, 0.6, 0.36)
LEAST_TORQUE = 0.3  # below it the current loop is a low-pass in the velocity loop, which no engineer accepts
# The current loop: its crossover times its own lag, one and a half periods; 60 degrees of phase margin.
CURRENT_CROSSOVER, CURRENT_LAG = 0.52, 1.5
# For each bandwidth and torque P: the number of gains whose variants are computed, and of those tried on the twin. A
# slow current loop has no better promise, but passes less of the encoder's quantisation noise.
EACH_NOMINAL, EACH = 8, 2
FINALISTS = 12  # number of gains tried in all variants of the machine
STEPS = (1.4, 1.25, 1.18, 1.1, 1.06)  # factors to the neighbours of the best gains, gain by gain, up and down
PROMISING = 32  # number of neighbours that are tried
FED_FORWARD = np.array([0.3, 0.5, 0.7, 0.85, 1.0])  # of the greatest feed-forward: values tried with the best gains
SETS, RUNS = 32, 3  # sets of gains at once on the twins, and runs of each in all variants
STILL_FRICTION = WORLDS[1].friction  # over the identified one, for an axis that was not at rest


def design_axes(
    bench: AutoBench,
    basis: Basis,
    where: Mask,
    say: Callable[[float], None] = lambda share: None,
    recorded: RecordedGains | None = None,
    dynamics: Dynamics | None = None,
    most: Floats | None = None,
) -> tuple[Integers, Floats, Floats]:
    """Design gains of axes on their twins: (num_axes, count), their robust cost, and that of the present gains.

    Args:
        bench: The drives.
        basis: The identified axes.
        where: Axes to design, (num_axes,); the others get gains of 1.
        say: Called with the share that is done.
        recorded: The present gains and their measurements; None without any.
        dynamics: Requirements on the loops; those of the run by default.
        most: Greatest raw velocity P of each axis, (num_axes,); infinite by default.
    """
    target, axes = bench.target, np.flatnonzero(where).tolist()
    gains, cost, present = np.ones_like(bench.before), *np.full((2, target.num_axes), np.nan)
    if not axes:
        return gains, cost, present
    known = [_known(bench, basis, recorded, k) for k in axes]
    scaler = np.asarray(target.drives.read(Role.POSITION_SCALE), float)[axes]
    # The response of a linked axis was measured with the other one off; the model combines both.
    measured = [None if recorded is None or target.linked else measured_axis(bench, basis, recorded, k) for k in axes]
    models = [
        (model, np.searchsorted(axes, of))
        for model, of in loop_models(target, basis.identified, recorded, where, bench.dynamics)
    ]
    if recorded is not None and not target.linked:
        models += _as_rigid(target, known, measured, bench.dynamics)

    twins = partial(Twins, target.device, target.motor, known, scaler, SETS, dynamics=dynamics or bench.dynamics)
    with closing(twins(worlds=WORLDS[:1])) as one_world, closing(twins(repeats=RUNS)) as all_worlds:
        coarse, fine = (Judge(one, models, measured) for one in (one_world, all_worlds))
        found = design(coarse, fine, [one.plant for one in known], say, None if most is None else most[axes])
        if recorded is not None:
            # As near to the border as a measurement tells they are as good as inside.
            present[axes] = fine.score(recorded.gains[axes][:, None], MEASURED)[:, 0]
    gains[axes], cost[axes] = found.gains[:, 0], found.cost[:, 0]
    return gains, cost, present


def _known(bench: AutoBench, basis: Basis, recorded: RecordedGains | None, k: int) -> Known:
    """Return the data of an axis' twin: as identified, or as its response was fitted if that was measured.

    For an axis that was not at rest the dry friction is reduced: moves overestimate it, since drag looks like dry
    friction.
    """
    plant, found = basis.identified.known(k)
    reach = float(basis.trial_reach(bench)[k])
    if bench.target.linked:
        # The ends of one rigid part move it together, each its share, without twisting it.
        rigid = replace(plant, anti_resonance=math.inf, resonance=math.inf)
        return known_of(rigid, found, reach)
    plant, found = fitted_plant(bench.target, basis.identified, recorded, k)
    known = known_of(plant, found, reach)
    restless = recorded is not None and recorded.swing[k] > RESTLESS
    return known._replace(coulomb=STILL_FRICTION * known.coulomb) if restless else known


def _as_rigid(
    target: Target, known: Sequence[Known], measured: Sequence[MeasuredAxis | LinkedAxis | None], dynamics: Dynamics
) -> list[tuple[LoopModel, Integers]]:
    """Return rigid models of elastic axes that were not measured: backlash looks like a soft spring in moves."""
    rigid = [replace(one.plant, anti_resonance=math.inf, resonance=math.inf) for one in known]
    return [
        (model_of(target.device, target.motor, rigid[n], dynamics), np.array([n]))
        for n, one in enumerate(measured)
        if one is None and known[n].plant.is_elastic
    ]


class Judge(NamedTuple):
    """Judges sets of gains of n axes: on their twins, by their linear models, and by their measured loops.

    All axes of a machine whose axes are coupled get the worst cost and the worst slack among them.

    Attributes:
        twins: The twins.
        models: Linear model of each machine, and which of the n axes it has, (axes,).
        measured: The measured loops of each axis, None if they were not measured.
    """

    twins: Twins
    models: Sequence[tuple[LoopModel, Integers]]
    measured: Sequence[MeasuredAxis | LinkedAxis | None]

    def slack(self, gains: Integers, *, nominal: bool = False) -> Floats:
        """Return the relative slack of gains to the constraints; with `nominal` without the variants of the machine."""
        slack = np.full(gains.shape[:2], np.inf)
        for k, one in enumerate(self.measured):
            if one is not None:
                slack[k] = one.slack(self.twins.dynamics, gains[k])
        for model, axes in self.models:
            of_machine = model.slack(self.twins.dynamics, np.moveaxis(gains[axes], 0, 1), nominal=nominal)
            slack[axes] = np.minimum(of_machine, slack[axes].min(axis=0))
        return slack

    def score(self, gains: Integers, allowance: float = 0.0) -> Floats:
        """Return the robust cost of raw gains, (n, sets, count): (n, sets).

        Args:
            gains: Of each axis.
            allowance: By how much they may fall short of the constraints, relative.
        """
        performance, slack = self.twins.judge(gains)
        return self.of_machines(robust_cost(performance, np.minimum(slack, self.slack(gains)) + allowance), np.max)

    def of_machines(self, values: Floats, reduce: Callable[..., Floats]) -> Floats:
        """Replace the values of axes, (n, sets), by their machine's, reduced over its axes."""
        whole = values.copy()
        for _, axes in self.models:
            whole[axes] = reduce(values[axes], axis=0)
        return whole


class Designed(NamedTuple):
    """The designed gains of every axis, the best first.

    gains: Raw, (n, found, count).
    cost: Robust cost on the twins, (n, found).
    slack: Relative slack to the constraints, (n, found); below 0 if no gains keep them.
    """

    gains: Integers
    cost: Floats
    slack: Floats


def design(
    coarse: Judge,
    fine: Judge,
    plants: Sequence[Plant],
    say: Callable[[float], None] = lambda share: None,
    most_velocity_p: Floats | None = None,
) -> Designed:
    """Design gains of axes by judges.

    Args:
        coarse: Judges the axes as identified, with one run of each set.
        fine: Judges the same axes in all variants of the machine, with several runs.
        plants: The axes, in the order of the judges.
        say: Called with the share that is done; an exception from it ends the design.
        most_velocity_p: Greatest velocity P, raw, (n,); infinite by default.
    """
    device, n = coarse.twins.device, coarse.twins.num_axes

    def promise(gains: Integers) -> Floats:
        return coarse.of_machines(_promise(device, gains), np.mean)

    most = np.full(n, np.inf) if most_velocity_p is None else most_velocity_p
    column = cascade_columns(device)[2]
    pool = np.array([_grid(device, plant, TORQUES) for plant in plants])
    torque_p = pool[..., cascade_columns(device)[0]].max(axis=1)
    pool[..., column] = np.minimum(pool[..., column], most[:, None])
    # The most promising gains of each bandwidth: first those that keep the nominal margins, then with the variants.
    for each, nominal in ((EACH_NOMINAL, True), (EACH, False)):
        rows = _of_each(coarse.slack(pool, nominal=nominal), promise(pool), each, len(BANDWIDTHS) * len(TORQUES))
        pool = np.take_along_axis(pool, rows[:, :, None], axis=1)
        say(0.2)
    cost = coarse.score(pool)
    say(0.4)
    best = np.argsort(cost, axis=1, kind="stable")[:, :FINALISTS]
    pool = np.take_along_axis(pool, best[:, :, None], axis=1)
    cost = fine.score(pool)
    for number, step in enumerate(STEPS):
        say(0.5 + 0.5 * number / len(STEPS))
        at = cost.argmin(axis=1)
        near = np.array([_around(device, pool[k, at[k]], step, int(torque_p[k])) for k in range(n)])
        near[..., column] = np.minimum(near[..., column], most[:, None])
        slack = coarse.slack(near)
        promising = np.argsort(np.where(slack > 0.0, promise(near), 1e9 - slack), axis=1, kind="stable")
        near = np.take_along_axis(near, promising[:, :PROMISING, None], axis=1)
        pool, cost = np.concatenate([pool, near], axis=1), np.concatenate([cost, fine.score(near)], axis=1)
    ahead = device.gains.column(*FEED_FORWARD)
    if ahead is not None:
        fed = np.repeat(np.take_along_axis(pool, cost.argmin(axis=1)[:, None, None], axis=1), len(FED_FORWARD), axis=1)
        fed[..., ahead] = np.rint(device.gains.rows[ahead].highest * FED_FORWARD)
        pool, cost = np.concatenate([pool, fed], axis=1), np.concatenate([cost, fine.score(fed)], axis=1)
    order = np.argsort(cost, axis=1, kind="stable")[:, :FINALISTS]
    pool = np.take_along_axis(pool, order[:, :, None], axis=1)
    return Designed(pool, np.take_along_axis(cost, order, axis=1), coarse.slack(pool))


def design_by_loops(
    device: Device, plant: Plant, slack: Callable[[Integers, bool], Floats], most_velocity_p: float
) -> tuple[Integers, float]:
    """Return the most promising gains that keep the constraints of the loops, (count,), and their slack.

    It takes seconds, since no twin runs: friction and noise are ignored, and the current loop has the crossover that
    its lags allow.

    Args:
        device: The drive.
        plant: The axis.
        slack: Returns the slack of raw gains, (sets, count), to the constraints, (sets,); its second argument selects
            the nominal axis without variants.
        most_velocity_p: Greatest velocity P, raw.
    """
    column = cascade_columns(device)[2]

    def bounded(gains: Integers) -> Integers:
        gains[:, column] = np.minimum(gains[:, column], most_velocity_p)
        return gains

    pool = bounded(_grid(device, plant, TORQUES[:1]))
    torque, torque_p = cascade_columns(device)[0], int(pool[0, cascade_columns(device)[0]])
    pool = pool[_of_each(slack(pool, True)[None], _promise(device, pool)[None], EACH_NOMINAL, len(BANDWIDTHS))[0]]
    for step in STEPS:
        best, _ = _best(device, pool, slack(pool, False))
        near = bounded(_around(device, best, step, torque_p))
        pool = np.concatenate([best[None], np.unique(near[near[:, torque] == torque_p], axis=0)])
    return _best(device, pool, slack(pool, False))


def _best(device: Device, gains: Integers, slack: Floats) -> tuple[Integers, float]:
    """Return the most promising gains that keep the constraints, else those with the most slack, and their slack."""
    best = int(np.argmin(np.where(slack > 0.0, _promise(device, gains), 1e9 - slack)))
    return gains[best], float(slack[best])


def _grid(device: Device, plant: Plant, torques: Sequence[float]) -> Integers:
    """Return the raw gains of the grid for an axis, (sets, count); bandwidth varies slowest."""
    scales = si_scales(device, plant.supply)
    lag = CURRENT_LAG / device.current_rate
    small = float(small_time_constants(device, plant.velocity_filter)) + plant.delay - 1.0 / device.velocity_rate
    rows = []
    for bandwidth, torque, integration, position in product(BANDWIDTHS, torques, INTEGRATIONS, POSITIONS):
        w = bandwidth / small
        values: dict[Part, float] = {
            ("current", "P"): torque * CURRENT_CROSSOVER / lag * plant.L,
            ("current", "I"): plant.R / plant.L,
            ("velocity", "P"): plant.inertia / plant.torque_constant * w,
            ("velocity", "I"): w / integration,
            ("position", "P"): position * w,
        }
        parts = [(row.loop, row.part) for row in device.gains.rows]
        rows.append([float(scales[part].raw(values[part])) if part in scales else 0.0 for part in parts])
    return _whole(device, np.array(rows))


def _whole(device: Device, rows: Floats | Integers) -> Integers:
    return np.clip(np.rint(rows), *gain_bounds(device)).astype(np.int64)


def _promise(device: Device, gains: Integers) -> Floats:
    """Estimate ln J without noise and resonances, over 0.4 and up to a constant, (n, sets); smaller is better.

    The product of the gains determines the error that a load step and dry friction leave.
    """
    return np.asarray(-np.log(device.gains.strength(gains, cascade_columns(device)[2:])).sum(axis=-1))


def _of_each(slack: Floats, promise: Floats, each: int, count: int) -> Integers:
    """Return the most promising gains of each of `count` pairs of bandwidth and torque P that keep the constraints.

    If too few do, those with the most slack follow. Indices of shape (n, count * each).
    """
    n, sets = slack.shape
    group = (n, count, sets // count)
    order = np.argsort(np.where(slack > 0.0, promise, 1e9 - slack).reshape(group), axis=2, kind="stable")[:, :, :each]
    first = group[2] * np.arange(group[1])[:, None]
    return np.asarray((order + first).reshape(n, -1))


def _around(device: Device, gains: Integers, step: float, most_torque_p: int) -> Integers:
    """Return the neighbours of gains, (sets, count): all outer gains and torque P, up and down by a factor."""
    torque_p, _, velocity_p, velocity_i, position_p = cascade_columns(device)
    factors = np.array(list(product((1.0 / step, 1.0, step), repeat=4)))
    rows = device.gains.scaled(gains, factors, [torque_p, velocity_p, velocity_i, position_p])
    rows[:, torque_p] = np.clip(rows[:, torque_p], np.rint(LEAST_TORQUE * most_torque_p), most_torque_p)
    return _whole(device, rows)
