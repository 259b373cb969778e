"""Optimisation of gains on drives: generations of trials, whose cost is computed from the drives' signals.

Optimisers search the logarithms of gains around the baseline rule's: each machine separately, or, if the emulated
machines are copies of one machine, in one search that tries a generation on all copies at the same time. The safe
search starts at slow gains that proved stable, continues in small steps from proved ones, and never beyond gains that
oscillated.

With dynamics, the axes are identified first, and no drive gets gains that break the dynamics by the model of its axes:
for these the sampler gets the robust cost (drive_env/trials/score.py), which depends on how far they break them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.devices.gains import RAW_MAX
from drive_env.drives.raw_gains import write_gains
from drive_env.loops.dynamics import find_dynamics
from drive_env.trials.method import check_tried
from drive_env.trials.position_pid import STEADY_SPEEDS, SWING, PidTrials
from drive_env.trials.positioning import wrapped
from drive_env.trials.score import TRIP, robust_cost
from mechanics.arrays import Floats, Integers
from tuning.identify.working_state import check_identifiable
from tuning.runs.shard_log import ShardLog
from tuning.search.model_margins import ModelMargins
from tuning.search.samplers import SAMPLERS, Proposer, Study, load, new_proposer
from tuning.search.trial_bench import OBJECTIVES, TrialBench, Tried
from tuning.search.trial_log import LoggedTrials
from tuning.target import Target, timed

COST = "cost"
WIDTH = math.log(6.0)  # from a sixth to six times the rule's gains
SAFE_STEP = 0.4  # of a gain's logarithm, measured from the nearest proved gains
SAFE_STARTS = 3  # halvings of the safe gains before the search of a machine ends
SAFE_HALVINGS = 3  # halvings of a step towards gains that oscillated, before it is skipped
PULLED = 0.2  # cost of a point per unit of distance by which the safe search moved it
SHUNNED = 1.0  # additional cost of a stopped trial in the safe search
UNTRIED = 20  # proposals that may break the dynamics per trial, before the search ends
SLOWER = 6  # halvings of first gains until they keep the dynamics


@dataclass(frozen=True)
class Settings:
    """The settings of a search.

    Attributes:
        sampler: One of `samplers.SAMPLERS`.
        trials: Number of trials of every search, with the first ones.
        objectives: ("cost",), or several of "speed", "robustness" and "current" (trial_bench.py).
        gains: Names of the searched gains of the device; the others are set by the rule. None selects those of velocity
            and position loop.
        width: Half width of the search, as the logarithm of a factor on the rule's gains.
        safe: Start from safe gains and continue from proved ones.
        seed: Seed of everything random.
        journal: File of Optuna's journal, in which the search is stored and from which it continues.
        subject: What is searched, as text: a journal with another subject is refused.
        dynamics: Requirements on the outer loops by their model, as in `find_dynamics`; None sets none.
        inertia_range: Range of load inertia over which they must be kept, as in `find_dynamics`.
    """

    sampler: str = "tpe"
    trials: int = 30
    objectives: tuple[str, ...] = (COST,)
    gains: tuple[str, ...] | None = None
    width: float = WIDTH
    safe: bool = False
    seed: int = 0
    journal: Path | None = None
    subject: str = ""
    dynamics: str | None = None
    inertia_range: str | None = None

    def __post_init__(self) -> None:
        _check("sampler", [self.sampler], SAMPLERS)
        _check("objective", self.objectives, (COST, *OBJECTIVES))
        if self.dynamics is not None:
            find_dynamics(self.dynamics, self.inertia_range)
        if self.trials < 1:
            raise ValueError(f"trials must be 1 or more, not {self.trials}")
        if not 0.0 < self.width <= math.log(RAW_MAX):
            raise ValueError(f"width must lie above 0 and up to {math.log(RAW_MAX):.1f}, not {self.width:g}")


class TrialRow(NamedTuple):
    """A finished trial.

    search, number: Index of the search, and number of the trial in it.
    gains: Gains of the machine's axes, raw integers, shape (axes_per_machine, count).
    cost: ln J by measured terms.
    objectives: Values in the order of `OBJECTIVES`.
    aborted: Stopped because of an oscillation or a fault.
    fragile: Rejected because with these gains the axis did not stop oscillating after a disturbance.
    cause: Emergencies of the drives in a stopped trial; "" without any.
    slack: Relative slack of the gains to the dynamics by the model, 0 if they are only just kept; infinite without
        dynamics.
    """

    search: int
    number: int
    gains: Integers
    cost: float
    objectives: tuple[float, ...]
    aborted: bool
    fragile: bool = False
    cause: str = ""
    slack: float = math.inf

    @property
    def robust_cost(self) -> float:
        """Logarithm of the robust cost by J and slack; it continues to grow where J saturates."""
        if math.isinf(self.slack):
            return self.cost
        judged = robust_cost(np.exp(self.cost), np.array(self.slack))
        return math.log(float(judged)) + max(self.cost - math.log(TRIP), 0.0)

    @property
    def accepted(self) -> bool:
        """Whether the gains may be kept."""
        return not (self.aborted or self.fragile)


@dataclass(frozen=True)
class Optimised:
    """The result of a search.

    Attributes:
        gains: Best gains of every machine, raw integers, shape (num_axes, count); in the safe search, of a trial that
            was never stopped. With dynamics and without an accepted trial, the gains before.
        rule: The baseline rule's gains for the identified axes, shape (num_axes, count).
        cost: ln J by measured terms of the best gains, shape (num_machines,).
        rows: All trials in order.
        drive_seconds: Time that passed on the drives [s].
        moves, aborts: Counts of every axis, shape (num_axes,).
        notes: Problems of every machine; "" without any.
        t_0: Settling time to which the objective speed is relative [s].
        untried: Number of proposals that broke the dynamics by the model, so that no drive got them.
        margins: Margins of the gains by the model: phase margin [degrees], gain margin [dB] and Ms of velocity and
            position loop, shape (num_axes, 2, 3); nan without dynamics.
    """

    gains: Integers
    rule: Integers
    cost: Floats
    rows: tuple[TrialRow, ...]
    drive_seconds: float
    moves: Integers
    aborts: Integers
    notes: tuple[str, ...]
    t_0: float
    untried: int
    margins: Floats

    def front(self, objectives: Sequence[str], search: int = 0) -> list[TrialRow]:
        """Return a search's accepted trials on the Pareto front of the objectives."""
        return pareto([row for row in self.rows if row.search == search and row.accepted], objectives)


def optimise(
    target: Target,
    settings: Settings,
    *,
    shared: bool = False,
    anew: bool = False,
    log: ShardLog | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Optimised:
    """Search gains and write the best ones to the drives.

    Args:
        target: The target to tune; its drives may have any gains.
        settings: Settings of the search.
        shared: The machines are copies of one: a single search tries each generation on all of them.
        anew: As in `TrialBench`.
        log: Finished trials of an earlier run, to which new ones are added; only with `anew` and without a journal.
        progress: Called with the share that is done.

    Raises:
        ValueError: For a gain that the device does not have, a sampler that lacks a package or does not support several
            objectives, or dynamics for a drive without a linear model.
        RuntimeError: If dynamics are requested and an axis cannot be identified.
        ShardLogError: If the log is of another search.
    """
    if log is not None and (not anew or settings.journal is not None):
        raise ValueError(
            "a search is continued from its log only if every trial starts from rest, and if it has no journal"
        )
    chosen = target.device.gains.outer if settings.gains is None else settings.gains
    check_tried(target.device, chosen)  # checked before anything moves
    columns = target.device.gains.columns(chosen)
    if settings.dynamics is not None:
        check_identifiable(target.device)
    with timed(target) as (watched, clock):
        known = None
        if settings.dynamics is not None:
            began = target.drives.read(cia402.POSITION_ACTUAL)
            # For copies of one machine, only the first is identified.
            where = np.arange(target.num_axes) < (target.axes_per_machine if shared else target.num_axes)
            known = ModelMargins(watched, find_dynamics(settings.dynamics, settings.inertia_range), where)
            if not anew:
                low, high = watched.travel_left(began)
                watched = replace(watched, low=low, high=high)
        bench = TrialBench(watched, anew=anew, gains=chosen)
        load(settings.sampler)
        bench.identify()
        trials = bench if log is None else LoggedTrials(bench, clock, log)
        search = _Search(bench, settings, columns, shared, trials, known)
        while search.generation():
            progress(search.share())
        gains, cost = search.best()
        if isinstance(bench.trials, PidTrials):
            search.tell_of_swings(gains)
        bench.leave(gains)
    margins = np.full((len(gains), 2, 3), np.nan) if known is None else known.margins(gains)
    return Optimised(
        gains, bench.rule, cost, search.judged(), clock.seconds, bench.moves, bench.aborts, tuple(search.notes),
        bench.t_0, sum(search.untried), margins,
    )  # fmt: skip


class _Search:
    """Simultaneous searches on the machines of a bench; a point is the logarithms of gains over the rule's.

    All axes of a machine use the same factors: the rule already adapts to the axes, and a search of three numbers
    succeeds in twenty trials where one of eighteen numbers does not.
    """

    def __init__(
        self,
        bench: TrialBench,
        settings: Settings,
        columns: Integers,
        shared: bool,
        trials: TrialBench | LoggedTrials,
        known: ModelMargins | None = None,
    ) -> None:
        machines, axes = bench.num_machines, bench.target.axes_per_machine
        self.rows: list[TrialRow] = []
        self.notes = [""] * machines
        self._bench, self._trials, self._settings, self._axes = bench, trials, settings, axes
        self._columns, self._known = columns, known
        # Machines of each search: its generation is tried on all of them.
        self._members = [np.arange(machines)] if shared else [np.array([k]) for k in range(machines)]
        self.untried = [0] * len(self._members)
        start = self._points(bench.safe if settings.safe else bench.rule)
        self._start = [self._slowed(k, start[members[0]]) for k, members in enumerate(self._members)]
        self._proved: list[list[Floats]] = [[] for _ in self._members]
        self._refuted: list[list[Floats]] = [[] for _ in self._members]
        self._fragile: list[set[bytes]] = [set() for _ in self._members]
        self._least = np.full(machines, np.inf)
        self._halted = [False] * len(self._members)
        self._proposers = [self._proposer(k) for k in range(len(self._members))]
        for k, proposer in enumerate(self._proposers):
            for fact in proposer.history():
                row = _row(k, fact)
                if row.slack > 0.0:
                    self._take(k, np.array(fact["point"]), row)
                else:
                    self.untried[k] += 1
        if settings.safe:
            self._prove()

    def generation(self) -> bool:
        """Try a generation; return False if no trials are left."""
        asked, held, slack = {}, {}, {}
        for k, members in enumerate(self._members):
            while (left := self._settings.trials - self._made(k)) > 0 and not self._halted[k]:
                points = self._proposers[k].ask(min(len(members), left))
                own = [self._held_back(k, point) for point in points]
                kept = [self._slack(k, place, point) for place, point in enumerate(own)]
                if any(value > 0.0 for value in kept):
                    asked[k], held[k], slack[k] = points, own, kept
                    break
                if not points:
                    break
                self._tell(k, points, own, kept)
                if self.untried[k] >= UNTRIED * self._settings.trials:
                    self._halted[k] = True
                    self._note(
                        k,
                        f"the search ended after {self._made(k)} trials: {self.untried[k]} proposals broke "
                        f"{self._settings.dynamics} dynamics by the model; give less width, or ask for less",
                    )
        if not asked:
            return False
        tried, gains = self._run(held, slack)
        self._drop_fragile(tried)
        for k, points in asked.items():
            self._tell(k, points, held[k], slack[k], (tried, gains))
        return True

    def share(self) -> float:
        """Return the share of the trials that is done."""
        made = [self._made(k) for k, halted in enumerate(self._halted) if not halted]
        return min(made) / self._settings.trials if made else 1.0

    def best(self) -> tuple[Integers, Floats]:
        """Return the best gains of every machine, shape (num_axes, count), and their costs, shape (num_machines,)."""
        bench = self._bench
        start = bench.safe if self._settings.safe else bench.rule
        gains = (start if self._known is None else self._known.before).copy()
        cost = np.full(bench.num_machines, np.nan)
        for k, members in enumerate(self._members):
            row = self._best_row(k)
            for machine in members:
                if row is not None:
                    gains[self._axes_of(machine)], cost[machine] = row.gains, row.cost
            if row is None and self._known is not None:
                asked = f"{self._settings.dynamics} dynamics"
                none = f"no gains keep {asked} and pass a trial: the drives keep those of before"
                self._note(k, "; ".join(filter(None, (self.notes[members[0]], none))))
        return gains, cost

    def tell_of_swings(self, gains: Integers) -> None:
        """Add a reservation if the rotor oscillates at a steady speed with the best gains of a PID."""
        bench = self._bench
        drives = bench.target.drives
        everywhere = np.ones(bench.target.num_axes, bool)
        write_gains(drives, gains)
        bench.trials.recover(everywhere)
        # There and back from the present positions, in the direction with the longer remaining way.
        gone = wrapped(drives.read(cia402.POSITION_ACTUAL) - bench.began) / bench.target.increments()
        left = bench.reach - gone
        swings = bench.trials.steady_swings(left, everywhere).reshape(len(STEADY_SPEEDS), bench.num_machines, -1)
        worst = np.nan_to_num(swings).max(axis=2)
        for machine in range(bench.num_machines):
            seen = [f"{worst[k, machine]:.2g} at {speed:g} rev/s"
                    for k, speed in enumerate(STEADY_SPEEDS) if worst[k, machine] > SWING]  # fmt: skip
            if seen:
                said = (
                    f"reservation: at a steady speed the rotor swings by more than {SWING:g} full steps RMS "
                    f"({', '.join(seen)}), which the short moves of trials do not show: close the loop by the load "
                    "angle for such speeds, or change the run current"
                )
                self.notes[machine] = "; ".join(filter(None, (self.notes[machine], said)))

    def judged(self) -> tuple[TrialRow, ...]:
        """Return all trials, with `fragile` set for gains that were found fragile later."""
        return tuple(row._replace(fragile=row.gains.tobytes() in self._fragile[row.search]) for row in self.rows)

    def _best_row(self, k: int) -> TrialRow | None:
        unstopped = self._unstopped(k)
        if not unstopped:
            rows = [row for row in self.rows if row.search == k]
            if rows and not self._settings.safe and self._known is None:
                self._note(k, "every trial was stopped; these are the gains of least cost")
                return min(rows, key=lambda row: row.robust_cost)
            return None
        return min(pareto(unstopped, self._settings.objectives), key=lambda row: row.robust_cost)

    # --- a generation -------------------------------------------------------------------------------------------------
    def _run(self, held: dict[int, list[Floats]], slack: dict[int, list[float]]) -> tuple[Tried, Integers]:
        """Try the points that keep the dynamics, each on its own machine; return results and gains."""
        gains, where = self._bench.incumbent.copy(), np.zeros(self._bench.num_machines, bool)
        for k, points in held.items():
            for machine, point, kept in zip(self._members[k], points, slack[k], strict=False):
                if kept > 0.0:
                    gains[self._axes_of(machine)] = self._gains(machine, point)
                    where[machine] = True
        return self._trials.run(gains, where), gains

    def _tell(
        self,
        k: int,
        asked: list[Floats],
        held: list[Floats],
        slack: list[float],
        run: tuple[Tried, Integers] | None = None,
    ) -> None:
        """Give a sampler the costs of its proposals; only those that keep the dynamics were run."""
        values, facts, made, untried = [], [], self._made(k), 0
        for place, (point, own, kept) in enumerate(zip(asked, held, slack, strict=True)):
            machine = int(self._members[k][place])
            if kept > 0.0:
                assert run is not None, "what keeps the dynamics is tried"
                tried, gains = run
                row = TrialRow(
                    k,
                    made + place - untried,
                    gains[self._axes_of(machine)].copy(),
                    float(tried.cost[machine]),
                    tuple(map(float, tried.objectives[machine])),
                    bool(tried.aborted[machine]),
                    cause=str(tried.causes[machine]) if tried.aborted[machine] else "",
                    slack=kept,
                )
                self._take(k, own, row)
            else:
                row = TrialRow(
                    k, -1, self._gains(machine, own), math.log(TRIP), self._bench.worst, aborted=False, slack=kept
                )
                untried += 1
            pulled = PULLED * float(np.abs(point - own).max()) + SHUNNED * (self._settings.safe and row.aborted)
            values.append([value + pulled for value in objective_values(row, self._settings.objectives)])
            facts.append({"point": own.tolist()} | {**row._asdict(), "gains": row.gains.tolist()})
        self._proposers[k].tell(values, facts)
        self.untried[k] += untried

    def _made(self, k: int) -> int:
        """Return the number of finished trials of a search."""
        return self._proposers[k].told - self.untried[k]

    def _drop_fragile(self, tried: Tried) -> None:
        """Discard the last good gains if they could not end an oscillation; the best earlier ones replace them."""
        for k, members in enumerate(self._members):
            for machine in map(int, members[tried.fragile[members]]):
                axes = self._axes_of(machine)
                self._fragile[k].add(self._bench.incumbent[axes].tobytes())
                left = min(self._unstopped(k), key=lambda row: row.robust_cost, default=None)
                self._bench.incumbent[axes] = self._bench.safe[axes] if left is None else left.gains
                self._least[machine] = np.inf if left is None else left.robust_cost
                self._note(
                    k,
                    "gains that passed a trial were not kept: the axis did not stop oscillating with them "
                    "after a disturbance",
                )

    def _unstopped(self, k: int) -> list[TrialRow]:
        """Return a search's trials that were not stopped, and whose gains were not found fragile later."""
        return [
            row
            for row in self.rows
            if row.search == k and not row.aborted and row.gains.tobytes() not in self._fragile[k]
        ]

    def _take(self, k: int, point: Floats, row: TrialRow) -> None:
        """Record a trial; if it is the best so far and was not stopped, its gains are the last good ones."""
        self.rows.append(row)
        (self._refuted if row.aborted else self._proved)[k].append(point)
        for machine in map(int, self._members[k]):
            if not row.aborted and row.robust_cost < self._least[machine]:
                self._least[machine] = row.robust_cost
                self._bench.incumbent[self._axes_of(machine)] = row.gains

    # --- the safe search ----------------------------------------------------------------------------------------------
    def _prove(self) -> None:
        """Try the safe gains first, then slower ones; end the search of a machine that oscillates with all of them."""
        searches = [k for k in range(len(self._members)) if not self._proved[k]]
        point = {k: self._start[k] for k in searches}
        for _ in range(SAFE_STARTS):
            slack = {k: [self._slack(k, 0, point[k])] for k in searches}
            for k in [k for k in searches if slack[k][0] <= 0.0]:
                self._halted[k] = True
                searches.remove(k)
                self._note(k, f"no slow gains keep {self._settings.dynamics} dynamics by the model: no safe start")
            if not searches:
                return
            for k in searches:
                self._proposers[k].ask(1)
            run = self._run({k: [point[k]] for k in searches}, slack)
            for k in searches:
                self._tell(k, [point[k]], [point[k]], slack[k], run)
            searches = [k for k in searches if not self._proved[k]]
            for k in searches:
                point[k] = point[k] - self._bench.method.caution * math.log(2.0)
        for k in searches:
            self._halted[k] = True
            self._note(
                k,
                f"the axis oscillated with the safe gains, and with 1/{2 ** (SAFE_STARTS - 1)} of them: no safe start"
                if self._bench.method.caution > 0
                else "the axis was stopped even at its motor's rated current: no safe start",
            )

    def _held_back(self, k: int, point: Floats) -> Floats:
        """Return the point; in the safe search moved close to proved points and away from refuted ones."""
        if not self._settings.safe:
            return point
        proved, caution = np.array(self._proved[k]), self._bench.method.caution
        nearest = proved[np.abs(proved - point).max(axis=1).argmin()]
        step = np.clip(point - nearest, -SAFE_STEP, SAFE_STEP)
        for _ in range(SAFE_HALVINGS):
            # Not beyond gains that oscillated (each at least as large) or currents that lost steps (each at most as
            # large), nor closer to them than half a step.
            if not any(
                np.all(caution * (nearest + step - bad) >= 0.0) or np.abs(nearest + step - bad).max() < 0.5 * SAFE_STEP
                for bad in self._refuted[k]
            ):
                return np.asarray(nearest + step)
            step = 0.5 * step
        return np.asarray(nearest)

    # --- points and gains ---------------------------------------------------------------------------------------------
    def _proposer(self, k: int) -> Proposer:
        settings, start = self._settings, self._start[k]
        low = np.minimum(np.full(start.shape, -settings.width), start)
        return new_proposer(
            settings.sampler,
            low,
            np.full(start.shape, settings.width),
            seed=settings.seed + 7919 * k,
            objectives=len(settings.objectives),
            trials=settings.trials,
            first=[start],
            generation=len(self._members[k]),
            journal=settings.journal,
            study=Study(
                f"machine {k}",
                f"{settings.subject}\n{settings.gains} {settings.objectives} {settings.dynamics} "
                f"{settings.inertia_range or ''}".rstrip(),
            ),
        )

    def _slack(self, k: int, place: int, point: Floats) -> float:
        """Return the slack to the dynamics by the model, of gains at a point on the machine at a place in a search."""
        if self._known is None:
            return math.inf
        members = self._members[k]
        return self._known.slack(self._gains(int(members[place]), point), self._axes_of(members[0]))

    def _slowed(self, k: int, point: Floats) -> Floats:
        """Return a first point with gains halved until they keep the dynamics; unchanged if none of these do."""
        slower = (point - step * math.log(2.0) for step in range(SLOWER))
        return next((one for one in slower if self._slack(k, 0, one) > 0.0), point)

    def _points(self, gains: Integers) -> Floats:
        """Convert gains to points of the machines, shape (num_machines, dimensions)."""
        known = self._bench.target.device.gains
        logs = known.change(gains, self._bench.rule, self._columns)
        return np.asarray(logs.reshape(self._bench.num_machines, self._axes, len(self._columns)).mean(axis=1))

    def _gains(self, machine: int, point: Floats) -> Integers:
        """Return the gains of a machine's axes at a point, shape (axes_per_machine, count)."""
        known = self._bench.target.device.gains
        return known.changed(self._bench.rule[self._axes_of(machine)], point, self._columns, self._bench.highest)

    def _axes_of(self, machine: int) -> slice:
        return slice(int(machine) * self._axes, (int(machine) + 1) * self._axes)

    def _note(self, k: int, text: str) -> None:
        for machine in self._members[k]:
            self.notes[machine] = text


def pareto(rows: Sequence[TrialRow], objectives: Sequence[str]) -> list[TrialRow]:
    """Return the trials on the Pareto front, in the order of the first objective."""
    values = np.array([objective_values(row, objectives) for row in rows]).reshape(len(rows), len(objectives))
    best = [
        k for k, own in enumerate(values) if not np.any(np.all(values <= own, axis=1) & np.any(values < own, axis=1))
    ]
    return sorted((rows[k] for k in best), key=lambda row: objective_values(row, objectives))


def objective_values(row: TrialRow, objectives: Sequence[str]) -> tuple[float, ...]:
    """Return a trial's value in each objective; smaller is better."""
    broken = math.log(2.0 - math.exp(min(row.slack, 0.0)))  # as in the robust cost
    return tuple(
        row.robust_cost if name == COST else row.objectives[OBJECTIVES.index(name)] + broken for name in objectives
    )


def _row(search: int, fact: Mapping[str, Any]) -> TrialRow:
    """Return a trial from its facts in a journal."""
    return TrialRow(
        search,
        int(fact["number"]),
        np.array(fact["gains"], np.int64),
        float(fact["cost"]),
        tuple(fact["objectives"]),
        bool(fact["aborted"]),
        cause=str(fact.get("cause", "")),
        slack=float(fact.get("slack", math.inf)),
    )


def _check(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError unless all names are known and different."""
    for name in names:
        if name not in known:
            raise ValueError(f"no {what} is named {name!r}; there are {', '.join(known)}")
    if not names or len(set(names)) != len(names):
        raise ValueError(f"give different ones of {what}: {', '.join(known)}, not {', '.join(names) or 'none'}")
