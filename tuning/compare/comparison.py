"""Tuners compared on the same machines: what their gains are worth, and the drive time and moves they took.

Every tuner gets every machine as it comes from the box, under an audit that counts time, moves and violations. Gains
are judged in the emulator (drive_env/trials/score.py): their robust performance over that of the machine's constrained
oracle (oracle.py), whether they keep the constraints, and the true margins; a tuner never sees any of it.
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

from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from drive_env.loops.dynamics import DEFAULT
from mechanics.untrusted import parse_json
from tuning.compare.oracle import Oracle, find_oracles
from tuning.compare.suite import SuiteMachine, groups, open_group
from tuning.compare.tuners import RuleTuner, find_tuner, identify_all
from tuning.compare.yardstick import Yardstick
from tuning.drive_audit import KINDS, DriveAudit
from tuning.outcome import Outcome, Tuner
from tuning.runs.inputs import as_given, taken_options
from tuning.runs.shard_log import ShardLog
from tuning.search.trial_bench import read_gains
from tuning.target import Target

if TYPE_CHECKING:
    from tuning.arrays import Integers
    from tuning.identify.estimate import Identification
    from tuning.runs.pools import Pool

Progress = Callable[[str, float], None]

NEAR_PHASE, NEAR_GAIN = 5.0, 1.0  # degrees and dB by which margins may be missed and still be near


@dataclass(frozen=True)
class MachineRow:
    """The result of a tuner on a machine.

    robust_cost, performance: Of its gains, with and without constraints. oracle: The oracle's performance, relative:
    over it. slack: How far the gains keep the constraints, below 0 where one is broken. phase_deg, gain_db, ms: True
    margins of the worst outer loop; 0, 0 and 100 of an unstable machine. All four are None without a linear model.
    near: Whether phase and gain margin are within 5 degrees and 1 dB of those demanded. accepted: Whether the tuner
    vouches for them. drive_seconds: Until the drive was last written to or moved [s], waits for the machines beside it
    included. moves: Of all its axes, each from standstill to standstill (moves.py). aborts: As the tuner says.
    violations: Of all kinds. gains: Raw gains of the machine's first axis, by the names that its device has for them.
    note: What the tuner says, or why it failed; then the gains are those that it left behind.
    """

    tuner: str
    machine: str
    robust_cost: float
    performance: float
    oracle: float
    relative: float
    slack: float | None
    phase_deg: float | None
    gain_db: float | None
    ms: float | None
    near: bool
    accepted: bool
    drive_seconds: float
    moves: int
    aborts: int
    violations: int
    kinds: str
    failed: bool
    gains: Mapping[str, int]
    note: str

    @property
    def kept(self) -> bool:
        """Whether the gains keep all constraints."""
        return self.slack is None or self.slack >= 0.0


@dataclass(frozen=True)
class TunerRow:
    """The result of a tuner over all machines.

    median, p95: Of the robust performance over the oracle's. kept: Share of machines whose gains keep all constraints.
    near: Share whose true phase and gain margins are within 5 degrees and 1 dB of those demanded. phase_deg, phase_p5,
    gain_db, ms, ms_p95: Margins of a machine's worst outer loop, phase: median and 5th percentile, gain: median, Ms:
    median and 95th percentile; None where no drive has a linear model. accepted: Share that the tuner vouches for.
    drive_seconds, moves: Median of a machine. aborts, violations: Of all machines together. failed: Machines on which
    it gave up with an error.
    """

    tuner: str
    machines: int
    median: float
    p95: float
    kept: float
    near: float
    phase_deg: float | None
    phase_p5: float | None
    gain_db: float | None
    ms: float | None
    ms_p95: float | None
    accepted: float
    drive_seconds: float
    moves: float
    aborts: int
    violations: int
    failed: int


@dataclass(frozen=True)
class Comparison:
    """Rows of every tuner and machine, and what each tuner is worth: the first keeps most, then by median."""

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
    oracles: Mapping[str, Oracle] | None = None,
    dynamics: str = DEFAULT,
) -> Comparison:
    """Have every tuner tune every machine.

    Args:
        machines: The suite.
        tuners: By name.
        seed: What the tuners draw from; the same machines and tuner see the same chances whatever else is compared.
        num_threads: As `EmulatedDrives` takes it.
        log: What tuners made of machines already, and where what is to come is kept.
        progress: Called with what is under way and the share that is done.
        pool: Where else it runs, which changes no digit; there the tuners are found by their names, `trials` and
            `dynamics`.
        trials: As `find_tuner` takes it.
        oracles: Of the machines, by name; found by default.
        dynamics: What the loops must keep, by which gains are judged.
    """
    best = find_oracles(machines, num_threads, dynamics=dynamics) if oracles is None else oracles
    tasks = [(indices, name) for indices in groups(machines) for name in tuners]
    done = {} if log is None else {k: _rows_of(str(arrays["rows"])) for k, arrays in log.done.items()}
    left = [k for k in range(len(tasks)) if k not in done]

    def say(k: int) -> None:
        machine = machines[tasks[k][0][0]]
        progress(f"{tasks[k][1]} on {machine.load}, {machine.motor}", len(done) / len(tasks))

    if pool is None:
        fresh = _here(machines, tuners, tasks, left, best, seed, num_threads, dynamics, say)
    else:
        fresh = _elsewhere(machines, tasks, left, best, seed, trials, dynamics, pool, say)
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
    return Comparison(ordered, tuple(sorted(summaries, key=lambda row: (-row.kept, row.median, row.tuner))))


class _GroupTask(NamedTuple):
    """A tuner on the machines of a group, for another process."""

    group: list[SuiteMachine]
    tuner: str
    oracles: list[Oracle]
    trials: int | None
    seed: int
    dynamics: str


def _run(task: _GroupTask) -> str:
    """Return what a tuner makes of the machines of a group, as text."""
    with closing(Yardstick(task.group, 1, dynamics=task.dynamics)) as yardstick:
        tuned = _Bench(task.group, task.seed, 1).tune(task.tuner, find_tuner(task.tuner, task.trials, task.dynamics))
        return _text_of(_rows(task.tuner, task.group, tuned, yardstick, task.oracles))


def _here(
    machines: Sequence[SuiteMachine],
    tuners: Mapping[str, Tuner],
    tasks: Sequence[tuple[Sequence[int], str]],
    left: Sequence[int],
    oracles: Mapping[str, Oracle],
    seed: int,
    num_threads: int | None,
    dynamics: str,
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
                yardstick = Yardstick(group, num_threads, dynamics=dynamics)
                bench = _Bench(group, seed, num_threads)
                open_now.callback(yardstick.close)
            name = tasks[k][1]
            say(k)
            best = [oracles[machine.name] for machine in group]
            yield k, _rows(name, group, bench.tune(name, tuners[name]), yardstick, best)


def _elsewhere(
    machines: Sequence[SuiteMachine],
    tasks: Sequence[tuple[Sequence[int], str]],
    left: Sequence[int],
    oracles: Mapping[str, Oracle],
    seed: int,
    trials: int | None,
    dynamics: str,
    pool: Pool,
    say: Callable[[int], None],
) -> Iterator[tuple[int, list[MachineRow]]]:
    """Give the number and the rows of each task as it comes back."""
    found = [oracles[machine.name] for machine in machines]
    machines = [
        replace(one, **taken_options({"device": one.device, "load": one.load, "motor": one.motor})) for one in machines
    ]
    items = [
        _GroupTask([machines[i] for i in where], name, [found[i] for i in where], trials, seed, dynamics)
        for where, name in (tasks[k] for k in left)
    ]
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


def _rows(
    name: str, group: Sequence[SuiteMachine], tuned: _Tuned, yardstick: Yardstick, oracles: Sequence[Oracle]
) -> list[MachineRow]:
    """Return what a tuner made of every machine of a group."""
    scores, worst = yardstick.score(tuned.gains), yardstick.margins(tuned.gains)
    outcome, audit, asked = tuned.outcome, tuned.audit, yardstick.dynamics
    per_machine = len(tuned.gains) // len(group)
    names = find_device(group[0].device).gains.names
    vouched = None if outcome is None else outcome.accepted
    accepted = np.full(len(tuned.gains), outcome is not None) if vouched is None else vouched
    rows = []
    for k, machine in enumerate(group):
        axes = slice(k * per_machine, (k + 1) * per_machine)
        counts = audit.violations[:, axes].sum(axis=1)
        notes = [tuned.failure] if outcome is None else [note for note in outcome.notes[axes] if note]
        phase, gain, ms = (float(value[k]) if np.isfinite(value[k]) else None for value in worst)
        rows.append(
            MachineRow(
                tuner=name,
                machine=machine.name,
                robust_cost=float(scores.robust_cost[k]),
                performance=float(scores.performance[k]),
                oracle=oracles[k].performance,
                relative=float(scores.performance[k]) / oracles[k].performance,
                slack=float(scores.slack[k]) if np.isfinite(scores.slack[k]) else None,
                phase_deg=phase,
                gain_db=gain,
                ms=ms,
                near=(phase is None or phase >= asked.phase_deg - NEAR_PHASE)
                and (gain is None or gain >= asked.gain_db - NEAR_GAIN),
                accepted=bool(accepted[axes].all()),
                drive_seconds=round(float(audit.seconds[axes].max()), 3),
                moves=int(audit.moves[axes].sum()),
                aborts=0 if outcome is None else int(outcome.aborts[axes].sum()),
                violations=int(counts.sum()),
                kinds=", ".join(f"{kind} {count}" for kind, count in zip(KINDS, counts, strict=True) if count),
                failed=outcome is None,
                gains=dict(zip(names, map(int, tuned.gains[axes.start]), strict=True)),
                note=" | ".join(notes).replace("\n", " "),
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
    def percentile(name: str, share: float) -> float | None:
        known = [value for row in rows if (value := getattr(row, name)) is not None]
        return float(np.percentile(known, share)) if known else None

    relative = [row.relative for row in rows]
    return TunerRow(
        tuner=name,
        machines=len(rows),
        median=float(np.median(relative)),
        p95=float(np.percentile(relative, 95)),
        kept=float(np.mean([row.kept for row in rows])),
        near=float(np.mean([row.near for row in rows])),
        phase_deg=percentile("phase_deg", 50),
        phase_p5=percentile("phase_deg", 5),
        gain_db=percentile("gain_db", 50),
        ms=percentile("ms", 50),
        ms_p95=percentile("ms", 95),
        accepted=float(np.mean([row.accepted for row in rows])),
        drive_seconds=float(np.median([row.drive_seconds for row in rows])),
        moves=float(np.median([row.moves for row in rows])),
        aborts=sum(row.aborts for row in rows),
        violations=sum(row.violations for row in rows),
        failed=sum(row.failed for row in rows),
    )
