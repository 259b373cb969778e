"""From a model of Stable-Baselines3 to a bundle: its actor's layers, the normaliser, the action's bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from agents.policies.agent_file import AgentFile, BundleError, installed
from agents.policies.policy import ACTIVATIONS, ACTOR

_ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "LeakyReLU": "leaky_relu", "SiLU": "silu"}
PACKAGES = ("drive-env", "numpy", "torch", "stable-baselines3", "sb3-contrib", "mujoco", "numba")


def bundle_of(
    model: Any, normaliser: Any, *, environment: str, configuration: Mapping[str, Any], card: Mapping[str, Any]
) -> AgentFile:
    """Return the actor of a model as a bundle.

    Args:
        model: PPO, RecurrentPPO or SAC, or another of their form.
        normaliser: Its VecNormalize, or None.
        environment: Name of the environment.
        configuration: The environment's options.
        card: Its description.

    Raises:
        BundleError: For a network of another form.
    """
    actor = getattr(model.policy, "actor", None)
    if actor is not None:
        hidden, last, squashes = actor.latent_pi, actor.mu, True
    else:
        hidden, last = model.policy.mlp_extractor.policy_net, model.policy.action_net
        squashes = bool(getattr(model.policy, "squash_output", False))
    activation, layers = _layers([*hidden, last])
    arrays: dict[str, Any] = {}
    for k, (weight, bias) in enumerate(layers):
        arrays[f"weight_{k}"], arrays[f"bias_{k}"] = weight, bias
    kind = "mlp"
    lstm = getattr(model.policy, "lstm_actor", None)
    if lstm is not None:
        if lstm.num_layers != 1:
            raise BundleError(f"the actor has {lstm.num_layers} layers of LSTM cells; a bundle holds 1")
        kind = "lstm"
        arrays["lstm_input"], arrays["lstm_state"] = _array(lstm.weight_ih_l0).T, _array(lstm.weight_hh_l0).T
        arrays["lstm_bias"] = _array(lstm.bias_ih_l0) + _array(lstm.bias_hh_l0)
    mean, scale, clip = _normaliser(normaliser, _observation_size(model.observation_space))
    arrays |= {
        "observation_mean": mean,
        "observation_scale": scale,
        "action_low": np.asarray(model.action_space.low, np.float32),
        "action_high": np.asarray(model.action_space.high, np.float32),
    }
    output = "tanh" if squashes else "clip"
    settings = {"activation": activation, "output": output, "observation_clip": clip}
    bundle = AgentFile(kind, arrays, settings, environment, configuration, card, installed(*PACKAGES))
    entries = arrays["lstm_input" if lstm is not None else "weight_0"].shape[0]
    if entries != len(mean):
        raise BundleError(
            f"the actor sees {entries} entries and the observation has {len(mean)}; a critic that sees more is trained "
            "with agents.training.asymmetric"
        )
    return bundle


def _layers(modules: list[Any]) -> tuple[str, list[Any]]:
    """Return the activation between fully connected layers, and weight (in, out) and bias of each layer."""
    layers, between, before = [], set(), None
    for one in modules:
        name = type(one).__name__
        if name == "Linear":
            layers.append(_layer(one, before))
            before = None
        elif name == "BatchRenorm1d":
            before = one
        else:
            between.add(name)
    unknown = between - set(_ACTIVATIONS)
    if unknown or len(between) > 1:
        raise BundleError(
            f"the actor has {', '.join(sorted(between))} between its layers; a bundle holds one of "
            f"{', '.join(_ACTIVATIONS)}"
        )
    name = _ACTIVATIONS[between.pop()] if between else next(iter(ACTIVATIONS))
    return name, layers


def _layer(layer: Any, before: Any) -> tuple[Any, Any]:
    """Return weight and bias of a fully connected layer, merged with CrossQ's normalisation before it, if any.

    For an acting agent this normalisation is (x - ra_mean) / sqrt(ra_var + eps) * scale + bias, with constant
    statistics.
    """
    weight, bias = _array(layer.weight).T, _array(layer.bias)
    if before is None:
        return weight, bias
    scale = _array(before.scale) / np.sqrt(_array(before.ra_var) + before.eps)
    return scale[:, None] * weight, bias + (_array(before.bias) - scale * _array(before.ra_mean)) @ weight


def _normaliser(normaliser: Any, entries: int) -> tuple[Any, Any, float | None]:
    """Return mean, 1/standard deviation and clip of a VecNormalize."""
    if normaliser is None or not normaliser.norm_obs:
        return np.zeros(entries), np.ones(entries), None
    statistics = normaliser.obs_rms
    if isinstance(statistics, dict):
        statistics = statistics[ACTOR]
    scale = 1.0 / np.sqrt(statistics.var + normaliser.epsilon)
    return np.array(statistics.mean), scale, float(normaliser.clip_obs)


def _observation_size(space: spaces.Space[Any]) -> int:
    if isinstance(space, spaces.Dict):
        space = space[ACTOR]
    return int(np.prod(space.shape or ()))


def _array(tensor: Any) -> Any:
    return tensor.detach().cpu().numpy().astype(np.float32)
