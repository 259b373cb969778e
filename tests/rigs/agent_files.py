"""An agent's file with random weights."""

from __future__ import annotations

import itertools

import numpy as np

from agents.policies.agent_file import AgentFile

ENTRIES, ACTIONS = 6, 2


def bundle(kind="mlp", activation="tanh", output="clip", hidden=(16, 8), **changes):
    """An agent with random weights."""
    rng = np.random.default_rng(1)
    cells = 5
    sizes = ((cells if kind == "lstm" else ENTRIES), *hidden, ACTIONS)
    arrays = {
        "observation_mean": rng.standard_normal(ENTRIES),
        "observation_scale": rng.uniform(0.5, 2.0, ENTRIES),
        "action_low": np.array([-1.0, -0.7], np.float32),
        "action_high": np.array([1.0, 0.3], np.float32),
    }
    for k, (wide, high) in enumerate(itertools.pairwise(sizes)):
        arrays[f"weight_{k}"] = rng.standard_normal((wide, high)).astype(np.float32)
        arrays[f"bias_{k}"] = rng.standard_normal(high).astype(np.float32)
    if kind == "lstm":
        for name, rows in (("input", ENTRIES), ("state", cells)):
            arrays[f"lstm_{name}"] = rng.standard_normal((rows, 4 * cells)).astype(np.float32)
        arrays["lstm_bias"] = rng.standard_normal(4 * cells).astype(np.float32)
    given = {
        "kind": kind,
        "arrays": arrays,
        "settings": {"activation": activation, "output": output, "observation_clip": 10.0},
        "environment": "ServoDrive/Tracking-v0",
        "configuration": {"load": "two_mass"},
        "card": {"limits": ["none known"]},
        "versions": {"numpy": np.__version__},
    }
    return AgentFile(**given | changes)


def observations(lanes=4, seed=0):
    return np.random.default_rng(seed).standard_normal((lanes, ENTRIES)).astype(np.float32)
