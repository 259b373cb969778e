"""Trials of StallGuard threshold and CoolStep: what they tell apart is true of the machine, whose obstacle is real."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.drives.speeds import per_increment
from drive_env.envs.gain_tuning import GainTuning
from drive_env.phase_current import run_and_standby
from drive_env.trials.load_reading import angle_of, falls
from drive_env.trials.method import check_tried
from tuning.linked_axes import are_independent
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import TrialBench
from tuning.stepper.obstacle import prove_with_load
from tuning.target import emulated

NAMES = ("stall_threshold", "coolstep_lower", "coolstep_width")
KNOWN = find_device("tmcm6212").gains
THRESHOLD, LOWER = (KNOWN.names.index(name) for name in NAMES[:2])


def target(**options):
    return emulated("tmcm6212", "inertia", num_threads=1, **options)


def with_settings(gains, **changed):
    changed_gains = gains.copy()
    for name, value in changed.items():
        changed_gains[:, KNOWN.names.index(name)] = value
    return changed_gains


def test_the_angle_of_a_reading_is_that_of_its_closed_form():
    angles = np.radians([0.0, 20.0, 45.0, 60.0, 90.0])
    np.testing.assert_allclose(angle_of(falls(angles)), angles, atol=1e-12)
    assert np.isnan(angle_of(np.array([1.5]))).all()


@pytest.mark.slow
def test_a_trial_tells_false_and_late_stalls_and_what_coolstep_saves():
    with target() as found:
        bench = TrialBench(found, gains=NAMES)
        bench.identify()
        off = with_settings(bench.rule, coolstep_lower=0)
        plain, saving = bench.run(off), bench.run(bench.rule)
        assert not plain.aborted[0] and not saving.aborted[0]
        assert saving.cost[0] < plain.cost[0] - 0.2
        assert saving.objectives[0, 2] < 0.7 * plain.objectives[0, 2], "the current that is left"
        false, late = (bench.run(with_settings(off, stall_threshold=value)) for value in (-40, 40))
        assert false.aborted[0] and late.aborted[0]
        bench.leave(bench.rule)
        # What a program sees: nothing acts by the load while trials are made, and the drives have theirs again.
        assert found.drives.read(Role.STALL_SPEED) == 0 and found.drives.read(Role.COOLSTEP_SPEED) == 0


@pytest.mark.slow
def test_what_a_search_finds_stops_at_an_obstacle_and_not_by_its_own_load():
    with target() as found:
        result = optimise(found, Settings(trials=12, gains=NAMES))
        assert np.exp(result.cost[0]) < 0.8
        bench = TrialBench(found, gains=NAMES)
        bench.identify()
        drives, trials = found.drives, bench.trials
        write_gains(drives, result.gains)
        moves = trials._moves(bench.began)
        speed = trials._speed
        stop = np.ceil(0.75 * speed * moves.increments * per_increment(drives, found.device.roles[Role.STALL_SPEED]))
        drives.write(Role.STALL_SPEED, stop.astype(np.int64))
        own = moves.run(speed, np.ones(1, bool))
        assert not own.failed[0], "no false stall"
        trials.acts_by_load = True
        run, _ = run_and_standby(found.device, result.gains)
        proof = prove_with_load(found, moves, speed, run, np.ones(1, bool))
        assert proof.stopped[0] and proof.lost[0] < 3


def test_a_search_with_chosen_names_leaves_the_drives_other_gains_and_speeds():
    with emulated("tmcm3313", "inertia", num_threads=1) as found:
        drives = found.drives
        before = read_gains(drives)
        speed = drives.read(Role.COOLSTEP_SPEED)
        result = optimise(found, Settings(trials=2, gains=NAMES))
        names = found.device.gains.names
        loop = [k for k, name in enumerate(names) if name.startswith("correction")]
        np.testing.assert_array_equal(read_gains(drives), result.gains)
        np.testing.assert_array_equal(result.gains[:, loop], before[:, loop])
        np.testing.assert_array_equal(drives.read(Role.COOLSTEP_SPEED), speed)


def test_settings_that_may_be_negative_change_by_steps_and_gains_by_factors():
    columns = [0, THRESHOLD, LOWER]
    gains = np.array([[100, 0, 2, 0, 0, 0, 0, 0]])
    gains = with_settings(gains, run_current=100, stall_threshold=0, coolstep_lower=2)
    changed = KNOWN.changed(gains, [[np.log(2.0), -1.0, -0.8]], columns, KNOWN.highest)
    assert changed[0, columns].tolist() == [200, -12, 0]
    np.testing.assert_allclose(KNOWN.change(changed, gains, columns), [[np.log(2.0), -1.0, -0.8]])
    least = KNOWN.changed(gains, [[-9.0, -9.0, -9.0]], columns, KNOWN.highest)
    assert least[0, columns].tolist() == [1, -63, 0]


@pytest.mark.parametrize("names", [("run_current", "stall_threshold"), ("coolstep_up", "standby_current")])
def test_currents_and_load_detection_are_searched_by_themselves(names):
    with pytest.raises(ValueError, match=r"search the others by themselves"):
        check_tried(find_device("tmcm6212"), names)


def test_gain_tuning_rewards_what_its_trials_tell():
    env = GainTuning(device="tmcm6212", load="inertia", gains=NAMES, trials=2, num_threads=1)
    try:
        observation, info = env.reset(seed=1)
        assert env.observation_space.contains(observation) and "robust_cost" not in info
        first = float(info["measured"][0])
        observation, reward, _, _, info = env.step(np.array([[0.2, 0.0, 0.0]]))
        assert env.observation_space.contains(observation)
        tried = float(info["trial_measured"][0])
        assert tried < first and reward[0] == pytest.approx(np.log(first / tried))
        assert info["trial_gains"][0, 0, THRESHOLD] == 2
    finally:
        env.close()


@pytest.mark.parametrize(("load", "independent"), [("portal", True), ("gantry", False), ("robot", False)])
def test_axes_that_move_each_other_are_not_independent(load, independent):
    with emulated("tmcm6212", load, num_threads=1) as found:
        assert are_independent(found.drives.inside.groups[0].load) is independent


def test_a_push_at_one_axis_of_a_machine_is_felt_by_that_axis_alone():
    from drive_env import motion

    with emulated("tmcm3313", "portal", num_threads=1) as found:
        drives, machine = found.drives, found.drives.machine
        motion.enable(drives, mode="pp")
        drives.advance(0.3)
        before = machine.rotor_angle.copy()
        torque = np.array([0.0, 0.05, 0.0])
        with machine.pushed() as push:
            push(torque)
            drives.advance(0.5)
            turned = machine.rotor_angle - before
        assert turned[1] > 5.0 * np.abs(turned[[0, 2]]).max()
        drives.advance(0.5)
        assert np.abs(machine.rotor_angle - before).max() < 0.3 * turned[1]
