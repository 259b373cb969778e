"""StallGuard2: the load reading against its closed form, and the stop of a motor that stalls.

Closed forms: torque = T_hold sin(load angle), and the mean voltage of a phase while its current falls, against the
current, (2 / pi) (L i w + psi w (cos d - sin d) - R i); the reading is 1023 times its share of the supply.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import FREE, MICROSTEPS, SMOOTH, build, lane

from drive_env import motion
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
PPS = MICROSTEPS / (2.0 * math.pi)
FULL_STEP = 256  # microsteps
HEAVY = {"load.inertia": 5.0 * MOTOR.inertia}
LINEAR = SMOOTH | HEAVY | {"motor.viscous": 3.0 * MOTOR.viscous, "motor.saturation": 0.0}
REAL = FREE | HEAVY
STALL = 0x3230
FAULT, DISABLED, ENABLED = 0x08, 0x40, 0x27
RPM = MICROSTEPS / 60.0  # microsteps a second


def turn(drives, speed, *, acceleration=400_000):
    """Bring enabled drives to a speed [microsteps/s] in pv."""
    motion.enable(drives, mode="pv")
    drives.write(0x6083, acceleration)
    drives.write(0x60FF, np.rint(speed).astype(int))
    drives.advance(round(float(np.max(np.abs(speed))) / acceleration + 0.4, 3))


def load_slowly(drives, torque, *, steps=20, settle=0.2):
    """Raise the torque against the motion from 0 in so many steps [N m]."""
    for k in range(steps):
        drives.machine.load_torque = -torque * (k + 1) / steps
        drives.advance(0.02)
    drives.advance(settle)


def behind(drives):
    """Return how far the rotor is behind the steps, electrical [rad]."""
    return 50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))


# --- the reading --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rpm", [120, 200, -200])
@pytest.mark.parametrize("supply", [24.0, 36.0])
def test_the_reading_is_what_the_falling_phase_gives_back(rpm, supply):
    shares = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
    direction = math.copysign(1.0, rpm)
    with build(num_machines=5, parameters=LINEAR, supply=supply, ideal=True) as drives:
        drives.write(0x209D, 1)
        turn(drives, np.full(5, rpm * RPM))
        speed = abs(rpm) * math.pi / 30.0
        amplitude = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))
        torque = 50.0 * MOTOR.psi_m * amplitude
        load_slowly(drives, direction * shares * torque)
        amplitude = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))
        w = 50.0 * speed
        sine = (shares * torque + LINEAR["motor.viscous"] * speed) / (50.0 * MOTOR.psi_m * amplitude)
        emf = MOTOR.psi_m * w * (np.sqrt(1.0 - sine * sine) - sine)
        back = 2.0 / math.pi * (MOTOR.L_q * amplitude * w + emf - lane(drives, "R_s") * amplitude)
        expected = np.clip(1023.0 * back / lane(drives, "u_dc"), 0.0, 1023.0)
        np.testing.assert_allclose(drives.read(0x2101), expected, atol=6.0)
        assert expected[0] > 70.0


def test_it_falls_with_the_load_to_all_but_nothing_where_the_motor_loses_its_steps():
    """The manual's figure; and above half of the torque no less steeply than below it."""
    with build(parameters=REAL) as drives:
        drives.write(0x209D, 1)
        turn(drives, 300 * RPM)
        readings, torques, torque = [], [], 0.0
        while True:
            drives.advance(0.03)
            if behind(drives)[0] > math.radians(110.0):
                break
            readings.append(drives.read(0x2101)[0])
            torques.append(torque)
            torque += 0.005 * MOTOR.rated_torque
            drives.machine.load_torque = -torque
        readings, torques = np.array(readings[5:]), np.array(torques[5:])
        assert np.all(np.diff(readings) <= 6)  # what the swinging of the rotor leaves of the mean
        assert readings[0] > 300 and 0 <= readings[-1] < 0.1 * readings[0]
        half = len(readings) // 2
        first, second = (
            np.polyfit(torques[part], readings[part], 1)[0] for part in (slice(0, half), slice(half, None))
        )
        assert 0.7 < first / second < 1.4  # all but a line


@pytest.mark.parametrize(("threshold", "expected"), [(0, 0), (10, 160), (-10, -160), (63, 1023), (-63, -1023)])
def test_the_threshold_shifts_the_reading(threshold, expected):
    with build(num_machines=2, parameters=LINEAR) as drives:
        drives.write(0x209D, 1)
        drives.write(0x209E, [0, threshold])
        turn(drives, np.full(2, 200 * RPM))
        plain, shifted = drives.read(0x2101)
        assert 200 < plain < 800
        if abs(expected) < 1000:
            assert shifted - plain == expected
        else:
            assert shifted == (1023 if expected > 0 else 0)


@pytest.mark.parametrize(("filtered", "period"), [(0, 0.025), (1, 0.1)])
def test_a_reading_is_taken_every_full_step_or_every_four(filtered, period):
    with build(parameters=LINEAR) as drives:
        drives.write(0x209D, filtered)
        turn(drives, 40 * FULL_STEP)
        begun = []
        for _ in range(500):
            drives.advance(0.001)
            begun.append(lane(drives, "load_start")[0])
        found = np.flatnonzero(np.diff(begun))
        np.testing.assert_allclose(np.diff(found) * 0.001, period, atol=0.0011)
        assert len(found) >= 4
        assert np.diff(begun)[found] * PPS == pytest.approx(period * 40 * FULL_STEP, rel=0.01)


def test_below_a_turn_a_second_it_tells_nothing():
    """TMC5160 data sheet: for many motors below one turn a second; the back-EMF is less than the resistance takes."""
    with build(num_machines=2, parameters=LINEAR) as drives:
        drives.write(0x209D, 1)
        drives.write(0x209E, 32)
        turn(drives, np.array([6.0, 6.0]) * RPM)
        load_slowly(drives, np.array([0.0, 0.5]) * MOTOR.rated_torque)
        slow = drives.read(0x2101)
        drives.write(0x60FF, round(200 * RPM))
        drives.advance(1.0)
        fast = drives.read(0x2101)
        assert abs(slow[0] - slow[1]) < 0.05 * abs(fast[0] - fast[1])


def test_where_the_back_emf_uses_the_supply_up_it_hardly_tells_the_load():
    """Half of the torque that can be had there changes it by a fraction of what it does with twice the supply."""
    changes = []
    for supply, threshold in ((24.0, 40), (48.0, 20)):
        with build(num_machines=2, parameters=LINEAR, supply=supply, ideal=True) as drives:
            drives.write(0x209D, 1)
            drives.write(0x209E, threshold)
            turn(drives, np.full(2, 500 * RPM))
            load_slowly(drives, np.array([0.0, 0.12]))
            assert np.all(np.abs(behind(drives)) < math.pi)
            changes.append(supply * np.diff(drives.read(0x2101))[0])
    assert changes[1] < 0.0 and abs(changes[0]) < 0.25 * abs(changes[1])


@pytest.mark.parametrize("objects", [{0x2093: 1}, {0x20B0: 10**6, 0x20B1: 40, 0x20B2: 100}])
def test_outside_of_spread_cycle_there_is_no_reading_and_no_stop(objects):
    with build(parameters=LINEAR) as drives:
        turn(drives, 200 * RPM)
        assert drives.read(0x2101)[0] > 0
        for index, value in objects.items():
            drives.write(index, value)
        drives.write(0x20A4, 1)
        drives.advance(0.2)
        assert drives.read(0x2101)[0] == 0
        assert drives.emergencies() == []
        assert drives.read(0x606C)[0] == round(200 * RPM)


# --- the stop -----------------------------------------------------------------------------------------------------
def stall(drives, torque=None):
    """Load a motor until it is stopped; return the most it had made in steps [rad] a millisecond before."""
    for k in range(400):
        drives.machine.load_torque = -0.005 * k * MOTOR.rated_torque if torque is None else -torque
        before = lane(drives, "step_position")
        drives.advance(0.001)
        if np.all(lane(drives, "stalled") > 0.0):
            return before
    raise AssertionError("never stopped")


def test_a_stall_stops_the_steps_at_once_whatever_the_ramp():
    """Before the rotor has lost any, and although 6085h would take a minute."""
    with build(parameters=REAL) as drives:
        drives.write(0x6085, 3000)
        turn(drives, 300 * RPM)
        drives.write(0x209E, -2)
        drives.write(0x20A4, round(100 * RPM))
        before = stall(drives)
        stopped = lane(drives, "step_position")[0]
        assert (stopped - before[0]) * PPS < 300 * RPM * 0.001 + 1
        assert stopped == lane(drives, "load_start")[0]  # in the window of the reading
        torque = drives.machine.load_torque[0]
        assert -torque > 0.6 * MOTOR.rated_torque
        drives.advance(0.002)
        assert lane(drives, "step_position")[0] == stopped
        assert drives.read(0x6041)[0] & 0x4F in (0x0F, FAULT)
        drives.machine.load_torque = 0.0
        drives.advance(1.2)
        assert lane(drives, "step_position")[0] == stopped
        assert abs(behind(drives)[0]) < math.pi  # no step was lost
        assert [(m.code, m.extra[0], m.error_register) for m in drives.emergencies()] == [(STALL, 0, 0x21)]
        assert drives.read(0x6041)[0] & 0x4F == FAULT
        assert drives.read(0x606C)[0] == 0
        assert lane(drives, "stage_on")[0] == 0.0
        assert drives.read(0x2102)[0] == 0  # the driver has no flag of it (table 155)


@pytest.mark.parametrize("threshold", [0, 400])
def test_below_the_speed_of_20a4h_or_with_0_nothing_stops_it(threshold):
    with build(parameters=REAL, ideal=True) as drives:
        turn(drives, 300 * RPM)
        drives.write(0x20A4, round(threshold * RPM))
        for k in range(100):
            drives.machine.load_torque = -0.02 * k * MOTOR.rated_torque
            drives.advance(0.005)
            if behind(drives)[0] > 2.0 * math.pi:
                break
        drives.machine.load_torque = 0.0
        assert drives.read(0x606C)[0] == round(300 * RPM)
        assert behind(drives)[0] > 2.0 * math.pi  # the steps went on, and were lost
        assert STALL not in {m.code for m in drives.emergencies()}


def test_a_slow_start_is_no_stall():
    """Every ramp goes through speeds at which the reading is 0."""
    with build(parameters=REAL) as drives:
        drives.write(0x20A4, round(150 * RPM))
        for target in (300, -300, 0, 300):
            turn(drives, np.array([target * RPM])) if target == 300 else None
            drives.write(0x60FF, round(target * RPM))
            drives.advance(2.0)
            assert drives.read(0x606C)[0] == round(target * RPM)
        assert drives.emergencies() == []


@pytest.mark.parametrize("mode", ["pp", "pv", "csp", "csv"])
def test_an_end_stop_stops_the_motor_in_every_mode(mode):
    """At a speed at which the inductance gives back no more than the resistance takes: a held rotor has no back-EMF."""
    speed = round(120 * RPM)
    with build(parameters=REAL) as drives:
        drives.write(0x209E, -1)
        drives.write(0x20A4, round(100 * RPM))
        motion.enable(drives, mode=mode)
        drives.write(0x6083, 400_000)
        drives.write(0x6084, 400_000)
        drives.write(0x6081, speed)
        ramp = np.minimum(np.arange(800) * 400, speed // 1000 * 1000)
        if mode == "pp":
            drives.write(0x607A, 10_000_000)
            drives.write(0x6040, 0x1F)
        elif mode == "pv":
            drives.write(0x60FF, speed)
        played = {"csp": {0x607A: np.cumsum(ramp) // 1000}, "csv": {0x60FF: ramp}}.get(mode)
        drives.record([0x6064], 0.8, played)
        assert drives.read(0x606C)[0] == pytest.approx(speed, rel=0.01) and drives.emergencies() == []
        drives.machine.fault("jam", torque=10.0)
        target = drives.read(0x607A)[0]
        further = target + speed // 1000 * np.arange(1220)
        drives.record([0x6064], 0.02, {0x607A: further[:20]} if mode == "csp" else None)
        at = lane(drives, "step_position")[0]
        # A rotor that has been held up is at most the steps of some milliseconds behind.
        assert behind(drives)[0] / (2.0 * math.pi) * 4 * FULL_STEP < 0.02 * speed
        drives.record([0x6064], 1.2, {0x607A: further[20:]} if mode == "csp" else None)
        assert lane(drives, "step_position")[0] == at
        assert drives.read(0x6041)[0] & 0x4F == FAULT
        assert [m.code for m in drives.emergencies()] == [STALL]


def test_a_fault_reset_and_a_new_set_point_lead_out_of_it():
    with build(parameters=REAL) as drives:
        turn(drives, 300 * RPM)
        drives.write(0x20A4, round(100 * RPM))
        stall(drives, 2.0 * MOTOR.rated_torque)
        drives.machine.load_torque = 0.0
        drives.advance(1.2)
        at = drives.read(0x6064)[0]
        drives.write(0x6040, 0x00)
        drives.advance(0.01)
        assert drives.read(0x6041)[0] & 0x4F == FAULT
        drives.write(0x6040, 0x80)
        drives.advance(0.01)
        assert drives.read(0x6041)[0] & 0x4F == DISABLED
        drives.write(0x60FF, 0)
        drives.emergencies()
        motion.enable(drives, mode="pp")
        drives.advance(0.2)
        assert drives.read(0x6064)[0] == at  # enabling moves nothing
        drives.write(0x6081, round(300 * RPM))
        drives.write(0x6084, 400_000)
        motion.move_to(drives, int(at) + 60_000)
        assert drives.emergencies() == []
        assert drives.read(0x6041)[0] & 0x6F == ENABLED


def test_a_stall_during_a_quick_stop_ends_it():
    with build(parameters=REAL) as drives:
        drives.write(0x6085, 60_000)  # a stop of four seconds
        turn(drives, 300 * RPM)
        drives.write(0x20A4, round(100 * RPM))
        drives.write(0x6040, 0x02)
        drives.advance(0.1)
        assert drives.read(0x606C)[0] > 200 * RPM
        stall(drives, 2.0 * MOTOR.rated_torque)
        at = lane(drives, "step_position")[0]
        drives.machine.load_torque = 0.0
        drives.advance(1.2)
        assert lane(drives, "step_position")[0] == at
        assert drives.read(0x6041)[0] & 0x4F == FAULT
