"""The highest speed of a stepper with a load: against an integration of its own, and where the emulator loses steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs import stepper_rig

from drive_env import EmulatedDrives, cia402, motion
from drive_env.envs.highest_speed import FASTEST, highest_speeds
from drive_env.motors import MOTORS
from drive_env.phase_current import amplitude, rated_setting
from drive_env.randomisation.random_machines import RandomMachines, laws_of


def parameters(motor, **others):
    """Return the parameters of a machine without friction, at 25 degC."""
    own = {"R_s": motor.R_s, "L_s": motor.L_q, "psi_m": motor.psi_m, "saturation": motor.saturation,
           "coulomb": 0.0, "viscous": 0.0}  # fmt: skip
    found = {f"motor.{name}": np.array([value]) for name, value in own.items()}
    beside = {"load.coulomb": 0.0, "load.viscous": 0.0, "supply.voltage": motor.voltage, "start.winding": 25.0,
              "stage.on_resistance": 0.0}  # fmt: skip
    return found | {name: np.array([value]) for name, value in (beside | others).items()}


@pytest.mark.every(72)
@pytest.mark.parametrize("name", ["qsh2818_32", "qsh4218_51", "qsh5718_51", "qsh5718_76"])
@pytest.mark.parametrize("share", [0.5, 0.7])
def test_there_the_pull_out_torque_is_what_friction_takes(name, share):
    motor = MOTORS[name]
    load = share * motor.rated_torque
    (speed,) = highest_speeds(motor, motor.rated_current, parameters(motor, **{"load.coulomb": load}))
    friction = motor.coulomb + motor.viscous * speed  # which the curve of the rig is without
    torque = stepper_rig.pull_out(motor, speed, motor.voltage, motor.rated_current) + friction
    assert torque == pytest.approx(load, rel=0.05)


def test_a_load_above_the_holding_torque_has_no_such_speed_and_none_at_all_the_highest():
    motor = MOTORS["qsh4218_51"]
    stuck = highest_speeds(motor, 1.0, parameters(motor, **{"load.coulomb": 2.0 * motor.rated_torque}))
    assert stuck.tolist() == [0.0]
    assert highest_speeds(motor, 1.0, parameters(motor))[0] == pytest.approx(FASTEST, rel=1e-2)


def test_a_warm_winding_is_slower_and_more_supply_faster():
    motor = MOTORS["qsh4218_51"]
    cold, warm, more = (
        highest_speeds(motor, 1.4, parameters(motor, **{"load.coulomb": 0.2}, **one))[0]
        for one in ({}, {"start.winding": 90.0}, {"supply.voltage": 30.0})
    )
    assert warm < 0.97 * cold < 1.03 * cold < more


def test_a_slow_ramp_loses_its_steps_there():
    """On machines as the task StepperRun draws them; a few, with little damping, are shaken out of step before."""
    machines, ramp = 24, 8.0  # rev/s^2
    with EmulatedDrives("tmcm6212", "inertia", num_machines=machines, num_threads=1) as drives:
        drawn = RandomMachines(drives, laws_of("stepper_run", drives.device, drives.machine.parameters))
        drawn.redraw([np.random.default_rng([7, k]) for k in range(machines)])
        current = amplitude(drives.device, rated_setting(drives.device, drives.motor))
        assert drives.read("Maximum current")[0] == rated_setting(drives.device, drives.motor)
        expected = highest_speeds(drives.motor, current, drawn.values) / (2.0 * math.pi)  # rev/s
        drives.write(cia402.SENSOR_SELECTION, 0)
        motion.enable(drives, mode="csv")
        lost = np.full(machines, np.nan)
        for cycle in range(2200):
            speed = ramp * 1e-3 * (cycle + 1)
            drives.write(cia402.TARGET_VELOCITY, round(speed * stepper_rig.MICROSTEPS))
            drives.advance(1e-3)
            fault = cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
            lost[fault & np.isnan(lost)] = speed
    ratio = lost / expected
    assert np.all(ratio < 1.03)
    assert np.mean(ratio > 0.97) > 0.8
    assert expected.max() > 2.0 * expected.min()
