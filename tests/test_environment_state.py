"""An environment's state is data: continued from it, environments do the same to the bit, here and elsewhere."""

from __future__ import annotations

import contextlib
import copy
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.tracking import Tracking
from drive_env.envs.vector_environment import SingleEnvironment

STEPS = {Tracking: 50, GainScheduling: 50, GainTuning: 2}
FAULTS = {
    "include": ["two_mass"],
    "faults": {"probability": 1.0, "names": ["encoder_noise", "current_offset", "payload_jump"], "at": [0.0, 0.02],
               "duration": [0.02, 0.05]},
}  # fmt: skip
SHORT = {"duration": 0.07, "autoreset_mode": "SameStep"}  # episodes begin anew within
# Devices, loads of every kind of physics, faults and delays, autoresets, a stepper's trials.
CASES = {
    "two masses": (Tracking, {"distributions": "two_mass"}),
    "faults": (Tracking, {"distributions": FAULTS, **SHORT}),
    "gantry": (Tracking, {"load": "gantry", "rate": 500, "delay": 2}),
    "pole": (Tracking, {"load": "inverted_pendulum", "action": "offset"}),
    "arm": (Tracking, {"load": "arm"}),
    "winder": (Tracking, {"load": "winder"}),
    "stepper": (
        Tracking,
        {"device": "tmcm6212", "load": "inertia", "action": "offset", "offset": 0.001, "trajectory": "hold"},
    ),
    "mains": (Tracking, {"device": "tgz_d", "load": "inertia"}),
    "belt": (GainScheduling, {"payload_every": 0.1}),
    "short": (GainScheduling, {"device": "tgz_d", "load": "inertia", **SHORT}),
    "servo": (GainTuning, {"trials": 3}),
    "servo of steppers": (GainTuning, {"device": "tmcm6212", "load": "inertia", "trials": 3}),
}
EVERY_CASE = pytest.mark.parametrize(("kind", "options"), CASES.values(), ids=CASES)
FEW = ("two masses", "stepper", "belt", "servo")
A_FEW_CASES = pytest.mark.parametrize(("kind", "options"), [CASES[name] for name in FEW], ids=FEW)


def made(kind, options, num_envs=2):
    return contextlib.closing(kind(num_envs, num_threads=1, **options))


def actions(environments, steps, number):
    space = environments.single_action_space
    rng = np.random.default_rng(number)
    shape = (steps, environments.num_envs, *space.shape)
    return (rng.uniform(-1.0, 1.0, shape) * space.high).astype(np.float32)


def run(environments, given):
    """Return observations, rewards and ends of every step."""
    found = []
    for action in given:
        observation, reward, terminated, truncated, _ = environments.step(action)
        found.append([np.array(one) for one in (observation, reward, terminated, truncated)])
    return found


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        for seen, due in zip(one, other, strict=True):
            np.testing.assert_array_equal(seen, due)


@EVERY_CASE
def test_what_is_continued_from_a_state_is_the_same_to_the_bit(kind, options):
    """Again in these environments, in others that were made alike, and once more: a state is not used up."""
    steps = STEPS[kind]
    with made(kind, options) as environments, made(kind, options) as others:
        environments.reset(seed=5)
        run(environments, actions(environments, steps, 0))
        state = environments.save_state()
        given = actions(environments, steps, 1)
        expected = run(environments, given)
        environments.restore_state(state)
        assert_same(run(environments, given), expected)
        others.reset(seed=77)
        run(others, actions(others, 1, 2))
        for _ in range(2):
            others.restore_state(state)
            assert_same(run(others, given), expected)
        assert_same(run(others, given), run(environments, given))  # random generators, too, are where they were


ELSEWHERE = """
import pickle, sys
kind, options, state, given = pickle.load(sys.stdin.buffer)
environments = kind(2, num_threads=1, **options)
environments.restore_state(state)
pickle.dump([environments.step(action)[:4] for action in given], sys.stdout.buffer)
"""


@pytest.mark.slow
@A_FEW_CASES
def test_a_state_continues_in_another_process(kind, options):
    with made(kind, options) as environments:
        environments.reset(seed=5)
        run(environments, actions(environments, 1, 0))
        given = actions(environments, STEPS[kind], 1)
        sent = pickle.dumps((kind, options, environments.save_state(), given))
        expected = run(environments, given)
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], input=sent, stdout=subprocess.PIPE, check=True)
    assert_same(pickle.loads(done.stdout), expected)


@A_FEW_CASES
@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "pickle"]
)
def test_a_copied_or_pickled_environment_goes_on_alike(kind, options, duplicate):
    name = f"ServoDrive/{kind.__name__}-v0"
    with contextlib.closing(gymnasium.make(name, num_threads=1, **options)) as single:
        single.reset(seed=3)
        single.step(np.zeros(single.action_space.shape, np.float32))
        with contextlib.closing(duplicate(single)) as twin:
            assert (
                twin.unwrapped is not single.unwrapped and twin.spec.max_episode_steps == single.spec.max_episode_steps
            )
            given = actions(single.unwrapped.vector, STEPS[kind], 1)[:, 0]
            assert_same(run(twin, given), run(single, given))
            np.testing.assert_array_equal(twin.reset()[0], single.reset()[0])
            assert twin.unwrapped.np_random.random() == single.unwrapped.np_random.random()
    with made(kind, options) as environments:
        environments.reset(seed=3)
        with contextlib.closing(duplicate(environments)) as twins:
            given = actions(environments, 2, 1)
            assert_same(run(twins, given), run(environments, given))


def test_a_state_of_a_single_environment_is_that_of_a_vector_of_one():
    with made(Tracking, {}, 1) as environments:
        single = SingleEnvironment(Tracking(1, num_threads=1, autoreset_mode="Disabled"))
        single.reset(seed=4)
        single.step(np.ones(1, np.float32))
        environments.restore_state(single.save_state())
        seen = environments.step(np.zeros((1, 1), np.float32))[0][0]
        np.testing.assert_array_equal(seen, single.step(np.zeros(1, np.float32))[0])
        single.close()


def test_what_was_scheduled_and_what_failed_goes_on_too():
    """A parameter that will change, a fault that is there, one that waits for a speed, a profile, a stuck node."""
    with made(Tracking, {"load": "inertia"}) as environments, made(Tracking, {"load": "inertia"}) as others:
        environments.reset(seed=1)
        machine = environments.drives.machine
        machine.schedule("load.inertia", 0.03, [2e-5])
        machine.fault("encoder_noise", at=0.005, duration=0.02)
        machine.fault("current_offset", when="speed > 5", where=np.array([True, False]))
        machine.load_profile([0.0, 0.02], [0.0, 0.01])
        run(environments, actions(environments, 10, 0))
        state = environments.save_state()
        given = actions(environments, 40, 1)
        expected = run(environments, given)
        others.restore_state(state)
        assert_same(run(others, given), expected)
        for name, values in machine.parameters.items():
            np.testing.assert_array_equal(others.drives.machine.parameters[name], values)
        assert [one.number for one in others.drives.machine.faults()] == [one.number for one in machine.faults()]
        environments.drives.machine.clear_fault()
        others.drives.machine.clear_fault()  # what it was without the fault is known there as well
        assert_same(run(others, given), run(environments, given))


@pytest.mark.parametrize(("kind", "options", "says"), [
    (Tracking, {"load": "gantry"}, "load is 'gantry' here|load is 'two_mass' there and 'gantry' here"),
    (Tracking, {"speed": 7.0}, r"the state is of other environments: speed is 20\.0 there and 7\.0 here$"),
    (Tracking, {"distributions": "two_mass"}, "distributions is None there and 'two_mass' here"),
    (Tracking, {"weights": {"speed": 0.5}}, "weights is"),
    (GainScheduling, {}, "environment is Tracking there and GainScheduling here"),
])  # fmt: skip
def test_a_state_of_another_configuration_is_refused_with_the_difference(kind, options, says):
    with made(Tracking, {}) as environments, made(kind, options) as others:
        state = environments.save_state()
        with pytest.raises(ValueError, match=says):
            others.restore_state(state)


def test_a_state_is_of_so_many_environments_and_of_any_number_of_threads():
    with made(Tracking, {}) as environments, made(Tracking, {}, 3) as others:
        with pytest.raises(ValueError, match="num_envs is 2 there and 3 here"):
            others.restore_state(environments.save_state())
        with contextlib.closing(Tracking(2, num_threads=2)) as threaded:
            threaded.restore_state(environments.save_state())


def test_a_state_of_other_drives_is_refused():
    from drive_env import EmulatedDrives

    with (
        EmulatedDrives(load="inertia", num_threads=1) as one,
        EmulatedDrives(load="belt", num_threads=1) as other,
        pytest.raises(ValueError, match="the state is of other drives: load is inertia there and belt here"),
    ):
        other.restore_state(one.save_state())
