"""Recorded episodes as a dataset of Minari, the format of Gymnasium's makers for offline reinforcement learning."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import gymnasium

from agents.evaluation.episode_log import ends_of

if TYPE_CHECKING:
    from agents.evaluation.evaluation import Evaluation


def check_name(name: str) -> None:
    """Raise ValueError, before any episode, if no dataset of this name can be written."""
    minari = _minari()
    try:
        minari.dataset.minari_dataset.parse_dataset_id(name)
    except ValueError:
        raise ValueError(f"--minari {name}: a dataset's name has a version, as servo/tracking-v0") from None
    if name in minari.list_local_datasets():
        raise ValueError(f"--minari {name}: there is such a dataset; give another version, or minari delete {name}")


def save(name: str, found: Evaluation) -> None:
    """Write the episodes of an evaluation to Minari's folder, with the environment for `recover_environment`."""
    minari: Any = _minari()
    terminated, truncated = ends_of(found.episodes)
    buffers: list[Any] = []
    with gymnasium.make(f"drive_env:{found.environment}", config=found.configuration) as env, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it asks for an author and an address, which are unknown here
        space = env.observation_space
        first = 0
        for number, episode in enumerate(found.episodes):
            steps = slice(first, first := first + len(episode.actions))
            buffers.append(
                minari.data_collector.EpisodeBuffer(
                    id=number, seed=episode.seed, observations=episode.observations, actions=episode.actions,
                    rewards=episode.rewards, terminations=terminated[steps], truncations=truncated[steps],
                )
            )  # fmt: skip
        minari.create_dataset_from_buffers(
            name, buffers, env=env, algorithm_name=found.policy, requirements=["drive-env"],
            observation_space=space["observation"] if isinstance(space, gymnasium.spaces.Dict) else space,
        )  # fmt: skip


def _minari() -> Any:
    try:
        import h5py  # noqa: F401 - what Minari writes with
        import minari
        import minari.data_collector
        import minari.dataset.minari_dataset
    except ImportError as error:
        raise ValueError(f"--minari needs Minari ({error}): pip install 'drive-env[minari]'") from None
    return minari
