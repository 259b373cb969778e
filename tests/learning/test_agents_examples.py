"""Every example of custom work runs, and is short."""

from __future__ import annotations

import importlib.util
import sys
import warnings

import numpy as np
import pytest
from rigs import ROOT

from agents.policies.agent_file import AgentFile

EXAMPLES = ROOT / "examples"
RUNS = {
    "own_reward": (["--steps", "256", "--environments", "4"], "mean return of 4 episodes"),
    "own_load": (["--steps", "256", "--environments", "4"], "mean following error"),
    "own_algorithm": (
        ["--generations", "2", "--candidates", "5", "--machines", "2", "--duration", "0.05"],
        "weights of the observation's entries",
    ),
    "curriculum": (["--steps", "512", "--environments", "4"], "trained up to stage"),
    "policy_at_1_khz": (["--seconds", "0.6"], "velocity follows within"),
}


def run(name, arguments, monkeypatch):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of SB3, about batches as small as a test's
        spec.loader.exec_module(module)
        if "Arguments" in vars(module):
            values = dict(zip(arguments[::2], arguments[1::2], strict=True))
            options = {key[2:].replace("-", "_"): float(value) for key, value in values.items()}
            options = {key: value if key == "duration" else int(value) for key, value in options.items()}
            module.main(module.Arguments(**options))
        else:
            module.main()


@pytest.mark.every(12)
@pytest.mark.parametrize("name", RUNS)
def test_it_runs(name, monkeypatch, capsys):
    if name in ("own_reward", "own_load", "curriculum"):
        pytest.importorskip("stable_baselines3")
    arguments, message = RUNS[name]
    run(name, arguments, monkeypatch)
    assert message in capsys.readouterr().out


@pytest.mark.parametrize("name", RUNS)
def test_it_has_less_than_60_lines(name):
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) < 60


def test_the_1_khz_loop_takes_a_trained_agent(tmp_path, monkeypatch, capsys):
    arrays = {"observation_mean": np.zeros(2), "observation_scale": np.ones(2), "action_low": -np.ones(1, np.float32),
              "action_high": np.ones(1, np.float32), "weight_0": np.array([[2.0], [0.0]], np.float32),
              "bias_0": np.zeros(1, np.float32)}  # fmt: skip
    settings = {"activation": "tanh", "output": "clip", "observation_clip": None}
    path = AgentFile("mlp", arrays, settings, "own").save(tmp_path / "agent.npz")
    run("policy_at_1_khz", ["--seconds", "0.1", "--agent", str(path)], monkeypatch)
    assert "velocity follows within" in capsys.readouterr().out
