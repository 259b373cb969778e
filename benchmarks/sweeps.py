"""Figures of sweeps: a grid of 10,000 points, 250 ms each, on two_mass, in one process and on processes."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

from tuning.runs import sweep
from tuning.runs.experiment import Experiment, SweptObject, load_experiment
from tuning.runs.pools import open_pool
from tuning.runs.shard_log import ShardLog

SIDE, DURATION = 100, 0.25  # points along each of two gains; s
REPETITIONS = 3
CORES = 2


def grid(side: int = SIDE) -> Experiment:
    """Return the default experiment on a grid of side x side velocity gains."""
    default = load_experiment()
    swept = tuple(SweptObject(name, 60, 4000, side, "log") for name in ("2042h:01", "2042h:02"))
    excitation = replace(default.excitation, load_time=0.5 * DURATION, duration=DURATION)
    return replace(default, sweep=swept, excitation=excitation)


def seconds(experiment: Experiment, workers: int | None = None, threads: int = CORES) -> float:
    """Return how long a sweep takes with its shards kept on disk and the kernels compiled, workers' start included."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        with open_pool(workers) as pool, ShardLog(Path(folder) / "shards", "benchmark") as log:
            sweep.run(experiment, num_threads=threads, pool=None if workers is None else pool, log=log)
        return time.perf_counter() - start


def figures(quick: bool = False) -> dict[str, float]:
    """Return all figures of sweeps, each the best of several: the one least disturbed."""
    experiment = grid(32 if quick else SIDE)
    sweep.run(grid(2))  # compiles
    kinds = {f"{CORES} threads": None, f"{CORES} workers": CORES}
    return {
        f"{experiment.size()} points of {DURATION:g} s, two_mass, {name} [s]": min(
            seconds(experiment, workers) for _ in range(REPETITIONS)
        )
        for name, workers in kinds.items()
    }
