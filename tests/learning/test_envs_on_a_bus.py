"""The same policy with the same seed on the emulator and through CanDrives in lockstep: the same observations."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.tracking import TASKS, Tracking
from mechanics.loads import LOADS

NOMINAL = {"parameters": {}}
EVERY_LOAD = pytest.mark.parametrize(
    "load", [load if load in TASKS else pytest.param(load, marks=pytest.mark.slow) for load in LOADS]
)


def twin(emulated):
    """Return drives of one machine, at rest, with the noise that these have now."""
    other = EmulatedDrives(load=emulated.load, num_threads=1)
    other.inside.noise_seeds[:] = emulated.inside.noise_seeds
    other.machine.reset()
    return other


def run(lanes, steps, seed):
    """Return observations, rewards and ends of an episode."""
    rng = np.random.default_rng(7)
    rows = [lanes.reset(seed=seed)[0]]
    results = []
    for _ in range(steps):
        low, high = lanes.single_action_space.low, lanes.single_action_space.high
        action = 0.5 * rng.uniform(low, high).astype(np.float32)
        observation, reward, terminated, truncated, _ = lanes.step(action[None])
        rows.append(observation)
        results.append((reward[0], terminated[0], truncated[0]))
        if terminated[0]:
            break
    return np.array(rows), np.array(results)


def assert_same(one, other):
    for expected, found in zip(one, other, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("load", "how"),
    [
        *(pytest.param(load, {}, id=load, marks=[] if load in TASKS else pytest.mark.slow) for load in LOADS),
        *(pytest.param("two_mass", {"mode": mode, "action": action}, id=f"{mode}-{action}")
          for mode, action in (("csv", "offset"), ("csp", "offset"), ("csp", "direct"))),
    ],
)  # fmt: skip
def test_tracking(load, how):
    options = {"load": load, "duration": 0.05, "delay": 2, **how}
    joint = TASKS[load].joint if load in TASKS else None
    inside = Tracking(1, num_threads=1, **options)
    expected = run(inside, 50, seed=3)
    served = twin(inside.drives)
    with on_bus(served, safety=False) as drives:
        # The pendulum's sensor is the master's own, no drive's.
        sensor = None if joint is None else lambda: served.machine.joint_positions[:, joint]
        found = run(Tracking(1, drives=drives, sensor=sensor, **options), 50, seed=3)
    assert_same(expected, found)
    assert np.ptp(expected[0], axis=0).max() > 0.0
    inside.close()


@pytest.mark.every(3)
@pytest.mark.parametrize("mode", ["csp", "csv"])
@EVERY_LOAD
def test_gain_scheduling(load, mode):
    options = {"load": load, "mode": mode, "base": "present", "payload": "none", "duration": 0.1}
    inside = GainScheduling(1, num_threads=1, distributions=NOMINAL, **options)
    expected = run(inside, 10, seed=3)
    with on_bus(twin(inside.drives), safety=False) as drives:
        found = run(GainScheduling(1, drives=drives, **options), 10, seed=3)
    assert_same(expected, found)
    inside.close()


@pytest.mark.every(3)
@EVERY_LOAD
def test_gain_tuning(load):
    """Drives that are given are taken as they are, in process too: nothing is drawn, nothing hidden is known."""
    with EmulatedDrives(load=load, num_threads=1) as drives:
        env = GainTuning(1, drives=drives, load=load, trials=1)
        expected = run(env, 1, seed=3)
        env.close()
    with on_bus(EmulatedDrives(load=load, num_threads=1), safety=False) as drives:
        env = GainTuning(1, drives=drives, load=load, trials=1)
        found = run(env, 1, seed=3)
        env.close()
    assert_same(expected, found)


def test_environments_on_a_bus_have_no_state_that_could_be_put_back():
    with EmulatedDrives(load="inertia", num_threads=1) as emulated, on_bus(emulated, safety=False) as drives:
        lanes = Tracking(1, load="inertia", drives=drives)
        for refused in (lanes.save_state, lambda: lanes.restore_state({})):
            with pytest.raises(ValueError, match="only emulated drives have a state that can be saved and restored"):
                refused()
        for duplicate in (copy.deepcopy, pickle.dumps):
            with pytest.raises(
                TypeError, match="an environment on drives that were given to it can neither be pickled"
            ):
                duplicate(lanes)
        lanes.close()
