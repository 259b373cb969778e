"""What is no number reaches no drive: refused before anything is sent, with environment, entry and value."""

import re

import gymnasium
import numpy as np
import pytest
from rigs.tables import every_row
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, ObjectAccessError
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.tracking import Tracking

ENVIRONMENTS = {"ServoDrive/Tracking-v0": Tracking, "ServoDrive/GainScheduling-v0": GainScheduling,
                "ServoDrive/GainTuning-v0": GainTuning}  # fmt: skip
NO_NUMBERS = [np.nan, np.inf, -np.inf]


def message(lane, entry, value):
    return rf"entry {entry} of the action of environment {lane} is {value:g}, not a finite number; nothing was sent"


class Watched:
    """Drives that count what they are told."""

    def __init__(self, drives):
        self._drives, self.told = drives, 0

    def __getattr__(self, name):
        found = getattr(self._drives, name)
        if name not in ("write", "record", "advance", "reset_node"):
            return found

        def counted(*args, **kwargs):
            self.told += 1
            return found(*args, **kwargs)

        return counted


@pytest.mark.every(6)
@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_drives_of_a_bus_are_told_nothing(name, value):
    with EmulatedDrives(load="inertia", num_threads=1) as emulated, on_bus(emulated, safety=False) as drives:
        watched = Watched(drives)
        env = gymnasium.make(name, load="inertia", distributions=None, drives=watched).unwrapped
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape, np.float32)
        env.step(action)
        action[-1] = value
        told = watched.told
        with pytest.raises(ValueError, match=message(0, len(action) - 1, value)):
            env.step(action)
        assert watched.told == told
        env.step(np.zeros_like(action))  # the episode goes on


@pytest.mark.every(4)
@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_emulated_environments_refuse_it_too(name, value):
    lanes = ENVIRONMENTS[name](3, load="inertia", num_threads=1)
    lanes.reset(seed=0)
    actions = np.zeros(lanes.action_space.shape, np.float32)
    actions[1, -1] = value
    with pytest.raises(ValueError, match=message(1, actions.shape[1] - 1, value)):
        lanes.step(actions)
    lanes.step(np.zeros_like(actions))
    lanes.close()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_actions_of_another_shape_are_refused_by_it(name):
    lanes = ENVIRONMENTS[name](2, load="inertia", num_threads=1)
    alone = gymnasium.make(name, load="inertia", num_threads=1).unwrapped
    for env in (lanes, alone):
        env.reset(seed=0)
        shape = env.action_space.shape
        for other in ((3, *shape), (0,), (*shape[:-1], shape[-1] + 1)):
            with pytest.raises(ValueError, match=re.escape(f"the action has shape {other}, and {shape} is taken")):
                env.step(np.zeros(other))
        env.close()


def test_lists_and_huge_numbers_are_numbers():
    lanes = Tracking(2, load="inertia", num_threads=1)
    lanes.reset(seed=0)
    lanes.step([[0.5], [-0.5]])
    lanes.step(np.array([[1e300], [-1e300]]))  # cut off at the ends of the range, as ever
    assert lanes.drives.read("Target position").size == 2
    lanes.close()


def test_the_action_of_a_lane_that_has_ended_is_ignored_and_not_sent():
    lanes = Tracking(2, load="inertia", duration=0.003, num_threads=1)
    lanes.reset(seed=0)
    actions = np.zeros((2, 1), np.float32)
    for _ in range(10):
        *_, truncated, _ = lanes.step(actions)
        if truncated.all():
            break
    assert truncated.all()
    lanes.step(np.full((2, 1), np.nan))
    assert np.isfinite(lanes._episodes.action).all()
    with pytest.raises(ValueError, match=message(0, 0, np.nan)):
        lanes.step(np.full((2, 1), np.nan))
    lanes.close()


# --- below the environments -------------------------------------------------------------------------------------------
VALUES = [np.nan, np.inf, 1e300, 0.5, 1.0, True, "5", None, 2**63, 2**70, -(2**63) - 1, [1, 2, 3], 1j]


@pytest.fixture(scope="module", params=["emulator", "bus"])
def drives(request):
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        if request.param == "emulator":
            yield emulated
            return
        with on_bus(emulated, safety=False) as found:
            yield found


@every_row("value", VALUES)
@every_row("name", [0x607A, 0x6040, 0x6081, (0x2042, 1)])
def test_write_takes_whole_numbers_alone(name, value, drives):
    before = drives.read(name)
    with pytest.raises(ObjectAccessError):
        drives.write(name, value)
    assert drives.read(name) == before


@every_row("value", VALUES)
def test_play_takes_whole_numbers_alone(value, drives):
    rows = [value, value] if isinstance(value, list) else [value] * 3
    before = drives.read(0x607A)
    with pytest.raises((ObjectAccessError, ValueError)):
        drives.record([0x6064], 0.003, play={0x607A: rows})
    assert drives.read(0x607A) == before


@every_row("value", VALUES)
def test_play_that_repeats_takes_whole_numbers_alone(value, drives):
    """The same call again goes a shorter way."""
    for _ in range(3):
        drives.record([0x6064], 0.002, play={0x607A: np.zeros(2, np.int64)})
    with pytest.raises((ObjectAccessError, ValueError)):
        drives.record([0x6064], 0.002, play={0x607A: value if isinstance(value, list) else [value] * 2})


@pytest.mark.parametrize("duration", [np.nan, np.inf, -np.inf, 1e300, -1.0, 1e8])
def test_time_that_cannot_pass(duration, drives):
    for call in (drives.advance, lambda time: drives.record([0x6064], time),
                 lambda time: drives.record([0x6064], 0.01, period=time)):  # fmt: skip
        with pytest.raises(ValueError, match=r"communication cycles|period must"):
            call(duration)
