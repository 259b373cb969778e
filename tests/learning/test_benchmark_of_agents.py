"""`drive-agent benchmark`: what its figures mean, that seeds never meet, and runs, rows and mistakes of the command."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("stable_baselines3")

from agents import seeds
from agents.benchmark import report, runs
from agents.benchmark.results import RESULT, Row, RowError
from agents.benchmark.statistics import interquartile_mean, probability_of_improvement
from agents.commands.cli import app
from agents.evaluation.evaluation import evaluate
from agents.hyperparameter_search import search
from agents.policies.agent_file import AgentFile
from agents.policies.baselines import baseline
from agents.policies.policy import policy_of
from agents.shipped import shipped
from agents.tasks import make_environments
from agents.training import hyperparameters
from agents.training.imitation import imitate
from agents.training.train import IMITATION, make_env, make_model, train
from agents.training.training_run import TrainingRun, segment_seed
from drive_env.envs.suite import TASKS
from drive_env.envs.vector_environment import VectorEnvironment

TASK = "ServoDrive/TorqueTracking-v1"
EPISODES = 4
TINY = """
ServoDrive/Tracking-v0: {n_envs: 4, n_timesteps: 64, policy: MlpPolicy, normalize: true, n_steps: 8, batch_size: 16,
  policy_kwargs: {net_arch: [8]}}
full: {}
"""


# --- the figures ------------------------------------------------------------------------------------------------------
def test_the_interquartile_mean_is_of_the_middle_half():
    found = interquartile_mean([np.array([[0.0, 3.0, 5.0, 100.0]])])
    assert found.value == 4.0
    # Agarwal's rule, scipy.stats.trim_mean(scores, 0.25): of 10 scores 2 go at each end.
    squares = np.arange(10.0) ** 2
    found = interquartile_mean([squares.reshape(2, 5)])
    assert found.value == squares[2:8].mean()


def test_the_tasks_scores_are_pooled_each_with_its_own_number_of_seeds():
    assert interquartile_mean([np.zeros((1, 4)), np.ones((1, 4))]).value == 0.5


def test_scores_without_spread_have_an_interval_without_width():
    assert interquartile_mean([np.full((3, 5), 0.25)]) == (0.25, 0.25, 0.25)


def test_the_interval_is_that_of_all_draws():
    """Two seeds that do not differ within: the interquartile mean of a draw is the mean of two seeds drawn."""
    found = interquartile_mean([np.array([[0.0] * 4, [1.0] * 4])])
    assert (found.value, found.low, found.high) == (0.5, 0.0, 1.0)  # each end has a quarter of the draws


def test_the_interval_of_a_mean_is_the_textbooks():
    """Of 400 normal values: 1.96 standard errors, 1.09 times as long for the middle half as for the mean (Tukey)."""
    scores = np.random.default_rng(1).standard_normal((1, 400))
    found = interquartile_mean([scores])
    assert found.high - found.low == pytest.approx(2 * 1.96 * 1.09 / 20.0, rel=0.1)


def test_the_seeds_count_however_many_episodes_there_are():
    """A figure that hangs on the seed alone has the spread of seeds, not of seeds times episodes."""
    scores = np.repeat(np.random.default_rng(2).standard_normal((10, 1)), 50, axis=1)
    found = interquartile_mean([scores])
    assert found.high - found.low > 0.5 * 2 * 1.96 / np.sqrt(10.0)


def test_the_probability_of_improvement_is_of_the_same_episode():
    rival = np.array([0.1, 0.5, 0.9, 0.9])
    above = probability_of_improvement([np.stack([rival + 0.01, rival + 0.02])], [rival])
    assert above == (1.0, 1.0, 1.0)  # in each episode, however much the episodes differ
    assert probability_of_improvement([rival[None]], [rival]).value == 0.5  # equal: half
    mixed = probability_of_improvement([rival[None] + [0.1, 0.1, 0.1, -0.1]], [rival])
    assert mixed.value == 0.75 and mixed.low == 0.25 and mixed.high == 1.0


def test_the_probability_of_improvement_has_the_binomial_interval():
    wins = np.where(np.arange(400) < 240, 1.0, -1.0)
    found = probability_of_improvement([wins[None]], [np.zeros(400)])
    width = 1.96 * np.sqrt(0.6 * 0.4 / 400)
    assert (found.low, found.high) == pytest.approx((0.6 - width, 0.6 + width), abs=0.006)


# --- the seeds --------------------------------------------------------------------------------------------------------
def test_seeds_of_two_purposes_never_meet():
    ranges = [one for one in vars(seeds).values() if isinstance(one, range)]
    assert len(ranges) == 4
    for one, other in itertools.combinations(ranges, 2):
        assert one[-1] < other[0] or other[-1] < one[0]
    assert len(seeds.TEST) >= runs.EPISODES


@pytest.mark.slow
def test_everything_has_the_seeds_of_its_purpose(tmp_path, monkeypatch):
    """A training's, a search's, the benchmark's, and those of `drive-agent evaluate` and of a training's card."""
    met = []
    begin = VectorEnvironment.reset

    def reset(self, *, seed=None, options=None):
        met.extend(seed if isinstance(seed, list) else [seed])
        return begin(self, seed=seed, options=options)

    monkeypatch.setattr(VectorEnvironment, "reset", reset)
    given = hyperparameters.load(TASK, "ppo")
    bundle = train(TrainingRun(TASK, "ppo", given, seed=3), tmp_path / "run")
    assert met and all(seed is None or seed in seeds.TRAINING for seed in met)
    assert all(segment_seed(seed, IMITATION) in seeds.TRAINING for seed in range(100))
    small = dict(given)
    for purpose, judged in {
        "VALIDATION": lambda: search(TASK, "ppo", small, tmp_path / "study", trials=1, episodes=2),
        "TEST": lambda: runs.judge(policy_of(bundle), TASK, 2),
        "EVALUATION": lambda: evaluate(policy_of(bundle), TASK, episodes=2),
    }.items():
        met.clear()
        judged()
        assert set(met[-2:]) == set(getattr(seeds, purpose)[:2])
    met.clear()
    path = bundle.save(tmp_path / "agent.npz")
    assert CliRunner().invoke(app, ["evaluate", str(path), "--episodes", "2"]).exit_code == 0
    assert set(met) == set(seeds.EVALUATION[:2])


def test_an_episode_of_the_test_is_not_the_trainings_of_the_same_low_bits():
    lanes = make_environments(TASK, 3)
    try:
        same, first, again = 7, seeds.TEST[0] + 7, seeds.TEST[0] + 7
        _, told = lanes.reset(seed=[same, first, again])
        stiffness = told["parameters"]["load.stiffness"]
        assert stiffness[0] != stiffness[1] == stiffness[2]
    finally:
        lanes.close()


# --- the command ------------------------------------------------------------------------------------------------------
def run(*arguments):
    return CliRunner().invoke(app, ["benchmark", *(str(one) for one in arguments)])


def shrink(monkeypatch, folder):
    """Set a few episodes, hyper-parameters for a training of a moment, and the present folder."""
    (folder / "yaml").mkdir()
    for algorithm in ("ppo", "sac"):
        (folder / f"yaml/tracking_{algorithm}.yaml").write_text(TINY)
    monkeypatch.setattr(hyperparameters, "FOLDER", folder / "yaml")
    monkeypatch.setattr(runs, "EPISODES", EPISODES)
    monkeypatch.chdir(folder)


@pytest.fixture(autouse=True)
def small(tmp_path, monkeypatch):
    shrink(monkeypatch, tmp_path)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A benchmark of two seeds, made once."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as monkeypatch:
        shrink(monkeypatch, folder)
        found = run("--task", "TorqueTracking", "--seeds", 2, "--out", folder / "bench")
    assert found.exit_code == 0, found.output
    return folder / "bench"


@pytest.fixture
def benchmark(made, tmp_path):
    """A copy of the benchmark, in a folder that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "bench"))


def rows_of(folder):
    return {path.parent.relative_to(folder).as_posix(): Row.load(path) for path in folder.glob(f"*/*/*/{RESULT}")}


@pytest.mark.slow
def test_every_run_has_its_row_and_the_table_has_them_all(benchmark):
    rows = rows_of(benchmark)
    assert {name.partition("/")[2] for name in rows} == {
        *(f"{name}/0" for name in ("rest", "cascade", "expert", "nominal", "ppo")),
        "ppo/1",
    }
    trained = rows["TorqueTracking-v1/ppo/1"]
    assert trained.seeds == [seeds.TEST[0], seeds.TEST[EPISODES - 1]] and len(trained.scores) == EPISODES
    assert trained.steps == 64 and trained.cpu_seconds["training"] > 0.0 and "sources" in trained.versions
    assert all(0.0 <= score <= 1.0 for row in rows.values() for score in row.scores)
    assert AgentFile.load(benchmark / "TorqueTracking-v1/ppo/1/agent.npz").card["seeds"]["training"] == 1
    table = {row["policy"]: row for row in json.loads((benchmark / "results.json").read_text())}
    assert table["ppo"]["seeds"] == 2 and table["expert"]["improvement"] is None
    assert table["ppo"]["mean"] == np.mean([rows[f"TorqueTracking-v1/ppo/{seed}"].scores for seed in (0, 1)])
    assert table["rest"]["improvement"]["value"] < 0.5 < table["expert"]["score"]["value"]
    assert (benchmark / "TorqueTracking-v1/learning_curves.png").read_bytes().startswith(b"\x89PNG")
    text = (benchmark / "results.md").read_text()
    assert "| TorqueTracking-v1 | ppo | 2 | 0." in text and str(seeds.TEST[0]) in text


@pytest.mark.slow
def test_the_scores_of_a_baseline_are_those_of_its_episodes(benchmark):
    lanes = make_environments(TASK, EPISODES, autoreset_mode="Disabled")
    try:
        expert = baseline("expert", TASK, lanes.config, 1)
        observation, told = lanes.reset(seed=[*seeds.TEST[:EPISODES]])
        expert.told(told["parameters"], np.ones(EPISODES, bool))
        total = np.zeros(EPISODES)
        for _ in range(TASKS[TASK].steps):
            observation, reward, *_ = lanes.step(expert.act(observation))
            total += reward
    finally:
        lanes.close()
    scores = rows_of(benchmark)["TorqueTracking-v1/expert/0"].scores
    np.testing.assert_allclose(scores, total / TASKS[TASK].steps, rtol=1e-12)


@pytest.mark.slow
def test_what_is_complete_is_not_made_again(benchmark, monkeypatch):
    kept = {path: path.stat().st_mtime_ns for path in benchmark.glob(f"*/*/*/{RESULT}")}
    lost = benchmark / "TorqueTracking-v1/ppo/1"
    before = Row.load(lost / RESULT)
    del kept[lost / RESULT]
    (lost / RESULT).unlink()  # as if Ctrl-C had come just before it was written
    assert run("--task", "TorqueTracking", "--seeds", 2, "--out", benchmark).exit_code == 2
    found = run("--task", "TorqueTracking", "--seeds", 2, "--out", benchmark, "--resume")
    assert found.exit_code == 0, found.output
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert Row.load(lost / RESULT).scores == before.scores


def test_ctrl_c_leaves_what_is_complete(tmp_path, monkeypatch):
    made = runs._made

    def interrupted(one, *rest):
        if one.policy == "ppo":
            raise KeyboardInterrupt
        return made(one, *rest)

    monkeypatch.setattr(runs, "_made", interrupted)
    found = run("--task", TASK, "--seeds", 1, "--out", tmp_path / "bench")
    assert found.exit_code == 130 and "continue with --resume" in found.output
    assert {name.split("/")[1] for name in rows_of(tmp_path / "bench")} == {"rest", "cascade", "expert", "nominal"}


def test_another_benchmark_is_not_mixed_in(benchmark):
    found = run("--task", TASK, "--seeds", 2, "--steps", 32, "--out", benchmark, "--resume")
    assert found.exit_code == 2 and "was made with other hyper-parameters than this run has" in found.output


@pytest.mark.slow
def test_worker_processes_change_no_score(benchmark, tmp_path):
    found = run("--task", TASK, "--seeds", 2, "--out", tmp_path / "other", "--workers", 2)
    assert found.exit_code == 0, found.output
    one, other = rows_of(benchmark), rows_of(tmp_path / "other")
    # Workers read the shipped hyper-parameters never: they are given with the run.
    assert {name: row.scores for name, row in one.items()} == {name: row.scores for name, row in other.items()}


# --- what trains there ------------------------------------------------------------------------------------------------
SHIPPED = hyperparameters.FOLDER


@pytest.mark.every(48)
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ["ppo", "recurrent_ppo", "sac", "crossq"])
def test_the_hyperparameters_that_ship_train_on_every_task(algorithm, task, tmp_path, monkeypatch):
    monkeypatch.setattr(hyperparameters, "FOLDER", SHIPPED)
    given = hyperparameters.load(task, algorithm)
    small = {"n_steps": 8, "batch_size": 16, "n_epochs": 1} if "ppo" in algorithm else {"learning_starts": 4}
    hyperparameters.merge(given, {"n_envs": 2, "n_timesteps": 16, **small})
    if given.get("imitate"):
        [teacher] = given["imitate"] if isinstance(given["imitate"], dict) else [given["imitate"]]
        given["imitate"] = {teacher: {"steps": 8, "updates": 1}}
    assert train(TrainingRun(task, algorithm, given), tmp_path).environment == task


class Recorder:
    """A teacher that is told its machines."""

    def __init__(self, actions):
        self.actions = actions
        self.begun = np.zeros(2, int)
        self.inertia = set()

    def told(self, parameters, mask):
        self.begun += mask
        self.inertia |= set(parameters["load.inertia"][mask])

    def reset(self, mask):
        pass

    def act(self, rows):
        return np.zeros((len(rows), self.actions))


def taught(task, monkeypatch):
    """Return the teacher after three episodes of each of two environments."""
    monkeypatch.setattr(hyperparameters, "FOLDER", SHIPPED)
    run = TrainingRun(task, "ppo", {**hyperparameters.load(task, "ppo"), "n_envs": 2})
    _, env = make_env(run)
    teacher = Recorder(env.action_space.shape[0])
    try:
        imitate(make_model(run, env)[0], teacher, seed=1, steps=2 * (2 * TASKS[task].steps + 5), updates=1)
    finally:
        env.close()
    return teacher


@pytest.mark.slow
def test_a_teacher_is_told_the_machine_of_each_episode(monkeypatch):
    found = taught(TASK, monkeypatch)
    assert found.begun.tolist() == [3, 3] and len(found.inertia) == 6


def test_a_teacher_is_told_of_a_payload_that_changes(monkeypatch):
    assert len(taught("ServoDrive/PayloadScheduling-v1", monkeypatch).inertia) > 6


# --- submitted policies -----------------------------------------------------------------------------------------------
@pytest.fixture
def stranger(benchmark, tmp_path):
    """A stranger's file, and the folder with the table that it enters."""
    shutil.copy(benchmark / "TorqueTracking-v1/ppo/0/agent.npz", tmp_path / "stranger.npz")
    found = run("--submit", tmp_path / "stranger.npz", "--task", TASK, "--out", benchmark, "--resume")
    assert found.exit_code == 0, found.output
    return benchmark / "TorqueTracking-v1/stranger/0" / RESULT


def test_a_strangers_policy_enters_the_table_and_its_row_holds(stranger):
    assert "| TorqueTracking-v1 | stranger |" in (stranger.parents[3] / "results.md").read_text()
    assert Row.load(stranger).scores == Row.load(stranger.parents[2] / "ppo/0" / RESULT).scores
    found = run("--check", stranger)
    assert found.exit_code == 0 and "all 4 scores are the row's, to the last digit" in found.output
    assert "not who made either" in found.output


def test_a_row_that_was_changed_does_not_pass(stranger):
    table = json.loads(stranger.read_text())
    stranger.write_text(json.dumps({**table, "scores": [1.0] * EPISODES}))
    found = run("--check", stranger)
    assert found.exit_code == 2 and "was changed since it was written" in found.output


def test_a_row_with_a_new_digest_but_false_scores_does_not_hold(stranger):
    row = Row.load(stranger)
    stranger.write_text(Row(**{**vars(row), "scores": [1.0] * EPISODES}).text())
    found = run("--check", stranger)
    assert found.exit_code == 1 and "does not hold" in found.output and "outside the row's interval" in found.output


def test_a_row_is_of_its_file_alone(stranger):
    other = stranger.parents[2] / "ppo/1/agent.npz"
    shutil.copy(other, stranger.parent / "stranger.npz")
    found = run("--check", stranger)
    assert found.exit_code == 1 and "is not the row's policy: its SHA-256 is" in found.output
    (stranger.parent / "stranger.npz").unlink()
    found = run("--check", stranger)
    assert found.exit_code == 2 and "is not beside it" in found.output


def test_a_python_function_is_submitted_and_checked(tmp_path):
    (tmp_path / "own_policy_of_test.py").write_text("def act(rows):\n    return 5.0 * rows[:, :1]\n")
    found = run("--submit", "own_policy_of_test:act", "--task", TASK, "--out", tmp_path / "own")
    assert found.exit_code == 0, found.output
    path = tmp_path / "own/TorqueTracking-v1/own_policy_of_test.act/0" / RESULT
    refused = run("--check", path)  # a row of somebody else says what is run
    assert refused.exit_code == 2 and "if you trust it, give --trust" in refused.output
    assert run("--check", path, "--trust").exit_code == 0


@pytest.mark.slow
def test_a_file_with_pickles_needs_trust(tmp_path):
    from stable_baselines3 import PPO

    from drive_env.envs.stable_baselines import DriveVecEnv

    env = DriveVecEnv(make_environments(TASK, 1, autoreset_mode="SameStep"))
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").save(tmp_path / "plain.zip")
    env.close()
    given = ("--submit", tmp_path / "plain.zip", "--task", TASK, "--out", tmp_path / "own")
    refused = run(*given)
    assert refused.exit_code == 2 and "give --trust" in refused.output
    path = tmp_path / "own/TorqueTracking-v1/plain/0" / RESULT
    assert run(*given, "--resume", "--trust").exit_code == 0
    assert run("--check", path).exit_code == 2 and run("--check", path, "--trust").exit_code == 0


# --- mistakes ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("given", "says"),
    [
        (("--task", "juggling"), "there is no environment 'juggling'; there are "),
        (("--task", "tracking"), "ServoDrive/Tracking-v0 is no task of the suite"),
        (("--algorithm", "dqn"), "there is no algorithm 'dqn'; there are ppo"),
        (("--seeds", 0), "--seeds 0 must be 1 or more"),
        (("--steps", 0), "--steps 0 must be 1 or more"),
        (("--trust",), "--trust is for --submit and --check"),
        (("--resume",), "give it with --out"),
        (("--submit", "expert", "--task", TASK), "expert has the name of a baseline or an algorithm"),
        (("--submit", "agent.npz"), "--submit judges a policy on one task; give --task once"),
        (("--submit", "agent.npz", "--task", TASK, "--seeds", 3), "--submit takes no --seeds; leave it out"),
        (("--submit", "gone.npz", "--task", TASK), "gone.npz"),
        (("--check", "gone.json"), "gone.json cannot be read: No such file or directory"),
        (("--check", "gone.json", "--task", TASK), "--check takes no --task; leave it out"),
        (("--task", TASK, "--workers", 2, "--cluster", "tcp://localhost:1"), "exclude each other"),
    ],
)
def test_a_mistake_is_told_in_a_line(given, says, tmp_path):
    found = run(*given, *(() if "--resume" in given or "--check" in given else ("--out", tmp_path / "bench")))
    assert found.exit_code == 2 and says in found.output, found.output
    assert "Traceback" not in found.output and len(found.output.strip().splitlines()) == 1
    assert not (tmp_path / "bench").exists()


@pytest.mark.parametrize(("content", "says"), [
    (b"no agent", "mine.npz is not an agent"),
    (Path(shipped("arm_path")).read_bytes(), "the policy takes 48 entries"),
])  # fmt: skip
def test_a_policy_that_cannot_act_in_the_task_is_refused_before_the_baselines_are_run(content, says, tmp_path):
    (tmp_path / "mine.npz").write_bytes(content)
    found = run("--submit", tmp_path / "mine.npz", "--task", TASK, "--out", tmp_path / "bench")
    assert found.exit_code > 0 and says in found.output and "/tmp/tmp" not in found.output, found.output
    assert not (tmp_path / "bench").exists()


def test_a_file_that_is_no_row_is_told(tmp_path):
    for text in ("", "[]", "{}", '{"digest": 1, "task": 3}'):
        (tmp_path / RESULT).write_text(text)
        with pytest.raises(RowError, match="is not a row of the benchmark"):
            Row.load(tmp_path / RESULT)


def test_a_row_names_no_file_elsewhere(tmp_path):
    row = Row(TASK, "mine", "submitted", 0, "../agent.npz", "", [seeds.TEST[0]] * 2, [0.5], 0)
    (tmp_path / RESULT).write_text(row.text())
    with pytest.raises(RowError, match="is not a row of the benchmark"):
        Row.load(tmp_path / RESULT)


def test_rows_of_other_episodes_are_not_compared(benchmark):
    path = benchmark / "TorqueTracking-v1/ppo/1" / RESULT
    row = Row.load(path)
    path.write_text(Row(**{**vars(row), "seeds": [row.seeds[0], row.seeds[0] + 1], "scores": row.scores[:2]}).text())
    with pytest.raises(ValueError, match="they cannot be compared"):
        report.read_rows(benchmark)
