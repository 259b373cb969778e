"""Any policy, judged on emulated machines and on a bus by the same command; exports that act as the original."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from test_agents_bundle import ENTRIES, bundle, observations
from test_parity import WorldBus
from typer.testing import CliRunner

from agents import episode_log, gap
from agents.bundle import Bundle, BundleError
from agents.cli import app
from agents.evaluation import AsOnABus, Evaluation, evaluate
from agents.policies import PolicyNotFoundError, open_policy
from agents.policy import PolicyError, policy_of
from agents.scores import interval
from drive_env import CanDrives, EmulatedDrives, Limits, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World

SHORT = {"load": "two_mass", "mode": "csp", "action": "offset", "duration": 0.05}
SCORE = "RMS following error [rev]"
TURN = 65536


class Gentle:
    def act(self, observation):
        return np.clip(0.1 * observation[:, :1], -1, 1).astype(np.float32)

    def reset(self, mask=None):
        pass


def gentle(observation):  # module:function of the command line
    return Gentle().act(observation)


def agent(path, **changes):
    """An untrained agent for SHORT."""
    rng = np.random.default_rng(2)
    arrays = {"observation_mean": np.zeros(8), "observation_scale": np.ones(8), "action_low": -np.ones(1, np.float32),
              "action_high": np.ones(1, np.float32), "weight_0": 0.1 * rng.standard_normal((8, 1)).astype(np.float32),
              "bias_0": np.zeros(1, np.float32)}  # fmt: skip
    return str(bundle(arrays=arrays, configuration=SHORT | changes).save(path))


def run(*arguments):
    return CliRunner().invoke(app, [str(one) for one in arguments])


@pytest.fixture
def served():
    """A node on a hub, in lockstep."""
    world = World(lockstep=True)
    emulated = EmulatedDrives(load="two_mass", num_threads=1)
    world.add(emulated, [1])
    hub = Hub()
    with Server(world, hub):
        yield hub.channel, emulated
    world.close()


# --- figures ----------------------------------------------------------------------------------------------------------
def test_an_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    held = [
        found.low <= 1.0 <= found.high
        for found in (interval(rng.exponential(1.0, 40), resamples=400) for _ in range(300))
    ]
    assert 0.88 <= np.mean(held) <= 0.99


def test_nothing_to_measure_is_no_number():
    assert np.isnan(interval([np.nan]).mean) and interval([np.nan, 2.0, 4.0])[::4] == (3.0, 2)


def test_the_score_is_what_the_episodes_show():
    found = evaluate(Gentle(), "tracking", SHORT, episodes=3, seed=7)
    for k, episode in enumerate(found.episodes):
        error = episode.observations[1:, 0].astype(float) * 2.0  # amplitude of two_mass [rev]
        assert found.values[SCORE][k] == pytest.approx(np.sqrt(np.mean(error**2)))
        assert found.values["return"][k] == pytest.approx(episode.rewards.sum())
    assert found.seeds == [7, 8, 9] and found.score == SCORE


def test_an_episode_is_the_same_among_others_and_in_a_later_round(monkeypatch):
    whole = evaluate(Gentle(), "tracking", SHORT | {"distributions": "two_mass"}, episodes=5)
    monkeypatch.setattr("agents.evaluation.LANES", 2)
    rounds = evaluate(Gentle(), "tracking", SHORT | {"distributions": "two_mass"}, episodes=5)
    assert rounds.values == whole.values


def test_an_episode_ends_where_its_pole_falls_though_others_still_stand(monkeypatch):
    class Lean(Gentle):
        def act(self, observation):
            return np.full((len(observation), 1), 0.4, np.float32)

    options = {"load": "inverted_pendulum", "distributions": "inverted_pendulum", "duration": 0.5}
    together = evaluate(Lean(), "tracking", options, episodes=3)
    lengths = [len(episode.actions) for episode in together.episodes]
    assert len(set(lengths)) > 1 and max(lengths) < 500
    monkeypatch.setattr("agents.evaluation.LANES", 1)
    alone = evaluate(Lean(), "tracking", options, episodes=3)
    assert [len(episode.actions) for episode in alone.episodes] == lengths
    assert [len(episode.observations) for episode in alone.episodes] == [length + 1 for length in lengths]
    for name, values in alone.values.items():
        assert values == pytest.approx(together.values[name], rel=1e-5)


def test_a_fall_is_a_violation_and_the_score_is_the_time_that_it_stood():
    class Push(Gentle):
        def act(self, observation):
            return np.ones((len(observation), 1), np.float32)

    found = evaluate(Push(), "tracking", {"load": "inverted_pendulum", "duration": 1.0}, episodes=2)
    assert found.score == "time lasted [of the episode]" and max(found.values[found.score]) < 1.0
    assert found.violations == {"fell": 2}


@pytest.mark.parametrize(
    ("environment", "options", "figure"),
    [
        ("gain_tuning", {"trials": 2}, "hidden J over the rule's (emulator)"),
        ("gain_scheduling", {"duration": 0.05}, "tracking term [0...1]"),
    ],
)
def test_every_environment_has_figures(environment, options, figure):
    class Still(Gentle):
        def act(self, observation):
            return np.zeros((len(observation), 3), np.float32)

    found = evaluate(Still(), environment, options, episodes=2)
    assert found.score == figure and all(np.isfinite(found.values[figure]))
    if environment == "gain_tuning":  # the rule's gains again and again: nothing is won
        assert found.values[figure] == pytest.approx([1.0, 1.0], abs=0.1)


def test_a_report_is_saved_and_loaded(tmp_path):
    found = evaluate(Gentle(), "tracking", SHORT, episodes=2)
    again = Evaluation.load(found.save(tmp_path / "report.json"))
    assert again.values == found.values and again.seeds == found.seeds and again.side == "emulator"
    (tmp_path / "no.json").write_text("{}")
    with pytest.raises(ValueError, match="is no report of `drive-agent evaluate`"):
        Evaluation.load(tmp_path / "no.json")


# --- both sides -------------------------------------------------------------------------------------------------------
def test_over_can_in_lockstep_actions_and_figures_are_the_same():
    found = {}
    with EmulatedDrives(load="two_mass", num_threads=1) as emulated:
        found["emulator"] = evaluate(Gentle(), "tracking", SHORT, drives=AsOnABus(emulated), episodes=2, side="one")
    world = World(lockstep=True)
    world.add(EmulatedDrives(load="two_mass", num_threads=1), [1])
    bus = WorldBus(world)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=100 * TURN)) as drives:
        found["bus"] = evaluate(Gentle(), "tracking", SHORT, drives=drives, episodes=2)
    bus.shutdown()
    world.close()
    for one, two in zip(found["emulator"].episodes, found["bus"].episodes, strict=True):
        assert np.array_equal(one.actions, two.actions) and np.array_equal(one.observations, two.observations)
    for row in gap.compare(found["emulator"], found["bus"]):
        assert row.paired and row.difference[:3] == (0.0, 0.0, 0.0)


def test_a_gap_is_found_and_told():
    one = Evaluation("p", "ServoDrive/Tracking-v0", {}, "emulator", [1, 2, 3], {SCORE: [1.0, 2.0, 3.0]}, {}, {})
    two = Evaluation("p", "ServoDrive/Tracking-v0", {}, "bus", [1, 2, 3], {SCORE: [1.5, 2.5, 3.5]}, {}, {})
    [row] = gap.compare(one, two)
    assert not row.paired and row.difference.mean == 0.5 and row.difference.low < 0.0 < row.difference.high
    one.side = "emulator as on a bus"
    [row] = gap.compare(one, two)
    assert row.paired and row.difference[:3] == (0.5, 0.5, 0.5)
    assert "difference +0.5 (95 % of +0.5 to +0.5, +25.0%; paired by seed)" in gap.text([row], "a", "b")[0]
    two.environment = "ServoDrive/GainTuning-v0"
    with pytest.raises(ValueError, match="they are different tasks"):
        gap.compare(one, two)


# --- the command ------------------------------------------------------------------------------------------------------
def test_the_command_on_both_sides_and_the_gap(tmp_path, served):
    channel, emulated = served
    path = agent(tmp_path / "agent.npz")
    found = run("evaluate", path, "--episodes", 2, "--out", tmp_path / "one")
    assert found.exit_code == 0 and re.search(r"RMS following error \[rev\]: \S+ \(95 % of", found.output)
    names = {"report.json", "episodes.npz", "figures.png", "episodes.png"}
    assert {one.name for one in (tmp_path / "one").iterdir()} == names
    found = run("evaluate", path, "--episodes", 1, "--channel", channel, "--lockstep", "--against", "emulator")
    assert found.exit_code == 0, found.output
    assert "on the bus, 1 episodes" in found.output and "violations: 0" in found.output
    assert "difference +0 (95 % of +0 to +0, +0.0%; paired by seed)" in found.output
    assert int(emulated.read(0x6041)[0]) & 0x4F == 0x40
    found = run("evaluate", path, "--episodes", 1, "--against", tmp_path / "one" / "report.json", "--json")
    assert json.loads(found.output)["gap"][0].startswith("gap of RMS following error")


def test_an_interface_in_the_environment_moves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", "socket://127.0.0.1:9")
    found = run("evaluate", agent(tmp_path / "agent.npz"), "--episodes", 1)
    assert found.exit_code == 0 and "on the emulator" in found.output


def test_a_policy_that_sticks_ends_the_command_with_a_line(tmp_path, served):
    channel, emulated = served
    path = agent(tmp_path / "agent.npz", mode="csv", duration=0.5)
    made = Bundle.load(path)
    stuck = bundle(arrays=dict(made.arrays) | {"bias_0": np.full(1, 9.0, np.float32)}, configuration=made.configuration)
    stuck.save(path)
    found = run("evaluate", path, "--channel", channel, "--lockstep")
    assert found.exit_code == 1 and "Traceback" not in found.output
    assert "drive-agent: entry 0 of the policy's action has been at the end of its range for 100 ms" in found.output
    assert int(emulated.read(0x6041)[0]) & 0x4F == 0x40


def test_recorded_episodes_are_repeated(tmp_path):
    found = evaluate(Gentle(), "tracking", SHORT, episodes=2)
    path = tmp_path / "episodes.npz"
    episode_log.save(path, found.environment, found.configuration, found.episodes)
    same = episode_log.repeat(Gentle(), episode_log.load(path))
    assert same == (0.0, 0.0, 100)

    class Other(Gentle):
        def act(self, observation):
            return super().act(observation) + np.float32(0.25)

    assert episode_log.repeat(Other(), episode_log.load(path))[:2] == pytest.approx((0.25, 0.25))
    told = run("evaluate", agent(tmp_path / "agent.npz"), "--replay", path)
    assert told.exit_code == 0 and "100 recorded steps: the policy's actions lie within" in told.output


def test_a_recorded_move_says_how_far_the_emulator_lies_from_it(tmp_path):
    path = tmp_path / "move.csv"
    with EmulatedDrives(load="two_mass", num_threads=1) as drives:
        motion.enable(drives, mode="csp")
        profile = np.rint(0.5 * TURN * (1.0 - np.cos(np.arange(400) / 40))).astype(int)
        trace = drives.record([0x6064], 0.4, play={0x607A: profile})
    rows = ["t [s],607Ah:00 Target position (node 1),6064h:00 Position actual value (node 1)"]
    rows += [f"{k / 1000:.3f},{profile[k]},{trace[0x6064][k, 0]}" for k in range(400)]
    path.write_text("\n".join(rows))
    policy = agent(tmp_path / "agent.npz")
    told = run("evaluate", policy, "--replay", path, "--json")
    assert told.exit_code == 0 and json.loads(told.output)["6064h"]["nrmse"] < 1e-3  # the same machine
    assert "6064h: the emulator lies 0.0" in run("evaluate", policy, "--replay", path).output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.npz",), "there is no file nowhere.npz"),
        (("agent.tflite",), "is no policy; give an agent"),
        (("nowhere:policy",), "module 'nowhere' cannot be imported"),
        (("json:nothing",), "json has no 'nothing'; it has"),
        (("test_agents_evaluate:gentle",), "does not say its environment; give --environment"),
        (("nothing", "-e", "walking"), "there is no environment 'walking'"),
        (("feed_forward", "-e", "gain_tuning"), "has no baseline 'feed_forward'; it has nothing"),
        (("nothing", "-e", "tracking", "--episodes", "0"), "--episodes 0 is too small"),
        (("nothing", "-e", "tracking", "--load", "moon"), "moon"),
        (("nothing", "-e", "tracking", "--replay", "no.npz"), "there is no file no.npz"),
        (("nothing", "-e", "tracking", "--channel", "socket://127.0.0.1:9"), "nobody answers at socket://127.0.0.1:9"),
    ],
)
def test_a_mistake_is_told_in_one_line(arguments, message):
    found = run("evaluate", *arguments)
    assert found.exit_code == 2 and message in found.output and "Traceback" not in found.output


@pytest.mark.parametrize(
    ("spec", "environment"),
    [("test_agents_evaluate:gentle", "tracking"), ("test_agents_evaluate:Gentle", "tracking")],
)
def test_python_functions_and_classes_are_policies(spec, environment, tmp_path):
    config = tmp_path / "tracking.toml"
    config.write_text('load = "two_mass"\nduration = 0.05\n')
    found = run("evaluate", spec, "-e", environment, "--config", config, "--episodes", 2)
    assert found.exit_code == 0 and f"{spec} in ServoDrive/Tracking-v0 on the emulator, 2 episodes" in found.output
    with pytest.raises(PolicyNotFoundError):
        open_policy("test_agents_evaluate:TURN")


# --- ONNX -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["mlp", "lstm"])
@pytest.mark.parametrize(("activation", "output"), [("tanh", "clip"), ("relu", "tanh"), ("elu", "clip"),
                                                    ("silu", "tanh"), ("leaky_relu", "clip")])  # fmt: skip
def test_an_export_acts_as_the_original(kind, activation, output, tmp_path):
    pytest.importorskip("onnxruntime")
    from agents.onnx_export import TOLERANCE, compare, export

    made = bundle(kind, activation, output)
    assert export(made, tmp_path / "agent.onnx") <= TOLERANCE
    assert compare(made, tmp_path / "agent.onnx", lambda rows: policy_of(made).act(rows) + 1.0) > 0.4
    loaded = open_policy(str(tmp_path / "agent.onnx"))
    assert loaded.environment == made.environment and loaded.configuration == made.configuration
    assert loaded.card == made.card


def test_an_onnx_policy_refuses_what_is_no_number(tmp_path):
    pytest.importorskip("onnxruntime")
    from agents.onnx_export import export
    from agents.onnx_policy import OnnxPolicy

    export(bundle(), tmp_path / "agent.onnx")
    policy = OnnxPolicy(tmp_path / "agent.onnx")
    assert np.allclose(policy.act(observations()), policy_of(bundle()).act(observations()), atol=1e-5)
    with pytest.raises(PolicyError, match="is no number"):
        policy.act(np.full(ENTRIES, np.nan))
    with pytest.raises(PolicyError, match="does not take this observation"):
        policy.act(np.zeros(ENTRIES + 1))
    (tmp_path / "no.onnx").write_bytes(b"no")
    with pytest.raises(BundleError, match="is no ONNX model"):
        OnnxPolicy(tmp_path / "no.onnx")


def test_the_export_command_prints_differences_and_latency(tmp_path):
    pytest.importorskip("onnxruntime")
    path = agent(tmp_path / "agent.npz")
    found = run("export", path)
    assert found.exit_code == 0 and "largest difference from NumPy" in found.output
    assert re.search(r"NumPy: median \d+ µs.*\nonnxruntime: median \d+ µs", found.output)
    assert (tmp_path / "agent.onnx").is_file()
    assert run("export", path, "--out", tmp_path / "agent.txt").exit_code == 2
    assert run("evaluate", tmp_path / "agent.onnx", "--episodes", 1).exit_code == 0
