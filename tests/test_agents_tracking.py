"""Controllers of Tracking: what they are compared with, how their last layer is refined, and those that ship."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_agents_bundle import bundle as untrained

from agents.evaluation.evaluation import evaluate
from agents.evaluation.sim_versus_bus import on_both_sides
from agents.policies.agent_file import AgentFile
from agents.policies.baselines import ControlLaw, baseline, feed_forward
from agents.policies.guard import GuardLimits
from agents.policies.policy import policy_of
from agents.shipped import shipped, shipped_names
from agents.training.tasks import make_environments
from drive_env.envs.tracking import TASKS, TrackingConfig
from research import refinement, tracking_comparison
from research.refinement import ENVIRONMENT, Played, RefinementSearch, refine
from research.tracking_comparison import RIVALS, compare, identified_lags, ratio

CONTROLLERS = [name for name in shipped_names() if name.startswith("tracking_")]
RESIDUAL = ("tracking_gantry", "tracking_two_mass")
LEADING = RefinementSearch(start="feed_forward", options=(("mode", "csp"), ("action", "offset"), ("duration", 0.2)))
ERROR, CURRENT = "RMS following error [rev]", "RMS current [of the limit]"


def leading(load="two_mass"):
    """The cascade with feed-forward through 60B0h, as a linear controller."""
    return refinement.linear(load, LEADING)


# --- comparison -------------------------------------------------------------------------------------------------------
def test_a_ratio_holds_pairs_together():
    others = np.random.default_rng(0).lognormal(size=50)
    assert ratio(0.8 * others, others) == pytest.approx((0.8, 0.8, 0.8, 0.8, 50))


def test_a_ratio_s_interval_is_that_of_the_mean():
    """Over a constant the ratio is a mean: its interval is known in closed form."""
    values = np.random.default_rng(1).normal(1.0, 0.3, 400)
    found = ratio(values, np.full(400, 2.0))
    half = 1.96 * values.std() / np.sqrt(400) / 2.0
    assert (found.low, found.high) == pytest.approx((values.mean() / 2.0 - half, values.mean() / 2.0 + half), rel=0.01)


def test_lags_are_found_in_what_they_make():
    rng = np.random.default_rng(2)
    speed, acceleration = rng.normal(size=(2, 400, 3, 2))
    lag, lag_of_speed = np.array([0.01, 0.03, 0.05])[:, None], 1e-3 * np.array([[1.0, 2.0]])
    found = identified_lags(lag * speed + lag_of_speed * acceleration, speed, acceleration)
    assert found[0] == pytest.approx(np.broadcast_to(lag, (3, 2)))
    assert found[1] == pytest.approx(np.broadcast_to(lag_of_speed, (3, 2)))


def test_the_lag_identified_on_a_machine_is_that_of_its_position_gain(monkeypatch):
    """A P loop in front of a PI loop follows a ramp 1/k_v behind: 2043h:01 = 118 is k_v = 31.5/s."""
    seen = []
    monkeypatch.setattr(tracking_comparison, "feed_forward", lambda config, lags: seen.append(lags) or nothing())
    made = replace(leading(), configuration={**leading().configuration, "distributions": None, "duration": 1.0})
    compare(made, 2, 7, ["csp with 60B0h identified on each machine"])
    assert seen[0][0] == pytest.approx(1 / 31.5, rel=0.06)


def nothing():
    return ControlLaw(lambda rows: np.zeros((len(rows), 1)))


def test_a_controller_that_is_the_rival_is_no_better_and_no_worse():
    made = leading()
    found = compare(made, 3, 11, ["csp with 60B0h", "csv with 60B1h"])
    assert found.fell == 0
    for row in found.ratios["csp with 60B0h"].values():
        assert row[:4] == pytest.approx((1.0, 1.0, 1.0, 1.0), abs=1e-3)
    assert found.ratios["csv with 60B1h"][ERROR].mean != pytest.approx(1.0, abs=0.01)
    told = found.table()
    assert told[ERROR]["mean"] == found.own[ERROR].mean() and set(told["against"]) == set(found.ratios)


def test_what_is_compared_is_what_drive_agent_evaluate_says():
    made = leading("gantry")
    found = compare(made, 2, 21, [])
    judged = evaluate(policy_of(made), ENVIRONMENT, made.configuration, episodes=2, seed=21)
    assert found.own.keys() == judged.values.keys() and found.ratios == {} and "against" not in found.table()
    for name, values in judged.values.items():
        assert found.own[name] == pytest.approx(values)


def test_a_tuned_cascade_has_velocity_gains_for_its_inertia():
    """Stiff shaft, so that inertia is rotor and disc; what a drive measures is inertia over torque constant."""
    lanes = make_environments(ENVIRONMENT, 2, {"load": "inertia", "mode": "csp", "action": "offset"})
    drives = lanes.drives
    commissioned = drives.read((0x2042, 1))
    drives.machine.set("load.inertia", np.array([2e-6, 8e-6]))
    drives.machine.set("motor.psi_m", drives.motor.psi_m * np.array([1.0, 0.9]))
    tracking_comparison.tune(drives, commissioned)
    J_m = drives.motor.inertia
    wanted = commissioned * (J_m + np.array([2e-6, 8e-6])) / np.array([1.0, 0.9]) / (3.0 * J_m)
    assert drives.read((0x2042, 1)) == pytest.approx(wanted, abs=1)
    lanes.close()


def test_what_acts_directly_has_no_rival():
    with pytest.raises(ValueError, match="cascades are rivals of a controller with action = 'offset'"):
        compare(AgentFile.load(shipped("tracking_inverted_pendulum")), 1)


@pytest.mark.parametrize(
    ("mode", "lags", "action"),
    [
        ("csp", None, 0.096),  # (0.030 s * 2 rev/s + 3e-4 s^2 * 40 rev/s^2) of 1.25 * 0.3 * 2 rev
        ("csp", (0.06, 0.0), 0.16),
        ("csv", None, 0.2133),  # (60/s * 0.02 rev + 0.010 s * 40 rev/s^2) of 1.25 * 0.3 * 20 rev/s
    ],
)
def test_feed_forward_is_lag_times_motion(mode, lags, action):
    config = TrackingConfig(load="two_mass", mode=mode, action="offset")
    row = np.zeros((1, 8), np.float32)
    row[0, [0, 5, 6]] = 0.01, 0.1, 0.12  # 0.02 rev behind; 2 rev/s, and 2.4 rev/s 10 ms later
    assert feed_forward(config, lags).act(row) == pytest.approx(np.array([[action]]), abs=1e-4)


# --- refinement -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("load", ["two_mass", "gantry"])
def test_a_linear_controller_does_what_its_baseline_does(load):
    made = leading(load)
    lanes = make_environments(ENVIRONMENT, 1, made.configuration)
    axes, entries = lanes.single_action_space.shape[0], lanes.single_observation_space.shape[0]
    law = baseline("feed_forward", ENVIRONMENT, lanes.config, axes)
    lanes.close()
    rows = np.random.default_rng(3).uniform(-0.5, 0.5, (20, entries)).astype(np.float32)
    assert policy_of(made).act(rows) == pytest.approx(law.act(rows), abs=1e-5)


def network(**changes):
    """An untrained network for two_mass."""
    rng = np.random.default_rng(4)
    arrays = {
        "observation_mean": rng.normal(size=8), "observation_scale": rng.uniform(1.0, 2.0, 8),
        "action_low": -np.ones(1, np.float32), "action_high": np.ones(1, np.float32),
        "weight_0": rng.normal(size=(8, 16)).astype(np.float32), "bias_0": rng.normal(size=16).astype(np.float32),
        "weight_1": 0.03 * rng.normal(size=(16, 1)).astype(np.float32), "bias_1": np.full(1, 0.02, np.float32),
    }  # fmt: skip
    return untrained(arrays=arrays, **changes)


def test_features_and_last_layer_make_the_action():
    made = network()
    rows = np.random.default_rng(5).normal(size=(6, 8)).astype(np.float32)
    features = refinement.features_of(made)(rows)
    assert np.all(features[:, -1] == 1.0)
    expected = policy_of(made).act(rows)
    assert features @ refinement.last_layer(made) == pytest.approx(expected, abs=1e-6)
    changed = refinement.with_last_layer(made, 0.5 * refinement.last_layer(made))
    assert policy_of(changed).act(rows) == pytest.approx(0.5 * expected, abs=1e-6)


def test_a_direction_adds_its_entry_in_standard_deviations():
    """A linear controller's features are the observation itself, so that the change is exact; here of the error."""
    made = leading()
    lanes = make_environments(ENVIRONMENT, 4, made.configuration)
    features, layer = refinement.features_of(made), refinement.last_layer(made)
    found = refinement.directions_of(lanes, features, layer, np.arange(4))
    lanes.close()
    assert found.shape == (9, 8)
    rows = np.zeros((2, 8), np.float32)
    rows[1, 0] = 0.01
    added = features(rows) @ found[:, 0]
    assert added[0] == pytest.approx(0.0, abs=1e-2) and added[1] > 0.1
    others = np.abs(found[1:8, 0]) * np.array([1.0, 1.0, 1.0, 0.1, 1.0, 1.0, 1.0])
    assert np.all(others < 0.05 * found[0, 0])


def test_axes_act_as_one():
    layer = np.random.default_rng(6).normal(size=(5, 2))
    found = refinement.acting_as_one(layer)
    assert np.array_equal(found[:, 0], found[:, 1]) and found[:, 0] == pytest.approx(layer.mean(axis=1))
    moved = refinement.changes(np.eye(5), np.ones((3, 5)), 2)
    assert moved.shape == (3, 5, 2) and np.all(moved == 1.0)


def test_current_costs_what_is_above_the_rival_s():
    rival = Played(np.array([0.1, 0.3]), np.array([0.2, 0.2]), np.zeros(2))
    one = np.array([[0.05, 0.15], [0.05, 0.15]]), np.array([[0.1, 0.1], [0.22, 0.22]]), np.zeros((2, 2))
    found = refinement.cost(Played(*one), rival, np.array([0.5, 0.5]), RefinementSearch(limit=1.0, price=4.0))
    assert found == pytest.approx([0.5, 0.5 + 4.0 * 0.1])
    rewards = Played(np.ones((1, 2)), np.ones((1, 2)), np.array([[1.0, 3.0]]))
    assert refinement.cost(rewards, rival, np.array([0.75, 0.25]), RefinementSearch(rival="")) == pytest.approx([-1.5])


def test_refinement_repeats_and_makes_the_error_smaller():
    """From a cascade that leads by half of what it should."""
    whole = leading()
    half = refinement.with_last_layer(whole, 0.5 * refinement.last_layer(whole))
    search = RefinementSearch(
        limit=2.0, deviation=0.05, pool=12, hard=2, machines=4, candidates=8, elite=3, generations=6
    )
    told = []
    made = refine(half, search, 3, told=lambda generation, cost: told.append(generation))
    again = refine(half, search, 3)
    assert made.hash == again.hash and made.hash != half.hash and told == list(range(6))
    errors = [compare(one, 8, 31, []).own[ERROR].mean() for one in (half, made)]
    assert errors[1] < 0.8 * errors[0]


def test_only_networks_for_tracking_are_refined():
    with pytest.raises(ValueError, match=r"a network \(mlp\) for ServoDrive/Tracking-v0 can be refined, not surrogate"):
        refine(AgentFile.load(shipped("gain_tuning")), RefinementSearch())


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (refinement, ["fan.npz", "--out", "x.npz"], "is for the load 'fan'; there are searches for two_mass, gantry"),
        (refinement, ["--load", "two_mass", "--out", "x.npz"], "give an agent to refine, or one of the loads"),
        (refinement, ["none.npz", "--out", "x.npz"], "there is no file none.npz"),
        (tracking_comparison, ["nobody"], "no agent named 'nobody' ships"),
        (tracking_comparison, ["tracking_gantry", "--episodes", "0"], "--episodes 0 must be 1 or more"),
    ],
)
def test_mistakes_in_a_command_are_told_in_a_line(tmp_path, monkeypatch, capsys, module, arguments, message):
    monkeypatch.chdir(tmp_path)
    network(configuration={"load": "fan"}).save("fan.npz")
    monkeypatch.setattr("sys.argv", ["command", *arguments])
    with pytest.raises(SystemExit) as ended:
        module.main()
    assert ended.value.code == 2 and message in capsys.readouterr().err


def test_the_commands_refine_compare_and_write_the_card(tmp_path, monkeypatch, capsys):
    path, out = leading().save(tmp_path / "agent.npz"), tmp_path / "refined.npz"
    small = RefinementSearch(pool=4, hard=1, machines=2, candidates=3, elite=2, generations=1)
    monkeypatch.setattr(refinement, "SEARCHES", {"two_mass": small})
    monkeypatch.setattr("sys.argv", ["refinement", str(path), "--out", str(out), "--seed", "4"])
    refinement.main()
    monkeypatch.setattr("sys.argv", ["comparison", str(out), "--episodes", "2", "--seed", "9", "--card"])
    tracking_comparison.main()
    card = AgentFile.load(out).card
    assert card["seeds"]["refinement"] == 4 and card["refinement"]["generations"] == 1
    assert "refined by the cross-entropy method" in card["trained"]
    assert card["seeds"]["evaluation"] == "9...10" and set(card["figures"]["against"]) == set(RIVALS)
    assert "over csp with 60B0h:" in capsys.readouterr().out


# --- what ships -------------------------------------------------------------------------------------------------------
def test_there_is_a_controller_for_each_task():
    assert [f"tracking_{load}" for load in sorted(TASKS)] == CONTROLLERS


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_shipped_controllers_perform_as_their_cards_say(name):
    made = AgentFile.load(shipped(name))
    found = evaluate(policy_of(made), made.environment, made.configuration, episodes=16, seed=77_000)
    assert found.interval(ERROR).median < 2.0 * made.card["figures"][ERROR]["median"]
    assert not found.violations


@pytest.mark.parametrize("name", RESIDUAL)
def test_the_residuals_beat_the_cascade_at_equal_current(name):
    """On the card, and on other machines than those that it tells of."""
    made = AgentFile.load(shipped(name))
    card = made.card["figures"]["against"]
    assert set(card) == set(RIVALS)
    told = card["csp with 60B0h"]
    assert told[CURRENT]["episodes"] >= 64
    found = compare(made, 24, 77_000, ["csp with 60B0h"]).ratios["csp with 60B0h"]
    assert found[ERROR].high < 0.85 and found[CURRENT].median <= 1.01
    assert abs(found[ERROR].median - told[ERROR]["median"]) < 0.2
    assert abs(found[CURRENT].median - told[CURRENT]["median"]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_shipped_controller_acts_the_same_over_can_in_lockstep(name):
    """Machines that are drawn, each in this process and behind its own hub."""
    made = AgentFile.load(shipped(name))
    options = {**made.configuration, "duration": 0.1}
    patient = GuardLimits(saturation=None, stall=30.0)
    both = on_both_sides(policy_of(made), made.environment, options, machines=2, seed=5, lockstep=True, guard=patient)
    assert both.missing == {} and len(both.bus.episodes) == 2
    for one, two in zip(both.inside.episodes, both.bus.episodes, strict=True):
        assert len(one.actions) == 100 and np.any(one.actions != 0.0)
        assert np.array_equal(one.actions, two.actions) and np.array_equal(one.observations, two.observations)
