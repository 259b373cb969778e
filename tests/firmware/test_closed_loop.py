"""Load angle control of a stepper: no step is lost, current follows the load angle, an overload is caught up with.

Closed forms: torque = T_hold sin(load angle), at most at 2027h; while it catches up the rotor turns 202Fh faster than
the ramp; the scale of the current is a straight line of the load angle.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.closed_loop_rig import RECIPE, build, close_loop
from rigs.stepper_rig import MICROSTEPS, SMOOTH, holding_torque, lane

from drive_env import motion
from drive_env.emulator.loop_trace import trace_loops
from drive_env.firmware.record import set_lanes
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
PPS = MICROSTEPS / (2.0 * math.pi)  # microsteps per rad
DAMPED = SMOOTH | {"motor.viscous": MOTOR.viscous}
# An overload drives the motor as a generator: a supply that takes power back keeps the link within its limits.
STIFF = SMOOTH | {"motor.viscous": 5.0 * MOTOR.viscous}
SINKS = DAMPED | {"stage.supply_sinks": 1.0}
CONSTANT_CURRENT = RECIPE | {0x2029: 255}


def lead(drives):
    """Return by how much the field leads the rotor, electrical [degrees], as it is and not as the drive counts it."""
    field = np.arctan2(lane(drives, "sin_ref"), lane(drives, "cos_ref"))
    ahead = field - 50.0 * lane(drives, "theta_m")
    return np.degrees(np.mod(ahead + math.pi, 2.0 * math.pi) - math.pi)


# --- initialisation -----------------------------------------------------------------------------------------------
def test_the_loop_closes_once_the_held_rotor_has_come_to_rest():
    """2120h reads 1 then; 2028h is what lies between steps and encoder, and nothing moves."""
    with build(num_machines=2) as drives:
        drives.machine.load_torque = np.array([0.0, 0.03])  # turns the second motor before it is switched on
        drives.advance(0.3)
        drives.machine.load_torque = 0.0
        drives.advance(0.5)
        motion.enable(drives, mode="pp")
        drives.advance(0.2)
        turned = lane(drives, "theta_m")
        drives.write(0x2020, 1)
        drives.advance(0.2)
        np.testing.assert_array_equal(drives.read(0x2120), 0)
        drives.advance(0.5)
        np.testing.assert_array_equal(drives.read(0x2120), 1)
        np.testing.assert_allclose(lane(drives, "theta_m"), turned, atol=1e-4)
        np.testing.assert_allclose(drives.read(0x2028), -turned * PPS, atol=2.0)
        assert abs(turned[1]) > 2.0 * math.pi
        # From now on the encoder's position is that of the steps.
        np.testing.assert_allclose(drives.read(0x6064), drives.read(0x6062), atol=2.0)
        drives.write(0x2020, 0)
        drives.advance(0.01)
        np.testing.assert_array_equal(drives.read(0x2120), 0)
        np.testing.assert_allclose(lane(drives, "theta_m"), turned, atol=1e-4)


def test_the_loop_waits_for_a_ramp_to_end_and_a_move_for_the_loop():
    with build() as drives:
        motion.enable(drives, mode="pp")
        drives.write(0x6081, 20_000)
        motion.start_move(drives, 10_000)
        drives.advance(0.2)
        drives.write(0x2020, 1)
        drives.advance(0.5)
        assert drives.read(0x2120)[0] == 0
        drives.advance(1.5)
        assert drives.read(0x6062)[0] == 10_000
        assert drives.read(0x2120)[0] == 1


def test_without_an_encoder_there_is_no_loop():
    with build(recipe=RECIPE | {0x606A: -1}) as drives:
        motion.enable(drives, mode="pp")
        drives.write(0x2020, 1)
        drives.advance(4.0)
        assert drives.read(0x2120)[0] == 0
        drives.write(0x606A, 0)
        drives.advance(0.6)
        assert drives.read(0x2120)[0] == 1


def test_enabling_again_moves_nothing_that_was_turned_by_hand():
    """The steps are where the encoder is while the stage is off, and so is the field."""
    with build(num_machines=3) as drives:
        close_loop(drives, [1, 2, 3])
        motion.disable(drives)
        drives.machine.load_torque = 0.03
        drives.advance(0.5)
        drives.machine.load_torque = 0.0
        drives.advance(0.5)
        turned = lane(drives, "theta_m")
        assert np.all(turned > 2.0 * math.pi)
        motion.enable(drives, mode="pp")
        drives.advance(0.3)
        moved = (lane(drives, "theta_m") - turned) * PPS
        assert abs(moved[0]) < 3.0
        assert np.all(np.abs(moved) < 520.0)  # a PID does not commutate: to the next place of the field, two full steps
        assert np.all(np.abs(drives.read(0x6064) - turned * PPS) < 520.0)


# --- load angle ---------------------------------------------------------------------------------------------------
def test_below_the_limit_it_is_an_open_loop_and_at_it_the_torque_is_the_motors_greatest():
    shares = np.array([0.3, 0.7, 0.95])
    with build(recipe=CONSTANT_CURRENT, num_machines=3) as drives:
        close_loop(drives)
        amplitude = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))[0]
        torque = holding_torque(MOTOR, amplitude)
        drives.machine.load_torque = -0.8 * shares * torque
        drives.advance(0.3)
        drives.machine.load_torque = -shares * torque
        drives.advance(0.4)
        np.testing.assert_allclose(np.sin(np.radians(lead(drives))), shares, atol=0.005)
        np.testing.assert_allclose(drives.read(0x6077), 1000.0 * amplitude * shares, rtol=0.02)
        # Held at the limit by a jammed rotor and a target far away.
        drives.machine.load_torque = 0.0
        drives.machine.fault("jam", torque=10.0)
        drives.write(0x2027, [255, 128, 64])
        motion.start_move(drives, 5_000)
        drives.advance(1.5)
        np.testing.assert_allclose(lead(drives), np.array([255, 128, 64]) * 360.0 / 1024.0, atol=0.7)
        held = holding_torque(MOTOR, np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))[0])
        np.testing.assert_allclose(lane(drives, "tau_m"), held * np.sin(np.radians([89.65, 45.0, 22.5])), rtol=0.03)


def test_gain_stiffens_the_axis_beyond_its_tolerance():
    """2021h = 2 leads by twice the deviation: half of it for the same torque; within 2022h the gain is 1."""
    recipe = CONSTANT_CURRENT | {0x2022: 0}
    with build(recipe=recipe, parameters=STIFF, num_machines=3) as drives:
        drives.write(0x2021, [65_536, 131_072, 131_072])
        drives.write(0x2022, [0, 0, 255])
        close_loop(drives)
        drives.machine.load_torque = -0.4 * MOTOR.rated_torque
        drives.advance(3.0)
        behind = -lane(drives, "theta_m") * PPS
        np.testing.assert_allclose(lead(drives), lead(drives)[0], rtol=0.02)
        assert behind[1] == pytest.approx(0.5 * behind[0], rel=0.03)
        assert behind[2] == pytest.approx(behind[0], rel=0.02)


def overload(drives, torque, seconds, load):
    """Push axes backwards for a time; return how far behind the ramp they are then [microsteps]."""
    drives.machine.load_torque = -load * torque
    drives.advance(seconds)
    drives.machine.load_torque = 0.0
    return drives.read(0x6062) - drives.read(0x6064)


def test_an_overload_that_loses_steps_in_open_loop_is_caught_up_with_in_closed_loop():
    with build(parameters=SINKS, num_machines=2) as drives:
        drives.write(0x2020, [1, 0])
        motion.enable(drives, mode="pp")
        drives.advance(0.6)
        np.testing.assert_array_equal(drives.read(0x2120), [1, 0])
        drives.write(0x6081, 40_000)
        drives.write(0x6083, 200_000)
        motion.start_move(drives, 40_000)
        drives.advance(0.3)
        behind = overload(drives, MOTOR.rated_torque, 0.05, 1.2)
        assert np.all(behind > 2_000)
        drives.advance(3.0)
        assert drives.emergencies() == []
        np.testing.assert_array_equal(drives.read(0x6062), 40_000)
        position = drives.read(0x6064)
        assert abs(position[0] - 40_000) <= 2
        # In open loop the rotor rests whole slips away, where the angle of the field is the same.
        lost = 40_000 - position[1]
        assert lost > 1_000
        assert lost % 1024 == pytest.approx(0, abs=4) or lost % 1024 == pytest.approx(1024, abs=4)
        assert drives.read(0x6041)[1] & 0x0400


@pytest.mark.parametrize("limit", [20_000, 100_000])
def test_the_axis_catches_up_faster_than_its_ramp_by_the_limit_of_the_correction(limit):
    with build(recipe=RECIPE | {0x202F: limit}, parameters=SINKS) as drives:
        close_loop(drives, operation="pv")
        drives.write(0x6083, 200_000)
        drives.write(0x60FF, 30_000)
        drives.advance(0.3)
        assert overload(drives, MOTOR.rated_torque, 0.1, 1.2)[0] > 2 * limit
        drives.advance(1.0)
        speed = trace_loops(drives, ["omega_m"], 0.2).signals["omega_m"].mean() * PPS
        assert speed == pytest.approx(30_000 + limit, rel=0.01)


def test_the_pi_slows_the_axis_down_on_its_way_to_the_ramp():
    """With P alone the velocity that is added is e P / 256: the deviation falls exponentially with 256 / P seconds."""
    p = 1024
    with build(recipe=RECIPE | {0x202B: p, 0x202C: 0, 0x202F: 2**31 - 1, 0x2022: 0}, parameters=SINKS) as drives:
        close_loop(drives)
        before = overload(drives, MOTOR.rated_torque, 0.06, 1.2)[0]
        assert before > 20_000
        drives.advance(0.5)
        first = drives.read(0x6062)[0] - drives.read(0x6064)[0]
        drives.advance(0.5)
        second = drives.read(0x6062)[0] - drives.read(0x6064)[0]
        assert second / first == pytest.approx(math.exp(-0.5 * p / 256), rel=0.05)
        # The integral part makes it faster.
        drives.write(0x202C, 100)
        drives.write(0x202D, 32_767)
        drives.advance(0.3)
        third = drives.read(0x6062)[0] - drives.read(0x6064)[0]
        assert third < 0.7 * second * math.exp(-0.3 * p / 256)


def test_a_traced_loop_runs_as_any_other():
    """Signals of every window come from the same run, to the bit."""
    ends = []
    for traced in (False, True):
        with build(parameters=SINKS) as drives:
            close_loop(drives, operation="pv")
            drives.write(0x60FF, 30_000)
            drives.advance(0.3)
            overload(drives, MOTOR.rated_torque, 0.05, 1.2)
            if traced:
                trace_loops(drives, ["omega_m"], 0.2)
            else:
                drives.advance(0.2)
            ends.append([lane(drives, name)[0] for name in ("theta_m", "field_position", "step_position", "u_dc")])
    assert ends[0] == ends[1]


# --- current ------------------------------------------------------------------------------------------------------
def test_the_scale_of_the_current_is_a_straight_line_of_the_load_angle():
    shares = np.array([0.0, 0.25, 0.5, 0.8])
    with build(parameters=STIFF, num_machines=4) as drives:
        close_loop(drives)
        drives.machine.load_torque = -0.9 * shares * MOTOR.rated_torque
        drives.advance(0.5)
        angle = np.abs(lead(drives))
        expected = 50 + (255 - 50) * angle / (255 * 360 / 1024)
        np.testing.assert_allclose(drives.read(0x2033), expected, atol=1.6)
        size = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))
        share = (np.floor(expected) + 1.0) / 256.0
        np.testing.assert_allclose(size / MOTOR.rated_current, share, rtol=0.06)
        # Torque for the load: at a smaller current the angle is larger.
        ratio = holding_torque(MOTOR, size[1]) * math.sin(math.radians(angle[1]))
        assert ratio == pytest.approx(0.9 * 0.25 * MOTOR.rated_torque, rel=0.02)


def test_without_a_load_the_loop_saves_the_copper_loss_of_its_current():
    """Loss is with the square of the current: (51/256)^2 at 2029h = 50."""
    with build(num_machines=2) as drives:
        drives.write(0x2020, [1, 0])
        motion.enable(drives, mode="pp")
        drives.advance(1.0)
        square = np.zeros(2)
        for _ in range(50):
            drives.advance(0.01)
            square += lane(drives, "i_a") ** 2 + lane(drives, "i_b") ** 2
        losses = lane(drives, "R_s") * square / 50.0
        assert losses[0] / losses[1] == pytest.approx((51 / 256) ** 2, rel=0.15)
        assert drives.read(0x2033)[0] == 50


def test_coolstep_takes_its_steps_of_the_current_that_a_loop_has():
    """Down to half of 32 steps (2098h = 0) without a load: half the current of a loop that has it constant (2029h)."""
    with build(recipe=CONSTANT_CURRENT, num_machines=2) as drives:
        close_loop(drives, operation="pv")
        drives.write(0x6083, 400_000)
        drives.write(0x60FF, 2 * MICROSTEPS)
        drives.advance(1.0)
        before = np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))
        for index, value in ((0x2098, 0), (0x2099, 1), (0x209E, 12), (0x20A5, MICROSTEPS)):
            drives.write(index, value)
        drives.write(0x209C, [1, 0])
        drives.advance(1.5)
        share = np.hypot(lane(drives, "i_a"), lane(drives, "i_b")) / before
        np.testing.assert_allclose(share, [0.5, 1.0], atol=0.05)


@pytest.mark.parametrize(("up", "down"), [(1000, 10_000), (16_000, 32_000)])
def test_delays_of_the_scale_count_clocks_for_each_step(up, down):
    recipe = RECIPE | {0x2030: up, 0x2031: down, 0x2027: 64}
    with build(recipe=recipe) as drives:
        close_loop(drives)
        drives.advance(1.0)
        drives.machine.fault("jam", torque=10.0)
        drives.write(0x6081, 10**6)
        drives.write(0x6083, 10**7)
        begin = drives.read(0x2033)[0]
        motion.start_move(drives, 5_000)
        ms = max(int(100 * up / 16e3), 3)
        drives.advance(0.001 * (ms + 7))  # 7 ms: until the ramp is beyond the limit of the angle
        assert begin == 50
        risen = drives.read(0x2033)[0] - begin
        assert min(ms, 205 * up / 16e3) * 16e3 / up <= risen + 1
        assert risen <= min((ms + 7) * 16e3 / up, 205) + 1
        drives.advance(0.5)
        assert drives.read(0x2033)[0] == 255
        motion.start_move(drives, 0)
        drives.advance(0.2)
        # Straight down as its delay has it, until there is no load angle left.
        levels = [drives.read(0x2033)[0]]
        for _ in range(5):
            drives.advance(0.01)
            levels.append(drives.read(0x2033)[0])
        falls = -np.diff(levels)
        assert falls.max() <= 160e3 / down + 1.0


# --- field weakening ----------------------------------------------------------------------------------------------
def test_field_weakening_turns_the_motor_faster_than_its_back_emf_lets_it():
    """Torque-limited top speed without a load: with an angle above 90 degrees it is higher at the same supply."""
    recipe = CONSTANT_CURRENT | {0x2034: 150_000, 0x2035: 150_000, 0x202B: 0, 0x202C: 0}
    with build(recipe=recipe, num_machines=2, supply=24.0) as drives:
        drives.write(0x2036, [0, 220])
        close_loop(drives, operation="pv")
        drives.write(0x6083, 1_000_000)
        drives.write(0x60FF, 3_000_000)
        drives.advance(4.0)
        speed = lane(drives, "omega_m") * PPS
        assert speed[1] > 1.2 * speed[0]
        limits = np.degrees(lane(drives, "lead_limit") * 50.0)
        np.testing.assert_allclose(limits, [255 * 360 / 1024, 475 * 360 / 1024], atol=0.1)


@pytest.mark.parametrize(("speed", "added"), [(100_000, 0.0), (225_000, 0.5), (400_000, 1.0)])
def test_the_angle_grows_with_the_speed_above_its_beginning(speed, added):
    with build(recipe=CONSTANT_CURRENT | {0x2034: 150_000, 0x2035: 150_000, 0x2036: 200}, supply=60.0) as drives:
        close_loop(drives, operation="pv")
        drives.write(0x6083, 500_000)
        drives.write(0x60FF, speed)
        drives.advance(1.2)
        angle = np.degrees(lane(drives, "lead_limit")[0] * 50.0) * 1024 / 360
        assert angle == pytest.approx(255 + 200 * added, abs=3.0)


# --- torque -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("milliamperes", [0, 20, 100, 700, 1400, 5000, -600])
def test_cst_makes_the_torque_of_its_current(milliamperes):
    with build() as drives:
        close_loop(drives)
        motion.select_mode(drives, "cst")
        drives.machine.fault("jam", torque=10.0)
        drives.write(0x6071, milliamperes - 10)
        drives.write(0x60B2, 10)
        drives.advance(0.05)
        assert drives.read(0x6041)[0] & 0x1000
        asked = max(min(milliamperes * 1e-3, MOTOR.rated_current), -MOTOR.rated_current)
        torque = math.copysign(holding_torque(MOTOR, abs(asked)), asked) if asked else 0.0
        assert lane(drives, "tau_m")[0] == pytest.approx(torque, rel=0.05, abs=1e-3)
        assert drives.read(0x6077)[0] == pytest.approx(1000.0 * asked, rel=0.05, abs=2)


def test_cst_without_a_loop_holds_and_says_that_the_target_is_ignored():
    with build() as drives:
        motion.enable(drives, mode="cst")
        drives.advance(0.2)
        before = lane(drives, "theta_m")[0]
        drives.write(0x6071, 1000)
        drives.advance(0.3)
        assert not drives.read(0x6041)[0] & 0x1000
        assert lane(drives, "theta_m")[0] == pytest.approx(before, abs=1e-5)


def test_a_stop_out_of_cst_begins_with_the_motion_there_is():
    with build(parameters=SINKS) as drives:
        close_loop(drives)
        motion.select_mode(drives, "cst")
        drives.write(0x6084, 400_000)
        drives.write(0x6085, 400_000)
        drives.write(0x6071, 300)
        drives.advance(0.05)
        turning = lane(drives, "omega_m")[0] * PPS
        assert turning > 50_000
        drives.write(0x605A, 6)
        drives.write(0x6040, 0x0B)
        drives.advance(round(0.5 * turning / 400_000, 3))
        assert lane(drives, "omega_m")[0] * PPS == pytest.approx(0.5 * turning, rel=0.15)
        drives.advance(round(0.6 * turning / 400_000, 3) + 0.2)
        assert abs(lane(drives, "omega_m")[0] * PPS) < 500
        assert drives.emergencies() == []


# --- what goes wrong ----------------------------------------------------------------------------------------------
def test_a_deviation_beyond_its_window_stops_the_axis_in_a_loop_too():
    with build(parameters=SINKS, num_machines=2) as drives:
        drives.write(0x6065, [4_000, 0])
        close_loop(drives, operation="pv")
        drives.write(0x6085, 10**7)
        drives.write(0x60FF, 20_000)
        drives.advance(0.3)
        overload(drives, MOTOR.rated_torque, 0.03, 1.2)
        drives.advance(0.5)
        assert [(m.axis, m.code) for m in drives.emergencies()] == [(0, 0x8611)]
        np.testing.assert_array_equal(drives.read(0x6041) & 0x4F, [0x08, 0x07])
        assert abs(lane(drives, "omega_m")[0]) < 0.1


@pytest.mark.every(6)
@pytest.mark.parametrize("mode", [1, 2, 3])
@pytest.mark.parametrize("failure", ["encoder_broken", "encoder_stuck", "encoder_reversed"])
def test_an_encoder_that_fails_in_a_loop_does_not_let_the_motor_run_away(mode, failure):
    """The deviation grows with the ramp, and 6065h stops the axis before it is far."""
    recipe = RECIPE | {0x202F: 30_000} if mode == 1 else RECIPE | {0x202B: 8000, 0x202C: 500, 0x202D: 400,
                                                                  0x202F: 30_000, 0x2021: 0, 0x2022: 20}  # fmt: skip
    with build(recipe=recipe) as drives:
        drives.write(0x6065, 3_000)
        close_loop(drives, mode, operation="pv")
        drives.write(0x6085, 10**6)
        drives.write(0x60FF, 10_000)
        drives.advance(0.4)
        if failure == "encoder_broken":
            set_lanes(drives.inside.records, failure, np.ones(1))
        else:
            drives.machine.fault(failure)
        begin = lane(drives, "theta_m")[0] * PPS
        farthest, codes = 0.0, []
        for _ in range(1_500):
            drives.advance(0.001)
            farthest = max(farthest, abs(lane(drives, "theta_m")[0] * PPS - begin))
            codes += [m.code for m in drives.emergencies()]
        assert 0x8611 in codes
        assert drives.read(0x6041)[0] & 0x4F == 0x08
        assert abs(lane(drives, "omega_m")[0]) * PPS < 100
        # Load angle control holds the rotor where the encoder stands still, a slip or two away, or swings up against
        # one that counts backwards, and coasts for a turn without friction; a PID runs until the window's end.
        held = 50_000 + 10_240 if failure == "encoder_reversed" else 2_048
        assert farthest < (held if mode == 1 else 3_000 * (1 + 30_000 / 10_000) + 1_024)


def test_limits_of_travel_hold_while_the_axis_catches_up():
    with build(parameters=SINKS) as drives:
        drives.write((0x607D, 2), 30_000)
        close_loop(drives)
        drives.write(0x6081, 40_000)
        drives.write(0x6083, 400_000)
        motion.start_move(drives, 50_000)
        drives.advance(0.2)
        overload(drives, MOTOR.rated_torque, 0.05, 1.2)
        highest = 0
        for _ in range(300):
            drives.advance(0.01)
            highest = max(highest, drives.read(0x6064)[0])
        assert drives.read(0x6064)[0] == pytest.approx(30_000, abs=3)
        assert highest < 30_000 + 255
        assert drives.read(0x6041)[0] & 0x0800
