"""The result of a run of the benchmark, `<task>/<policy>/<seed>/result.json`: a row that can be checked.

Its digest covers all other content, and reveals a truncated or changed file; since anyone can compute a digest, it does
not prove the row's origin. Only running the episodes again (`check`) proves the scores.
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
    """A file is not a row of the benchmark, or was changed; the message says which."""


@dataclass(frozen=True)
class Row:
    """A policy's scores in the held-out episodes of a task.

    Attributes:
        task: Name of the task.
        policy: Name of the algorithm, of the baseline, or of the submitted policy.
        kind: TRAINED, SUBMITTED or BASELINE.
        seed: Seed of the training; 0 for a row that was not trained here.
        opened: The policy's name for `open_policy`: a file beside the row, a Python function or a baseline.
        policy_sha256: Hash of that file, or of the function's; "" for a baseline, which is in the package's sources.
        seeds: Seeds of the first and of the last episode.
        scores: Scores of the episodes: the sum of rewards over the horizon, 0...1.
        ended_early: Episodes that a fall or a trip ended.
        steps: Steps of the training, all environments together.
        hyperparameters: Hyper-parameters of the training.
        cpu_seconds: CPU time of the training, and of the episodes.
        versions: Versions of the packages used.
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
            # Names of files beside it, never a path elsewhere.
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
