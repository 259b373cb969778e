"""Training: one seed gives one agent, a resumed run equals an uninterrupted one, and every shipped YAML runs."""

from __future__ import annotations

import csv
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from rigs.trainings import TINY, tiny

from agents import hyperparameter_search as search
from agents.evaluation.evaluation import evaluate
from agents.evaluation.open_policy import open_policy
from agents.policies.agent_file import AgentFile
from agents.policies.baselines import baseline
from agents.policies.policy import policy_of
from agents.shipped import TUNER, shipped
from agents.tasks import ENVIRONMENTS, environment_name, make_environments
from agents.training import checkpoint, hyperparameters
from agents.training import train as training
from agents.training.algorithms import ALGORITHMS
from agents.training.hyperparameters import HyperparameterError, read_value
from agents.training.imitation import _windows, imitate
from agents.training.rewards import LAST_ACTION
from agents.training.train import DivergedError, train
from agents.training.training_run import AGENT, CHECKPOINT, TABLE, TrainingRun
from tuning.runs import provenance
from tuning.runs.pools import PoolError


def weights(bundle):
    return np.concatenate([np.asarray(array, float).ravel() for _, array in sorted(bundle.arrays.items())])


# --- one seed, one agent ----------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_one_seed_gives_the_same_agent(algorithm, tmp_path):
    one, two = (train(tiny(algorithm=algorithm), tmp_path / name) for name in "ab")
    assert one.hash == two.hash and np.array_equal(weights(one), weights(two))
    assert (tmp_path / "a" / AGENT).read_bytes() == (tmp_path / "b" / AGENT).read_bytes()


@pytest.mark.slow
def test_another_seed_gives_another_agent(tmp_path):
    run = tiny()
    other = TrainingRun(run.environment, run.algorithm, run.hyperparameters, seed=4, segments=4)
    assert not np.array_equal(weights(train(run, tmp_path / "a")), weights(train(other, tmp_path / "b")))


class StoppedError(Exception):
    pass


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_resumed_run_equals_an_uninterrupted_one(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr("agents.training.segments.ROWS", 1000)  # a row for each of the few rollouts
    run = tiny(algorithm=algorithm, timesteps=480)
    whole = train(run, tmp_path / "whole")
    seen = []

    def stop_later(progress):
        seen.append(progress.timesteps)
        if progress.timesteps >= 300:  # between the checkpoints after 240 and 360 steps
            raise StoppedError

    with pytest.raises(StoppedError):
        train(run, tmp_path / "cut", report=stop_later)
    cut = checkpoint.read_run(tmp_path / "cut" / CHECKPOINT)["timesteps"]
    assert 0 < cut < 300
    resumed = train(run, tmp_path / "cut", resume=True, trust=True)
    assert np.array_equal(weights(resumed), weights(whole)) and resumed.hash == whole.hash
    rows = [list(csv.DictReader((tmp_path / name / TABLE).open())) for name in ("whole", "cut")]
    steps = [[int(row["timesteps"]) for row in table] for table in rows]
    assert steps[1] == sorted(set(steps[1])) and steps[1][-1] == steps[0][-1] == 480


@pytest.mark.slow
def test_a_curriculum_goes_on_where_a_run_was_cut(tmp_path, monkeypatch):
    stages = []
    kind = type(make_environments("tracking", 1, TINY["ServoDrive/Tracking-v0"]))
    begin = kind._reset_environments
    monkeypatch.setattr(
        kind, "_reset_environments", lambda self, *rest: (stages.append(self.stage), begin(self, *rest))[1]
    )
    schedule = {"steps": [0, 480], "stage": [0.0, 1.0]}
    run = tiny(timesteps=480, env_kwargs={"distributions": {"include": ["two_mass"], "curriculum": schedule}})
    whole = train(run, tmp_path / "whole")
    expected, stages[:] = list(stages), []

    def stop_later(progress):
        if progress.timesteps >= 300:
            raise StoppedError

    with pytest.raises(StoppedError):
        train(run, tmp_path / "cut", report=stop_later)
    stages.clear()
    assert train(run, tmp_path / "cut", resume=True, trust=True).hash == whole.hash
    assert stages == expected[-len(stages) :] and min(stages) > 0.4


@pytest.mark.slow
def test_a_training_counts_to_the_end_of_its_last_rollout(tmp_path):
    """PPO learns from whole rollouts, here of 8 steps in 4 environments: "32 of 10 steps" would be no progress."""
    told = []
    train(tiny(timesteps=10), tmp_path, report=told.append)
    assert (told[-1].timesteps, told[-1].total) == (32, 32)


@pytest.mark.slow
def test_what_is_left_of_a_run(tmp_path):
    told = []
    bundle = train(tiny(), tmp_path, report=told.append)
    names = {path.name for path in tmp_path.iterdir()}
    assert {AGENT, CHECKPOINT, TABLE} < names and any(name.startswith("events.out.tfevents") for name in names)
    table = list(csv.DictReader((tmp_path / TABLE).open()))
    assert {"timesteps", "seconds", "return", "term tracking", "term effort", "steps/s"} <= set(table[0])
    assert told[-1].timesteps == told[-1].total == 192 and 0.0 < told[-1].environment_share < 1.0
    assert np.isfinite(told[-1].means["return"]) and "tracking" in told[-1].terms
    assert bundle.card["seeds"] == {"training": 3} and "192 steps" in bundle.card["trained"]
    assert json.dumps(bundle.card)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_bundle_acts_as_the_model(algorithm, tmp_path):
    bundle = train(tiny(algorithm=algorithm), tmp_path)
    model = open_policy(str(tmp_path / CHECKPOINT), trust=True).policy
    ours = policy_of(bundle)
    rng = np.random.default_rng(0)
    for _ in range(20):
        rows = rng.standard_normal((4, 8)).astype(np.float32)
        assert np.allclose(ours.act(rows), model.act(rows), atol=1e-5)


@pytest.mark.slow
def test_a_policy_begins_as_what_it_imitates(tmp_path):
    small = {
        "timesteps": 64,
        "imitate": {"feed_forward": {"steps": 6000, "updates": 500}},
        "learning_rate": 1e-9,
        "policy_kwargs": {"log_std_init": -2.5},
    }
    run = tiny(**small, env_kwargs={"action": "offset", "mode": "csp", "duration": 0.2, "num_threads": 1}, n_steps=16)
    told = []
    bundle = train(run, tmp_path, report=told.append)
    shares = [progress.imitated for progress in told if not progress.timesteps]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0 and len(shares) > 100
    options = {"episodes": 4, "seed": 5}
    lanes = make_environments(run.environment, 1, bundle.configuration)
    lanes.close()
    teacher = baseline("feed_forward", run.environment, lanes.config, 1)
    error = {
        name: evaluate(policy, run.environment, bundle.configuration, **options).values["RMS following error [rev]"]
        for name, policy in (
            ("agent", policy_of(bundle)),
            ("teacher", teacher),
            ("nothing", baseline("nothing", run.environment, lanes.config, 1)),
        )
    }
    assert np.mean(error["teacher"]) < 0.5 * np.mean(error["nothing"])
    assert np.mean(error["agent"]) < np.mean(error["teacher"]) + 0.25 * np.mean(error["nothing"])


class Constant:
    """A teacher that always does the same, and what it was shown."""

    def __init__(self, action):
        self.action, self.entries = action, set()

    def act(self, observation):
        self.entries.add(observation.shape[1])
        return np.tile(self.action, (len(observation), 1))

    def reset(self, mask=None):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sac", "crossq", "recurrent_ppo"])
def test_every_algorithm_imitates_and_a_replay_buffer_has_what_the_teacher_saw(algorithm):
    """With exploration; the critic learns from there what is earned: about a step's reward / (1 - discount)."""
    steps = 1200
    kept = {} if algorithm == "recurrent_ppo" else {"buffer_size": 4 * steps, "ent_coef": 0.001}
    run = tiny(algorithm=algorithm, gamma=0.5, learning_rate=1e-2, **kept)
    lanes, env = training.make_env(run)
    model, normaliser = training.make_model(run, env)
    assert imitate(model, Constant(np.float32([0.3])), seed=1, steps=4 * steps, updates=300) < 0.05
    seen = normaliser.normalize_obs(lanes.reset(seed=2)[0])
    acted, _ = model.predict(seen, deterministic=True)
    lanes.close()
    assert acted == pytest.approx(0.3, abs=0.1)
    if not kept:
        return
    import torch

    buffer = model.replay_buffer
    assert buffer.full and buffer.dones.sum() == 4 * steps / 10 and len(np.unique(buffer.observations[:, 0, 0])) > 100
    assert 0.01 < np.std(buffer.actions) < 0.1 and np.mean(buffer.actions) == pytest.approx(0.3, abs=0.01)
    assert np.array_equal(buffer.observations[1:9], buffer.next_observations[:8])
    judged = model.critic(*(torch.as_tensor(rows, dtype=torch.float32) for rows in (seen, acted)))[0].mean().item()
    assert judged == pytest.approx(buffer.rewards.mean() / (1.0 - model.gamma), rel=0.25)


@pytest.mark.parametrize("algorithm", ["ppo", "crossq", "recurrent_ppo"])
def test_the_student_acts_in_more_and_more_environments_while_it_is_taught(algorithm):
    """The last action is an entry of the observation: the teacher's is always 1, an untaught student's about 0."""
    lanes, env = training.make_env(tiny(algorithm=algorithm, env_kwargs={"duration": 1.0}))
    model, _ = training.make_model(tiny(algorithm=algorithm, policy_kwargs={"log_std_init": -9.0}), env)
    teacher = Constant(np.float32([1.0]))
    seen, act = [], teacher.act
    teacher.act = lambda rows: seen.append(rows[:, LAST_ACTION]) or act(rows)
    imitate(model, teacher, seed=1, steps=3 * 4 * 10, updates=3, rounds=3)
    lanes.close()
    by_teacher = np.array(seen)[[9, 15, 29]] > 0.9  # of one round each; an action is seen in the next step
    assert by_teacher.tolist() == [[True] * 4, [False, False, True, True], [False] * 4]


@pytest.mark.parametrize("length", [1, 3])
def test_windows_of_an_imitation_lie_within_an_episode(length):
    ends = np.zeros((8, 2), bool)
    ends[3, 0] = ends[7] = True
    rows = _windows(ends, length)[:, None] + 2 * np.arange(length)
    assert len(rows) == {1: 16, 3: 10}[length]
    assert not ends.ravel()[rows[:, :-1]].any() and np.all(rows % 2 == rows[:, :1] % 2)


@pytest.mark.slow
def test_an_asymmetric_critic_learns_from_the_machine_while_the_actor_imitates():
    teacher = Constant(np.float32([0.3, -0.2, 0.1]))
    run = tiny("gain_tuning")
    lanes, env = training.make_env(run)
    model, _ = training.make_model(run, env)
    actor, critic = (model.policy.mlp_extractor.policy_net[0].weight, model.policy.mlp_extractor.value_net[0].weight)
    seen, before = actor.shape[1], critic.detach().clone()
    assert imitate(model, teacher, seed=1, steps=24, updates=200) < 0.02
    lanes.close()
    assert teacher.entries == {seen}  # not the true machine
    moved = (critic - before).abs().max(dim=0).values
    assert moved[seen:].max() > 1e-3


def test_the_shipped_tuner_is_a_baseline_of_its_own_gains():
    lanes = make_environments("gain_tuning", 1, {"num_threads": 1})
    policy = baseline("surrogate", "gain_tuning", lanes.config, 3)
    lanes.close()
    ships = AgentFile.load(shipped(TUNER))
    assert all(np.array_equal(policy.bundle.arrays[name], array) for name, array in ships.arrays.items())
    assert policy.bundle.settings == {**ships.settings, "step": lanes.config.step}  # the action's bound
    with pytest.raises(ValueError, match="surrogate changes the gains velocity_p, velocity_i, position_p"):
        baseline("surrogate", "gain_tuning", replace(lanes.config, gains=("position_p", "velocity_p", "velocity_i")), 3)


# --- rewards ----------------------------------------------------------------------------------------------------------
def both(environment, options, wrapper):
    """Environments as they are, and the same behind a reward of agents.training.rewards."""
    plain = make_environments(environment, 4, {**options, "num_threads": 1}, autoreset_mode="SameStep")
    name = environment_name(environment)
    settings = {"n_envs": 4, "env_kwargs": {**options, "num_threads": 1}, "vec_env_wrapper": wrapper}
    _, env = training.make_env(TrainingRun(name, "ppo", settings))
    env.seed(7)
    return plain, plain.reset(seed=7), env, env.reset()


def test_each_trial_earns_its_own_hidden_j_over_the_rules():
    lanes, (_, told), env, _ = both("gain_tuning", {"trials": 2}, {"agents.training.rewards:EachTrial": {"limit": 0.4}})
    rng, rule, limited = np.random.default_rng(0), told["robust_cost"], 0
    for _ in range(4):  # two episodes: the second one's machines have other rules
        action = rng.uniform(-1.0, 1.0, (4, 3)).astype(np.float32)
        _, _, _, ended, told = lanes.step(action)
        gained = np.log(rule) - np.log(told.get("final_info", told)["trial_robust_cost"])
        env.step_async(action)
        assert env.step_wait()[1] == pytest.approx(np.clip(gained, -0.4, 0.4), rel=1e-5)
        limited += np.sum(np.abs(gained) > 0.4)
        rule = told["robust_cost"] if ended.all() else rule
    lanes.close(), env.close()
    assert 0 < limited < 16


def test_small_errors_cost_thousandths_of_the_amplitude():
    settings = {"error": 0.002, "effort": 3.0, "smoothness": 5.0}
    lanes, (rows, _), env, _ = both("tracking", {"duration": 0.004}, {"agents.training.rewards:SmallErrors": settings})
    rng = np.random.default_rng(0)
    for step in range(8):
        action, before = rng.uniform(-0.3, 0.3, (4, 1)).astype(np.float32), rows[:, 7]
        rows, _, _, ended, told = lanes.step(action)
        final = np.stack(told["final_obs"]) if ended.all() else rows
        cost = np.abs(final[:, 0]) / 0.002 + 3.0 * final[:, 4] ** 2 + 5.0 * (final[:, 7] - before) ** 2
        env.step_async(action)
        assert env.step_wait()[1] == pytest.approx(-cost, rel=1e-4)
        assert ended.all() == (step % 4 == 3)
    lanes.close(), env.close()


# --- hyper-parameters -------------------------------------------------------------------------------------------------
@pytest.mark.every(5)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_there_are_hyperparameters_for_every_environment_and_algorithm(environment, algorithm, tmp_path):
    quick, full = (hyperparameters.load(environment, algorithm, preset) for preset in ("quick", "full"))
    assert quick["n_timesteps"] < full["n_timesteps"] and quick["policy"] == full["policy"]
    run = tiny(environment, algorithm, timesteps=32)
    _, env = training.make_env(run)
    model, normaliser = training.make_model(run, env)  # the constructor takes them all
    assert normaliser is not None and model.num_timesteps == 0
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("environment", ["gain_tuning", "gain_scheduling"])
def test_every_environment_trains(environment, algorithm, tmp_path):
    bundle = train(tiny(environment, algorithm, timesteps=64), tmp_path)
    assert AgentFile.load(tmp_path / AGENT).environment == bundle.environment


@pytest.mark.slow
def test_an_asymmetric_critic_sees_the_machine_and_the_actor_does_not(tmp_path):
    bundle = train(tiny("gain_tuning", timesteps=32), tmp_path)
    lanes = make_environments("gain_tuning", 1, {"privileged": True})
    seen, all_ = (lanes.single_observation_space[key].shape[0] for key in ("observation", "privileged"))
    lanes.close()
    assert bundle.arrays["weight_0"].shape[0] == seen
    loaded = open_policy(str(tmp_path / CHECKPOINT), trust=True).policy
    assert loaded.model.policy.mlp_extractor.value_net[0].in_features == seen + all_
    rows = np.random.default_rng(0).standard_normal((3, seen)).astype(np.float32)
    assert np.allclose(loaded.act(rows), policy_of(bundle).act(rows), atol=1e-5)
    found = evaluate(policy_of(bundle), "gain_tuning", bundle.configuration, episodes=2)
    assert np.isfinite(found.values["robust cost (emulator)"]).all()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("dict(net_arch=[64, 64], activation_fn=nn.Tanh)", {"net_arch": [64, 64], "activation_fn": "nn.Tanh"}),
        ("dict(net_arch=dict(pi=[256], vf=[256]))", {"net_arch": {"pi": [256], "vf": [256]}}),
        ("{'norm_obs': True, 'norm_reward': False}", {"norm_obs": True, "norm_reward": False}),
        ("1e-4", 1e-4), ("-2", -2.0), ("lin_3e-4", "lin_3e-4"), ("MlpPolicy", "MlpPolicy"), (5, 5),
    ],
)  # fmt: skip
def test_zoo_entries_are_read(text, value):
    assert read_value(text) == value


@pytest.mark.parametrize("text", ["dict(a=open('x'))", "dict(net_arch=__import__('os'))", "[x for x in y]", "dict(a=1"])
def test_nothing_of_a_yaml_is_evaluated(text):
    with pytest.raises(HyperparameterError):
        read_value(text)


def test_a_schedule_falls_to_zero():
    falling = hyperparameters.schedule("lin_3e-4")
    assert falling(1.0) == 3e-4 and falling(0.5) == 1.5e-4 and falling(0.0) == 0.0
    assert hyperparameters.schedule(0.2) == 0.2
    with pytest.raises(HyperparameterError, match=r"e\.g\. lin_3e-4, not 'lin_x'"):
        hyperparameters.schedule("lin_x")


def test_a_section_of_a_load_replaces_the_environments(tmp_path):
    found = hyperparameters.load("tracking", "ppo", "quick", section="gantry")
    assert found["env_kwargs"]["load"] == "gantry" and found["n_timesteps"] == 3_000_000
    assert found["policy_kwargs"]["net_arch"] == [64, 64]  # of the environment's own section


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("walking", "ppo"), "there is no environment 'walking'; there are ServoDrive/GainTuning-v0"),
        (("tracking", "dqn"), "there is no algorithm 'dqn'; there are ppo, sac, recurrent_ppo, tqc, crossq"),
        (("tracking", "ppo", "slow"), "there is no preset 'slow'; there are quick, full"),
        (("tracking", "ppo", "quick", None, "moon"), "has no section moon; it has ServoDrive/Tracking-v0, quick"),
        (("tracking", "ppo", "quick", "missing.yaml"), "there is no file missing.yaml"),
    ],
)
def test_a_wrong_name_names_the_valid_ones(arguments, message):
    with pytest.raises(ValueError, match=message):
        hyperparameters.load(*arguments)


def test_hyperparameters_that_the_algorithm_does_not_take_are_told(tmp_path):
    with pytest.raises(HyperparameterError, match=r"ppo does not take these hyper-parameters: .*'tau'"):
        train(tiny(tau=0.1), tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_steps": 0}, "ppo does not take these hyper-parameters: .*n_steps=0"),
        ({"normalize": {"norm_foo": 1}}, "normalize does not take these hyper-parameters: .*'norm_foo'"),
        ({"vec_env_wrapper": {"agents.training.rewards:SmallErrors": {"foo": 1}}}, "SmallErrors does not take .*'foo'"),
        ({"imitate": {"nothing": {"stepz": 1}}}, "imitate nothing does not take these hyper-parameters: .*'stepz'"),
        ({"imitate": {"nothing": {"rounds": 0}}}, "an imitation has 1 or more updates and rounds, not 1200 and 0"),
        (
            {"policy": "agents.training.asymmetric:AsymmetricPolicy"},
            "needs an observation with 'observation' first .*MlpPolicy",
        ),
        ({"policy_kwargs": {"activation_fn": "nn.Sigmoid"}}, "Sigmoid between its layers; a bundle holds one of Tanh"),
        ({"learning_rate": 1e6}, "the training diverged: .*Use a smaller learning_rate"),
    ],
)
def test_what_cannot_be_trained_is_told_and_leaves_no_agent(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train(tiny(**changes), tmp_path)
    assert not (tmp_path / AGENT).exists() and not (tmp_path / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("n_envs: 2.5", "n_envs must be a whole number of 1 or more, not 2.5"),
        ("n_envs: -1", "n_envs must be a whole number of 1 or more, not -1"),
        ("n_timesteps: many", "n_timesteps must be a whole number of 1 or more, not 'many'"),
        ("normalize: 'no'", "normalize is true, false or VecNormalize's settings, not 'no'"),
        ("policy: null", "policy is missing"),
    ],
)
def test_a_wrong_entry_is_told_with_its_file(entry, message, tmp_path):
    path = tmp_path / "own.yaml"
    rows = {"n_envs": "n_envs: 1", "n_timesteps": "n_timesteps: 1e3", "policy": "policy: MlpPolicy"}
    rows[entry.partition(":")[0]] = entry
    path.write_text("ServoDrive/Tracking-v0:\n" + "".join(f"  {row}\n" for row in rows.values()))
    with pytest.raises(HyperparameterError, match=f"own.yaml: {message}"):
        hyperparameters.load("tracking", "ppo", path=path)


# --- search -----------------------------------------------------------------------------------------------------------
def drawn_in(folder):
    """State, learning rate and score of a study's trials."""
    optuna = pytest.importorskip("optuna")
    journal = optuna.storages.journal
    storage = optuna.storages.JournalStorage(journal.JournalFileBackend(str(folder / search.JOURNAL)))
    study = optuna.load_study(study_name="ServoDrive/Tracking-v0 ppo", storage=storage)
    return [(trial.state.name, trial.params["learning_rate"], trial.value) for trial in study.trials]


@pytest.mark.slow
def test_a_killed_search_goes_on_behind_the_lost_trial_and_draws_anew(tmp_path, monkeypatch):
    run, trained = tiny(timesteps=32), []

    def killed_in_the_third(one, folder):
        trained.append(folder)
        if len(trained) == 3:
            raise SystemExit  # nothing of the trial is told to the journal
        return train(one, folder)

    monkeypatch.setattr(search, "train", killed_in_the_third)
    options = {"seed": 4, "episodes": 2}
    with pytest.raises(SystemExit):
        search.search(run.environment, "ppo", run.hyperparameters, tmp_path, trials=5, **options)
    assert "learning_rate" in (tmp_path / search.BEST).read_text()  # of the two that are over
    best = search.search(run.environment, "ppo", run.hyperparameters, tmp_path, trials=2, **options)
    rows = drawn_in(tmp_path)
    assert [state for state, _, _ in rows] == ["COMPLETE", "COMPLETE", "RUNNING", "COMPLETE", "COMPLETE"]
    assert len({rate for _, rate, _ in rows}) == 5
    assert best["learning_rate"] == min((value, rate) for _, rate, value in rows if value is not None)[1]
    other = tmp_path / "again"
    monkeypatch.setattr(search, "train", train)
    search.search(run.environment, "ppo", run.hyperparameters, other, trials=2, **options)
    assert drawn_in(other) == rows[:2]  # one seed, one search


def test_a_training_that_diverges_is_a_trial_that_failed(tmp_path, monkeypatch):
    run, told = tiny(timesteps=32), []
    trained = iter([{"learning_rate": 1e6}, {}])

    def train_so(one, folder):
        return train(replace(one, hyperparameters={**one.hyperparameters, **next(trained)}), folder)

    monkeypatch.setattr(search, "train", train_so)
    search.search(run.environment, "ppo", run.hyperparameters, tmp_path, trials=2, episodes=2,
                  told=lambda trial, best: told.append((trial.score, best)))  # fmt: skip
    assert told[0] == (None, None) and told[1][1].number == 1 and told[1][1].score == told[1][0]


def test_a_search_without_any_agent_says_so(tmp_path, monkeypatch):
    run = tiny(timesteps=32, max_grad_norm=1e9)
    monkeypatch.setitem(search.SPACES, "ppo", (search.SearchRow("learning_rate", choices=(1e6,)),))
    with pytest.raises(DivergedError, match="all 1 trainings diverged; give a smaller learning_rate"):
        search.search(run.environment, "ppo", run.hyperparameters, tmp_path, trials=1)


class Elsewhere:
    """A pool as a cluster is: tasks are pickled, files stay where they are, and results come back in another order."""

    width, shares_disk = 3, False

    def unordered(self, function, items, say=None, fits=None):
        for k, item in reversed(list(enumerate(items))):
            task = pickle.loads(pickle.dumps((function, item)))
            yield k, pickle.loads(pickle.dumps(task[0](task[1])))


@pytest.mark.slow
def test_trials_elsewhere_are_those_of_one_process(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "ROUND", 2)
    run, found, told = tiny(timesteps=32), {}, {}
    for name, pool in (("here", None), ("elsewhere", Elsewhere())):
        told[name] = []
        found[name] = search.search(
            run.environment, "ppo", run.hyperparameters, tmp_path / name, trials=3, seed=4, episodes=2, pool=pool,
            told=lambda trial, best, own=told[name]: own.append((trial, best)),
        )  # fmt: skip
    assert found["here"] == found["elsewhere"]
    assert told["here"] == told["elsewhere"]
    assert drawn_in(tmp_path / "here") == drawn_in(tmp_path / "elsewhere")
    for name in (search.BEST, *(f"trial-{k:03d}/agent.npz" for k in range(3))):
        one, other = ((tmp_path / folder / name) for folder in ("here", "elsewhere"))
        assert one.read_bytes() == other.read_bytes(), name


@pytest.mark.slow
def test_what_a_round_draws_follows_from_the_rounds_before_wherever_it_runs(tmp_path, monkeypatch):
    """Optuna's sampler draws at random until it knows ten trials: the thirteenth and later ones tell."""

    def scored(task):
        return search._Scored(abs(task.run.hyperparameters["learning_rate"] - 1e-3), {})

    class AtOnce(Elsewhere):
        def unordered(self, function, items, say=None, fits=None):
            return [(k, function(item)) for k, item in reversed(list(enumerate(items)))]

    monkeypatch.setattr(search, "_trained", scored)
    run = tiny(timesteps=32)
    for name, pool in (("here", None), ("again", None), ("elsewhere", AtOnce())):
        search.search(run.environment, "ppo", run.hyperparameters, tmp_path / name, trials=20, seed=4, pool=pool)
    rows = drawn_in(tmp_path / "here")
    assert rows == drawn_in(tmp_path / "again") == drawn_in(tmp_path / "elsewhere")
    assert np.mean([value for *_, value in rows[15:]]) < np.mean([value for *_, value in rows[:10]])  # it learns


def test_trials_that_an_error_ends_are_over_for_the_next_search(tmp_path, monkeypatch):
    run = tiny(timesteps=32)

    class Lost(Elsewhere):
        def unordered(self, function, items, say=None, fits=None):
            yield 0, function(items[0])
            raise PoolError("the connection was lost")

    with pytest.raises(PoolError):
        search.search(run.environment, "ppo", run.hyperparameters, tmp_path, trials=3, episodes=2, pool=Lost())
    assert [state for state, _, _ in drawn_in(tmp_path)] == ["COMPLETE", "FAIL", "FAIL"]


def test_a_run_of_other_sources_is_not_gone_on_with(tmp_path, monkeypatch):
    """Half of its agent would be another program's."""
    train(tiny(timesteps=32), tmp_path)
    before, here = (tmp_path / CHECKPOINT).read_bytes(), provenance.SOURCES
    monkeypatch.setattr(provenance, "SOURCES", "0123456789abcdef")
    refused = f"checkpoint.zip holds results of sources {here}, these are 0123456789abcdef.*or begin a new run"
    with pytest.raises(ValueError, match=refused):
        train(tiny(), tmp_path, resume=True, trust=True)
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def test_a_study_of_other_sources_is_not_gone_on_with(tmp_path, monkeypatch):
    """Its scores would be those of two programs, and the best of them nobody's."""
    run, trained = tiny(timesteps=32), []
    monkeypatch.setattr(search, "train", lambda one, folder: trained.append(folder) or train(one, folder))
    options = {"trials": 1, "seed": 4, "episodes": 2}
    search.search(run.environment, "ppo", run.hyperparameters, tmp_path, **options)
    here = provenance.SOURCES
    monkeypatch.setattr(provenance, "SOURCES", "0123456789abcdef")
    refused = f"study.log holds results of sources {here}, these are 0123456789abcdef.*or give another --out"
    with pytest.raises(ValueError, match=refused):
        search.search(run.environment, "ppo", run.hyperparameters, tmp_path, **options)
    assert len(trained) == 1


def test_there_is_nothing_to_resume(tmp_path):
    with pytest.raises(ValueError, match=r"no file .*checkpoint\.zip to continue from: a run writes its first"):
        train(tiny(), tmp_path, resume=True, trust=True)
    (tmp_path / CHECKPOINT).write_bytes(b"no")
    with pytest.raises(ValueError, match=r"is not a complete \.zip"):
        train(tiny(), tmp_path, resume=True, trust=True)
