"""The result of a run of the benchmark, `<task>/<policy>/<seed>/result.json`: a row that can be checked.

Its digest is over all else in it. That shows a file that was torn or changed; anybody can make a new digest, so it says
nothing of who made the row. What proves the scores is to run the episodes again (`check`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from agents.seeds import TEST
from drive_env.envs.suite import TASKS
from drive_env.whole_file import content_hash
from mechanics.reading.untrusted import read_json

RESULT = "result.json"
TRAINED, SUBMITTED, BASELINE = "trained", "submitted", "baseline"


class RowError(ValueError):
    """A file is no row of the benchmark, or was changed; the message says which."""


@dataclass(frozen=True)
class Row:
    """A policy's scores in the held-out episodes of a task.

    Attributes:
        task: Name of the task.
        policy: Name of the algorithm, of the baseline, or of the submitted policy.
        kind: TRAINED, SUBMITTED or BASELINE.
        seed: Of the training; 0 for a row that was not trained here.
        opened: What names the policy for `open_policy`: a file beside the row, a Python function or a baseline.
        policy_sha256: Of that file, or of the function's; "" for a baseline, which is in the package's sources.
        seeds: Of the first and of the last episode.
        scores: Of the episodes: the sum of rewards over the horizon, 0...1.
        ended_early: Episodes that a fall or a trip ended.
        steps: Of the training, all environments together.
        hyperparameters: Of the training.
        cpu_seconds: Of the training, and of the episodes.
        versions: What made it.
    """

    task: str
    policy: str
    kind: str
    seed: int
    opened: str
    policy_sha256: str
    seeds: list[int]
    scores: list[float]
    ended_early: int
    steps: int = 0
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """Return the file's text, the digest last."""
        content = asdict(self)
        return json.dumps({**content, "digest": content_hash(content)}, indent=1)

    @classmethod
    def load(cls, path: Path) -> Row:
        """Read a row.

        Raises:
            RowError: If the file is not a row, or its digest does not match its content.
        """
        try:
            table: dict[str, Any] = read_json(path)
            digest = table.pop("digest")
            row = cls(**table)
            sound = len(row.scores) == row.seeds[1] - row.seeds[0] + 1 > 0
            sound = sound and row.task in TASKS and row.seeds[0] in TEST and row.seeds[1] in TEST
            # Names of files beside it, never a path that leads elsewhere.
            sound = sound and all(name == Path(name).name for name in (row.opened, row.policy))
            sound = sound and all(isinstance(score, float) for score in row.scores)
        except OSError as error:
            raise RowError(f"{path} cannot be read: {error.strerror}") from None
        except (ValueError, KeyError, TypeError, AttributeError, IndexError):
            sound = False
        if not sound:
            raise RowError(f"{path} is not a row of the benchmark; give a {RESULT} that drive-agent benchmark wrote")
        if digest != content_hash(table):
            raise RowError(f"{path} was changed since it was written: its digest is not that of its content")
        return row
