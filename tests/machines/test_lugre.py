"""LuGre friction against scipy's integration of its equations (Canudas de Wit et al., IEEE TAC 40(3), 1995):
dz/dt = v - s_0 |v| z / g(v), g = F_c + (F_s - F_c) exp(-(v/v_s)^2), F = s_0 z + s_1 dz/dt + s_2 v."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rigs.stepped_load import stepped
from scipy.integrate import solve_ivp

from drive_env import EmulatedDrives
from mechanics import friction as friction_laws
from mechanics.friction import FRICTION_MODELS, find_friction
from mechanics.kernels.compiled import cached
from mechanics.loads import LOADS
from mechanics.packed import PackedLoad

H = 200e-6
# The paper's parameters, for a mass of 1 kg.
S_0, S_1, S_2, F_C, F_S, V_S, MASS = 1e5, math.sqrt(1e5), 0.4, 1.0, 1.5, 1e-3, 1.0


@cached()
def bristle_torque(v, other, mass, h, z, s_0, s_1, coulomb, breakaway, stribeck, viscous, drag):
    """The stage, which kernels alone can call, for Python."""
    return friction_laws.bristle_torque(v, other, mass, h, z, s_0, s_1, coulomb, breakaway, stribeck, viscous, drag)


ROW = (S_0, S_1, F_C, F_S, V_S, S_2, 0.0)  # the order of bristle_torque
J_M, J_L = 4.8e-6, 1e-5


@cached()
def push(row, mass, force, h, seen):
    """Let forces (n,), held for a step each, push a mass; write its position, speed and friction, (n, 3)."""
    v, x, z = 0.0, 0.0, 0.0
    for n in range(force.shape[0]):
        friction, z = bristle_torque(v, force[n], mass, h, z, row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        v_end = v + h / mass * (force[n] + friction)
        x += 0.5 * h * (v + v_end)
        v = v_end
        seen[n] = x, v, friction


@cached()
def slide(row, speed, h, friction):
    """Write the friction of a mass too heavy to be slowed that slides at speeds (n,)."""
    z = 0.0
    for n in range(speed.shape[0]):
        friction[n], z = bristle_torque(
            speed[n], 0.0, 1e15, h, z, row[0], row[1], row[2], row[3], row[4], row[5], row[6]
        )


def pushed(force, h=H, row=ROW, mass=MASS):
    seen = np.zeros((len(force), 3))
    push(np.array(row), mass, np.ascontiguousarray(force), h, seen)
    return seen.T


def slid(speed, h=H, row=ROW):
    friction = np.zeros(len(speed))
    slide(np.array(row), np.ascontiguousarray(speed), h, friction)
    return -friction


def sliding(v, row=ROW):
    """Return g(v)."""
    _, _, coulomb, breakaway, stribeck, _, _ = row
    return coulomb + (breakaway - coulomb) * np.exp(-((v / stribeck) ** 2))


def bristles(v, z, row=ROW):
    """Return dz/dt and the friction."""
    rate = v - row[0] * abs(v) / sliding(v, row) * z
    return rate, row[0] * z + row[1] * rate + row[5] * v + row[6] * abs(v) * v


def oracle(force, t, row=ROW, mass=MASS, **options):
    """Return scipy's solution (x, v, z) at times t, of a mass pushed by force(t) from rest."""

    def slopes(at, state):
        _, v, z = state
        rate, friction = bristles(v, z, row)
        return v, (force(at) - friction) / mass, rate

    found = solve_ivp(slopes, (0.0, t[-1]), np.zeros(3), "LSODA", t, rtol=1e-9, atol=1e-15, max_step=0.01, **options)
    assert found.success
    return found


def times(duration, h=H):
    """Return the middles and the ends of the steps."""
    n = np.arange(round(duration / h))
    return (n + 0.5) * h, (n + 1.0) * h


# --- pre-sliding ------------------------------------------------------------------------------------------------------
def test_pre_sliding_displacement_follows_the_equations_with_hysteresis():
    """The paper's figure 3: a force of up to 95 % of break-away, back and forth, moves the mass on its bristles."""
    force = lambda t: 1.425 * np.sin(2 * np.pi * 0.5 * t)  # noqa: E731
    middle, end = times(4.0)
    x, _, _ = pushed(force(middle))
    true = oracle(force, end).y[0]
    assert np.abs(x - true).max() < 1e-5 * np.ptp(true)
    # The second period: the loop is open where the force passes through zero, and the mass does not come back.
    last = slice(len(x) // 2, None)
    up = x[last][np.argmin(np.abs(end[last] - 4.0))]
    down = x[last][np.argmin(np.abs(end[last] - 3.0))]
    assert abs(up - down) > 5e-6
    assert np.ptp(x[last]) < 1e-4


def test_small_forces_meet_a_spring_with_the_bristles_stiffness():
    middle, _ = times(2.0)
    x, _, _ = pushed(0.05 * np.sin(2 * np.pi * 0.5 * middle))
    assert np.ptp(x) == pytest.approx(0.1 / S_0, rel=0.03)


def test_bristles_swing_at_their_natural_frequency_and_damping():
    """A step of a hundredth of break-away: sqrt(s_0/m), damping (s_1 + s_2) / 2 sqrt(s_0 m) = 0.5."""
    force = lambda t: 0.015 + 0.0 * t  # noqa: E731
    middle, end = times(0.06)
    x, v, _ = pushed(force(middle))
    found = oracle(force, end)
    assert np.abs(x - found.y[0]).max() < 2e-3 * x.max()
    assert np.abs(v - found.y[1]).max() < 2e-3 * v.max()
    assert x.max() / x[-1] - 1 == pytest.approx(math.exp(-math.pi * 0.5 / math.sqrt(0.75)), rel=0.05)


# --- break-away -------------------------------------------------------------------------------------------------------
def breakaway_force(rate):
    """Return the force at which a ramp of `rate` [N/s] brings the mass to twice Stribeck's speed, ours and scipy's."""
    duration = round(2.0 / rate, 3)
    middle, end = times(duration)
    _, v, friction = pushed(rate * middle)
    n = int(np.argmax(v > 2 * V_S))
    part = (2 * V_S - v[n - 1]) / (v[n] - v[n - 1])

    def loose(_, state):
        return state[1] - 2 * V_S

    loose.terminal = True
    true = rate * oracle(lambda t: rate * t, end, events=loose).t_events[0][0]
    return rate * (end[n - 1] + part * H), true, -friction.min()


RATES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


def test_breakaway_is_that_of_the_equations_and_falls_with_the_rate():
    """Faster ramps break away earlier (the paper's figure 6): from F_s for slow ones down towards F_c."""
    ours, true, peak = np.transpose([breakaway_force(rate) for rate in RATES])
    np.testing.assert_allclose(ours, true, rtol=1e-4)
    # The greatest friction falls with every rate, from near F_s.
    assert np.all(np.diff(peak) < 0.0)
    assert 0.95 * F_S < peak[0] < F_S + S_2 * 0.1
    assert F_C < peak[-1] < 0.9 * F_S


# --- sliding ----------------------------------------------------------------------------------------------------------
def lag_loop(frequency, h=H):
    """Return speed and friction over one period about twice Stribeck's speed, and scipy's friction."""
    speed = lambda t: V_S * (1.5 + 1.0 * np.sin(2 * np.pi * frequency * t))  # noqa: E731
    middle, _ = times(3.0 / frequency, h)
    found = solve_ivp(
        lambda t, z: bristles(speed(t), z)[0], (0.0, middle[-1]), np.zeros(1), "LSODA", middle, rtol=1e-10, atol=1e-16,
        max_step=0.02 / frequency,
    )  # fmt: skip
    last = slice(-round(1.0 / frequency / h), None)
    return speed(middle)[last], slid(speed(middle), h)[last], bristles(speed(middle), found.y[0])[1][last]


def test_friction_lags_behind_a_changing_speed():
    """Friction is greater while speed rises than while it falls, more so at a higher frequency (figure 4)."""
    widths = []
    for frequency in (1.0, 3.0, 10.0):
        v, ours, true = lag_loop(frequency)
        assert np.abs(ours - true).max() < 1e-4 * np.ptp(true)
        # The loop's area per range of speed; positive where friction is greater with rising speed.
        widths.append(np.sum(ours * np.gradient(v)) / np.ptp(v))
    assert 0.0 < widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize("v", [1e-5, 3e-4, 1e-3, 2e-3, 5e-3, 0.1, 1.0, -1e-3, -1.0])
def test_steady_speeds_meet_the_static_law(v):
    """F(v) = g(v) + s_2 v."""
    n = round(40.0 / S_0 / abs(v) / H) + 10
    end = slid(np.full(n, v))[-1]
    assert end == pytest.approx(math.copysign(sliding(v), v) + S_2 * v, rel=1e-6)


def test_stick_slip_of_a_mass_pulled_by_a_spring_follows_the_equations():
    """The paper's figure 5: a spring of 2 N/m, its end pulled at 0.1 m/s; the mass jumps, sticks and jumps again."""
    h, stiffness, pull = 50e-6, 2.0, 0.1
    n = round(40.0 / h)

    x, sticks, at = pulled(n, h, stiffness, pull)

    def slopes(t, state):
        x, v, z = state
        rate, friction = bristles(v, z)
        return v, (stiffness * (pull * t - x) - friction) / MASS, rate

    true = solve_ivp(slopes, (0.0, 40.0), np.zeros(3), "LSODA", at, rtol=1e-9, atol=1e-13, max_step=0.01)
    assert sticks > 2
    assert np.abs(x - true.y[0]).max() < 2e-3 * np.ptp(x)


@cached()
def pull_by_spring(row, mass, stiffness, pull, h, position, speed):
    v, x, z = 0.0, 0.0, 0.0
    for n in range(position.shape[0]):
        # Staggered: the position of the step's middle gives the force of the step.
        x += h * v
        force = stiffness * (pull * (n + 0.5) * h - x)
        friction, z = bristle_torque(v, force, mass, h, z, row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        v += h / mass * (force + friction)
        position[n] = x
        speed[n] = v


def pulled(n, h, stiffness, pull):
    """Return positions every 10 ms, the number of times the mass came to stick, and the times."""
    position, speed = np.zeros((2, n))
    pull_by_spring(np.array(ROW), MASS, stiffness, pull, h, position, speed)
    every = round(0.01 / h)
    still = np.abs(speed) < 1e-3
    return position[::every], int(np.sum(still[1:] & ~still[:-1])), (np.arange(n)[::every] + 0.5) * h


# --- a load ---------------------------------------------------------------------------------------------------------
FIELDS = ("coulomb", "breakaway", "viscous")


def machine(name="inertia", friction="lugre", h=H, **parameters):
    axes = (1, 1)
    values = {key: np.array([value]) for key, value in parameters.items()}
    return PackedLoad(LOADS[name], np.full(axes, J_M), np.zeros((*axes, 4)), values, h, friction=friction)


def turned(load, torque, h=H):
    found = stepped(load.plant, torque, h)
    return found.theta[:, 0], found.omega[:, 0]


def lugre_of(load):
    """Return LuGre's parameters of a one-joint load at its rotor, from the row as written: s_0 = F_s / bristle."""
    row, gear = load.load.frictions[0], load.load.gears[0]
    mass = J_M * gear**2 + (J_L if load.load.name == "inertia" else float(load.get("mass")[0]))
    stiffness = row.breakaway / row.bristle
    damping = math.sqrt(stiffness * mass)  # damping ratio 0.5
    return (stiffness, damping, row.coulomb, row.breakaway, row.stribeck, row.viscous, 0.0), mass


PULSES = {  # torque [N*m] over time; of the break-away torque of 3e-3
    "pre-sliding": lambda t: 2.7e-3 * np.sin(2 * np.pi * 2 * t),
    "a slow ramp through break-away": lambda t: 4e-3 * t,
    "there and back again": lambda t: 5e-3 * np.sin(2 * np.pi * 1.5 * t),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", PULSES)
def test_a_packed_load_follows_the_equations(kind):
    load = machine("inertia")
    row, mass = lugre_of(load)
    middle, end = times(1.0)
    theta, omega = turned(load, PULSES[kind](middle))
    true = oracle(PULSES[kind], end, row, mass).y
    assert np.abs(theta - true[0]).max() < 1e-4 * np.ptp(true[0])
    assert np.abs(omega - true[1]).max() < 5e-4 * np.abs(true[1]).max()


def test_bristles_scale_with_the_machine():
    """Twice the break-away torque is held by bristles of twice the stiffness: the same deflection."""
    seen = []
    for scale in (1.0, 2.0):
        load = machine("inertia", coulomb=scale * 2e-3, breakaway=scale * 3e-3)
        middle, _ = times(0.5)
        seen.append(turned(load, scale * 1.5e-3 * np.sin(np.pi * middle))[0].max())
    assert seen[1] == pytest.approx(seen[0], rel=0.02)
    assert 0.4e-3 < seen[0] < 1.1e-3  # of a bristle of 1 mrad at half of break-away


@pytest.mark.parametrize("name", sorted(LOADS))
def test_every_load_stands_still_on_its_bristles(name):
    """No torque: what hangs or stands on dry friction settles, and nothing shakes."""
    with EmulatedDrives(load=name, friction="lugre", num_threads=1) as drives:
        drives.machine.brake = "closed"
        drives.advance(0.3)
        assert not drives.machine.diverged.any()
        assert np.abs(drives.machine.rotor_speed).max() < 1e-3


# --- stability and the solver inside --------------------------------------------------------------------------------
def mean_force(u, z, h, row):
    """Return the mean friction of a step at a held speed u, by integrating the bristles' linear equation exactly."""
    s_0, s_1, _, _, _, viscous, drag = row
    rate = s_0 * abs(u) / sliding(u, row)
    if rate * h < 1e-6:
        end = z + h * u - h * rate * (z + 0.5 * h * u)
        mean = z + 0.5 * h * u
    else:
        rest = u / rate
        end = rest + (z - rest) * math.exp(-rate * h)
        mean = rest - (z - rest) * math.expm1(-rate * h) / (rate * h)
    return s_0 * mean + s_1 * (end - z) / h + viscous * u + drag * abs(u) * u, end


@pytest.mark.slow
@settings(max_examples=1500, deadline=None, derandomize=True)
@given(
    v=st.floats(-1e4, 1e4) | st.floats(-1.0, 1.0) | st.floats(-1e-4, 1e-4),
    other=st.floats(-10.0, 10.0),
    mass=st.floats(-7.0, 2.0).map(lambda e: 10.0**e),
    h=st.sampled_from([20e-6, 62.5e-6, 200e-6, 1e-3]),
    deflection=st.floats(-1.0, 1.0),
    stiffness=st.floats(-1.0, 10.0).map(lambda e: 10.0**e),
    coulomb=st.floats(-6.0, 2.0).map(lambda e: 10.0**e),
    rise=st.floats(1.0, 3.0),
    stribeck=st.floats(-4.0, 1.0).map(lambda e: 10.0**e),
    viscous=st.sampled_from([0.0, 1e-5, 0.4, 20.0]),
    drag=st.sampled_from([0.0, 1e-6, 1e-2]),
)
@example(1e-3, 1.4, 1.0, 2e-4, 0.9, 1e5, 1.0, 1.5, 1e-3, 0.4, 0.0)
def test_the_step_solves_its_equation(v, other, mass, h, deflection, stiffness, coulomb, rise, stribeck, viscous, drag):
    """u = v + h/2m (other - F(u)): friction is wrong by below 1e-6 of the forces at play, or a speed's rounding."""
    row = (stiffness, math.sqrt(stiffness * mass), coulomb, rise * coulomb, stribeck, viscous, drag)
    z = deflection * rise * coulomb / stiffness
    friction, end = bristle_torque(v, other, mass, h, z, *row)
    assert math.isfinite(friction)
    half = 0.5 * h / mass
    u = v + half * (other + friction)
    force, true_end = mean_force(u, z, h, row)
    scale = abs(friction) + abs(other) + rise * coulomb
    # Stiff bristles make much of the little by which u is wrong where the friction is: 1 + h/2m dF/du times its error.
    nearby = 1e-4 * abs(u) + 1e-12 * half * scale
    slope = abs(mean_force(u + nearby, z, h, row)[0] - mean_force(u - nearby, z, h, row)[0]) / (2 * nearby)
    error = 1e-6 * scale * (1 + half * slope)
    # What a speed rounded to 1e-12 of itself makes of the force.
    rounded = 1e-11 * (abs(v) + abs(u)) * (mass / h + row[1] + viscous + stiffness * h + 2 * drag * abs(u))
    assert abs(force + friction) < error + rounded
    assert abs(end - true_end) < 1e-6 * rise * coulomb / stiffness + h * (half * error + 1e-11 * (abs(v) + abs(u)))
    # Bristles never bend farther than break-away does.
    assert abs(end) <= (1 + 1e-9) * rise * coulomb / stiffness


@pytest.mark.parametrize("stiffness", [1e5, 1e8, 1e12])
@pytest.mark.parametrize("v", [1e-3, 1.0, 1e4])
def test_stiff_bristles_and_high_speeds_brake_to_rest(v, stiffness):
    """No chatter: the mass coasts down as Coulomb says and stays, however stiff the bristles and fast the mass."""
    row = (stiffness, math.sqrt(stiffness), 1.0, 1.0, V_S, 0.0, 0.0)
    h = max(H, v / 20_000)
    n = round(v / h) + 2_000
    seen = np.zeros((n, 3))
    coast(np.array(row), v, h, seen)
    speed = seen[:, 1]
    assert np.all(np.abs(speed) <= v * (1 + 1e-12))
    # It rings on its bristles at most: a Coulomb force over the bristles' frequency.
    assert speed.min() > -1.0 / math.sqrt(stiffness) - h
    # What rings on is a thousandth of what the friction changes in a step.
    assert np.abs(speed[-10:]).max() < 1e-3 * h
    assert seen[-1, 0] == pytest.approx(0.5 * v * v, rel=2e-2, abs=2.0 / stiffness + v * h)


@cached()
def coast(row, v, h, seen):
    x, z = 0.0, 0.0
    for n in range(seen.shape[0]):
        friction, z = bristle_torque(v, 0.0, 1.0, h, z, row[0], row[1], row[2], row[3], row[4], row[5], row[6])
        v_end = v + h * friction
        x += 0.5 * h * (v + v_end)
        v = v_end
        seen[n] = x, v, friction


# --- the rows of friction.py ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "holds", "sliding_friction", "yields"),
    [  # torque that it just holds; friction at 100 rad/s; whether it yields to half of what it holds
        ("none", 0.0, 0.0, True),
        ("coulomb_viscous", 2e-3, 2e-3 + 5e-6 * 100, False),
        ("stribeck", 3e-3, 2e-3 + 5e-6 * 100, False),
        ("lugre", 3e-3, 2e-3 + 5e-6 * 100, True),
    ],
)
def test_a_row_of_friction_means(name, holds, sliding_friction, yields):
    values = {"coulomb": 2e-3, "breakaway": 3e-3, "viscous": 5e-6}
    above = machine("inertia", name, **values)
    assert abs(turned(above, np.full(2500, 1.02 * holds + 1e-4))[1][-1]) > 1.0
    if holds:
        # A slow ramp, which LuGre's bristles bear without slipping.
        below = machine("inertia", name, **values)
        theta, omega = turned(below, np.linspace(0.0, 0.97 * holds, 2500))
        assert abs(omega[-1]) < 0.05
        assert (theta[1250] > 1e-5) == yields
    fast = machine("inertia", name, **values)
    fast.data.qvel[:] = 100.0
    omega = turned(fast, np.zeros(200))[1]
    # Bristles have to bend first: 1 mrad at 100 rad/s is no time.
    found = -(omega[199] - omega[99]) / (100 * H) * (J_M + J_L)
    slowed = 5e-6 * (100 - 0.5 * (omega[199] + omega[99])) if sliding_friction else 0.0
    assert found == pytest.approx(sliding_friction - slowed, rel=1e-3, abs=1e-12)


def test_a_fan_s_drag_is_its_load_and_always_there():
    for name in FRICTION_MODELS:
        fan = machine("fan", name)
        fan.data.qvel[:] = 300.0
        omega = turned(fan, np.zeros(2))[1]
        dry = 0.0 if name == "none" else 1e-3 + 1e-6 * 300
        assert -np.diff(omega)[0] / H * (J_M + 1.2e-5) == pytest.approx(3.5e-7 * 300**2 + dry, rel=0.01)


def test_bearings_of_the_motor_keep_theirs():
    """They are the motor's row; `ideal` is what takes them away."""
    bearing = np.array([[[1.5e-3, 1.5e-3, 1.0, 0.0]]])
    load = PackedLoad(LOADS["inertia"], np.full((1, 1), J_M), bearing, {}, H, friction="none")
    assert np.all(turned(load, np.full(500, 1.4e-3))[1] == 0.0)


def test_a_bristle_without_length_is_stribeck_s_law():
    row = LOADS["inertia"].frictions[0]._replace(bristle=0.0)
    rigid = replace(LOADS["inertia"], frictions=(row,))
    load = PackedLoad(rigid, np.full((1, 1), J_M), np.zeros((1, 1, 4)), {}, H, friction="lugre")
    middle, _ = times(0.5)
    torque = 5e-3 * np.sin(2 * np.pi * 2 * middle)
    assert np.array_equal(turned(load, torque), turned(machine("inertia", "stribeck"), torque))


def test_an_unknown_friction_is_answered_with_those_there_are():
    text = r"no friction is named 'dahl'; there are none, coulomb_viscous, stribeck, lugre"
    with pytest.raises(ValueError, match=text):
        find_friction("dahl")
    with pytest.raises(ValueError, match=text):
        EmulatedDrives(load="inertia", friction="dahl")
