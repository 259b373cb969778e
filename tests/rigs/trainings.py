"""Trainings of a few steps, and the curves that a training writes."""

from __future__ import annotations

import pytest

from agents.tasks import environment_name
from agents.training import hyperparameters
from agents.training.training_run import TrainingRun

TINY = {"ServoDrive/Tracking-v0": {"duration": 0.01}, "ServoDrive/GainScheduling-v0": {"duration": 0.02},
        "ServoDrive/GainTuning-v0": {"trials": 1}}  # fmt: skip


def tiny(environment="tracking", algorithm="ppo", timesteps=192, **changes):
    """A run of the shipped hyper-parameters, shrunk."""
    name = environment_name(environment)
    given = hyperparameters.load(name, algorithm, "quick")
    hyperparameters.merge(
        given, {"n_envs": 4, "n_timesteps": timesteps, "env_kwargs": {**TINY[name], "num_threads": 1}}
    )
    given["imitate"] = None  # takes longer than all the rest
    small = {"learning_starts": 8, "buffer_size": 500, "batch_size": 16, "gradient_steps": 1}
    if "ppo" in algorithm:
        small = {"n_steps": 8, "batch_size": 16, "n_epochs": 2}
    hyperparameters.merge(given, small | changes)
    return TrainingRun(name, algorithm, given, seed=3, segments=4)


def write_events(folder, count):
    """Let TensorBoard's own writer write a training's curves."""
    pytest.importorskip("tensorboard", reason="the extra `agents` is not installed")
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

    writer = EventFileWriter(str(folder))
    for k in range(count):
        values = [
            Summary.Value(tag=tag, simple_value=k * f) for tag, f in (("rollout/ep_rew_mean", 2.0), ("loss", -1.0))
        ]
        writer.add_event(Event(step=100 * k, summary=Summary(value=values)))
    writer.close()
    return next(folder.glob("events.out.tfevents.*"))
