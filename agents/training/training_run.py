"""A training run: its task, files, segments, and progress report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from agents.tasks import environment_name, row_of
from agents.training.algorithms import ALGORITHMS
from agents.training.counted_environments import CountedEnvironments

CHECKPOINT, AGENT, TABLE, CURVE = "checkpoint.zip", "agent.npz", "training.csv", "learning_curve.png"
EPISODES_PER_SEGMENT = 3  # of every environment, at least


@dataclass(frozen=True)
class TrainingRun:
    """A training.

    Attributes:
        environment: Name of the environment.
        algorithm: A row of ALGORITHMS.
        hyperparameters: Result of agents.training.hyperparameters.load.
        seed: Seed of all random numbers.
        preset: Preset of the hyper-parameters, for the card.
        segments: Number of segments, each with a checkpoint at its end and then a reset of the environments.
        torch_threads: Threads of torch; small networks are fastest with 1.
    """

    environment: str
    algorithm: str
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    preset: str = "full"
    segments: int = 10
    torch_threads: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "environment", environment_name(self.environment))
        if self.algorithm not in ALGORITHMS:
            raise ValueError(f"there is no algorithm {self.algorithm!r}; there are {', '.join(ALGORITHMS)}")
        if self.segments < 1:
            raise ValueError(f"segments must be 1 or more, not {self.segments}")
        if self.seed < 0:
            raise ValueError(f"the seed must be 0 or more, not {self.seed}")

    @property
    def total(self) -> int:
        """Steps of all environments together."""
        return int(self.hyperparameters["n_timesteps"])


class Progress(NamedTuple):
    """The progress of a training: means of the last episodes, mean of each reward term per step, speed [steps/s].

    `environment_share` is the environment's share of the time. `imitated` is the finished share of a preceding
    imitation; until it is 1, all other fields but `total` are 0.
    """

    timesteps: int
    total: int
    episodes: int
    means: Mapping[str, float]
    terms: Mapping[str, float]
    speed: float
    environment_share: float
    imitated: float = 1.0


Report = Callable[[Progress], None]


def segment_length(run: TrainingRun, lanes: CountedEnvironments) -> int:
    """Return the steps of a segment: a share of the run, but at least some episodes of every environment."""
    episode: int = row_of(run.environment).steps(lanes.config) * lanes.num_envs
    return max(int(run.total // run.segments), EPISODES_PER_SEGMENT * episode)


def segment_seed(seed: int, segment: int) -> int:
    """Return the seed of all environments in a segment."""
    return int(np.random.SeedSequence([seed, segment]).generate_state(1)[0]) >> 1
