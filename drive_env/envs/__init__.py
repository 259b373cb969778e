"""The Gymnasium environments; `import drive_env` registers them, and each is imported only when one is made.

Each of ENVIRONMENTS has a file with its vector environment, a class of `vector_environment.VectorEnvironment`; the
single environment is a view of it. The tasks of the suite (`suite.TASKS`) are configurations of these.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium

from drive_env.envs.suite import TASKS, task_options

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    from drive_env.envs.vector_environment import VectorEnvironment

# Name -> file and class of the vector environment.
ENVIRONMENTS = {
    "ServoDrive/GainTuning-v0": ("gain_tuning", "GainTuning"),
    "ServoDrive/GainScheduling-v0": ("gain_scheduling", "GainScheduling"),
    "ServoDrive/Tracking-v0": ("tracking", "Tracking"),
}
# Further arguments of a vector environment, besides its configuration's options.
_AROUND = ("config", "drives", "sensor", "reach", "autoreset_mode", "render_mode", "reward")


def register() -> None:
    """Register the environments and the tasks of the suite with Gymnasium, once."""
    for name in (*ENVIRONMENTS, *TASKS):
        if name not in gymnasium.registry:
            task = TASKS.get(name)
            gymnasium.register(
                name,
                entry_point="drive_env.envs:make_single",
                vector_entry_point="drive_env.envs:make_vector",
                reward_threshold=None if task is None else task.solved * task.steps,
                kwargs={"name": name},
            )


def environment_of(name: str) -> str:
    """Return the configurable environment of a name: that of a task, or the environment itself.

    Raises:
        ValueError: For an unknown name.
    """
    if name in TASKS:
        return TASKS[name].environment
    if name in ENVIRONMENTS:
        return name
    from mechanics.reading.near_names import did_you_mean  # after `commands` has checked `mechanics`

    known = (*ENVIRONMENTS, *TASKS)
    raise ValueError(f"there is no environment {name!r}{did_you_mean(name, known)}; there are {', '.join(known)}")


def make_vector(num_envs: int = 1, *, name: str, **options: Any) -> VectorEnvironment:
    """Return a vector environment.

    Args:
        num_envs: Number of environments.
        name: Name of a configurable environment or of a task of the suite.
        options: drives, sensor, reach, autoreset_mode, render_mode and reward as for the environment, and the fields of
            its configuration; for a task only num_threads.

    Raises:
        ValueError: For an unknown name, or an option that the task or environment does not have.
    """
    module, kind = ENVIRONMENTS[environment_of(name)]
    if name in TASKS:
        around = {key: options.pop(key) for key in _AROUND[1:] if key in options}
        options = around | task_options(name, options)
    made: VectorEnvironment = getattr(importlib.import_module(f"drive_env.envs.{module}"), kind)(num_envs, **options)
    return made


def make_single(*, name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """Return a single environment; arguments as for `make_vector`."""
    from drive_env.envs.vector_environment import SingleEnvironment

    return SingleEnvironment(make_vector(1, name=name, autoreset_mode="Disabled", **options))


def make_vec_env(name: str, num_envs: int = 8, **options: Any) -> VecEnv:
    """Return a VecEnv of Stable-Baselines3, with the episodes' returns for its log.

    Args:
        name: Its registered name, e.g. "ServoDrive/GantryBeam-v1".
        num_envs: Number of environments.
        options: Options of the environment.

    Raises:
        ValueError: For an unknown name; ImportError without Stable-Baselines3 (the extra `agents`).
    """
    environment_of(name)
    try:
        from stable_baselines3.common.vec_env import VecMonitor

        from drive_env.envs.stable_baselines import DriveVecEnv
    except ImportError as error:
        raise ImportError(f"make_vec_env needs Stable-Baselines3 ({error}): pip install 'drive-env[agents]'") from None
    return VecMonitor(DriveVecEnv(make_vector(num_envs, name=name, autoreset_mode="SameStep", **options)))
