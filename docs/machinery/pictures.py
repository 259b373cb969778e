"""Draw the site's pictures of loads and environments, and film a machine while it is tuned, into docs/assets.

python docs/machinery/pictures.py             # all; or the names of some: loads environments tasks film

Pictures are committed: they need OpenGL (as `drive-env render` does), which not every computer that builds the site
has. Run it again after a load or an environment has changed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from agents.evaluation.open_policy import open_policy
from agents.policies.baselines import baseline
from agents.shipped import TUNER
from agents.tasks import short_name
from drive_env import EmulatedDrives, motion
from drive_env.drives.interface import CYCLE
from drive_env.drives.raw_gains import write_gains
from drive_env.envs import ENVIRONMENTS
from drive_env.envs.suite import TASKS
from drive_env.pictures.demonstration import PictureFormat
from drive_env.pictures.recording import Recorder
from drive_env.pictures.render import Picture
from drive_env.trials.gain_trial import PROBE
from mechanics.arrays import Integers
from mechanics.loads import LOADS
from mechanics.shaft import one
from tuning.auto.one_button import auto
from tuning.target import emulated

ASSETS = Path(__file__).resolve().parent.parent / "assets"
QUALITY = 82  # of WebP
LOAD_PICTURE = PictureFormat(width=960, height=420)  # of which the machine is the left half
# The film: a belt axis with the gains before auto, with those that it tried, and with its answer.
FILM = PictureFormat(width=800, height=450, frames_per_second=12.5)
SLOW, MOVE, ANSWER = 10.0, 131_072, 16  # slow motion; two turns [inc]; frames for which the answer's end is held
SHOWN = 0.32  # s that are shown: the move, and how it settles


class Row(NamedTuple):
    """How an environment's picture comes about: options, the policy that acts, and after how many steps it is taken."""

    policy: str
    steps: int
    options: dict[str, Any]


ENVIRONMENT_ROWS = {
    "gain_tuning": Row(TUNER, 6, {"load": "belt"}),
    "gain_scheduling": Row("", 90, {"load": "gantry"}),
    "tracking": Row("tracking_inverted_pendulum", 700, {"load": "inverted_pendulum", "mode": "cst"}),
}


def draw_loads() -> None:
    """Draw every load at rest."""
    for load in LOADS.values():
        with Picture(load, LOAD_PICTURE) as picture:
            save(picture.scene.draw(one(load).start), ASSETS / "loads" / f"{load.name}.webp")


def draw_environments() -> None:
    """Draw every environment after some steps, with an agent that ships at work where there is one."""
    for name, (module, _) in ENVIRONMENTS.items():
        row = ENVIRONMENT_ROWS[module]
        with gymnasium.make(name, render_mode="rgb_array", **row.options) as env:
            policy = open_policy(row.policy).policy if row.policy else None
            observation, _ = env.reset(seed=0)
            for _ in range(row.steps):
                action = np.zeros(env.action_space.shape)
                if policy is not None:
                    action = np.asarray(policy.act(observation[None]))[0]
                observation, *_ = env.step(action)
            save(np.asarray(env.render()), ASSETS / "environments" / f"{module}.webp")


def draw_tasks() -> None:
    """Draw every task of the suite with its expert at work, after a third of the episode."""
    for name, task in TASKS.items():
        with gymnasium.make(name, render_mode="rgb_array") as env:
            lanes = env.unwrapped.vector  # type: ignore[attr-defined]
            expert = baseline("expert", name, lanes.config, lanes.single_action_space.shape[0])
            observation, info = env.reset(seed=1)
            for _ in range(task.steps // 3):
                if hasattr(expert, "told") and "parameters" in info:  # at the begin, and while a payload changes
                    expert.told(
                        {key: np.atleast_1d(value) for key, value in info["parameters"].items()}, np.ones(1, bool)
                    )
                observation, _, _, _, info = env.step(expert.act(observation))
            save(np.asarray(env.render()), ASSETS / "tasks" / f"{short_name(name)}.webp")


def film_tuning() -> None:
    """Film a move of a belt axis with the gains before auto, with those that it tried, and with its answer."""
    with emulated(load="belt") as target, tempfile.TemporaryDirectory() as folder:
        (axis,) = auto(target, Path(folder) / "before.toml").axes
        known = target.device.gains
    designed = axis.corrections[0].old if axis.corrections else axis.after
    more = known.scaled(np.array(axis.after), PROBE, known.columns_of("velocity")[:1])
    rows = [("before", axis.before), ("designed", designed)]
    rows += [("corrected", one.new) for one in axis.corrections]
    rows += [(f"velocity P x {PROBE:g}", tuple(more.tolist())), ("answer", axis.after)]
    pictures = [
        Image.fromarray(frame)
        for name, gains in rows
        for frame in move_frames(f"{name}: {in_words(known.titles, gains)}", np.array(gains)[None])
    ]
    pictures += [pictures[-1]] * ANSWER
    pictures[0].save(
        ASSETS / "tuning.webp", save_all=True, append_images=pictures[1:], quality=60, method=6, loop=0,
        duration=round(1e3 / FILM.frames_per_second),
    )  # fmt: skip
    pictures[-1].save(ASSETS / "tuning_still.webp", quality=QUALITY, method=6)


def in_words(titles: tuple[str, ...], gains: Iterable[int]) -> str:
    """Return the gains of the outer loops, with their names."""
    return ", ".join(f"{title} {gain}" for title, gain in zip(titles, gains, strict=True) if "torque" not in title)


def move_frames(title: str, gains: Integers) -> Iterator[NDArray[np.uint8]]:
    """Move the axis once with some gains, and draw it as it moves."""
    with EmulatedDrives(load="belt") as drives:
        write_gains(drives, gains)
        motion.enable(drives, mode="pp")
        recorder = Recorder(drives)
        motion.start_move(recorder, MOVE, relative=True)
        recorder.advance(SHOWN)
        recording = recorder.recording(title)
    step = round(1.0 / (FILM.frames_per_second * SLOW * CYCLE))
    with Picture(drives.load, FILM) as picture:
        for k in range(step - 1, len(recording.t), step):
            yield picture.frame(recording, k, SLOW)


def save(image: NDArray[np.uint8], path: Path) -> None:
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, quality=QUALITY, method=6)
    print(f"{path.relative_to(ASSETS.parent)}: {path.stat().st_size} bytes")


JOBS: dict[str, Callable[[], None]] = {
    "loads": draw_loads,
    "environments": draw_environments,
    "tasks": draw_tasks,
    "film": film_tuning,
}

if __name__ == "__main__":
    for wanted in sys.argv[1:] or JOBS:
        JOBS[wanted]()
