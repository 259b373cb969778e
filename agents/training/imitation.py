"""Imitation of a teacher: before an algorithm improves a policy, its network learns the teacher's actions.

The teacher acts with the algorithm's initial exploration noise, so that the critic learns the returns of noisy actions,
too: the first updates by an untrained critic would undo the imitation. What it has seen stays in the replay buffer of
an algorithm that has one, and its critic learns from there. A recurrent network learns from windows of an episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policies.policy import ACTOR

STEPS = 60_000  # of all environments together
BATCH, UPDATES, LEARNING_RATE = 1024, 1200, 1e-3
WINDOW = 64  # steps of an episode, for recurrent networks; a machine shows in less what it is
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
    """Teach a model and return the RMS difference of its actions from the teacher's in the last update.

    A critic that sees more than the actor learns from all its entries; the teacher sees the actor's.

    Args:
        model: The model with its environment; the normaliser learns its statistics here.
        teacher: The teacher, which acts on the environment's own observations: `act(observations)`, `reset(mask)`.
        seed: Seed of the environments and of the noise.
        steps: Steps of all environments together.
        updates: Updates of the network; of SAC, TQC and CrossQ as many of the actor and of the critic.
        told: Called with the finished share, 0...1.
    """
    import torch

    env, policy = model.get_env(), model.policy
    rng = np.random.default_rng(seed)
    env.seed(seed)
    rows, actions, rewards, ends = _play(model, teacher, rng, _deviation(policy), max(1, steps // env.num_envs), told)
    scale = np.sqrt(env.ret_rms.var + env.epsilon) if getattr(env, "norm_reward", False) else 1.0
    returns = _discounted(rewards / scale, ends, float(model.gamma))
    normalised = env.normalize_obs(rows) if hasattr(env, "normalize_obs") else rows

    def tensor(columns: NDArray[Any]) -> Any:
        return torch.as_tensor(columns.reshape(-1, columns.shape[-1]), dtype=torch.float32)

    inputs, wanted = _each(normalised, tensor), tensor(actions)
    values = torch.as_tensor(returns.reshape(-1), dtype=torch.float32)
    first_episodes = np.where(ends.any(axis=0), ends.argmax(axis=0) + 1, len(ends))
    length = min(WINDOW, int(first_episodes.max())) if hasattr(policy, "lstm_actor") else 1
    first, ahead = _windows(ends, length), env.num_envs * np.arange(length)
    policy.set_training_mode(True)
    learning = getattr(policy, "actor", policy)
    parameters = [value for name, value in learning.named_parameters() if name != "log_std"]
    optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for _ in range(updates):
        begins = first[rng.integers(0, len(first), BATCH // length)]
        chosen = torch.from_numpy((begins[:, None] + ahead).ravel())
        found, judged = _answers(policy, _each(inputs, lambda rows: rows[chosen]), len(begins))  # noqa: B023
        error = (found - wanted[chosen]).square().mean()
        loss = error if judged is None else error + 0.5 * (judged.flatten() - values[chosen]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()
    if hasattr(model, "replay_buffer"):
        _teach_critic(model, updates)
    told(1.0)
    return float(error.detach().sqrt())


def _deviation(policy: Any) -> Any:
    """Return the deviation of a policy's first actions; that of SAC begins at its `log_std_init`, too."""
    import torch

    actor = getattr(policy, "actor", None)
    if actor is None:
        return np.exp(policy.log_std.detach().numpy())
    torch.nn.init.zeros_(actor.log_std.weight)
    torch.nn.init.constant_(actor.log_std.bias, actor.log_std_init)
    return np.exp(actor.log_std_init)


def _windows(ends: NDArray[Any], length: int) -> NDArray[Any]:
    """Return the flat indices of (steps, environments) where windows begin that lie within an episode."""
    ended = np.cumsum(np.concatenate([np.zeros((1, ends.shape[1])), ends[:-1]]), axis=0)
    return np.flatnonzero(ended[length - 1 :] == ended[: len(ended) - length + 1])


def _answers(policy: Any, rows: Any, windows: int) -> tuple[Any, Any]:
    """Return a policy's actions without exploration, and its values; None where the critic judges actions."""
    import torch

    if hasattr(policy, "actor"):
        actor = policy.actor
        return torch.tanh(actor.mu(actor.latent_pi(actor.extract_features(rows, actor.features_extractor)))), None
    if not hasattr(policy, "lstm_actor"):
        features = policy.extract_features(rows, policy.pi_features_extractor)
        return policy.action_net(policy.mlp_extractor.forward_actor(features)), policy.predict_values(rows)
    layers, _, cells = policy.lstm_hidden_state_shape
    memory = (torch.zeros(layers, windows, cells),) * 2
    begun = torch.zeros(len(rows))
    distribution, _ = policy.get_distribution(rows, memory, begun)
    return distribution.distribution.mean, policy.predict_values(rows, memory, begun)


class _Resting:
    """In place of an optimiser: changes nothing."""

    param_groups = ()

    def zero_grad(self) -> None: ...

    def step(self) -> None: ...


def _teach_critic(model: Any, updates: int) -> None:
    """Have a critic learn from the replay buffer while the actor stays as it is."""
    from stable_baselines3.common.logger import Logger

    model.set_logger(Logger(None, []))
    optimiser, model.actor.optimizer = model.actor.optimizer, _Resting()
    model.train(gradient_steps=updates, batch_size=model.batch_size)
    model.actor.optimizer = optimiser


def _each(observations: Any, function: Callable[[Any], Any]) -> Any:
    """Return a function of an observation's array, or of every array of a dict."""
    if isinstance(observations, dict):
        return {key: function(rows) for key, rows in observations.items()}
    return function(observations)


def _play(
    model: Any, teacher: Any, rng: np.random.Generator, deviation: Any, steps: int, told: Callable[[float], None]
) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return observations, the teacher's actions, rewards and ends, each of shape (steps, environments, ...).

    A model with a replay buffer keeps what was done.
    """
    env, low, high = model.get_env(), model.action_space.low, model.action_space.high
    changes = hasattr(env.get_attr("config")[0], "payload")  # machines within an episode
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
        done = np.clip(wanted + noise, low, high).astype(np.float32)
        model._last_obs, model._last_original_obs = seen, rows
        seen, reward, ended, infos = env.step(done)
        if hasattr(model, "replay_buffer"):
            model._store_transition(model.replay_buffer, model.policy.scale_action(done), seen, reward, ended, infos)
        reward = env.get_original_reward() if hasattr(env, "get_original_reward") else reward
        if ended.any():
            teacher.reset(ended)
        if changes or ended.any():
            _tell(teacher, env, ended | changes)
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
    """Notify a teacher that has `told` of the machines whose episodes begin, or that change, where the mask is true.

    The network, without this knowledge, learns such a teacher's average action over the machines, or over those that
    are likely after what it remembers.
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
