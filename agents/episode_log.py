"""Recorded episodes in a file, and what a policy would have done in them: the same, if it is the same policy."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.bundle import plain
from agents.guard import PATIENT, GuardedPolicy
from agents.scores import Episode


class Recording(NamedTuple):
    """Episodes as a policy saw them: observations (steps, entries) and actions (steps, actions) of each, and seeds."""

    environment: str
    configuration: dict[str, Any]
    seeds: list[int]
    observations: list[NDArray[np.float32]]
    actions: list[NDArray[np.float32]]


class Repeated(NamedTuple):
    """What a policy does with recorded observations: largest and RMS difference from the recorded actions."""

    largest: float
    rms: float
    steps: int


def save(path: Path, environment: str, configuration: dict[str, Any], episodes: Sequence[Episode]) -> None:
    """Write episodes to an .npz."""
    about = {"environment": environment, "configuration": plain(configuration)}
    about |= {"seeds": [episode.seed for episode in episodes]}
    np.savez_compressed(
        path,
        about=np.frombuffer(json.dumps(about).encode(), np.uint8),
        lengths=np.array([len(episode.actions) for episode in episodes]),
        observations=np.concatenate([episode.observations[:-1] for episode in episodes]).astype(np.float32),
        actions=np.concatenate([episode.actions for episode in episodes]).astype(np.float32),
    )


def load(path: Path) -> Recording:
    """Read what `save` wrote.

    Raises:
        ValueError: If the file is none.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            about = json.loads(bytes(stored["about"]).decode())
            ends = np.cumsum(stored["lengths"])[:-1]
            observations, actions = (np.split(stored[name], ends) for name in ("observations", "actions"))
        return Recording(about["environment"], about["configuration"], about["seeds"], observations, actions)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        raise ValueError(f"{path} holds no episodes; give the episodes.npz of `drive-agent evaluate --out`") from None


def repeat(policy: Any, recording: Recording, told: Callable[[float], None] = lambda share: None) -> Repeated:
    """Return how far a policy's actions on the recorded observations lie from the recorded ones.

    Args:
        policy: What acts.
        recording: What it is compared with.
        told: Is told the share that is done, episode by episode.

    Raises:
        PolicyStoppedError: If the policy fails on what was recorded, or gives another number of actions.
    """
    unused = np.zeros(recording.actions[0].shape[1])  # nobody looks at it: what sticks does so in the recording, too
    watched = GuardedPolicy(policy, unused, unused, 0.0, PATIENT)
    largest, squares, count = 0.0, 0.0, 0
    try:
        for number, (observations, actions) in enumerate(zip(recording.observations, recording.actions, strict=True)):
            told(number / len(recording.actions))
            watched.reset(None)
            for seen, done in zip(observations, actions, strict=True):
                difference = np.asarray(watched.act(seen[None]), float).reshape(-1) - done
                largest = max(largest, float(np.abs(difference).max()))
                squares += float(np.mean(np.square(difference)))
                count += 1
    finally:
        watched.close()
    return Repeated(largest, float(np.sqrt(squares / max(count, 1))), count)
