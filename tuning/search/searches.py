"""Independent searches on the same emulated machine, each with its own seed, as shards of one optimisation.

A search is a sequence of generations, each based on the last, so it runs in one process. Several with other seeds
reduce the influence of chance, and can run anywhere. An interrupted search continues from its last generation if its
file can be reached, otherwise it starts again from its seed, with identical results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuning.runs.inputs import as_kept, taken_options
from tuning.runs.pools import Pool
from tuning.runs.shard_log import Arrays, ShardLog
from tuning.runs.unfinished import part_log, part_path
from tuning.search.optimise import SAFE_STARTS, Optimised, Settings, TrialRow, optimise
from tuning.target import emulated
from tuning.toml_tables import toml

# Fields of `Optimised`. A search on copies of one machine returns those of one copy for OF_AXES, those of all copies
# for OF_ALL, and sums for SUMS.
OF_AXES, OF_ALL, SUMS = ("gains", "rule", "margins"), ("moves", "aborts"), ("drive_seconds", "untried")


class Search(NamedTuple):
    """A search on an emulated machine: the arguments of `emulated`, and the settings."""

    machine: Mapping[str, Any]
    settings: Settings


class _SearchTask(NamedTuple):
    """A search to run, and the file from which it continues, with its key; None without a file."""

    search: Search
    path: Path | None
    key: str


def searches(machine: Mapping[str, Any], settings: Settings, count: int) -> list[Search]:
    """Return searches of the same machine with consecutive seeds, beginning with that of the settings.

    Raises:
        ValueError: For a count below 1, or several searches with one journal.
    """
    if count < 1:
        raise ValueError(f"--searches {count} is below 1; give the number of searches")
    if count > 1 and settings.journal is not None:
        raise ValueError("a journal keeps one search; leave --journal out, or take --searches 1")
    machine = taken_options(machine)
    return [Search(machine, replace(settings, seed=settings.seed + k)) for k in range(count)]


def description(shards: list[Search]) -> str:
    """Describe machine and settings of searches as TOML lines; equal searches have equal lines."""
    lines = [f"searches = {len(shards)}"]
    machine = as_kept(dict(shards[0].machine))
    lines += [f"machine.{name} = {toml(value)}" for name, value in machine.items() if value is not None]
    settings = {f.name: getattr(shards[0].settings, f.name) for f in fields(Settings) if f.name != "subject"}
    lines += [f"{name} = {toml(value)}" for name, value in settings.items() if value is not None]
    return "\n".join(lines) + "\n"


def run(
    shards: list[Search], pool: Pool | None, log: ShardLog, progress: Callable[[float], None] = lambda share: None
) -> list[Optimised]:
    """Run the searches that are not in the log yet, and return the results of all in order.

    Args:
        shards: The searches.
        pool: Processes that run them, with identical results; None runs them in this process.
        log: Finished searches of an earlier run, to which new ones are added.
        progress: Called with the share that is done.
    """
    found = dict(log.done)
    left = [k for k in range(len(shards)) if k not in found]
    # A journal stores the search itself; a cluster's workers cannot access this machine's files.
    here = shards[0].settings.journal is None and (pool is None or pool.shares_disk)
    tasks = [
        _SearchTask(shard, part_path(log, k) if here else None, f"{log.key}search {k}")
        for k, shard in enumerate(shards)
    ]
    for k, arrays in _done(tasks, left, pool, progress):
        found[k] = arrays
        log.append(k, arrays)
        part_path(log, k).unlink(missing_ok=True)
    return [_optimised(found[k], search=k) for k in range(len(shards))]


def _done(
    tasks: list[_SearchTask], left: list[int], pool: Pool | None, progress: Callable[[float], None]
) -> Iterator[tuple[int, Arrays]]:
    """Yield the number and the result of each search when it is done."""
    before = len(tasks) - len(left)
    if pool is None:
        for done, k in enumerate(left, before):

            def report(share: float, done: int = done) -> None:
                progress((done + share) / len(tasks))

            yield k, _run(tasks[k], report)
        return
    for done, (place, arrays) in enumerate(pool.unordered(_run, [tasks[k] for k in left], fits=_is_of), before + 1):
        progress(done / len(tasks))
        yield left[place], arrays


def joined(found: list[Optimised]) -> Optimised:
    """Join searches: gains, shape (searches * axes, count), cost, shape (searches,), and counts of all machines."""
    rows = tuple(row for one in found for row in one.rows)
    notes = tuple(note for one in found for note in one.notes)
    every: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in found]) for name in (*OF_AXES, "cost", *OF_ALL)
    }
    total = {name: sum(getattr(one, name) for one in found) for name in SUMS}
    return replace(found[0], rows=rows, notes=notes, **every, **total)


def _run(task: _SearchTask, progress: Callable[[float], None] = lambda share: None) -> Arrays:
    """Run a search on copies of its machine; return the result as arrays."""
    search = task.search
    kept = nullcontext() if task.path is None else part_log(task.path, task.key)
    with emulated(**search.machine) as target, kept as log:
        found = optimise(target, search.settings, shared=True, anew=True, log=log, progress=progress)
        axes = target.axes_per_machine
    rows = {f"trial {name}": np.array([getattr(row, name) for row in found.rows]) for name in TrialRow._fields}
    return {
        "cost": found.cost[:1], "notes": np.array(found.notes[:1]), **rows,
        **{name: getattr(found, name)[:axes] for name in OF_AXES},
        **{name: np.array(getattr(found, name)) for name in (*OF_ALL, *SUMS, "t_0")},
    }  # fmt: skip


def _is_of(task: _SearchTask, arrays: Any) -> bool:
    """Return whether arrays have the form of `_run`'s result for a task."""
    found = _optimised(arrays, 0)
    trials = len(found.rows) <= task.search.settings.trials + SAFE_STARTS
    return trials and all(one.shape == found.gains.shape for one in (found.rule, *(row.gains for row in found.rows)))


def _optimised(arrays: Mapping[str, NDArray[Any]], search: int) -> Optimised:
    columns = [arrays[f"trial {name}"] for name in TrialRow._fields]
    # Gains stay arrays, all other fields become plain values.
    plain = (column if column.ndim == 3 else column.tolist() for column in columns)
    rows = (TrialRow(*values)._replace(search=search) for values in zip(*plain, strict=True))
    rest: dict[str, Any] = {name: arrays[name] for name in (*OF_AXES, "cost", *OF_ALL)}
    rest |= {name: arrays[name].item() for name in (*SUMS, "t_0")}
    listed = tuple(row._replace(objectives=tuple(row.objectives)) for row in rows)
    return Optimised(rows=listed, notes=tuple(map(str, arrays["notes"])), **rest)
