"""The contract: every device turns every load with every motor through a whole life; a new row joins by being a row.

For all combinations: the protocol (states, mode display, fault and reset, homing's outcome), no emergency but the one
that is caused, no divergence, every object readable as an integer in its range, currents as commanded, motion the right
way, and machine 0 the same in any set; a warning exactly of the motors that a load asks too much of, which need not
move it. How closely a motion follows, and that the rotor is where the drive believes it, is asserted where the motor
suits the load, by the figures at the shaft: the total inertia within a factor of four of the three rotors that the
presets were made for, and what gravity and dry friction take below half the torque that the drive lets the motor give.

What a drive lacks is left out, by its data: modes that 6060h does not take, a current that no object tells.

Each run has every third of these rows: all loads with the default motor (of a variant three), and every motor with one
load; the others are slow.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from rigs.life import Demand, Life, build

from drive_env import EmulatedDrives
from drive_env.devices import device_names, find_device
from drive_env.emulator.inertia_check import MAX_INERTIA_RATIO, MisfitWarning
from drive_env.emulator.machine_kinds import MACHINE_KINDS
from mechanics.loads import LOADS, find_load
from mechanics.packed import PackedLoad
from mechanics.shaft import shaft_load

ROWS = [(device, load, motor) for device in device_names() for load in LOADS for motor in find_device(device).motors]
THREE_LOADS = ("two_mass", "belt", "vertical_screw")  # elastic; switches; gravity and backlash


def is_quick(device, load, motor):
    own = find_device(device)
    if motor == own.default_motor:
        return not own.variant_of or load in THREE_LOADS  # what differs of a variant is data
    return not own.variant_of and load == THREE_LOADS[list(own.motors).index(motor) % len(THREE_LOADS)]


@pytest.mark.every(48)
@pytest.mark.parametrize(
    ("device", "load", "motor"),
    [pytest.param(*row, id="-".join(row), marks=[] if is_quick(*row) else [pytest.mark.slow]) for row in ROWS],
)
def test_every_device_turns_every_load_with_every_motor(device, load, motor):
    two = Life(device, load, motor, 2).whole()
    alone = Life(device, load, motor, 1).whole()
    axes = LOADS[load].num_axes
    np.testing.assert_array_equal(alone, two[:, :, :axes])
    if MACHINE_KINDS[find_device(device).firmware_name].noise:
        assert np.any(two[:, :, axes:] != two[:, :, :axes])  # another machine: its noise is its own


def test_every_row_is_in_the_contract_and_most_motors_suit_a_load():
    assert len(ROWS) == sum(len(find_device(device).motors) for device in device_names()) * len(LOADS)
    for device in device_names():
        assert find_device(device).name == device
    for load in LOADS:
        motors = find_device("tmcm1636").motors
        suited = [Demand("tmcm1636", load, motor).suits for motor in motors]
        assert sum(suited) >= len(motors) // 2, load
        assert suited[list(motors).index(find_device("tmcm1636").default_motor)], load


@pytest.mark.parametrize(
    ("load", "inertia", "gravity", "friction"),
    [  # of the rows and MJCFs, by hand: [kg m^2], [N m], [N m]
        ("inertia", 1e-5, 0.0, 3e-3),
        ("two_mass", 1e-5 + 1e-9, 0.0, 3e-3),
        ("belt", 0.45 * (0.04 / (2 * math.pi)) ** 2, 0.0, 1.2 * 0.04 / (2 * math.pi)),
        ("ball_screw", 6.4e-6 + 8.0 * (0.005 / (2 * math.pi)) ** 2, 0.0, 10.0 * 0.005 / (2 * math.pi)),
        (
            "vertical_screw",
            6.4e-6 + 4.0 * (0.005 / (2 * math.pi)) ** 2,
            4.0 * 9.81 * 0.005 / (2 * math.pi),
            10.0 * 0.005 / (2 * math.pi),
        ),
        ("geared_joint", 1e-9 + (1.7e-2 + 0.8 * 0.1**2) / 50**2, 0.0, 0.16 / 50),
        ("arm", (2e-4 + 0.5 * 0.15**2) / 30**2, 0.5 * 9.81 * 0.15 / 30, 0.05 / 30),
        ("winder", (2e-5 + math.pi / 2 * 24.0 * (0.025**4 - 0.02**4)) / 2.5**2, 0.0, 8e-3 / 2.5),
    ],
)
def test_what_a_load_asks_at_the_shaft_is_that_of_the_hand_calculation(load, inertia, gravity, friction):
    found = shaft_load(PackedLoad(find_load(load), np.full((1, 1), 4.8e-6), np.zeros((1, 1, 4)), {}, 200e-6))
    assert float(found.inertia[0, 0]) == pytest.approx(inertia, rel=1e-6)
    assert float(found.friction[0, 0]) == pytest.approx(friction, rel=1e-9)
    # The worst of 16 poses: an arm is seen nearly, not quite, where it lies level.
    assert 0.97 * gravity <= float(found.gravity[0, 0]) <= gravity * (1 + 1e-9)


def test_a_motor_that_is_asked_too_much_is_told_with_the_figures():
    with pytest.warns(MisfitWarning, match=r"'qube_servo_3' cannot move axis 0 of machine 0, load 'vertical_screw'"):
        EmulatedDrives(load="vertical_screw", motor="qube_servo_3").close()
    warned = set()
    for load in LOADS:
        for motor in find_device("tmcm1636").motors:
            demand = Demand("tmcm1636", load, motor)
            if demand.torque > 0.7 or demand.ratio > 0.5 * MAX_INERTIA_RATIO:  # others are far from it
                drives, told = build("tmcm1636", load, motor, 1)
                drives.close()
                assert told == demand.is_warned_of
                warned |= {(load, motor)} if told else set()
    assert warned == {
        ("vertical_screw", "qube_servo_3"), ("vertical_screw", "class_20w"), ("arm", "qube_servo_3"),
        ("robot", "qube_servo_3"), ("robot", "class_20w"),
    }  # fmt: skip


def test_a_load_too_heavy_for_the_rotor_is_told_with_its_ratio():
    """1.45e-4 kg m^2 is 30.2 rotors of the default motor, 1.4e-4 is 29.2."""
    with pytest.warns(MisfitWarning, match=r"load 'inertia' has 30 times the inertia of the rotor of motor 'qbl4208'"):
        EmulatedDrives(load="inertia", parameters={"load.inertia": 1.45e-4}).close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        EmulatedDrives(load="inertia", parameters={"load.inertia": 1.4e-4}).close()
