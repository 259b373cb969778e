"""DcStep: the steps wait for the rotor, so that an overload makes a move slower and loses no step."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import FREE, MICROSTEPS, build, lane

from drive_env import motion
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
REAL = FREE | {"load.inertia": 5.0 * MOTOR.inertia}
RPM = MICROSTEPS / 60.0  # microsteps a second
STALL, FAULT = 0x3230, 0x08
LOWEST = round(60 * RPM)
OFF = 2 * (12 + 32 * 3)  # clocks: the high speed chopper doubles the off time


def set_up(drives, *, time=70, lowest=LOWEST, stall=0):
    """Write what DcStep needs: full steps and the high speed chopper, its lowest speed and its on-times."""
    for index, value in {
        0x2003: 255,
        0x20B7: 1,
        0x20B8: 1,
        0x20B3: lowest,
        0x20B4: time,
        0x20B5: stall,
        0x2092: 1,
        0x2097: 3,
    }.items():
        drives.write(index, value)
    drives.write(0x6083, 300_000)
    drives.write(0x6084, 300_000)


def behind(drives):
    """Return how far the rotor is behind the steps, electrical [rad]."""
    return 50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))


def turn(drives, speed):
    """Bring motors to a speed [microsteps/s] in pv."""
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, round(speed))
    drives.advance(round(speed / 300_000 + 0.5, 2))


def load_slowly(drives, torque):
    """Raise the torque against the motion [N m] within a second."""
    for k in range(20):
        drives.machine.load_torque = -torque * (k + 1) / 20.0
        drives.advance(0.05)
    drives.advance(0.5)


def test_a_move_under_an_overload_becomes_slower_and_ends_at_its_target():
    """A load that appears for a second in mid-move, above the pull-out torque of its speed: lost without DcStep."""
    target = 700_000
    with build(num_machines=3, parameters=REAL, ideal=True) as drives:
        set_up(drives)
        drives.write(0x20B3, [LOWEST, LOWEST, 0])
        motion.enable(drives, mode="pp")
        drives.write(0x6081, round(400 * RPM))
        drives.write(0x607A, target)
        drives.write(0x6040, 0x1F)
        slowest, ended = np.full(3, np.inf), np.full(3, np.nan)
        for k in range(400):
            drives.machine.load_torque = np.array([0.0, -0.38, -0.38]) if 120 <= k < 220 else 0.0
            trace = drives.record([0x606C], 0.01)[0x606C]
            if 130 <= k < 180:
                slowest = np.minimum(slowest, trace.mean(axis=0))
            there = drives.read(0x6041) & 0x0400 > 0
            ended[there & np.isnan(ended)] = 0.01 * k
        drives.advance(0.2)
        np.testing.assert_array_equal(drives.read(0x6064)[:2], target)
        np.testing.assert_allclose(behind(drives)[:2], 0.0, atol=0.5)  # a third of a full step, by detent
        assert abs(behind(drives)[2]) > 2.0 * math.pi  # what it would lose
        assert slowest[0] == pytest.approx(400 * RPM, rel=0.01) and slowest[1] < 330 * RPM
        assert ended[1] > ended[0] + 0.1
        assert drives.read((0x210B, 3))[1] == pytest.approx(target, abs=2)


@pytest.mark.parametrize("load", [0.1, 0.2, 0.3, 0.35])
def test_it_is_as_fast_as_its_torque_lets_it_and_shows_that_speed(load):
    """More load, less speed; the field stays where the mean torque is greatest, 90 degrees ahead, or less."""
    with build(num_machines=2, parameters=REAL, ideal=True) as drives:
        set_up(drives)
        turn(drives, 600 * RPM)
        load_slowly(drives, np.array([load, load + 0.05]))
        trace = drives.record([0x606C], 0.3)
        speed = trace[0x606C].mean(axis=0) / RPM
        before = lane(drives, "theta_m")
        drives.advance(0.5)
        turned = (lane(drives, "theta_m") - before) / 0.5 * 30.0 / math.pi
        np.testing.assert_allclose(speed, turned, rtol=0.05)
        assert 60.0 < speed[1] < speed[0] < 500.0
        assert np.all(behind(drives) < 2.0 * math.pi) and drives.emergencies() == []


def test_the_on_time_says_how_far_the_field_is_ahead():
    """Longer on-times let it go farther; below the blank time no step is made but at the lowest speed."""
    times = np.array([20, 24, 60, 90, 120])
    with build(num_machines=5, parameters=REAL, ideal=True) as drives:
        set_up(drives)
        drives.write(0x20B4, times)
        turn(drives, 600 * RPM)
        load_slowly(drives, np.full(5, 0.1))
        speed, lag = np.zeros(5), np.zeros(5)
        for _ in range(500):
            drives.advance(0.001)
            speed += lane(drives, "omega_m") / 500.0 * 30.0 / math.pi
            lag += np.degrees(behind(drives)) / 500.0
        np.testing.assert_allclose(speed[:2], 60.0, rtol=0.05)
        # In the mean 90 degrees and what the back-EMF at that on-time makes: the last machine is as fast as asked.
        emf = 24.0 * times[2:] / (times[2:] + OFF) - MOTOR.R_s * MOTOR.rated_current * math.sqrt(0.5)
        most = 90.0 + np.degrees(np.arcsin(emf / (lane(drives, "psi")[2:] * 50.0 * speed[2:] * math.pi / 30.0)))
        np.testing.assert_allclose(lag[2:4], most[:2], atol=0.5)
        assert speed[4] == pytest.approx(600.0, rel=0.01) and lag[4] < most[2]
        assert 200.0 < speed[2] < speed[3] < 590.0


def test_without_full_steps_and_high_speed_chopper_it_does_not_work():
    with build(num_machines=3, parameters=REAL, ideal=True) as drives:
        set_up(drives, time=20)
        drives.write(0x20B7, [1, 0, 1])
        drives.write(0x20B8, [1, 1, 0])
        turn(drives, 200 * RPM)
        np.testing.assert_allclose(drives.read(0x606C), np.array([60, 200, 200]) * RPM, atol=2)


def test_below_its_speed_the_motor_makes_microsteps():
    with build(parameters=REAL) as drives:
        set_up(drives)
        turn(drives, 50 * RPM)
        assert lane(drives, "in_full_steps")[0] == 0.0
        drives.write(0x60FF, round(70 * RPM))
        drives.advance(0.3)
        assert lane(drives, "in_full_steps")[0] == 1.0
        assert drives.read(0x606C)[0] == round(70 * RPM)


@pytest.mark.parametrize("stops", [0, 1])
def test_a_blocked_motor_steps_at_the_lowest_speed_until_the_stall_stops_it(stops):
    with build(parameters=REAL, ideal=True) as drives:
        set_up(drives, time=50, stall=4)
        drives.write(0x20A4, stops * (LOWEST - 1))
        turn(drives, 200 * RPM)
        assert drives.emergencies() == []
        drives.machine.fault("jam", torque=10.0)
        drives.advance(0.5)
        at = lane(drives, "step_position")[0]
        drives.advance(0.3)
        way = (lane(drives, "step_position")[0] - at) * 30.0 / math.pi / 0.3  # rpm
        drives.advance(1.2)
        if stops:
            assert way == 0.0
            assert [m.code for m in drives.emergencies()] == [STALL]
            assert drives.read(0x6041)[0] & 0x4F == FAULT
        else:
            assert way == pytest.approx(60.0, rel=0.1)
            assert drives.read(0x606C)[0] == LOWEST and drives.emergencies() == []


def test_a_motor_that_turns_is_no_stall():
    with build(parameters=REAL, ideal=True) as drives:
        set_up(drives, time=50, stall=4)
        drives.write(0x20A4, LOWEST - 1)  # below DcStep's, StallGuard2 reads nothing yet
        turn(drives, 400 * RPM)
        load_slowly(drives, np.array([0.3]))
        drives.machine.load_torque = 0.0
        drives.advance(0.5)
        drives.write(0x60FF, 0)
        drives.advance(2.0)
        assert drives.emergencies() == [] and abs(behind(drives)[0]) < math.pi


def test_set_points_of_csp_are_caught_up_with():
    """Faster than they are, and so that 6084h brings the motor to their speed in time."""
    speed = np.concatenate([np.arange(300), np.full(1700, 300), np.arange(300, 0, -1), np.zeros(100)])
    targets = np.cumsum(speed).astype(int)  # 350 rpm
    with build(parameters=REAL, ideal=True) as drives:
        set_up(drives)
        drives.write(0x6084, 2_000_000)
        motion.enable(drives, mode="csp")
        drives.record([0x6064], 0.5, {0x607A: targets[:500]})
        drives.machine.load_torque = -0.38
        drives.record([0x6064], 0.3, {0x607A: targets[500:800]})
        assert targets[799] - drives.read(0x6064)[0] > 2000
        drives.machine.load_torque = 0.0
        drives.record([0x6064], 1.6, {0x607A: targets[800:]})
        assert drives.read(0x6064)[0] == targets[-1]
        assert behind(drives)[0] == pytest.approx(0.0, abs=0.5)
