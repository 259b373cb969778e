"""The TMCM-6212: what it makes of a motor and its supply, and the axes of its node that have no motor."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, motion
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.motors import MOTORS

DEVICE, AXES = find_device("tmcm6212"), 6
ENABLED, FAULT = (0x6F, 0x27), (0x4F, 0x08)


def is_in(status, pattern):
    return status & pattern[0] == pattern[1]


# --- its motors -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", DEVICE.motors)
def test_the_run_current_is_the_highest_step_within_the_rated_current(name):
    """2003h makes 32 steps of 1.5 A: of a QSH4218-51 with 1.414 A the thirtieth, of one with 2.8 A rms all."""
    motor, preset = MOTORS[name], DEVICE.preset(MOTORS[name])
    step = preset["Maximum current"] // 8 + 1
    allowed = min(motor.rated_current, 1.5) / 1.5 * 32
    assert step <= allowed < step + 1 or step == 32
    assert preset["Full step resolution"] == 4 * motor.n_p
    if name == "qsh4218_51":
        assert step == 30


def test_a_motor_of_48_v_turns_at_the_35_v_that_the_module_is_built_for():
    assert MOTORS["qsh8618_96"].voltage == 48.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        with EmulatedDrives("tmcm6212", "inertia", "qsh8618_96", num_threads=1) as drives:
            assert drives.machine.supply.tolist() == [35.0]
            motion.enable(drives, mode="pp")
            drives.advance(0.05)
            assert is_in(drives.read(0x6041), ENABLED).all()
            drives.machine.supply = 48.0
            drives.advance(0.05)
            assert [each.name for each in drives.emergencies()] == ["overvoltage"]


def test_a_motor_with_too_little_current_is_told_what_torque_that_leaves():
    """The torque of n_p psi i / sqrt(1 + s i^2) at 1.5 A, of 3.96 A for 3.1 N m."""
    motor = MOTORS["qsh6018_86"]
    left = motor.n_p * motor.psi_m * 1.5 / math.sqrt(1.0 + motor.saturation * 1.5**2)
    assert DEVICE.torque_of(motor) == pytest.approx(left) == pytest.approx(3.1 * 1.5 / 3.96 / 0.95, rel=0.02)
    assert DEVICE.torque_of(MOTORS["qsh4218_51"]) == MOTORS["qsh4218_51"].rated_torque, "it has all of its 1.41 A"
    heavy = {"load.mass": 20.0}
    with pytest.warns(MisfitWarning, match=r"the motor is rated at 0\.06 N\*m"):
        EmulatedDrives("tmcm6212", "vertical_screw", "qsh2818_32", parameters=heavy).close()
    says = r"tmcm6212 has 1\.5 A of the 3\.96 A for the motor's 0\.4 N\*m, which leaves 0\.158 N\*m"
    with pytest.warns(MisfitWarning, match=says):
        EmulatedDrives("tmcm6212", "vertical_screw", "qsh4218_47", parameters=heavy).close()


# --- axes without a motor ---------------------------------------------------------------------------------------------
def machine(load, num_machines=1):
    return EmulatedDrives("tmcm6212", load, num_machines=num_machines, num_threads=1)


@pytest.mark.every(3)
@pytest.mark.parametrize(("load", "machines", "driven"), [("inertia", 1, 1), ("gantry", 1, 2), ("inertia", 4, 4)])
def test_axes_that_a_machine_leaves_over_have_no_motor(load, machines, driven):
    """They live, and a phase without current is found once it should have some."""
    with on_bus(machine(load, machines)) as drives:
        has_motor = np.arange(AXES) < driven
        motion.enable(drives, mode="pv")
        assert is_in(drives.read(0x6041), ENABLED).all()
        drives.write(0x60FF, 51200, where=has_motor)
        drives.advance(0.3)
        np.testing.assert_array_equal(is_in(drives.read(0x6041), ENABLED), has_motor)
        np.testing.assert_array_equal(is_in(drives.read(0x6041), FAULT), ~has_motor)
        assert (drives.read(0x606C)[has_motor] == 51200).all()
        told = {(one.axis, one.name) for one in drives.emergencies() if one.code == 0x1000}
        assert told == {(axis, "open_load_a") for axis in range(driven, AXES)}
        motion.disable(drives, has_motor)


def test_twelve_motors_need_two_nodes_and_seven_leave_five_axes():
    for motors, nodes in ((12, 2), (7, 2), (6, 1)):
        drives = EmulatedDrives("tmcm6212", num_machines=motors, num_threads=1)
        made = World().add(drives, range(1, nodes + 1))
        assert [node.first_axis for node in made] == [0, 6][:nodes]
        drives.close()
    with (
        EmulatedDrives("tmcm6212", num_machines=7, num_threads=1) as drives,
        pytest.raises(ValueError, match=r"7 axes \(7 x load 'two_mass'\) take 2 nodes of tmcm6212, which drives 6"),
    ):
        World().add(drives, [1])


def test_six_axes_that_fault_at_once_are_told_one_by_one():
    """Two messages each: more than the eight of a node with one axis."""
    emulated = machine("inertia", AXES)
    with on_bus(emulated) as drives:
        motion.enable(drives, mode="pv")
        emulated.machine.set_temperatures(25.0, 160.0)
        drives.advance(0.01)
        told = [(one.axis, one.name) for one in drives.emergencies()]
    assert sorted(told) == [(k, name) for k in range(AXES) for name in ("overtemperature", "overtemperature_warning")]
