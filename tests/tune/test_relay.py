"""Relay feedback: the swing of an axis says its slope and its lags, against the linear model and a closed form."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import true_plant

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.devices.gains import gains_in_si
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE
from drive_env.drives.raw_gains import write_gains
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.loops.linear_model import Plant
from drive_env.loops.margins import margins
from drive_env.motors import find_motor
from tuning.rules import relay as module
from tuning.rules.lags import velocity_lag
from tuning.rules.optima import take_current
from tuning.rules.proposal import Workbench
from tuning.rules.relay import (
    evaluate,
    finish,
    fundamental,
    gains_from_swing,
    line,
    relay_experiment,
    relay_rule,
    ultimate_of_integrator,
)
from tuning.target import emulated

HELD = 0.5e-3  # s: a current that is held for a cycle acted half a cycle earlier on the mean
STILL = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}


def swung(**options):
    """Return the swing of an axis, its plant, and the target as the experiment left it."""
    with emulated(num_threads=1, **options) as target:
        plant = true_plant(target.drives)
        before = target.drives.read(0x6064)
        write_gains(target.drives, np.array([relay_rule(target.device, target.motor, plant).gains]))
        swing = relay_experiment(target)
        way = (target.drives.read(0x6064) - before) / target.increments()
        return swing, plant, target, float(way[0]), int(target.drives.read(0x6041)[0])


def model_lag(target, plant):
    """Return the velocity loop's lags around the relay's current loop [s]."""
    return velocity_lag(plant, take_current(Workbench(target.device, plant), target.device, plant))


def test_an_ideal_axis_shows_its_slope_and_its_lags():
    slopes, lags = [], []
    for corner in (500.0, 400.0, 250.0, 200.0, 160.0, 140.0):  # of the velocity filter [Hz]
        swing, plant, target, _, _ = swung(
            load="inertia", ideal=True, parameters=STILL | {"stage.velocity_filter": corner}
        )
        assert swing.reason == ("",)
        assert 40.0 < swing.frequency[0] < 150.0
        slopes.append(float(swing.slope[0]) * plant.inertia / plant.torque_constant)
        lags.append(float(swing.lag[0]) / model_lag(target, plant))
    # The relay switches once in a cycle, so that a swing of 7 to 20 cycles falls a part of one beside its own period.
    assert slopes == pytest.approx([1.0] * 6, rel=0.06)
    assert lags == pytest.approx([1.0] * 6, rel=0.12)
    assert float(np.median(slopes)) == pytest.approx(1.0, rel=0.03)
    assert float(np.median(lags)) == pytest.approx(1.0, rel=0.1)


def test_a_real_axis_shows_them_too_and_is_off_and_near_where_it_was():
    swing, plant, target, way, status = swung(load="inertia")
    assert swing.slope[0] == pytest.approx(plant.torque_constant / plant.inertia, rel=0.1)
    assert swing.lag[0] == pytest.approx(model_lag(target, plant), rel=0.1)
    assert abs(way) < 0.5
    assert status & 0x4F == 0x40  # switch on disabled


def test_gains_of_a_measured_swing_are_those_of_the_rule():
    swing, plant, target, _, _ = swung(load="inertia", ideal=True, parameters=STILL)
    measured = gains_from_swing(target.device, plant, float(swing.slope[0]), swing.ultimate(0)).gains
    computed = relay_rule(target.device, target.motor, plant).gains
    np.testing.assert_allclose(measured, computed, rtol=0.08)


def test_a_swing_with_the_loads_resonance_is_told_from_one_of_the_axis():
    swing, plant, target, _, _ = swung(load="two_mass")
    with pytest.raises(ValueError, match="it swings at its load's resonance"):
        gains_from_swing(target.device, plant, float(swing.slope[0]), swing.ultimate(0))


def test_an_axis_that_friction_holds_says_so():
    stuck = STILL | {"load.coulomb": 0.2, "load.breakaway": 0.3}
    with pytest.warns(MisfitWarning):
        swing, *_ = swung(load="inertia", parameters=stuck)
    assert np.isnan(swing.slope[0])
    assert "friction is too high" in swing.reason[0]


def test_an_axis_without_a_way_is_left_alone():
    swing, _, _, way, _ = swung(load="inertia", travel=(-1e-3, 1e-3))
    assert np.isnan(swing.lag[0])
    assert "travel is too short" in swing.reason[0]
    assert abs(way) < 0.2


def test_an_integrator_at_its_ultimate_gain_has_no_gain_margin():
    gain, period = ultimate_of_integrator(2400.0, 0.9e-3)
    f = np.geomspace(1.0, 2000.0, 20_000)
    s = 2j * math.pi * f
    found = margins(f, gain * 2400.0 * np.exp(-s * 0.9e-3) / s)
    assert found.gain_db == pytest.approx(0.0, abs=0.01)
    assert found.crossover_hz == pytest.approx(1.0 / period, rel=1e-3)


def test_the_rules_gain_is_tyreus_and_luybens_share_of_the_ultimate_one():
    _, plant, target, _, _ = swung(load="inertia", ideal=True, parameters=STILL)
    ultimate = ultimate_of_integrator(plant.torque_constant / plant.inertia, model_lag(target, plant))
    si = gains_in_si(target.device, plant.supply, relay_rule(target.device, target.motor, plant).gains)
    assert si.velocity_p == pytest.approx(ultimate.gain / 3.2, rel=0.01)
    assert si.velocity_integration == pytest.approx(2.2 * ultimate.period, rel=0.01)


# --- evaluation -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("frequency", [37.3, 106.0, 212.9])
def test_a_line_is_found_with_amplitude_and_phase(frequency):
    t = np.arange(200) * CYCLE
    x = 3.0 + 2.0 * t + 5.0 * np.cos(2.0 * math.pi * frequency * t + 0.7)
    assert fundamental(x) == pytest.approx(frequency, rel=3e-3)
    assert line(x, frequency) == pytest.approx(5.0 * np.exp(0.7j), rel=1e-6)
    assert math.isnan(fundamental(np.zeros(200)))


@pytest.mark.parametrize(("periods", "seen"), [(6.3, True), (5.7, False)])
def test_six_swings_are_worth_evaluating(periods, seen):
    """Of the 200 ms that are left when the first 100 have died away."""
    swing = evaluated(periods / 0.2)
    assert np.isfinite(swing.slope[0]) == seen
    assert swing.reason == (
        "" if seen else "the axis did not swing 6 times: friction is too high, or the inertia too large",
    )


@pytest.mark.parametrize(("counts", "seen"), [(0.51, True), (0.49, False)])
def test_a_swing_of_half_a_count_is_more_than_noise(counts, seen):
    swing = evaluated(100.0, amplitude=counts * 2.0 * math.pi / 4096 * 2.0 * math.pi * 100.0)
    assert np.isfinite(swing.slope[0]) == seen
    assert swing.reason == (
        "" if seen else "the axis swung by less than 0.5 counts: friction is too high, or the inertia too large",
    )


def evaluated(frequency, amplitude=8.0, lag=1.1e-3, first=0.0, slope=2000.0, inside=True):
    """What is said of an ideal swing of 300 ms, whose first 100 ms are something else."""
    w = 2.0 * math.pi * frequency
    t = np.arange(300) * CYCLE
    amps = amplitude / (slope * np.exp(-1j * w * (lag - HELD)) / (1j * w))
    speed, current = ((x * np.exp(1j * w * t)).real[:, None] for x in (amplitude, amps))
    speed[:100] += first
    current[:100] -= first
    return evaluate(speed, current, np.array([inside]), 2.0 * math.pi / 4096)


def test_what_swings_in_is_left_out_of_the_first_100_ms_and_no_more():
    swing = evaluated(100.0, first=1e4)
    assert swing.frequency[0] == pytest.approx(100.0, rel=1e-3)
    assert (swing.amplitude[0], swing.slope[0]) == (pytest.approx(8.0, rel=0.01), pytest.approx(2000.0, rel=0.01))
    assert swing.lag[0] == pytest.approx(1.1e-3, rel=0.02) and swing.reason == ("",)
    late = np.zeros((300, 1))
    late[100] = 1e4  # and this is looked at
    cycles = np.arange(300)[:, None] * CYCLE
    speed = np.cos(2.0 * math.pi * 100.0 * cycles) + late
    assert evaluate(speed, speed, np.array([True]), 1e-6).amplitude[0] != pytest.approx(1.0, rel=0.5)


def test_a_phase_ahead_of_an_integrators_is_that_of_no_rigid_axis():
    swing = evaluated(100.0, lag=-0.2e-3)
    assert math.isnan(swing.slope[0]) and math.isnan(swing.lag[0])
    assert swing.frequency[0] == pytest.approx(100.0, rel=1e-3) and swing.amplitude[0] == pytest.approx(8.0, rel=1e-2)
    assert swing.reason == ("the phase at 100 Hz leads an integrator's: the oscillation is not that of a rigid axis",)
    assert evaluated(100.0, lag=0.2e-3).lag[0] == pytest.approx(0.2e-3, rel=0.05)


def test_an_axis_that_came_to_its_end_has_no_figures():
    swing = evaluated(100.0, inside=False)
    assert swing.reason == ("the travel is too short: the relay drove the axis to its end",)
    assert np.isnan([swing.frequency, swing.amplitude, swing.slope, swing.lag]).all()


def test_axes_are_evaluated_each_by_itself():
    """The first rests, the second swings, the last came to its end."""
    w = 2.0 * math.pi * 100.0
    wave = 8.0 * np.cos(w * np.arange(300) * CYCLE)
    speed = np.stack([0.0 * wave, wave, wave], axis=1)
    current = np.stack([wave, 4.0 * np.cos(w * (np.arange(300) * CYCLE + HELD)), wave], axis=1)
    swing = evaluate(speed, current, np.array([True, True, False]), 1e-3)
    assert [reason.split(":")[0] for reason in swing.reason] == [
        "the axis did not swing 6 times",
        "the phase at 100 Hz leads an integrator's", "the travel is too short",
    ]  # fmt: skip
    assert np.isnan(swing.frequency).tolist() == [True, False, True]


def test_the_strongest_line_may_be_the_first_or_the_last_of_the_spectrum():
    alternating = (-1.0) ** np.arange(200)
    assert fundamental(alternating) == pytest.approx(0.5 / CYCLE, rel=0.01)
    t = np.arange(400) * CYCLE
    assert fundamental(np.cos(2.0 * math.pi * 40.0 * t)) == pytest.approx(40.0, abs=0.01)


# --- gains from it ----------------------------------------------------------------------------------------------------
DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
PLANT = Plant.from_data_sheet(DEVICE, MOTOR, 24.0, 1.5e-5)


def test_an_ultimate_point_is_where_the_lag_turns_by_90_degrees():
    assert ultimate_of_integrator(2000.0, 1e-3) == (pytest.approx(math.pi / 4.0), pytest.approx(4e-3))


def test_a_rule_takes_its_shares_of_the_ultimate_point_and_of_what_was_reached():
    """The integer that was reached, here 0.9 of the gain that was asked for, is what the position loop follows."""
    asked = []

    def p(loop, gain):
        asked.append((loop, "p", gain))
        return 0.9 * gain

    bench = SimpleNamespace(p=p, time=lambda loop, time: asked.append((loop, "time", time)), proposal=lambda: "done")
    assert finish(bench, module.Ultimate(0.32, 5e-3), 2000.0) == "done"
    assert asked == [
        ("velocity", "p", pytest.approx(0.1)),
        ("velocity", "time", pytest.approx(11e-3)),
        ("position", "p", pytest.approx(0.25 * 0.09 * 2000.0)),
    ]


def test_a_load_that_twists_is_held_to_the_crossover_that_the_rule_will_have(monkeypatch):
    """Of an integrator with a dead time the crossover turns by pi/2 over 3.2: so much of the lag counts."""
    asked = []
    monkeypatch.setattr(module, "velocity_lag", lambda plant, current: 1e-3)
    monkeypatch.setattr(module, "slow_enough", lambda bench, plant, lag, turn: asked.append((lag, turn)) or 2e-3)
    monkeypatch.setattr(module, "finish", lambda bench, ultimate, slope: (ultimate, slope))
    ultimate, slope = relay_rule(DEVICE, MOTOR, PLANT)
    assert asked == [(1e-3, pytest.approx(math.pi / 6.4))]
    assert slope == pytest.approx(PLANT.torque_constant / 1.5e-5)
    assert ultimate == (pytest.approx(math.pi / 4e-3 / slope), pytest.approx(8e-3))


@pytest.mark.parametrize(("factor", "taken"), [(1.49, True), (1.51, False), (1.0 / 1.49, True), (1.0 / 1.51, False)])
def test_a_swing_of_another_inertia_than_the_axiss_is_refused(factor, taken):
    slope = factor * PLANT.torque_constant / PLANT.inertia
    point = ultimate_of_integrator(slope, 1e-3)
    if taken:
        si = gains_in_si(DEVICE, 24.0, gains_from_swing(DEVICE, PLANT, slope, point).gains)
        assert si.velocity_p == pytest.approx(point.gain / 3.2, rel=0.01)
        return
    with pytest.raises(ValueError, match=rf"swung like {1.5e-5 / factor:.2g} kg\*m\^2, and its inertia is 1.5e-05: it"):
        gains_from_swing(DEVICE, PLANT, slope, point)


# --- the experiment, on drives that are an integrator -----------------------------------------------------------------
class Axes:
    """Drives whose axes turn as a test says: `moves(k)` is the speed [counts] and way [inc] of each in cycle k."""

    device = None

    def __init__(self, moves, limit=3500, num_axes=1):
        self._moves, self._limit, self._n = moves, limit, num_axes
        self.played, self.log, self.cycles = [], [], 0

    def read(self, name):
        return np.full(self._n, self._limit if name is Role.CURRENT_LIMIT else 5000)

    def write(self, name, value, where=None):
        self.log.append((name, value))

    def record(self, objects, duration, play):
        rows = play[cia402.TARGET_TORQUE]
        assert len(rows) == round(duration / CYCLE)
        self.played.append(rows.tolist())
        speed, way = (np.broadcast_to(np.asarray(x, float), self._n) for x in self._moves(self.cycles))
        self.cycles += 1
        return {
            cia402.VELOCITY_ACTUAL: speed[None],
            cia402.POSITION_ACTUAL: 5000 + way[None],
            cia402.TORQUE_ACTUAL: 2.0 * rows[:1],
        }


@pytest.fixture
def experiment(monkeypatch):
    """Run the experiment on such axes: a turn is 1,000 increments, a count of speed 0.5 rad/s, of current 1 mA."""
    enabled = []
    monkeypatch.setattr(module, "ampere_per_count", lambda drives: 1e-3)
    monkeypatch.setattr(module, "to_counts", lambda drives, torque: np.rint(torque * 1e3).astype(np.int64))
    monkeypatch.setattr(module.motion, "enable", lambda drives, mode: enabled.append(mode))
    monkeypatch.setattr(module.motion, "disable", lambda drives: enabled.append("off"))
    monkeypatch.setattr(module, "evaluate", lambda *arguments: arguments)

    def run(moves, *, limit=3500, current=10.0, rated=3.5, ways=((-math.inf, math.inf),)):
        n = len(ways)
        drives = Axes(moves, limit, n)
        target = SimpleNamespace(
            drives=drives, num_axes=n, current=current, low=np.array([low for low, _ in ways]) * 2.0 * math.pi,
            high=np.array([high for _, high in ways]) * 2.0 * math.pi,
            motor=SimpleNamespace(rated_current=rated, encoder_counts=4096),
            increments=lambda: np.full(n, 1000.0 / (2.0 * math.pi)), speed_counts=lambda: np.full(n, 2.0),
        )  # fmt: skip
        return drives, relay_experiment(target), enabled

    return run


@pytest.mark.parametrize(
    ("given", "height"),
    [
        ({}, 1400),  # 0.4 of the rated current
        ({"limit": 2000}, 900),  # 0.45 of the drive's limit
        ({"current": 0.6}, 600),  # and what may excite
        ({"limit": 0}, 0),
    ],
)
def test_how_high_the_relay_is(experiment, given, height):
    drives, _, _ = experiment(lambda k: (1, 0), **given)
    assert drives.played[0] == [[height]] and drives.played[1] == [[-height]]


def test_the_relay_brakes_what_turns_for_300_ms_and_leaves_the_axis_off(experiment):
    speeds = [3, -3, 0, -1, 1]
    drives, (speed, current, inside, count), enabled = experiment(lambda k: (speeds[k % 5], 0))
    assert drives.log == [(cia402.TARGET_TORQUE, 0)]
    assert enabled == ["cst", "off"]
    assert len(drives.played) == 301 and drives.played[-1] == [[0]] * 5  # and 5 ms without any
    assert [row[0][0] for row in drives.played[:6]] == [1400, -1400, 1400, -1400, 1400, -1400]
    assert speed.shape == (300, 1) and speed[:3, 0].tolist() == [1.5, -1.5, 0.0]
    assert current[:2, 0].tolist() == pytest.approx([2.8, -2.8])
    assert inside.tolist() == [True]
    assert count == pytest.approx(2.0 * math.pi / 4096)


@pytest.mark.parametrize(("way", "stays"), [(799, True), (800, False), (-399, True), (-400, False)])
def test_at_four_fifths_of_its_way_an_axis_is_let_go_for_good(experiment, way, stays):
    """Of a way of one turn forwards, half a turn back."""
    drives, (*_, inside, _), _ = experiment(lambda k: (1, way if k == 9 else 0), ways=((-0.5, 1.0),))
    assert inside.tolist() == [stays]
    torques = np.array([rows[0][0] for rows in drives.played[:-1]])
    assert np.all(torques[1:10] == -1400) and np.all((torques[10:] != 0) == stays)


def test_a_constant_load_is_held_by_a_bias_against_the_way(experiment):
    """A fiftieth of the height a cycle and 0.05 of a turn times 0.76; never more than half the height."""
    drives, _, _ = experiment(lambda k: (-1 if k % 2 else 1, 50))
    torques = np.array([rows[0][0] for rows in drives.played[:-1]])
    step = 0.02 * 1400 * math.tanh(1.0)
    assert torques[1] == round(-1400 - step) and torques[2] == round(1400 - 2 * step)
    assert sorted(torques[-2:].tolist()) == [-2100, 700]
    back, _, _ = experiment(lambda k: (-1 if k % 2 else 1, -50))
    assert back.played[1] == [[round(-1400 + step)]]
    assert sorted(rows[0][0] for rows in back.played[298:300]) == [-700, 2100]


def test_an_axis_whose_drive_is_lost_is_switched_off(experiment, monkeypatch):
    def lost(k):
        raise OSError("the cable is out")

    off = []
    monkeypatch.setattr(module.motion, "disable", lambda drives: off.append(True))
    with pytest.raises(OSError, match="cable"):
        experiment(lost)
    assert off == [True]
