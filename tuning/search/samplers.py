"""Samplers propose gains: they yield points of a box, one generation at a time, and receive their costs.

TPE, CMA-ES and Gaussian processes are Optuna's, used by ask and tell. Their samplers are created for every generation
from the seed and its number, so that an interrupted study, when continued, proposes the same points.
"""

from __future__ import annotations

import importlib.util
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from mechanics.arrays import Floats
from tuning.runs.provenance import check_study

SAMPLERS = ("random", "grid", "tpe", "cmaes", "gp")
_NEEDS = {"cmaes": ("cmaes", "cmaes"), "gp": ("torch", "torch")}  # sampler -> module, what pip installs
_FACTS = "facts"
STARTUP = 6  # random trials of TPE and GP before their model is used


class Proposer(Protocol):
    """Proposes points of a box and receives their values."""

    def ask(self, count: int) -> list[Floats]:
        """Return `count` points, or fewer if no more exist."""

    def tell(self, values: Sequence[Sequence[float]], facts: Sequence[Mapping[str, Any]]) -> None:
        """Receive the values of the points last asked for, one row of objectives each; smaller is better.

        `facts` are further data to store with each point, of JSON types.
        """

    def history(self) -> list[Mapping[str, Any]]:
        """Return the facts of all points stored in a journal, in order."""

    @property
    def told(self) -> int:
        """Number of points whose values were received."""


class Study(NamedTuple):
    """A study in a journal: its name, and the subject of its points as lines of text."""

    name: str = "study"
    subject: str = ""


THE_STUDY = Study()


def new_proposer(
    sampler: str,
    low: Floats,
    high: Floats,
    *,
    seed: int,
    objectives: int = 1,
    trials: int = 30,
    first: Sequence[Floats] = (),
    generation: int = 1,
    journal: Path | None = None,
    study: Study = THE_STUDY,
) -> Proposer:
    """Create a sampler of the box low...high.

    Args:
        sampler: One of `SAMPLERS`.
        low: Lower ends of the box, shape (dimensions,).
        high: Upper ends of the box, shape (dimensions,).
        seed: Seed of everything random.
        objectives: Number of values of each point.
        trials: Number of points that will be asked for; it determines the levels of a grid.
        first: Points to propose first.
        generation: Number of points asked for at a time: the population of CMA-ES, if it is 4 or more.
        journal: File in which Optuna's studies are stored, and from which an interrupted one continues.
        study: The study in the journal; one with another subject is refused.

    Raises:
        ValueError: For an unknown sampler, one that supports a single objective only, or one that lacks a package.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"no sampler is named {sampler!r}; there are {', '.join(SAMPLERS)}")
    check_installed(sampler)
    if objectives > 1 and sampler == "cmaes":
        raise ValueError("CMA-ES has one objective only; take tpe or gp for several, or let cmaes minimise the cost")
    if sampler == "grid":
        if journal is not None:
            raise ValueError("a grid keeps no journal; leave it out, or use drive-tune sweep, which resumes")
        return _Grid(low, high, trials, first)
    return _Optuna(sampler, low, high, seed, objectives, first, generation, journal, study)


def check_installed(sampler: str) -> None:
    """Raise ValueError, with the remedy, if a package that the sampler needs is missing."""
    module, package = _NEEDS.get(sampler, ("optuna", "optuna"))
    if importlib.util.find_spec(module) is None:
        others = ", ".join(name for name in SAMPLERS if name not in _NEEDS)
        raise ValueError(
            f"the sampler {sampler!r} needs {package}: pip install {package}; without it there are {others}"
        )


def load(sampler: str) -> None:
    """Import a sampler's package in advance: it takes a second or more, too long while an axis is enabled."""
    if sampler != "grid":
        importlib.import_module("optuna.samplers")


class _Grid:
    """The points of a grid in lexicographic order, after the given first points."""

    def __init__(self, low: Floats, high: Floats, trials: int, first: Sequence[Floats]) -> None:
        room = max(trials - len(first), 1)
        levels = max(math.floor(room ** (1.0 / len(low)) + 1e-9), 1)
        marks = [np.linspace(a, b, levels + 2)[1:-1] for a, b in zip(low, high, strict=True)]
        self._left = [*map(np.asarray, first), *map(np.array, product(*marks))]
        self._told = 0

    def ask(self, count: int) -> list[Floats]:
        asked, self._left = self._left[:count], self._left[count:]
        return asked

    def tell(self, values: Sequence[Sequence[float]], facts: Sequence[Mapping[str, Any]]) -> None:
        self._told += len(values)

    def history(self) -> list[Mapping[str, Any]]:
        return []

    @property
    def told(self) -> int:
        return self._told


class _Optuna:
    """An Optuna study, used by ask and tell."""

    def __init__(
        self,
        sampler: str,
        low: Floats,
        high: Floats,
        seed: int,
        objectives: int,
        first: Sequence[Floats],
        generation: int,
        journal: Path | None,
        study: Study,
    ) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._optuna, self._sampler, self._seed, self._generation = optuna, sampler, seed, generation
        self._bounds = {f"x{k}": (float(a), float(b)) for k, (a, b) in enumerate(zip(low, high, strict=True))}
        storage = None
        if journal is not None:
            from optuna.storages import JournalStorage
            from optuna.storages.journal import JournalFileBackend

            storage = JournalStorage(JournalFileBackend(str(journal)))
        self._study = optuna.create_study(
            storage=storage, study_name=study.name, directions=["minimize"] * objectives, load_if_exists=True
        )
        if journal is not None:
            check_study(self._study, journal, "give another --journal", study.subject)
        # Points that had been asked for when the study was interrupted come first.
        running = optuna.trial.TrialState.RUNNING
        self._running = [trial._trial_id for trial in self._study.get_trials(deepcopy=False, states=(running,))]
        self._first = list(first)[self.told :]
        self._asked: list[Any] = []

    @property
    def told(self) -> int:
        return len(self._complete())

    def ask(self, count: int) -> list[Floats]:
        first, self._first = self._first[:count], self._first[count:]
        told = self.told
        self._asked = []
        points = []
        with self._quiet():
            for place in range(count):
                # A sampler for each point: its random numbers must not depend on how the last generation ended.
                self._study.sampler = self._new_sampler(told + place)
                if self._running:
                    trial = self._optuna.trial.Trial(self._study, self._running.pop(0))
                else:
                    if place < len(first):
                        point = dict(zip(self._bounds, map(float, first[place]), strict=True))
                        self._study.enqueue_trial(point, skip_if_exists=True)
                    trial = self._study.ask()
                points.append(np.array([trial.suggest_float(name, *ends) for name, ends in self._bounds.items()]))
                self._asked.append(trial)
        return points

    def tell(self, values: Sequence[Sequence[float]], facts: Sequence[Mapping[str, Any]]) -> None:
        with self._quiet():
            for trial, row, fact in zip(self._asked, values, facts, strict=True):
                trial.set_user_attr(_FACTS, dict(fact))
                self._study.tell(trial, list(map(float, row)))
        self._asked = []

    def history(self) -> list[Mapping[str, Any]]:
        return [trial.user_attrs[_FACTS] for trial in self._complete()]

    def _complete(self) -> list[Any]:
        state = self._optuna.trial.TrialState.COMPLETE
        return list(self._study.get_trials(deepcopy=False, states=(state,)))

    @contextmanager
    def _quiet(self) -> Iterator[None]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", self._optuna.exceptions.ExperimentalWarning)
            yield

    def _new_sampler(self, number: int) -> Any:
        samplers = self._optuna.samplers
        seed = int(np.random.SeedSequence((self._seed, number)).generate_state(1)[0])
        if self._sampler == "random":
            return samplers.RandomSampler(seed=seed)
        if self._sampler == "tpe":
            return samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=STARTUP)
        if self._sampler == "gp":
            return samplers.GPSampler(seed=seed, n_startup_trials=STARTUP)
        population = self._generation if self._generation >= 4 else None
        return samplers.CmaEsSampler(seed=seed, popsize=population, n_startup_trials=0)
