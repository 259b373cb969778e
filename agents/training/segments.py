"""The callback for training with Stable-Baselines3 in segments; imported only when a training begins, like SB3."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from agents.plain import plain
from agents.tasks import configuration_of
from agents.training import checkpoint
from agents.training.counted_environments import CountedEnvironments
from agents.training.learning_curve import draw_learning_curve
from agents.training.training_run import (
    CHECKPOINT,
    CURVE,
    TABLE,
    Progress,
    Report,
    TrainingRun,
    segment_length,
    segment_seed,
)
from agents.training.training_table import TrainingTable
from tuning.runs.inputs import as_kept, hashes, inputs_in
from tuning.runs.provenance import SOURCES

ROWS = 200  # of the table, about


class Segments(BaseCallback):  # type: ignore[misc]
    """Writes checkpoints, begins segments, reports progress."""

    def __init__(
        self,
        run: TrainingRun,
        folder: Path,
        lanes: CountedEnvironments,
        normaliser: Any,
        report: Report | None,
        resumed: bool,
    ) -> None:
        super().__init__()
        self._run, self._folder, self._lanes, self._normaliser = run, folder, lanes, normaliser
        self._report, self._resumed = report, resumed
        self._total = run.total
        self._length = segment_length(run, lanes)
        self._row_length = max(1, run.total // ROWS)
        self._segment = 0
        self._next_row = 0
        self._table: TrainingTable | None = None
        self._began = self._row_began = time.perf_counter()
        self._row_steps, self._row_seconds = 0, 0.0

    def _on_training_start(self) -> None:
        rollout = getattr(self.model, "n_steps", 1) * self._lanes.num_envs
        self._total = self.num_timesteps + -(-(self._run.total - self.num_timesteps) // rollout) * rollout
        self._segment = self.num_timesteps // self._length
        self._next_row = self.num_timesteps + self._row_length
        self._table = TrainingTable(self._folder / TABLE, keep=self.num_timesteps if self._resumed else 0)
        self._began = self._row_began = time.perf_counter()
        # An imitation's steps and the first reset do not count for the training's speed.
        self._row_steps, self._row_seconds = self._lanes.steps, self._lanes.seconds

    def _on_rollout_start(self) -> None:
        if self._resumed:
            self._resumed = False
            checkpoint.restore_random_states(self._folder / CHECKPOINT, self.model)
            self._begin_segment()
        elif self.num_timesteps // self._length > self._segment:
            self._segment = self.num_timesteps // self._length
            self._save()
            self._draw()
            self._begin_segment()
        if self.num_timesteps >= self._next_row:
            self._next_row = self.num_timesteps + self._row_length
            self._tell()

    def _on_step(self) -> bool:
        return True

    def finish(self) -> None:
        """Write the final files of a run."""
        self._save()
        if self.num_timesteps and self._lanes.steps > self._row_steps:
            self._tell()
        self._draw()

    def _draw(self) -> None:
        title = f"{self._run.environment}, {self._run.algorithm}, {self._run.preset}, seed {self._run.seed}"
        draw_learning_curve(self._folder / TABLE, self._folder / CURVE, title)

    def _save(self) -> None:
        checkpoint.save(
            self._folder / CHECKPOINT,
            self.model,
            self._normaliser,
            {
                "algorithm": self._run.algorithm,
                "environment": self._run.environment,
                "configuration": as_kept(configuration_of(self._lanes)),
                "timesteps": self.num_timesteps,
                "run": as_kept(plain(asdict(self._run))),
                "inputs": hashes(inputs_in(self._run.hyperparameters)),
                "sources": SOURCES,
            },
        )

    def _begin_segment(self) -> None:
        """Begin an episode in every environment, with the segment's seeds."""
        model = self.model
        env = model.get_env()
        env.seed(segment_seed(self._run.seed, self._segment))
        model._last_obs = env.reset()
        model._last_episode_starts = np.ones(env.num_envs, bool)
        if getattr(model, "_vec_normalize_env", None) is not None:
            model._last_original_obs = model._vec_normalize_env.get_original_obs()

    def _tell(self) -> None:
        now = time.perf_counter()
        spent = max(now - self._row_began, 1e-9)
        lanes = self._lanes
        progress = Progress(
            self.num_timesteps,
            self._total,
            lanes.episodes,
            lanes.episode_means(),
            lanes.take_terms(),
            (lanes.steps - self._row_steps) / spent,
            (lanes.seconds - self._row_seconds) / spent,
        )
        self._row_began, self._row_steps, self._row_seconds = now, lanes.steps, lanes.seconds
        for name, value in progress.means.items():
            self.logger.record(f"episode/{name}", value)
        for name, value in progress.terms.items():
            self.logger.record(f"reward_terms/{name}", value)
        self.logger.record("time/steps_per_s", progress.speed)
        self.logger.record("time/environment_share", progress.environment_share)
        if self._table is not None:
            self._table.add(
                {"timesteps": progress.timesteps, "seconds": round(now - self._began, 2)}
                | {"episodes": progress.episodes, **progress.means}
                | {f"term {name}": value for name, value in progress.terms.items()}
                | {"steps/s": progress.speed, "environment share": progress.environment_share}
            )
        if self._report is not None:
            self._report(progress)
