"""The suite of learning tasks: what is frozen, and that no task is won by a policy that has learnt nothing."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from agents.evaluation.evaluation import evaluate
from agents.policies.baselines import SUITE_TASKS, baseline
from agents.training.tasks import environment_name, make_environments
from drive_env.envs import make_vector
from drive_env.envs.suite import TASKS

MACHINES = 6
UNLEARNT, LEAST, MOST = 0.6, 0.7, 0.95  # score of what has learnt nothing at most; of the expert

# Policies that have learnt nothing: name -> action of every entry from error, step and generator.
PLAIN = {
    "zero": lambda error, rng: np.zeros_like(error),
    "random": lambda error, rng: rng.uniform(-1.0, 1.0, error.shape),
    "bang-bang": lambda error, rng: np.sign(error),
    **{f"constant {value:g}": lambda error, rng, value=value: np.full_like(error, value)
       for value in (-1.0, -0.5, -0.2, -0.05, 0.05, 0.1, 0.2, 0.5, 1.0)},
}  # fmt: skip


@pytest.mark.parametrize("name", TASKS)
def test_a_task_has_its_horizon_and_its_threshold_in_the_spec_and_takes_no_options(name):
    task = TASKS[name]
    with gymnasium.make(name) as env:
        assert env.spec.max_episode_steps == task.steps == env.unwrapped.vector.config.steps
        assert env.spec.reward_threshold == pytest.approx(task.solved * task.steps)
        assert np.all(env.action_space.low == -1.0) and np.all(env.action_space.high == 1.0)
    with pytest.raises(ValueError, match="is frozen and takes no 'speed'"):
        gymnasium.make(name, speed=1.0)
    assert environment_name(name.partition("/")[2].partition("-")[0]) == name


@pytest.mark.parametrize("name", TASKS)
def test_what_has_learnt_nothing_scores_less_than_0_6(name):
    lanes = make_vector(len(PLAIN) * MACHINES, name=name, autoreset_mode="NextStep")
    try:
        entries = lanes.single_action_space.shape[0]
        machines = list(range(MACHINES)) * len(PLAIN)  # every policy meets the same ones
        seen, _ = lanes.reset(seed=machines)
        rng = np.random.default_rng(0)
        total, going = np.zeros(lanes.num_envs), np.ones(lanes.num_envs, bool)
        for _ in range(TASKS[name].steps):
            errors = seen[:, : 8 * entries].reshape(len(PLAIN), MACHINES, entries, 8)[..., 0]
            action = np.stack([act(error, rng) for act, error in zip(PLAIN.values(), errors, strict=True)])
            seen, reward, terminated, _, _ = lanes.step(action.reshape(-1, entries).astype(np.float32))
            assert np.all((reward >= 0.0) & (reward <= 1.0))
            total += np.where(going, reward, 0.0)
            going &= ~terminated
    finally:
        lanes.close()
    scores = dict(zip(PLAIN, total.reshape(len(PLAIN), MACHINES).mean(axis=1) / TASKS[name].steps, strict=True))
    assert max(scores.values()) < UNLEARNT, scores


@pytest.mark.parametrize("name", TASKS)
def test_the_cascade_scores_less_than_0_6_and_the_expert_0_7_to_0_95(name):
    scores = {}
    for row in SUITE_TASKS[name]:
        lanes = make_environments(name, 1)
        policy = baseline(row, name, lanes.config, lanes.single_action_space.shape[0])
        lanes.close()
        found = evaluate(policy, name, episodes=24, seed=3_000_000)
        scores[row] = float(np.mean([episode.rewards.sum() for episode in found.episodes])) / TASKS[name].steps
    assert LEAST <= scores.pop("expert") <= MOST
    assert max(scores.values()) < UNLEARNT + 0.02, scores
