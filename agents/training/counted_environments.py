"""Environments during a training, with returns of episodes, reward terms, and their computing time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from drive_env.envs.vector_environment import VectorEnvironment

EPISODES = 100  # last episodes over which means are reported


class CountedEnvironments:
    """A vectorised environment with counters; otherwise it behaves as the environment inside.

    Attributes:
        episodes: Number of finished episodes.
        steps: Steps of all environments. seconds: Time spent in the environment.
        told: The info of the last reset or step, of all environments: Stable-Baselines3 does not get it.
    """

    def __init__(self, vector: VectorEnvironment) -> None:
        self.vector = vector
        self.episodes = self.steps = 0
        self.seconds = 0.0
        self.told: Mapping[str, Any] = {}
        self._returns = np.zeros(vector.num_envs)
        self._lengths = np.zeros(vector.num_envs, np.int64)
        self._ended: deque[tuple[float, int, bool]] = deque(maxlen=EPISODES)
        self._terms: dict[str, float] = {}
        self._term_steps = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.vector, name)

    @property
    def stage(self) -> float:
        """Stage of the curriculum."""
        return self.vector.stage

    @stage.setter
    def stage(self, stage: float) -> None:
        self.vector.stage = stage

    def reset(self, **options: Any) -> Any:
        """Begin an episode in every environment; interrupted ones do not count."""
        self._returns[:] = 0.0
        self._lengths[:] = 0
        start = time.perf_counter()
        found = self.vector.reset(**options)
        self.seconds += time.perf_counter() - start
        self.told = found[1]
        return found

    def step(self, actions: Any) -> Any:
        """Make a step in every environment."""
        start = time.perf_counter()
        stepped = self.vector.step(actions)
        self.seconds += time.perf_counter() - start
        _, reward, terminated, truncated, info = stepped
        self.told = info
        self.steps += len(reward)
        self._returns += reward
        self._lengths += 1
        for name, values in info.get("final_info", info).get("reward_terms", {}).items():
            self._terms[name] = self._terms.get(name, 0.0) + float(np.sum(values))
        self._term_steps += len(reward)
        ended = terminated | truncated
        if ended.any():
            for lane in np.flatnonzero(ended):
                self._ended.append((float(self._returns[lane]), int(self._lengths[lane]), bool(terminated[lane])))
            self.episodes += int(ended.sum())
            self._returns[ended] = 0.0
            self._lengths[ended] = 0
        return stepped

    def take_terms(self) -> dict[str, float]:
        """Return the mean of each reward term per step since the last call."""
        count = max(self._term_steps, 1)
        found = {name: total / count for name, total in self._terms.items()}
        self._terms, self._term_steps = {}, 0
        return found

    def forget(self) -> None:
        """Restart the means of episodes and terms."""
        self._ended.clear()
        self.take_terms()

    def episode_means(self) -> dict[str, float]:
        """Return mean return and length, and the share that terminated, of the last episodes; NaN before any."""
        if not self._ended:
            return {"return": np.nan, "length": np.nan, "terminated": np.nan}
        rows = np.array(self._ended, float).mean(axis=0)
        return {"return": float(rows[0]), "length": float(rows[1]), "terminated": float(rows[2])}
