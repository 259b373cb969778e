"""The sweep: every point of a grid of gains on its own machines, equal for all points, in parallel."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices.gain_set import PID_ON_RAMP, ClosedLoop
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, read_current_limit
from drive_env.drives.speeds import per_increment_of
from drive_env.drives.trace import Trace
from drive_env.phase_current import run_and_standby
from drive_env.trials.open_loop import ENCODER, LOST, NO_WINDOW, TOOTH
from drive_env.trials.positioning import wrapped
from mechanics.arrays import Floats, Integers, Mask
from mechanics.loads import find_load
from mechanics.model import COPIES_PER_MODEL
from tuning.runs import metrics
from tuning.runs.experiment import Experiment, Resolved, label, resolve
from tuning.runs.experiment import load_experiment as load_experiment
from tuning.runs.metrics import MoveRecording
from tuning.runs.pools import Pool
from tuning.runs.shard_log import Arrays, ShardLog

FLAGS = ("diverged", "oscillates", "fault")
PIECE = 0.02  # s of simulation between two reports of progress
CLOSING_TIME = 0.6  # s, in which the encoder of a rotor at rest is aligned
MAX_SAMPLES = 4_000_000  # of one signal in memory at a time: 32 MB
MAX_MACHINES = 1024  # of a shard: small, so that little is lost when a run is killed
SHARDS_PER_WORKER = 4  # at least, if there are enough points: so that all workers finish at about the same time

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep.

    Attributes:
        experiment: The experiment.
        objects: Labels of the swept objects, e.g. `2042h:01`.
        names: Labels of the swept objects with their names.
        columns: All columns of the table by name, each of shape (points,), in the order of the grid.
        order: Indices of the points from best to worst.
        response: The recording of the best point.
        simulated: Simulated time of all machines together, without resumed parts [s].
        wall: Wall time of the simulation [s].
    """

    experiment: Experiment
    objects: tuple[str, ...]
    names: tuple[str, ...]
    columns: dict[str, NDArray[Any]]
    order: Integers
    response: MoveRecording
    simulated: float
    wall: float

    @property
    def score_column(self) -> str:
        """Name of the ranking's column; it is inf if a point oscillates, tripped, diverged or lacks the metric."""
        return f"score [{metrics.unit_of(self.experiment.metric.name)}]"

    @property
    def score(self) -> Floats:
        """The metric of the ranking, shape (points,)."""
        return np.asarray(self.columns[self.score_column])

    def best(self, count: int = 10) -> list[dict[str, Any]]:
        """Return the best rows of the table, best first, as column name -> value."""
        return [{name: column[k].item() for name, column in self.columns.items()} for k in self.order[:count]]

    def without_effect(self) -> list[str]:
        """Return the swept objects that have no effect at all in this excitation."""
        shape = self.experiment.shape()
        names = [name for name in self.columns if name not in self.objects and name != "rank"]
        found = []
        for axis, swept in enumerate(self.objects):
            grids = [np.moveaxis(self.columns[name].reshape(shape), axis, 0) for name in names]
            if shape[axis] > 1 and all(np.array_equal(g, np.broadcast_to(g[:1], g.shape), g.dtype.kind == "f")
                                       for g in grids):  # fmt: skip
                found.append(swept)
        return found


class Shard(NamedTuple):
    """A part of a grid; a sweep is split into these on any kind of pool."""

    experiment: Experiment
    first: int  # its first point in the grid
    last: int  # the point after its last
    num_threads: int | None


def shards(
    experiment: Experiment,
    num_threads: int | None = None,
    *,
    width: int = 1,
    done: Mapping[int, int] = MappingProxyType({}),
) -> list[Shard]:
    """Return the remaining parts of a grid; how it is split does not affect results.

    Args:
        experiment: The experiment.
        num_threads: Threads that simulate each part.
        width: Number of parts that can run at the same time: for many, parts are smaller.
        done: First point of each finished part -> the point after its last.
    """
    samples = round(experiment.excitation.duration / experiment.excitation.sampling_period)
    axes = find_load(experiment.load).num_axes * experiment.machines
    points = experiment.size()
    fair = points // (width * SHARDS_PER_WORKER) if width > 1 else MAX_MACHINES
    fit = min(MAX_SAMPLES // (samples * axes), fair, MAX_MACHINES // experiment.machines)
    # Whole packed models, with the same points in every split: a constraint solver computes all copies of a model
    # together.
    size = int(np.clip(fit, COPIES_PER_MODEL, MAX_MACHINES)) // COPIES_PER_MODEL * COPIES_PER_MODEL
    parts, first = [], 0
    while first < points:
        if first in done:
            first = done[first]
            continue
        last = min([first + size, points, *(other for other in done if other > first)])
        parts.append(Shard(experiment, first, last, num_threads))
        first = last
    return parts


def run(
    experiment: Experiment,
    progress: Progress | None = None,
    num_threads: int | None = None,
    *,
    pool: Pool | None = None,
    log: ShardLog | None = None,
) -> SweepResult:
    """Simulate every point of an experiment and rank them.

    Args:
        experiment: The experiment.
        progress: Called with the present action and the share that is done.
        num_threads: Threads that simulate in this process; the number of cores by default. They do not affect results.
        pool: Pool that runs the shards; None runs them in this process. It does not affect results.
        log: Finished shards of an earlier run, to which new ones are added.

    Raises:
        ExperimentError: If the experiment is invalid.
        InputError: If a file of the user cannot be read.
        PoolError: If shards could not run in the pool.
    """
    report = progress or (lambda _what, _share: None)
    resolved = resolve(experiment)
    experiment = experiment.with_inputs()
    found: dict[int, Arrays] = {} if log is None else dict(log.done)
    done = {first: first + len(arrays["score"]) for first, arrays in found.items()}
    threads, width = (num_threads, 1) if pool is None else (1, pool.width)
    left = shards(experiment, threads, width=width, done=done)
    report("compiling", 0.0)
    if left:
        # Also for workers: they then find compiled kernels, and warnings are shown once, here.
        _compile(experiment)
    started = time.perf_counter()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)  # a flag of the table
        for part, arrays in _done(left, experiment.size(), pool, report):
            found[part.first] = arrays
            if log is not None:
                log.append(part.first, arrays)
    wall = time.perf_counter() - started
    simulated = experiment.excitation.duration * experiment.machines * sum(part.last - part.first for part in left)
    in_order = [found[first] for first in sorted(found)]
    names = _column_names(resolved)
    columns = {name: np.concatenate([arrays[name] for arrays in in_order]) for name in names}
    return _ranked(experiment, resolved, columns, _best(in_order, experiment), simulated, wall)


def _done(left: list[Shard], points: int, pool: Pool | None, report: Progress) -> Iterator[tuple[Shard, Arrays]]:
    """Yield each shard with its result when it is done."""
    shares = [0.0] * len(left)
    sizes = [part.last - part.first for part in left]

    def done() -> float:
        return 1.0 - sum((1.0 - share) * size for share, size in zip(shares, sizes, strict=True)) / points

    def say(k: int, share: float) -> None:
        shares[k] = share
        report("simulating", done())

    if pool is not None:
        for k, arrays in pool.unordered(simulate, left, lambda what: report(what or "simulating", done()), _is_of):
            say(k, 1.0)
            yield left[k], arrays
        return
    # Two at a time: building and judging machines holds the interpreter's lock, simulating does not.
    with ThreadPoolExecutor(2) as executor:
        futures = {executor.submit(simulate, part, partial(say, k)): part for k, part in enumerate(left)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()


def simulate(shard: Shard, report: Callable[[float], None] = lambda _share: None) -> Arrays:
    """Simulate a shard; return its columns, and under `best.` the recording of its best point."""
    experiment = shard.experiment
    points = experiment.points(shard.first, shard.last)
    with _machines(experiment, len(points), shard.num_threads) as drives:
        axes = drives.num_axes // len(points)
        recording, fault = _record(drives, experiment, resolve(experiment), points, report)
        columns = _evaluate(experiment, recording) | {"fault": fault}
        diverged = np.repeat(drives.machine.diverged, drives.load.num_axes)
        columns["diverged"] = np.asarray(columns["diverged"] | diverged)
    # All axes of all machines of a point have its gains; the worst axis counts.
    worst = np.argmax(_score(columns).reshape(-1, axes), axis=1) + np.arange(len(points)) * axes
    columns = {name: values[worst] for name, values in columns.items()}
    best = recording.point(int(worst[np.argmin(_score(columns))]))
    return columns | {f"best.{name}": np.asarray(getattr(best, name)) for name in _recorded(experiment)}


def _is_of(shard: Shard, arrays: Any) -> bool:
    """Return whether arrays are the columns of a shard and a recording."""
    columns = _column_names(resolve(shard.experiment))
    recorded = [f"best.{name}" for name in _recorded(shard.experiment)]
    return set(arrays) == {*columns, *recorded} and all(
        arrays[name].shape == (shard.last - shard.first,) and arrays[name].dtype.kind in "fb" for name in columns
    )


_RECORDED = ("t", "reference_rpm", "speed_rpm", "current", "current_limit")


def _recorded(experiment: Experiment) -> tuple[str, ...]:
    resolved = resolve(experiment)
    if resolved.loop is not None:
        return (*_RECORDED, "lag", "full_steps")
    return (*_RECORDED, "lag", "effort") if resolved.device.gains.is_open_loop else _RECORDED


def _column_names(resolved: Resolved) -> list[str]:
    return ["score", *metrics.metrics_of(resolved.device, resolved.loop), *FLAGS]


def _best(found: list[Arrays], experiment: Experiment) -> MoveRecording:
    """Return the recording of the best point; of equal ones that of the first shard."""
    shard = found[int(np.argmin([_score(arrays).min() for arrays in found]))]
    recorded = {name: shard[f"best.{name}"] for name in _recorded(experiment)}
    excitation = experiment.excitation
    return MoveRecording(**recorded, t_step=excitation.velocity_time, t_load=excitation.load_time)


def _compile(experiment: Experiment) -> None:
    """Compile or load the kernels in this thread: in another one, Ctrl-C would have to wait for the compiler."""
    with _machines(experiment, 1, 1) as drives:
        motion.enable(drives, mode="pv")
        drives.record(_signals(resolve(experiment)), 0.001)


def _signals(resolved: Resolved) -> list[ObjectName]:
    """Return the objects to record, by the kind of loop and the signals that it measures."""
    if resolved.loop is not None:
        return [cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL]
    if resolved.device.gains.is_open_loop:
        return [cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL]
    return [cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL]


def _machines(experiment: Experiment, points: int, num_threads: int | None) -> EmulatedDrives:
    return EmulatedDrives(
        experiment.device,
        load=experiment.load,
        motor=experiment.motor,
        num_machines=points * experiment.machines,
        seed=experiment.seed,
        distinct=experiment.machines,
        randomise=experiment.machines > 1,
        num_threads=num_threads,
    )


def _record(
    drives: EmulatedDrives,
    experiment: Experiment,
    resolved: Resolved,
    points: Integers,
    report: Callable[[float], None],
) -> tuple[MoveRecording, Mask]:
    """Return the recording of every point, and which points ended in fault."""
    excitation, is_open_loop = experiment.excitation, resolved.device.gains.is_open_loop
    unclosed = np.zeros(drives.num_axes, bool)
    if is_open_loop:
        drives.write(cia402.SENSOR_SELECTION, ENCODER)
    # Enabled with the preset's gains, which are stable, so that all points' gains start from the same state.
    motion.enable(drives, mode="pv")
    if resolved.loop is not None:
        unclosed = _close_loop(drives, resolved.loop)
    drives.write((cia402.PROFILE_ACCELERATION, 0), resolved.acceleration)
    for column, entry in enumerate(resolved.entries):
        drives.write((entry.index, entry.sub), np.repeat(points[:, column], drives.num_axes // len(points)))
    traces: list[Trace] = []
    for start, end in _pieces(excitation.velocity_time, excitation.load_time, excitation.duration, PIECE,
                              excitation.sampling_period):  # fmt: skip
        if start == excitation.velocity_time:
            drives.write(cia402.TARGET_VELOCITY, resolved.velocity)
        if start == excitation.load_time:
            drives.machine.load_torque = excitation.load_torque
        period = excitation.sampling_period
        traces.append(drives.record(_signals(resolved), round((end - start) / period) * period, period=period))
        report(end / excitation.duration)
    t = np.arange(sum(map(len, traces)), dtype=np.float64) * excitation.sampling_period
    velocity_unit = resolved.device.bindings[cia402.VELOCITY_ACTUAL, 0].unit
    scaler = resolved.position_scaler
    rpm = 60.0 / scaler / per_increment_of(velocity_unit, scaler, resolved.velocity_ratio)
    ramp = np.clip((t - excitation.velocity_time) * resolved.acceleration, 0.0, abs(resolved.velocity))
    if is_open_loop:
        signals = _stepper_signals(drives, traces, period, resolved.loop)
    else:
        signals = {
            "speed_rpm": np.concatenate([trace[cia402.VELOCITY_ACTUAL] for trace in traces]) * rpm,
            "current": np.concatenate([trace[cia402.TORQUE_ACTUAL] for trace in traces]) * ampere_per_count(drives),
            "current_limit": read_current_limit(drives),
        }
    recording = MoveRecording(
        t=t,
        reference_rpm=np.sign(resolved.velocity) * ramp * rpm,
        t_step=excitation.velocity_time,
        t_load=excitation.load_time,
        **signals,
    )
    tripped = unclosed | cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
    for message in drives.emergencies():
        tripped[message.axis] = True  # also by a limit of travel: what follows says nothing about the gains
    # The field leads a rotor that has lost steps; only with a PID is the demand always behind.
    on_ramp = resolved.loop is not None and resolved.loop.kind == PID_ON_RAMP
    if recording.lag is not None and (recording.is_open_loop or on_ramp):
        tripped |= (np.abs(recording.lag) > LOST).any(axis=0)
    return recording, tripped


def _close_loop(drives: EmulatedDrives, loop: ClosedLoop) -> Mask:
    """Close the loops of enabled axes with the first gains, or the preset's; return axes whose loops stay open.

    The following error window is off: an overloaded axis falls behind, and catches up by its gains.
    """
    known = drives.device.gains
    for name, value in loop.first.items():
        drives.write(known.keys[known.columns([name])[0]], value)
    drives.write(cia402.FOLLOWING_WINDOW, NO_WINDOW)
    drives.write(Role.LOOP_MODE, loop.mode)
    drives.advance(CLOSING_TIME)
    return np.asarray((drives.read(Role.LOOP_INITIALISED) == 0) & (not loop.is_pid))


def _stepper_signals(
    drives: EmulatedDrives, traces: list[Trace], period: float, loop: ClosedLoop | None
) -> dict[str, Floats]:
    """Return speed by the encoder, lag and effort of the points, and nan for a current that is not measured.

    If the encoder commutates, the torque current is measured, and its limit is the run current.

    606Ch of these drives is the speed of the steps, not of the rotor.
    """
    demand, actual = (
        np.concatenate([trace[name] for trace in traces]) for name in (cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL)
    )
    scale = np.asarray(drives.read(Role.POSITION_SCALE), float)
    full_step = scale / (TOOTH * drives.motor.n_p)
    run, _ = run_and_standby(drives.device, drives.device.gains.read(drives))
    way = wrapped(actual - actual[0])
    if loop is not None:
        current = np.concatenate([trace[cia402.TORQUE_ACTUAL] for trace in traces]) * ampere_per_count(drives)
        return {
            "speed_rpm": np.gradient(way, period, axis=0) * 60.0 / scale,
            "current": np.full(demand.shape, np.nan) if loop.is_pid else current,
            "current_limit": np.full(drives.num_axes, np.nan) if loop.is_pid else np.asarray(run),
            "lag": wrapped(demand - actual) / full_step,
            "full_steps": np.full(drives.num_axes, TOOTH * drives.motor.n_p),
        }
    return {
        "speed_rpm": np.gradient(way, period, axis=0) * 60.0 / scale,
        "current": np.full(demand.shape, np.nan),
        "current_limit": np.full(drives.num_axes, np.nan),
        "lag": wrapped(demand - actual) / full_step,
        "effort": np.asarray((run / drives.motor.rated_current) ** 2),
    }


def _pieces(step: float, load: float, end: float, piece: float, period: float) -> list[tuple[float, float]]:
    """Return the pieces [s] in which a run is recorded: whole sampling periods, split at the two events."""
    edges = [0.0, step, load, end]
    size = max(1, round(piece / period)) * period
    pieces = []
    for first, last in pairwise(edges):
        start = first
        while last - start > 1e-9:
            stop = min(start + size, last) if last - start - size > 1e-9 else last
            pieces.append((start, stop))
            start = stop
    return pieces


def _evaluate(experiment: Experiment, recording: MoveRecording) -> dict[str, NDArray[Any]]:
    """Return the score without regard to flags, all metrics, and the flags except the fault."""
    found = metrics.figures(recording)
    choice = experiment.metric
    columns: dict[str, NDArray[Any]] = {"score": metrics.score(choice.name, choice.weights, found)}
    resolved = resolve(experiment)
    for row in metrics.metrics_of(resolved.device, resolved.loop).values():
        columns[row.name] = np.asarray(row.function(found), np.float64)
    columns["diverged"] = np.asarray(~np.isfinite(recording.speed_rpm).all(axis=0))
    columns["oscillates"] = metrics.oscillates(found)
    return columns


def _score(columns: dict[str, NDArray[Any]]) -> Floats:
    """Return the key of the ranking: inf for a point with a flag, or without the metric."""
    flagged = np.any([columns[flag] for flag in FLAGS], axis=0) | np.isnan(columns["score"])
    return np.where(flagged, np.inf, columns["score"])


def _ranked(
    experiment: Experiment,
    resolved: Resolved,
    found: dict[str, NDArray[Any]],
    best: MoveRecording,
    simulated: float,
    wall: float,
) -> SweepResult:
    points = experiment.points()
    score = _score(found)
    order = np.argsort(score, kind="stable")
    rank = np.empty(len(points), np.int64)
    rank[order] = np.arange(1, len(points) + 1)
    objects = tuple(label(entry) for entry in resolved.entries)
    columns: dict[str, NDArray[Any]] = {name: points[:, k] for k, name in enumerate(objects)}
    columns["rank"] = rank
    columns[f"score [{metrics.unit_of(experiment.metric.name)}]"] = score
    for row in metrics.metrics_of(resolved.device, resolved.loop).values():
        columns[f"{row.name} [{row.unit}]"] = found[row.name]
    for flag in FLAGS:
        columns[flag] = found[flag]
    names = tuple(entry.label for entry in resolved.entries)
    return SweepResult(experiment, objects, names, columns, order, best, simulated, wall)
