"""Search for hyper-parameters with Optuna: every trial trains an agent and scores it on machines that it has not seen.

The study is a journal file: it can be gone on with after an interruption, and by several processes at once.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from agents.training.hyperparameters import merge
from agents.training.train import ALGORITHMS, DivergedError, Run, train

JOURNAL, BEST = "study.log", "best.yaml"


class Row(NamedTuple):
    """A hyper-parameter that is searched: where it stands in the YAML, and its range or its choices."""

    key: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[Any, ...] = ()


DISCOUNTS = (0.0, 0.95, 0.98, 0.99, 0.995, 1.0)  # 0: rewards that each step earns alone, as EachTrial's
PPO = (
    Row("learning_rate", 3e-5, 3e-3, log=True),
    Row("gamma", choices=DISCOUNTS),
    Row("gae_lambda", choices=(0.9, 0.95, 1.0)),
    Row("clip_range", choices=(0.1, 0.2, 0.3)),
    Row("n_epochs", choices=(3, 5, 10)),
    Row("policy_kwargs.log_std_init", -3.0, 0.0),
    Row("policy_kwargs.net_arch", choices=("32,32", "64,64", "128,128")),
)
# Algorithm -> what is searched. Networks are texts: Optuna keeps choices in its file as JSON.
SPACES: dict[str, tuple[Row, ...]] = {
    "ppo": PPO,
    "recurrent_ppo": (*PPO[:-1], Row("policy_kwargs.lstm_hidden_size", choices=(32, 64, 128))),
    "sac": (
        Row("learning_rate", 3e-5, 3e-3, log=True),
        Row("gamma", choices=DISCOUNTS),
        Row("tau", choices=(0.005, 0.01, 0.02)),
        Row("batch_size", choices=(128, 256, 512)),
        Row("policy_kwargs.net_arch", choices=("64,64", "128,128", "256,256")),
    ),
}


class Trial(NamedTuple):
    """A trial that is over: its number, score (None if the training diverged), and what was drawn."""

    number: int
    score: float | None
    drawn: Mapping[str, Any]


def search(
    environment: str,
    algorithm: str,
    hyperparameters: Mapping[str, Any],
    folder: str | Path,
    *,
    trials: int,
    seed: int = 0,
    episodes: int = 64,
    told: Callable[[Trial, Trial | None], None] | None = None,
) -> dict[str, Any]:
    """Try hyper-parameters and return the best, RL-Zoo's way; the folder gets the study, and best.yaml, trial by trial.

    A search that is killed loses the trial under way: the next search in the folder goes on behind it.

    Args:
        environment: Name of the environment.
        algorithm: A row of SPACES.
        hyperparameters: Those that a trial begins with.
        folder: With a study in it, that is gone on with.
        trials: How many more.
        seed: Of trainings and of the search.
        episodes: Of a score.
        told: Is told of each trial that is over, and of the best one; None before there is one.

    Raises:
        DivergedError: If no training at all gave an agent.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    from agents.evaluation.evaluation import FIRST_SEED, evaluate
    from agents.policies.policy import policy_of

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # what failed is told, in a line
    base = Run(environment, algorithm, hyperparameters)
    storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    study = optuna.create_study(storage=storage, study_name=f"{base.environment} {algorithm}", load_if_exists=True)

    def objective(trial: Any) -> float:
        # Seeded by trial: a search that is gone on with, or a second process, would draw the first ones again.
        own = np.random.SeedSequence((seed, trial.number)).generate_state(1)[0]
        study.sampler = optuna.samplers.TPESampler(seed=int(own))
        given = drawn(algorithm, hyperparameters, trial)
        run = Run(environment, algorithm, given, seed=seed, preset="search")
        bundle = train(run, folder / f"trial-{trial.number:03d}")
        found = evaluate(
            policy_of(bundle), bundle.environment, bundle.configuration, episodes=episodes, seed=FIRST_SEED // 2
        )
        mean = found.interval(found.score).mean
        return mean if found.lower_is_better[found.score] else -mean

    done = (optuna.trial.TrialState.COMPLETE,)

    def tell(study: Any, trial: Any) -> None:
        best = study.best_trial if study.get_trials(deepcopy=False, states=done) else None
        if best is not None:
            _write(folder / BEST, base.environment, drawn(algorithm, hyperparameters, best), study, best)
        if told is not None:
            over, first = (None if one is None else Trial(one.number, one.value, one.params) for one in (trial, best))
            assert over is not None
            told(over, first)

    # A training that diverges is a trial that failed: the next ones go elsewhere.
    study.optimize(objective, n_trials=trials, callbacks=[tell], catch=(DivergedError,))
    if not study.get_trials(deepcopy=False, states=done):
        raise DivergedError(f"all {len(study.trials)} trainings diverged; give a smaller learning_rate (--config)")
    best: dict[str, Any] = drawn(algorithm, hyperparameters, study.best_trial)
    return best


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
