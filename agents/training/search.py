"""Search for hyper-parameters with Optuna: every trial trains an agent and scores it on machines not used for training.

The study is a journal file: it can be gone on with after an interruption, and by several processes at once. Trials are
drawn in rounds, each from what the rounds before have found, so that those of a round may run side by side: where they
run changes none of them.
"""

from __future__ import annotations

import copy
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from agents.training.algorithms import ALGORITHMS
from agents.training.hyperparameters import merge
from agents.training.train import DivergedError, TrainingRun, train
from tuning.runs.provenance import check_study

if TYPE_CHECKING:
    from tuning.runs.pools import Pool

JOURNAL, BEST = "study.log", "best.yaml"
ROUND = 5  # trials that are drawn from the same knowledge, and may run at a time
# Torch's and NumPy's random numbers are a process's: of two trainings at once in it, none would be what it is alone.
_ALONE = threading.Lock()


class SearchRow(NamedTuple):
    """A hyper-parameter that is searched: where it stands in the YAML, and its range or its choices."""

    key: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[Any, ...] = ()


DISCOUNTS = (0.0, 0.95, 0.98, 0.99, 0.995, 1.0)  # 0: rewards that each step earns alone, as EachTrial's
PPO = (
    SearchRow("learning_rate", 3e-5, 3e-3, log=True),
    SearchRow("gamma", choices=DISCOUNTS),
    SearchRow("gae_lambda", choices=(0.9, 0.95, 1.0)),
    SearchRow("clip_range", choices=(0.1, 0.2, 0.3)),
    SearchRow("n_epochs", choices=(3, 5, 10)),
    SearchRow("policy_kwargs.log_std_init", -3.0, 0.0),
    SearchRow("policy_kwargs.net_arch", choices=("32,32", "64,64", "128,128")),
)
# Algorithm -> what is searched. Networks are texts: Optuna keeps choices in its file as JSON.
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


class SearchTrial(NamedTuple):
    """A trial that is over: its number, score (None if the training diverged), and what was drawn."""

    number: int
    score: float | None
    drawn: Mapping[str, Any]


class _TrainingTask(NamedTuple):
    """A training and its score, for whatever process; without a folder its files come back with the score."""

    run: TrainingRun
    folder: Path | None
    episodes: int


class _Scored(NamedTuple):
    """What came of a task: the score to be minimised, None if the training diverged, and files by their names."""

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
    told: Callable[[SearchTrial, SearchTrial | None], None] | None = None,
    pool: Pool | None = None,
) -> dict[str, Any]:
    """Try hyper-parameters and return the best, RL-Zoo's way; the folder gets the study, and best.yaml, trial by trial.

    A search that is killed loses the trials under way: the next search in the folder goes on behind them.

    Args:
        environment: Name of the environment.
        algorithm: A row of SPACES.
        hyperparameters: Those that a trial begins with.
        folder: With a study in it, that is gone on with.
        trials: How many more.
        seed: Of trainings and of the search.
        episodes: Of a score.
        told: Called with each completed trial, in their order, and the best one; None before there is one.
        pool: Where else trials run, ROUND at a time, which changes none of them.

    Raises:
        DivergedError: If no training at all gave an agent.
        ValueError: For a study that was begun with other sources.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # what failed is told, in a line
    base = TrainingRun(environment, algorithm, hyperparameters)
    storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    study = optuna.create_study(storage=storage, study_name=f"{base.environment} {algorithm}", load_if_exists=True)
    check_study(study, folder / JOURNAL, "give another --out")
    states = optuna.trial.TrialState

    def begun(known: Any) -> tuple[Any, _TrainingTask]:
        """Return a trial, drawn from what was known when its round began, and what is to be done."""
        study.sampler = optuna.samplers.RandomSampler()  # draws nothing yet
        trial = study.ask()
        # Seeded by trial: a search that is gone on with, or a second process, would draw the first ones again.
        own = np.random.SeedSequence((seed, trial.number)).generate_state(1)[0]
        study.sampler = _sampler(known, int(own))
        given = drawn(algorithm, hyperparameters, trial)
        here = pool is None or pool.shares_disk
        run = TrainingRun(environment, algorithm, given, seed=seed, preset="search")
        return trial, _TrainingTask(run, _folder_of(folder, trial.number) if here else None, episodes)

    def over(trial: Any, scored: _Scored) -> None:
        for name, content in scored.files.items():
            path = _folder_of(folder, trial.number) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        # A training that diverges is a trial that failed: the next ones go elsewhere.
        found = study.tell(trial, scored.score, state=states.FAIL if scored.score is None else states.COMPLETE)
        best = study.best_trial if study.get_trials(deepcopy=False, states=(states.COMPLETE,)) else None
        if best is not None:
            _write(folder / BEST, base.environment, drawn(algorithm, hyperparameters, best), study, best)
        if told is not None:
            last, first = (
                None if one is None else SearchTrial(one.number, one.value, one.params) for one in (found, best)
            )
            assert last is not None
            told(last, first)

    for first in range(0, trials, ROUND):
        count = min(ROUND, trials - first)
        known = optuna.create_study()
        known.add_trials(study.get_trials(states=(states.COMPLETE,)))
        waiting: list[Any] = []
        try:
            if pool is None:
                for _ in range(count):
                    trial, task = begun(known)
                    waiting = [trial]
                    over(trial, _trained(task))
            else:
                tasks = [begun(known) for _ in range(count)]
                waiting = [trial for trial, _ in tasks]
                for scored in _in_turn(pool.unordered(_trained, [task for _, task in tasks])):
                    over(waiting[0], scored)
                    del waiting[0]
        except (Exception, KeyboardInterrupt):
            for trial in waiting:
                study.tell(trial, state=states.FAIL, skip_if_finished=True)
            raise
    if not study.get_trials(deepcopy=False, states=(states.COMPLETE,)):
        raise DivergedError(f"all {len(study.trials)} trainings diverged; give a smaller learning_rate (--config)")
    best: dict[str, Any] = drawn(algorithm, hyperparameters, study.best_trial)
    return best


def _sampler(known: Any, seed: int) -> Any:
    """Return Optuna's own sampler, which draws from what is known in place of what the study has meanwhile."""
    from optuna.samplers import TPESampler

    class FromTheRoundsBefore(TPESampler):  # type: ignore[misc]  # Optuna has no types
        def sample_independent(self, _study: Any, trial: Any, name: str, distribution: Any) -> Any:
            return super().sample_independent(known, trial, name, distribution)

    return FromTheRoundsBefore(seed=seed, multivariate=False)  # what is drawn jointly is so before the trial's seed


def _trained(task: _TrainingTask) -> _Scored:
    """Do a task."""
    from agents.evaluation.evaluation import FIRST_SEED, evaluate
    from agents.policies.policy import policy_of

    with _ALONE, tempfile.TemporaryDirectory() as elsewhere:
        folder = Path(elsewhere) if task.folder is None else task.folder
        score: float | None = None
        try:
            bundle = train(task.run, folder)
        except DivergedError:
            pass
        else:
            found = evaluate(
                policy_of(bundle), bundle.environment, bundle.configuration, episodes=task.episodes,
                seed=FIRST_SEED // 2,
            )  # fmt: skip
            mean = found.interval(found.score).mean
            score = mean if found.lower_is_better[found.score] else -mean
        paths = [] if task.folder is not None else [path for path in folder.rglob("*") if path.is_file()]
        return _Scored(score, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def _in_turn(results: Iterator[tuple[int, _Scored]]) -> Iterator[_Scored]:
    """Give results in the order of their tasks, each as soon as those before it are there."""
    early: dict[int, _Scored] = {}
    given = 0
    for k, scored in results:
        early[k] = scored
        while given in early:
            yield early.pop(given)
            given += 1


def _folder_of(folder: Path, number: int) -> Path:
    return folder / f"trial-{number:03d}"


def _write(path: Path, environment: str, best: Mapping[str, Any], study: Any, trial: Any) -> None:
    """Write hyper-parameters as a file that `drive-agent train --config` takes."""
    text = yaml.safe_dump({environment: dict(best), "quick": {}, "full": {}}, sort_keys=False)
    path.write_text(f"# Trial {trial.number}, the best of {len(study.trials)}.\n\n{text}", encoding="utf-8")


def drawn(algorithm: str, hyperparameters: Mapping[str, Any], trial: Any) -> dict[str, Any]:
    """Return hyper-parameters with what a trial drew, or draws, in their places."""
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
