"""Faults as randomisation: off by default, by the lane's own chance, in every environment."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.tracking import Tracking
from drive_env.faults.table import FAULTS
from drive_env.randomisation.random_machines import Distributions, RandomMachines

ALL = {"probability": 1.0, "names": ["enable_lost"], "at": [0.05, 0.05]}
NUMBER = {name: 1.0 + k for k, name in enumerate(FAULTS)}


def generators(count, seed=0):
    return [np.random.default_rng((seed, lane)) for lane in range(count)]


def drawn(faults, count=8, seed=0, load="two_mass"):
    """Redraw machines once and return what they tell, and their faults."""
    with EmulatedDrives(load=load, num_machines=count, num_threads=1) as drives:
        machines = RandomMachines(drives, Distributions.load({"include": "two_mass", "faults": faults}))
        machines.redraw(generators(count, seed))
        return {name: values.copy() for name, values in machines.values.items()}, drives.machine.faults()


def test_without_faults_nothing_is_told_and_with_them_the_machines_are_the_same():
    none, nothing = drawn(False)
    some, _ = drawn(ALL)
    assert nothing == []
    assert not [name for name in none if name.startswith("fault.")]
    for name, values in none.items():
        np.testing.assert_array_equal(some[name], values, name)
    assert np.all(some["fault.number"] == NUMBER["enable_lost"])
    assert np.all(some["fault.at"] == 0.05)


def test_probability_names_times_and_ranges_are_drawn():
    faults = {
        "probability": 0.5, "names": ["jam", "encoder_jump", "open_phase"], "at": [0.1, 0.3], "duration": [0.02, 0.04],
        "ranges": {"jam.torque": [2.0, 4.0], "open_phase.phase": [0, 2]},
    }  # fmt: skip
    told, given = drawn(faults, 400)
    assert np.mean(told["fault.number"] > 0) == pytest.approx(0.5, abs=0.08)
    orders = [fault.order for fault in given]
    assert len(orders) == np.count_nonzero(told["fault.number"])
    for name in faults["names"]:
        assert len([order for order in orders if order.name == name]) == pytest.approx(67, abs=25)
    begins = np.array([order.at for order in orders])
    assert 0.1 <= begins.min() < 0.12
    assert 0.28 < begins.max() <= 0.3
    assert {order.duration for order in orders if order.name == "encoder_jump"} == {None}
    lengths = [order.duration for order in orders if order.name != "encoder_jump"]
    assert 0.02 <= min(lengths) < 0.025
    assert 0.035 < max(lengths) <= 0.04
    torques = [order.parameters["torque"] for order in orders if order.name == "jam"]
    assert 2.0 <= min(torques) < 2.2
    assert 3.8 < max(torques) <= 4.0
    assert {order.parameters["phase"] for order in orders if order.name == "open_phase"} == {0.0, 1.0, 2.0}
    assert {order.parameters["angle"] for order in orders if order.name == "encoder_jump"} == {0.1}


def test_a_lane_s_fault_is_its_own_among_any_number_and_the_curriculum_opens_it():
    faults = {"probability": 0.5, "names": ["sensor", "supply"], "at": [0.0, 1.0]}
    many, few = drawn(faults, 16)[0], drawn(faults, 4)[0]
    for name in ("fault.number", "fault.at"):
        np.testing.assert_array_equal(many[name][:4], few[name])
    laws = Distributions.load(
        {"include": "two_mass", "faults": faults, "curriculum": {"opens": {"faults": [0.5, 1.0]}}}
    )
    with EmulatedDrives(load="two_mass", num_machines=100, num_threads=1) as drives:
        machines = RandomMachines(drives, laws)
        counts = []
        for stage in (0.4, 0.75, 1.0):
            machines.redraw(generators(100), stage=stage)
            counts.append(np.count_nonzero(machines.values["fault.number"]))
    assert counts[0] == 0
    assert 10 <= counts[1] <= 40
    assert 35 <= counts[2] <= 65


def test_a_new_episode_is_sound_again():
    with EmulatedDrives(load="two_mass", num_machines=2, num_threads=1) as drives:
        laws = {"faults": {"probability": 1.0, "names": ["supply_dip"], "at": [0, 0]}}
        machines = RandomMachines(drives, Distributions.load(laws))
        machines.redraw(generators(2))
        drives.advance(0.01)
        assert drives.machine.supply.tolist() == [5.0, 5.0]
        machines.redraw(generators(2), np.array([True, False]))
        assert drives.machine.supply.tolist() == [24.0, 5.0]
        assert [fault.active.tolist() for fault in drives.machine.faults()] == [[False, True], [False, False]]


def test_the_last_episode_s_fault_does_not_meet_the_next_machine_and_an_impossible_one_stays_away():
    """A tenth of the payload can be stepped with the machine as built, not with one of a tenth of its inertia."""
    laws = {
        "parameters": {"load.inertia": {"law": "loguniform", "low": 0.1, "high": 0.1, "of": "default"}},
        "faults": {
            "probability": 1.0, "names": ["payload_jump"], "at": [0, 0], "ranges": {"payload_jump.factor": [0.1, 0.1]},
        },
        "curriculum": {"opens": {"faults": [0.0, 0.01], "load.inertia": [0.5, 1.0]}},
    }  # fmt: skip
    with EmulatedDrives(load="two_mass", num_machines=2, num_threads=1) as drives:
        inertia = drives.machine.parameters["load.inertia"]
        machines = RandomMachines(drives, Distributions.load(laws))
        machines.redraw(generators(2), stage=0.5)
        drives.advance(0.01)
        np.testing.assert_allclose(drives.inside.groups[0].load.get("inertia"), 0.1 * inertia)
        machines.redraw(generators(2), stage=1.0)  # no warning of a fault that is called off
        drives.advance(0.01)
        np.testing.assert_allclose(drives.inside.groups[0].load.get("inertia"), 0.1 * inertia)
        assert machines.values["fault.number"].tolist() == [0.0, 0.0]


def test_the_set_is_written_and_read_back(tmp_path):
    faults = {**ALL, "duration": [0.1, 0.2], "names": ["jam", "enable_lost"], "ranges": {"jam.torque": [1.0, 2.0]}}
    laws = Distributions.load({"include": "two_mass", "faults": faults})
    path = tmp_path / "laws.toml"
    path.write_text(laws.to_toml(), encoding="utf-8")
    assert Distributions.load(path).faults == laws.faults


# --- the environments -------------------------------------------------------------------------------------------------
def test_tracking_meets_faults_and_tells_them():
    lanes = Tracking(4, num_threads=1, distributions={"include": "two_mass", "faults": ALL}, autoreset_mode="SameStep")
    _, info = lanes.reset(seed=0)
    assert np.all(info["parameters"]["fault.number"] == NUMBER["enable_lost"])
    zero = np.zeros((4, 1), np.float32)
    for episode in range(2):  # the next episode has one, too
        steps = 0
        while steps < 60:
            steps += 1
            terminated, info = lanes.step(zero)[2::2]
            if terminated.any():
                break
        assert terminated.all()
        assert info["final_info"]["fault"].tolist() == ["shutdown_switch"] * 4
        assert 40 <= steps <= 55, episode  # the drive has been enabled meanwhile
    lanes.close()


def test_tracking_is_bit_identical_before_a_fault_and_without_one():
    def run(distributions):
        lanes = Tracking(4, num_threads=1, distributions=distributions)
        lanes.reset(seed=3)
        actions = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 4, 1)).astype(np.float32)
        seen = [lanes.step(action)[0] for action in actions]
        lanes.close()
        return np.array(seen)

    sound = run("two_mass")
    late = run({"include": "two_mass", "faults": {**ALL, "at": [0.5, 0.5]}})
    np.testing.assert_array_equal(sound, late)
    early = run({"include": "two_mass", "faults": {"probability": 1.0, "names": ["encoder_lost_counts"], "at": [0, 0]}})
    assert not np.array_equal(sound, early)


def test_gain_scheduling_meets_faults():
    lanes = GainScheduling(2, num_threads=1, distributions={"include": "belt", "faults": ALL})
    lanes.reset(seed=0)
    zero = np.zeros((2, *lanes.single_action_space.shape), np.float32)
    ended = [lanes.step(zero)[2].tolist() for _ in range(7)]
    assert ended.index([True, True]) in (4, 5)  # steps of 10 ms, some of them enabling
    lanes.close()


def test_every_trial_of_gain_tuning_meets_the_episode_s_fault():
    lanes = GainTuning(2, num_threads=1, distributions={"include": "two_mass", "faults": ALL})
    lanes.reset(seed=0)
    zero = np.zeros((2, *lanes.single_action_space.shape), np.float32)
    for _ in range(2):
        info = lanes.step(zero)[4]
        assert info["aborted"].astype(bool).all() or all("shutdown" in str(one) for one in info["faults"])
    lanes.close()


# --- mistakes ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("faults", "message"), [
    ({"probability": 2, "names": ["jam"]}, r"faults: probability must lie in 0\.\.\.1, not 2"),
    ({"probability": 1}, "names must be a list of faults or groups"),
    ({"probability": 1, "names": ["jim"]}, "no fault or group is named 'jim'; there are sensor, motor"),
    ({"names": ["jam"], "at": [2, 1]}, r"at must be \[shortest, longest\] of 0 s or more, not \[2, 1\]"),
    ({"names": ["jam"], "at": 3}, r"at must be \[low, high\], not 3"),
    ({"names": ["jam"], "ranges": {"jam.force": [1, 2]}}, "there is no 'jam.force'; there are jam.torque"),
    ({"names": ["jam"], "ranges": {"jam.torque": [1, 2e6]}}, r"jam.torque must be \[low, high\] within 0...1000"),
    ({"names": ["jam"], "when": "enabled"}, "key 'when' is unknown"),
    ({"names": ["bus"]}, "fault bus_loss is of a bus and its nodes"),
    ({"names": ["broken_coupling"]}, "load 'inertia' has no coupling"),
])  # fmt: skip
def test_a_mistake_is_told_at_once(faults, message):
    with EmulatedDrives(load="inertia", num_threads=1) as drives, pytest.raises(ValueError, match=message):
        RandomMachines(drives, Distributions.load({"faults": faults}))
