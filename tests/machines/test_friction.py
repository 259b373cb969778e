"""Friction: F(v) = Fc + (Fs - Fc) exp(-(v/vs)^2) + b |v| against the motion, and sticking at standstill."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.stepped_load import stepped

from mechanics import friction
from mechanics.kernels.compiled import cached
from mechanics.loads import LOADS
from mechanics.packed import PackedLoad


@cached()
def friction_torque(v, other, inertia, h, coulomb, breakaway, stribeck, viscous, drag):
    """The static law's torque of one step [N*m], of the parts that kernels put together."""
    dry = friction.dry_friction(friction.middle_speed(v, other, inertia, h), coulomb, breakaway, stribeck)
    return friction.limited_torque(v, other, inertia, h, dry, viscous, drag)


H = 200e-6
J_M = 4.8e-6
J_L = 1e-5
REST = 1e-12  # rad/s, three nanoradians in an hour
COULOMB, BREAKAWAY, STRIBECK, VISCOUS = 2e-3, 3e-3, 2.0, 2e-5


def run(load, torque, h=H):
    """Return qvel after every step, shape (n, D)."""
    return stepped(load.plant, torque, h).qvel


def machine(name, motor=(0.0, 0.0, 1.0, 0.0), h=H, **parameters):
    """Return one copy; friction of the load is zero unless given."""
    values = {"coulomb": 0.0, "breakaway": 0.0, "viscous": 0.0, **parameters}
    return PackedLoad(
        LOADS[name], np.full((1, 1), J_M), np.array([[motor]]), {k: np.array([v]) for k, v in values.items()}, h
    )


def law(v):
    return COULOMB + (BREAKAWAY - COULOMB) * math.exp(-((v / STRIBECK) ** 2)) + VISCOUS * abs(v)


# --- the law ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("v", [0.5, 1.0, 2.0, 5.0, 50.0, 400.0, -1.0, -400.0])
def test_steady_speed_needs_the_torque_of_the_law(v):
    """Held at speed v by a torque of F(v), the friction of a step is F(v); the step's mean speed blurs it little."""
    J = J_M + J_L
    torque = math.copysign(law(v), v)
    found = friction_torque(v, torque, J, H, COULOMB, BREAKAWAY, STRIBECK, VISCOUS, 0.0)
    # The law is taken up to h F / 2J from v: half of what the step would gain without friction.
    shift = 0.5 * H * law(v) / J
    dry = lambda speed: law(speed) - VISCOUS * speed  # noqa: E731
    slope = abs(dry(abs(v) + shift) - dry(abs(v))) + VISCOUS * shift
    assert found == pytest.approx(-torque, abs=1.01 * slope)
    assert slope < 0.03 * law(v)


@pytest.mark.parametrize("v", [5.0, 100.0, 400.0])
def test_speed_settles_where_the_law_meets_the_torque(v):
    """Two seconds under the torque of the law, simulated, starting beside it."""
    load = machine("inertia", coulomb=COULOMB, breakaway=BREAKAWAY, viscous=VISCOUS * 10)
    b = VISCOUS * 10
    torque = COULOMB + (BREAKAWAY - COULOMB) * math.exp(-((v / STRIBECK) ** 2)) + b * v
    load.data.qvel[:] = 1.1 * v
    end = run(load, np.full(10_000, torque))[-1, 0]
    assert end == pytest.approx(v, rel=1e-3, abs=H * torque / (J_M + J_L))


def test_friction_vanishes_where_all_its_parameters_do():
    assert friction_torque(3.0, 0.01, 1e-5, H, 0.0, 0.0, 1.0, 0.0, 0.0) == 0.0


# --- sticking ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999, -0.5, -0.999])
def test_hinge_sticks_exactly_below_breakaway(share):
    load = machine("inertia", coulomb=COULOMB, breakaway=BREAKAWAY)
    qvel = run(load, np.full(5000, share * BREAKAWAY))  # 1 s
    assert np.all(qvel == 0.0)
    assert abs(load.data.qpos[0]) < 1e-15


def test_motor_and_load_friction_hold_together():
    """Both bearings of the rigid shaft: break-away is the sum."""
    motor = (1.5e-3, 1.5e-3, 1.0, 0.0)
    holds = machine("inertia", motor, coulomb=COULOMB, breakaway=BREAKAWAY)
    assert np.all(np.abs(run(holds, np.full(5000, 0.999 * (BREAKAWAY + 1.5e-3)))) < REST)
    slips = machine("inertia", motor, coulomb=COULOMB, breakaway=BREAKAWAY)
    assert run(slips, np.full(5000, 1.001 * (BREAKAWAY + 1.5e-3)))[-1, 0] > 1.0


@pytest.mark.parametrize("sign", [1, -1])
def test_hinge_breaks_away_above_breakaway(sign):
    load = machine("inertia", coulomb=COULOMB, breakaway=BREAKAWAY)
    qvel = run(load, np.full(5000, sign * 1.001 * BREAKAWAY))
    assert sign * qvel[-1, 0] > 1.0
    # Once it slides, the friction is down to Coulomb's: (Fs - Fc) / J.
    slope = (qvel[-1, 0] - qvel[-1001, 0]) / (1000 * H)
    assert slope == pytest.approx(sign * (1.001 * BREAKAWAY - COULOMB) / (J_M + J_L), rel=1e-3)


def test_a_spinning_rotor_comes_to_rest_and_stays():
    """The explicit sign law would chatter at h Fc / J around zero for ever."""
    load = machine("inertia", coulomb=COULOMB, breakaway=BREAKAWAY)
    load.data.qvel[:] = 20.0
    torque = 0.9 * COULOMB
    qvel = run(load, np.full(20_000, torque))[:, 0]
    rest = int(np.argmax(np.abs(qvel) < REST))
    assert rest > 0
    assert np.all(np.diff(qvel[: rest + 1]) < 0.0)
    assert np.all(np.abs(qvel[rest:]) < REST)
    assert rest * H < 20.0 * (J_M + J_L) / (COULOMB - torque)


def test_two_mass_settles_with_a_twisted_shaft_and_stays():
    """Under a torque that both bearings hold, the ringing ends and then nothing moves for 1 s."""
    load = machine("two_mass", (1.5e-3, 1.5e-3, 1.0, 0.0), coulomb=COULOMB, breakaway=BREAKAWAY)
    load.data.qvel[:] = (30.0, 0.0)
    run(load, np.full(10_000, 0.8 * 1.5e-3))  # 2 s
    at = load.data.qpos.copy()
    qvel = run(load, np.full(5000, 0.8 * 1.5e-3))
    assert np.all(qvel == 0.0), np.abs(qvel).max()
    assert np.array_equal(load.data.qpos, at)


# --- coasting down ----------------------------------------------------------------------------------------------------
def test_coulomb_friction_brakes_linearly():
    load = machine("inertia", coulomb=COULOMB, breakaway=COULOMB)
    load.data.qvel[:] = 50.0
    rate = COULOMB / (J_M + J_L)
    n = int(50.0 / rate / H)
    qvel = run(load, np.zeros(n + 2))[:, 0]
    np.testing.assert_allclose(qvel[:n], 50.0 - rate * H * np.arange(1, n + 1), atol=1e-10)
    assert abs(qvel[n]) < REST  # stops within the step in which the closed form does
    assert abs(qvel[n + 1]) < REST


def coast_error(h, exact, v0, duration=0.2, **parameters):
    load = machine("inertia", h=h, **parameters)
    load.data.qvel[:] = v0
    n = round(duration / h)
    return np.abs(run(load, np.zeros(n), h)[:, 0] - exact(h * np.arange(1, n + 1))).max()


def test_viscous_friction_brakes_exponentially_to_second_order():
    b, v0, J = 1e-3, 100.0, J_M + J_L
    errors = [coast_error(h, lambda t: v0 * np.exp(-b / J * t), v0, viscous=b) for h in (400e-6, 200e-6, 100e-6)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2.0) < 0.05), errors
    assert errors[1] < 1e-4 * v0


def test_coulomb_and_viscous_friction_brake_to_second_order():
    """J dv/dt = -Fc - b v: v = (v0 + Fc/b) exp(-b t / J) - Fc/b, down to standstill."""
    b, v0, J = 1e-3, 100.0, J_M + J_L
    exact = lambda t: (v0 + COULOMB / b) * np.exp(-b / J * t) - COULOMB / b  # noqa: E731
    stop = J / b * math.log(1 + v0 * b / COULOMB)
    errors = [
        coast_error(h, exact, v0, 0.04, viscous=b, coulomb=COULOMB, breakaway=COULOMB) for h in (400e-6, 200e-6, 100e-6)
    ]
    assert stop > 0.04
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 1.9), errors


def test_strong_viscous_friction_stays_stable():
    """h b / J = 100: an explicit scheme would explode."""
    load = machine("inertia", viscous=100 * (J_M + J_L) / H)
    load.data.qvel[:] = 100.0
    speed = np.abs(run(load, np.zeros(100))[:, 0])
    assert np.all(np.diff(speed) <= 0.0)


# --- which body -------------------------------------------------------------------------------------------------------
def test_each_friction_acts_on_its_own_body():
    """A soft shaft: right after the start each body is braked by its own bearing alone."""
    stiffness = 0.3
    motor = (1.5e-3, 1.5e-3, 1.0, 0.0)

    def slopes(motor_friction, **parameters):
        load = machine("two_mass", motor_friction, stiffness=stiffness, damping=0.0, **parameters)
        load.data.qvel[:] = (100.0, 0.0)
        qvel = run(load, np.zeros(1))[0]
        return (qvel[0] - 100.0) / H, (qvel.sum() - 100.0) / H

    assert slopes((0.0, 0.0, 1.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert slopes(motor) == pytest.approx((-1.5e-3 / (J_M + 1e-9), 0.0), rel=1e-9, abs=1e-6)
    only_load = slopes((0.0, 0.0, 1.0, 0.0), coulomb=COULOMB, breakaway=COULOMB)
    assert only_load == pytest.approx((0.0, -COULOMB / J_L), rel=1e-9, abs=1e-6)


# --- energy -----------------------------------------------------------------------------------------------------------
@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    v=st.floats(-1e3, 1e3),
    other=st.floats(-10.0, 10.0),
    J=st.floats(1e-7, 1e-1),
    h=st.floats(1e-6, 1e-3),
    coulomb=st.floats(0.0, 1.0),
    rise=st.floats(0.0, 1.0),
    stribeck=st.floats(1e-3, 100.0),
    viscous=st.floats(0.0, 1.0),
)
def test_friction_never_gives_energy(v, other, J, h, coulomb, rise, stribeck, viscous):
    """It opposes the speed that the step would reach, and stops it at most."""
    torque = friction_torque(v, other, J, h, coulomb, coulomb + rise, stribeck, viscous, 0.0)
    v_free = v + h * other / J
    v_end = v_free + h * torque / J
    slack = 1e-12 * (abs(v_free) + 1e-9)
    assert abs(v_end) <= abs(v_free) + slack
    assert v_end * v_free >= -slack * abs(v_free)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    v0=st.floats(-200.0, 200.0),
    v1=st.floats(-200.0, 200.0),
    coulomb=st.floats(0.0, 1e-2),
    rise=st.floats(0.0, 1e-2),
    viscous=st.floats(0.0, 1e-3),
)
def test_a_coasting_machine_never_gains_energy(v0, v1, coulomb, rise, viscous):
    """Two masses left to themselves; the shaft's energy is taken at the speed's time, qpos moved half a step back."""
    load = machine("two_mass", coulomb=coulomb, breakaway=coulomb + rise, viscous=viscous)
    load.data.qvel[:] = (v0, v1)
    k = float(load.plant.stiffness[1, 1, 0])
    start = 0.5 * (J_M + 1e-9) * v0**2 + 0.5 * J_L * (v0 + v1) ** 2
    for _ in range(40):
        run(load, np.zeros(25))
        motor, twist = load.data.qvel
        # The staggered scheme conserves the energy with the product of successive positions; this one swings about it
        # by (omega_r h / 2)^2 / 2.
        x = load.data.qpos[1] - 0.5 * H * twist
        energy = 0.5 * (J_M + 1e-9) * motor**2 + 0.5 * J_L * (motor + twist) ** 2 + 0.5 * k * x**2
        assert energy <= 1.01 * start + 1e-15
