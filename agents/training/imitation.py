"""Imitation of a teacher: before PPO improves a policy, its network learns the teacher's actions.

The teacher acts with PPO's initial exploration noise, so that the critic learns the returns of noisy actions, too: the
first updates by an untrained critic would undo the imitation.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policies.policy import ACTOR

STEPS = 60_000  # of all environments together
BATCH, UPDATES, LEARNING_RATE = 1024, 1200, 1e-3
PLAYING = 0.9  # share of the time for playing, about


def imitate(
    model: Any,
    teacher: Any,
    *,
    seed: int,
    steps: int = STEPS,
    updates: int = UPDATES,
    told: Callable[[float], None] = lambda share: None,
) -> float:
    """Teach a model of PPO and return the RMS difference of its actions from the teacher's.

    A critic that sees more than the actor learns from all its entries; the teacher sees the actor's.

    Args:
        model: The model with its environment; the normaliser learns its statistics here.
        teacher: The teacher, which acts on the environment's own observations: `act(observations)`, `reset(mask)`.
        seed: Seed of the environments and of the noise.
        steps: Steps of all environments together.
        updates: Updates of the network.
        told: Called with the finished share, 0...1.
    """
    import torch

    env = model.get_env()
    rng = np.random.default_rng(seed)
    env.seed(seed)
    deviation = np.exp(model.policy.log_std.detach().numpy())
    low, high = model.action_space.low, model.action_space.high
    rows, actions, rewards, ends = _play(env, teacher, rng, deviation, (low, high), max(1, steps // env.num_envs), told)
    scale = np.sqrt(env.ret_rms.var + env.epsilon) if getattr(env, "norm_reward", False) else 1.0
    returns = _discounted(rewards / scale, ends, float(model.gamma))
    normalised = env.normalize_obs(rows) if hasattr(env, "normalize_obs") else rows

    def tensor(columns: NDArray[Any]) -> Any:
        return torch.as_tensor(columns.reshape(-1, columns.shape[-1]), dtype=torch.float32)

    inputs, wanted = _each(normalised, tensor), tensor(actions)
    values = torch.as_tensor(returns.reshape(-1), dtype=torch.float32)
    policy = model.policy
    policy.set_training_mode(True)
    parameters = [value for name, value in policy.named_parameters() if name != "log_std"]
    optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for _ in range(updates):
        chosen = torch.from_numpy(rng.integers(0, len(wanted), BATCH))
        batch = _each(inputs, itemgetter(chosen))
        loss = (_mean(policy, batch) - wanted[chosen]).square().mean()
        loss = loss + 0.5 * (policy.predict_values(batch).flatten() - values[chosen]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()
    told(1.0)
    with torch.no_grad():
        return float((_mean(policy, inputs) - wanted).square().mean().sqrt())


def _mean(policy: Any, inputs: Any) -> Any:
    features = policy.extract_features(inputs, policy.pi_features_extractor)
    return policy.action_net(policy.mlp_extractor.forward_actor(features))


def _each(observations: Any, function: Callable[[Any], Any]) -> Any:
    """Return a function of an observation's array, or of every array of a dict."""
    if isinstance(observations, dict):
        return {key: function(rows) for key, rows in observations.items()}
    return function(observations)


def _play(
    env: Any,
    teacher: Any,
    rng: np.random.Generator,
    deviation: Any,
    bounds: tuple[Any, Any],
    steps: int,
    told: Callable[[float], None],
) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return observations, the teacher's actions, rewards and ends, each of shape (steps, environments, ...)."""
    seen = env.reset()
    teacher.reset(None)
    _tell(teacher, env, np.ones(env.num_envs, bool))
    observations: list[Any] = []
    found: tuple[list[Any], ...] = ([], [], [])
    for step in range(steps):
        told(PLAYING * step / steps)
        rows = _each(env.get_original_obs() if hasattr(env, "get_original_obs") else seen, np.array)
        wanted = np.asarray(teacher.act(rows[ACTOR] if isinstance(rows, dict) else rows), np.float32)
        noise = deviation * rng.standard_normal(wanted.shape)
        seen, reward, ended, _ = env.step(np.clip(wanted + noise, *bounds).astype(np.float32))
        reward = env.get_original_reward() if hasattr(env, "get_original_reward") else reward
        if ended.any():
            teacher.reset(ended)
            _tell(teacher, env, ended)
        observations.append(rows)
        for column, value in zip(found, (wanted, reward, ended), strict=True):
            column.append(np.array(value))
    if isinstance(observations[0], dict):
        stacked: Any = {key: np.stack([rows[key] for rows in observations]) for key in observations[0]}
    else:
        stacked = np.stack(observations)
    actions, rewards, ends = (np.stack(column) for column in found)
    return stacked, actions, rewards, ends


def _tell(teacher: Any, env: Any, mask: Any) -> None:
    """Notify a teacher that has `told` of the machines whose episodes begin where the mask is true.

    The network, without this knowledge, learns such a teacher's average action over the machines.
    """
    if hasattr(teacher, "told"):
        teacher.told(env.get_attr("told")[0]["parameters"], mask)


def _discounted(rewards: NDArray[Any], ends: NDArray[Any], discount: float) -> NDArray[Any]:
    """Return the sum of later rewards, discounted, up to the episode's end."""
    found = np.zeros_like(rewards, float)
    later = np.zeros(rewards.shape[1])
    for k in range(len(rewards) - 1, -1, -1):
        later = rewards[k] + discount * np.where(ends[k], 0.0, later)
        found[k] = later
    return found
