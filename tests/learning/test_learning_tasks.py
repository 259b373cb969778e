"""The suite of learning tasks: what is frozen, and that no task is won by a policy that has learnt nothing."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import pickle
import runpy
import tomllib

import gymnasium
import numpy as np
import pytest
from rigs import ROOT

from agents.benchmark.unlearnt import unlearnt_scores
from agents.evaluation.evaluation import evaluate
from agents.evaluation.loop_sensitivity import check_kept, measure_sensitivity
from agents.evaluation.sim_versus_bus import on_both_sides
from agents.plain import plain
from agents.policies.baselines import SUITE_TASKS, baseline
from agents.policies.guard import GuardLimits
from agents.tasks import configuration_of, environment_name, make_environments
from drive_env.envs.suite import TASKS
from drive_env.loops.dynamics import find_dynamics
from drive_env.randomisation.random_machines import SHIPPED

DOCS = ROOT / "docs"
# A trial of a tuning costs as much as 750 steps.
MACHINES = {"ServoDrive/Tracking-v0": 12, "ServoDrive/GainScheduling-v0": 12, "ServoDrive/GainTuning-v0": 12}
SLOW = "ServoDrive/GainTuning-v0"
QUICK = [
    pytest.param(name, marks=pytest.mark.slow) if task.environment == SLOW else name for name, task in TASKS.items()
]
UNLEARNT, LEAST, MOST = 0.6, 0.7, 0.95  # score of what has learnt nothing at most; of the expert


@pytest.mark.every(3)
@pytest.mark.parametrize("name", TASKS)
def test_a_task_has_its_horizon_and_its_threshold_in_the_spec_and_takes_no_options(name):
    task = TASKS[name]
    with gymnasium.make(name) as env:
        assert env.spec.max_episode_steps == task.steps == env.unwrapped.vector.max_episode_steps
        assert env.spec.reward_threshold == pytest.approx(task.solved * task.steps)
        assert np.all(env.action_space.low == -1.0) and np.all(env.action_space.high == 1.0)
    with contextlib.closing(gymnasium.make_vec(name, 2)) as envs:
        assert envs.spec.max_episode_steps == task.steps
    with pytest.raises(ValueError, match="is frozen and takes no 'speed'"):
        gymnasium.make(name, speed=1.0)
    assert environment_name(name.partition("/")[2].partition("-")[0]) == name


# What every published task is, of its options and of the distributions that its machines are drawn from.
FROZEN = {
    "ServoDrive/TorqueTracking-v1": "36c0ba71ce9ce241",
    "ServoDrive/GantryBeam-v1": "c1073a7da7e5d911",
    "ServoDrive/Crane-v1": "c440e6e93e24e598",
    "ServoDrive/PoleBalance-v1": "87bf81fa814f7439",
    "ServoDrive/PoleSwingUp-v1": "a176bbc9569535f4",
    "ServoDrive/ArmPath-v1": "099611bdd54fcb38",
    "ServoDrive/StepperRun-v1": "f9e749def4b173d9",
    "ServoDrive/PayloadScheduling-v1": "d30cd507bfc0d3ee",
    "ServoDrive/KnownPayload-v1": "d64930769400297a",
    "ServoDrive/ServoTuning-v1": "0a61b10e4c9c9160",
    "ServoDrive/AmplifierTuning-v1": "d43013d4a4f8536a",
}


@pytest.mark.parametrize("name", TASKS)
def test_a_published_task_never_changes(name):
    assert digest(name) == FROZEN[name], "a published task is frozen: give what is changed the id of a next version"


def digest(name):
    laws, read = TASKS[name].options["distributions"], {}
    sets = [*laws["include"]] if isinstance(laws, dict) else [laws]
    while sets:
        one = sets.pop()
        read[one] = tomllib.loads((SHIPPED / f"{one}.toml").read_text(encoding="utf-8"))
        sets += read[one].get("include", [])
    content = json.dumps([plain(dict(TASKS[name].options)), TASKS[name].steps, read], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


@pytest.mark.every(16)
@pytest.mark.parametrize("name", QUICK)
def test_what_has_learnt_nothing_scores_less_than_0_6(name):
    scores = unlearnt_scores(name, MACHINES[TASKS[name].environment])
    assert max(scores.values()) < UNLEARNT, scores


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_the_cascade_scores_less_than_0_6_and_the_expert_0_7_to_0_95(name):
    scores = {}
    for row in SUITE_TASKS[name]:
        lanes = make_environments(name, 1)
        policy = baseline(row, name, lanes.config, lanes.single_action_space.shape[0])
        lanes.close()
        found = evaluate(policy, name, episodes=32, seed=3_000_000)
        scores[row] = float(np.mean([episode.rewards.sum() for episode in found.episodes])) / TASKS[name].steps
    best = scores.pop("oracle", 1.0)
    assert LEAST <= scores["expert"] <= min(best, MOST)
    del scores["expert"]
    assert max(scores.values()) < UNLEARNT + 0.02, scores


@pytest.mark.parametrize("name", [name for name, rows in SUITE_TASKS.items() if "nominal" in rows])
def test_a_nominal_expert_acts_as_the_expert_that_is_told_no_machine(name):
    lanes = make_environments(name, 4)
    seen, info = lanes.reset(seed=0)
    told, untold = (baseline(row, name, lanes.config, 1) for row in ("expert", "expert"))
    nominal = baseline("nominal", name, lanes.config, 1)
    for one in (told, nominal):
        one.told(info["parameters"], np.ones(4, bool))
    seen = np.linspace(-0.1, 0.1, seen.size).reshape(seen.shape)  # near its balance a pole's regulator acts
    lanes.close()
    assert (nominal.act(seen) == untold.act(seen)).all()
    assert (nominal.act(seen) != told.act(seen)).any()


@pytest.mark.every(11)
@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_a_picture_and_goes_on_alike_as_a_copy_or_from_a_file(name):
    with gymnasium.make(name, render_mode="rgb_array") as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render().std() > 10.0
        action = np.zeros(env.action_space.shape, np.float32)
        others = copy.deepcopy(env.unwrapped), pickle.loads(pickle.dumps(env.unwrapped))
        first, *stepped = (one.step(action) for one in (env.unwrapped, *others))
        assert all(np.array_equal(one[0], first[0]) and one[1] == first[1] for one in stepped)


def test_an_agents_file_has_the_whole_configuration_of_its_task_and_another_is_refused():
    lanes = make_environments("Crane", 1)
    whole = configuration_of(lanes)
    lanes.close()
    make_environments("Crane", 1, whole).close()
    with pytest.raises(ValueError, match="is frozen and takes no 'speed'"):
        make_environments("Crane", 1, {**whole, "speed": 6.0})


def test_the_score_of_a_task_is_the_share_of_the_horizons_rewards():
    lanes = make_environments("PoleBalance", 1)
    rest = baseline("rest", "PoleBalance", lanes.config, 1)
    lanes.close()
    found = evaluate(rest, "PoleBalance", episodes=4, seed=3_000_000)
    sums = [episode.rewards.sum() / TASKS["ServoDrive/PoleBalance-v1"].steps for episode in found.episodes]
    assert found.score == "score [0...1]" and found.values[found.score] == pytest.approx(sums)


@pytest.mark.slow
def test_a_policy_acts_on_the_drives_of_a_bus_as_in_process():
    lanes = make_environments("GantryBeam", 1)
    expert = baseline("expert", "GantryBeam", lanes.config, 2)
    lanes.close()
    found = on_both_sides(expert, "GantryBeam", machines=1, lockstep=True, guard=GuardLimits(saturation=None))
    assert found.bus.values == found.inside.values and found.bus.violations == {} and found.missing == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["GantryBeam", pytest.param("ArmPath", marks=pytest.mark.slow)])
def test_an_expert_in_the_loops_keeps_stiff_margins(name):
    lanes = make_environments(name, 1)
    expert = baseline("expert", name, lanes.config, lanes.single_action_space.shape[0])
    lanes.close()
    check_kept(measure_sensitivity(expert, name, machines=8, seed=0), find_dynamics("stiff"))


def test_the_page_is_what_the_suite_and_the_kept_scores_make():
    written = runpy.run_path(str(DOCS / "task_page.py"))["page"]()
    assert (DOCS / "tasks.md").read_text(encoding="utf-8") == written
    kept = json.loads((DOCS / "task_scores.json").read_text(encoding="utf-8"))
    assert set(kept) == set(TASKS)
    for scores in kept.values():
        assert max(scores["unlearnt"].values()) < UNLEARNT and LEAST <= scores["baselines"]["expert"] <= MOST


def test_an_oracle_that_is_told_no_machine_refuses():
    lanes = make_environments("StepperRun", 1)
    oracle = baseline("oracle", "StepperRun", lanes.config, 1)
    seen, _ = lanes.reset(seed=0)
    lanes.close()
    with pytest.raises(ValueError, match="must be told the true machine, which no bus tells; take the expert"):
        oracle.act(seen)
