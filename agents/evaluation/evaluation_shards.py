"""Episodes of a policy on processes and clusters, with the same results as in this process: each round is a task."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from agents.evaluation.evaluation import Evaluation, environments_for, evaluate, summary
from agents.evaluation.open_policy import names_a_file, opened, source_of
from agents.evaluation.scores import Episode
from agents.tasks import configuration_of, environment_name, make_environments
from mechanics.reading.untrusted import MOST_ARRAYS, read_bytes
from tuning.runs.inputs import taken_options

if TYPE_CHECKING:
    from tuning.runs.pools import Pool


class Written(NamedTuple):
    """A policy's name and the content of its file, so that it can be opened on another machine.

    Attributes:
        text: Its name.
        content: Content of the named file, None if it is not a file.
        source: Hash of the file of the Python function that the text names, "" for other texts: it is not sent, and the
            other machine must have the same.
        trust: As for `open_policy`.
    """

    text: str
    content: bytes | None
    trust: bool
    source: str = ""

    @classmethod
    def of(cls, text: str, trust: bool) -> Written:
        """Read the policy named by a text."""
        content = read_bytes(text, MOST_ARRAYS) if names_a_file(text) else None
        return cls(text, content, trust, source_of(text) if content is None else "")

    @property
    def sha256(self) -> str:
        """Hash of its file, or of the file of its function; "" for a policy of the package."""
        return self.source if self.content is None else hashlib.sha256(self.content).hexdigest()

    def open(self, environment: str, configuration: Mapping[str, Any]) -> Any:
        """Return the policy, or the baseline, in an environment with these options."""
        if self.content is None:
            if (own := source_of(self.text)) != self.source:
                raise ValueError(
                    f"{self.text}: a worker's file with it has hash {own[:16]}, here it has {self.source[:16]}; give "
                    "the worker the same file, in the folder where it was started, or evaluate in this process"
                )
            return opened(self.text, environment, configuration, trust=self.trust).policy
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / Path(self.text).name
            path.write_bytes(self.content)
            return opened(str(path), environment, configuration, trust=self.trust).policy


class _Round(NamedTuple):
    policy: Written
    environment: str
    configuration: dict[str, Any]
    seed: int  # of the first episode
    episodes: int
    at_once: int


def _run(task: _Round) -> list[Episode]:
    policy = task.policy.open(task.environment, task.configuration)
    return evaluate(
        policy, task.environment, task.configuration, episodes=task.episodes, seed=task.seed, at_once=task.at_once
    ).episodes


def _is_of(task: _Round, found: Any) -> bool:
    seeds = [episode.seed for episode in found if len(episode.observations) == len(episode.actions) + 1]
    return seeds == list(range(task.seed, task.seed + task.episodes))


def evaluate_elsewhere(
    policy: Written,
    environment: str,
    configuration: Mapping[str, Any],
    pool: Pool,
    *,
    name: str,
    episodes: int,
    seed: int,
    told: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Run episodes on emulated machines and return the evaluation, as `evaluate` does, on any pool."""
    environment, options = environment_name(environment), taken_options(configuration)
    at_once = environments_for(episodes)
    rounds = [
        _Round(policy, environment, options, seed + first, min(at_once, episodes - first), at_once)
        for first in range(0, episodes, at_once)
    ]
    found: dict[int, list[Episode]] = {}
    for k, recorded in pool.unordered(_run, rounds, fits=_is_of):
        found[k] = recorded
        told(len(found) / len(rounds))
    lanes: Any = make_environments(environment, 1, options)
    config, complete = lanes.config, configuration_of(lanes)
    lanes.close()
    every = [episode for k in range(len(rounds)) for episode in found[k]]
    return summary(every, config, complete, environment, name, "emulator")
