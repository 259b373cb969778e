"""Commutation: the angle sources of 2055h, their settings and wiring, the encoder's initialisation, motor types.

Torque of a rotor held at the electrical angle x, with the current along the angle y: K_t i cos(y - x).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.firmware.servo import alignment
from drive_env.motors import MOTORS

MOTOR = MOTORS["qbl4208"]
N_P, K_T = MOTOR.n_p, MOTOR.torque_constant
FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
HELD = {"load.coulomb": 2.0, "load.breakaway": 2.0}  # N*m
TURN = 65536
DISABLED, OPEN_LOOP, HALL, ENCODER = range(4)
HALL_POLARITY, HALL_DIRECTION, HALL_INTERPOLATION, HALL_OFFSET = ((0x2070, k) for k in range(1, 5))
ENCODER_DIRECTION, ENCODER_STEPS, ENCODER_INIT = ((0x2080, k) for k in range(1, 4))
ESTIMATE_OFFSET, USE_OFFSET, USE_HALL = range(3)
STOP_MODE, MODULE_INITIALIZED, INITIALIZATION_ERROR = 1 << 8, 1 << 15, 1 << 7  # 2101h, table 85


@pytest.fixture
def build():
    made = []

    def new(num_machines=1, parameters=FREE, **options):
        drives = EmulatedDrives(
            load="inertia", num_machines=num_machines, num_threads=1,
            parameters=parameters, **{"ideal": True, **options},
        )  # fmt: skip
        made.append(drives)
        return drives

    yield new
    for drives in made:
        drives.close()


def lanes(drives, name):
    return get_lanes(drives.inside.records, name, drives.num_axes).astype(float)


def place(drives, electrical):
    """Turn the rotors to electrical angles [rad] by hand, and switch the drives off and on there."""
    angle = np.broadcast_to(np.asarray(electrical, float), drives.num_axes) / drives.motor.n_p
    drives.inside.groups[0].load.plant.qpos[:] = angle
    set_lanes(drives.inside.records, "theta_m", angle)
    drives.machine.power_cycle()


def wrapped(angle):
    """Return an angle [rad] within +-pi."""
    return np.angle(np.exp(1j * np.asarray(angle)))


def rotor_angle(drives):
    return drives.motor.n_p * drives.machine.rotor_angle


def to_pps(omega):
    return np.rint(np.asarray(omega) / (2.0 * math.pi) * TURN).astype(int)


def torque_factor(drives, current=1.0):
    """Return the torque of held rotors at a commanded current, as a multiple of K_t i."""
    motion.enable(drives, mode="cst")
    drives.write("Target torque", round(current * 1000))
    drives.advance(0.03)
    return drives.machine.motor_torque / (K_T * current)


# --- 2055h and 2050h: which stage drives which motor --------------------------------------------------------------
def turns(drives, omega=50.0):
    """Return whether the motor follows a speed; what does not follow may carry no current at all."""
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(omega))
    drives.advance(0.3)
    follows = abs(drives.machine.rotor_speed[0] - omega) < 0.05 * omega
    if not follows:
        assert lanes(drives, "i_d")[0] == 0.0
        assert lanes(drives, "i_q")[0] == 0.0
        assert drives.machine.rotor_angle[0] == 0.0
    return follows


@pytest.mark.parametrize(
    ("motor", "motor_type", "commutation", "expected"),
    [
        ("qbl4208", 3, ENCODER, True),
        ("qbl4208", 3, HALL, True),
        ("qbl4208", 3, DISABLED, False),
        ("qbl4208", 0, ENCODER, False),  # 2050h: no motor
        ("qbl4208", 1, ENCODER, False),  # set for two legs, three phases connected
        ("re_40", 1, ENCODER, True),
        ("re_40", 1, DISABLED, True),  # a brushed motor commutates itself
        ("re_40", 0, ENCODER, False),
        ("re_40", 3, ENCODER, False),
    ],
)
def test_motor_type_and_commutation_mode_decide_whether_current_flows(build, motor, motor_type, commutation, expected):
    drives = build(motor=motor)
    drives.write(0x2050, motor_type)
    drives.write(0x2055, commutation)
    assert turns(drives) == expected


@pytest.mark.parametrize("motor", ["qbl4208", "re_40"])
def test_shaft_direction_reverses_motion_and_readings_together(build, motor):
    drives = build(2, motor=motor)
    drives.write(0x2057, [0, 1])
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(100.0))
    drives.advance(0.3)
    np.testing.assert_allclose(drives.machine.rotor_speed, [100.0, -100.0], rtol=0.02)
    assert np.all(drives.read(0x606C) > 0)
    assert np.all(drives.read(0x6064) > 0)
    # 6077h too is the user's: against a torque that brakes the true rotation.
    drives.machine.load_torque = [-0.05, 0.05]
    drives.advance(0.3)
    assert np.all(drives.read(0x6077) > 0)


# --- open loop ----------------------------------------------------------------------------------------------------
def test_open_loop_holds_with_its_load_angle_and_slips_above_the_holding_torque(build):
    """2004h along the angle 2102h: torque 1.5 n_p psi i sin(lag), so lag = asin(tau / tau_max) electrical."""
    share = np.array([0.0, 0.3, 0.6, 0.9, -0.3, -0.9, 1.2, -1.2])
    drives = build(8, parameters={**FREE, "load.viscous": 5e-4})
    drives.write(0x2055, OPEN_LOOP)
    drives.write(0x2004, 2000)
    motion.enable(drives, mode="pv")
    for k in range(1, 41):
        drives.machine.load_torque = share * K_T * 2.0 * k / 40
        drives.advance(0.02)
    drives.advance(0.3)
    lag = rotor_angle(drives) - lanes(drives, "angle_open_loop")
    held = np.abs(share) < 1.0
    np.testing.assert_allclose(lag[held], np.arcsin(share[held]), atol=math.radians(1.5))
    assert np.all(lag[~held] * share[~held] > 4.0 * math.pi)  # slipped by turns, the way the load pulls


def test_open_loop_follows_its_demand_like_a_stepper_and_stalls_when_asked_too_fast(build):
    """Synchronous as long as the torque suffices for the ramp, without an encoder; beyond that it falls out of step."""
    drives = build(3, parameters={**FREE, "load.viscous": 2e-4})
    drives.write(0x2055, OPEN_LOOP)
    drives.write(0x2004, 2000)
    drives.write(0x6065, 0)
    set_lanes(drives.inside.records, "encoder_broken", np.ones(3))
    motion.enable(drives, mode="pv")
    drives.write(0x6083, [to_pps(50.0), to_pps(50.0), 2**31 - 1])
    drives.write(0x60FF, to_pps([10.0, -20.0, 300.0]))
    drives.advance(0.6)
    before = drives.machine.rotor_angle
    drives.advance(1.0)
    speed = drives.machine.rotor_angle - before
    np.testing.assert_allclose(speed[:2], [10.0, -20.0], rtol=0.01)
    assert abs(speed[2]) < 60.0


def test_open_loop_current_is_that_of_2004h_within_2003h(build):
    drives = build(3)
    drives.write(0x2055, OPEN_LOOP)
    drives.write(0x2003, 3000)
    drives.write(0x2004, [500, 2000, 5000])
    motion.enable(drives, mode="pv")
    drives.advance(1.0)
    np.testing.assert_allclose(np.hypot(lanes(drives, "i_d"), lanes(drives, "i_q")), [0.5, 2.0, 3.0], rtol=0.02)


# --- digital hall -------------------------------------------------------------------------------------------------
def around(n=48):
    """Angles over an electrical turn, in the middle of equal parts: no edge, each sector alike."""
    return (np.arange(n) + 0.5) * (2.0 * math.pi / n)


@pytest.mark.parametrize(
    ("true_polarity", "polarity", "true_direction", "direction", "true_offset", "offset", "turned"),
    [
        (0, 0, 0, 0, 0, 0, 0.0),
        (1, 1, 0, 0, 0, 0, 0.0),
        (1, 0, 0, 0, 0, 0, 180.0),
        (0, 1, 0, 0, 0, 0, 180.0),
        (0, 0, 1, 1, 0, 0, 0.0),
        (1, 1, 1, 1, 90, 90, 0.0),
        (0, 0, 0, 0, 30, 30, 0.0),
        (0, 0, 0, 0, 45, 0, 45.0),
        (0, 0, 0, 0, 0, -60, 60.0),
    ],
)
def test_hall_torque_has_the_ripple_of_its_sectors(
    build, true_polarity, polarity, true_direction, direction, true_offset, offset, turned
):
    """Current along the sector's middle, 30 degrees off at most: mean factor 3/pi, turned by what is set wrong."""
    wired = {"motor.hall_polarity": true_polarity, "motor.hall_direction": true_direction}
    drives = build(48, parameters={**HELD, **wired, "motor.hall_offset": math.radians(true_offset)})
    place(drives, around() - math.radians(true_offset))
    drives.write(0x2055, HALL)
    drives.write(HALL_POLARITY, polarity)
    drives.write(HALL_DIRECTION, direction)
    drives.write(HALL_INTERPOLATION, 0)
    drives.write(HALL_OFFSET, round(offset / 360 * TURN))
    drives.advance(0.01)
    factor = torque_factor(drives)
    x = around()
    middle = (np.floor(x / (math.pi / 3)) + 0.5) * (math.pi / 3)
    np.testing.assert_allclose(factor, np.cos(middle - x + math.radians(turned)), atol=0.01)
    assert np.mean(factor) == pytest.approx(3.0 / math.pi * math.cos(math.radians(turned)), abs=0.005)


def test_halls_wired_in_reverse_turn_nothing(build):
    """The angle runs backwards: the torque's mean over a turn is zero."""
    drives = build(48, parameters={**HELD, "motor.hall_direction": 1})
    place(drives, around())
    drives.write(0x2055, HALL)
    drives.advance(0.01)
    factor = torque_factor(drives)
    assert abs(np.mean(factor)) < 0.02
    assert factor.max() > 0.8
    assert factor.min() < -0.8


def test_interpolation_takes_the_ripple_out_of_the_angle(build):
    """At constant speed the interpolated angle is within 2 degrees, the other within half a sector."""
    drives = build(2)
    drives.write(0x2055, HALL)
    drives.write(HALL_INTERPOLATION, [0, 1])
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(200.0))
    drives.advance(0.5)
    errors = []
    for _ in range(60):
        drives.advance(0.001)
        errors.append(wrapped(lanes(drives, "angle_hall") - rotor_angle(drives)))
    worst = np.degrees(np.max(np.abs(errors), axis=0))
    # An angle is known as of the tick's start: the rotor turns 2 degrees in a tick.
    assert 25.0 < worst[0] < 33.0
    assert worst[1] < 4.0


@pytest.mark.parametrize("omega", [60.0, 300.0, -300.0])
def test_speed_from_halls_is_within_2_percent_at_constant_speed(build, omega):
    drives = build(1)
    drives.write(0x2055, HALL)
    drives.write(HALL_INTERPOLATION, 1)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(omega))
    drives.advance(0.6)
    angle = drives.machine.rotor_angle[0]
    trace = drives.record([0x606C], 0.2)
    true = (drives.machine.rotor_angle[0] - angle) / 0.2
    assert true == pytest.approx(omega, rel=0.02)
    assert np.mean(trace[0x606C]) * 2.0 * math.pi / TURN == pytest.approx(true, rel=0.02)


def test_an_edge_that_is_crossed_back_is_no_speed(build):
    """A rotor that trembles about the edge between two sectors passes none."""
    drives = build(1)
    drives.write(0x2055, HALL)
    motion.enable(drives, mode="cst")
    edge = -lanes(drives, "hall_true_offset")[0]
    sectors, speeds = [], []
    for k in range(100):
        drives.inside.groups[0].load.plant.qpos[:] = (edge + (0.02 if k % 2 else -0.02)) / N_P
        drives.advance(0.002)
        sectors.append(lanes(drives, "hall_sector")[0])
        speeds.append(drives.read(0x606C)[0])
    assert np.all(np.abs(np.diff(sectors)) == 1.0)
    assert np.abs(speeds).max() == 0


@pytest.mark.parametrize(("omega", "least"), [(12.0, 0.6), (-20.0, 0.9), (60.0, 0.98)])
def test_a_slow_axis_under_halls_advances(build, omega, least):
    """It stood, trembling about an edge, while 606Ch told what was asked for; a slow one still goes in jerks."""
    drives = build(1)
    drives.write(0x2055, HALL)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(omega))
    drives.advance(1.0)
    start = drives.machine.rotor_angle[0]
    drives.advance(2.0)
    assert least < (drives.machine.rotor_angle[0] - start) / 2.0 / omega < 1.02


def test_position_comes_from_the_halls_unless_always_use_encoder_is_set(build):
    """24 steps per turn of four pole pairs, or the encoder's 4096 (2043h:03)."""
    drives = build(2)
    drives.write(0x2055, HALL)
    drives.write((0x2043, 3), [0, 1])
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(30.0))
    trace = drives.record([0x6064], 1.0)
    steps = [np.unique(trace[0x6064][:, axis]) for axis in (0, 1)]
    sector = TURN / (6 * N_P)
    np.testing.assert_allclose(steps[0] / sector, np.rint(steps[0] / sector), atol=1e-3)
    np.testing.assert_allclose(trace[0x6064][-1, 0], drives.machine.rotor_angle[0] / (2 * math.pi) * TURN, atol=2500)
    assert len(steps[1]) > 3 * len(steps[0])
    np.testing.assert_allclose(trace[0x6064][-1, 1], drives.machine.rotor_angle[1] / (2 * math.pi) * TURN, atol=400)


# --- encoder and its initialisation -------------------------------------------------------------------------------
def test_estimate_offset_turns_the_rotor_and_finds_the_angle_from_everywhere(build):
    """Ordinary motors: friction and cogging leave a few degrees."""
    drives = build(16, parameters=None, ideal=False)
    drives.write(ENCODER_INIT, ESTIMATE_OFFSET)
    start = np.arange(16) * (2.0 * math.pi / 16)
    drives.machine.set("motor.commutation_offset", np.linspace(-3.0, 3.0, 16))  # what was known before is wrong
    place(drives, start)
    drives.write(ENCODER_INIT, ESTIMATE_OFFSET)
    assert np.all(drives.read(0x2101) & MODULE_INITIALIZED)  # the module's, not the encoder's
    motion.enable(drives, mode="pv")
    assert np.all(drives.read(0x2101) & STOP_MODE)
    states, angles = [], []
    for _ in range(30):
        drives.advance(0.05)
        states.append(lanes(drives, "init_state"))
        angles.append(rotor_angle(drives))
    states, angles = np.array(states), np.array(angles)
    assert np.all(states[0] == alignment.FIRST_ANGLE)
    assert np.all(states[-1] == alignment.DONE)
    assert np.all(drives.read(0x2101) & STOP_MODE == 0)
    # It stands a quarter electrical turn further than at the end of the first angle, where it still swings a little.
    last_first = np.argmax(states == alignment.SECOND_ANGLE, axis=0)[0]
    turned = np.degrees(angles[-1] - angles[last_first])
    assert np.all(np.abs(turned - 90.0) < 30.0)
    error = np.degrees(wrapped(lanes(drives, "angle_encoder") - rotor_angle(drives)))
    assert np.max(np.abs(error)) < 6.0
    drives.write(0x60FF, to_pps(100.0))
    drives.advance(0.4)
    np.testing.assert_allclose(drives.machine.rotor_speed, 100.0, rtol=0.05)
    assert drives.emergencies() == []


def test_estimate_offset_fails_when_blocked_and_is_tried_again_at_the_next_enabling(build):
    """Blocked by friction: 7305h, fault, 2101h bit 7; let go, reset and enabled again it succeeds."""
    drives = build(2, parameters=HELD)
    drives.machine.set("load.breakaway", [2.0, 0.003])
    drives.machine.set("load.coulomb", [2.0, 0.002])
    drives.write(ENCODER_INIT, ESTIMATE_OFFSET)
    drives.reset_node()  # 2080h:03 is not stored: what follows must set it again
    drives.write(ENCODER_INIT, ESTIMATE_OFFSET)
    motion.enable(drives, mode="pv")
    drives.advance(1.5)
    assert [(m.axis, m.code) for m in drives.emergencies()] == [(0, 0x7305)]
    status, flags = drives.read(0x6041), drives.read(0x2101)
    assert status[0] & 0x4F == 0x08
    assert status[1] & 0x6F == 0x27
    assert list(flags & INITIALIZATION_ERROR) == [INITIALIZATION_ERROR, 0]
    assert list(flags & STOP_MODE) == [STOP_MODE, 0]
    assert lanes(drives, "i_d")[0] == 0.0
    drives.machine.set("load.coulomb", 0.002)
    drives.machine.set("load.breakaway", 0.003)
    motion.enable(drives)
    drives.advance(1.5)
    assert np.all(drives.read(0x6041) & 0x6F == 0x27)
    assert np.all(drives.read(0x2101) & (STOP_MODE | INITIALIZATION_ERROR) == 0)
    assert [m.code for m in drives.emergencies()] == [0x0000]


def test_use_hall_is_right_within_half_a_sector(build):
    drives = build(48, parameters=HELD)
    drives.machine.set("motor.commutation_offset", 1.0)  # what was known before is wrong
    place(drives, around())
    drives.write(ENCODER_INIT, USE_HALL)
    drives.advance(0.01)
    factor = torque_factor(drives)
    error = wrapped(lanes(drives, "angle_encoder") - rotor_angle(drives))
    assert np.max(np.abs(error)) < math.radians(30.5)
    np.testing.assert_allclose(factor, np.cos(error), atol=0.01)
    assert factor.min() > math.cos(math.radians(30.5)) - 0.01


def test_use_offset_is_the_alignment_from_before(build):
    """The error that alignment left (a parameter of the machine) costs its cosine in torque."""
    drives = build(4, parameters=HELD)
    left = np.radians([0.0, 10.0, -30.0, 60.0])
    drives.machine.set("motor.commutation_offset", left)
    place(drives, [0.0, 1.0, 2.0, 3.0])
    drives.advance(0.01)
    assert np.all(lanes(drives, "init_state") == alignment.DONE)
    np.testing.assert_allclose(torque_factor(drives), np.cos(left), atol=0.01)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        (ENCODER_DIRECTION, 1 - MOTOR.encoder_direction),
        (0x2056, 1),
        (0x2056, 12),
        (ENCODER_STEPS, 2048),
        (ENCODER_STEPS, 40000),
    ],
    ids=["direction", "pole pairs too few", "pole pairs too many", "steps too few", "steps too many"],
)
def test_wrong_encoder_direction_pole_pairs_or_steps_end_in_a_fault(build, setting, value):
    """The motor runs away or stalls; beside it one that is set right runs on."""
    drives = build(2, parameters=None, ideal=False)
    drives.write(setting, value, where=np.array([True, False]))
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 10 * TURN)
    drives.advance(3.0)
    status = drives.read(0x6041)
    assert status[0] & 0x4F == 0x08
    assert {m.axis for m in drives.emergencies()} == {0}
    assert status[1] & 0x6F == 0x27
    assert drives.machine.rotor_speed[1] == pytest.approx(20.0 * math.pi, rel=0.05)


def test_the_three_angles_are_live(build):
    """2102h to 2104h while the encoder commutates: the ramp's angle, the encoder's, the halls', 65536 per turn."""
    drives = build(1)
    drives.machine.set("motor.commutation_offset", 0.0)
    drives.machine.power_cycle()
    drives.write(HALL_INTERPOLATION, 0)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(20.0))
    drives.advance(0.5)
    seen = []
    for _ in range(40):
        drives.advance(0.003)
        angles = [drives.read(index)[0] / TURN * 2.0 * math.pi for index in (0x2102, 0x2103, 0x2104)]
        seen.append([*angles, rotor_angle(drives)[0]])
    open_loop, encoder, halls, true = np.array(seen).T
    # A count is 0.35 degrees, and the rotor turns a fifth of one in a tick.
    assert np.max(np.abs(wrapped(encoder - true))) < math.radians(1.0)
    assert 20.0 < np.degrees(np.max(np.abs(wrapped(halls - true)))) < 31.0
    np.testing.assert_allclose(wrapped(np.diff(open_loop)), N_P * 20.0 * 0.003, atol=1e-3)


@pytest.mark.parametrize(
    ("always_use_encoder", "per_turn"),
    [(0, 6 * N_P), (1, MOTOR.encoder_counts)],  # section 4.1.21: "in encoder or hall increments"
)
def test_2140h_counts_with_the_sensor_that_tells_the_position(build, always_use_encoder, per_turn):
    drives = build(parameters=None)  # with friction: it comes to rest
    drives.write(0x2055, HALL)
    drives.write((0x2043, 3), always_use_encoder)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 5 * TURN)
    drives.advance(1.0)
    motion.disable(drives)
    drives.advance(0.5)
    position = int(drives.read(0x6064)[0])
    assert position > 2 * TURN
    drives.write(0x607C, 10 * TURN)  # not told, and method 35 does not use it
    drives.write(0x6098, 35)
    drives.write(0x6060, 6)
    drives.advance(0.002)
    drives.write(0x6040, 0x10)
    drives.advance(0.002)
    assert drives.read(0x6064)[0] == 0
    assert drives.read(0x2140)[0] == round(position / TURN * per_turn)
