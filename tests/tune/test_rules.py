"""Rules against their textbooks, on plants that fit their assumptions; and what becomes of them as integers."""

from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.chip_gains import Gains
from rigs.known_machines import true_plant
from scipy import signal

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.devices.gains import RAW_MAX, gains_in_si
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.parameters import velocity_filter
from drive_env.loops.dynamics import find_dynamics
from drive_env.loops.linear_model import OPEN_LOOPS, Plant, current_open_loop, position_open_loop, velocity_open_loop
from drive_env.loops.margins import Margins, margins
from drive_env.motors import MOTORS, find_motor
from tuning.compare import side_by_side
from tuning.compare.side_by_side import outer_margins, slacks
from tuning.estimate import Estimate, refused
from tuning.identify.identified_axis import Identification
from tuning.rules.internal_model import imc_first_order, simc_first_order, simc_integrating
from tuning.rules.lags import current_lag, slow_enough, velocity_lag, velocity_noise
from tuning.rules.margin_targets import TARGETS, _greatest
from tuning.rules.optima import modulus_optimum, symmetrical_optimum
from tuning.rules.pole_placement import place_first_order
from tuning.rules.proposal import Workbench
from tuning.rules.relay import Swing, gains_from_swing
from tuning.rules.rules_by_name import MEANINGS, RULES, propose

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
F = np.geomspace(0.5, 0.49 * DEVICE.velocity_rate, 2000)
T = 1e-3  # s, the small time constant of the textbook plants


def plant(inertia=3.0 * MOTOR.inertia, **more):
    return Plant.from_data_sheet(DEVICE, MOTOR, MOTOR.voltage, inertia, **more)


def open_loop(controller, numerator, denominator):
    """Return a PI controller, p (1 + 1/(s time)), in series with a plant, as numerator and denominator."""
    p, time = controller
    if math.isinf(time):
        return np.polymul([p], numerator), np.asarray(denominator, float)
    return np.polymul([p * time, p], numerator), np.polymul([time, 0.0], denominator)


def closed_step(numerator, denominator, until):
    t = np.linspace(0.0, until, 20_001)
    return signal.step((numerator, np.polyadd(denominator, numerator)), T=t)


def phase_margin(numerator, denominator):
    """Return phase margin [degrees] and crossover [rad/s] of an open loop."""
    w = np.geomspace(1.0, 1e6, 200_001)
    _, L = signal.freqresp((numerator, denominator), w)
    at = np.flatnonzero(np.abs(L) < 1.0)[0]
    return 180.0 + math.degrees(np.unwrap(np.angle(L))[at]), w[at]


# --- textbooks --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("gain", "large"), [(1.0, 50e-3), (40.0, 20e-3), (0.02, 1.0)])
def test_modulus_optimum_overshoots_by_4_percent_and_rises_in_five_small_time_constants(gain, large):
    loop = open_loop(modulus_optimum(gain, large, T), [gain], np.polymul([large, 1.0], [T, 1.0]))
    t, y = closed_step(*loop, 20 * T)
    assert y.max() - 1.0 == pytest.approx(0.0432, abs=2e-4)
    assert t[np.argmax(y >= 1.0)] == pytest.approx(4.7 * T, rel=0.01)
    assert phase_margin(*loop)[0] == pytest.approx(65.5, abs=0.1)


@pytest.mark.parametrize("slope", [1.0, 2400.0])
def test_symmetrical_optimum_overshoots_by_43_percent_with_36_9_degrees(slope):
    loop = open_loop(symmetrical_optimum(slope, T), [slope], [T, 1.0, 0.0])
    t, y = closed_step(*loop, 40 * T)
    assert y.max() - 1.0 == pytest.approx(0.434, abs=1e-3)
    assert t[np.argmax(y >= 1.0)] == pytest.approx(3.1 * T, rel=0.01)
    phase, crossover = phase_margin(*loop)
    assert phase == pytest.approx(36.87, abs=0.1)
    assert crossover == pytest.approx(0.5 / T, rel=1e-3)


@pytest.mark.parametrize("spread", [2.0, 3.0, 4.0])
def test_symmetrical_optimum_with_another_spread_has_the_phase_margin_of_its_formula(spread):
    loop = open_loop(symmetrical_optimum(7.0, T, spread), [7.0], [T, 1.0, 0.0])
    phase, crossover = phase_margin(*loop)
    assert phase == pytest.approx(math.degrees(math.asin((spread**2 - 1) / (spread**2 + 1))), abs=0.1)
    assert crossover == pytest.approx(1.0 / (spread * T), rel=1e-3)


def test_imc_gives_a_first_order_lag_the_closed_loop_that_was_asked_for():
    t, y = closed_step(*open_loop(imc_first_order(3.0, 0.1, 0.02), [3.0], [0.1, 1.0]), 0.2)
    np.testing.assert_allclose(y, 1.0 - np.exp(-t / 0.02), atol=1e-3)


@pytest.mark.parametrize(
    ("controller", "response", "gain_margin", "phase", "ms"),
    [  # Skogestad 2003, table 1: closed = dead; the last two columns of his table
        (simc_first_order(1.0, 1.0, 1.0, 1.0), lambda s: np.exp(-s) / (1.0 + s), 3.14, 61.4, 1.59),
        (simc_integrating(1.0, 1.0, 1.0), lambda s: np.exp(-s) / s, 2.96, 46.9, 1.70),
    ],
)
def test_simc_has_the_margins_of_its_table(controller, response, gain_margin, phase, ms):
    w = np.geomspace(1e-3, 1e2, 400_001)
    s = 1j * w
    found = margins(w / (2.0 * math.pi), controller.p * (1.0 + 1.0 / (s * controller.time)) * response(s))
    assert 10.0 ** (found.gain_db / 20.0) == pytest.approx(gain_margin, abs=0.02)
    assert found.phase_deg == pytest.approx(phase, abs=0.3)
    assert found.ms == pytest.approx(ms, abs=0.01)


@pytest.mark.parametrize(("natural", "damping"), [(50.0, 0.7), (300.0, 1.0), (80.0, 1.5)])
def test_pole_placement_places_the_poles(natural, damping):
    storage, loss = 0.4e-3, 2e-3
    p, time = place_first_order(storage, loss, natural, damping)
    poles = np.roots([storage, loss + p, p / time])
    wanted = np.roots([1.0, 2.0 * damping * natural, natural**2])
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(wanted), rtol=1e-4)


def test_poles_slower_than_the_plant_are_refused_with_the_limit():
    with pytest.raises(ValueError, match=r"natural frequency of 1 rad/s is below what the plant alone has, 50 rad/s"):
        place_first_order(1.0, 100.0, 1.0, 1.0)


# --- on the emulator --------------------------------------------------------------------------------------------------
def velocity_step(rule, corner):
    """Return the overshoot of a small velocity step of an ideal machine with viscous friction."""
    parameters = {"stage.velocity_filter": corner, "motor.viscous": 2e-5}
    parameters |= dict.fromkeys(("load.coulomb", "load.breakaway", "load.viscous"), 0.0)
    with EmulatedDrives(load="inertia", ideal=True, parameters=parameters, num_threads=1) as drives:
        proposal = propose(rule, drives.device, drives.motor, true_plant(drives))
        write_gains(drives, np.array([proposal.gains]))
        motion.enable(drives, mode="csv")
        drives.write((0x60C2, 1), 1)
        scale = 65536.0 / (2.0 * math.pi)
        trace = drives.record([0x606C], 0.06, play={0x60FF: np.full(60, round(20.0 * scale))})
        return float(trace[0x606C].max() / (20.0 * scale) - 1.0)


@pytest.mark.parametrize("corner", [200.0, 400.0])  # of the velocity filter, which is most of the lag [Hz]
def test_the_emulated_axis_overshoots_as_the_optima_say(corner):
    assert velocity_step("modulus_optimum", corner) == pytest.approx(0.043, abs=0.02)
    # True delays in place of one lag cost a few percent more.
    assert velocity_step("symmetrical_optimum", corner) == pytest.approx(0.45, abs=0.06)


def test_the_symmetrical_optimum_of_the_sampled_drive_has_its_textbook_margin():
    gains = propose("symmetrical_optimum", DEVICE, MOTOR, plant()).gains
    assert margins(F, velocity_open_loop(DEVICE, plant(), gains, F)).phase_deg == pytest.approx(36.9, abs=3.0)


# --- every rule -------------------------------------------------------------------------------------------------------
@pytest.mark.every(12)
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("motor", ["qbl4208", "ec_i_40", "class_750w", "qube_servo_3"])
def test_every_rule_proposes_integers_that_are_stable_in_every_loop(rule, motor):
    row = MOTORS[motor]
    axis = Plant.from_data_sheet(DEVICE, row, row.voltage, 3.0 * row.inertia, viscous=row.viscous)
    proposal = propose(rule, DEVICE, row, axis)
    assert all(isinstance(gain, int) and 0 <= gain <= RAW_MAX for gain in proposal.gains)
    assert set(proposal.wanted) == set(Gains._fields)
    for name, loop, f in (
        ("current", current_open_loop, np.geomspace(5.0, 0.49 * DEVICE.current_rate, 2000)),
        ("velocity", velocity_open_loop, F),
        ("position", position_open_loop, F),
    ):
        found = margins(f, loop(DEVICE, axis, proposal.gains, f))
        assert not found.phase_deg < 25.0, name
        assert found.gain_db > 6.0, name


@pytest.mark.parametrize("rule", [name for name in RULES if not name.startswith("margin")])
def test_an_elastic_load_holds_every_rule_to_half_its_anti_resonance_and_says_so(rule):
    elastic = plant(anti_resonance=40.0, resonance=70.0)
    proposal = propose(rule, DEVICE, MOTOR, elastic)
    velocity_p = gains_in_si(DEVICE, elastic.supply, proposal.gains).velocity_p
    crossover = velocity_p * elastic.torque_constant / elastic.inertia / (2.0 * math.pi)
    assert crossover == pytest.approx(20.0, rel=0.01)
    assert any("limited to 20 Hz, half the anti-resonance at 40 Hz" in note for note in proposal.notes)
    assert not any("anti-resonance" in note for note in propose(rule, DEVICE, MOTOR, plant()).notes)


def test_rules_are_known_by_name_and_each_has_a_meaning():
    assert set(RULES) == set(MEANINGS)
    with pytest.raises(ValueError, match=r"no rule is named 'ziegler'; there are modulus_optimum, .*cascade"):
        propose("ziegler", DEVICE, MOTOR, plant())


# --- margin targets ---------------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.parametrize("axis", [plant(), plant(anti_resonance=60.0, resonance=110.0)], ids=["rigid", "elastic"])
def test_margin_targets_are_kept_and_the_next_integers_would_break_them(name, axis):
    phase, gain = TARGETS[name]
    proposal = propose(name, DEVICE, MOTOR, axis)
    f = np.geomspace(0.2, 0.49 * DEVICE.velocity_rate, 3000)

    def kept(gains):
        found = margins(f, velocity_open_loop(DEVICE, axis, gains, f))
        return not found.phase_deg < phase - 0.2 and found.gain_db >= gain - 0.1

    assert kept(proposal.gains)
    raw = Gains(*proposal.gains)
    faster = raw.velocity_p * 1.03 + 1
    more = raw._replace(velocity_p=round(faster), velocity_i=round(raw.velocity_i * 1.03))
    assert not kept(more)
    current = np.geomspace(5.0, 0.49 * DEVICE.current_rate, 3000)
    assert margins(current, current_open_loop(DEVICE, axis, proposal.gains, current)).gain_db >= gain - 0.1
    position = margins(f, position_open_loop(DEVICE, axis, proposal.gains, f))
    assert not position.phase_deg < phase - 0.2
    assert position.gain_db >= gain - 0.1


# --- integers ---------------------------------------------------------------------------------------------------------
def test_what_no_integer_reaches_is_said():
    heavy = propose("simc", DEVICE, MOTOR, plant(inertia=2e-3))
    assert Gains(*heavy.gains).velocity_p == RAW_MAX
    assert heavy.wanted["velocity_p"] > 2 * RAW_MAX
    assert any("velocity P would have to be" in note and f"above {RAW_MAX} exists" in note for note in heavy.notes)


def test_outer_loops_follow_the_integer_that_was_reached_not_the_one_that_was_wanted():
    heavy = plant(inertia=2e-3)
    gains = propose("simc", DEVICE, MOTOR, heavy).gains
    si = gains_in_si(DEVICE, heavy.supply, gains)
    crossover = si.velocity_p * heavy.torque_constant / heavy.inertia
    assert si.velocity_integration == pytest.approx(4.0 / crossover, rel=0.02)
    assert si.position_p == pytest.approx(crossover / 3.0, rel=0.02)


def test_a_coarse_integer_is_said_with_its_error():
    bench = Workbench(DEVICE, plant())
    reached = bench.time("velocity", 65536.0 / DEVICE.velocity_rate / 3.4)
    assert reached == pytest.approx(65536.0 / DEVICE.velocity_rate / 3.0)
    bench.time("current", math.inf)
    for loop in ("current", "velocity", "position"):
        bench.p(loop, 1.0 if loop != "velocity" else 1e-6)
    proposal = bench.proposal()
    assert Gains(*proposal.gains)[1::2] == (0, 3)  # the integral parts
    assert any(note.startswith("velocity I would have to be 3.40; no integer comes nearer than 3, 12 % off")
               for note in proposal.notes)  # fmt: skip
    assert any("1 is the least" in note for note in proposal.notes)


def test_a_workbench_and_the_drive_mean_the_same_by_a_gain():
    bench = Workbench(DEVICE, plant())
    found = [
        bench.p("current", 2.0),
        bench.time("current", 1e-3),
        bench.p("velocity", 0.03),
        bench.time("velocity", 0.02),
    ]
    found.append(bench.p("position", 150.0))
    np.testing.assert_allclose(gains_in_si(DEVICE, MOTOR.voltage, bench.proposal().gains), found, rtol=1e-9)
    assert len(GAIN_OBJECTS) == len(found)


# --- lags -------------------------------------------------------------------------------------------------------------
def test_a_loop_that_lags_so_much_turns_its_phase_by_so_much():
    axis, gains = plant(), propose("modulus_optimum", DEVICE, MOTOR, plant()).gains
    f = np.array([5.0, 20.0])
    L = velocity_open_loop(DEVICE, axis, Gains(*gains)._replace(velocity_i=0), f)
    beyond = -np.unwrap(np.angle(L)) - math.pi / 2.0
    current = axis.L / gains_in_si(DEVICE, axis.supply, gains).torque_p
    # At low frequencies the winding's own behaviour under back-EMF shows: look at the growth between two.
    lag = float(np.diff(beyond)[0] / (2.0 * math.pi * np.diff(f)[0]))
    assert velocity_lag(axis, current) == pytest.approx(lag, rel=0.1)
    assert current_lag(DEVICE) == pytest.approx(60e-6)


@pytest.mark.parametrize(("counts", "corner"), [(4096, 400.0), (1000, 150.0), (10_000, 800.0)])
def test_noise_of_counts_is_that_of_a_turning_encoder(counts, corner):
    rate = DEVICE.velocity_rate
    t = np.arange(400_000) / rate
    count = 2.0 * math.pi / counts
    true = 60.0 * t + 0.3 * np.cumsum(np.sin(2.0 * math.pi * 0.37 * t)) / rate
    seen = np.floor(true / count) * count
    b, a1, a2 = (float(x) for x in velocity_filter(np.asarray(corner), rate))
    noise = signal.lfilter(b * np.array([1.0, 2.0, 1.0]), [1.0, a1, a2], np.diff(seen - true) * rate)
    axis = plant(counts=counts, velocity_filter=corner)
    assert velocity_noise(DEVICE, axis) == pytest.approx(noise[1000:].std(), rel=0.25)


def test_the_cascade_rule_counts_the_encoder():
    fine, coarse = (propose("cascade", DEVICE, MOTOR, plant(counts=counts)) for counts in (4096, 200))
    assert Gains(*coarse.gains).velocity_p < 0.5 * Gains(*fine.gains).velocity_p
    assert any("where the encoder's 200 counts cause current noise of 10 % of rated" in note for note in coarse.notes)
    assert not any("counts" in note for note in fine.notes)


# --- what each rule asks for, by its own formula ----------------------------------------------------------------------
VISCOUS = {"viscous": 2e-5}
CURRENT_LAG = 1.5 / DEVICE.current_rate


def proposed(rule, axis):
    """What a rule proposes in SI, and the crossover of its velocity loop [rad/s]."""
    proposal = propose(rule, DEVICE, MOTOR, axis)
    si = gains_in_si(DEVICE, axis.supply, proposal.gains)
    return proposal, si, si.velocity_p * axis.torque_constant / axis.inertia


def small_of(axis, si, loss=0.0):
    """The small time constants that the velocity loop has around the current loop that was reached [s]."""
    return velocity_lag(axis, axis.L / (si.torque_p + loss))


@pytest.mark.parametrize(
    ("rule", "torque_p", "torque_time", "crossover", "time", "position"),
    [  # over L / lag, L / R, 1 / small, 1 / crossover (or J / viscous), crossover
        ("modulus_optimum", 1 / 2, 1.0, 1 / 2, None, 1 / 2),
        ("symmetrical_optimum", 1 / 2, 1.0, 1 / 2, 2.0, 1 / 4),
        ("imc", 1 / 4, 1.0, 1 / 3, None, 1 / 2),
        ("cascade", 1 / 2, 1.0, 1 / 3, 3.0, 1 / 4),
        ("simc", 1 / 2, None, 1 / 2, 4.0, 1 / 3),
    ],
)
def test_the_shares_of_a_rule(rule, torque_p, torque_time, crossover, time, position):
    axis = plant(**VISCOUS)
    _, si, reached = proposed(rule, axis)
    assert si.torque_p == pytest.approx(torque_p * axis.L / CURRENT_LAG, rel=0.01)
    winding = axis.L / axis.R if torque_time else min(axis.L / axis.R, 8.0 * CURRENT_LAG)
    assert si.torque_integration == pytest.approx(winding, rel=0.02)
    assert reached == pytest.approx(crossover / small_of(axis, si), rel=0.01)
    own = axis.inertia / axis.viscous if time is None else time / reached
    assert si.velocity_integration == pytest.approx(own, rel=0.3 if time is None else 0.02)  # seconds: a coarse integer
    assert si.position_p == pytest.approx(position * reached, rel=0.01)


@pytest.mark.parametrize("rule", ["modulus_optimum", "imc"])
def test_an_axis_without_viscous_friction_has_no_lag_to_cancel_and_this_is_said(rule):
    _, with_friction, _ = proposed(rule, plant(**VISCOUS))
    proposal, si, _ = proposed(rule, plant())
    assert si.velocity_p == pytest.approx(with_friction.velocity_p, rel=1e-3)
    assert (
        Gains(*proposal.gains).velocity_i == 0
        and Gains(*propose(rule, DEVICE, MOTOR, plant(**VISCOUS)).gains).velocity_i
    )
    assert [note for note in proposal.notes if "no integral part: a constant load leaves an error" in note]


def test_poles_of_a_loop_that_is_slower_than_its_lags_allow():
    """w_0 such that 2 zeta w_0 times the lags is 0.35 rad; zeta 0.9 of the current loop, 1 of the velocity loop."""
    axis = plant(**VISCOUS)
    _, si, _ = proposed("pole_placement", axis)
    natural = max(0.35 / (1.8 * CURRENT_LAG), 0.6 * axis.R / (0.9 * axis.L))
    assert si.torque_p == pytest.approx(1.8 * natural * axis.L - axis.R, rel=0.01)
    assert si.torque_integration == pytest.approx(si.torque_p / (natural**2 * axis.L), rel=0.03)
    natural = 0.35 / (2.0 * small_of(axis, si, axis.R))
    storage, loss = axis.inertia / axis.torque_constant, axis.viscous / axis.torque_constant
    assert si.velocity_p == pytest.approx(2.0 * natural * storage - loss, rel=0.01)
    assert si.velocity_integration == pytest.approx(si.velocity_p / (natural**2 * storage), rel=0.02)
    assert si.position_p == pytest.approx(natural / 3.0, rel=0.01)


def test_a_plant_that_is_fast_by_itself_leaves_a_pole_placement_a_fifth_of_its_loss():
    """Of 2 zeta w_0 = 1.2 times what it has alone, winding or axis."""
    axis = plant(viscous=0.02)
    _, si, _ = proposed("pole_placement", axis)
    storage, loss = axis.inertia / axis.torque_constant, axis.viscous / axis.torque_constant
    assert si.velocity_p == pytest.approx(0.2 * loss, rel=0.02)
    natural = (si.velocity_p + loss) / (2.0 * storage)
    assert si.position_p == pytest.approx(natural / 3.0, rel=0.02)
    slow = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1e-5, R=40.0)
    _, si, _ = proposed("pole_placement", slow)
    assert si.torque_p == pytest.approx(0.2 * 40.0, rel=0.02)


def test_margin_targets_leave_the_integral_part_a_quarter_of_the_crossover():
    axis = plant()
    for name in TARGETS:
        _, si, crossover = proposed(name, axis)
        assert si.velocity_integration == pytest.approx(4.0 / crossover, rel=0.1)
        assert si.torque_integration == pytest.approx(axis.L / axis.R, rel=0.02)
    assert TARGETS == {
        "margin_45": (45.0, 8.0), "margin_55": (55.0, 12.0), "margin_60": (60.0, 20.0), "margin_65": (65.0, 35.0),
    }  # fmt: skip


@pytest.mark.parametrize("greatest", [1, 2, 3, 17, 18, 19, 20, 100, 999, 1000])
def test_the_greatest_integer_is_found_below_the_first_that_fails(greatest):
    bench, tried = bench_of_a_gain(1000), []
    found = Margins(50.0, 10.0, 1.0, 1.0, 1.0)

    def margins_of(p):
        assert 1 <= p <= 1000
        tried.append(p)
        return p, found

    assert _greatest(bench, ("velocity", "P"), margins_of, lambda seen: seen[0] <= greatest, 45.0, 8.0) == greatest
    assert len(tried) < 100
    ends = ["velocity P ends at 1000, the greatest integer, with margin to spare"]
    assert bench.notes == (ends if greatest == 1000 else [])


def test_where_no_integer_keeps_the_margins_the_least_is_told_with_its_own():
    bench = bench_of_a_gain(1000)
    found = Margins(33.4, 5.26, 1.0, 1.0, 1.0)
    assert _greatest(bench, ("velocity", "P"), lambda p: found, lambda seen: False, 45.0, 8.0) == 1
    assert bench.notes == [
        "velocity P: no integer keeps 45 degrees and 8 dB: 1, the least, has 33 degrees and 5.3 dB"
    ]  # fmt: skip


def bench_of_a_gain(highest):
    notes = []
    return SimpleNamespace(row=lambda part: ("velocity_p", "velocity P", (1, 2), highest, "", ""), note=notes.append,
                           notes=notes)  # fmt: skip


# --- what is said of integers and limits ------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("wanted", "raw", "note"),
    [
        (0.0, 0, None),
        (0.2, 1, "would have to be 0.2, and 1 is the least: 5.0 times as much"),
        (0.51, 1, "would have to be 0.51; no integer comes nearer than 1, 96 % off"),
        (10.4, 10, None),
        (10.6, 11, None),
        (9.51, 10, "would have to be 9.51; no integer comes nearer than 10, 5 % off"),
        (9.53, 10, None),
        (RAW_MAX + 0.4, RAW_MAX, None),
        (2.0 * RAW_MAX, RAW_MAX, "would have to be 65534, and no integer above 32767 exists: 50 % of it is reached"),
    ],
)
def test_what_an_integer_misses_by_more_than_a_twentieth_is_said(wanted, raw, note):
    bench = Workbench(DEVICE, plant())
    part = ("velocity", "P")
    reached = bench.p("velocity", float(bench.scales[part].value(wanted)))
    assert reached == pytest.approx(float(bench.scales[part].value(raw))) == pytest.approx(bench.si(part, raw))
    assert [text.split("P ", 1)[1] for text in bench._notes] == ([] if note is None else [note])
    assert bench.so_far() == (1, 1, raw, 1, 1) and bench.so_far({("torque", "P"): 7, ("velocity", "P"): 3})[2] == 3
    assert bench.raw(part, 9) == pytest.approx(float(bench.scales[part].value(9))) and bench.so_far()[2] == 9


@pytest.mark.parametrize(("wanted_hz", "slowed"), [(19.9, False), (20.1, True)])
def test_a_loop_is_slowed_above_half_the_anti_resonance(wanted_hz, slowed):
    notes = []
    elastic = plant(anti_resonance=40.0, resonance=70.0)
    small = 0.3 / (2.0 * math.pi * wanted_hz)
    found = slow_enough(SimpleNamespace(note=notes.append), elastic, small, 0.3)
    assert found == pytest.approx(0.3 / (2.0 * math.pi * 20.0) if slowed else small, rel=1e-9)
    assert notes == (["velocity loop limited to 20 Hz, half the anti-resonance at 40 Hz; the lags alone would allow "
                      "20 Hz"] if slowed else [])  # fmt: skip


def test_a_cascade_that_counts_limit_says_to_what_and_from_what():
    """A tenth of the rated current is what the noise of counts may cause."""
    coarse = plant(counts=200)
    proposal, si, _ = proposed("cascade", coarse)
    quiet = 0.1 * MOTOR.rated_current / velocity_noise(DEVICE, coarse)
    assert si.velocity_p == pytest.approx(quiet, rel=0.01)
    hz = quiet * coarse.torque_constant / coarse.inertia / (2.0 * math.pi)
    _, _, alone = proposed("cascade", plant())
    assert any(
        f"velocity loop limited to {hz:.0f} Hz" in note
        and f"alone would allow {alone / (2.0 * math.pi):.0f} Hz" in note
        for note in proposal.notes
    )


@pytest.mark.parametrize(
    ("rule", "share"), [("modulus_optimum", 1 / 2), ("symmetrical_optimum", 1 / 2), ("imc", 1 / 3), ("simc", 1 / 2),
                        ("cascade", 1 / 3), ("relay", math.pi / 2 / 3.2)],
)  # fmt: skip
@pytest.mark.parametrize("slope", [0.7, 1.9])  # rad/(A s^2), of a load that is as heavy as a car
def test_what_a_rule_asks_for_is_over_what_an_ampere_accelerates_by(rule, share, slope):
    axis = plant(inertia=MOTOR.torque_constant / slope, counts=10**8)
    proposal = propose(rule, DEVICE, MOTOR, axis)
    small = small_of(axis, gains_in_si(DEVICE, axis.supply, proposal.gains))
    bench = Workbench(DEVICE, axis)
    assert float(bench.scales["velocity", "P"].value(proposal.wanted["velocity_p"])) == pytest.approx(
        share / (slope * small), rel=1e-3
    )


# --- side by side -----------------------------------------------------------------------------------------------------
def test_the_margins_of_a_proposal_are_those_of_its_outer_loops():
    """From 0.5 Hz to just below half the loop's rate."""
    gains = propose("simc", DEVICE, MOTOR, plant()).gains
    found = outer_margins(DEVICE, plant(), gains)
    assert list(found) == ["velocity", "position"]
    for loop, one in found.items():
        assert one == pytest.approx(margins(F, OPEN_LOOPS[loop](DEVICE, plant(), gains, F)), rel=1e-3), loop
        assert len(one) == 7


@pytest.mark.parametrize("axis", [plant(), plant(anti_resonance=80.0, resonance=140.0)], ids=["rigid", "elastic"])
def test_proposals_keep_dynamics_by_the_loops_of_the_axis_and_of_its_variants(axis):
    target = SimpleNamespace(device=DEVICE, motor=MOTOR)
    rows = {name: propose(name, DEVICE, MOTOR, axis) for name in ("margin_45", "margin_60")}
    by_name = {name: slacks(target, axis, rows, find_dynamics(name)) for name in ("soft", "standard", "stiff")}
    for dynamics, slack in by_name.items():
        asked = find_dynamics(dynamics)
        for name, row in rows.items():
            loops = [OPEN_LOOPS[loop](DEVICE, axis, row.gains, F) for loop in ("velocity", "position")]
            least = min(float(asked.clearance(loop)) for loop in loops)
            assert slack[name] <= least - 1.0 + 0.02, (dynamics, name)  # variants and overshoot may be tighter
    assert by_name["soft"]["margin_45"] < by_name["standard"]["margin_45"] < by_name["stiff"]["margin_45"]
    assert by_name["soft"]["margin_45"] < 0.0 < by_name["standard"]["margin_60"]
    wide = slacks(target, axis, rows, find_dynamics("standard", "0.5/5"))
    assert wide["margin_45"] < by_name["standard"]["margin_45"]


def test_axes_without_an_inertia_have_a_reason_in_place_of_a_model(monkeypatch):
    said = []

    def identify(target, progress):
        progress("inertia", 0.5)
        known, reason = Estimate(2e-5, 2e-5, 2e-5, ""), refused("", "the travel is too short")
        return [Identification({"inertia": one}, 1.0) for one in (known, reason)]

    monkeypatch.setattr("tuning.identify.identification.identify", identify)
    target = SimpleNamespace(
        drives=SimpleNamespace(safety=None), device=DEVICE, motor=MOTOR, supply=np.array([30.0, 24.0])
    )
    monkeypatch.setattr(side_by_side, "swinging_allowed", lambda drives: nullcontext())
    _, (one, other) = side_by_side.identified_plants(target, lambda what, share: said.append(share))
    assert (one.supply, one.inertia) == (30.0, 2e-5) and said == [0.5]
    assert other == "the axis has no identified inertia: the travel is too short"
    assert list(side_by_side.proposals(target, one, ["simc", "imc"])) == ["simc", "imc"]


@pytest.mark.parametrize("fails", [False, True])
def test_relay_experiments_have_the_rules_current_loops_and_drives_their_own_gains_afterwards(fails, monkeypatch):
    written, axis = [], plant()
    slope = axis.torque_constant / axis.inertia
    reasons = ("", "the travel is too short", "")
    swing = Swing(*(np.full(3, 1.0),) * 2, np.array([slope, slope, 4.0 * slope]), np.full(3, 1e-3), reasons)

    def experiment(target):
        if fails:
            raise OSError("the cable is out")
        return swing

    monkeypatch.setattr("tuning.rules.relay.relay_experiment", experiment)
    monkeypatch.setattr(side_by_side, "read_gains", lambda drives: "before")
    monkeypatch.setattr(
        side_by_side,
        "write_gains",
        lambda drives, gains: written.append(gains if isinstance(gains, str) else gains.tolist()),
    )
    target = SimpleNamespace(drives=None, device=DEVICE, motor=MOTOR)
    rule = list(propose("relay", DEVICE, MOTOR, axis).gains)
    if fails:
        with pytest.raises(OSError, match="cable"):
            side_by_side.swung_proposals(target, [axis] * 3)
        assert written == [[rule] * 3, "before"]
        return
    one, short, other = side_by_side.swung_proposals(target, [axis] * 3)
    assert written == [[rule] * 3, "before"] and short == "the travel is too short"
    assert one == gains_from_swing(DEVICE, axis, slope, swing.ultimate(0))
    assert "it swings at its load's resonance" in other
