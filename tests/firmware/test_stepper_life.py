"""A stepper's life with every load: protocol, motion in every mode, homing, no emergency, every object readable."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from rigs.stepper_rig import BARE, MICROSTEPS, lane

from drive_env import EmulatedDrives, motion
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.firmware.record import set_lanes
from drive_env.motors import MOTORS, motors_of
from mechanics.loads import LOADS

QUARTER = MICROSTEPS // 4
ENABLED = (0x6F, 0x27)


def build(load, motor, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        drives = EmulatedDrives(BARE, load, motor, num_threads=1, **options)
    set_lanes(drives.inside.records, "full_scale_current", np.full(drives.num_axes, MOTORS[motor].rated_current))
    drives.machine.brake = "with_stage"  # what hangs must not fall while a stage is off
    return drives


def behind(drives):
    """Return by how many full steps rotors and steps differ."""
    return np.abs(lane(drives, "theta_m") - lane(drives, "step_position")) / np.radians(1.8)


def readable(drives):
    for entry in drives.device.new_dictionary():
        value = drives.read((entry.index, entry.sub))
        assert np.all((entry.low <= value) & (value <= entry.high)), entry.label


@pytest.mark.every(6)
@pytest.mark.parametrize("load", LOADS)
def test_a_stepper_moves_every_load_in_every_mode(load):
    with build(load, "qsh8618_96", num_machines=2, randomise=True, seed=3) as drives:
        readable(drives)
        motion.enable(drives, mode="pp")
        start = drives.read(0x6064)
        motion.move_to(drives, start + QUARTER)
        drives.advance(0.3)
        np.testing.assert_array_equal(drives.read(0x6064), start + QUARTER)
        motion.select_mode(drives, "pv")
        drives.write(0x60FF, -QUARTER)
        drives.advance(0.4)
        drives.write(0x60FF, 0)
        drives.advance(0.2)
        motion.select_mode(drives, "csp")
        begin = drives.read(0x6062)
        way = np.rint(QUARTER / 2 * (1 - np.cos(np.linspace(0, np.pi, 500)))).astype(int)
        drives.record([0x6064], 0.5, {0x607A: begin + way[:, None]})
        drives.advance(0.3)
        np.testing.assert_array_equal(drives.read(0x6064), begin + way[-1])
        assert np.all(behind(drives) < 1.0)
        drives.write(0x6098, 35)
        motion.select_mode(drives, "hm")
        drives.write(0x6040, 0x1F)
        drives.advance(0.05)
        assert np.all(np.abs(drives.read(0x6064)) <= 1)
        assert np.all(drives.read(0x6041) & ENABLED[0] == ENABLED[1])
        assert drives.emergencies() == []
        assert not np.any(drives.machine.diverged)
        readable(drives)
        motion.disable(drives)


@pytest.mark.parametrize("motor", motors_of(["stepper"]))
def test_every_stepper_makes_a_thousand_revolutions_a_minute_or_its_rated_speed(motor):
    row = MOTORS[motor]
    speed = min(0.8 * row.rated_speed, 1000 * 2 * np.pi / 60)
    with build("inertia", motor, parameters={"load.inertia": 2.0 * row.inertia}) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x6083, round(2.0 * speed / (2 * np.pi) * MICROSTEPS))
        drives.write(0x60FF, round(speed / (2 * np.pi) * MICROSTEPS))
        drives.advance(0.8)
        assert drives.machine.rotor_speed[0] == pytest.approx(speed, rel=0.02)
        assert behind(drives)[0] < 1.0
        assert drives.emergencies() == []


def test_homing_finds_the_left_switch():
    with build("belt", "qsh8618_96") as drives:
        motion.enable(drives, mode="hm")
        drives.write(0x6098, 17)
        drives.write((0x6099, 1), MICROSTEPS)
        drives.write((0x6099, 2), MICROSTEPS // 20)
        drives.write(0x6040, 0x1F)
        drives.advance(12.0)
        status = drives.read(0x6041)[0]
        assert status & 0x3400 == 0x1400
        switch = next(row for row in drives.load.switches if row.kind == "left")
        assert lane(drives, "load_position")[0] == pytest.approx(switch.high, abs=1e-3)
        assert drives.emergencies() == []


def test_a_machine_that_leaves_physics_is_frozen_alone():
    with build("inertia", "qsh4218_51", num_machines=9) as drives, pytest.warns(RuntimeWarning, match="machine 4 left"):
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 20_000)
        drives.machine.load_torque = np.where(np.arange(9) == 4, 1e12, 0.0)
        drives.advance(0.3)
        assert drives.machine.diverged.tolist() == [k == 4 for k in range(9)]
        others = np.arange(9) != 4
        assert np.ptp(lane(drives, "theta_m")[others]) == 0.0
        assert np.all(drives.read(0x6041)[others] & ENABLED[0] == ENABLED[1])
        assert drives.read(0x6041)[4] & 0x4F == 0x08
        readable(drives)
