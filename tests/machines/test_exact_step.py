"""The physics step against closed forms and matrix exponentials: angles, damped shafts, and what gears transmit."""

import dataclasses
import math

import numpy as np
import pytest
from rigs.stepped_load import stepped
from scipy.linalg import expm

from mechanics.loads import LOADS
from mechanics.packed import PackedLoad

H = 200e-6  # the default: 5 steps per ms
FINE = 62.5e-6
J_M = 4.8e-6
LEAD = 0.005 / (2 * math.pi)
G = 9.81


def run(machine, torque, moment=None):
    """Return the rotor's angle and speed and the joints' speeds at every step's end, (n,), (n,) and (n, D)."""
    found = stepped(machine.plant, torque, machine.h, moment)
    assert not machine.plant.diverged.any()
    return found.theta[:, 0], found.omega[:, 0], found.qvel


def machine_of(load, h=H, **parameters):
    row = LOADS[load] if isinstance(load, str) else load
    values = {name: np.array([value], float) for name, value in parameters.items()}
    friction = "none" if isinstance(load, str) else "stribeck"
    return PackedLoad(row, np.full((1, 1), J_M), np.array([[[0.0, 0.0, 1.0, 0.0]]]), values, h, friction=friction)


def sine(amplitude, frequency, h, n):
    """Return mean of a sine over every step, and mean of sine times time from the step's middle."""
    w, middle = 2 * math.pi * frequency, (np.arange(n) + 0.5) * h
    x = 0.5 * w * h
    moment = amplitude / w * (math.sin(x) / x - math.cos(x))
    return amplitude * math.sin(x) / x * np.sin(w * middle), moment * np.cos(w * middle)


def exact(inertia, stiffness, damping, axis, torque, h):
    """Return angle and speed of an axis at every step's end; torque (n,) is held over each step."""
    D = len(inertia)
    system = np.zeros((2 * D + 1, 2 * D + 1))
    system[:D, D : 2 * D] = np.eye(D)
    system[D : 2 * D, :D] = -np.linalg.solve(inertia, stiffness)
    system[D : 2 * D, D : 2 * D] = -np.linalg.solve(inertia, damping)
    system[D : 2 * D, 2 * D] = np.linalg.solve(inertia, axis)
    once = expm(system * h)
    state, seen = np.zeros(2 * D), []
    for u in torque:
        state = once[: 2 * D, : 2 * D] @ state + once[: 2 * D, 2 * D] * u
        seen.append((axis @ state[:D], axis @ state[D:]))
    return np.array(seen).T


def levels(n, of=5):
    """Return torques that jump every few steps, (n,)."""
    return np.repeat(np.random.default_rng(1).normal(0.0, 0.02, -(-n // of)), of)[:n]


def assert_same(found, expected, rel):
    assert np.abs(found - expected).max() < rel * np.abs(expected).max()


# --- a free rotor -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("h", [H, FINE])
def test_a_free_rotor_under_a_constant_torque_is_where_newton_has_it(h):
    """theta = a t^2 / 2."""
    machine = machine_of("inertia", h)
    acceleration = 0.04 / machine.mass_matrix()[0, 0, 0]
    t = (np.arange(200) + 1) * h
    theta, omega, _ = run(machine, np.full(200, 0.04))
    assert_same(theta, 0.5 * acceleration * t**2, 1e-12)
    assert_same(omega, acceleration * t, 1e-12)


@pytest.mark.parametrize("h", [H, FINE])
@pytest.mark.parametrize("frequency", [50.0, 400.0, 900.0])
def test_a_free_rotor_under_a_sinusoidal_torque_too(frequency, h):
    """theta = T / (J w) (t - sin(w t) / w), to far less than (w h)^2 / 8 of the swing, which are 3 % at 400 Hz."""
    machine = machine_of("inertia", h)
    w, n = 2 * math.pi * frequency, round(0.02 / h)
    t = (np.arange(n) + 1) * h
    theta, omega, _ = run(machine, *sine(0.04, frequency, h, n))
    swing = 0.04 / machine.mass_matrix()[0, 0, 0] / w**2
    assert np.abs(theta - swing * (w * t - np.sin(w * t))).max() < 1e-9 * swing
    assert_same(omega, swing * w * (1.0 - np.cos(w * t)), 1e-9)


# --- shafts, teeth ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("h", [H, FINE])
@pytest.mark.parametrize("damping_ratio", [0.0, 0.1, 1.0, 2.0, 30.0])
@pytest.mark.parametrize("frequency", [10.0, 140.0, 500.0])
def test_two_masses_on_a_shaft_of_any_damping_move_as_the_matrix_exponential_says(frequency, damping_ratio, h):
    w = 2 * math.pi * frequency
    J_1, J_2 = J_M + 1e-9, 1e-5
    reduced = J_1 * J_2 / (J_1 + J_2)
    k, c = reduced * w**2, 2.0 * damping_ratio * w * reduced
    machine = machine_of("two_mass", h, stiffness=k, damping=c)
    torque = levels(300)
    shaft = np.array([[1.0, -1.0], [-1.0, 1.0]])
    expected = exact(np.diag([J_1, J_2]), k * shaft, c * shaft, np.array([1.0, 0.0]), torque, h)
    theta, omega, _ = run(machine, torque)
    assert_same(theta, expected[0], 1e-7)
    assert_same(omega, expected[1], 1e-7)


@pytest.mark.parametrize("load", ["belt", "three_mass"])
def test_loads_with_dampers_as_their_rows_have_them_too(load):
    machine = machine_of(load)
    torque = levels(300) * 0.2
    expected = exact(
        machine.mass_matrix()[0], np.diag(machine.values.stiffness[0]), np.diag(machine.values.damping[0]),
        machine.plant.axis_motion[0], torque, H,
    )  # fmt: skip
    theta, omega, _ = run(machine, torque)
    assert_same(theta, expected[0], 1e-4)
    assert_same(omega, expected[1], 1e-4)


@pytest.mark.parametrize("damping_ratio", [0.0, 0.5])
def test_torque_that_changes_within_a_step_moves_a_shaft_as_it_does_at_a_fine_step(damping_ratio):
    """A sine of 400 Hz, by mean and first moment, beside a resonance of 300 Hz."""
    found = {}
    for h, every in ((H, 1), (H / 32, 32)):
        reduced = J_M * 1e-5 / (J_M + 1e-5)
        w = 2 * math.pi * 300.0
        machine = machine_of("two_mass", h, stiffness=reduced * w**2, damping=2.0 * damping_ratio * w * reduced)
        theta, omega, _ = run(machine, *sine(0.02, 400.0, h, 150 * every))
        found[h] = theta[every - 1 :: every], omega[every - 1 :: every]
    swing = 0.02 / J_M / (2 * math.pi * 400.0) ** 2
    assert np.abs(found[H][0] - found[H / 32][0]).max() < 0.01 * swing
    assert np.abs(found[H][1] - found[H / 32][1]).max() < 0.01 * swing * 2 * math.pi * 400.0


@pytest.mark.parametrize("h", [H, FINE])
def test_a_rotor_whose_teeth_are_pressed_both_ways_is_one_on_a_spring(h):
    machine = machine_of("geared_joint", h, backlash=0.0, damping=0.0, efficiency=1.0)
    machine.data.qpos[machine.joints.index("joint")] = 1e-12  # the first step, too, has them pressed
    torque = levels(300)
    teeth = np.array([-1.0 / 50.0, 1.0])
    inertia = machine.mass_matrix()[0]
    assert machine.joints == ["motor", "joint"]
    expected = exact(inertia, 7000.0 * np.outer(teeth, teeth), np.zeros((2, 2)), np.array([1.0, 0.0]), torque, h)
    theta, omega, _ = run(machine, torque)
    assert_same(theta, expected[0], 1e-7)
    assert_same(omega, expected[1], 1e-7)


def test_damping_that_couples_resonances_too_strongly_for_the_step_is_refused():
    machine = machine_of("three_mass")
    before = machine.get("damping")
    refusal = (
        r"joint 'second_twist' of machine 0 is damped by 0\.01, so strongly that its resonances brake each other at "
        r"\d+ 1/s; the limit is 500 1/s at a physics step of 200 us; lower its damping or take more physics steps"
    )
    with pytest.raises(ValueError, match=refusal):
        machine.set("damping", np.array([0.01]), np.ones(1, bool))
    assert np.array_equal(machine.get("damping"), before)
    with pytest.raises(ValueError, match=refusal):
        machine_of("three_mass", damping=0.01)
    machine_of("three_mass", H / 8, damping=0.01)
    machine_of("three_mass", damping=0.002)


# --- starts -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("how", ["start", "place"])
@pytest.mark.parametrize("damping_ratio", [0.0, 0.05])
def test_a_shaft_that_starts_tense_swings_as_far_as_it_was_twisted(how, damping_ratio):
    """400 Hz, 12.5 steps a period: angle and speed at the end of each step, from the first one on."""
    J_L, w, twisted = 1e-5, 2.0 * math.pi * 400.0, 0.1
    J_R = J_M + 1e-9  # with the MJCF's hub
    k = w * w * J_R * J_L / (J_R + J_L)
    load = LOADS["two_mass"]
    if how == "start":
        load = dataclasses.replace(load, start={"twist": twisted})
    c = 2.0 * damping_ratio * k / w
    row = {"inertia": J_L, "stiffness": k, "damping": c, "coulomb": 0.0, "breakaway": 0.0, "viscous": 0.0}
    machine = machine_of(load, **row)
    if how == "place":
        machine.place(machine.joints.index("twist"), np.array([twisted]), np.array([True]))
    theta, _, qvel = run(machine, np.zeros(500))
    # No torque from outside: the twist swings alone, and the rotor has the load's share of it, the other way.
    t = (np.arange(500) + 1) * H
    d = damping_ratio * w
    swing = math.sqrt(w * w - d * d)
    twist = twisted * np.exp(-d * t) * (np.cos(swing * t) + d / swing * np.sin(swing * t))
    share = J_L / (J_R + J_L)
    assert np.abs(theta - share * (twisted - twist)).max() < 1e-9 * twisted
    speed = -twisted * np.exp(-d * t) * w * w / swing * np.sin(swing * t)
    assert np.abs(qvel[:, machine.joints.index("twist")] - speed).max() < 1e-9 * w * twisted
    machine.reset(np.array([True]))
    again = run(machine, np.zeros(500))[0]
    assert (np.abs(again).max() > 0.0) == (how == "start")  # and is at its start again after a reset


# --- efficiency -------------------------------------------------------------------------------------------------------
def without_drag(load):
    """Return a load that loses by its efficiency alone."""
    row = LOADS[load]
    frictions = tuple(friction._replace(coulomb=0.0, breakaway=0.0, viscous=0.0) for friction in row.frictions)
    return dataclasses.replace(row, frictions=frictions)


@pytest.mark.parametrize("h", [H, FINE])
@pytest.mark.parametrize("efficiency", [0.6, 0.9])
@pytest.mark.parametrize("speed", [0.05, -0.05])
def test_a_screw_passes_on_its_efficiency_of_the_work(speed, efficiency, h):
    """Lifting, the load gets eta of what the motor gives; lowering, the motor gets 2 - 1/eta of what the load gives.

    At these torques the closed form is a constant speed: J dw/dt = T - F r / eta, and T - F r (2 - 1/eta).
    """
    weight = 4 * G
    machine = machine_of(without_drag("vertical_screw"), h, efficiency=efficiency, backlash=0.0)
    screw, table = machine.joints.index("screw"), machine.joints.index("table")
    machine.data.qvel[screw], machine.data.qvel[table] = speed / LEAD, speed
    share = 1.0 / efficiency if speed > 0.0 else 2.0 - 1.0 / efficiency
    torque = LEAD * weight * share
    n, settled = round(0.4 / h), round(0.1 / h)
    theta, omega, qvel = run(machine, np.full(n, torque))
    assert np.abs(qvel[settled:, table] / speed - 1.0).max() < 1e-6
    rotor = machine.mass_matrix()[0, screw, screw]
    work = torque * (theta[-1] - theta[settled]) - 0.5 * rotor * (omega[-1] ** 2 - omega[settled] ** 2)
    gained = weight * LEAD * (theta[-1] - theta[settled])
    gained += 0.5 * 4.0 * (qvel[-1, table] ** 2 - qvel[settled, table] ** 2)
    assert work / gained == pytest.approx(share, rel=1e-6)


@pytest.mark.parametrize("h", [H, FINE])
@pytest.mark.parametrize("driving", [True, False])
def test_a_gear_passes_on_its_efficiency_of_the_work(driving, h):
    efficiency, load_torque, speed = 0.7, 1.0, 40.0
    machine = machine_of(without_drag("geared_joint"), h, efficiency=efficiency, backlash=0.0)
    share = 1.0 / efficiency if driving else 2.0 - 1.0 / efficiency
    sign = 1.0 if driving else -1.0
    machine.data.qvel[:] = sign * speed * np.array([1.0, 1.0 / 50.0])
    machine.plant.load_torque[:] = -load_torque
    _, omega, _ = run(machine, np.full(round(0.4 / h), load_torque / 50.0 * share))
    # By then the teeth have rung out.
    assert np.abs(omega[round(0.3 / h) :] / (sign * speed) - 1.0).max() < 3e-4


def test_a_coupling_that_is_mended_moves_no_rotor():
    """The load comes to where the rotor is; correcting the twist before as one at rest made the rotor leap."""
    machine = machine_of(LOADS["two_mass"], H)
    machine.data.qpos[:] = np.array([0.3, 2.0])
    machine.data.qvel[:] = np.array([50.0, 80.0])
    machine.mend("stiffness", np.ones(1, bool))
    assert machine.data.qpos.tolist() == [0.3, 0.0] and machine.data.qvel.tolist() == [50.0, 0.0]
