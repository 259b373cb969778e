"""Any policy, judged on emulated machines and on a bus by the same command; exports that act as the original."""

from __future__ import annotations

import json
import pickle
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.agent_files import ENTRIES, bundle, observations
from rigs.world_bus import on_bus
from typer.testing import CliRunner

from agents.commands.cli import app
from agents.evaluation import episode_log, evaluation_plots, gap
from agents.evaluation.evaluation import Evaluation, GivenDrives, as_on_a_bus, evaluate
from agents.evaluation.evaluation_shards import Written, evaluate_elsewhere
from agents.evaluation.on_the_bus import target_for
from agents.evaluation.open_policy import PolicyNotFoundError, open_policy, opened
from agents.evaluation.scores import interval
from agents.evaluation.served import draw_machines, emulated
from agents.evaluation.sim_versus_bus import ROBUST_COST, on_both_sides
from agents.policies.agent_file import AgentFile, BundleError
from agents.policies.guard import GuardLimits
from agents.policies.policy import PolicyError, policy_of
from agents.seeds import EVALUATION
from agents.tasks import make_environments
from drive_env import EmulatedDrives, Limits, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.envs.gain_observation import IDENTIFIED
from drive_env.envs.gain_tuning import GainTuning, GainTuningConfig

pytestmark = pytest.mark.usefixtures("files_read_here")
SHORT = {"load": "two_mass", "mode": "csp", "action": "offset", "duration": 0.05}
SCORE = "RMS following error [rev]"
TURN = 65536
PATIENT = GuardLimits(saturation=None, stall=30.0)


class Gentle:
    def act(self, observation):
        return np.clip(0.1 * observation[:, :1], -1, 1).astype(np.float32)

    def reset(self, mask=None):
        pass


def gentle(observation):  # module:function of the command line
    return Gentle().act(observation)


def broken(observation):
    return {}["speed"]


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
def served(tmp_path, monkeypatch):
    """A node on a hub, in lockstep, and a folder of its own for what a command leaves."""
    monkeypatch.chdir(tmp_path)
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
    held = [found.low <= 1.0 <= found.high for found in (interval(rng.exponential(1.0, 40)) for _ in range(300))]
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
    monkeypatch.setattr("agents.evaluation.evaluation.LANES", 2)
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
    monkeypatch.setattr("agents.evaluation.evaluation.LANES", 1)
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
        ("gain_tuning", {"trials": 2}, "robust cost (emulator)"),
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
        begun = [float(episode.first["robust_cost"]) for episode in found.episodes]
        assert found.values[figure] == pytest.approx(begun, rel=0.1)


class Bold(Gentle):
    """A tuner that tries ever stiffer gains, and stays with those of one of its trials; trial 0 is the rule."""

    def __init__(self, trial):
        self.trial, self.seen = trial, []

    def reset(self, mask=None):
        self.seen = []

    def act(self, observation):
        self.seen.append(observation)
        # Each time by another step: where an incumbent stays, the same gains are not tried twice.
        return np.full((len(observation), 3), 0.2 + 0.02 * len(self.seen), np.float32)

    def answer(self, observation):
        last, best = (slice(len(IDENTIFIED) + k * 3, len(IDENTIFIED) + (k + 1) * 3) for k in range(2))
        return ([*self.seen, observation][self.trial][:, last] - observation[:, best]) / GainTuningConfig().step


@pytest.mark.every(3)
@pytest.mark.parametrize("trial", [0, 1, 3])
def test_a_tuner_is_judged_by_its_own_answer_not_by_the_incumbent(trial):
    """What the environment told of that trial, on drawn machines and on given drives."""
    told = []

    class Listening(GainTuning):
        def step(self, action):
            found = super().step(action)
            told.append(found[4])
            return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drive_env.envs.gain_tuning.GainTuning", Listening)
        found = evaluate(Bold(trial), "gain_tuning", {"trials": 3}, episodes=2)
    for lane, episode in enumerate(found.episodes):
        names = {"robust_cost": "trial_robust_cost", "measured": "trial_measured", "gains": "trial_gains"}
        for own, name in names.items():
            expected = episode.first[own] if trial == 0 else told[trial - 1][name][lane]
            assert np.array_equal(episode.last[own], expected), own


def test_an_answer_that_was_never_tried_is_refused():
    class Guessing(Bold):
        def answer(self, observation):
            return np.full((len(observation), 3), 0.123)

    with pytest.raises(ValueError, match="answered gains that it had not tried"):
        evaluate(Guessing(0), "gain_tuning", {"trials": 2}, episodes=2)


def test_a_policy_on_a_bus_has_half_as_far_again_as_its_task_and_twice_its_speed(served):
    channel, emulated = served
    at = int(emulated.read(0x6064)[0])
    task = SHORT | {"amplitude": 1.0, "speed": 10.0}
    with target_for("tracking", task, PATIENT, channel=channel, lockstep=True) as target:
        limits = target.drives.safety.limits
    assert limits.position == ([at - 3 * TURN // 2], [at + 3 * TURN // 2]) and limits.velocity == [20 * TURN]
    assert limits.oscillation and limits.stall == PATIENT.stall


def test_a_real_motor_turns_only_if_its_way_is_said_to_be_clear(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run("evaluate", "tracking_two_mass", "--channel", "socket://127.0.0.1:1", "--node", 3)
    assert (found.exit_code, found.stderr) == (
        2, "drive-agent: The motor of node 3 will turn. Is its way clear? There is no terminal to ask; confirm with "
           "--yes\n",
    )  # fmt: skip
    monkeypatch.setattr("drive_env.commands.options.sys", SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True)))
    monkeypatch.setattr("typer.confirm", lambda question: False)
    found = run("evaluate", "tracking_two_mass", "--channel", "socket://127.0.0.1:1", "--node", 3)
    assert (found.exit_code, found.stderr) == (1, "drive-agent: nothing was changed\n")
    assert not any(tmp_path.iterdir())


def test_a_report_is_saved_and_loaded(tmp_path):
    found = evaluate(Gentle(), "tracking", SHORT, episodes=2)
    again = Evaluation.load(found.save(tmp_path / "report.json"))
    assert again.values == found.values and again.seeds == found.seeds and again.side == "emulator"
    (tmp_path / "no.json").write_text("{}")
    with pytest.raises(ValueError, match="is not a report of `drive-agent evaluate`"):
        Evaluation.load(tmp_path / "no.json")


# --- both sides -------------------------------------------------------------------------------------------------------
def test_over_can_in_lockstep_actions_and_figures_are_the_same():
    found = {}
    with EmulatedDrives(load="two_mass", num_threads=1) as emulated:
        found["emulator"] = evaluate(
            Gentle(), "tracking", SHORT, on=GivenDrives(as_on_a_bus(emulated), guard=PATIENT, side="one"), episodes=2
        )
    with on_bus(EmulatedDrives(load="two_mass", num_threads=1), safety=Limits(velocity=100 * TURN)) as drives:
        found["bus"] = evaluate(Gentle(), "tracking", SHORT, on=GivenDrives(drives, guard=PATIENT), episodes=2)
    for one, two in zip(found["emulator"].episodes, found["bus"].episodes, strict=True):
        assert np.array_equal(one.actions, two.actions) and np.array_equal(one.observations, two.observations)
    for row in gap.compare(found["emulator"], found["bus"]):
        assert row.paired and row.difference[:3] == (0.0, 0.0, 0.0)


class Acting(Gentle):
    """Acts on what it sees, in any environment."""

    def __init__(self, actions):
        self._weights = 0.2 * np.random.default_rng(3).standard_normal((64, actions))

    def act(self, observation):
        return np.clip(observation @ self._weights[: observation.shape[1]], -1.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "options", "actions", "score"),
    [
        ("tracking", SHORT, 1, SCORE),
        ("tracking", {"load": "inverted_pendulum", "duration": 0.05}, 1, "time lasted [of the episode]"),
        ("gain_scheduling", {"load": "belt", "duration": 0.1}, 3, "tracking term [0...1]"),
        ("gain_scheduling", {"load": "two_mass", "mode": "csv", "excitation": "sine", "duration": 0.1}, 3,
         "tracking term [0...1]"),
        ("gain_tuning", {"trials": 2}, 3, ROBUST_COST),
    ],
)  # fmt: skip
def test_on_the_same_drawn_machines_the_gap_in_lockstep_is_nothing(environment, options, actions, score):
    """Each machine in this process and behind its own hub, for all environments, sensors and modes."""
    both = on_both_sides(Acting(actions), environment, options, machines=2, seed=5, lockstep=True, guard=PATIENT)
    assert both.missing == {} and both.inside.score == score and both.inside.seeds == [5, 6]
    first, second = both.inside.values[score]
    assert first != second or score.startswith("time")  # other machines
    for one, two in zip(both.inside.episodes, both.bus.episodes, strict=True):
        assert np.array_equal(one.actions, two.actions) and np.array_equal(one.observations, two.observations)
    assert both.bus.values == both.inside.values


def test_a_machine_that_cannot_be_judged_is_missing_on_both_sides():
    class Wild(Gentle):
        runs = 0

        def reset(self, mask=None):
            self.runs += 1

        def act(self, observation):
            last_one = self.runs > 10  # two machines, twice each: warm-up and episodes
            return np.full((len(observation), 1), np.nan if last_one else 0.1)

    both = on_both_sides(Wild(), "tracking", SHORT, machines=3, lockstep=True, guard=PATIENT)
    assert list(both.missing) == [2] and "is nan, not a number" in both.missing[2]
    assert both.inside.seeds == both.bus.seeds == [0, 1]


@pytest.mark.slow
def test_in_real_time_machines_are_served_by_processes_of_their_own(tmp_path):
    """How large the gap is a busy computer may say as it likes; that both sides are the same machine it may not."""
    both = on_both_sides(Gentle(), "tracking", SHORT, machines=1, seed=3, guard=GuardLimits(saturation=None, stall=30))
    if not both.missing:
        assert both.bus.side == "bus" and both.again is not None
        assert both.inside.values[SCORE] != both.again.values[SCORE]  # other noise
        assert both.bus.values[SCORE][0] == pytest.approx(both.inside.values[SCORE][0], rel=20.0)
        path = evaluation_plots.save_gap(both.inside, both.bus, tmp_path)
        assert path.stat().st_size > 10_000


def test_drawn_machines_are_those_of_the_seed_and_number():
    config = make_environments("tracking", 1, SHORT | {"distributions": "two_mass"}).config
    three, five = draw_machines(config, 3, 7), draw_machines(config, 5, 7)
    assert five[:3] == three and three[0].parameters != three[1].parameters
    assert draw_machines(config, 1, 8)[0] != three[0]
    with emulated(three[1], 0) as drives:
        found = drives.machine.parameters
    assert {name: float(found[name][0]) for name in three[1].parameters} == pytest.approx(three[1].parameters)


def test_machines_of_a_named_set_have_what_their_devices_machines_have():
    config = make_environments("StepperRun", 1).config
    (stepper,) = draw_machines(config, 1, 0)
    assert "motor.L_s" in stepper.parameters and "motor.L_d" not in stepper.parameters


def test_a_gap_is_found_and_told():
    one = Evaluation("p", "ServoDrive/Tracking-v0", {}, "emulator", [1, 2, 3], {SCORE: [1.0, 2.0, 3.0]}, {}, {})
    two = Evaluation("p", "ServoDrive/Tracking-v0", {}, "bus", [1, 2, 3], {SCORE: [1.5, 2.5, 3.5]}, {}, {})
    [row] = gap.compare(one, two)
    assert not row.paired and row.difference.mean == 0.5 and row.difference.low < 0.0 < row.difference.high
    two.side = "emulator"  # which draws the same machines for the same seeds
    assert gap.compare(one, two)[0].paired
    two.configuration = {"load": "inertia"}
    assert not gap.compare(one, two)[0].paired
    two.side, two.configuration = "bus", {}
    one.side = "emulator as on a bus"
    [row] = gap.compare(one, two)
    assert row.paired and row.difference[:3] == (0.5, 0.5, 0.5)
    assert "difference +0.5 (95 % of +0.5 to +0.5, +25.0%; paired by seed)" in gap.text([row], "a", "b")[0]
    low, value, high = row.medians
    assert value == pytest.approx(0.25) and pytest.approx(high) == 1.5 / 1.0 - 1.0 and low == pytest.approx(1.0 / 6.0)
    assert "medians 2 and 2.5, +25.0% (95 % of +16.7% to +50.0%)" in gap.text([row], "a", "b")[0]
    two.environment = "ServoDrive/GainTuning-v0"
    with pytest.raises(ValueError, match="they are different tasks"):
        gap.compare(one, two)


# --- the command ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_command_on_both_sides_and_the_gap(tmp_path, served):
    channel, emulated = served
    path = agent(tmp_path / "agent.npz")
    found = run("evaluate", path, "--episodes", 2, "--out", tmp_path / "one")
    assert found.exit_code == 0 and re.search(r"RMS following error \[rev\]: \S+ \(95 % of", found.output)
    names = {"report.json", "episodes.npz", "figures.png", "episodes.png"}
    assert {one.name for one in (tmp_path / "one").iterdir()} == names
    bus = ("--channel", channel, "--lockstep", "--stall", 30)
    found = run("evaluate", path, "--episodes", 1, *bus, "--against", "emulator")
    assert found.exit_code == 0, found.output
    assert "on the bus, 1 episodes" in found.output and "violations: 0" in found.output
    assert "difference +0 (95 % of +0 to +0, +0.0%; paired by seed)" in found.output
    assert int(emulated.read(0x6041)[0]) & 0x4F == 0x40
    found = run("evaluate", path, "--episodes", 1, "--against", tmp_path / "one" / "report.json", "--json")
    assert json.loads(found.output)["gap"][0].startswith("gap of RMS following error")
    found = run("evaluate", path, "--episodes", 2, "--against", tmp_path / "one" / "report.json", "--json")
    assert "difference +0 (95 % of +0 to +0, +0.0%; paired by seed)" in json.loads(found.output)["gap"][0]


def test_a_profile_velocity_beyond_the_tasks_limit_is_lowered_and_put_back(tmp_path, served, caplog):
    channel, emulated = served
    before = int(emulated.read("Profile velocity")[0])
    path = agent(tmp_path / "agent.npz", speed=10.0)  # limit 20 rev/s, the preset's is 33
    assert before > 20 * TURN
    found = run("evaluate", path, "--episodes", 2, "--channel", channel, "--lockstep", "--stall", 30)
    assert found.exit_code == 0, found.output
    assert "could not be restored" not in caplog.text
    assert int(emulated.read("Profile velocity")[0]) == before


def test_an_interface_in_the_environment_moves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", "socket://127.0.0.1:9")
    found = run("evaluate", agent(tmp_path / "agent.npz"), "--episodes", 1)
    assert found.exit_code == 0 and "on the emulator" in found.output


def test_a_policy_that_sticks_ends_the_command_with_a_line(tmp_path, served):
    channel, emulated = served
    path = agent(tmp_path / "agent.npz", mode="csv", duration=0.5)
    made = AgentFile.load(path)
    stuck = bundle(arrays=dict(made.arrays) | {"bias_0": np.full(1, 9.0, np.float32)}, configuration=made.configuration)
    stuck.save(path)
    found = run("evaluate", path, "--channel", channel, "--lockstep", "--stall", 30)
    assert found.exit_code == 1 and "Traceback" not in found.output
    assert "drive-agent: entry 0 of the policy's action has been at the end of its range for 100 ms" in found.output
    assert int(emulated.read(0x6041)[0]) & 0x4F == 0x40


def test_episodes_are_a_dataset_of_minari(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    options = ("evaluate", agent(tmp_path / "agent.npz", mode="csv", duration=0.05), "--episodes", 2)
    told = run(*options, "--out", tmp_path / "out", "--minari", "servo/two-mass-v0")
    assert told.exit_code == 0, told.output
    dataset = minari.load_dataset("servo/two-mass-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (2, 100)
    recorded = episode_log.load(tmp_path / "out" / "episodes.npz")
    for k, episode in enumerate(dataset.iterate_episodes()):
        np.testing.assert_array_equal(episode.observations[:-1], recorded.observations[k])
        np.testing.assert_array_equal(episode.actions, recorded.actions[k])
        assert np.flatnonzero(episode.truncations).tolist() == [49] and not episode.terminations.any()
    env = dataset.recover_environment()
    assert env.spec.max_episode_steps == 50 and env.unwrapped.vector.config.mode == "csv"
    np.testing.assert_array_equal(env.reset(seed=recorded.seeds[1])[0], recorded.observations[1][0])
    env.close()
    for name, says in (("servo/two-mass-v0", "there is such a dataset"), ("two mass", "name has a version")):
        told = run(*options, "--minari", name)
        assert told.exit_code == 2 and says in told.output and "Traceback" not in told.output


def test_a_dataset_without_minari_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    told = run("evaluate", agent(tmp_path / "agent.npz"), "--minari", "servo/two-mass-v0")
    assert told.exit_code == 2 and "pip install 'drive-env[minari]'" in told.output


def test_recorded_episodes_are_repeated(tmp_path):
    found = evaluate(Gentle(), "tracking", SHORT, episodes=2)
    path = tmp_path / "episodes.npz"
    episode_log.save(path, found.environment, found.configuration, found.episodes)
    with np.load(path) as stored:
        for k, (episode, steps) in enumerate(zip(found.episodes, np.split(np.arange(100), 2), strict=True)):
            np.testing.assert_array_equal(stored["rewards"][steps], episode.rewards)
            np.testing.assert_array_equal(stored["final_observations"][k], episode.observations[-1])
        assert np.flatnonzero(stored["truncations"]).tolist() == [49, 99] and not stored["terminations"].any()
    tripped = [found.episodes[0]._replace(terminated=True), found.episodes[1]]
    episode_log.save(tmp_path / "tripped.npz", found.environment, found.configuration, tripped)
    with np.load(tmp_path / "tripped.npz") as stored:
        ends = [np.flatnonzero(stored[name]).tolist() for name in ("terminations", "truncations")]
    assert ends == [[49], [99]]
    same = episode_log.repeat(Gentle(), episode_log.load(path))
    assert same == (0.0, 0.0, 100)

    class Other(Gentle):
        def act(self, observation):
            return super().act(observation) + np.float32(0.25)

    assert episode_log.repeat(Other(), episode_log.load(path))[:2] == pytest.approx((0.25, 0.25))
    told = run("evaluate", agent(tmp_path / "agent.npz"), "--replay", path)
    assert told.exit_code == 0 and "100 recorded steps: the policy's actions lie within" in told.output
    told = run("evaluate", "test_agents_evaluate:gentle", "--replay", path, "--json")  # its environment is recorded
    assert json.loads(told.output) == {"largest": 0.0, "rms": 0.0, "steps": 100}
    told = run("evaluate", "gain_tuning", "--replay", path)
    assert told.exit_code == 2 and "was recorded in ServoDrive/Tracking-v0, and gain_tuning acts in" in told.output
    told = run("evaluate", "tracking_inverted_pendulum", "--replay", path)  # sees a pole besides
    assert told.exit_code == 1 and "the policy takes 10 entries" in told.output


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
    assert "6064h: deviation of the emulator 0.0" in run("evaluate", policy, "--replay", path).output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.npz",), "there is no file nowhere.npz"),
        (("agent.tflite",), "or a baseline (cascade, expert, feed_forward, nominal, nothing, oracle, rest, "),
        (("feed_forward", "-e", "tracking"), "adds to the profile, and action is 'direct'"),
        (("state_feedback", "-e", "tracking"), "is for load inverted_pendulum, mode cst and action direct alone"),
        (("nowhere:policy",), "module 'nowhere' cannot be imported"),
        (("json:nothing",), "json has no 'nothing'; it has"),
        (("test_agents_evaluate:gentle",), "does not name its environment; give --environment"),
        (("nothing", "-e", "walking"), "there is no environment 'walking'"),
        (("feed_forward", "-e", "gain_tuning"), "has no baseline 'feed_forward'; it has nothing"),
        (("nothing", "-e", "tracking", "--episodes", "0"), "--episodes 0 is too small"),
        (("nothing", "-e", "tracking", "--load", "moon"), "moon"),
        (("nothing", "-e", "tracking", "--replay", "no.npz"), "there is no file no.npz"),
        (
            ("nothing", "-e", "tracking", "--channel", "socket://127.0.0.1:9", "--yes"),
            "no hub answers at socket://127.0.0",
        ),
        (("nothing", "-e", "tracking", "--lockstep"), "--lockstep is for a bus; give its --channel, or --gap"),
        (("nothing", "-e", "tracking", "--gap", "0"), "--gap 0 is too small"),
        (("nothing", "-e", "tracking", "--gap", "2", "--node", "1"), "leave --node out"),
        (("tracking_inverted_pendulum", "--gap", "2"), "evaluate it with --lockstep"),
        (("nothing", "-e", "tracking", "--stall", "-1"), "--stall -1 must be a time [s], 0 for no limit"),
        (("nothing", "-e", "tracking", "--seed", "-3"), "--seed -3 is too small"),
        (("gain_tuning", "-e", "tracking"), "acts in ServoDrive/GainTuning-v0, not in ServoDrive/Tracking-v0"),
        (("nobody",), "give an agent that ships (arm_path, gain_tuning, "),
        (("test_agents_evaluate:gentle", "--card"), "has no card"),
    ],
)
def test_a_mistake_is_told_in_one_line(arguments, message):
    found = run("evaluate", *arguments)
    assert found.exit_code == 2 and message in found.output and "Traceback" not in found.output


@pytest.mark.parametrize(
    ("spec", "environment"), [("test_agents_evaluate:gentle", "tracking"), ("test_agents_evaluate:Gentle", "tracking")]
)
def test_python_functions_and_classes_are_policies(spec, environment, tmp_path):
    config = tmp_path / "tracking.toml"
    config.write_text('load = "two_mass"\nduration = 0.05\n')
    found = run("evaluate", spec, "-e", environment, "--config", config, "--episodes", 2)
    assert found.exit_code == 0 and f"{spec} in ServoDrive/Tracking-v0 on the emulator, 2 episodes" in found.output
    with pytest.raises(PolicyNotFoundError):
        open_policy("test_agents_evaluate:TURN")


def test_an_agent_that_ships_goes_by_its_name_and_shows_its_card():
    found = run("evaluate", "tracking_two_mass", "--card")
    assert found.exit_code == 0 and "environment: ServoDrive/Tracking-v0" in found.output
    assert "trained: ppo of Stable-Baselines3" in found.output and "RMS following error [rev]:" in found.output
    assert json.loads(run("evaluate", "gain_tuning", "--card", "--json").output)["machines"] > 1000
    assert run("evaluate", "tracking_two_mass", "--episodes", 1).exit_code == 0


def test_another_load_brings_its_own_machines():
    found = run("evaluate", "tracking_two_mass", "--load", "belt", "--episodes", 1)
    assert found.exit_code == 0, found.output


def test_what_the_policy_breaks_is_told_in_one_line():
    found = run("evaluate", "test_agents_evaluate:broken", "-e", "tracking", "--episodes", 1)
    assert found.exit_code == 1 and "Traceback" not in found.output
    assert "the policy failed: KeyError: 'speed'" in found.output and "test_agents_evaluate.py, line" in found.output


@pytest.mark.slow
def test_the_gap_as_a_command(tmp_path):
    path = agent(tmp_path / "agent.npz")
    found = run("evaluate", path, "--gap", 2, "--lockstep", "--stall", 30, "--out", tmp_path / "out")
    assert found.exit_code == 0, found.output
    assert "on the bus, 2 episodes" in found.output
    assert "difference +0 (95 % of +0 to +0, +0.0%; paired by seed)" in found.output
    assert {"gap.png", "gap.txt", "report.json", "report-in-process.json"} <= {
        p.name for p in (tmp_path / "out").iterdir()
    }
    stored = [Evaluation.load(tmp_path / "out" / name) for name in ("report.json", "report-in-process.json")]
    assert stored[0].values == stored[1].values and stored[0].side != stored[1].side


# --- ONNX -------------------------------------------------------------------------------------------------------------
@pytest.mark.every(10)
@pytest.mark.parametrize("kind", ["mlp", "lstm"])
@pytest.mark.parametrize(("activation", "output"), [("tanh", "clip"), ("relu", "tanh"), ("elu", "clip"),
                                                    ("silu", "tanh"), ("leaky_relu", "clip")])  # fmt: skip
def test_an_export_acts_as_the_original(kind, activation, output, tmp_path):
    pytest.importorskip("onnxruntime")
    from agents.policies.onnx_export import TOLERANCE, compare, export

    made = bundle(kind, activation, output)
    assert export(made, tmp_path / "agent.onnx") <= TOLERANCE
    assert compare(made, tmp_path / "agent.onnx", lambda rows: policy_of(made).act(rows) + 1.0) > 0.4
    loaded = open_policy(str(tmp_path / "agent.onnx"))
    assert loaded.environment == made.environment and loaded.configuration == made.configuration
    assert loaded.card == made.card


def test_an_onnx_policy_refuses_what_is_no_number(tmp_path):
    pytest.importorskip("onnxruntime")
    from agents.policies.onnx_export import export
    from agents.policies.onnx_policy import OnnxPolicy

    export(bundle(), tmp_path / "agent.onnx")
    policy = OnnxPolicy(tmp_path / "agent.onnx")
    assert np.allclose(policy.act(observations()), policy_of(bundle()).act(observations()), atol=1e-5)
    with pytest.raises(PolicyError, match="is not a number"):
        policy.act(np.full(ENTRIES, np.nan))
    with pytest.raises(PolicyError, match="does not take this observation"):
        policy.act(np.zeros(ENTRIES + 1))
    (tmp_path / "no.onnx").write_bytes(b"no")
    with pytest.raises(BundleError, match="is not an ONNX model"):
        OnnxPolicy(tmp_path / "no.onnx")


def test_the_export_command_prints_differences_and_latency(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    path = agent(tmp_path / "agent.npz")
    found = run("export", path)
    assert found.exit_code == 0 and "largest difference from NumPy" in found.output
    assert re.search(r"NumPy: median \d+ µs.*\nonnxruntime: median \d+ µs", found.output)
    assert (tmp_path / "agent.onnx").is_file()
    assert run("export", path, "--out", tmp_path / "agent.txt").exit_code == 2
    assert run("evaluate", tmp_path / "agent.onnx", "--episodes", 1).exit_code == 0
    monkeypatch.chdir(tmp_path)  # one that ships is written here, not beside the package's file
    assert run("export", "gantry_beam").exit_code == 0 and (tmp_path / "gantry_beam.onnx").is_file()


# --- on processes and clusters ----------------------------------------------------------------------------------------
DRAWN = SHORT | {"distributions": "two_mass"}


class Elsewhere:
    """A pool as a cluster is: tasks and results are pickled, and come back in another order."""

    width, shares_disk = 2, False

    def unordered(self, function, items, say=None, fits=None):
        for k, item in reversed(list(enumerate(items))):
            task = pickle.loads(pickle.dumps((function, item)))
            yield k, pickle.loads(pickle.dumps(task[0](task[1])))


@pytest.mark.every(3)
@pytest.mark.parametrize("policy", ["agent.npz", "feed_forward", "tracking_two_mass", "test_agents_evaluate:gentle"])
def test_rounds_elsewhere_give_the_same_files(policy, tmp_path, monkeypatch):
    monkeypatch.setattr("agents.evaluation.evaluation.LANES", 2)
    text = agent(tmp_path / "agent.npz") if policy == "agent.npz" else policy
    here = evaluate(opened(text, "ServoDrive/Tracking-v0", DRAWN).policy, "tracking", DRAWN, name=text, episodes=5)
    written = Written.of(text, trust=False)
    if policy == "agent.npz":
        (tmp_path / "agent.npz").unlink()  # of another computer
    told = []
    apart = evaluate_elsewhere(
        written, "tracking", DRAWN, Elsewhere(), name=text, episodes=5, seed=EVALUATION[0], told=told.append
    )
    assert told == pytest.approx([1 / 3, 2 / 3, 1.0])
    for one, folder in ((here, tmp_path / "here"), (apart, tmp_path / "apart")):
        folder.mkdir()
        one.save(folder / "report.json")
        episode_log.save(folder / "episodes.npz", one.environment, one.configuration, one.episodes)
    for name in ("report.json", "episodes.npz"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "apart" / name).read_bytes()


@pytest.mark.slow
def test_the_command_writes_the_same_bytes_on_processes(tmp_path):
    own = agent(tmp_path / "agent.npz", distributions="two_mass")
    for folder, more in (("here", ()), ("apart", ("--workers", 2))):
        found = run("evaluate", own, "--episodes", 70, "--out", tmp_path / folder, *more)
        assert found.exit_code == 0, found.output
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "apart").iterdir())
    for name in names:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "apart" / name).read_bytes(), name


@pytest.mark.parametrize(("more", "message"), [
    (("--bitrate", 500_000), "--bitrate is for a bus; give its --channel, or leave --bitrate out"),
    (("--device", "tmcm6212"), "--device is for a bus; give its --channel, or leave --device out"),
    (("--sensor", "a:b"), "--sensor is for a bus; give its --channel, or leave --sensor out"),
    (("--workers", 2, "--bus"), "--workers is for episodes on the emulator; leave it out on a bus, with --gap"),
    (("--cluster", "tcp://x:1", "--gap", 2), "--cluster is for episodes on the emulator; leave it out on a bus"),
    (("--workers", 0), "--workers 0 is below 1; give the number of processes"),
    (("--workers", 1, "--cluster", "tcp://x:1"), "choose one"),
])  # fmt: skip
def test_what_would_be_ignored_is_refused(more, message):
    found = run("evaluate", "tracking_two_mass", *more)
    assert (found.exit_code, message in " ".join(found.output.split())) == (2, True), found.output
