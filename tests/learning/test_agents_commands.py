"""`drive-agent`: what its commands say and leave behind, and what they say of mistakes."""

from __future__ import annotations

import csv
import re

import pytest
import yaml
from rigs.trainings import TINY
from typer.testing import CliRunner

pytest.importorskip("stable_baselines3")

from agents.commands import train as train_command
from agents.commands.cli import app
from agents.policies.agent_file import AgentFile
from agents.seeds import EVALUATION


def run(*arguments):
    return CliRunner().invoke(app, [str(one) for one in arguments])


@pytest.fixture
def shrunk(tmp_path, monkeypatch):
    """Hyper-parameters for a run of a moment, in a file as users write it."""
    monkeypatch.setattr(train_command, "EPISODES", 3)
    path = tmp_path / "own.yaml"
    table = {"n_envs": 4, "n_timesteps": "2e2", "policy": "MlpPolicy", "normalize": True, "n_steps": 8,
             "batch_size": 16, "learning_rate": "lin_1e-3",
             "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.ReLU)",
             "env_kwargs": {**TINY["ServoDrive/Tracking-v0"], "num_threads": 1}}  # fmt: skip
    path.write_text(yaml.safe_dump({"ServoDrive/Tracking-v0": table, "gantry": {"n_steps": 4}}))
    return path


def test_train_judge_resume_export(tmp_path, shrunk):
    out = tmp_path / "run"
    found = run("train", "tracking", "--config", shrunk, "--load", "gantry", "--seed", 5, "--out", out)
    assert found.exit_code == 0, found.output
    assert "ServoDrive/Tracking-v0 ppo: 208 of 208 steps" in found.output and "tracking 0." in found.output
    assert re.search(r"RMS following error \[rev\]: \S+ \(95 % of \S+ to \S+\), median", found.output)
    bundle = AgentFile.load(out / "agent.npz")
    assert bundle.configuration["load"] == "gantry" and bundle.settings["activation"] == "relu"
    figures = bundle.card["figures"]
    assert figures["RMS following error [rev]"]["episodes"] == 3 and figures["violations"] == {}
    assert bundle.card["seeds"] == {"training": 5, "evaluation": f"{EVALUATION[0]}...{EVALUATION[2]}"}
    again = run("train", "--resume", out, "--trust")  # nothing is left to do: the same agent
    assert again.exit_code == 0 and AgentFile.load(out / "agent.npz").hash == bundle.hash
    exported = run("export", out / "checkpoint.zip", "--trust", "--out", tmp_path / "agent.onnx")
    assert exported.exit_code == 0 and "largest difference from Stable-Baselines3" in exported.output
    assert (tmp_path / "agent.npz").is_file()


@pytest.mark.slow
def test_a_search_finds_and_goes_on(tmp_path, shrunk):
    out = tmp_path / "study"
    for trials, best in ((2, "trial 1: "), (1, "trial 2: ")):
        found = run("search", "tracking", "--config", shrunk, "--steps", 40, "--trials", trials, "--out", out)
        assert found.exit_code == 0 and best in found.output
    rows = [float(row) for row in re.findall(r"best (\S+) of trial", found.output)]
    table = yaml.safe_load((out / "best.yaml").read_text())["ServoDrive/Tracking-v0"]
    assert rows and 3e-5 <= table["learning_rate"] <= 3e-3 and table["n_envs"] == 4
    assert run("train", "tracking", "--config", out / "best.yaml", "--out", tmp_path / "run").exit_code == 0
    with (tmp_path / "run" / "training.csv").open() as file:
        assert list(csv.DictReader(file))[-1]["timesteps"] == "64"  # whole rollouts of 16 steps of 4 environments


@pytest.mark.slow
def test_a_search_on_processes_is_the_same_search(tmp_path, shrunk):
    for folder, more in (("here", ()), ("apart", ("--workers", 2))):
        out = tmp_path / folder
        found = run("search", "tracking", "--config", shrunk, "--steps", 40, "--trials", 2, "--out", out, *more)
        assert found.exit_code == 0, found.output
    for name in ("best.yaml", "trial-000/agent.npz", "trial-001/agent.npz"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "apart" / name).read_bytes(), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "walking"), "there is no environment 'walking'"),
        (("train", "tracking", "-a", "dqn"), "there is no algorithm 'dqn'; there are ppo, sac, recurrent_ppo,"),
        (("train", "tracking", "--preset", "slow"), "there is no preset 'slow'"),
        (("train", "tracking", "--steps", "0"), "--steps 0 must be 1 or more"),
        (("train", "tracking", "--config", "no.yaml"), "there is no file no.yaml"),
        (("train", "--resume", "nowhere"), "there is no file nowhere/checkpoint.zip to continue from"),
        (
            ("train", "--resume", "nowhere", "--steps", "5", "--seed", "0"),
            "with its own options; leave --seed, --steps out",
        ),
        (("train", "tracking", "--resume", "nowhere"), "with its own options; leave environment out"),
        (("train", "tracking", "--seed", "-1"), "the seed must be 0 or more, not -1"),
        (("search", "tracking", "--trials", "0"), "--trials 0 must be 1 or more"),
        (
            ("export", "agent.txt"),
            "must be an agent (.npz), a checkpoint (.zip), or one that ships: arm_path, gain_tuning",
        ),
        (("export", "gain_tuning"), "an agent of kind 'surrogate' cannot be written as ONNX"),
        (("export", "no.npz"), "there is no file no.npz"),
    ],
)
def test_a_mistake_is_told_in_one_line(arguments, message):
    found = run(*arguments)
    assert found.exit_code == 2 and message in found.output and "Traceback" not in found.output


def test_a_folder_with_something_in_it_is_left_alone(tmp_path, shrunk):
    found = run("train", "tracking", "--config", shrunk, "--out", tmp_path)
    assert found.exit_code == 2 and "is not empty; choose a new folder" in found.output


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_without_onnx_the_extra_is_named(package, monkeypatch, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, package, None)
    found = run("export", "tracking_two_mass", "--out", tmp_path / "agent.onnx")
    assert found.exit_code == 2 and "pip install 'drive-env[agents]'" in found.output


def test_without_torch_the_extra_is_named(monkeypatch, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    found = run("train", "tracking", "--out", tmp_path / "run")
    assert found.exit_code == 2 and "pip install 'drive-env[agents]'" in found.output
