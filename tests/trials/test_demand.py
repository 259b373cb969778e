"""The demand of a move in pp where a drive cannot send it: computed from what the drive was told, and told so."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE
from drive_env.trials.demand import computed, is_recorded
from drive_env.trials.positioning import TRIAL, plan_move, power_up, start, write_profile


@pytest.mark.parametrize("device", ["tmcm1636", "tgz_d"])
@pytest.mark.parametrize("turns", [2.0, -0.2, 0.0])
def test_it_is_the_drives_own_to_a_millisecond(device, turns):
    with EmulatedDrives(device, "inertia", num_machines=2, num_threads=1) as drives:
        motor, scale = drives.motor, drives.read(Role.POSITION_SCALE)
        move = plan_move(motor, np.full(2, 3.0 * motor.inertia), scale, 2.0 * np.pi * turns * np.array([1.0, 0.5]))
        power_up(drives)
        write_profile(drives, move)
        begin = drives.read(cia402.POSITION_DEMAND)
        start(drives, begin + move.distance)
        recorded = drives.record([cia402.POSITION_DEMAND], TRIAL * CYCLE)[cia402.POSITION_DEMAND]
    found = computed(begin, begin + move.distance, move, TRIAL)
    np.testing.assert_array_equal(found[-1], recorded[-1])
    assert np.all(np.abs(found - recorded) <= move.velocity * CYCLE + 1.0)


def test_a_profile_that_reaches_its_speed():
    class Told:
        velocity, acceleration = np.array([100.0]), np.array([1000.0])

    found = computed(np.array([5]), np.array([-15]), Told, 400)[:, 0]  # 20 back: 0.1 s ramp, 0.1 s at speed, 0.1 s ramp
    assert found[[0, 100, 200, 300, 399]].tolist() == pytest.approx([5.0, 0.0, -10.0, -15.0, -15.0])


def test_emulated_drives_record_theirs():
    with EmulatedDrives(num_threads=1) as drives:
        assert is_recorded(drives)
