"""A policy that begins as a teacher: before PPO improves it, its network learns what the teacher does.

The teacher acts with the exploration noise that PPO will begin with, so that the critic learns the returns of that,
too: an untaught critic's first updates would undo what was imitated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

STEPS = 60_000  # of all lanes together
BATCH, UPDATES, LEARNING_RATE = 1024, 1200, 1e-3


def imitate(model: Any, teacher: Any, *, seed: int, steps: int = STEPS, updates: int = UPDATES) -> float:
    """Teach a model of PPO and return the RMS difference of its actions from the teacher's.

    Args:
        model: With its environment, the normaliser included, which learns its statistics here.
        teacher: What acts on the environment's own observations: `act(observations)`, `reset(mask)`.
        seed: Of the lanes and of the noise.
        steps: Of all lanes together.
        updates: Of the network.
    """
    import torch

    if hasattr(model.observation_space, "spaces"):
        raise ValueError("a teacher sees arrays; leave `imitate` or the critic's privileged observation out")
    env = model.get_env()
    rng = np.random.default_rng(seed)
    env.seed(seed)
    deviation = np.exp(model.policy.log_std.detach().numpy())
    low, high = model.action_space.low, model.action_space.high
    rows, actions, rewards, ends = _play(env, teacher, rng, deviation, (low, high), max(1, steps // env.num_envs))
    scale = np.sqrt(env.ret_rms.var + env.epsilon) if getattr(env, "norm_reward", False) else 1.0
    returns = _discounted(rewards / scale, ends, float(model.gamma))
    normalised = env.normalize_obs(rows) if hasattr(env, "normalize_obs") else rows
    inputs = torch.as_tensor(normalised.reshape(-1, rows.shape[-1]), dtype=torch.float32)
    wanted = torch.as_tensor(actions.reshape(-1, actions.shape[-1]), dtype=torch.float32)
    values = torch.as_tensor(returns.reshape(-1), dtype=torch.float32)
    policy = model.policy
    policy.set_training_mode(True)
    parameters = [value for name, value in policy.named_parameters() if name != "log_std"]
    optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for _ in range(updates):
        chosen = torch.from_numpy(rng.integers(0, len(inputs), BATCH))
        loss = (_mean(policy, inputs[chosen]) - wanted[chosen]).square().mean()
        loss = loss + 0.5 * (policy.predict_values(inputs[chosen]).flatten() - values[chosen]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()
    with torch.no_grad():
        return float((_mean(policy, inputs) - wanted).square().mean().sqrt())


def _mean(policy: Any, inputs: Any) -> Any:
    features = policy.extract_features(inputs, policy.pi_features_extractor)
    return policy.action_net(policy.mlp_extractor.forward_actor(features))


def _play(
    env: Any, teacher: Any, rng: np.random.Generator, deviation: Any, bounds: tuple[Any, Any], steps: int
) -> tuple[NDArray[Any], ...]:
    """Return observations, the teacher's actions, rewards and ends, each of shape (steps, lanes, ...)."""
    seen = env.reset()
    teacher.reset(None)
    found: tuple[list[Any], ...] = ([], [], [], [])
    for _ in range(steps):
        rows = np.array(env.get_original_obs() if hasattr(env, "get_original_obs") else seen)
        wanted = np.asarray(teacher.act(rows), np.float32)
        noise = deviation * rng.standard_normal(wanted.shape)
        seen, reward, ended, _ = env.step(np.clip(wanted + noise, *bounds).astype(np.float32))
        reward = env.get_original_reward() if hasattr(env, "get_original_reward") else reward
        if ended.any():
            teacher.reset(ended)
        for column, value in zip(found, (rows, wanted, reward, ended), strict=True):
            column.append(np.array(value))
    return tuple(np.stack(column) for column in found)


def _discounted(rewards: NDArray[Any], ends: NDArray[Any], discount: float) -> NDArray[Any]:
    """Return the sum of later rewards, discounted, up to the episode's end."""
    found = np.zeros_like(rewards, float)
    later = np.zeros(rewards.shape[1])
    for k in range(len(rewards) - 1, -1, -1):
        later = rewards[k] + discount * np.where(ends[k], 0.0, later)
        found[k] = later
    return found
