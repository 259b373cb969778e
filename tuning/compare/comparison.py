"""Compares tuners on the same machines: the quality of their gains, and the drive time and moves that they need.

Every tuner gets every machine with factory settings, under an audit that counts time, moves and violations. Gains are
judged in the emulator (drive_env/trials/score.py): robust performance over that of the machine's constrained oracle
(oracle.py), whether the constraints are kept, and the true margins. No tuner can read any of these.
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

from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import read_gains
from drive_env.loops.dynamics import DEFAULT
from mechanics.arrays import Integers
from mechanics.reading.untrusted import parse_json
from tuning.compare.oracle import Oracle, find_oracles
from tuning.compare.suite import SuiteMachine, open_group
from tuning.compare.tuners import RuleTuner, find_tuner, identify_all
from tuning.compare.yardstick import Yardstick
from tuning.drive_audit import KINDS, DriveAudit
from tuning.outcome import Outcome, Tuner
from tuning.runs.inputs import as_given, taken_options
from tuning.runs.shard_log import ShardLog
from tuning.target import Target

if TYPE_CHECKING:
    from drive_env.loops.linear_model import Plant
    from tuning.runs.pools import Pool

Progress = Callable[[str, float], None]

NEAR_PHASE, NEAR_GAIN = 5.0, 1.0  # degrees and dB below the demanded margins up to which they are near


@dataclass(frozen=True)
class MachineRow:
    """The result of a tuner on a machine.

    robust_cost, performance: Of the tuner's gains, with and without constraints.
    oracle: Performance of the oracle.
    relative: Performance over the oracle's.
    slack: Relative distance of the gains to the nearest constraint, below 0 if one is broken; None without a linear
        model, as the margins.
    phase_deg, gain_db, ms: True margins of the worst outer loop; 0, 0 and 100 for an unstable machine.
    near: Whether phase and gain margin are at most 5 degrees and 1 dB below those demanded.
    accepted: Whether the tuner accepts the gains.
    reserved: Whether it accepts them with reservations, so that it does not guarantee them.
    drive_seconds: Time until the drive was last written to or moved [s].
    moves: Moves of all axes, each from standstill to standstill (move_counter.py).
    aborts: As counted by the tuner.
    violations: Violations of all kinds; `kinds` lists them as text.
    failed: Whether the tuner raised an error; the gains are then those that it left in the drive.
    gains: Raw gains of the machine's first axis, by the device's names.
    note: Notes of the tuner, or its error.
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
    reserved: bool
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

    median, p95: Of the robust performance over the oracle's.
    kept: Share of machines whose gains keep all constraints.
    near: Share of machines whose true phase and gain margins are at most 5 degrees and 1 dB below those demanded.
    phase_deg, phase_p5, gain_db, ms, ms_p95: Margins of a machine's worst outer loop: phase (median and 5th
        percentile), gain (median), Ms (median and 95th percentile); None if no drive has a linear model.
    accepted, reserved: Shares of machines whose gains the tuner accepts, and accepts with reservations.
    drive_seconds, moves: Medians over machines.
    aborts, violations: Sums over all machines.
    failed: Number of machines on which the tuner raised an error.
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
    reserved: float
    drive_seconds: float
    moves: float
    aborts: int
    violations: int
    failed: int


@dataclass(frozen=True)
class Comparison:
    """Rows of every tuner and machine, and a summary per tuner, sorted by kept constraints, then by median."""

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
    log: ShardLog | None = None,
    progress: Progress = lambda what, share: None,
    pool: Pool | None = None,
    trials: int | None = None,
    oracles: Mapping[str, Oracle] | None = None,
    dynamics: str = DEFAULT,
) -> Comparison:
    """Tune every machine with every tuner.

    Args:
        machines: The machines of the suite.
        tuners: Tuners by name.
        seed: Seed of the tuners; the same machines and tuner get the same random numbers, whatever else is compared.
        log: Log with the finished rows of an earlier run, to which new ones are added.
        progress: Called with the present action and the share that is done.
        pool: Processes that run the tasks, with identical results; they look tuners up by name, `trials` and
            `dynamics`.
        trials: As in `find_tuner`.
        oracles: Oracles of the machines by name; searched by default.
        dynamics: Requirements on the loops by which gains are judged.
    """
    best = find_oracles(machines, dynamics=dynamics) if oracles is None else oracles
    tasks = [
        _Task(machine, best[machine.name], seed, dynamics, name, trials) for machine in machines for name in tuners
    ]
    done = _rows_in(log)
    left = [k for k in range(len(tasks)) if k not in done]

    def say(task: _Task) -> None:
        progress(f"{task.tuner} on {task.machine.name}", len(done) / len(tasks))

    fresh = _here(tasks, left, tuners, say) if pool is None else _elsewhere(tasks, left, pool, say)
    for k, row in fresh:
        done[k] = row
        if log is not None:
            log.append(k, {"row": np.array(_text_of(row))})
    progress("", 1.0)
    found = _compared(machines, list(tuners), done)
    assert found is not None, "all tasks are done"
    return found


def so_far(machines: Sequence[SuiteMachine], tuners: Sequence[str], log: ShardLog) -> Comparison | None:
    """Compare on those machines that all tuners had tuned before a run was stopped; None without such machines."""
    return _compared(machines, tuners, _rows_in(log))


def _compared(
    machines: Sequence[SuiteMachine], tuners: Sequence[str], done: Mapping[int, MachineRow]
) -> Comparison | None:
    """Compare by the rows of finished tasks, on the machines that all tuners have tuned; None without such machines."""
    found = {(row.tuner, row.machine): row for row in done.values()}
    common = [machine.name for machine in machines if all((name, machine.name) in found for name in tuners)]
    if not common:
        return None
    ordered = tuple(found[name, machine] for name in tuners for machine in common)
    summaries = [_summary(name, [row for row in ordered if row.tuner == name]) for name in tuners]
    return Comparison(ordered, tuple(sorted(summaries, key=lambda row: (-row.kept, row.median, row.tuner))))


class _Task(NamedTuple):
    """A tuner on a machine."""

    machine: SuiteMachine
    oracle: Oracle
    seed: int
    dynamics: str
    tuner: str
    trials: int | None


Fresh = Iterator[tuple[int, MachineRow]]  # number of a task, and its row
Say = Callable[[_Task], None]  # called with a task that begins, or that a pool has finished


def _here(tasks: Sequence[_Task], left: Sequence[int], tuners: Mapping[str, Tuner], say: Say) -> Fresh:
    """Run tasks one after the other; the bench of a machine is shared by consecutive tasks."""
    with ExitStack() as open_now:
        bench: _Bench | None = None
        for k in left:
            if bench is None or bench.task.machine is not tasks[k].machine:
                open_now.close()
                bench = open_now.enter_context(closing(_Bench(tasks[k], None)))
            say(tasks[k])
            yield k, bench.row(tasks[k].tuner, tuners[tasks[k].tuner])


def _elsewhere(tasks: Sequence[_Task], left: Sequence[int], pool: Pool, say: Say) -> Fresh:
    """Run tasks in a pool, with the content of their files, and yield them in the order in which they finish."""
    items = []
    for k in left:
        one = tasks[k].machine
        named = taken_options({"device": one.device, "load": one.load, "motor": one.motor})
        items.append(tasks[k]._replace(machine=replace(one, **named)))
    for place, text in pool.unordered(_run, items, fits=_is_of):
        say(tasks[left[place]])
        yield left[place], _row_of(text)


def _run(task: _Task) -> str:
    """Tune a machine with a tuner; return the row as text."""
    with closing(_Bench(task, 1)) as bench:
        return _text_of(bench.row(task.tuner, find_tuner(task.tuner, task.trials, task.dynamics)))


def _is_of(task: _Task, text: Any) -> bool:
    """Return whether a text contains the row of this tuner for this machine."""
    row = _row_of(text)
    return (row.tuner, row.machine) == (task.tuner, task.machine.name)


def _text_of(row: MachineRow) -> str:
    return json.dumps(asdict(row))


def _row_of(text: str) -> MachineRow:
    return MachineRow(**parse_json(text))


def _rows_in(log: ShardLog | None) -> dict[int, MachineRow]:
    return {} if log is None else {k: _row_of(str(arrays["row"])) for k, arrays in log.done.items()}


class _Bench:
    """The machine of a task, opened with factory settings for every tuner.

    Each machine is tuned alone: together with others it would wait for the slowest, which no real one does.
    """

    def __init__(self, task: _Task, num_threads: int | None) -> None:
        self.task, self._num_threads = task, num_threads
        self._yardstick = Yardstick([task.machine], num_threads, dynamics=task.dynamics)
        self._identified: tuple[list[Plant | str], float, Integers, DriveAudit] | None = None

    def close(self) -> None:
        """Close the yardstick's machines."""
        self._yardstick.close()

    def _tune(self, name: str, tuner: Tuner) -> tuple[Outcome | None, Integers, str, DriveAudit]:
        """Return a tuner's outcome, None after an error; the gains left in the drives; the error; and the audit."""
        with open_group([self.task.machine], self._num_threads) as target:
            audit = DriveAudit(target)
            watched = replace(target, drives=ObservedDrives(target.drives, audit))
            rng = np.random.default_rng(
                (self.task.seed, *(zlib.crc32(x.encode()) for x in (name, self.task.machine.name)))
            )
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
                try:
                    if isinstance(tuner, RuleTuner):
                        outcome, audit = self._propose(tuner, watched, audit)
                    else:
                        outcome = tuner(watched, rng)
                    return outcome, _checked_gains(outcome, target), "", audit
                except Exception as error:  # a tuner may be foreign code that raises anything; the comparison goes on
                    return None, read_gains(target.drives), as_given(f"{type(error).__name__}: {error}"), audit

    def _propose(self, tuner: RuleTuner, target: Target, audit: DriveAudit) -> tuple[Outcome, DriveAudit]:
        """Return a rule's gains, and the audit of the identification, which all rules share."""
        if self._identified is None:
            before = read_gains(target.drives)
            self._identified = *identify_all(target), before, audit
        plants, seconds, before, audit = self._identified
        return tuner.propose(target, plants, before, seconds), audit

    def row(self, name: str, tuner: Tuner) -> MachineRow:
        """Tune the machine with a tuner and judge the gains."""
        outcome, gains, failure, audit = self._tune(name, tuner)
        scores, worst = self._yardstick.score(gains), self._yardstick.margins(gains)
        asked, oracle = self._yardstick.dynamics, self.task.oracle.performance
        counts = audit.violations.sum(axis=1)
        accepted = outcome is not None and (outcome.accepted is None or bool(np.all(outcome.accepted)))
        notes = [failure] if outcome is None else [note for note in outcome.notes if note]
        phase, gain, ms, slack = (
            float(value[0]) if np.isfinite(value[0]) else None for value in (*worst, scores.slack)
        )
        return MachineRow(
            tuner=name,
            machine=self.task.machine.name,
            robust_cost=float(scores.robust_cost[0]),
            performance=float(scores.performance[0]),
            oracle=oracle,
            relative=float(scores.performance[0]) / oracle,
            slack=slack,
            phase_deg=phase,
            gain_db=gain,
            ms=ms,
            near=(phase is None or phase >= asked.phase_deg - NEAR_PHASE)
            and (gain is None or gain >= asked.gain_db - NEAR_GAIN),
            accepted=accepted,
            reserved=accepted and outcome is not None and outcome.reserved is not None and bool(outcome.reserved.any()),
            drive_seconds=round(float(audit.seconds.max()), 3),
            moves=int(audit.moves.sum()),
            aborts=0 if outcome is None else int(outcome.aborts.sum()),
            violations=int(counts.sum()),
            kinds=", ".join(f"{kind} {count}" for kind, count in zip(KINDS, counts, strict=True) if count),
            failed=outcome is None,
            gains=dict(zip(self._yardstick.device.gains.names, map(int, gains[0]), strict=True)),
            note=" | ".join(notes).replace("\n", " "),
        )


def _checked_gains(outcome: Any, target: Target) -> Integers:
    """Return a tuner's gains; ValueError if their type or shape is wrong."""
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
        reserved=float(np.mean([row.reserved for row in rows])),
        drive_seconds=float(np.median([row.drive_seconds for row in rows])),
        moves=float(np.median([row.moves for row in rows])),
        aborts=sum(row.aborts for row in rows),
        violations=sum(row.violations for row in rows),
        failed=sum(row.failed for row in rows),
    )
