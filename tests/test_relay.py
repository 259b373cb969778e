"""Relay feedback: the swing of an axis says its slope and its lags, against the linear model and a closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.gains import gains_in_si, write_gains
from drive_env.trials.positioning import CYCLE
from tuning.identify.true_plant import true_plant
from tuning.response.margins import margins
from tuning.rules.lags import velocity_lag
from tuning.rules.optima import take_current
from tuning.rules.proposal import Workbench
from tuning.rules.relay import (
    HELD,
    evaluate,
    fundamental,
    gains_from_swing,
    line,
    relay_experiment,
    relay_rule,
    ultimate_of_integrator,
)
from tuning.target import emulated

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
    return velocity_lag(target.device, plant, take_current(Workbench(target.device, plant), target.device, plant))


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


@pytest.mark.parametrize("coulomb", [0.0, 0.4])
def test_known_friction_is_taken_out_of_the_swing(coulomb):
    """A synthetic axis: velocity = slope e^(-s lag)/s of the current less its friction, as fundamentals."""
    slope, lag, w = 2000.0, 1.1e-3, 2.0 * math.pi * 90.0
    V = 8.0 + 0.0j
    amps = V / (slope * np.exp(-1j * w * (lag - HELD)) / (1j * w)) + 4.0 / math.pi * coulomb * V / abs(V)
    t = np.arange(300) * CYCLE
    speed, current = ((x * np.exp(1j * w * t)).real[:, None] for x in (V, amps))
    yes = np.array([True])
    swing = evaluate(speed, current, np.array([coulomb]), yes, yes, 2.0 * math.pi / 4096)
    assert swing.slope[0] == pytest.approx(slope, rel=0.01)
    assert swing.lag[0] == pytest.approx(lag, rel=0.03)
