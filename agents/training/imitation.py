"""Imitation of a teacher: before an algorithm improves a policy, its network learns the teacher's actions.

The teacher acts first, then the student in more and more environments, and the teacher tells what it would do: how to
make up for its own errors a student learns only where they lead (DAgger, Ross et al. 2011). Both act with the
algorithm's initial exploration noise, so that the critic learns the returns of noisy actions, too: the first updates by
an untrained critic would undo the imitation. What was done stays in the replay buffer of an algorithm that has one, and
its critic learns from there. A recurrent network learns from windows of an episode.
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
    rounds: int = 1,
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
        rounds: Rounds of acting and learning: the teacher acts in the first, the student in the last, in those between
            either in some of the environments. The critic learns from the latest round alone.
        told: Called with the finished share, 0...1.

    Raises:
        ValueError: Without an update or a round.
    """
    import torch

    if min(updates, rounds) < 1:
        raise ValueError(f"an imitation has 1 or more updates and rounds, not {updates} and {rounds}")
    env, policy = model.get_env(), model.policy
    lesson = _Lesson(model, teacher, seed)
    learning = getattr(policy, "actor", policy)
    parameters = [value for name, value in learning.named_parameters() if name != "log_std"]
    optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    each = max(1, steps // env.num_envs // rounds)
    for turn in range(rounds):
        latest = len(lesson.ends) * env.num_envs
        for step in range(each):
            told((turn + PLAYING * step / each) / rounds)
            lesson.play(turn / max(rounds - 1, 1))
        draw = lesson.windows()
        policy.set_training_mode(True)
        for _ in range(updates * turn // rounds, updates * (turn + 1) // rounds):
            chosen, inputs, wanted, values, windows = draw()
            found, judged = _answers(policy, inputs, windows)
            error = loss = (found - wanted).square().mean()
            if judged is not None:
                loss = error + 0.5 * ((judged.flatten() - values).square() * (chosen >= latest)).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            falling.step()
    if hasattr(model, "replay_buffer"):
        _teach_critic(model, updates)
    told(1.0)
    return float(error.detach().sqrt())


class _Lesson:
    """What was seen and earned, and what the teacher would have done, of shape (environments, ...) in each step.

    Args:
        model, teacher, seed: As for `imitate`.
    """

    def __init__(self, model: Any, teacher: Any, seed: int) -> None:
        self.model, self.teacher, self.env, self.rng = model, teacher, model.get_env(), np.random.default_rng(seed)
        self.deviation = _deviation(model.policy)
        self.changes = hasattr(self.env.get_attr("config")[0], "payload")  # machines within an episode
        self.rows: list[Any] = []
        self.wanted: list[Any] = []
        self.rewards: list[Any] = []
        self.ends: list[Any] = []
        self.env.seed(seed)
        self.seen, self.memory, self.begun = self.env.reset(), None, np.ones(self.env.num_envs, bool)
        teacher.reset(None)
        _tell(teacher, self.env, self.begun)

    def play(self, share: float) -> None:
        """Make a step, in which the student acts in a share of the environments, 0...1.

        A model with a replay buffer keeps what was done.
        """
        env, model = self.env, self.model
        rows = _each(env.get_original_obs() if hasattr(env, "get_original_obs") else self.seen, np.array)
        wanted = np.asarray(self.teacher.act(rows[ACTOR] if isinstance(rows, dict) else rows), np.float32)
        done = wanted + self.deviation * self.rng.standard_normal(wanted.shape)
        if share:
            own, self.memory = model.predict(self.seen, self.memory, self.begun, deterministic=True)
            student = np.arange(env.num_envs) < share * env.num_envs
            done[student] += (own - wanted)[student]
        done = np.clip(done, model.action_space.low, model.action_space.high).astype(np.float32)
        model._last_obs, model._last_original_obs = self.seen, rows
        self.seen, reward, ended, infos = env.step(done)
        if hasattr(model, "replay_buffer"):
            scaled = model.policy.scale_action(done)
            model._store_transition(model.replay_buffer, scaled, self.seen, reward, ended, infos)
        reward = env.get_original_reward() if hasattr(env, "get_original_reward") else reward
        if ended.any():
            self.teacher.reset(ended)
        if self.changes or ended.any():
            _tell(self.teacher, env, ended | self.changes)
        self.begun = ended
        columns = (self.rows, self.wanted, self.rewards, self.ends)
        for column, value in zip(columns, (rows, wanted, reward, ended), strict=True):
            column.append(_each(value, np.array))

    def windows(self) -> Callable[[], tuple[Any, ...]]:
        """Return a function that draws windows.

        It returns flat indices, observations, the teacher's actions, returns, and how many windows they are.
        """
        import torch

        env, ends = self.env, np.stack(self.ends)

        def tensor(columns: NDArray[Any]) -> Any:
            return torch.as_tensor(columns.reshape(-1, columns.shape[-1]), dtype=torch.float32)

        if isinstance(self.rows[0], dict):
            rows: Any = {key: np.stack([one[key] for one in self.rows]) for key in self.rows[0]}
        else:
            rows = np.stack(self.rows)
        inputs = _each(env.normalize_obs(rows) if hasattr(env, "normalize_obs") else rows, tensor)
        wanted = tensor(np.stack(self.wanted))
        scale = np.sqrt(env.ret_rms.var + env.epsilon) if getattr(env, "norm_reward", False) else 1.0
        returns = _discounted(np.stack(self.rewards) / scale, ends, float(self.model.gamma))
        values = torch.as_tensor(returns.reshape(-1), dtype=torch.float32)
        first_episodes = np.where(ends.any(axis=0), ends.argmax(axis=0) + 1, len(ends))
        length = min(WINDOW, int(first_episodes.max())) if hasattr(self.model.policy, "lstm_actor") else 1
        first, ahead = _windows(ends, length), env.num_envs * np.arange(length)

        def draw() -> tuple[Any, ...]:
            begins = first[self.rng.integers(0, len(first), BATCH // length)]
            chosen = torch.from_numpy((begins[:, None] + ahead).ravel())
            return chosen, _each(inputs, lambda rows: rows[chosen]), wanted[chosen], values[chosen], len(begins)

        return draw


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
