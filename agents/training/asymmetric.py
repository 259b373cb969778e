"""A critic that sees more than the actor: the true machine, which only an emulator knows.

For environments with `privileged: true`, whose observation is a dict of "observation" and "privileged". The actor's
network is exported to a bundle; the critic's network and its entries are not.
"""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn

from agents.policies.policy import ACTOR


class _Split(nn.Module):  # type: ignore[misc]
    """Two networks on the concatenated entries of a dict: the actor's on the first entries, the critic's on all."""

    def __init__(self, actor_entries: int, all_entries: int, net_arch: Any, activation_fn: Any) -> None:
        super().__init__()
        self._entries = actor_entries
        # Of each MlpExtractor one half is used: the other one must not be among the parameters.
        actor = MlpExtractor(actor_entries, net_arch, activation_fn, device="cpu")
        critic = MlpExtractor(all_entries, net_arch, activation_fn, device="cpu")
        self.policy_net, self.value_net = actor.policy_net, critic.value_net
        self.latent_dim_pi, self.latent_dim_vf = actor.latent_dim_pi, critic.latent_dim_vf

    def forward(self, features: Any) -> tuple[Any, Any]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Any) -> Any:
        return self.policy_net(features[:, : self._entries])

    def forward_critic(self, features: Any) -> Any:
        return self.value_net(features)


class AsymmetricPolicy(MultiInputActorCriticPolicy):  # type: ignore[misc]
    """PPO's policy whose critic sees more than the actor.

    In the YAML: `policy: agents.training.asymmetric:AsymmetricPolicy`.

    Raises:
        ValueError: For an observation that is not a dict of the actor's entry and at least one more.
    """

    def __init__(self, observation_space: Any, *rest: Any, **options: Any) -> None:
        spaces = getattr(observation_space, "spaces", {})
        if next(iter(spaces), None) != ACTOR or len(spaces) < 2:
            raise ValueError(
                f"an asymmetric critic needs an observation with {ACTOR!r} first and more after it; give the "
                "environment privileged: true (env_kwargs) if it has that, or take MlpPolicy"
            )
        super().__init__(observation_space, *rest, **options)

    def _build_mlp_extractor(self) -> None:
        entries = int(torch.Size(self.observation_space.spaces[ACTOR].shape).numel())
        self.mlp_extractor = _Split(entries, self.features_dim, self.net_arch, self.activation_fn)
