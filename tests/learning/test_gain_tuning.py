"""GainTuning: an episode of commissioning, what it observes, and what it must not depend on."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from rigs.chip_gains import Gains
from rigs.world_bus import served

from drive_env import EmulatedDrives, Limits, cia402
from drive_env.devices import find_device
from drive_env.devices.gains import rule_gains, small_time_constants
from drive_env.envs.gain_tuning import GainTuning
from drive_env.trials import gain_trial
from drive_env.trials.gain_trial import Trials, measured_cost, softness
from drive_env.trials.positioning import plan_move, power_up, reach
from mechanics.shaft import way

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

P = Gains._fields.index("velocity_p")
FEW = {"trials": 3, "num_threads": 1}


def actions(env, steps, seed=0):
    """Return the actions of a random agent, the same for environment k of any number of environments."""
    shape = env.single_action_space.shape
    lanes = [np.random.default_rng((seed, lane)).uniform(-1.0, 1.0, (steps, *shape)) for lane in range(env.num_envs)]
    return np.stack(lanes, axis=1).astype(np.float32)


def episode(env, seed, lanes=None):
    """Return observations and rewards of an episode, (steps, environments, ...)."""
    observation, _ = env.reset(seed=seed)
    observations, rewards = [observation], []
    for action in actions(env, env.config.trials) if lanes is None else lanes:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


@pytest.fixture(scope="module")
def four():
    env = GainTuning(4, **FEW)
    yield env
    env.close()


# --- an episode -------------------------------------------------------------------------------------------------------
def test_an_episode_starts_at_the_rule_and_ends_when_its_trials_are_used_up(four):
    observation, info = four.reset(seed=1)
    assert observation.shape == four.observation_space.shape
    np.testing.assert_array_equal(observation[:, 4:10], 0.0)  # last and best gains over the rule's
    assert observation[:, -1].tolist() == [1.0] * 4
    np.testing.assert_array_equal(info["gains"][:, 0], four._rule)
    for left in (2, 1, 0):
        observation, _, terminated, truncated, _ = four.step(four.action_space.sample() * 0)
        assert observation[:, -1] == pytest.approx([left / 3] * 4)
        assert not terminated.any()
        assert truncated.all() == (left == 0)


def test_rewards_add_up_to_the_decrease_of_ln_hidden_j(four):
    _, info = four.reset(seed=2)
    begin, total = info["robust_cost"], np.zeros(4)
    for action in actions(four, 3, seed=5):
        _, reward, _, _, info = four.step(action)
        total += info["reward_terms"]["tuning"]
        np.testing.assert_allclose(reward, info["reward_terms"]["tuning"] - 0.05 * info["aborted"])
    np.testing.assert_allclose(total, np.log(begin / info["robust_cost"]), atol=1e-12)


def test_the_incumbent_never_gets_worse_by_measured_terms_and_changes_only_when_better(four):
    _, info = four.reset(seed=3)
    for action in actions(four, 3, seed=7):
        before, measured = info["gains"], info["measured"]
        _, _, _, _, info = four.step(action)
        better = info["measured"] < measured
        assert np.all(info["measured"] <= measured)
        changed = (info["gains"] != before).any(axis=(1, 2))
        np.testing.assert_array_equal(changed, better)
        np.testing.assert_array_equal(info["reward_terms"]["tuning"][~better], 0.0)


def test_a_judged_trial_earns_what_its_gains_are_worth_whatever_the_incumbent_is():
    env = GainTuning(2, load="two_mass", judged="trial", half=4.0, step=2.0, **FEW)
    _, info = env.reset(seed=6)
    rule, rules_cost = info["gains"], info["robust_cost"]
    for action in (np.zeros((2, 3)), np.full((2, 3), -1.0), np.zeros((2, 3))):
        _, reward, _, _, info = env.step(action)
        expected = np.clip(np.rint(rule[..., 2:] * np.exp(2.0 * action[:, None])), 1, 32767)
        np.testing.assert_array_equal(info["trial_gains"][..., 2:], expected)
        np.testing.assert_allclose(reward, 1.0 / (1.0 + (info["trial_robust_cost"] / 4.0) ** 2))
        np.testing.assert_array_equal(reward, info["reward_terms"]["worth"])
        if not action.any():
            np.testing.assert_array_equal(info["trial_robust_cost"], rules_cost)  # as at the begin, each time
        else:
            assert np.all(info["trial_robust_cost"] != rules_cost)
    env.close()


def test_an_action_is_a_change_of_the_logarithm_of_the_chosen_gains_from_the_incumbent():
    env = GainTuning(1, gains=("velocity_p", "torque_p"), **FEW)
    env.reset(seed=0)
    rule = env._rule[0].copy()
    env.step(np.array([[1.0, -1.0]], np.float32))
    expected = rule.copy()
    expected[P] = round(rule[P] * np.exp(0.7))
    expected[0] = round(rule[0] * np.exp(-0.7))
    assert env._last[0].tolist() == expected.tolist()
    env.close()


def test_an_action_of_1_is_the_step_and_gains_of_says_what_one_means_without_trying_it():
    for step in (0.2, 2.5):
        env = GainTuning(2, step=step, **FEW)
        _, before = env.reset(seed=0)
        assert env.single_action_space.high == pytest.approx([1.0] * 3)
        action = np.array([[9.0, 0.1, -9.0], [0.0, 0.0, 0.0]], np.float32)
        meant = env.gains_of(action)
        factors = np.exp([[0.0, 0.0, step, 0.1 * step, -step], [0.0] * 5])
        assert meant[:, 0] == pytest.approx(np.clip(np.rint(before["gains"][:, 0] * factors), 1, 32767), abs=1)
        _, _, _, _, info = env.step(action)
        np.testing.assert_array_equal(info["trial_gains"], meant)
        env.close()


def test_what_shakes_is_stopped_costs_and_leaves_the_incumbent(four):
    _, info = four.reset(seed=4)
    start = info["gains"]
    aborted = np.zeros(4, bool)
    for _ in range(3):
        before = four._best.copy()
        observation, reward, _, _, info = four.step(np.ones((4, 3), np.float32))
        lanes = info["aborted"] & (four._best == before).all(axis=1)
        aborted |= lanes
        assert np.all(reward[lanes] == -0.05)
        assert four.observation_space.contains(observation)
    assert aborted.any()
    assert start.shape == (4, 1, 5)


# --- the spaces -------------------------------------------------------------------------------------------------------
def test_the_waveform_is_the_error_of_the_move():
    env = GainTuning(1, distributions={"parameters": {}}, waveform=250, **FEW)
    env.reset(seed=0)
    traces = []
    record = env.drives.record
    env.drives.record = lambda objects, *rest: traces.append(record(objects, *rest)) or traces[-1]
    observation, *_ = env.step(np.zeros((1, 3), np.float32))
    demand, actual = (np.concatenate([trace[name] for trace in traces[:10]])[:, 0] for name in (0x6062, 0x6064))
    np.testing.assert_allclose(observation[0, 42:-1], (demand - actual) / env._move.distance[0], atol=1e-6)
    assert demand[-1] == env._move.distance[0]  # the move took place
    assert 0.02 < np.abs(observation[0, 42:-1]).max() < 1.0
    few = GainTuning(1, distributions={"parameters": {}}, waveform=10, **FEW)
    few.reset(seed=0)
    resampled, *_ = few.step(np.zeros((1, 3), np.float32))
    at = np.linspace(0, 249, 10).round().astype(int)
    np.testing.assert_array_equal(resampled[0, 42:-1], observation[0, 42:-1][at])
    env.close()
    few.close()


def test_privileged_observation_is_the_true_machine():
    env = GainTuning(2, privileged=True, **FEW)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    names = list(info["parameters"])
    k = names.index("load.inertia")
    default = env._defaults["load.inertia"]
    np.testing.assert_allclose(
        observation["privileged"][:, k], info["parameters"]["load.inertia"] / default - 1.0, rtol=1e-5
    )
    env.close()


def test_what_is_hidden_cannot_be_observed(four):
    # The robust cost and load steps change nothing of what is observed.
    observed, _ = episode(four, 40)
    score = four._score.score
    four._score.score = lambda gains: score(gains)._replace(robust_cost=np.full(4, 3.0))
    again, _ = episode(four, 40)
    four._score.score = score
    np.testing.assert_array_equal(observed, again)


# --- identification and the trial ------------------------------------------------------------------------------------
def inertia_of_all_axes_moving(load):
    """Return what each axis accelerates while all axes of its machine turn alike [kg*m^2], (copies, axes)."""
    turning, model, data = way(load).joints, load.model, mujoco.MjData(load.model)
    data.qpos[:] = np.tile(load.start, load.copies)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    blocks = full.reshape(load.copies, load.num_dofs, load.copies, load.num_dofs)
    mass = blocks[np.arange(load.copies), :, np.arange(load.copies), :]
    return np.einsum("ad,cde,e->ca", turning, mass, turning.sum(axis=0))


@pytest.mark.parametrize(("load", "low", "high"), [
    ("inertia", 0.8, 1.15), ("two_mass", 0.75, 1.2), ("vertical_screw", 0.75, 1.2),
    # Axes that share a mass, with frictions of their own, and a robot whose inertia changes with its pose: both move
    # all axes at once, and what an axis accelerates then is not what it would accelerate alone.
    ("gantry", 0.7, 1.5), ("robot", 0.8, 1.2),
])  # fmt: skip
def test_identified_inertia_is_that_of_the_machine(load, low, high):
    with EmulatedDrives(load=load, num_machines=16, seed=3, randomise=["load"], num_threads=1) as drives:
        power_up(drives)
        axes = drives.num_axes // 16
        t_0 = 4.0 * float(small_time_constants(drives.device, 400.0))
        every = np.ones(drives.num_axes, bool)
        found, _ = Trials(drives, drives.motor, axes, t_0).identify(np.tile(reach(load), 16), every)
        true = np.concatenate([inertia_of_all_axes_moving(group.load).reshape(-1) for group in drives.inside.groups])
    ratio = found.inertia / true
    assert np.median(ratio.reshape(16, -1), axis=0) == pytest.approx(1.0, abs=0.12)  # of every axis
    assert low < ratio.min()
    assert ratio.max() < high


def test_a_trial_that_shakes_is_stopped_within_50_ms_and_the_drive_goes_on_with_the_incumbent():
    with EmulatedDrives(load="two_mass", num_machines=2, num_threads=1) as drives:
        power_up(drives)
        rule = rule_gains(drives.device, drives.motor, np.full(2, 3 * drives.motor.inertia))
        move = plan_move(drives.motor, np.full(2, 3 * drives.motor.inertia), 65536, [np.inf, np.inf])
        wild = rule.copy()
        wild[1, P] *= 20
        looks = []
        trials = Trials(drives, drives.motor, 1, 0.004)
        trials.look = lambda: looks.append(int(drives.read((0x2042, 1))[1]))
        tried = trials.run(wild, rule, move, np.zeros(2, np.int64), np.ones(2, np.int64), np.ones(2, bool))
        assert tried.aborted[:, 0].tolist()[:2] == [False, False]
        assert tried.aborted[:, 1].all()
        followed = np.abs(tried.error).sum(axis=0) * 0.001  # the integral of the first phase's error, a sample per ms
        assert tried.following[0] == pytest.approx(followed) and (followed > 0.002).all()
        assert looks[0] == wild[1, P]
        assert set(looks[50:]) == {rule[1, P]}  # a look is a millisecond
        assert [int(drives.read(name)[1]) for name in GAIN_OBJECTS] == rule[1].tolist()
        assert np.all(drives.read(0x6041) & 0x6F == 0x27)
        assert abs(int(drives.read(0x6064)[1]) - move.distance[1]) < 0.05 * move.distance[1]


def test_a_drive_that_trips_is_cleared_and_goes_on():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        power_up(drives)
        motor = drives.motor
        rule = rule_gains(drives.device, motor, [3 * motor.inertia])
        move = plan_move(motor, [3 * motor.inertia], 65536, [np.inf])
        window = int(drives.read(0x6065)[0])
        drives.write(0x6065, 200)  # the lag of the profile is more
        calls = []

        def look():
            calls.append(int(drives.read(0x6041)[0]) & 0x4F)
            if len(calls) == 75:
                drives.write(0x6065, window)

        one = np.ones(1, np.int64)
        trials = Trials(drives, motor, 1, 0.004)
        trials.look = look
        tried = trials.run(rule, rule, move, 0 * one, one, np.ones(1, bool))
        assert 0x08 in calls  # fault
        assert tried.aborted.all()
        assert calls[-1] == 0x07  # operation enabled: bits 0 to 2
        assert next(m.name for m in drives.emergencies()) == "following_error"


def test_on_a_bus_in_real_time_what_is_recorded_is_mapped_before_the_move_starts():
    """Mapping takes some 10 ms, which the samples of the move would miss."""

    class RealTime:
        time_waits = False

        def __init__(self, drives):
            self.drives, self.calls = drives, []

        def __getattr__(self, name):
            return getattr(self.drives, name)

        def write(self, name, value, where=None):
            if name == 0x6040 and value == 0x1F:
                self.calls.append("start")
            self.drives.write(name, value, where=where)

        def record(self, objects, duration, *rest, **options):
            self.calls.append((tuple(objects), duration))
            return self.drives.record(objects, duration, *rest, **options)

    with EmulatedDrives(load="inertia", num_threads=1) as own:
        power_up(own)
        drives = RealTime(own)
        trials = Trials(drives, own.motor, 1, 0.01)
        everywhere = np.ones(1, bool)
        trials.identify(reach("inertia"), everywhere)
        gains = np.stack([own.read(name) for name in GAIN_OBJECTS], axis=-1)
        move = plan_move(own.motor, np.array([3.0 * own.motor.inertia]), own.read((0x2058, 0)), reach("inertia"))
        trials.run(gains, gains, move, own.read(0x6064), np.ones(1, np.int64), everywhere)
    starts = [k for k, call in enumerate(drives.calls) if call == "start"]
    assert len(starts) == 5
    for first in starts:
        objects, _ = next(call for call in drives.calls[first:] if call != "start")
        assert any(call[0] == objects for call in drives.calls[:first] if call != "start")
    assert (objects, 0.0) in drives.calls


def test_softness_is_inverse_to_every_gain_of_the_cascade():
    gains = np.array([[1, 1, 100, 200, 300], [9, 9, 200, 200, 300], [1, 1, 100, 400, 600]])
    assert softness(find_device("tmcm1636").gains, gains) * 6e6 == pytest.approx([1.0, 0.5, 0.25])


def test_measured_cost_is_half_the_mean_of_the_moves_and_half_the_worst_phase():
    assert measured_cost(np.array([[1.0], [3.0], [30.0]])) == pytest.approx([16.0])


# --- given drives -----------------------------------------------------------------------------------------------------
def test_given_drives_are_taken_as_they_are_and_rewarded_by_measured_terms():
    with EmulatedDrives(num_machines=2, num_threads=1) as drives:
        drives.advance(0.005)
        env = GainTuning(2, drives=drives, **FEW)
        _, info = env.reset(seed=0)
        assert "robust_cost" not in info and "parameters" not in info
        # They were off: the first move found them enabled, and knows what they turn.
        np.testing.assert_allclose(env._identified.inertia, 3.08 * drives.motor.inertia, rtol=0.1)
        begin, total = info["measured"], np.zeros(2)
        positions = []
        for action in actions(env, 3):
            _, _, _, _, info = env.step(action)
            total += info["reward_terms"]["tuning"]
            positions.append(drives.read(0x6064))
        np.testing.assert_allclose(total, np.log(begin / info["measured"]), atol=1e-12)
        # The rule's trial ended at the move's end; from there back, and there again: no way is gone for nothing.
        near = np.abs(np.array(positions) / env._move.distance - [[0.0], [1.0], [0.0]])
        assert near.max() < 0.1
        env.close()
        drives.advance(0.001)  # still open


@pytest.mark.parametrize(("action", "cost"), [(-0.1, 0.05), (0.0, 0.0)])
def test_a_given_drive_that_cannot_be_cleared_terminates_its_lane_alone(action, cost):
    """The enable input of machine 1 opens in the first cycle of its trial, and stays open.

    A trial of the incumbent's own gains costs nothing: whoever changes nothing is not to blame.
    """
    with EmulatedDrives(num_machines=2, num_threads=1) as drives:
        env = GainTuning(2, drives=drives, autoreset_mode="Disabled", **FEW)
        env.reset(seed=0)
        _, _, terminated, truncated, info = env.step(np.zeros((2, 3), np.float32))
        assert not terminated.any() and not truncated.any() and info["faults"].tolist() == [(), ()]
        drives.machine.enable_input = [True, False]
        _, reward, terminated, truncated, info = env.step(np.full((2, 3), action, np.float32))
        assert terminated.tolist() == [False, True] and not truncated.any()
        assert info["aborted"].tolist() == [False, True]
        assert info["faults"][0] == () and "shutdown_switch" in info["faults"][1]
        assert reward[1] == -cost
        drives.machine.enable_input = True
        observation, _ = env.reset(options={"reset_mask": np.array([False, True])})
        assert observation[1, -1] == 1.0
        assert not env.step(np.zeros((2, 3), np.float32))[2].any()
        env.close()


def test_a_trip_in_a_trial_costs_is_cleared_and_does_not_end_the_episode():
    """Of emulated machines every trial begins anew: drive 1 trips by its lag, environment 0 sees nothing of it."""
    env = GainTuning(2, **FEW)
    acted = actions(env, 2)
    undisturbed, _ = episode(env, 30, acted)
    env.reset(seed=30)
    begin = env._trials.run

    def narrow(*arguments):
        env.drives.write(0x6065, 200, where=np.array([False, True]))  # the lag of the profile is more
        return begin(*arguments)

    env._trials.run = narrow
    observation, reward, terminated, truncated, info = env.step(acted[0])
    assert not terminated.any() and not truncated.any()
    assert info["aborted"].tolist()[1] and "following_error" in info["faults"][1]
    assert info["reward_terms"]["abort"][1] == -0.05 and reward[1] == -0.05
    np.testing.assert_array_equal(observation[0], undisturbed[1, 0])
    env._trials.run = begin
    observation, _, terminated, *_ = env.step(acted[1])
    np.testing.assert_array_equal(observation[0], undisturbed[2, 0])
    assert not terminated.any()
    env.close()


def test_given_drives_of_two_kinds_say_the_same_as_long_as_they_are_the_same():
    observations = []
    for _ in range(2):
        with EmulatedDrives(num_machines=2, num_threads=1, seed=5) as drives:
            env = GainTuning(2, drives=drives, **FEW)
            observations.append(episode(env, 0)[0])
    np.testing.assert_array_equal(*observations)


# The envelope would stop the whole bus where the trial's own watch stops an environment.
@pytest.mark.slow
@pytest.mark.parametrize("safety", [False, Limits(oscillation=False)], ids=["no envelope", "envelope"])
def test_over_can_in_lockstep_the_observations_are_the_same(safety):
    inside, outside = (
        EmulatedDrives(load="two_mass", num_machines=2, num_threads=1, seed=5),
        served("calls", nodes=(1, 2), safety=safety, load="two_mass", num_machines=2, seed=5),
    )
    found = []
    with inside as drives, outside as bus:
        for each in (drives, bus):
            env = GainTuning(2, drives=each, **FEW)
            found.append(episode(env, 0))
            env.close()
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


# --- a wrong configuration --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("options", "says"), [
    ({"gains": ("velocity_d",)}, "torque_p.*velocity_p.*position_p"),
    ({"gains": ()}, "different ones of torque_p"),
    ({"trials": 0}, "1 or more"),
    ({"step": 0.0}, "step must be finite and more than 0, not 0"),
    ({"half": 0.0}, "half must be finite and more than 0, not 0"),
    ({"judged": "best"}, "judged is one of 'incumbent', 'trial', not 'best'"),
    ({"waveform": 251}, "0...250"),
    ({"reward": 1}, "reward is a function of observations, actions and info, not 1"),
    ({"travel": 0.0}, "not 0"),
])  # fmt: skip
def test_a_wrong_value_names_the_valid_ones(options, says):
    with pytest.raises(ValueError, match=says):
        GainTuning(1, **options)


def test_given_drives_have_no_machine_to_draw():
    with EmulatedDrives() as drives, pytest.raises(ValueError, match="leave distributions and privileged out"):
        GainTuning(1, drives=drives, privileged=True)


def test_the_watch_is_half_of_what_it_promises():
    assert 2 * gain_trial.WATCH <= 50
    assert cia402.OPERATION_ENABLED == (0x6F, 0x27)
