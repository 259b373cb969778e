"""Rewards for a training, as wrappers of Stable-Baselines3's VecEnv: `vec_env_wrapper` of the YAML names one."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper

AXIS_ENTRIES = 8  # entries per axis in Tracking's observation
ERROR, CURRENT, LAST_ACTION = 0, 4, 7


class EachTrial(VecEnvWrapper):  # type: ignore[misc]
    """A reward for each trial of GainTuning by itself, whether it becomes the incumbent or not.

    It is - ln of the trial's robust cost over the rule's. The environment's own reward is 0 for every trial that is not
    better than all before, and most of it comes from a few machines for which the rule was far too cautious: a policy
    trained with it left half of the machines at the rule's gains. Meant for a discount of 0, since no trial is rewarded
    for others.

    Args:
        venv: The VecEnv of GainTuning, over `CountedEnvironments`.
        limit: Limit of the reward's magnitude: the cost of an oscillation, and the most that any machine counts.
    """

    def __init__(self, venv: Any, limit: float = 1.5) -> None:
        super().__init__(venv)
        self._limit = limit
        self._rule = np.ones(self.num_envs)  # the robust cost at its gains, of each environment's machine

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        observation = self.venv.reset()
        self._rule = self._told()["robust_cost"]
        return observation

    def step_wait(self) -> tuple[Any, Any, Any, Any]:
        """Return the step with this reward instead of the environment's."""
        observation, _, ended, infos = self.venv.step_wait()
        told = self._told()
        trial = told.get("final_info", told)["trial_robust_cost"]
        reward = np.clip(np.log(self._rule / trial), -self._limit, self._limit)
        self._rule = np.where(ended, told["robust_cost"], self._rule)  # of another machine, if an episode ended
        return observation, reward.astype(np.float32), ended, infos

    def _told(self) -> Any:
        return self.venv.get_attr("told", 0)[0]


class SmallErrors(VecEnvWrapper):  # type: ignore[misc]
    """A reward for Tracking with a slope at errors of some thousandths, where the environment's own is flat.

    It is the mean over the axes of - |error| / 0.01 amplitude - effort (current / limit)^2 - smoothness (change of the
    action)^2.

    Args:
        venv: The VecEnv of Tracking.
        error: Error, as a share of the amplitude, that costs 1.
        effort, smoothness: Weights.
    """

    def __init__(self, venv: Any, error: float = 0.01, effort: float = 1.0, smoothness: float = 1.0) -> None:
        super().__init__(venv)
        self._error, self._effort, self._smoothness = error, effort, smoothness
        self._before = np.zeros((self.num_envs, 1))

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        observation = self.venv.reset()
        self._before = self._axes(observation)[:, :, LAST_ACTION]
        return observation

    def step_wait(self) -> tuple[Any, Any, Any, Any]:
        """Return the step with this reward instead of the environment's, minus 100 if a drive went into fault."""
        observation, _, ended, infos = self.venv.step_wait()
        final = np.array(observation)
        tripped = np.zeros(self.num_envs)
        for lane in np.flatnonzero(ended):
            final[lane] = infos[lane]["terminal_observation"]
            tripped[lane] = not infos[lane]["TimeLimit.truncated"]
        rows = self._axes(final)
        change = rows[:, :, LAST_ACTION] - self._before
        cost = np.abs(rows[:, :, ERROR]) / self._error + self._effort * np.square(rows[:, :, CURRENT])
        reward = -np.mean(cost + self._smoothness * np.square(change), axis=1) - 100.0 * tripped
        self._before = self._axes(observation)[:, :, LAST_ACTION]
        return observation, reward.astype(np.float32), ended, infos

    def _axes(self, observation: Any) -> Any:
        axes = self.action_space.shape[0]
        return np.asarray(observation)[:, : AXIS_ENTRIES * axes].reshape(len(observation), axes, AXIS_ENTRIES)


class Logarithm(VecEnvWrapper):  # type: ignore[misc]
    """The logarithm of a reward, 0...1, scaled to 0...1: for a task with hardly any reward until an error is small.

    It is ln(1 + reward / least) / ln(1 + 1 / least), which grows as much from 0.01 to 0.1 as from 0.1 to 1.

    Args:
        venv: The VecEnv of a task of the suite.
        least: Reward below which it counts as about 0.
    """

    def __init__(self, venv: Any, least: float = 0.001) -> None:
        super().__init__(venv)
        if not 0.0 < least < 1.0:
            raise ValueError(f"least must lie in 0...1, not {least:g}")
        self._least = least

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        return self.venv.reset()

    def step_wait(self) -> tuple[Any, Any, Any, Any]:
        """Return the step with this reward instead of the environment's."""
        observation, reward, ended, infos = self.venv.step_wait()
        found = np.log1p(np.maximum(reward, 0.0) / self._least) / np.log1p(1.0 / self._least)
        return observation, found.astype(np.float32), ended, infos
