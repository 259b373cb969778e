"""An environment's state is data: continued from it, environments do the same to the bit, here and elsewhere.

And a reset may begin from a state, with a machine and a trajectory that are given.
"""

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
from drive_env.envs.suite import TASKS
from drive_env.envs.tracking import Tracking
from drive_env.envs.vector_environment import SingleEnvironment

OF_TASKS = {f"ServoDrive/{kind.__name__}-v0": kind for kind in (Tracking, GainScheduling, GainTuning)}
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
    **{name: (OF_TASKS[task.environment], dict(task.options)) for name, task in TASKS.items()},
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


@pytest.mark.every(48)
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


@pytest.mark.every(4)
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


@pytest.mark.parametrize("options", [{"state": {}}, {"state": 5}, {"machine": 5}, {"machine": "heavy"}])
def test_an_option_of_reset_of_another_kind_is_refused_and_the_episode_goes_on(options):
    with made(Tracking, {}) as environments:
        environments.reset(seed=1)
        with pytest.raises(ValueError, match="give "):
            environments.reset(options=options)
        environments.step(environments.action_space.sample())


def test_a_state_of_other_drives_is_refused():
    from drive_env import EmulatedDrives

    with (
        EmulatedDrives(load="inertia", num_threads=1) as one,
        EmulatedDrives(load="belt", num_threads=1) as other,
        pytest.raises(ValueError, match="the state is of other drives: load is inertia there and belt here"),
    ):
        other.restore_state(one.save_state())


# --- what a reset may be given ----------------------------------------------------------------------------------------
@pytest.mark.every(3)
@A_FEW_CASES
def test_a_reset_to_a_state_returns_what_was_seen_there_and_goes_on(kind, options):
    with made(kind, options, 3) as environments, made(kind, options, 3) as others:
        environments.reset(seed=5)
        seen = run(environments, actions(environments, 1, 0))[-1][0]
        state = environments.save_state()
        told = environments.reset(options={"reset_mask": np.array([True, False, False])})[0]
        begun = environments.save_state()
        observation, info = others.reset(options={"state": state})
        np.testing.assert_array_equal(observation, seen)
        for name, values in environments.drives.machine.parameters.items():
            assert values[1] == info["parameters"][name][1], name
        np.testing.assert_array_equal(others.reset(options={"state": begun})[0][1:], seen[1:])  # these go on
        np.testing.assert_array_equal(others.reset(options={"state": begun})[0][0], told[0])
        given = actions(environments, 2, 1)
        assert_same(run(others, given), run(environments, given))
    name = f"ServoDrive/{kind.__name__}-v0"
    with contextlib.closing(gymnasium.make(name, num_threads=1, **options)) as single:
        single.reset(seed=5)
        state = single.unwrapped.save_state()
        single.unwrapped.np_random.random()
        single.reset(options={"state": state})
        np.testing.assert_equal(single.unwrapped.save_state(), state)


def test_an_episode_that_had_ended_has_ended_in_its_state():
    with made(Tracking, {"duration": 0.002, "autoreset_mode": "Disabled"}) as environments:
        environments.reset(seed=0)
        run(environments, actions(environments, 2, 0))
        state = environments.save_state()
        environments.reset()
        environments.restore_state(state)
        with pytest.raises(gymnasium.error.ResetNeeded):
            environments.step(environments.action_space.sample())


@pytest.mark.parametrize(("kind", "options"), [
    (Tracking, {"distributions": "two_mass"}), (GainScheduling, {"load": "two_mass", "payload": "none"}),
    (GainTuning, {"load": "two_mass"}),
])  # fmt: skip
def test_a_reset_takes_parameters_of_the_machine_for_one_episode(kind, options):
    """Of every environment or of each its own; what has a distribution is drawn again later, the rest is default."""
    given = {"motor.R_s": 0.7, "load.inertia": [1e-5, 2e-5]}
    with made(kind, options) as environments:
        environments.reset(seed=2)
        drawn = environments.reset(seed=4)[1]["parameters"]
        defaults = kind(1, num_threads=1, **options | {"distributions": {"parameters": {}}})
        usual = defaults.drives.machine.parameters
        defaults.close()
        info = environments.reset(seed=4, options={"machine": given})[1]
        true = environments.drives.machine.parameters
        for name, value in given.items():
            np.testing.assert_array_equal(true[name], value * np.ones(2))
            np.testing.assert_array_equal(info["parameters"][name], true[name])
        others = [name for name in usual if name not in given]
        for name in others:
            np.testing.assert_array_equal(true[name], drawn[name])
        again = environments.reset(seed=4)[1]["parameters"]
        for name in usual:
            np.testing.assert_array_equal(again[name], drawn[name])
        info = environments.reset(seed=4, options={"machine": drawn})[1]["parameters"]  # all that a reset tells
        for name, values in drawn.items():
            np.testing.assert_array_equal(info[name], values)
        environments.reset(options={"machine": given})
        mask = np.array([True, False])
        environments.reset(seed=4, options={"reset_mask": mask})
        kept = environments.drives.machine.parameters
        assert kept["load.inertia"][1] == 2e-5 and kept["load.inertia"][0] == drawn["load.inertia"][0]


@pytest.mark.parametrize(("kind", "options", "says"), [
    (Tracking, {"machine": {"load.mass": 1.0}}, "machines have no parameter 'load.mass'; they have motor.R_s"),
    (Tracking, {"machine": {"motor.R_s": -1.0}}, "motor.R_s must be above 0, not -1"),
    (Tracking, {"machine": {"motor.R_s": [1.0, 1.0, 1.0]}}, "one value or one for each of 2 machines"),
    (Tracking, {"speed": 1.0}, "option of reset is one of 'reset_mask', 'state', 'machine', 'trajectory', not 'speed'"),
    (GainTuning, {"trajectory": None}, "is one of 'reset_mask', 'state', 'machine', not 'trajectory'"),
    (Tracking, {"trajectory": np.zeros((3, 5))}, r"in shape \(3, 1011\) or \(2, 3, 1011\), finite, not shape \(3, 5\)"),
    (Tracking, {"trajectory": np.full((3, 1011), np.nan)}, "finite, not numbers that are not finite"),
    (Tracking, {"trajectory": lambda rng, length, period: np.zeros((2, length))}, r"\(3, 1011\), finite, not shape"),
    (Tracking, {"state": {}, "machine": {"motor.R_s": 1.0}}, "all that a reset begins from; leave machine out"),
])  # fmt: skip
def test_what_a_reset_cannot_take_is_refused(kind, options, says):
    with made(kind, {}) as environments:
        environments.reset(seed=0)
        with pytest.raises(ValueError, match=says):
            environments.reset(options=options)


def ramp(rng, length, period):
    """Return a ramp at a speed that is drawn."""
    t = np.arange(length) * period
    speed = rng.uniform(1.0, 3.0)
    return np.stack([speed * t, np.full(length, speed), np.zeros(length)])


def test_a_trajectory_of_ones_own_is_a_function_or_rows():
    """Configured it is called in every episode; given to a reset it is for that episode alone."""
    with made(Tracking, {"trajectory": ramp}) as environments, made(Tracking, {}) as usual:
        reference = environments._episodes.reference
        environments.reset(seed=3)
        per_turn = environments._per_turn[0]
        speeds = reference[:, 0, 1000] / per_turn
        assert np.all((speeds > 1.0) & (speeds < 3.0)) and speeds[0] != speeds[1]
        copied = copy.deepcopy(environments)
        np.testing.assert_array_equal(copied.reset()[0], environments.reset()[0])
        copied.close()

        moves = usual.reset(seed=3)[0]
        rows = np.stack([ramp(np.random.default_rng(k), 1011, 0.001) for k in range(2)])
        for given in (ramp, rows[0], rows):
            seen = usual.reset(seed=3, options={"trajectory": given})[0]
            assert not np.array_equal(seen, moves)
        np.testing.assert_allclose(usual._episodes.reference[:, :2] / per_turn, rows[:, :2])
        np.testing.assert_array_equal(usual.reset(seed=3)[0], moves)


def test_a_reward_of_ones_own_sees_how_the_episode_ends():
    seen = []

    def reward(observation, action, info):
        seen.append((info["terminated"], info["truncated"]))
        return 1.0 - 5.0 * info["terminated"] + 2.0 * info["truncated"]

    options = {"duration": 0.02, "reward": reward, "autoreset_mode": "Disabled"}
    with made(Tracking, options) as environments:
        environments.reset(seed=0)
        environments.drives.machine.enable_input = np.array([False, True])
        rewards = [environments.step(np.zeros((2, 1), np.float32))[1] for _ in range(2)]
        assert [row.tolist() for row in rewards] == [[1.0, 1.0], [-4.0, 1.0]]
        assert [terminated.tolist() for terminated, _ in seen] == [[False, False], [True, False]]
    single = SingleEnvironment(Tracking(1, num_threads=1, **options | {"duration": 0.001}))
    single.reset(seed=0)
    _, value, terminated, truncated, info = single.step(np.zeros(1, np.float32))
    assert (value, terminated, truncated) == (3.0, False, True) and "truncated" not in info
    single.close()
