"""The runs of the benchmark: an agent is trained, or a policy opened, and judged in the held-out episodes of its task.

Every run has a folder with its `result.json`, written last: an interrupted run is repeated, a complete one stays.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from agents.benchmark.results import BASELINE, RESULT, SUBMITTED, TRAINED, Row, RowError
from agents.evaluation.evaluation import evaluate
from agents.evaluation.evaluation_shards import Written
from agents.evaluation.open_policy import is_baseline, names_a_file, open_policy
from agents.evaluation.scores import RETURN
from agents.policies.baselines import baselines_of
from agents.seeds import TEST
from agents.tasks import environment_name
from agents.training.training_run import AGENT, TABLE, TrainingRun
from drive_env.envs.suite import TASKS
from drive_env.whole_file import write_whole
from mechanics.reading.untrusted import MOST_ARRAYS, read_bytes
from tuning.runs.provenance import check_begun, versions

if TYPE_CHECKING:
    from tuning.runs.pools import Pool

EPISODES = 64  # held-out episodes of a task
ONE_THREAD = {"num_threads": 1}  # CPU time is then the cost of a run, and parallel runs do not disturb each other


@dataclass(frozen=True)
class BenchmarkRun:
    """A policy evaluated on a task.

    Attributes:
        task: Name of the task.
        policy: Name of the algorithm, of the baseline, or of the submitted policy.
        kind: TRAINED, SUBMITTED or BASELINE.
        seed: Seed of the training.
        hyperparameters: Hyper-parameters of the training.
        written: The policy to be opened; None if the run trains its own.
        episodes: Number of held-out episodes.
    """

    task: str
    policy: str
    kind: str
    seed: int = 0
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    written: Written | None = None
    episodes: int = field(default_factory=lambda: EPISODES)

    @property
    def folder(self) -> str:
        """Path of the run's folder within the benchmark's folder."""
        return f"{self.task.partition('/')[2]}/{self.policy}/{self.seed}"

    def check_same(self, path: Path, row: Row) -> None:
        """Raise ValueError unless an existing row belongs to this run."""
        check_begun(path, row.versions.get("sources"), "give another --out")
        what = {
            "hyper-parameters": (row.hyperparameters, dict(self.hyperparameters)),
            "episodes": (len(row.scores), self.episodes),
            "policy": (row.policy_sha256, row.policy_sha256 if self.written is None else self.written.sha256),
        }
        for name, (there, here) in what.items():
            if there != here:
                raise ValueError(f"{path} was made with other {name} than this run has; give another --out")


class _Done(NamedTuple):
    """A run's row and the other files of its folder."""

    row: Row
    files: Mapping[str, bytes]


def suite_task(text: str) -> str:
    """Return a task's full name from any spelling; ValueError for a task outside the suite."""
    name = environment_name(text)
    if name not in TASKS:
        raise ValueError(f"{name} is no task of the suite, whose configuration is frozen; take {', '.join(TASKS)}")
    return name


def baseline_runs(task: str) -> list[BenchmarkRun]:
    """Return the runs of a task's baselines."""
    return [BenchmarkRun(task, name, BASELINE, written=Written.of(name, trust=False)) for name in baselines_of(task)]


def submitted_run(task: str, text: str, trust: bool) -> BenchmarkRun:
    """Return the run of a submitted policy.

    Args:
        task: Name of the task.
        text: Name of the policy: a file or module:function.
        trust: As for `open_policy`.

    Raises:
        ValueError: For a baseline, which every table has, or the name of an algorithm.
    """
    from agents.training.algorithms import ALGORITHMS

    name = Path(text).stem if names_a_file(text) else text.replace(":", ".")
    if is_baseline(text) or name in (*ALGORITHMS, *baselines_of(task)):
        raise ValueError(f"{text} has the name of a baseline or an algorithm of the table; give it one of its own")
    written = Written.of(text, trust)
    judge(open_policy(text, trust=trust).policy, task, 1)  # what cannot act there is refused before all else is run
    return BenchmarkRun(task, name, SUBMITTED, written=written)


def make(
    runs: Sequence[BenchmarkRun],
    folder: Path,
    *,
    pool: Pool | None = None,
    told: Callable[[BenchmarkRun, Row], None] = lambda run, row: None,
    share: Callable[[float], None] = lambda share: None,
) -> None:
    """Make the runs that are missing in the folder.

    Args:
        runs: All runs.
        folder: Folder of the benchmark.
        pool: Pool that makes them elsewhere, with equal results.
        told: Called with each finished run.
        share: Called with the finished share of all runs.

    Raises:
        ValueError: For an existing row of another run, or of other sources.
    """
    left = []
    for run in runs:
        path = folder / run.folder / RESULT
        if path.is_file():
            run.check_same(path, Row.load(path))
        else:
            left.append(run)
    begun = len(runs) - len(left)
    share(begun / len(runs))

    def tell(k: int, own: float) -> None:
        share((begun + k + own) / len(runs))

    for k, (run, done) in enumerate(_each(left, pool, tell)):
        for name, content in {**done.files, RESULT: done.row.text().encode()}.items():
            write_whole(folder / run.folder / name, content)
        tell(k + 1, 0.0)
        told(run, done.row)


def _each(
    runs: Sequence[BenchmarkRun], pool: Pool | None, tell: Callable[[int, float], None]
) -> Iterator[tuple[BenchmarkRun, _Done]]:
    if pool is None:
        for k, run in enumerate(runs):
            yield run, _made(run, partial(tell, k))
    else:
        for number, done in pool.unordered(_made, runs, fits=_is_of):
            yield runs[number], done


def _made(run: BenchmarkRun, tell: Callable[[float], None] = lambda share: None) -> _Done:
    """Train a row's agent, and evaluate it."""
    from agents.policies.policy import policy_of

    files: dict[str, bytes] = {}
    start = time.process_time()
    if run.written is None:
        bundle, files = _trained(run, tell)
        policy: Any = policy_of(bundle)
        opened, sha256 = AGENT, hashlib.sha256(files[AGENT]).hexdigest()
    else:
        policy = run.written.open(run.task, ONE_THREAD)
        opened, sha256 = run.written.text, run.written.sha256
        if run.written.content is not None:
            opened = Path(opened).name
            files = {opened: run.written.content}
    trained = time.process_time()
    scores, ended = judge(policy, run.task, run.episodes)
    row = Row(
        run.task, run.policy, run.kind, run.seed, opened, sha256, [TEST[0], TEST[run.episodes - 1]], scores, ended,
        int(run.hyperparameters.get("n_timesteps", 0)), dict(run.hyperparameters),
        {"training": round(trained - start, 2) if run.kind == TRAINED else 0.0,
         "episodes": round(time.process_time() - trained, 2)}, versions(),
    )  # fmt: skip
    return _Done(row, files)


def _trained(run: BenchmarkRun, tell: Callable[[float], None]) -> tuple[Any, dict[str, bytes]]:
    """Return a trained agent and the files of its training, without checkpoint and TensorBoard's."""
    from agents.training.train import train

    given = {**run.hyperparameters, "env_kwargs": ONE_THREAD}
    with tempfile.TemporaryDirectory() as elsewhere:
        folder = Path(elsewhere)
        training = TrainingRun(run.task, run.policy, given, seed=run.seed, preset="benchmark")
        bundle = train(training, folder, report=lambda state: tell(state.timesteps / max(state.total, 1)))
        return bundle, {name: read_bytes(folder / name, MOST_ARRAYS) for name in (AGENT, TABLE)}


def judge(policy: Any, task: str, episodes: int) -> tuple[list[float], int]:
    """Return the scores in a task's held-out episodes, and how many of these ended early."""
    found = evaluate(policy, task, ONE_THREAD, episodes=episodes, seed=TEST[0])
    return [value / TASKS[task].steps for value in found.values[RETURN.name]], sum(found.violations.values())


def _is_of(run: BenchmarkRun, found: Any) -> bool:
    """Return whether an answer is a result of `_made` for a run."""
    return isinstance(found, _Done) and found.row.task == run.task and len(found.row.scores) == run.episodes


class RowCheck(NamedTuple):
    """The result of running a row's episodes again."""

    holds: bool
    says: str


def check(path: Path, *, trust: bool = False) -> RowCheck:
    """Run a row's episodes again with its policy, a file in the same folder; return whether they confirm its scores.

    Raises:
        RowError: If the file is no row, was changed, lacks its policy, or names a Python function without `trust`.
        UntrustedError: For a checkpoint without `trust`.
    """
    from agents.benchmark.statistics import interquartile_mean

    row = Row.load(path)
    text = str(path.parent / row.opened) if names_a_file(row.opened) else row.opened
    if ":" in row.opened and not names_a_file(text) and not trust:
        raise RowError(
            f"the row's policy is the Python function {row.opened}, whose module would be run with your rights: if you "
            "trust it, give --trust"
        )
    if names_a_file(text) and not Path(text).is_file():
        raise RowError(f"the row's policy, {row.opened}, is not beside it: put it into {path.parent}")
    written = Written.of(text, trust)
    if written.sha256 != row.policy_sha256:
        return RowCheck(
            False, f"{row.opened} is not the row's policy: its SHA-256 is {written.sha256}, not {row.policy_sha256}"
        )
    scores, _ = judge(written.open(row.task, ONE_THREAD), row.task, len(row.scores))
    if scores == row.scores:
        return RowCheck(True, f"all {len(scores)} scores are the row's, to the last digit")
    import numpy as np

    stated, now = (interquartile_mean([np.array([values])]) for values in (row.scores, scores))
    most = float(np.abs(np.subtract(scores, row.scores)).max())
    inside = stated.low <= now.value <= stated.high
    return RowCheck(
        inside,
        f"the interquartile mean is {now.value:.4f}, {'inside' if inside else 'outside'} the row's interval "
        f"({stated.low:.4f} to {stated.high:.4f}); scores differ by up to {most:.2g}, and the row was made with "
        f"drive-env {row.versions.get('drive-env')}, sources {row.versions.get('sources')}",
    )
