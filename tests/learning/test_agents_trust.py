"""Files of agents that run what their writer wished are loaded only with --trust; all others run nothing."""

import json
import pickle
import re
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from agents.commands import evaluate
from agents.commands.cli import app
from agents.evaluation.open_policy import open_policy
from agents.training import checkpoint
from agents.training.checkpoint import CheckpointError, UntrustedError
from agents.training.train import bundle_of_checkpoint, run_to_resume
from agents.training.train import train as run_training

RUN = {"algorithm": "ppo", "environment": "ServoDrive/Tracking-v0", "configuration": {}, "timesteps": 640,
       "run": {"environment": "tracking", "algorithm": "ppo", "seed": 3,
               "hyperparameters": {"n_timesteps": 640, "n_envs": 1, "policy": "MlpPolicy"}}}  # fmt: skip
MARK = "it-ran"


class _RunsAtLoading:
    def __reduce__(self):
        return (Path.touch, (Path(MARK),))


def hostile(path, run=RUN):
    """A checkpoint whose every pickle runs something at loading."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("drive_agent.json", run if isinstance(run, str) else json.dumps(run))
        for name in ("normaliser.pkl", "replay_buffer.pkl", "random_states.pkl"):
            archive.writestr(name, pickle.dumps(_RunsAtLoading()))
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    hostile(tmp_path / "x.zip")
    hostile(tmp_path / "run" / "checkpoint.zip")
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(app, list(arguments))


@pytest.mark.parametrize(
    "arguments", [("evaluate", "x.zip"), ("evaluate", "x.ZIP"), ("export", "x.zip"), ("train", "--resume", "run"),
                  ("evaluate", "x.zip", "--gap", "2"), ("evaluate", "x.zip", "--interface", "virtual", "--yes")]
)  # fmt: skip
def test_a_checkpoint_is_not_loaded_without_trust(arguments, folder):
    (folder / "x.ZIP").write_bytes((folder / "x.zip").read_bytes())
    found = run(*arguments)
    assert found.exit_code == 2, found.output
    assert re.search(r"holds pickles: loading it runs code that its author put there.* give --trust", found.output)
    assert not (folder / MARK).exists()


def test_the_card_of_a_checkpoint_is_read_without_running_it(folder):
    found = run("evaluate", "x.zip", "--card")
    assert found.exit_code == 0 and "trained: ppo, 640 steps" in found.output
    assert not (folder / MARK).exists()


def test_python_asks_for_trust_too(folder):
    for call in (
        lambda: open_policy("x.zip"),
        lambda: checkpoint.load(Path("x.zip")),
        lambda: bundle_of_checkpoint("x.zip"),
        lambda: run_training(run_to_resume("run"), "run", resume=True),
    ):
        with pytest.raises(UntrustedError, match=r"in Python trust=True"):
            call()
    assert not (folder / MARK).exists()


def test_who_is_trusted_runs(folder):
    """The test above would pass with a file that runs nothing."""
    pytest.importorskip("stable_baselines3")
    with pytest.raises(Exception):  # noqa: B017  # whatever the broken file leads to, after it ran
        checkpoint.load(Path("x.zip"), trust=True)
    assert (folder / MARK).exists()


def test_a_new_run_needs_no_trust(folder):
    found = run("train", "--trust")
    assert found.exit_code == 2 and "--trust is for --resume" in found.output


@pytest.mark.parametrize(
    "text",
    ["[]", "{}", "no", "[" * 100_000, '{"run": NaN}', json.dumps(RUN | {"run": []}),
     json.dumps(RUN | {"timesteps": "x"}),
     json.dumps(RUN | {"run": {"seed": 1}}), json.dumps(RUN | {"run": {"hyperparameters": {}, "seed": "x"}})],
)  # fmt: skip
def test_what_a_checkpoint_says_of_its_run_is_checked(text, folder):
    hostile(folder / "run" / "checkpoint.zip", text)
    with pytest.raises(CheckpointError, match=r"checkpoint\.zip is not a checkpoint of drive-agent"):
        checkpoint.read_run(folder / "run" / "checkpoint.zip")
    for arguments in (("evaluate", "run/checkpoint.zip", "--card"), ("train", "--resume", "run", "--trust")):
        found = run(*arguments)
        assert found.exit_code == 2 and found.output.strip().count("\n") == 0


def test_a_run_of_another_version_is_told(folder):
    hostile(folder / "run" / "checkpoint.zip", json.dumps(RUN | {"run": RUN["run"] | {"colour": "red"}}))
    found = run("train", "--resume", "run", "--trust")
    assert found.exit_code == 2 and "is not a checkpoint of this drive-agent" in found.output


def test_a_bomb_in_a_checkpoint_is_not_unpacked(folder):
    with zipfile.ZipFile(folder / "x.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("drive_agent.json", b" " * 20_000_000)
    found = run("evaluate", "x.zip", "--card")
    assert found.exit_code == 2 and "would unpack to 20 MB" in found.output


def test_a_card_cannot_act_on_the_terminal():
    told = list(evaluate._lines({"trained\x1b[2J": "\x1b]0;title\x07 a\nb", "limits": ["\x9b31m", "µ 48 %"]}))
    assert all(one.isprintable() for one in told)
    assert told[1].endswith("µ 48 %")
