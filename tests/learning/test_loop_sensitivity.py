"""What a policy does to the loops: measured Ms against closed forms, and agents that are brought within margins."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.known_machines import true_plant
from typer.testing import CliRunner

from agents.commands.cli import app
from agents.evaluation.loop_sensitivity import NotKeptError, check_kept, measure_sensitivity, within
from agents.policies.agent_file import AgentFile
from agents.policies.policy import policy_of
from drive_env import EmulatedDrives
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import position_open_loop, velocity_open_loop

TRACKING = "ServoDrive/Tracking-v0"
ERROR, SPEED = 0, 3  # entries of an axis' observation


def linear(load: str, entry: int, gain: float) -> AgentFile:
    """Return an agent whose action is an entry of the observation times a gain: a lead per following error, in csp."""
    weight = np.zeros((8, 1), np.float32)
    weight[entry] = gain
    arrays = {"observation_mean": np.zeros(8), "observation_scale": np.ones(8), "weight_0": weight,
              "bias_0": np.zeros(1, np.float32), "action_low": -np.ones(1), "action_high": np.ones(1)}  # fmt: skip
    settings = {"activation": "tanh", "output": "clip", "observation_clip": 10.0}
    configuration = {"load": load, "mode": "csp", "action": "offset", "num_threads": 1}
    return AgentFile("mlp", arrays, settings, TRACKING, configuration)


def measured(agent: AgentFile, machines: int = 2):
    """Return the loops of two machines with the agent."""
    return measure_sensitivity(policy_of(agent), agent.environment, agent.configuration, machines=machines, seed=3)


@pytest.mark.every(2)
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_loops_without_an_agent_are_those_of_the_linear_model(load):
    """At the torque, L of both outer loops: 1 + L = (1 + L of the velocity loop) (1 + L of the position loop)."""
    found = measured(linear(load, ERROR, 0.0))
    f = found.frequencies
    with EmulatedDrives("tmcm1636", load, num_threads=1) as drives:
        gains = [int(drives.read(key)[0]) for key in drives.device.gains.keys]
        plant, device = true_plant(drives), drives.device
        velocity, position = (loop(device, plant, gains, f) for loop in (velocity_open_loop, position_open_loop))
    exact = 1.0 / ((1.0 + velocity) * (1.0 + position))
    quick = f > 25.0  # below, friction takes part
    assert np.abs(found.response[:, 0] - exact)[:, quick].max() < 0.15
    assert found.ms[:, 0] == pytest.approx(np.abs(exact).max(), rel=0.08)


@pytest.mark.slow
def test_an_agent_that_answers_errors_too_much_is_brought_within_margins():
    hot, stiff = linear("inertia", ERROR, 16.0), find_dynamics("stiff")
    with pytest.raises(NotKeptError, match=r"stiff allows 2\.5"):
        check_kept(measured(hot), stiff)
    agent, found = within(hot, stiff)
    assert found.ms.max() <= 2.5
    card = agent.card["margins"]
    assert card["answer to errors"] < 1.0 and card["Ms greatest"] == found.ms.max() and card["dynamics"] == "stiff"
    rows = np.random.default_rng(0).uniform(-0.05, 0.05, (5, 8)).astype(np.float32)
    assert policy_of(agent).act(rows) == pytest.approx(card["answer to errors"] * policy_of(hot).act(rows), rel=1e-5)


@pytest.mark.slow
def test_feedback_that_is_not_of_errors_is_not_reduced():
    with pytest.raises(NotKeptError, match=r"even with 0\.3 of its answer to errors"):
        within(linear("inertia", SPEED, 0.9), find_dynamics("stiff"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cascade", "-e", "gantry_beam_v1", "--out", "x.npz"], "give both"),
        (["cascade", "-e", "GantryBeam-v1", "--out", "x.npz", "--dynamics", "stiff"], "not trained by drive-agent"),
        (["cascade", "-e", "GantryBeam-v1", "--dynamics", "lively"], "give soft, standard, stiff"),
        (["nothing", "-e", "gain_tuning"], "not in ServoDrive/GainTuning-v0"),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_told(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["margins", *arguments])
    assert found.exit_code == 2 and message in found.output.replace("\n", " ") and not list(tmp_path.iterdir())


def test_a_file_that_is_there_stays(tmp_path):
    path = linear("inertia", ERROR, 1.0).save(tmp_path / "agent.npz")
    before = path.read_bytes()
    found = CliRunner().invoke(app, ["margins", str(path), "--dynamics", "stiff", "--out", str(path)])
    assert found.exit_code == 2 and "is there already" in found.output and path.read_bytes() == before
