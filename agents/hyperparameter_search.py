"""Search for hyper-parameters with Optuna: every trial trains an agent and scores it on machines not used for training.

The study is a journal file: it can be continued after an interruption, and by several processes at once. Trials are
drawn in rounds, each from the results of previous rounds, so that the trials of a round may run in parallel, with equal
results anywhere.
"""

from __future__ import annotations

import copy
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from agents.seeds import VALIDATION
from agents.training.algorithms import ALGORITHMS, NOT_TAKEN
from agents.training.hyperparameters import merge
from agents.training.train import DivergedError, train, with_inputs
from agents.training.training_run import TrainingRun
from drive_env.whole_file import write_whole
from tuning.runs.inputs import as_kept, found_in, inputs_in, table_of, write_inputs
from tuning.runs.provenance import check_study

if TYPE_CHECKING:
    from tuning.runs.pools import Pool

JOURNAL, BEST = "study.log", "best.yaml"
ROUND = 5  # trials drawn from the same results, which may run in parallel


class SearchRow(NamedTuple):
    """A searched hyper-parameter: its place in the YAML, and its range or choices."""

    key: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[Any, ...] = ()


DISCOUNTS = (0.0, 0.95, 0.98, 0.99, 0.995, 1.0)  # 0: rewards that each step earns by itself, as in EachTrial's
PPO = (
    SearchRow("learning_rate", 3e-5, 3e-3, log=True),
    SearchRow("gamma", choices=DISCOUNTS),
    SearchRow("gae_lambda", choices=(0.9, 0.95, 1.0)),
    SearchRow("clip_range", choices=(0.1, 0.2, 0.3)),
    SearchRow("n_epochs", choices=(3, 5, 10)),
    SearchRow("policy_kwargs.log_std_init", -3.0, 0.0),
    SearchRow("policy_kwargs.net_arch", choices=("32,32", "64,64", "128,128")),
)
# Algorithm -> searched hyper-parameters. Networks are texts: Optuna stores choices in its file as JSON.
SPACES: dict[str, tuple[SearchRow, ...]] = {
    "ppo": PPO,
    "recurrent_ppo": (*PPO[:-1], SearchRow("policy_kwargs.lstm_hidden_size", choices=(32, 64, 128))),
    "sac": (
        SearchRow("learning_rate", 3e-5, 3e-3, log=True),
        SearchRow("gamma", choices=DISCOUNTS),
        SearchRow("tau", choices=(0.005, 0.01, 0.02)),
        SearchRow("batch_size", choices=(128, 256, 512)),
        SearchRow("policy_kwargs.net_arch", choices=("64,64", "128,128", "256,256")),
    ),
}
SPACES["tqc"] = SPACES["sac"]
SPACES["crossq"] = tuple(row for row in SPACES["sac"] if row.key not in NOT_TAKEN["crossq"])


class SearchTrial(NamedTuple):
    """A finished trial: its number, score (None if the training diverged), and the drawn hyper-parameters."""

    number: int
    score: float | None
    drawn: Mapping[str, Any]


Told = Callable[[SearchTrial, SearchTrial | None], None]  # a finished trial, and the best one, if any


class _TrainingTask(NamedTuple):
    """A training and its score, for any process; without a folder its files are returned with the score."""

    run: TrainingRun
    folder: Path | None
    episodes: int


class _Scored(NamedTuple):
    """The result of a task: the score to be minimised, None if the training diverged, and files by their names."""

    score: float | None
    files: Mapping[str, bytes]


def search(
    environment: str,
    algorithm: str,
    hyperparameters: Mapping[str, Any],
    folder: str | Path,
    *,
    trials: int,
    seed: int = 0,
    episodes: int = 64,
    told: Told | None = None,
    pool: Pool | None = None,
) -> dict[str, Any]:
    """Search hyper-parameters and return the best in RL-Zoo's form; study and best.yaml are updated after each trial.

    A killed search loses the trials under way; the next search in the folder continues after them.

    Args:
        environment: Name of the environment.
        algorithm: A row of SPACES.
        hyperparameters: Initial hyper-parameters of a trial.
        folder: Folder of the study; an existing study is continued.
        trials: Number of further trials.
        seed: Seed of trainings and of the search.
        episodes: Episodes for a score.
        told: Called with each completed trial, in their order, and the best one; None before there is one.
        pool: Pool that runs trials elsewhere, ROUND at a time, with equal results.

    Raises:
        DivergedError: If all trainings diverged.
        ValueError: For a study that was begun with other sources, hyper-parameters or files.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    base = with_inputs(TrainingRun(environment, algorithm, hyperparameters))
    study = _Study(base, folder, seed, episodes, told)
    for first in range(0, trials, ROUND):
        _make_round(study, min(ROUND, trials - first), pool)
    return study.best()


def _make_round(study: _Study, count: int, pool: Pool | None) -> None:
    """Make trials drawn from the same results; those ended by an error or Ctrl-C count as failed."""
    known = study.known()
    waiting: list[Any] = []
    try:
        if pool is None:
            for _ in range(count):
                trial, task = study.begin(known, writes_there=True)
                waiting = [trial]
                study.end(trial, _trained(task))
        else:
            begun = [study.begin(known, writes_there=pool.shares_disk) for _ in range(count)]
            waiting = [trial for trial, _ in begun]
            for scored in _in_turn(pool.unordered(_trained, [task for _, task in begun], fits=_is_score)):
                study.end(waiting[0], scored)
                del waiting[0]
    except (Exception, KeyboardInterrupt):
        study.fail(waiting)
        raise


class _Study:
    """A search's study of Optuna, in the journal of its folder."""

    def __init__(self, base: TrainingRun, folder: Path, seed: int, episodes: int, told: Told | None) -> None:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        self._base, self._folder, self._seed, self._episodes, self._told = base, folder, seed, episodes, told
        optuna.logging.set_verbosity(optuna.logging.ERROR)  # failures are reported in a line
        storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
        name = f"{base.environment} {base.algorithm}"
        self._study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True)
        inputs = inputs_in(base.hyperparameters)
        subject = [f"{name} = {value}" for name, value in as_kept(base.hyperparameters).items()]
        subject += [f"episodes = {episodes}", *table_of(inputs)]
        check_study(self._study, folder / JOURNAL, "give another --out", "\n".join(subject))
        write_inputs(folder, inputs)
        self._states = optuna.trial.TrialState

    def known(self) -> Any:
        """Return the finished trials as a separate study."""
        import optuna

        known = optuna.create_study()
        known.add_trials(self._study.get_trials(states=(self._states.COMPLETE,)))
        return known

    def begin(self, known: Any, writes_there: bool) -> tuple[Any, _TrainingTask]:
        """Return a trial, drawn from the results known when its round began, and its task.

        Args:
            known: Result of `known`.
            writes_there: Whether the worker writes into this folder.
        """
        import optuna

        self._study.sampler = optuna.samplers.RandomSampler()  # draws nothing yet
        trial = self._study.ask()
        # Seeded by trial: a continued search, or a second process, would repeat the first draws.
        own = np.random.SeedSequence((self._seed, trial.number)).generate_state(1)[0]
        self._study.sampler = _sampler(known, int(own))
        base = self._base
        run = TrainingRun(base.environment, base.algorithm, self._drawn(trial), seed=self._seed, preset="search")
        return trial, _TrainingTask(run, self._folder_of(trial) if writes_there else None, self._episodes)

    def end(self, trial: Any, scored: _Scored) -> None:
        """Store the result of a trial, and report it."""
        for name, content in scored.files.items():
            path = self._folder_of(trial) / name
            write_whole(path, content)
        # A diverged training is a failed trial: the next ones go elsewhere.
        state = self._states.FAIL if scored.score is None else self._states.COMPLETE
        found = self._study.tell(trial, scored.score, state=state)
        best = self._study.best_trial if self._completed() else None
        if best is not None:
            found_best = found_in(self._drawn(best), self._folder)
            _write(self._folder / BEST, self._base.environment, found_best, self._study, best)
        if self._told is not None:
            last = SearchTrial(found.number, found.value, found.params)
            self._told(last, None if best is None else SearchTrial(best.number, best.value, best.params))

    def fail(self, trials: Sequence[Any]) -> None:
        """Store trials as failed."""
        for trial in trials:
            self._study.tell(trial, state=self._states.FAIL, skip_if_finished=True)

    def best(self) -> dict[str, Any]:
        """Return the best hyper-parameters; DivergedError if no training gave an agent."""
        if not self._completed():
            raise DivergedError(
                f"all {len(self._study.trials)} trainings diverged; give a smaller learning_rate (--config)"
            )
        return self._drawn(self._study.best_trial)

    def _completed(self) -> list[Any]:
        found: list[Any] = self._study.get_trials(deepcopy=False, states=(self._states.COMPLETE,))
        return found

    def _drawn(self, trial: Any) -> dict[str, Any]:
        return drawn(self._base.algorithm, self._base.hyperparameters, trial)

    def _folder_of(self, trial: Any) -> Path:
        return self._folder / f"trial-{trial.number:03d}"


def _sampler(known: Any, seed: int) -> Any:
    """Return Optuna's TPE sampler for a round: it uses only the trials known at the round's begin, no later ones."""
    from optuna.samplers import TPESampler

    class FromTheRoundsBefore(TPESampler):  # type: ignore[misc]  # Optuna has no types
        def sample_independent(self, _study: Any, trial: Any, name: str, distribution: Any) -> Any:
            return super().sample_independent(known, trial, name, distribution)

    return FromTheRoundsBefore(seed=seed, multivariate=False)  # joint draws would come before the trial's seed


def _trained(task: _TrainingTask) -> _Scored:
    from agents.evaluation.evaluation import evaluate
    from agents.policies.policy import policy_of

    with tempfile.TemporaryDirectory() as elsewhere:
        folder = Path(elsewhere) if task.folder is None else task.folder
        score: float | None = None
        try:
            bundle = train(task.run, folder)
        except DivergedError:
            pass
        else:
            found = evaluate(
                policy_of(bundle), bundle.environment, bundle.configuration, episodes=task.episodes,
                seed=VALIDATION[0],
            )  # fmt: skip
            mean = found.interval(found.score).mean
            score = mean if found.lower_is_better[found.score] else -mean
        paths = [] if task.folder is not None else [path for path in folder.rglob("*") if path.is_file()]
        return _Scored(score, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def _is_score(_: _TrainingTask, scored: Any) -> bool:
    """Return whether an answer is a result of `_trained`."""
    return isinstance(scored, _Scored) and (scored.score is None or math.isfinite(scored.score))


def _in_turn(results: Iterator[tuple[int, _Scored]]) -> Iterator[_Scored]:
    """Yield results in the order of their tasks, each as soon as all previous ones are available."""
    early: dict[int, _Scored] = {}
    given = 0
    for k, scored in results:
        early[k] = scored
        while given in early:
            yield early.pop(given)
            given += 1


def _write(path: Path, environment: str, best: Mapping[str, Any], study: Any, trial: Any) -> None:
    """Write hyper-parameters as a file that `drive-agent train --config` takes."""
    text = yaml.safe_dump({environment: dict(best), "quick": {}, "full": {}}, sort_keys=False)
    write_whole(path, f"# Trial {trial.number}, the best of {len(study.trials)}.\n\n{text}")


def drawn(algorithm: str, hyperparameters: Mapping[str, Any], trial: Any) -> dict[str, Any]:
    """Return hyper-parameters with the values that a trial draws; ValueError for an algorithm not in SPACES."""
    if algorithm not in SPACES:
        raise ValueError(f"there is no algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    found: dict[str, Any] = copy.deepcopy(dict(hyperparameters))
    for row in SPACES[algorithm]:
        if hasattr(trial, "suggest_float"):
            value: Any = (
                trial.suggest_categorical(row.key, row.choices)
                if row.choices
                else trial.suggest_float(row.key, row.low, row.high, log=row.log)
            )
        else:
            value = trial.params[row.key]
        if isinstance(value, str):
            value = [int(one) for one in value.split(",")]
        table, dot, key = row.key.rpartition(".")
        merge(found, {table: {key: value}} if dot else {key: value})
    return found
