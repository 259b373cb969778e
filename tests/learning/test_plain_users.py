"""What users of plain Gymnasium and Stable-Baselines3 expect to work: one line, their own files, films, rewards."""

from __future__ import annotations

import csv

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from rigs.drawing import needs_gl
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.vec_env import VecEnv
from typer.testing import CliRunner

import agents.training.train
from agents.commands.cli import app
from agents.evaluation.open_policy import open_policy
from agents.training.checkpoint import CheckpointError, UntrustedError
from agents.training.learning_curve import draw_learning_curve
from drive_env import EmulatedDrives, motion
from drive_env.envs import make_vec_env
from drive_env.envs.pictures import Pictures
from drive_env.envs.tracking import Tracking

TRACKING = "ServoDrive/Tracking-v0"
SHORT = {"num_threads": 1, "duration": 0.1}


# --- Stable-Baselines3 ------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_line_gives_what_stable_baselines_trains_on():
    env = make_vec_env(TRACKING, 4, load="inertia", **SHORT)
    assert isinstance(env, VecEnv) and env.num_envs == 4
    model = PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(1024)
    assert len(model.ep_info_buffer) > 0, "nothing for SB3's log"
    assert {round(one["l"]) for one in model.ep_info_buffer} == {100}
    env.close()


def test_a_name_that_is_none_is_told_with_the_nearest():
    with pytest.raises(ValueError, match=r"did you mean .ServoDrive/Tracking-v0."):
        make_vec_env("ServoDrive/Traking-v0")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PPO, A2C, SAC])
def test_its_own_file_is_evaluated_if_its_writer_is_trusted(kind, tmp_path, caplog):
    env = make_vec_env(TRACKING, 1, load="inertia", **SHORT)
    model = kind("MlpPolicy", env, seed=1, device="cpu")
    file = tmp_path / "mine.zip"
    model.save(file)
    observation = env.reset()
    wanted, _ = model.predict(observation, deterministic=True)
    env.close()
    with pytest.raises(UntrustedError, match="it runs code that its author put there"):
        open_policy(str(file))
    found = open_policy(str(file), trust=True)
    assert found.environment is None  # the file does not say
    np.testing.assert_array_equal(found.policy.act(observation), wanted)
    arguments = ["evaluate", str(file), "-e", "tracking", "--load", "inertia", "--episodes", "2",
                 "--out", str(tmp_path / "run")]  # fmt: skip
    told = CliRunner().invoke(app, arguments)
    assert told.exit_code == 2 and "--trust" in told.output and not (tmp_path / "run").exists()
    told = CliRunner().invoke(app, [*arguments, "--trust"])
    assert told.exit_code == 0, told.output
    assert "RMS following error" in told.output
    unsaid = "does not say with which options of the environment it was trained"
    assert unsaid in caplog.text
    caplog.clear()
    told = CliRunner().invoke(app, ["evaluate", str(file), "-e", "TorqueTracking", "--episodes", "2", "--trust"])
    assert "score [0...1]" in told.output and unsaid not in caplog.text  # a task has but one configuration
    told = CliRunner().invoke(app, ["evaluate", str(file), "--trust", "--episodes", "2"])
    assert told.exit_code == 2 and "does not name its environment; give --environment" in told.output


def test_a_zip_of_something_else_is_none(tmp_path):
    import zipfile

    file = tmp_path / "other.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("letter.txt", "dear sir")
    with pytest.raises(CheckpointError, match="is not a checkpoint of drive-agent"):
        open_policy(str(file), trust=True)


# --- a reward of one's own --------------------------------------------------------------------------------------------
def by_terms(observation, action, info):
    return 2.0 * info["reward_terms"]["tracking"] - 0.5 * np.abs(action).sum(axis=-1)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_function_gives_the_rewards_of_all_lanes(mode):
    lanes = Tracking(3, load="inertia", autoreset_mode=mode, reward=by_terms, **SHORT)
    lanes.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(150):
        action = rng.uniform(-1.0, 1.0, (3, 1)).astype(np.float32)
        before = lanes._ended.copy()
        _, reward, terminated, truncated, info = lanes.step(action)
        told = info.get("final_info", info)
        wanted = np.where(before, 0.0, by_terms(None, action, told))  # an environment that begins anew earns nothing
        np.testing.assert_allclose(reward, wanted, rtol=1e-12)
        if mode == "NextStep":
            assert not (before & (terminated | truncated)).any()
    lanes.close()


def test_one_lane_earns_what_lane_0_does():
    env = gymnasium.make(TRACKING, load="inertia", reward=by_terms, **SHORT)
    env.reset(seed=3)
    _, reward, _, _, info = env.step(np.array([0.4], np.float32))
    assert reward == pytest.approx(2.0 * info["reward_terms"]["tracking"] - 0.2, rel=1e-6)
    env.close()


@pytest.mark.parametrize(("reward", "says"), [
    (lambda *_: 1.0, "it must return 2 numbers, one for each environment"),
    (lambda *_: np.array([0.0, np.nan]), "it must return 2 numbers, one for each environment"),
])  # fmt: skip
def test_a_reward_that_is_none_is_told(reward, says):
    lanes = Tracking(2, load="inertia", reward=reward, **SHORT)
    lanes.reset(seed=0)
    with pytest.raises(ValueError, match=says):
        lanes.step(np.zeros((2, 1), np.float32))
    lanes.close()


def test_what_is_no_function_is_no_reward():
    with pytest.raises(ValueError, match="reward is a function of observations, actions and info, not 'sparse'"):
        Tracking(1, load="inertia", reward="sparse", **SHORT)


# --- pictures ---------------------------------------------------------------------------------------------------------
class Scope:
    """Takes what a picture would be drawn of."""

    def frame(self, recording):
        self.recording = recording
        return np.zeros((2, 2, 3), np.uint8)

    def close(self):
        pass


@pytest.fixture
def scope(monkeypatch):
    made = Scope()
    monkeypatch.setattr(Pictures, "_drawn", lambda self: made)
    return made


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_a_first_picture_after_60_steps_shows_them_and_what_was_followed(scope, mode):
    env = gymnasium.make(TRACKING, load="inertia", mode=mode, render_mode="rgb_array", disable_env_checker=True,
                         **SHORT)  # fmt: skip
    env.reset(seed=1)
    errors = []
    for _ in range(60):
        observation, *_ = env.step(np.zeros(1, np.float32))
        errors.append(observation[0])
    env.render()
    run = scope.recording
    assert len(run.t) == 61  # the reset, and the steps
    amplitude = 2.0 * np.pi * env.unwrapped.vector.config.amplitude
    assert np.isfinite(run.position_demand[1:]).all() and np.isfinite(run.velocity_demand[1:]).all()
    if mode != "csp":  # there the drive's own demand is drawn, which is what the action says
        # A drive tells a cycle late how it stands; the observation is of float32.
        error = (run.position_demand - run.position)[1:, 0] / amplitude
        np.testing.assert_allclose(error[:-1], errors[1:], atol=2e-5)
    env.close()


@pytest.mark.slow
@needs_gl
def test_gymnasiums_recorder_films_an_episode(tmp_path):
    from gymnasium.wrappers import RecordVideo

    env = gymnasium.make(TRACKING, load="inertia", render_mode="rgb_array", num_threads=1, duration=0.02)
    env = RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True, disable_logger=True)
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        done = terminated or truncated
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    assert film.stat().st_size > 1000


# --- a training that is interrupted, and what one leaves --------------------------------------------------------------
def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_a_training_interrupted_before_its_first_checkpoint_leaves_nothing(tmp_path, monkeypatch):
    real = agents.training.train.train

    def train(run, folder, *, report=None, **options):
        return real(run, folder, report=interrupted, **options)

    monkeypatch.setattr(agents.training.train, "train", train)
    out = tmp_path / "run"
    told = CliRunner().invoke(app, ["train", "tracking", "--load", "inertia", "--steps", "100000", "--out", str(out)])
    assert told.exit_code == 130
    assert "interrupted before the first checkpoint: the run cannot be continued" in told.output
    assert not out.exists()
    told = CliRunner().invoke(app, ["train", "--resume", str(out), "--trust"])
    assert told.exit_code == 2 and "there is no file" in told.output


def test_the_learning_curve_is_the_table(tmp_path, monkeypatch):
    table = tmp_path / "training.csv"
    draw_learning_curve(table, tmp_path / "none.png", "nothing yet")
    assert not (tmp_path / "none.png").exists()
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([["timesteps", "return", "term tracking", "term effort"],
                          [100, 1.0, 0.1, 0.9], [200, "", 0.2, 0.8], [300, 3.0, 0.3, 0.7]])  # fmt: skip
    drawn = []
    from matplotlib.axes import Axes

    plot = Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda self, x, y, **options: drawn.append((x, y)) or plot(self, x, y, **options))
    draw_learning_curve(table, tmp_path / "curve.png", "a run")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    steps = [100, 200, 300]
    np.testing.assert_array_equal(
        np.array([[x, y] for x, y in drawn]),
        [[steps, [1.0, np.nan, 3.0]], [steps, [0.1, 0.2, 0.3]], [steps, [0.9, 0.8, 0.7]]],
    )


# --- a move of drives that cannot -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("mode", "says"), [
    (None, "axis 0 is not enabled and cannot move: statusword 0250h, mode 0"),
    ("csv", "axis 0 is not in pp and cannot move: statusword [0-9A-F]{4}h, mode 9"),
])  # fmt: skip
def test_a_move_of_what_cannot_move_says_why_and_writes_nothing(mode, says):
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        if mode is not None:
            motion.enable(drives, mode=mode)
        before = drives.read(0x607A)
        with pytest.raises(RuntimeError, match=says) as told:
            motion.move_to(drives, 5000)
        assert 'motion.enable(drives, mode="pp") first' in str(told.value)
        assert drives.read(0x607A) == before
