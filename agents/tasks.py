"""The environments for training agents, and functions that make them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

from agents.plain import plain
from drive_env.envs import environment_of, make_vector
from drive_env.envs.suite import TASKS as SUITE

if TYPE_CHECKING:
    from drive_env.envs.vector_environment import VectorEnvironment


OF_MACHINES = ("distributions", "privileged", "stage")  # options only for drawn machines


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
    """Return the full name of an environment or task from any spelling: tracking, Tracking-v0, ServoDrive/Tracking-v0.

    Raises:
        ValueError: For an unknown name, naming the known ones.
    """
    wanted = _letters(text)
    for name in (*ENVIRONMENTS, *SUITE):
        last = name.partition("/")[2]
        if wanted in (_letters(name), _letters(last), _letters(last.partition("-")[0])):
            return name
    raise ValueError(f"there is no environment {text!r}; there are {', '.join((*ENVIRONMENTS, *SUITE))}")


def row_of(environment: str) -> TrainingTask:
    """Return the row of ENVIRONMENTS for the full name of an environment or task; KeyError for an unknown one."""
    return ENVIRONMENTS[environment_of(environment)]


def short_name(environment: str) -> str:
    """Return an environment's or a task's name in names of files: without namespace and version."""
    if environment in ENVIRONMENTS:
        return ENVIRONMENTS[environment].short
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in environment.partition("/")[2].partition("-")[0])[1:]


def make_environments(
    environment: str, num_envs: int, configuration: Mapping[str, Any] | None = None, **options: Any
) -> VectorEnvironment:
    """Return a vectorised environment.

    Args:
        environment: Its name.
        num_envs: Number of environments.
        configuration: The environment's own options; a task of the suite takes none but its own.
        options: drives, sensor, autoreset_mode, render_mode, as for the environment. A task on given drives draws no
            machines.

    Raises:
        ValueError: For an unknown name or an invalid value.
    """
    name, own = environment_name(environment), dict(configuration or {})
    if name in SUITE and options.get("drives") is not None:
        name, own = environment_of(name), without_machines(name, own)
    if name in SUITE:
        whole = _whole_configuration(name)  # an agent's file contains all of it
        own = {key: value for key, value in own.items() if not _is_of_task(plain({key: value})[key], whole.get(key))}
        return make_vector(num_envs, name=name, **own, **options)
    return make_vector(num_envs, name=name, config=own, **options)


def _is_of_task(value: Any, whole: Any) -> bool:
    """Return whether an option equals the task's; an older agent's file may lack newer reward weights that are 0."""
    if isinstance(value, Mapping) and isinstance(whole, Mapping):
        return value == {key: one for key, one in whole.items() if key in value or one}
    return bool(value == whole)


def without_machines(environment: str, configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of an environment or task for given drives: those for drawn machines are left out."""
    own = SUITE[environment].options if environment in SUITE else {}
    return {key: value for key, value in {**own, **configuration}.items() if key not in OF_MACHINES}


def _whole_configuration(task: str) -> dict[str, Any]:
    """Return all options of a task of the suite for JSON, including defaults."""
    row = row_of(task)
    kind = getattr(importlib.import_module(f"drive_env.envs.{row.short}"), f"{row.kind}Config")
    table: dict[str, Any] = plain(asdict(kind(**SUITE[task].options)))
    return table


def configuration_of(lanes: Any) -> dict[str, Any]:
    """Return all options of an environment for JSON, including defaults."""
    table: dict[str, Any] = plain(asdict(lanes.config))
    return table


def _letters(text: str) -> str:
    return "".join(character for character in text.lower() if character.isalnum())
