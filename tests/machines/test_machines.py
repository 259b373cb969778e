"""The machines against closed forms: gravity, friction, backlash, efficiency, brakes, end stops, schedules."""

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from rigs.stepped_load import stepped

from drive_env import EmulatedDrives, motion
from drive_env.emulator.inertia_check import MisfitWarning
from mechanics.load import Friction, Load
from mechanics.loads import LOADS, find_load
from mechanics.packed import PackedLoad

pytestmark = pytest.mark.usefixtures("files_read_here")
TURN = 65536  # increments
H = 200e-6
G = 9.81
J_M = 4.8e-6  # of the default motor
RATED = 0.125  # N*m
PULLEY = 0.04 / (2 * math.pi)
LEAD = 0.005 / (2 * math.pi)
STILL = 1e-12  # rad/s

SLOPE = """
<mujoco model="slope">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body euler="0 30 0">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
    </body>
  </worldbody>
</mujoco>
"""


def drives_of(load, **options):
    """Return drives without the motor's faults, so that the load's closed form is all there is."""
    return EmulatedDrives(load=load, num_threads=1, **{"ideal": True, **options})


def watch(drives, duration, seen):
    """Let time pass a millisecond at a time; return what `seen` gives after each."""
    found = []
    for _ in range(round(duration / 1e-3)):
        drives.advance(1e-3)
        found.append(np.array(seen()))
    return np.array(found)


def run_at(drives, rpm, settle=0.5, measure=0.4):
    """Turn axis 0 in pv; return its mean torque and speed in a whole number of turns."""
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", round(rpm / 60 * TURN))
    drives.advance(settle)
    seen = watch(drives, measure, lambda: (drives.machine.motor_torque[0], drives.machine.rotor_speed[0]))
    return seen.mean(axis=0)


# --- dry friction holds -----------------------------------------------------------------------------------------------
def slope(tmp_path, friction):
    (tmp_path / "slope.xml").write_text(SLOPE)
    guide = Friction("guide", {"slide": 1.0}, coulomb=friction, breakaway=friction)
    return Load(tmp_path / "slope.xml", gear=1 / PULLEY, frictions=(guide,))


def test_coulomb_friction_holds_a_load_on_a_slope(tmp_path):
    """1 kg at 30 degrees pulls with 4.905 N; 5 N hold it: no creep, no chatter, for five seconds."""
    with drives_of(slope(tmp_path, 5.0)) as drives:
        start = drives.machine.joint_positions
        seen = watch(drives, 5.0, lambda: drives.machine.rotor_speed[0])
        assert np.abs(seen).max() == 0.0
        assert np.array_equal(drives.machine.joint_positions, start)


def test_less_friction_lets_it_slide_as_newton_says(tmp_path):
    with drives_of(slope(tmp_path, 4.0)) as drives:
        drives.advance(0.4)
        a = (G * math.sin(math.radians(30)) - 4.0) / (1.0 + J_M / PULLEY**2)
        assert abs(drives.machine.rotor_speed[0]) * PULLEY == pytest.approx(a * 0.4, rel=2e-3)


@pytest.mark.parametrize(("coulomb", "holds"), [(0.36, True), (0.34, False)])
def test_dry_friction_holds_an_arm_askew_up_to_its_gravity(coulomb, holds):
    """m g l sin(0.5) is 0.3527 N*m."""
    arm = replace(LOADS["arm"], start={"joint": 0.5})
    with drives_of(arm, parameters={"load.coulomb": coulomb, "load.breakaway": coulomb, "load.viscous": 0.0}) as drives:
        drives.advance(3.0)
        moved = abs(drives.machine.joint_positions[0, 0] - 0.5)
        assert (moved == 0.0) == holds
        if not holds:
            assert moved > 0.02


@pytest.mark.every(5)
@pytest.mark.parametrize("friction", ["none", "stribeck", "lugre"])
@pytest.mark.parametrize(("load", "force"), [("robot", 0.0), ("gantry", 20.0), ("vertical_screw", 0.0), ("belt", 10.0)])
def test_brakes_of_coupled_axes_hold_without_creep(load, force, friction):
    """Each brake's hold pushes at the other axes: they must find a balance together."""
    with drives_of(load, friction=friction) as drives:
        drives.machine.brake = "closed"
        drives.machine.load_torque = force
        drives.advance(0.5)
        before = drives.machine.joint_positions
        drives.advance(1.0)
        assert np.abs(drives.machine.joint_positions - before).max() < 1e-9
        assert np.abs(drives.machine.rotor_speed).max() < 1e-6


# --- backlash ---------------------------------------------------------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("load", "ratio", "gap", "turns", "friction", "stiffness"),
    [  # ratio: output per rotor angle; gap as a multiple of the row's; friction that the output needs
        ("geared_joint", 1 / 50, 1.0, 1.0, 0.05, 7000.0),
        ("geared_joint", 1 / 50, 3.0, 1.0, 0.05, 7000.0),
        ("ball_screw", LEAD, 1.0, 0.5, 3.0, 1e7),
        ("ball_screw", LEAD, 3.0, 0.5, 3.0, 1e7),
    ],
)
def test_the_hysteresis_of_a_slow_sine_is_the_backlash(load, ratio, gap, turns, friction, stiffness):
    """Rotor against output over a period; beyond the gap the friction bends teeth or screw by F/k to each side."""
    parameters = {"load.coulomb": friction, "load.breakaway": friction, "load.viscous": 0.0}
    with drives_of(load, parameters=parameters) as drives:
        backlash = gap * drives.machine.parameters["load.backlash"][0]
        drives.machine.set("load.backlash", backlash)
        motion.enable(drives, mode="csp")
        t = np.arange(2000) / 1000
        demand = np.round(turns * TURN * np.sin(np.pi * t)).astype(int)
        found = []
        for value in np.tile(demand, 2):
            drives.write(0x607A, value)
            drives.advance(1e-3)
            found.append(drives.machine.joint_positions[0])
    rotor, output = np.array(found)[2000:].T
    slip = output - ratio * rotor
    # Near the middle of the way, up and down: past every reversal, where the speed is greatest and steadiest.
    up, down = np.abs(t - 2.0) < 0.1, np.abs(t - 1.0) < 0.1
    up |= t < 0.1
    width = abs(np.median(slip[down]) - np.median(slip[up]))
    assert width == pytest.approx(backlash + 2 * friction / stiffness, rel=0.02)
    if gap > 1.0:
        assert width == pytest.approx(backlash, rel=0.02)


def test_without_backlash_there_is_no_hysteresis_but_the_teeth_s():
    with drives_of("geared_joint", parameters={"load.backlash": 0.0}) as drives:
        motion.enable(drives, mode="pp")
        seen = []
        for target in (TURN, 0):
            motion.move_to(drives, target)
            drives.advance(0.3)
            rotor, output = drives.machine.joint_positions[0]
            seen.append(output - rotor / 50)
        assert np.abs(seen).max() < 2 * 0.08 / 7000


# --- screws -----------------------------------------------------------------------------------------------------------
def test_a_screw_s_efficiency_costs_when_lifting_and_helps_when_lowering():
    """Lifting F takes F r / eta, lowering F r (2 - 1/eta): what eta < 1 loses is dry friction in proportion to F.

    Beside it the nut drags with 4 N + 20 v and the guide with 3 N + 20 v.
    """
    eta, v = 0.9, 600 / 60 * 0.005
    drag = 4.0 + 20 * v
    with drives_of("vertical_screw") as drives:
        lift, speed = run_at(drives, 600)
        assert speed == pytest.approx(2 * np.pi * 10, rel=2e-3)
        force = 4 * G + 3 + 20 * v
        assert lift == pytest.approx(LEAD * (force / eta + drag), rel=0.01)
    with drives_of("vertical_screw") as drives:
        lower, speed = run_at(drives, -600)
        assert speed == pytest.approx(-2 * np.pi * 10, rel=2e-3)
        force = 4 * G - 3 - 20 * v
        assert lower == pytest.approx(LEAD * (force * (2 - 1 / eta) - drag), rel=0.01)


@pytest.mark.parametrize("eta", [0.81, 0.97])
def test_efficiency_is_a_parameter(eta):
    with drives_of("vertical_screw", parameters={"load.efficiency": eta}) as drives:
        lift, _ = run_at(drives, 600)
    assert lift == pytest.approx(LEAD * ((4 * G + 4) / eta + 5), rel=0.01)


def fall(t, eta=0.9, mass=4.0):
    """Return the speed [m/s] of the table after falling for t [s].

    J/r^2 dv/dt = F (2 - 1/eta) - Fn, F = m (g - dv/dt) - Fg,
    Fn = 4 + 20 v and Fg = 3 + 20 v, so that v approaches its end exponentially.
    """
    passed = 2 - 1 / eta
    inertia = (6.4e-6 + J_M) / LEAD**2 + mass * passed
    slowing = 20 * (1 + passed) / inertia
    return ((mass * G - 3) * passed - 4) / inertia / slowing * (1 - math.exp(-slowing * t))


def test_a_vertical_screw_falls_when_the_stage_is_cut_and_the_brake_is_open():
    with drives_of("vertical_screw") as drives:
        assert drives.machine.brake.tolist() == ["open"]
        motion.enable(drives, mode="pp")
        drives.advance(0.3)
        assert abs(drives.machine.joint_positions[0, 1]) < 1e-4
        drives.machine.enable_input = False
        seen = watch(drives, 0.2, lambda: drives.machine.rotor_speed[0] * LEAD)
        # Break-away and Stribeck's rise cost it a little at first: compared from 0.1 s on.
        gained = seen[-1] - seen[99]
        t = -np.log(1 + seen[99] / fall(1e9)) / (fall(1e-9) / 1e-9 / fall(1e9))
        assert gained == pytest.approx(-(fall(t + 0.1) - fall(t)), rel=0.01)
        assert seen[-1] < -0.15


@pytest.mark.parametrize("brake", ["with_stage", "closed"])
def test_a_vertical_screw_holds_by_its_brake(brake):
    with drives_of("vertical_screw") as drives:
        if brake == "with_stage":
            drives.machine.brake = brake
            motion.enable(drives, mode="pp")
            motion.move_to(drives, 4 * TURN)  # the brake is open while the stage is on
            assert drives.machine.joint_positions[0, 1] == pytest.approx(0.02, abs=2e-4)
            motion.disable(drives)
        drives.machine.brake = brake
        drives.advance(0.2)
        before = drives.machine.joint_positions
        drives.advance(1.0)
        assert np.abs(drives.machine.joint_positions - before).max() < 1e-10
        assert abs(drives.machine.rotor_speed[0]) < STILL


def test_a_closed_brake_holds_against_the_motor_up_to_twice_its_rated_torque():
    for torque, holds in ((1.98 * RATED, True), (2.02 * RATED, False)):
        with drives_of("inertia", friction="none") as drives:
            drives.machine.brake = "closed"
            drives.machine.load_torque = torque
            drives.advance(0.5)
            assert (abs(drives.machine.rotor_speed[0]) < STILL) == holds


def test_a_brake_is_one_of_three_where_the_drive_has_no_output_for_it():
    with EmulatedDrives(load="gantry") as drives:
        with pytest.raises(ValueError, match="a brake of tmcm1636 is open, closed, with_stage, not 'shut'"):
            drives.machine.brake = "shut"
        with pytest.raises(ValueError, match="not 'shut'"):
            drives.machine.brake = ["closed", "shut"]
        with pytest.raises(ValueError, match="not 'output'"):
            drives.machine.brake = "output"
        assert drives.machine.brake.tolist() == ["open", "open"]
        drives.machine.brake = ["closed", "with_stage"]
        assert drives.machine.brake.tolist() == ["closed", "with_stage"]


# --- end stops --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("load", "gear", "stiffness", "stop"), [("belt", 1 / PULLEY, 4e4, 0.25), ("cart_pendulum", 1 / PULLEY, 2e4, 0.41)]
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_drive_presses_into_its_end_stop_by_force_over_stiffness(load, gear, stiffness, stop, sign):
    # Next to nothing hangs from the cart: its swinging would pull at it.
    light = {"load.payload": 1e-4} if load == "cart_pendulum" else {}
    with drives_of(load, parameters=light, friction="none") as drives:
        drives.write("Limit switches", 3)  # not looked at
        motion.enable(drives, mode="cst")
        drives.write("Target torque", sign * 400)  # mA
        drives.advance(3.0)
        torque = watch(drives, 0.2, lambda: drives.machine.motor_torque[0]).mean()
        position = watch(drives, 0.5, lambda: drives.machine.joint_positions[0])
        place = position[:, :2].sum(1).mean() if load == "belt" else position[:, 0].mean()
        assert abs(torque) == pytest.approx(0.4 / 3.5 * RATED, rel=0.05)
        assert abs(place) - stop == pytest.approx(abs(torque) * gear / stiffness, rel=0.02)
        assert math.copysign(1, place) == sign


def into_the_stop(drives):
    """Command the belt 50 mm beyond its end stop at 0.2 m/s; return what was recorded."""
    drives.write("Limit switches", 3)  # not looked at
    motion.enable(drives, mode="csp")
    ramp = np.round(np.linspace(0.0, 0.30 / 0.04 * TURN, 1500)).astype(int)
    return drives.record([0x6064, 0x6077, 0x6041], 1.6, play={0x607A: np.append(ramp, np.full(100, ramp[-1]))})


def test_a_drive_that_runs_into_its_end_stop_feels_it():
    """Its position stays behind, its current rises to the limit, the carriage stands in the rubber."""
    with drives_of("belt") as drives:
        trace = into_the_stop(drives)
        limit = 7000  # mA, the drive's
        free = np.abs(trace[0x6077][200:1100]).max()
        assert free < 0.05 * limit
        assert np.all(np.abs(trace[0x6077][-100:] - limit) < 0.01 * limit)
        assert np.all(trace[0x6064][-50:] == trace[0x6064][-1])
        torque = limit * 1e-3 / 3.5 * RATED
        place = drives.machine.joint_positions[0].sum()
        # Up to 1.2 N of friction hold it anywhere beside.
        assert place - 0.25 == pytest.approx(torque / PULLEY / 4e4, abs=1.3 / 4e4)
        assert trace[0x6041][-1, 0] & 0x6F == 0x27


def test_a_following_error_behind_an_end_stop_is_a_fault():
    with drives_of("belt") as drives:
        drives.write(0x6065, TURN)
        trace = into_the_stop(drives)
        assert trace[0x6041][-1, 0] & 0x4F == 0x08
        assert trace[0x6041][1000, 0] & 0x6F == 0x27  # not on the free way
        assert [message.code for message in drives.emergencies()] == [0x8611]
        # The rubber has pushed it back.
        drives.advance(0.5)
        assert drives.machine.joint_positions[0].sum() < 0.2501


# --- winder, fan, arm -------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("turns", [0.0, 10.0, 50.0, 200.0])
def test_a_winder_s_radius_and_inertia_grow_by_closed_form(turns):
    """r = r_0 + thickness per turn; the web's force has the lever r, the roll J = pi/2 rho (r^4 - core^4)."""
    load = PackedLoad(find_load("winder"), np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H, friction="none")
    load.data.qpos[0] = 2 * math.pi * turns
    load.plant.load_torque[:] = 3.0  # N
    qvel = stepped(load.plant, np.zeros(50), H).qvel
    radius = 0.025 + 2e-4 * turns
    inertia = 2e-5 + J_M * 2.5**2 + math.pi / 2 * 24 * (radius**4 - 0.02**4)
    assert qvel[-1, 0] == pytest.approx(3.0 * radius / inertia * 50 * H, rel=1e-4)


def test_a_winder_never_unwinds_below_its_core():
    load = PackedLoad(find_load("winder"), np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H, friction="none")
    load.data.qpos[0] = -2 * math.pi * 100
    load.plant.load_torque[:] = 3.0
    qvel = stepped(load.plant, np.zeros(50), H).qvel
    assert qvel[-1, 0] == pytest.approx(3.0 * 0.02 / (2e-5 + J_M * 2.5**2) * 50 * H, rel=1e-4)


def test_a_winder_s_drive_holds_the_web_s_force_with_its_growing_lever():
    with drives_of("winder", friction="none") as drives:
        motion.enable(drives, mode="pp")
        for target in (0, 50 * TURN):
            if target:
                motion.move_to(drives, target)
            drives.machine.load_torque = -2.0
            drives.advance(0.5)
            torque = watch(drives, 0.2, lambda: drives.machine.motor_torque[0]).mean()
            radius = 0.025 + 2e-4 * target / TURN / 2.5
            assert torque == pytest.approx(2.0 * radius / 2.5, rel=0.01)
            drives.machine.load_torque = 0.0


@pytest.mark.parametrize("rpm", [1500, 3000])
def test_a_fan_s_torque_grows_with_the_square_of_speed(rpm):
    with drives_of("fan") as drives:
        torque, speed = run_at(drives, rpm, settle=1.5)
    assert speed == pytest.approx(rpm * math.pi / 30, rel=2e-3)
    assert torque == pytest.approx(3.5e-7 * speed**2 + 1e-3 + 1e-6 * speed, rel=0.01)


@pytest.mark.parametrize("degrees", [30, 90, 150, -90])
def test_an_arm_weighs_on_its_motor_by_the_sine_of_its_angle(degrees):
    with drives_of("arm", friction="none") as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, round(degrees / 360 * 30 * TURN))
        drives.advance(0.3)
        torque = watch(drives, 0.2, lambda: drives.machine.motor_torque[0]).mean()
        angle = drives.machine.joint_positions[0, 0]
    assert angle == pytest.approx(math.radians(degrees), abs=1e-3)
    assert torque == pytest.approx(0.5 * G * 0.15 * math.sin(angle) / 30, rel=0.005)


# --- pendulums --------------------------------------------------------------------------------------------------------
def pendulum(mass, cart_free):
    """Return the squared angular frequency of a pendulum of 0.3 m on a cart."""
    inertia = 5e-5 + mass * 0.3**2
    if not cart_free:
        return mass * G * 0.3 / inertia
    total = 0.25 + J_M / PULLEY**2 + mass
    return mass * G * 0.3 * total / (total * inertia - (mass * 0.3) ** 2)


@pytest.mark.parametrize("cart_free", [True, False])
def test_a_hanging_load_swings_at_its_frequency(cart_free):
    crane = replace(LOADS["cart_pendulum"], start={"swing": 0.03})
    with drives_of(crane, friction="none") as drives:
        drives.machine.brake = "open" if cart_free else "closed"
        swing = watch(drives, 5.0, lambda: drives.machine.joint_positions[0, 1])
    n = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
    at = n + swing[n] / (swing[n] - swing[n + 1])
    period = np.diff(at).mean() * 1e-3
    assert len(n) >= 4
    assert 2 * math.pi / period == pytest.approx(math.sqrt(pendulum(0.1, cart_free)), rel=1e-3)


@pytest.mark.parametrize("cart_free", [True, False])
def test_a_standing_pole_falls_at_its_rate(cart_free):
    """From 0.02 rad at rest: 0.02 cosh(rate t)."""
    with drives_of("inverted_pendulum", friction="none") as drives:
        drives.machine.brake = "open" if cart_free else "closed"
        rate = math.sqrt(pendulum(0.08, cart_free))
        n = round(math.acosh(4.0) / rate / 1e-3)
        swing = watch(drives, n * 1e-3, lambda: drives.machine.joint_positions[0, 1])
    assert swing[-1] == pytest.approx(0.02 * math.cosh(rate * (n * 1e-3 - 0.5 * H)), rel=0.01)


# --- several axes -----------------------------------------------------------------------------------------------------
def test_a_single_drive_yaws_the_gantry_against_its_guides():
    """One end held, the other pulled with F: the lever is 0.4 m, so that yaw = 0.4 F / k."""
    with drives_of("gantry", friction="none") as drives:
        drives.machine.brake = ["open", "closed"]
        first = np.array([True, False])
        motion.enable(drives, mode="cst", where=first)
        drives.write("Target torque", 1000, where=first)
        drives.advance(1.0)
        torque = watch(drives, 0.1, lambda: drives.machine.motor_torque[0]).mean()
        yaw = watch(drives, 0.3, lambda: drives.machine.joint_positions[0, 1]).mean()
        travel = drives.machine.joint_positions[0, 0]
    assert yaw == pytest.approx(-0.4 * torque / PULLEY / 3000, rel=0.01)
    assert travel == pytest.approx(-0.2 * yaw, rel=0.05)


def test_two_drives_pull_the_gantry_straight():
    with drives_of("gantry", friction="none", parameters={"load.payload": 1e-6}) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 2 * TURN)
        drives.advance(0.3)
        travel, yaw = drives.machine.joint_positions[0]
    assert travel == pytest.approx(0.08, abs=1e-4)
    assert abs(yaw) < 1e-4


def test_the_tool_of_the_portal_sways_as_arm_and_gravity_let_it():
    """Axes held: the arm's stiffness and its weight against its inertia, about the arm's upper end."""
    load = replace(find_load("portal"), start={"sway_x": 0.01, "sway_y": -0.005})
    with drives_of(load, friction="none") as drives:
        drives.machine.brake = "closed"
        sway = watch(drives, 1.0, lambda: drives.machine.joint_positions[0, 3:])
    rate = math.sqrt((9.0 + 0.15 * G * 0.12) / (4e-5 + 0.15 * 0.12**2))
    damping = 2.5e-3 / (4e-5 + 0.15 * 0.12**2) / 2.0
    t = np.arange(1, len(sway) + 1) * 1e-3 - 0.5 * H
    free = np.exp(-damping * t) * np.cos(math.sqrt(rate**2 - damping**2) * t)
    np.testing.assert_allclose(sway[:, 0], 0.01 * free, atol=5e-4)
    np.testing.assert_allclose(sway[:, 1], -0.005 * free, atol=2.5e-4)


def test_the_axes_of_the_portal_go_their_own_ways_and_one_carries_the_weight():
    ways = np.array([0.032, 0.032, 0.01])  # m per turn
    turns = np.array([2.0, -3.0, 4.0])
    with drives_of("portal", friction="none", parameters={"load.stiffness": 1e3}) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, np.rint(turns * TURN).astype(int))
        drives.advance(0.5)
        seen = watch(drives, 0.2, lambda: (drives.machine.joint_positions[0, :3], drives.machine.motor_torque))
    np.testing.assert_allclose(seen[:, 0].mean(axis=0), turns * ways, atol=1e-5)
    weight = (0.12 + 0.15) * G * 0.01 / (2 * math.pi)
    np.testing.assert_allclose(seen[:, 1].mean(axis=0), [0.0, 0.0, weight], atol=0.03 * weight)


def test_a_robot_holds_its_pose():
    with drives_of("robot") as drives:
        motion.enable(drives, mode="pp")
        goal = np.array([0.3, 0.4, -0.3, 0.5, 0.6, -0.4])
        gears = np.array(drives.load.gears)
        motion.move_to(drives, np.round(goal * gears / (2 * np.pi) * TURN).astype(int))
        drives.advance(0.3)
        seen = watch(drives, 0.5, lambda: drives.machine.joint_positions[0])
        assert np.abs(seen - goal).max() < 1e-3
        assert drives.emergencies() == []
        assert abs(drives.machine.motor_torque[1]) < RATED


def test_joint_positions_are_those_of_the_model_in_its_order():
    with EmulatedDrives(load="robot", num_machines=3) as drives:
        assert drives.machine.joint_positions.shape == (3, 6)
        assert np.all(drives.machine.joint_positions == 0.0)
    with EmulatedDrives(load="inverted_pendulum", num_machines=66) as drives:
        assert drives.machine.joint_positions.shape == (66, 2)
        assert np.all(drives.machine.joint_positions == [0.0, 0.02])
        drives.machine.joint_positions[:] = 1.0  # a copy
        assert np.all(drives.machine.joint_positions == [0.0, 0.02])


# --- what changes with time -----------------------------------------------------------------------------------------
def test_a_scheduled_payload_equals_one_set_by_hand():
    """Within one record call, too."""
    objects, found = [0x6064, 0x606C, 0x6077], []
    for by_hand in (False, True):
        with EmulatedDrives(load="belt", num_machines=2, seed=3) as drives:
            motion.enable(drives, mode="pv")
            drives.write("Target velocity", TURN)
            if by_hand:
                parts = []
                for duration, mass in ((0.1, 1.2), (0.15, 0.4), (0.05, None)):
                    parts.append(drives.record(objects, duration))
                    if mass is not None:
                        drives.machine.set("load.mass", mass, where=np.array([True, False]))
                found.append([np.concatenate([part[name] for part in parts]) for name in objects])
            else:
                drives.machine.schedule("load.mass", [0.1, 0.25], [1.2, 0.4], where=np.array([True, False]))
                trace = drives.record(objects, 0.3)
                found.append([trace[name] for name in objects])
                assert drives.machine.parameters["load.mass"].tolist() == [0.4, 0.4]
    for scheduled, hand in zip(*found, strict=True):
        assert np.array_equal(scheduled, hand)


def test_a_schedule_takes_effect_at_its_time():
    with drives_of("inertia", friction="none") as drives:
        drives.machine.schedule("load.inertia", 0.1, [4e-5])
        drives.machine.load_torque = 1e-3
        drives.advance(0.05)
        drives.advance(0.15)
        expected = 1e-3 * 0.1 / (J_M + 1e-5) + 1e-3 * 0.1 / (J_M + 4e-5)
        assert drives.machine.rotor_speed[0] == pytest.approx(expected, rel=1e-3)
        assert drives.machine.parameters["load.inertia"].tolist() == [4e-5]


def test_a_schedule_has_values_per_machine_and_any_order():
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        drives.machine.schedule("load.inertia", [0.02, 0.01], [[4e-5, 5e-5], [2e-5, 3e-5]])
        for expected in ([1e-5, 1e-5], [2e-5, 3e-5], [4e-5, 5e-5]):
            drives.advance(0.005)
            assert drives.machine.parameters["load.inertia"].tolist() == expected
            drives.advance(0.005)
        assert drives.machine.parameters["load.inertia"].tolist() == [4e-5, 5e-5]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("load.mass", [0.1], [1.0]), "machines have no parameter 'load.mass'; they have motor.R_s"),
        (("load.inertia", [0.1, 0.2], [1e-5]), r"a schedule of 2 times needs values of shape \(2,\) or \(2, 3\)"),
        (("load.inertia", [0.1005], [1e-5]), "0.1005 s is not a whole number of communication cycles"),
        (("load.inertia", [-0.1], [1e-5]), "-0.1 s is not a whole number"),
        (("load.inertia", [0.1], [math.nan]), "load.inertia"),
        (("load.inertia", [0.1], [-1e-5]), "load.inertia"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused_at_once(arguments, text):
    with EmulatedDrives(load="inertia", num_machines=3) as drives:
        with pytest.raises(ValueError, match=text):
            drives.machine.schedule(*arguments)
        drives.advance(0.3)
        assert np.all(drives.machine.parameters["load.inertia"] == 1e-5)


def freewheel(**options):
    """Return a disc that only the profile turns."""
    return drives_of("inertia", friction="none", parameters={"load.inertia": 1e-5 - J_M}, **options)


def test_a_profile_of_time_adds_its_impulse():
    """J omega = the integral of the table, its last value held; 1e-3 N*m on 1e-5 kg*m^2 is 100 rad/s^2."""
    with freewheel() as drives:
        drives.machine.load_profile([0.0, 0.1, 0.2], [0.0, 1e-3, -5e-4])
        speed = watch(drives, 0.3, lambda: drives.machine.rotor_speed[0])
        assert speed[99] == pytest.approx(5.0, rel=1e-3)
        assert speed[199] == pytest.approx(5.0 + 2.5, rel=1e-3)
        assert speed[299] == pytest.approx(7.5 - 5.0, rel=1e-3)
        drives.machine.load_profile(None)
        drives.advance(0.1)
        assert drives.machine.rotor_speed[0] == pytest.approx(2.5, rel=1e-3)


def test_a_profile_of_time_begins_anew_after_its_period():
    """A pulse of 10 ms every 50 ms."""
    with freewheel() as drives:
        drives.advance(0.013)  # times are from the call on
        drives.machine.load_profile([0.0, 0.01, 0.01001, 0.04], [1e-3, 1e-3, 0.0, 0.0], period=0.05)
        speed = watch(drives, 0.2, lambda: drives.machine.rotor_speed[0])
        # At the period's end the last value meets the first without a ramp.
        np.testing.assert_allclose(speed[[9, 39, 59, 109, 159]], [1.0, 1.0, 2.0, 3.0, 4.0], rtol=0.02)


def test_a_profile_adds_to_the_load_torque_and_may_differ_per_machine():
    with freewheel(num_machines=2) as drives:
        drives.machine.load_torque = 1e-3
        drives.machine.load_profile([0.0], [[1e-3], [-1e-3]])
        drives.advance(0.1)
        assert drives.machine.rotor_speed == pytest.approx([20.0, 0.0], rel=1e-3, abs=1e-9)


def test_a_profile_of_position_does_its_work():
    """J omega^2 / 2 = the integral of the torque over the angle."""
    with freewheel() as drives:
        drives.machine.load_profile([0.0, 1.0, 2.0], [1e-3, 2e-3, 0.0], of="position")
        speed = watch(drives, 0.6, lambda: drives.machine.rotor_speed[0])
        angle = drives.machine.rotor_angle[0]
    work = 1.5e-3 + 1e-3  # 0 to 1, 1 to 2; nothing afterwards
    assert angle > 2.5
    assert speed[-1] == pytest.approx(math.sqrt(2 * work / 1e-5), rel=2e-3)


def test_a_profile_of_position_repeats_with_its_period():
    """A spring-like cam of one lobe per turn gives back what it takes."""
    with freewheel() as drives:
        at = np.linspace(0.0, 2 * math.pi, 50)
        drives.machine.load_profile(at, 2e-4 * np.sin(at), of="position", period=2 * math.pi)
        drives.machine.load_torque = 2e-4
        drives.advance(1.0)
        speed, angle = drives.machine.rotor_speed[0], drives.machine.rotor_angle[0]
    assert angle > 3 * math.pi
    work = 2e-4 * angle + 2e-4 * (1 - math.cos(angle))
    assert speed == pytest.approx(math.sqrt(2 * work / 1e-5), rel=2e-3)


@pytest.mark.parametrize(
    ("arguments", "options", "text"),
    [
        (([0.0, 0.1], [0.0, 1.0]), {"of": "speed"}, "a load profile is of time or of position, not of 'speed'"),
        (([0.1, 0.0], [0.0, 1.0]), {}, "one finite, increasing row of times or positions"),
        (([0.0, math.inf], [0.0, 1.0]), {}, "one finite, increasing row"),
        (([[0.0, 0.1]], [[0.0, 1.0]]), {}, "one finite, increasing row"),
        (([0.0, 0.1], [0.0]), {}, r"needs finite torques of shape \(2,\) or \(3, 2\), not \(1,\)"),
        (([0.0, 0.1], [0.0, math.nan]), {}, "needs finite torques"),
        (([0.0, 0.1],), {}, r"needs finite torques of shape \(2,\) or \(3, 2\), not \(0,\)"),
        (([0.0, 0.1], [0.0, 1.0]), {"period": 0.05}, "must be above 0 and span its points, not 0.05"),
        (([0.0], [1.0]), {"period": 0.0}, "must be above 0"),
        ((None,), {"period": 1.0}, "must be above 0 and span its points"),
    ],
)
def test_a_profile_that_is_none_is_refused(arguments, options, text):
    with freewheel(num_machines=3) as drives:
        with pytest.raises(ValueError, match=text):
            drives.machine.load_profile(*arguments, **options)
        drives.advance(0.1)
        assert np.all(drives.machine.rotor_speed == 0.0)


# --- misfits ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", sorted(LOADS))
def test_the_default_motor_moves_every_load_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        EmulatedDrives(load=name).close()


def test_a_load_too_heavy_for_its_motor_is_said_with_the_figures():
    """12 kg at 0.15 m over 30:1 are 0.5886 N*m at the shaft; the motor is rated at 0.125."""
    mass = np.array([0.5, 12.0, 9.0])
    with pytest.warns(MisfitWarning) as caught:
        drives = drives_of("arm", num_machines=3, parameters={"load.mass": mass})
    text = str(caught[0].message)
    assert "motor 'qbl4208' cannot move axis 0 of machine 1, load 'arm', for long" in text
    assert "rated at 0.125 N*m (2 of 3 machines)" in text
    assert "take a stronger motor, a higher gear or a lighter load" in text
    figures = re.search(r"takes ([\d.]+) N\*m at the shaft \(([\d.]+) against gravity, ([\d.e-]+) to", text)
    total, gravity, friction = (float(figure) for figure in figures.groups())
    # 16 poses are looked at: the worst of them is near the horizontal.
    assert 0.97 * 12 * G * 0.15 / 30 < gravity <= 1.001 * 12 * G * 0.15 / 30
    assert friction == pytest.approx(0.05 / 30, rel=0.01)
    assert total == pytest.approx(gravity + friction, rel=0.01)
    assert caught[0].filename == __file__
    drives.close()


def test_a_load_with_too_much_inertia_is_said_with_its_ratio():
    """40 rotors' inertia: 1.92e-4 over 4.8e-6."""
    with pytest.warns(MisfitWarning) as caught:
        drives = drives_of("inertia", num_machines=2, parameters={"load.inertia": np.array([1e-5, 40 * J_M])})
    assert len(caught) == 1
    text = str(caught[0].message)
    assert "load 'inertia' has 40 times the inertia of the rotor of motor 'qbl4208' at axis 0 of machine 1" in text
    assert "(1 of 2 machines above 30)" in text
    drives.close()


@pytest.mark.parametrize("ratio", [29.0, 31.0])
def test_the_limit_of_the_inertia_ratio(ratio):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        drives_of("inertia", parameters={"load.inertia": ratio * J_M}).close()
    assert [w.category for w in caught] == ([MisfitWarning] if ratio > 30 else [])


def test_friction_alone_may_be_too_much():
    with pytest.warns(MisfitWarning, match=r"0\.13 to break away\), and the motor is rated at 0\.125 N\*m"):
        drives_of("inertia", parameters={"load.breakaway": 0.13}).close()
