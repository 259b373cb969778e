"""Tuners compared on the same machines: the robust cost of their gains, and the drive time and moves they took.

Every tuner gets every machine as it comes from the box, under an audit that counts time, moves and violations. Gains
are scored in the emulator by the robust cost (drive_env/trials/score.py), relative to that of the baseline rule which
knows the true inertia; a tuner never sees the score.
"""

from __future__ import annotations

import json
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import machine_of
from drive_env.drives.observed import ObservedDrives
from drive_env.gains import rule_gains
from drive_env.trials.positioning import highest_ramp, longer_way, plan_move
from drive_env.trials.score import RobustScore
from mechanics.untrusted import parse_json
from tuning.compare.rule_check import rule_passes
from tuning.compare.suite import SuiteMachine, groups, open_group
from tuning.compare.tuners import RuleTuner, find_tuner, identify_all
from tuning.drive_audit import KINDS, DriveAudit
from tuning.identify.moved_inertia import moved_inertia
from tuning.outcome import Outcome, Tuner
from tuning.runs.inputs import as_given, taken_options
from tuning.runs.shard_log import ShardLog
from tuning.search.trial_bench import read_gains
from tuning.target import Target

if TYPE_CHECKING:
    from tuning.identify.estimate import Identification
    from tuning.runs.pools import Pool

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Progress = Callable[[str, float], None]

# Runs of every machine and variant, each with a noise of its own, whose scores are averaged: with one run, the same
# gains get a score that differs by 10 % on some machines, and the rule's count as worse than themselves on one of 13.
REPEATS = 16
WORSE = 1.05  # times the baseline rule's robust cost: from here on a tuning counts as worse


@dataclass(frozen=True)
class MachineRow:
    """The result of a tuner on a machine.

    robust_cost, relative: The robust cost, and over that of the baseline rule. rule: That of the baseline rule.
    drive_seconds: Until the drive was last written to or moved [s], waits for the machines beside it included.
    moves: Of all its axes, each from standstill to standstill (moves.py). aborts: As the tuner says.
    violations: Of all kinds. gains: Raw gains of the machine's first axis, by the names that its device has for them.
    note: What the tuner says, or why it failed; then the gains are those that it left behind.
    rule_passes: Whether the baseline rule's gains themselves pass the checks of auto on this machine (rule_check.py).
    """

    tuner: str
    machine: str
    robust_cost: float
    relative: float
    rule: float
    drive_seconds: float
    moves: int
    aborts: int
    violations: int
    kinds: str
    failed: bool
    gains: Mapping[str, int]
    note: str
    rule_passes: bool = True


@dataclass(frozen=True)
class TunerRow:
    """The result of a tuner over all machines.

    median, p95: Of the robust cost over the baseline rule's. worse: Share of machines that are more than 5 % worse.
    drive_seconds, moves: Median of a machine. aborts, violations: Of all machines together. failed: Machines on which
    it gave up with an error. rule_passes: Machines on which the baseline rule's own gains pass the checks of auto, with
    median, p95 and share worse on these alone; None where there are none.
    """

    tuner: str
    machines: int
    median: float
    p95: float
    worse: float
    drive_seconds: float
    moves: float
    aborts: int
    violations: int
    failed: int
    rule_passes: int = 0
    median_there: float | None = None
    p95_there: float | None = None
    worse_there: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Rows of every tuner and machine, and what each tuner is worth, the best median first."""

    rows: tuple[MachineRow, ...]
    tuners: tuple[TunerRow, ...]

    def of(self, tuner: str) -> list[MachineRow]:
        """Return a tuner's rows."""
        return [row for row in self.rows if row.tuner == tuner]


def compare(
    machines: Sequence[SuiteMachine],
    tuners: Mapping[str, Tuner],
    *,
    seed: int = 0,
    num_threads: int | None = None,
    log: ShardLog | None = None,
    progress: Progress = lambda what, share: None,
    pool: Pool | None = None,
    trials: int | None = None,
) -> Comparison:
    """Have every tuner tune every machine.

    Args:
        machines: The suite.
        tuners: By name.
        seed: What the tuners draw from; the same machines and tuner see the same chances whatever else is compared.
        num_threads: As `EmulatedDrives` takes it.
        log: What tuners made of machines already, and where what is to come is kept.
        progress: Called with what is under way and the share that is done.
        pool: Where else it runs, which changes no digit; there the tuners are found by their names and `trials`.
        trials: As `find_tuner` takes it.
    """
    tasks = [(indices, name) for indices in groups(machines) for name in tuners]
    done = {} if log is None else {k: _rows_of(str(arrays["rows"])) for k, arrays in log.done.items()}
    left = [k for k in range(len(tasks)) if k not in done]

    def say(k: int) -> None:
        machine = machines[tasks[k][0][0]]
        progress(f"{tasks[k][1]} on {machine.load}, {machine.motor}", len(done) / len(tasks))

    if pool is None:
        fresh = _here(machines, tuners, tasks, left, seed, num_threads, say)
    else:
        fresh = _elsewhere(machines, tasks, left, seed, trials, pool, say)
    for k, rows in fresh:
        done[k] = rows
        if log is not None:
            log.append(k, {"rows": np.array(_text_of(rows))})
    progress("", 1.0)
    found = _compared(machines, list(tuners), done)
    assert found is not None, "all tasks are done"
    return found


def so_far(machines: Sequence[SuiteMachine], tuners: Sequence[str], log: ShardLog) -> Comparison | None:
    """Return the comparison on those machines that a run which was stopped has had all tuners tune; None if none."""
    return _compared(machines, tuners, {k: _rows_of(str(arrays["rows"])) for k, arrays in log.done.items()})


def _compared(
    machines: Sequence[SuiteMachine], tuners: Sequence[str], done: Mapping[int, Sequence[MachineRow]]
) -> Comparison | None:
    """Return the comparison by the rows of tasks; on the machines that all tuners have tuned."""
    tasks = [(indices, name) for indices in groups(machines) for name in tuners]
    found = {(tasks[k][1], i): row for k, own in done.items() for i, row in zip(tasks[k][0], own, strict=True)}
    common = [i for i in range(len(machines)) if all((name, i) in found for name in tuners)]
    if not common:
        return None
    ordered = tuple(found[name, i] for name in tuners for i in common)
    summaries = [_summary(name, [row for row in ordered if row.tuner == name]) for name in tuners]
    return Comparison(ordered, tuple(sorted(summaries, key=lambda row: (row.median, row.tuner))))


class _GroupTask(NamedTuple):
    """A tuner on the machines of a group, for another process."""

    group: list[SuiteMachine]
    tuner: str
    trials: int | None
    seed: int


def _run(task: _GroupTask) -> str:
    """Return what a tuner makes of the machines of a group, as text."""
    with closing(Yardstick(task.group, 1)) as yardstick:
        tuned = _Bench(task.group, task.seed, 1).tune(task.tuner, find_tuner(task.tuner, task.trials))
        return _text_of(_rows(task.tuner, task.group, tuned, yardstick))


def _here(
    machines: Sequence[SuiteMachine],
    tuners: Mapping[str, Tuner],
    tasks: Sequence[tuple[Sequence[int], str]],
    left: Sequence[int],
    seed: int,
    num_threads: int | None,
    say: Callable[[int], None],
) -> Iterator[tuple[int, list[MachineRow]]]:
    """Give the number and the rows of each task as it is done, group by group: what a group needs is made once."""
    with ExitStack() as open_now:
        indices: Sequence[int] = ()
        for k in left:
            if tasks[k][0] is not indices:
                open_now.close()
                indices = tasks[k][0]
                group = [machines[index] for index in indices]
                yardstick, bench = Yardstick(group, num_threads), _Bench(group, seed, num_threads)
                open_now.callback(yardstick.close)
            name = tasks[k][1]
            say(k)
            yield k, _rows(name, group, bench.tune(name, tuners[name]), yardstick)


def _elsewhere(
    machines: Sequence[SuiteMachine],
    tasks: Sequence[tuple[Sequence[int], str]],
    left: Sequence[int],
    seed: int,
    trials: int | None,
    pool: Pool,
    say: Callable[[int], None],
) -> Iterator[tuple[int, list[MachineRow]]]:
    """Give the number and the rows of each task as it comes back."""
    machines = [
        replace(one, **taken_options({"device": one.device, "load": one.load, "motor": one.motor})) for one in machines
    ]
    items = [_GroupTask([machines[i] for i in tasks[k][0]], tasks[k][1], trials, seed) for k in left]
    for place, text in pool.unordered(_run, items, fits=_is_of):
        say(left[place])
        yield left[place], _rows_of(text)


def _is_of(task: _GroupTask, text: Any) -> bool:
    """Return whether a text has the rows of a tuner on a group."""
    rows = [(row.tuner, row.machine) for row in _rows_of(text)]
    return rows == [(task.tuner, machine.name) for machine in task.group]


def _text_of(rows: Sequence[MachineRow]) -> str:
    return json.dumps([asdict(row) for row in rows])


def _rows_of(text: str) -> list[MachineRow]:
    return [MachineRow(**row) for row in parse_json(text)]


class Yardstick:
    """The robust cost of a group of machines, and that of the baseline rule with their true inertia."""

    def __init__(self, group: Sequence[SuiteMachine], num_threads: int | None) -> None:
        device, load, motor, friction = group[0].kind
        self._score = RobustScore(
            device, load, motor, len(group), num_threads=num_threads, friction=friction,
            repeats=REPEATS,
        )  # fmt: skip
        with open_group(group, num_threads) as target:
            drives = target.drives
            inertia = _true_inertia(target)
            reach = longer_way(target.low, target.high)
            supply = target.supply.reshape(len(group), -1)[:, 0]
            self._score.set_machines(machine_of(drives).parameters, supply)
            self._score.set_moves(
                plan_move(target.motor, inertia, drives.read(Role.POSITION_SCALE), reach, highest_ramp(target.device))
            )
            rule = np.concatenate(
                [
                    rule_gains(target.device, target.motor, J, supply=float(volts))
                    for J, volts in zip(inertia, target.supply, strict=True)
                ]
            )
            # On the machines themselves, fresh from the box; the score has its own.
            self.rule_passes = rule_passes(target, rule, inertia)
        self.rule = self._score.set_reference(rule).robust_cost

    def score(self, gains: Integers) -> Floats:
        """Return the robust cost of every machine, (num_machines,)."""
        return self._score.score(gains).robust_cost

    def close(self) -> None:
        """Give the machines back."""
        self._score.close()


def _true_inertia(target: Target) -> Floats:
    """Return the total inertia as a perfect identification finds it: over the true K_t, times the data sheet's.

    The axes of a machine move together: an axis pushes its own inertia, and what the others' acceleration puts on it.
    """
    moved = np.concatenate([moved_inertia(group.load) for group in machine_of(target.drives).drives.inside.groups])
    share = machine_of(target.drives).parameters["motor.psi_m"] / target.motor.psi_m
    return np.asarray(moved.reshape(-1) / np.repeat(share, target.axes_per_machine))


class _Tuned(NamedTuple):
    """What came of a tuner on the machines of a group: its outcome, or why there is none and the gains it left."""

    outcome: Outcome | None
    gains: Integers
    failure: str
    audit: DriveAudit


class _Bench:
    """Has tuners tune the machines of a group, each time fresh from the box."""

    def __init__(self, group: Sequence[SuiteMachine], seed: int, num_threads: int | None) -> None:
        self._group, self._seed, self._num_threads = group, seed, num_threads
        self._identified: tuple[list[Identification], float, Integers, DriveAudit] | None = None

    def tune(self, name: str, tuner: Tuner) -> _Tuned:
        """Return what comes of a tuner."""
        with open_group(self._group, self._num_threads) as target:
            audit = DriveAudit(target)
            watched = replace(target, drives=ObservedDrives(target.drives, audit))
            machines = (zlib.crc32(machine.name.encode()) for machine in self._group)
            rng = np.random.default_rng((self._seed, zlib.crc32(name.encode()), *machines))
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
                try:
                    if isinstance(tuner, RuleTuner):
                        outcome, audit = self._propose(tuner, watched, audit)
                    else:
                        outcome = tuner(watched, rng)
                    return _Tuned(outcome, _checked_gains(outcome, target), "", audit)
                except Exception as error:  # a tuner is anybody's code; the others are to be compared all the same
                    return _Tuned(None, read_gains(target), as_given(f"{type(error).__name__}: {error}"), audit)

    def _propose(self, tuner: RuleTuner, target: Target, audit: DriveAudit) -> tuple[Outcome, DriveAudit]:
        """Return what a rule proposes, and the audit of the identification, which is the same for all rules."""
        if self._identified is None:
            before = read_gains(target)
            found, seconds = identify_all(target)
            self._identified = found, seconds, before, audit
        found, seconds, before, audit = self._identified
        return tuner.propose(target, found, before, seconds), audit


def _rows(name: str, group: Sequence[SuiteMachine], tuned: _Tuned, yardstick: Yardstick) -> list[MachineRow]:
    """Return what a tuner made of every machine of a group."""
    robust_cost, outcome, audit = yardstick.score(tuned.gains), tuned.outcome, tuned.audit
    per_machine = len(tuned.gains) // len(group)
    names = find_device(group[0].device).gains.names
    rows = []
    for k, machine in enumerate(group):
        axes = slice(k * per_machine, (k + 1) * per_machine)
        counts = audit.violations[:, axes].sum(axis=1)
        notes = [tuned.failure] if outcome is None else [note for note in outcome.notes[axes] if note]
        rows.append(
            MachineRow(
                tuner=name,
                machine=machine.name,
                robust_cost=float(robust_cost[k]),
                relative=float(robust_cost[k] / yardstick.rule[k]),
                rule=float(yardstick.rule[k]),
                drive_seconds=round(float(audit.seconds[axes].max()), 3),
                moves=int(audit.moves[axes].sum()),
                aborts=0 if outcome is None else int(outcome.aborts[axes].sum()),
                violations=int(counts.sum()),
                kinds=", ".join(f"{kind} {count}" for kind, count in zip(KINDS, counts, strict=True) if count),
                failed=outcome is None,
                gains=dict(zip(names, map(int, tuned.gains[axes.start]), strict=True)),
                note=" | ".join(notes).replace("\n", " "),
                rule_passes=bool(yardstick.rule_passes[k]),
            )
        )
    return rows


def _checked_gains(outcome: Any, target: Target) -> Integers:
    """Return a tuner's gains; ValueError if they are none, which is the tuner's mistake."""
    shape = (target.num_axes, target.device.gains.count)
    gains = np.asarray(outcome.gains)
    if not isinstance(outcome, Outcome) or gains.shape != shape or not np.issubdtype(gains.dtype, np.integer):
        raise ValueError(
            f"a tuner returns an Outcome with integer gains of shape {shape}, not {gains.dtype} {gains.shape}"
        )
    return gains.astype(np.int64)


def _summary(name: str, rows: Sequence[MachineRow]) -> TunerRow:
    relative = np.array([row.relative for row in rows])
    there = np.array([row.relative for row in rows if row.rule_passes])
    figures: tuple[float | None, ...] = (None,) * 3
    if there.size:
        figures = float(np.median(there)), float(np.percentile(there, 95)), float(np.mean(there > WORSE))
    return TunerRow(
        name,
        len(rows),
        float(np.median(relative)),
        float(np.percentile(relative, 95)),
        float(np.mean(relative > WORSE)),
        float(np.median([row.drive_seconds for row in rows])),
        float(np.median([row.moves for row in rows])),
        sum(row.aborts for row in rows),
        sum(row.violations for row in rows),
        sum(row.failed for row in rows),
        len(there),
        *figures,
    )
