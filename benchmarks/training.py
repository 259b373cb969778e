"""Figures of training: PPO as `drive-agent train` runs it, and the environment's share of its time."""

from __future__ import annotations

import tempfile
from importlib.util import find_spec
from typing import Any

# Environment, section of its hyper-parameters (None for the environment's own), rollouts.
TRAININGS = (("ServoDrive/Tracking-v0", "two_mass", 8), ("ServoDrive/GainTuning-v0", None, 3))
CORES = 2


def training(environment: str, section: str | None, rollouts: int) -> dict[str, float]:
    """Return steps/s of the fastest rollout with its update, and the share of its time that the environment took."""
    from agents.training import hyperparameters
    from agents.training.train import train
    from agents.training.training_run import Progress, TrainingRun

    given = hyperparameters.load(environment, "ppo", "quick", section=section)
    given["n_timesteps"] = rollouts * given["n_envs"] * given["n_steps"]
    given["imitate"] = None  # that is before the training
    from drive_env.cores import usable_cores

    cores = min(CORES, usable_cores())
    hyperparameters.merge(given, {"env_kwargs": {"num_threads": cores}})
    told: list[Progress] = []
    with tempfile.TemporaryDirectory() as folder:
        # No checkpoint but the last: a short run has as many as a long one.
        train(TrainingRun(environment, "ppo", given, segments=1), folder, report=told.append)
    fastest = max(told, key=lambda progress: progress.speed)
    load, lanes = given["env_kwargs"]["load"], given["n_envs"]
    name = f"PPO, {environment.partition('/')[2]}, {load}, {lanes} environments, {cores} threads"
    return {
        f"{name}: steps/s": fastest.speed,
        f"{name}: the environment's share of wall time": fastest.environment_share,
    }


def figures() -> dict[str, float]:
    """Return all figures of training; none without Stable-Baselines3."""
    found: dict[str, Any] = {}
    if find_spec("stable_baselines3") is not None:
        for row in TRAININGS:
            found |= training(*row)
    return found


if __name__ == "__main__":
    for name, figure in figures().items():
        print(f"{name:90} {figure:12,.3f}")
