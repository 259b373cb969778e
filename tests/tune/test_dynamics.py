"""Dynamics: a region around -1 that is kept exactly when the margins are, names and numbers, linear machines, steps."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rigs.known_machines import machine_of

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.devices.gains import bandwidth_gains, cascade_columns
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.emulator.parameters import velocity_filter
from drive_env.loops.dynamics import DEFAULT, OFF_NOMINAL, Dynamics, find_dynamics, known_dynamics, loop_clearance
from drive_env.loops.linear_model import position_open_loop, velocity_open_loop
from drive_env.loops.margins import margins
from drive_env.loops.sampled import CascadeGains, LoopRates, closed_loops, open_loops, step_overshoot, window
from drive_env.loops.true_plant import true_machines
from drive_env.motors import find_motor

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
RATES = LoopRates.of(DEVICE)
P = cascade_columns(DEVICE)[2]
STANDARD = find_dynamics("standard")


# --- the table, and what is asked for by name or by numbers -----------------------------------------------------------
@pytest.mark.parametrize(("name", "phase_deg", "gain_db", "ms"), [
    ("soft", 60.0, 12.0, 1.5),
    ("standard", 45.0, 8.0, 2.0),
    ("stiff", 35.0, 6.0, 2.5),
])  # fmt: skip
def test_dynamics_by_name(name, phase_deg, gain_db, ms):
    found = find_dynamics(name)
    assert (found.name, found.phase_deg, found.gain_db, found.ms) == (name, phase_deg, gain_db, ms)
    assert find_dynamics(found) is found


def test_there_are_three_and_each_asks_less_than_the_one_before():
    assert list(known_dynamics()) == ["soft", "standard", "stiff"] and DEFAULT == "standard"
    rows = list(known_dynamics().values())
    for one, next_one in pairwise(rows):
        assert one.phase_deg > next_one.phase_deg and one.gain_db > next_one.gain_db
        assert one.ms < next_one.ms and one.overshoot < next_one.overshoot
    assert [row.overshoot for row in rows] == [0.10, 0.20, 0.35]


@pytest.mark.parametrize(("text", "expected", "overshoot"), [
    ("45/8/2.0", (45.0, 8.0, 2.0), 0.20),
    ("50/9/1.75", (50.0, 9.0, 1.75), 0.15),   # halfway between soft and standard
    ("38.5/7/2.25", (38.5, 7.0, 2.25), 0.275),
    ("70/15/1.2", (70.0, 15.0, 1.2), 0.10),   # softer than soft: its overshoot
    ("20/3/5", (20.0, 3.0, 5.0), 0.35),
])  # fmt: skip
def test_dynamics_by_numbers(text, expected, overshoot):
    found = find_dynamics(text)
    assert (found.phase_deg, found.gain_db, found.ms) == expected and found.name == text
    assert found.overshoot == pytest.approx(overshoot)


ASKED = "give soft, standard, stiff, or phase margin/gain margin/Ms as 45/8/2.0"
BOUNDS = "; a phase margin lies between 0 and 90 degrees, a gain margin between 0 and 40 dB, and Ms between 1 and 10"


@pytest.mark.parametrize(("text", "reason"), [
    ("harsh", ""),
    ("Soft", ""),
    ("", ""),
    ("45/8", ""),
    ("45/8/2/1", ""),
    ("45/8/x", ""),
    ("0/8/2", BOUNDS),
    ("90/8/2", BOUNDS),
    ("45/0/2", BOUNDS),
    ("45/40/2", BOUNDS),
    ("45/8/1", BOUNDS),
    ("45/8/10", BOUNDS),
    ("-45/8/2", BOUNDS),
    ("nan/8/2", BOUNDS),
    ("45/nan/2", BOUNDS),
    ("45/8/nan", BOUNDS),
])  # fmt: skip
def test_dynamics_that_do_not_exist(text, reason):
    with pytest.raises(ValueError) as refusal:
        find_dynamics(text)
    assert str(refusal.value) == f"dynamics {text!r}: {ASKED}{reason}"


def test_the_load_inertia_that_loops_must_bear():
    assert find_dynamics("soft").inertia_range == (0.5, 2.0)
    wide = find_dynamics("soft", "0.25/4")
    assert wide.inertia_range == (0.25, 4.0) and replace(wide, inertia_range=(0.5, 2.0)) == find_dynamics("soft")
    assert find_dynamics(wide) is wide and find_dynamics(wide, (1.0, 1.5)).inertia_range == (1.0, 1.5)


RANGE = "give the least and the greatest load inertia over the one it is tuned with, as 0.5/2"
WITHIN = "; the least lies between 0.2 and 1, the greatest between 1 and 5"


@pytest.mark.parametrize(("given", "reason"), [
    ("2", ""), ("0.5/1/2", ""), ("half/twice", ""), ("", ""), ((0.5,), ""),
    ("2/0.5", WITHIN), ("0.1/2", WITHIN), ("0.5/6", WITHIN), ("1.1/2", WITHIN), ("0.5/0.9", WITHIN), ("nan/2", WITHIN),
    ((0.5, np.inf), WITHIN),
])  # fmt: skip
def test_ranges_of_inertia_that_are_none(given, reason):
    with pytest.raises(ValueError) as refusal:
        find_dynamics("standard", given)
    assert str(refusal.value) == f"inertia range {given!r}: {RANGE}{reason}"


# --- the region around -1 ---------------------------------------------------------------------------------------------
F = np.geomspace(1.0, 2400.0, 4000)


def random_loops(count):
    """Return open loops of a velocity loop, (count, n): integrator, PI, delay, half with anti-resonance, resonance."""
    rng, s, loops = np.random.default_rng(1), 2j * np.pi * F, []
    while len(loops) < count:
        w = rng.uniform(50.0, 900.0)
        L = w / s * (1.0 + 1.0 / (rng.uniform(1.0, 8.0) / w * s)) * np.exp(-1e-3 * s)
        if len(loops) % 2:
            w_r, damping, share = (
                2.0 * np.pi * rng.uniform(40.0, 400.0),
                rng.uniform(0.005, 0.05),
                rng.uniform(0.5, 0.95),
            )
            w_a = share * w_r
            L *= (s**2 + 2 * damping * w_a * s + w_a**2) / (s**2 + 2 * damping * w_r * s + w_r**2) / share**2
        loops.append(L)
    return np.array(loops)


def three_margins(L):
    """Return phase margin [degrees], gain margin up and down [dB] and Ms, by crossings looked for one by one."""
    gain, off = 20.0 * np.log10(np.abs(L)), np.degrees(np.angle(-L))
    phase, gains = [np.inf], [np.inf]
    for k in range(len(L) - 1):
        if (gain[k] > 0.0) != (gain[k + 1] > 0.0):
            share = gain[k] / (gain[k] - gain[k + 1])
            turn = (off[k + 1] - off[k] + 180.0) % 360.0 - 180.0
            phase.append(abs((off[k] + share * turn + 180.0) % 360.0 - 180.0))
        if (off[k] > 0.0) != (off[k + 1] > 0.0) and abs(off[k + 1] - off[k]) < 180.0:
            share = off[k] / (off[k] - off[k + 1])
            gains.append(abs(gain[k] + share * (gain[k + 1] - gain[k])))
    return min(phase), min(gains), float((1.0 / np.abs(1.0 + L)).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["soft", "standard", "stiff", "50/9/1.7", "30/10/3"])
def test_the_clearance_is_at_least_1_exactly_when_all_margins_are_kept(name):
    """Where it is within 0.5 % of 1 both may differ by how they interpolate."""
    dynamics, kept = find_dynamics(name), 0
    loops = random_loops(300)
    clearance = dynamics.clearance(loops)
    assert clearance.shape == (300,)
    for L, least in zip(loops, clearance, strict=True):
        phase, gain, ms = three_margins(L)
        keeps = phase >= dynamics.phase_deg and gain >= dynamics.gain_db and ms <= dynamics.ms
        kept += keeps
        found = margins(F, L)
        assert abs(found.phase_deg) == pytest.approx(phase, abs=0.2) or phase == np.inf
        assert found.ms == pytest.approx(ms)
        if abs(least - 1.0) > 0.005:
            assert keeps == (least > 1.0), (least, phase, gain, ms)
    assert 20 < kept < 280, "the loops are on both sides"


def test_each_margin_by_itself():
    """Loops that pass three points: where |L| is 1, where L is real, and where it is nearest to -1."""
    d = Dynamics("", 40.0, 6.0, 2.0, 0.2)
    angle = np.radians(np.linspace(-10.0, -179.9, 20_000))
    for phase in (20.0, 40.0, 60.0):  # |L| falls through 1 at -180 degrees + phase, and is never near -1 elsewhere
        at = np.radians(-180.0 + phase)
        L = np.exp(-8.0 * (at - angle)) * np.exp(1j * np.linspace(-np.pi + np.radians(phase), at, 20_000))
        assert d.clearance(L) == pytest.approx(min(phase / 40.0, 2.0 * np.abs(1.0 + L).min()), rel=1e-3)
    for decibels in (3.0, 6.0, -3.0, -6.0, 9.0):  # it crosses the real axis at one gain, straight down
        L = -(10.0 ** (-decibels / 20.0)) + 1j * np.linspace(2.0, -2.0, 10_001)
        sensitivity = 2.0 * np.abs(1.0 + L).min()
        found = float(d.clearance(L))
        assert found <= min(abs(decibels) / 6.0, sensitivity) + 1e-9
    wide = Dynamics("", 1.0, 0.1, 2.0, 0.2)  # nothing but Ms
    assert wide.clearance(np.array([-0.5 + 0.3j, -0.7 + 0.31j, -0.9 + 0.32j])) == pytest.approx(
        2.0 * min(abs(0.5 + 0.3j), abs(0.3 + 0.31j), abs(0.1 + 0.32j))
    )


@pytest.mark.parametrize("name", ["soft", "stiff"])
def test_the_edge_of_the_region_goes_through_its_margins_and_has_a_clearance_of_1(name):
    d = find_dynamics(name)
    phase, gain = d.region()
    assert (phase.max(), phase.min()) == pytest.approx((d.phase_deg, -d.phase_deg))
    assert (gain.max(), gain.min()) == pytest.approx((d.gain_db, -d.gain_db))
    L = -(10.0 ** (gain / 20.0)) * np.exp(1j * np.radians(phase))
    on_circle = np.isclose(np.abs(1.0 + L), 1.0 / d.ms, rtol=1e-6)
    assert on_circle.mean() > 0.5
    assert (np.abs(1.0 + L) > 1.0 / d.ms - 1e-9).all(), "no point of the edge is inside the circle"
    for point in L[1::7]:
        assert d.clearance(np.array([point, point])) == pytest.approx(1.0, abs=1e-6)


def test_at_minus_1_the_clearance_is_0_and_it_is_even_to_either_side():
    for d in known_dynamics().values():
        assert d.clearance(np.array([-2.0 + 1e-9j, -1.0, -0.5 - 1e-9j])) == pytest.approx(0.0, abs=1e-6)
        near = np.exp(1j * np.radians(np.linspace(100.0, 150.0, 200))) * np.linspace(2.0, 0.5, 200)
        assert d.clearance(near) == pytest.approx(d.clearance(near.conj()))


def test_the_clearance_is_continuous_where_a_resonance_begins_to_cross_over():
    """A phase margin jumps there, as its crossing appears; the region does not care. 1 % of gain moves it by little."""
    s = 2j * np.pi * F
    w_r, damping = 2.0 * np.pi * 300.0, 0.01
    L = 60.0 / s * w_r**2 / (s**2 + 2 * damping * w_r * s + w_r**2) * np.exp(-5e-4 * s)
    gains = np.geomspace(0.2, 10.0, 500)
    below = [float(STANDARD.clearance(k * L)) for k in gains]
    phases = [margins(F, k * L).phase_deg for k in gains]
    assert np.abs(np.diff(phases)).max() > 30.0
    assert np.abs(np.diff(below)).max() < 0.05


def test_between_the_ends_of_the_margins_the_region_is_the_circle_of_ms_alone():
    """What closes it adds slivers along the lines of both margins, thinner than 17 % of their ends."""
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 801), np.linspace(-1.2, 1.2, 801))
    for d in known_dynamics().values():
        L = -(10.0 ** (d.gain_db * y / 20.0)) * np.exp(1j * np.radians(d.phase_deg * x))
        refused = d.clearance(np.stack([L, L], axis=-1)) < 1.0
        beyond_ms = refused & (d.ms * np.abs(1.0 + L) > 1.0)
        assert refused[d.ms * np.abs(1.0 + L) < 1.0].all() and beyond_ms.any()
        assert np.minimum(np.abs(x), np.abs(y))[beyond_ms].max() < 0.17


# --- slack ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("nominal", "variants", "overshoot", "slack"), [
    (1.25, [1.0, 1.0], 0.0, 0.25),
    (0.75, [1.0, 1.0], 0.0, -0.25),
    (1.5, [0.4, 1.0], 0.0, 0.0),      # a variant is asked for a region smaller by OFF_NOMINAL
    (1.5, [1.0, 0.2], 0.0, -0.5),
    (1.5, [1.0, -1.0], 0.0, -3.5),    # unstable
    (1.5, [1.0, 1.0], 0.2, 0.0),      # of 20 % in standard
    (1.5, [1.0, 1.0], 0.4, -1.0),
    (1.5, [1.0, 1.0], 1.0, -4.0),
    (1.5, [1.0, 1.0], np.inf, -4.0),  # nothing overshoots by more than all of it
    (-1.0, [-1.0, -1.0], np.inf, -4.0),
])  # fmt: skip
def test_slack_is_relative_to_each_constraint_and_the_least_counts(nominal, variants, overshoot, slack):
    found = STANDARD.slack(np.array([nominal]), np.array([variants]), np.array([overshoot]))
    assert found == pytest.approx([slack])
    assert OFF_NOMINAL == 0.4


def test_without_variants_the_machine_as_it_is_counts():
    assert STANDARD.slack(np.array([1.25]), np.zeros((1, 0)), np.zeros(1)) == pytest.approx([0.25])


# --- the true linear machine ------------------------------------------------------------------------------------------
def gains_for(inertia, velocity, position, integration=5.0):
    return bandwidth_gains(
        DEVICE, MOTOR, inertia, current_hz=1000.0, velocity_hz=velocity, position_hz=position, integration=integration
    )


def of_raw(raw, axes=1):
    return CascadeGains.of(DEVICE, np.broadcast_to(np.asarray(raw), (1, axes, 5)))


@pytest.mark.parametrize(("load", "within"), [("inertia", 1e-9), ("two_mass", 1e-2)])
def test_open_loops_of_a_machine_are_those_of_its_plant(load, within):
    machines, inertia, plant = machine_of(load)
    raw = gains_for(inertia, 30.0, 8.0)
    f = np.geomspace(1.0, 2000.0, 400)
    found = open_loops(RATES, machines, of_raw(raw), f[None])
    velocity, position = (loop(DEVICE, plant, raw, f) for loop in (velocity_open_loop, position_open_loop))
    # At the anti-resonance, where they are nearly 0, a percent of themselves is nothing.
    near = within if load == "inertia" else 1e-3
    np.testing.assert_allclose(found.velocity[0, 0], velocity, rtol=within, atol=near)
    np.testing.assert_allclose(found.position[0, 0], position, rtol=within, atol=near)


def test_machines_side_by_side_are_those_alone():
    with EmulatedDrives(load="two_mass", num_machines=3, num_threads=1, distinct=1) as drives:
        stiffness = drives.machine.parameters["load.stiffness"][0]
        drives.machine.set_all({"load.stiffness": stiffness * np.array([0.5, 1.0, 2.0])})
        three = true_machines(drives)
    raw = np.broadcast_to(gains_for(1.5e-5, 20.0, 5.0), (3, 1, 5))
    f = np.geomspace(1.0, 2000.0, 50) * np.ones((3, 1))
    together = open_loops(RATES, three, CascadeGains.of(DEVICE, raw), f)
    clear, over = loop_clearance(STANDARD, RATES, three, CascadeGains.of(DEVICE, raw))
    assert clear.shape == over.shape == (3,) and len({*clear.tolist()}) == 3
    of_variants = loop_clearance(STANDARD, RATES, three, CascadeGains.of(DEVICE, raw), 3)
    assert [part.tolist() for part in of_variants] == [clear.tolist(), over[:1].tolist()], "of the first the step alone"
    for k in range(3):
        one = type(three)(*(values[k : k + 1] for values in three))
        alone = open_loops(RATES, one, CascadeGains.of(DEVICE, raw[:1]), f[:1])
        np.testing.assert_allclose(together.velocity[k], alone.velocity[0], rtol=1e-9)
        np.testing.assert_allclose(together.position[k], alone.position[0], rtol=1e-9)
        of_one = loop_clearance(STANDARD, RATES, one, CascadeGains.of(DEVICE, raw[:1]))
        assert (of_one[0][0], of_one[1][0]) == pytest.approx((clear[k], over[k]), rel=1e-6)


def cut(machines, gains, axis, f, what):
    """Return the loop of one axis with all others closed: the closed machine, one feedback of it cut by hand.

    The error of the axis's regulator becomes an input, and what the feedback would answer is read: L is minus that.
    """
    rate = RATES.velocity_rate
    one = window(RATES, machines, gains)
    closed = closed_loops(RATES, machines, gains, one)
    size, axes = one.H.shape[1], one.H.shape[2]
    z = np.exp(2j * np.pi * f / rate)
    A = closed.A[0].copy()
    mean, first, _, total, angle = (slice(size + k * axes, size + (k + 1) * axes) for k in range(5))
    b = velocity_filter(machines.velocity_filter, rate)[0][0, axis]
    P, share, outer = (float(gains[k][0, axis]) for k in (2, 3, 4))
    filtered, place = np.zeros(len(A)), np.zeros(len(A))
    filtered[mean.start + axis], filtered[first.start + axis] = b, 1.0
    place[mean.start + axis], place[angle.start + axis] = 1.0 / rate, 1.0
    summed = -outer * place - filtered
    summed[total.start + axis] += 1.0
    H, turned = one.H[0][:, axis], rate * one.turn_of_demand[0][:, axis]
    into = np.zeros(len(A))  # what a unit of the axis's error does to the states, through P and I
    into[:size], into[mean], into[total.start + axis] = P * (1.0 + share) * H, P * (1.0 + share) * turned, 1.0
    parts = {"velocity": -filtered, "position": -outer * place}
    np.testing.assert_allclose(closed.A[0][total.start + axis], summed, atol=1e-12)  # the order of states
    A -= np.outer(into, parts[what])
    response = np.array([np.linalg.solve(one_z * np.eye(len(A)) - A, into) for one_z in z])
    return -(response @ parts[what])


@pytest.mark.parametrize(("load", "axis"), [("inertia", 0), ("gantry", 0), ("gantry", 1)])
def test_the_loop_of_an_axis_has_those_of_the_others_closed(load, axis):
    """Independently: cut one feedback of the closed machine, in the time domain's states, and look at its answer.

    The velocity loop is cut with the position loop of its own axis open, since that is how it is tuned.
    """
    axes = 2 if load == "gantry" else 1
    machines, inertia, _ = machine_of(load, axes)
    raw = np.stack([gains_for(inertia, 25.0, 6.0), gains_for(inertia, 40.0, 9.0)])[:axes]
    f = np.geomspace(1.0, 1500.0, 60)
    gains = CascadeGains.of(DEVICE, raw[None])
    found = open_loops(RATES, machines, gains, f[None])
    np.testing.assert_allclose(cut(machines, gains, axis, f, "position"), found.position[0, axis], rtol=1e-6)
    held = gains.position.copy()
    held[0, axis] = 0.0
    open_axis = gains._replace(position=held)
    np.testing.assert_allclose(cut(machines, open_axis, axis, f, "velocity"), found.velocity[0, axis], rtol=1e-6)


# --- stability: the border is the emulated machine's ------------------------------------------------------------------
def border(machines, raw):
    """Return the factor of velocity P above which the closed loops grow, to 0.1 %."""
    low, high = 1.0, 20.0

    def grows(factor):
        gains = raw.astype(float).copy()
        gains[P] *= factor
        one = of_raw(gains)
        return closed_loops(RATES, machines, one, window(RATES, machines, one)).growth[0] > 0.0

    assert not grows(low) and grows(high)
    while high / low > 1.001:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return low


def swing_in_csp(load, raw):
    """Return the RMS current [A] of an emulated machine 0.4 s after a kick in csp, which then holds its place.

    The kick is of 250 counts: what swings by less than a count of the encoder is not seen, and dies away.
    """
    with EmulatedDrives(load=load, num_threads=1, friction="none") as drives:
        write_gains(drives, raw[None])
        assert read_gains(drives).tolist() == [raw.tolist()]
        motion.enable(drives, mode="csp")
        drives.advance(0.1)
        drives.write(cia402.TARGET_POSITION, drives.read(cia402.POSITION_ACTUAL) + 4000)
        drives.advance(0.4)
        return 1e-3 * float(drives.record([cia402.TORQUE_ACTUAL], 0.05)[cia402.TORQUE_ACTUAL][:, 0].std())


@pytest.mark.parametrize(("load", "velocity"), [("inertia", 60.0), ("two_mass", 20.0), ("belt", 30.0)])
def test_loops_grow_exactly_where_an_emulated_machine_oscillates(load, velocity):
    """A tenth below the border it is calm; a tenth above it swings, until the voltage or the current is at its end."""
    machines, inertia, _ = machine_of(load)
    raw = gains_for(inertia, velocity, 5.0)
    factor = border(machines, raw)
    for share, swings in ((0.7, False), (0.9, False), (1.1, True), (1.3, True)):
        gains = raw.copy()
        gains[P] = round(raw[P] * factor * share)
        one = of_raw(gains)
        growth = closed_loops(RATES, machines, one, window(RATES, machines, one)).growth[0]
        assert (growth > 0.0) == swings
        clearance, overshoot = loop_clearance(STANDARD, RATES, machines, one)
        assert (clearance[0] < 0.0) == swings and np.isinf(overshoot[0]) == swings
        current = swing_in_csp(load, gains)  # A; 3.5 are rated, and rest shows 0.03
        assert current > 3.0 if swings else current < 0.1, (share, current)


def test_how_fast_it_grows_says_how_unstable():
    machines, inertia, _ = machine_of("inertia")
    raw = gains_for(inertia, 60.0, 5.0)
    factor, found = border(machines, raw), []
    for share in (0.95, 0.995, 1.005, 1.05, 3.0):
        gains = raw.astype(float).copy()
        gains[P] *= factor * share
        found.append(float(loop_clearance(STANDARD, RATES, machines, of_raw(gains))[0][0]))
    assert found == sorted(found, reverse=True) and found[1] > 0.0 > found[2]
    assert found[1] < 0.1 and found[2] > -0.1, "it passes 0 where the machine becomes unstable"
    assert found[-1] == -1.0


# --- a step in csp ----------------------------------------------------------------------------------------------------
STEP = 50  # counts of the encoder


@pytest.mark.parametrize(("velocity", "position", "integration", "low", "high"), [
    (60.0, 10.0, 8.0, 0.0, 0.03),
    (60.0, 45.0, 5.0, 0.10, 0.20),
    (40.0, 70.0, 4.0, 0.35, 0.45),
])  # fmt: skip
def test_a_step_overshoots_as_the_emulated_axis_does(velocity, position, integration, low, high):
    machines, inertia, _ = machine_of("inertia")
    raw = gains_for(inertia, velocity, position, integration)
    one = of_raw(raw)
    expected = float(step_overshoot(RATES, closed_loops(RATES, machines, one, window(RATES, machines, one)))[0, 0])
    with EmulatedDrives(load="inertia", num_threads=1, friction="none") as drives:
        write_gains(drives, raw[None])
        motion.enable(drives, mode="csp")
        drives.advance(0.2)
        start = int(drives.read(cia402.POSITION_ACTUAL)[0])
        step = STEP * 65536 // MOTOR.encoder_counts
        drives.write(cia402.TARGET_POSITION, start + step)
        found = drives.record([cia402.POSITION_ACTUAL], 0.3)[cia402.POSITION_ACTUAL][:, 0].max()
    assert low <= expected <= high
    assert (found - start) / step - 1.0 == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(("position", "low", "high"), [(15.0, 0.0, 0.03), (45.0, 0.15, 0.25), (60.0, 0.25, 0.35)])
def test_of_coupled_axes_the_step_of_all_of_them_counts_too(position, low, high):
    """Each of a gantry's drives alone is held by the other one through the bridge, and never overshoots."""
    machines, _, _ = machine_of("gantry", axes=2)
    raw = np.repeat(gains_for(4.0 * MOTOR.inertia, 45.0, position)[None], 2, axis=0)
    one = CascadeGains.of(DEVICE, raw[None])
    closed = closed_loops(RATES, machines, one, window(RATES, machines, one))
    expected = step_overshoot(RATES, closed)[0]
    assert (low <= expected).all() and (expected <= high).all()
    with EmulatedDrives(load="gantry", num_threads=1, friction="none") as drives:
        write_gains(drives, raw)
        motion.enable(drives, mode="csp")
        drives.advance(0.2)
        start = drives.read(cia402.POSITION_ACTUAL)
        step = STEP * 65536 // MOTOR.encoder_counts
        drives.write(cia402.TARGET_POSITION, start + step)
        found = drives.record([cia402.POSITION_ACTUAL], 0.3)[cia402.POSITION_ACTUAL].max(axis=0)
    assert (found - start) / step - 1.0 == pytest.approx(expected, abs=0.04)
