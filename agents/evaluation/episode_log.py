"""Recorded episodes in a file, and a policy's actions in them, which are equal for the same policy."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.evaluation.scores import Episode
from agents.plain import plain
from agents.policies.guard import PATIENT, GuardedPolicy
from drive_env.whole_file import write_arrays
from mechanics.arrays import Mask, Singles
from mechanics.reading.untrusted import parse_json, read_arrays
from tuning.runs.inputs import as_kept


class EpisodeRecording(NamedTuple):
    """Episodes as seen by a policy: observations (steps, entries) and actions (steps, actions) of each, and seeds."""

    environment: str
    configuration: dict[str, Any]
    seeds: list[int]
    observations: list[Singles]
    actions: list[Singles]


class Repeated(NamedTuple):
    """A policy's actions on recorded observations: largest and RMS difference from the recorded actions."""

    largest: float
    rms: float
    steps: int


def save(path: Path, environment: str, configuration: dict[str, Any], episodes: Sequence[Episode]) -> None:
    """Write episodes to an .npz."""
    about = {"environment": environment, "configuration": plain(as_kept(configuration))}
    about |= {"seeds": [episode.seed for episode in episodes]}
    terminated, truncated = ends_of(episodes)
    arrays = {
        "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
        "lengths": np.array([len(episode.actions) for episode in episodes]),
        "observations": np.concatenate([episode.observations[:-1] for episode in episodes]).astype(np.float32),
        "actions": np.concatenate([episode.actions for episode in episodes]).astype(np.float32),
        "rewards": np.concatenate([episode.rewards for episode in episodes]),
        "terminations": terminated,
        "truncations": truncated,
        "final_observations": np.stack([episode.observations[-1] for episode in episodes]).astype(np.float32),
    }
    write_arrays(path, arrays)


def ends_of(episodes: Sequence[Episode]) -> tuple[Mask, Mask]:
    """Return which steps of all episodes, one after the other, terminated one, and which truncated one."""
    lengths = [len(episode.actions) for episode in episodes]
    is_last = np.zeros(sum(lengths), bool)
    is_last[np.cumsum(lengths) - 1] = True
    terminated = is_last & np.repeat([episode.terminated for episode in episodes], lengths)
    return terminated, is_last & ~terminated


def load(path: Path) -> EpisodeRecording:
    """Read a recording of `save`.

    Raises:
        ValueError: If the file is not a recording.
    """
    try:
        stored = read_arrays(path)
        about = parse_json(bytes(stored["about"]))
        lengths = [int(length) for length in stored["lengths"]]
        rows = [stored[name].astype(np.float32) for name in ("observations", "actions")]
        if not lengths or min(lengths) < 0 or any(one.ndim != 2 or len(one) != sum(lengths) for one in rows):
            raise ValueError("its arrays do not fit each other")
        if not all(np.isfinite(one).all() for one in rows):
            raise ValueError("it has values that are not numbers")
        observations, actions = (np.split(one, np.cumsum(lengths)[:-1]) for one in rows)
        configuration, seeds = dict(about["configuration"]), [int(seed) for seed in about["seeds"]]
        return EpisodeRecording(str(about["environment"]), configuration, seeds, observations, actions)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    except (OSError, KeyError, ValueError, TypeError, OverflowError) as error:
        raise ValueError(
            f"{path} has no episodes ({error}); give the episodes.npz of `drive-agent evaluate --out`"
        ) from None


def repeat(policy: Any, recording: EpisodeRecording, told: Callable[[float], None] = lambda share: None) -> Repeated:
    """Return the difference of a policy's actions on the recorded observations from the recorded ones.

    Args:
        policy: The policy.
        recording: The recording to compare with.
        told: Called with the finished share, episode by episode.

    Raises:
        PolicyStoppedError: If the policy fails on a recorded observation, or gives another number of actions.
    """
    unused = np.zeros(recording.actions[0].shape[1])  # never used: a stuck policy is stuck in the recording, too
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
