"""The environments that agents are trained in, and how they are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from drive_env.envs.vector_environment import VectorEnvironment


class TrainingTask(NamedTuple):
    """An environment.

    short: Name of its files, and of its module in drive_env.envs.
    kind: Its class there.
    steps: Steps of an episode, from its configuration.
    """

    short: str
    kind: str
    steps: Callable[[Any], int]


ENVIRONMENTS = {
    "ServoDrive/GainTuning-v0": TrainingTask("gain_tuning", "GainTuning", lambda config: int(config.trials)),
    "ServoDrive/GainScheduling-v0": TrainingTask(
        "gain_scheduling", "GainScheduling", lambda config: round(config.duration / config.step)
    ),
    "ServoDrive/Tracking-v0": TrainingTask("tracking", "Tracking", lambda config: int(config.steps)),
}


def environment_name(text: str) -> str:
    """Return the full name of an environment from any spelling: tracking, Tracking-v0, ServoDrive/Tracking-v0.

    Raises:
        ValueError: If there is none, naming those that are.
    """
    wanted = _letters(text)
    for name, task in ENVIRONMENTS.items():
        if wanted in (_letters(name), _letters(name.partition("/")[2]), _letters(task.short)):
            return name
    raise ValueError(f"there is no environment {text!r}; there are {', '.join(ENVIRONMENTS)}")


def make_environments(
    environment: str, num_envs: int, configuration: Mapping[str, Any] | None = None, **options: Any
) -> VectorEnvironment:
    """Return a vectorised environment.

    Args:
        environment: Its name.
        num_envs: Number of environments.
        configuration: The environment's own options.
        options: drives, sensor, autoreset_mode, render_mode, as the environment takes them.

    Raises:
        ValueError: For a name or a value that is none.
    """
    import importlib

    task = ENVIRONMENTS[environment_name(environment)]
    kind = getattr(importlib.import_module(f"drive_env.envs.{task.short}"), task.kind)
    made: VectorEnvironment = kind(num_envs, config=dict(configuration or {}), **options)
    return made


def configuration_of(lanes: Any) -> dict[str, Any]:
    """Return all options of an environment for JSON, defaults too."""
    from dataclasses import asdict

    from agents.policies.agent_file import plain

    table: dict[str, Any] = plain(asdict(lanes.config))
    return table


def _letters(text: str) -> str:
    return "".join(character for character in text.lower() if character.isalnum())
