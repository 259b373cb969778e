"""The Gymnasium environments; `import drive_env` registers them, and each is imported only when one is made.

Each has a file with its vector environment, a class of `vector_environment.VectorEnvironment`; the single environment
is a view of it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


class EnvironmentRow(NamedTuple):
    """File and class of a vector environment, and the return from which Gymnasium's users count it as solved.

    The steps of an episode are the configuration's: an environment tells them in its `spec` once it is made.
    """

    module: str
    kind: str
    reward_threshold: float | None = None


ENVIRONMENTS = {
    "ServoDrive/GainTuning-v0": EnvironmentRow("gain_tuning", "GainTuning"),
    "ServoDrive/GainScheduling-v0": EnvironmentRow("gain_scheduling", "GainScheduling"),
    "ServoDrive/Tracking-v0": EnvironmentRow("tracking", "Tracking"),
}


def register() -> None:
    """Register the environments with Gymnasium, once."""
    for name, row in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"drive_env.envs:make_{row.module}",
                vector_entry_point=f"drive_env.envs.{row.module}:{row.kind}",
                reward_threshold=row.reward_threshold,
            )


def make_vec_env(name: str, num_envs: int = 8, **options: Any) -> VecEnv:
    """Return a VecEnv of Stable-Baselines3, with the episodes' returns for its log.

    Args:
        name: As it is registered, e.g. "ServoDrive/Tracking-v0".
        num_envs: Number of environments.
        options: Of the environment.

    Raises:
        ValueError: For a name that is none; ImportError without Stable-Baselines3 (the extra `agents`).
    """
    if name not in ENVIRONMENTS:
        from mechanics.near_names import did_you_mean  # not before `commands` has looked whose `mechanics` that is

        near = did_you_mean(name, ENVIRONMENTS)
        raise ValueError(f"there is no environment {name!r}{near}; there are {', '.join(ENVIRONMENTS)}")
    try:
        from stable_baselines3.common.vec_env import VecMonitor

        from drive_env.envs.stable_baselines import DriveVecEnv
    except ImportError as error:
        raise ImportError(f"make_vec_env needs Stable-Baselines3 ({error}): pip install 'drive-env[agents]'") from None
    row = ENVIRONMENTS[name]
    lanes = getattr(importlib.import_module(f"drive_env.envs.{row.module}"), row.kind)
    return VecMonitor(DriveVecEnv(lanes(num_envs, autoreset_mode="SameStep", **options)))


def make_gain_tuning(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return a single GainTuning environment."""
    from drive_env.envs.gain_tuning import GainTuning
    from drive_env.envs.vector_environment import SingleEnvironment

    return SingleEnvironment(GainTuning(1, autoreset_mode="Disabled", **options))


def make_gain_scheduling(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return a single GainScheduling environment."""
    from drive_env.envs.gain_scheduling import GainScheduling
    from drive_env.envs.vector_environment import SingleEnvironment

    return SingleEnvironment(GainScheduling(1, autoreset_mode="Disabled", **options))


def make_tracking(**options: Any) -> gymnasium.Env[Any, Any]:
    """Return a single Tracking environment."""
    from drive_env.envs.tracking import Tracking
    from drive_env.envs.vector_environment import SingleEnvironment

    return SingleEnvironment(Tracking(1, autoreset_mode="Disabled", **options))
