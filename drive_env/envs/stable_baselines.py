"""Environments as a VecEnv of Stable-Baselines3, without copying: its arrays are the environments' own.

Needs stable-baselines3 (pip install stable-baselines3); nothing else in this package imports it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from drive_env.envs.vector_environment import Info, VectorEnvironment


class DriveVecEnv(VecEnv):  # type: ignore[misc]
    """Stable-Baselines3's view of environments with autoreset mode "SameStep".

    Observations, rewards and ends are passed on unchanged; infos are dicts with "terminal_observation",
    "TimeLimit.truncated", "fault" for environments that ended, otherwise empty. If the distributions have a curriculum,
    its stage follows the steps of all environments.

    Raises:
        ValueError: For environments of another autoreset mode, which SB3 does not know.
    """

    def __init__(self, vector: VectorEnvironment) -> None:
        if vector.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"Stable-Baselines3 needs autoreset_mode='SameStep', not {vector.autoreset_mode.value!r}")
        self.vector = vector
        self._actions: Any = None
        self._steps = 0
        self._follows = len(vector.curriculum.steps) > 1
        super().__init__(vector.num_envs, vector.single_observation_space, vector.single_action_space)

    def reset(self) -> Any:
        """Begin an episode in every environment, with the seeds and options given before."""
        seed = self._seeds[0] if self._seeds else None  # the others are only counted up from it
        options = self._options[0] if self._options and self._options[0] else None
        self._follow_curriculum()
        observation, told = self.vector.reset(seed=seed, options=options)
        self.reset_infos = [_of_environment(told, lane) for lane in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Any) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[Info]]:
        """Act in every environment."""
        self._steps += self.num_envs
        self._follow_curriculum()
        observation, reward, terminated, truncated, info = self.vector.step(self._actions)
        ended = terminated | truncated
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        if "final_obs" in info:
            for lane in np.flatnonzero(ended):
                infos[lane]["terminal_observation"] = info["final_obs"][lane]
                infos[lane]["TimeLimit.truncated"] = bool(truncated[lane] and not terminated[lane])
                fault = info["final_info"].get("fault")
                if fault is not None and fault[lane]:
                    infos[lane]["fault"] = fault[lane]
        return observation, reward.astype(np.float32), ended, infos

    def _follow_curriculum(self) -> None:
        if self._follows:
            self.vector.stage = self.vector.curriculum.stage_at(self._steps)

    def close(self) -> None:
        """Release drives and pictures."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments, once per requested environment."""
        return [getattr(self.vector, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environments."""
        setattr(self.vector, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environments once, and return its result once per requested environment."""
        result = getattr(self.vector, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that no environment is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[Any]:
        """Return a picture of every environment."""
        return list(self.vector.render() or ())


def _of_environment(info: Mapping[str, Any], lane: int) -> Info:
    found: Info = {}
    for key, value in info.items():
        if key.startswith("_") or value is None or (f"_{key}" in info and not info[f"_{key}"][lane]):
            continue
        found[key] = _of_environment(value, lane) if isinstance(value, Mapping) else value[lane]
    return found
