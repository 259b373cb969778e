"""A stepper in open loop: torque against load angle, lost steps, detent, resonance, pull-out, what is told of it.

Closed forms: torque = T_hold sin(load angle), natural frequency sqrt(50 T_hold / J) / 2 pi, one slip = four full steps.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import FREE, MICROSTEPS, SMOOTH, build, hold, holding_torque, lane

from drive_env import motion
from drive_env.emulator.loop_trace import trace_loops
from drive_env.firmware.record import set_lanes
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
PPS = MICROSTEPS / (2.0 * math.pi)  # microsteps per rad
FULL_STEP = math.radians(1.8)
DAMPED = SMOOTH | {"motor.viscous": MOTOR.viscous}
SLIP = 4  # full steps


def load_angle(drives):
    """Return how far the rotor lies behind the field, electrical [rad]."""
    field = np.arctan2(lane(drives, "sin_ref"), lane(drives, "cos_ref"))
    behind = field - 50.0 * lane(drives, "theta_m")
    return np.mod(behind + math.pi, 2.0 * math.pi) - math.pi


# --- standstill ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("current", [0.5, 1.0])
def test_torque_is_that_of_the_load_angles_sine(current):
    shares = np.array([-0.9, -0.5, 0.0, 0.3, 0.7, 0.95])
    with build(current=current, num_machines=6, parameters=DAMPED) as drives:
        hold(drives)
        amplitude = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))[0]
        assert amplitude == pytest.approx(current * MOTOR.rated_current, rel=0.03)  # the mean of a chopped current
        torque = holding_torque(MOTOR, amplitude)
        drives.machine.load_torque = -0.8 * shares * torque  # not at once: a rotor that swings goes twice as far
        drives.advance(0.2)
        drives.machine.load_torque = -shares * torque
        drives.advance(0.3)
        np.testing.assert_allclose(np.sin(load_angle(drives)), shares, atol=0.003)
        assert np.all(drives.read(0x6063) == 0)


def test_above_the_holding_torque_the_rotor_slips_by_four_full_steps_and_below_it_holds():
    """Pushed past the peak for as long as a slip takes, it comes to rest a slip further; the counter sees nothing."""
    over = np.array([0.97, 1.02])
    with build(num_machines=2, parameters=SMOOTH | {"motor.viscous": 5.0 * MOTOR.viscous}) as drives:
        drives.write(0x606A, 0)  # the encoder tells the position
        hold(drives)
        drives.machine.load_torque = -0.9 * MOTOR.rated_torque
        drives.advance(0.2)
        drives.machine.load_torque = -over * MOTOR.rated_torque
        for _ in range(500):
            drives.advance(0.001)
            # Taken away once the rotor is past the next place where it is as weak.
            if lane(drives, "theta_m")[1] < -1.5 * math.pi / 50.0:
                break
        assert abs(lane(drives, "theta_m")[0]) < math.pi / 2 / 50.0
        drives.machine.load_torque = 0.0
        drives.advance(0.3)
        turned = lane(drives, "theta_m") / FULL_STEP
        np.testing.assert_allclose(turned, [0.0, -SLIP], atol=0.01)
        assert math.degrees(lane(drives, "theta_m")[1]) == pytest.approx(-7.2, abs=0.02)
        np.testing.assert_array_equal(drives.read(0x6063), [0, 0])
        np.testing.assert_array_equal(drives.read(0x6062), [0, 0])
        np.testing.assert_allclose(drives.read(0x6064), [0, -SLIP * 256], atol=3)


def test_the_deviation_between_steps_and_encoder_stops_the_axis():
    with build(num_machines=2, parameters=SMOOTH | {"motor.viscous": 5.0 * MOTOR.viscous}) as drives:
        drives.write(0x606A, [0, -1])
        drives.write(0x6065, 2 * 256)
        hold(drives)
        drives.machine.load_torque = -1.2 * MOTOR.rated_torque
        drives.advance(0.1)
        drives.machine.load_torque = 0.0
        drives.advance(0.1)
        assert [(m.axis, m.code) for m in drives.emergencies()] == [(0, 0x8611)]
        np.testing.assert_array_equal(drives.read(0x6041) & 0x4F, [0x08, 0x07])  # the counter alone knows no deviation


def test_without_current_the_detent_torque_holds_and_no_more():
    """-T_d sin(4 theta_e): at rest where one phase would hold; a push beyond T_d turns the rotor."""
    shares = np.array([-0.9, 0.5, 1.1])
    parameters = FREE | {"motor.coulomb": 0.0, "motor.viscous": MOTOR.viscous}
    with build(num_machines=3, parameters=parameters) as drives:
        drives.machine.load_torque = 0.6 * shares * MOTOR.cogging_torque  # not at once, or the rotor swings over
        drives.advance(0.5)
        drives.machine.load_torque = shares * MOTOR.cogging_torque
        drives.advance(1.0)
        theta = lane(drives, "theta_m")
        np.testing.assert_allclose(4.0 * 50.0 * theta[:2], np.arcsin(shares[:2]), atol=2e-3)
        assert theta[2] > 10.0 * FULL_STEP
        assert np.all(lane(drives, "i_a") == 0.0)


def test_the_detent_torque_shifts_the_rotor_between_full_steps():
    """At an angle of the field between two full steps T_hold sin(field - theta) = T_d sin(4 theta)."""
    parameters = FREE | {"motor.coulomb": 0.0, "motor.viscous": MOTOR.viscous}
    with build(parameters=parameters) as drives:
        hold(drives)
        drives.write(0x6083, 10**7)
        motion.move_to(drives, 100)
        drives.advance(0.5)
        field = 100.5 * math.pi / 512.0
        theta = 50.0 * lane(drives, "theta_m")[0]
        pull = MOTOR.rated_torque * math.sin(field - theta)
        assert pull == pytest.approx(MOTOR.cogging_torque * math.sin(4.0 * theta), rel=0.02)
        assert field - theta > 0.02


# --- resonance ----------------------------------------------------------------------------------------------------
def crossings(x):
    """Return the mean period [samples] of a swing about 0."""
    up = np.flatnonzero((x[:-1] < 0.0) & (x[1:] >= 0.0))
    exact = up - x[up] / (x[up + 1] - x[up])
    return (exact[-1] - exact[0]) / (len(exact) - 1)


@pytest.mark.parametrize("name", ["qsh2818_32", "qsh4218_51", "qsh5718_76", "qsh8618_96"])
def test_a_displaced_rotor_swings_with_its_natural_frequency(name):
    motor = MOTORS[name]
    with build(name) as drives:
        hold(drives)
        drives.machine.load_torque = 0.05 * motor.rated_torque
        drives.advance(0.1)
        drives.machine.load_torque = 0.0
        swing = trace_loops(drives, ["theta_m"], 0.3).signals["theta_m"][:, 0]
        torque = holding_torque(motor, np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))[0])
        assert lane(drives, "J_rotor")[0] == pytest.approx(motor.inertia, rel=1e-3)
    frequency = 5000.0 / crossings(swing - swing.mean())
    assert frequency == pytest.approx(math.sqrt(50.0 * torque / motor.inertia) / (2.0 * math.pi), rel=0.003)
    rated = math.sqrt(50.0 * motor.rated_torque / motor.inertia) / (2.0 * math.pi)
    assert frequency == pytest.approx(rated, rel=0.03)  # with what the chopper's cycle leaves of the rated current


def test_the_detent_torque_makes_a_full_steps_rest_softer_or_stiffer():
    """Stiffness 50 (T_hold + 4 T_d) where one phase holds the rotor."""
    parameters = FREE | {"motor.coulomb": 0.0, "motor.viscous": 0.0}
    with build(parameters=parameters) as drives:
        hold(drives)
        drives.machine.load_torque = 0.03 * MOTOR.rated_torque
        drives.advance(0.1)
        drives.machine.load_torque = 0.0
        swing = trace_loops(drives, ["theta_m"], 0.3).signals["theta_m"][:, 0]
    stiffness = 50.0 * (MOTOR.rated_torque + 4.0 * MOTOR.cogging_torque)
    natural = math.sqrt(stiffness / MOTOR.inertia) / (2.0 * math.pi)
    assert 5000.0 / crossings(swing - swing.mean()) == pytest.approx(natural, rel=0.01)


def test_microsteps_take_the_resonance_away():
    """One full step per period of the natural frequency shakes the rotor; smaller steps do less, 256 nothing."""
    resolutions = np.array([0, 1, 2, 4, 8])
    natural = math.sqrt(50.0 * MOTOR.rated_torque / MOTOR.inertia) / (2.0 * math.pi)
    with build(num_machines=5, parameters=DAMPED) as drives:
        drives.write(0x2000, resolutions)
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 10**7)
        drives.write(0x60FF, round(natural * FULL_STEP * PPS))
        drives.advance(0.5)
        speed = trace_loops(drives, ["omega_m"], 0.1).signals["omega_m"]
        turned = lane(drives, "theta_m") - lane(drives, "step_position")
    shaking = speed.std(axis=0) / (natural * FULL_STEP)
    assert shaking[0] > 0.5  # as large as the speed itself
    assert np.all(shaking[1:] < 0.6 * shaking[:-1])
    assert shaking[4] < 0.01
    assert np.all(np.abs(turned) < 2.0 * FULL_STEP)  # none has lost a step


# --- pull-out -----------------------------------------------------------------------------------------------------
def dynamometer(name, speeds, **options):
    """Return the torque [N m] at which motors that turn at speeds [rad/s] lose steps, the load growing slowly."""
    motor = MOTORS[name]
    parameters = FREE | {"load.inertia": 5.0 * motor.inertia}
    with build(name, num_machines=len(speeds), parameters=parameters, **options) as drives:
        drives.write(0x2092, 1)  # short blank and off times, as windings of low inductance want them
        drives.write(0x2097, 2)
        motion.enable(drives, mode="pv")
        drives.write(0x6083, round(speeds.max() / 2.0 * PPS))
        drives.write(0x60FF, np.rint(speeds * PPS).astype(int))
        drives.advance(2.3)
        found, torque, step = np.full(len(speeds), np.nan), 0.0, 0.01 * motor.rated_torque
        while np.isnan(found).any() and torque < 1.3 * motor.rated_torque:
            torque += step
            drives.machine.load_torque = np.where(np.isnan(found), -torque, 0.0)
            drives.advance(0.01)
            behind = 50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))
            found[(np.abs(behind) > 2.0 * math.pi) & np.isnan(found)] = torque - 0.5 * step
        return found


@pytest.mark.parametrize("name", ["qsh4218_47", "qsh5718_51"])
def test_pull_out_torque_follows_the_rows_curve(name):
    """Within 10 % of the row, in shape and at the corner, where the torque has fallen to 85 % of the first point's."""
    curve = MOTORS[name].pull_out
    speed, torque = np.array(curve.speed), np.array(curve.torque)
    found = dynamometer(name, speed, supply=curve.supply)
    np.testing.assert_allclose(found, torque, rtol=0.1, atol=0.02 * MOTORS[name].rated_torque)
    corner = [np.interp(-0.85 * of[0], -of, speed) for of in (found, torque)]
    assert corner[0] == pytest.approx(corner[1], rel=0.1)


def test_twice_the_supply_moves_the_corner_to_twice_the_speed():
    """QSH4218 manual, 6.3: "scale the velocity axis proportionally to the supply voltage"."""
    corner = MOTOR.rated_speed
    low = dynamometer("qsh4218_51", 1.5 * np.array([corner]), supply=24.0)[0] + 1.5 * corner * MOTOR.viscous
    high = dynamometer("qsh4218_51", 3.0 * np.array([corner]), supply=48.0)[0] + 3.0 * corner * MOTOR.viscous
    assert high == pytest.approx(low, rel=0.1)
    assert low < 0.9 * MOTOR.rated_torque


# --- motion -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("resolution", [0, 3, 8])
def test_a_move_ends_at_its_microstep(resolution):
    with build(parameters=DAMPED) as drives:
        drives.write(0x2000, resolution)
        hold(drives)
        target = 37 * 256 + 128
        motion.move_to(drives, target)
        drives.advance(0.2)
        assert drives.read(0x6064)[0] == target
        assert drives.read(0x6041)[0] & 0x0400
        # The table's entry nearest to it, in the middle of its microstep.
        size = 2**resolution
        entry = math.floor(target * size / 256.0 + 0.5)
        assert 50.0 * lane(drives, "theta_m")[0] == pytest.approx((entry + 0.5) * math.pi / 2.0 / size, abs=1e-3)
        assert drives.read((0x210B, 3))[0] == pytest.approx(target * size / 256.0, abs=1)


def test_there_and_back_again_is_where_it_began():
    with build(parameters=DAMPED) as drives:
        hold(drives)
        before = lane(drives, "theta_m")[0]
        for target in (12_345, -77_777, 3, 0):
            motion.move_to(drives, target)
        drives.advance(0.3)
        assert lane(drives, "theta_m")[0] == pytest.approx(before, abs=1e-6)
        assert lane(drives, "step_position")[0] == pytest.approx(0.0, abs=1e-9)
        assert drives.read((0x210B, 3))[0] == pytest.approx(12_345 + 90_122 + 77_780 + 3, abs=4)


def test_the_step_counter_is_one_of_64_bits_whose_halves_can_be_set():
    with build(parameters=SMOOTH) as drives:
        drives.write((0x210B, 1), 2**32 - 1_000)
        drives.write((0x210B, 2), 7)
        motion.enable(drives, mode="pp")
        motion.move_to(drives, -3_000)
        drives.advance(0.01)
        assert [int(drives.read((0x210B, sub))[0]) for sub in (1, 2, 3)] == [2_000, 8, 8 * 2**32 + 2_000]


def test_the_rotor_follows_set_points_of_csp_and_csv():
    with build(parameters=DAMPED) as drives:
        motion.enable(drives, mode="csp")
        way = np.rint(20_000 * (1.0 - np.cos(np.linspace(0.0, math.pi, 400))) / 2.0).astype(int)
        trace = drives.record([0x6062, 0x6064], 0.4, {0x607A: way})
        assert np.all(np.abs(trace[0x6062][1:, 0] - way[:-1]) <= 1)
        drives.advance(0.1)
        assert drives.read(0x6064)[0] == 20_000
        assert lane(drives, "theta_m")[0] * PPS == pytest.approx(20_000, abs=3)
        motion.select_mode(drives, "csv")
        drives.record([0x606C], 0.3, {0x60FF: np.minimum(np.arange(300) * 100, 20_000)})
        assert drives.read(0x606C)[0] == pytest.approx(20_000, abs=1)
        drives.advance(0.1)
        assert lane(drives, "omega_m")[0] == pytest.approx(20_000 / PPS, rel=0.02)
        assert drives.read(0x2122)[0] == pytest.approx(20_000, rel=0.05)


@pytest.mark.parametrize("sensor", [-1, 0])
def test_homing_here_moves_nothing(sensor):
    with build(parameters=DAMPED) as drives:
        drives.write(0x606A, sensor)
        hold(drives)
        motion.move_to(drives, 5000)
        drives.advance(0.1)
        before = lane(drives, "theta_m")[0]
        drives.write(0x6098, 35)
        motion.select_mode(drives, "hm")
        drives.write(0x6040, 0x1F)
        drives.advance(0.1)
        assert abs(drives.read(0x6064)[0]) <= (1 if sensor < 0 else 3)  # an encoder's count is 1.3 microsteps
        assert lane(drives, "theta_m")[0] == pytest.approx(before, abs=1e-5)


def test_a_jammed_rotor_does_not_stop_the_steps():
    """What an open loop does: the ramp runs on, and only the encoder knows."""
    with build(parameters=DAMPED) as drives:
        motion.enable(drives, mode="pv")
        drives.machine.fault("jam", torque=10.0)
        drives.write(0x60FF, 20_000)
        drives.advance(0.5)
        assert drives.read(0x6041)[0] & 0x0400
        assert drives.read(0x6063)[0] > 5000
        assert abs(lane(drives, "theta_m")[0]) < FULL_STEP
        drives.write(0x606A, 0)
        drives.advance(0.001)
        assert abs(drives.read(0x6064)[0]) < 256
        assert drives.emergencies() == []


def test_a_disabled_motor_keeps_its_count_and_can_be_turned_by_hand():
    with build(parameters=DAMPED) as drives:
        hold(drives)
        motion.move_to(drives, 3000)
        motion.disable(drives)
        drives.advance(0.05)
        drives.machine.load_torque = 0.01
        drives.advance(0.2)
        assert lane(drives, "omega_m")[0] > 1.0
        assert drives.read(0x6063)[0] == 3000
        assert np.all(lane(drives, "i_a") == 0.0)


def test_an_encoder_that_is_wired_backwards_is_set_right():
    parameters = DAMPED | {"motor.encoder_direction": 1.0}
    with build(num_machines=2, parameters=parameters) as drives:
        drives.write((0x200B, 2), [0, 1])
        drives.write(0x606A, 0)
        hold(drives)
        drives.write(0x607A, 10_000)
        drives.write(0x6040, 0x1F)
        drives.advance(1.0)
        np.testing.assert_allclose(drives.read(0x6064), [-10_000, 10_000], atol=5)


def test_a_motor_without_encoder_reads_nothing_from_it():
    with build(parameters=DAMPED) as drives:
        set_lanes(drives.inside.records, "encoder_counts", np.zeros(1))
        drives.inside.objects.restart(np.ones(1, bool))
        drives.write(0x606A, 0)
        hold(drives)
        drives.write(0x607A, 10_000)
        drives.write(0x6040, 0x1F)
        drives.advance(0.5)
        assert drives.read(0x6063)[0] == 10_000
        assert drives.read(0x6064)[0] == 0
