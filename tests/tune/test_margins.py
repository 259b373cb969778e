"""Margins against closed forms: an integrator with dead time has them all."""

import math

import numpy as np
import pytest

from drive_env.loops.margins import _gain_margin, margins

F = np.geomspace(1.0, 1000.0, 2000)
S = 2j * math.pi * F


def delayed_integrator(crossover_hz, dead_time):
    return 2.0 * math.pi * crossover_hz / S * np.exp(-S * dead_time)


@pytest.mark.parametrize(("crossover", "dead_time"), [(20.0, 2e-3), (50.0, 1e-3), (80.0, 2.5e-3)])
def test_an_integrator_with_dead_time(crossover, dead_time):
    found = margins(F, delayed_integrator(crossover, dead_time))
    assert found.crossover_hz == pytest.approx(crossover, rel=1e-4)
    assert found.phase_deg == pytest.approx(90.0 - 360.0 * crossover * dead_time, abs=0.05)
    # The phase is -180 degrees at 1 / (4 dead_time).
    assert found.gain_db == pytest.approx(20.0 * math.log10(0.25 / dead_time / crossover), abs=0.02)


def test_the_bandwidth_of_an_integrator_is_its_crossover():
    found = margins(F, delayed_integrator(30.0, 0.0))
    assert found.bandwidth_hz == pytest.approx(30.0, rel=1e-3)
    assert found.ms == pytest.approx(1.0, abs=1e-3)
    assert found.gain_db == math.inf


def test_an_unstable_loop_has_negative_margins():
    found = margins(F, delayed_integrator(200.0, 2.5e-3))
    assert found.phase_deg == pytest.approx(90.0 - 180.0, abs=0.1)
    assert found.gain_db == pytest.approx(-20.0 * math.log10(2.0), abs=0.02)


def test_sensitivity_is_one_over_the_distance_from_minus_one():
    L = delayed_integrator(60.0, 1.5e-3)
    assert margins(F, L).ms == pytest.approx((1.0 / np.abs(1.0 + L)).max())


def test_a_crossing_that_nobody_saw_gives_no_margin():
    L = delayed_integrator(20.0, 2e-3)
    seen = np.abs(np.log(F / 20.0)) > 0.2
    found = margins(F, L, seen)
    assert math.isnan(found.phase_deg)
    assert math.isnan(found.crossover_hz)
    assert found.gain_db == pytest.approx(20.0 * math.log10(125.0 / 20.0), abs=0.02)


def test_a_phase_of_minus_180_degrees_that_nobody_saw_gives_no_gain_margin():
    L = delayed_integrator(20.0, 2e-3)  # -180 degrees at 125 Hz, and again at 625
    found = margins(F, L, (F < 110.0) | (F > 140.0))
    assert math.isnan(found.gain_db)
    assert found.phase_deg == pytest.approx(margins(F, L).phase_deg)


def test_a_phase_that_nobody_saw_where_the_gain_is_less_than_where_it_was_seen_changes_nothing():
    L = delayed_integrator(20.0, 2e-3)
    hidden = (F > 600.0) & (F < 660.0)
    assert margins(F, L, ~hidden).gain_db == pytest.approx(20.0 * math.log10(125.0 / 20.0), abs=0.02)


def test_what_is_not_trusted_moves_nothing():
    L = delayed_integrator(20.0, 2e-3)
    seen = (F < 50.0) | (F > 60.0)
    assert margins(F, np.where(seen, L, 100.0), seen)[:3] == pytest.approx(margins(F, L)[:3])


def test_without_a_crossing_there_is_none():
    found = margins(F, np.full(F.shape, 0.1 + 0.0j))
    assert math.isnan(found.phase_deg)
    assert math.isnan(found.crossover_hz)
    assert found.gain_db == math.inf


def test_margins_are_read_where_they_are_least_of_several_crossings():
    """A resonance lifts the gain above 1 once more: the phase is read there, not at the first crossover."""
    f = np.geomspace(1.0, 1000.0, 4000)
    s = 2j * np.pi * f
    w, z = 2.0 * np.pi * 100.0, 0.02
    L = 2.0 * np.pi * 20.0 / s * np.exp(-5e-4 * s) * w**2 / (s**2 + 2.0 * z * w * s + w**2)
    found = margins(f, L)
    assert found.crossover_hz == pytest.approx(20.9, abs=0.5)
    assert 80.0 < found.phase_hz < 115.0
    at = lambda hz: np.interp(hz, f, np.degrees(np.unwrap(np.angle(L))))  # noqa: E731
    off = (at(found.phase_hz) + 180.0 + 180.0) % 360.0 - 180.0
    assert off == pytest.approx(found.phase_deg, abs=0.5)
    assert -20.0 * np.log10(np.interp(found.gain_hz, f, np.abs(L))) == pytest.approx(found.gain_db, abs=0.05)


# --- by hand, from a few frequencies ----------------------------------------------------------------------------------
def closed_to_open(closed):
    """The open loop of a closed one: T / (1 - T)."""
    T = np.asarray(closed, complex)
    return T / (1.0 - T)


@pytest.mark.parametrize(
    ("closed", "bandwidth"),
    [
        ([0.9, 0.9, 0.9, 0.9], math.nan),  # it has not fallen yet
        ([0.5, 0.4, 0.3, 0.2], math.nan),  # it had before the first
        ([0.9, 0.9, 0.5, 0.9], None),  # the first time counts
        ([0.9, 0.9, 0.5, 0.3], None),
        ([0.9, 0.9, math.sqrt(0.5) * (1 - 1e-9), 0.3], 4.0),
        ([0.9, 0.9, math.sqrt(0.5) * (1 + 1e-9), 0.3], 4.0),  # just above there, and so right behind it
    ],
)
def test_the_bandwidth_lies_on_a_straight_line_of_logarithms(closed, bandwidth):
    f = np.array([1.0, 2.0, 4.0, 8.0])
    if bandwidth is None:  # from 0.9 at 2 Hz to 0.5 at 4 Hz
        bandwidth = 2.0 * 2.0 ** (math.log(0.9 / math.sqrt(0.5)) / math.log(0.9 / 0.5))
    found = margins(f, closed_to_open(closed)).bandwidth_hz
    assert found == pytest.approx(bandwidth, rel=1e-6, nan_ok=True)


def test_the_bandwidth_is_read_between_frequencies_that_are_trusted():
    f = np.array([1.0, 2.0, 3.0, 4.0, 8.0])
    L = closed_to_open([0.9, 0.9, 0.1, 0.5, 0.3])
    seen = margins(f, L, [True, True, False, True, True]).bandwidth_hz
    assert seen == pytest.approx(margins(f[[0, 1, 3, 4]], L[[0, 1, 3, 4]]).bandwidth_hz)
    nobody = margins(f, L, np.zeros(5, bool))
    assert math.isnan(nobody.bandwidth_hz) and math.isnan(nobody.ms) and math.isnan(nobody.phase_deg)
    assert math.isnan(margins(f, np.where(np.arange(5) == 0, np.nan, L)).bandwidth_hz) is False


def test_a_crossover_lies_where_the_gains_logarithm_is_0_and_its_phase_there():
    """From 4 at -100 degrees to 1/2 at -130 degrees: two thirds of the way, in logarithms."""
    f = np.array([1.0, 8.0])
    L = np.array([4.0, 0.5]) * np.exp(1j * np.radians([-100.0, -130.0]))
    found = margins(f, L)
    assert found.crossover_hz == pytest.approx(4.0)
    assert found.phase_hz == found.crossover_hz and found.phase_deg == pytest.approx(60.0)
    assert found.gain_db == math.inf and math.isnan(found.gain_hz)


def test_a_gain_margin_lies_where_the_phase_is_minus_180_degrees():
    """From -150 degrees to -210: half way, in logarithms of frequency; the gain there is 1/4."""
    f = np.array([1.0, 2.0, 8.0])
    L = np.array([2.0, 0.5, 0.125]) * np.exp(1j * np.radians([-140.0, -150.0, -210.0]))
    found = margins(f, L)
    assert found.gain_hz == pytest.approx(4.0) and found.gain_db == pytest.approx(20 * math.log10(4.0))
    assert found.crossover_hz == pytest.approx(math.sqrt(2.0)) and found.phase_deg == pytest.approx(35.0)


@pytest.mark.parametrize(
    ("gains", "phases", "db"),
    [
        # Down with a gain of 5.7, up again with 2.8, and down with 0.7: only the last counts.
        ([8, 4, 2, 0.25, 0.1], [-170, -190, -170, -190, -200], 20 * math.log10(math.sqrt(2.0))),
        ([8, 4, 2, 0.5, 0.1], [-170, -190, -200, -200, -190], -20 * math.log10(math.sqrt(32.0))),  # unstable
    ],
)
def test_a_loop_that_passes_minus_180_degrees_with_gain_and_comes_back_is_stable(gains, phases, db):
    f = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    found = margins(f, np.array(gains) * np.exp(1j * np.radians(phases)))
    assert found.gain_db == pytest.approx(db, abs=1e-6)


def test_rows_have_one_dimension_and_two_frequencies():
    for f, L in (([1.0], [1.0]), ([[1.0, 2.0]], [[1.0, 1.0]]), ([1.0, 2.0], [1.0])):
        with pytest.raises(ValueError, match="rows of one length"):
            margins(f, L)
    for f in ([1.0, 1.0], [2.0, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="must be above 0 and increase"):
            margins(f, [1.0, 1.0])
    with pytest.raises(ValueError, match="rows of one length"):
        margins([1.0, 2.0], [1.0, 1.0], [True])


@pytest.mark.parametrize(("decibels", "margin"), [
    # Of crossings at 10 Hz (the phase rises through -180 degrees) and at 100 Hz (it falls), the gain there.
    ((-0.5, -4.0), (0.5, 10.0)),  # both below 1: the nearer one, which the phase rises through, too
    ((-4.0, -0.5), (0.5, 100.0)),
    ((0.5, -4.0), (4.0, 100.0)),  # a rise with a gain above 1 is no instability
    ((-4.0, 0.5), (-0.5, 100.0)),  # a fall is
])  # fmt: skip
def test_which_crossing_of_minus_180_degrees_is_the_margin(decibels, margin):
    f = np.array([5.0, 20.0, 50.0, 200.0])
    # Straight lines over log f pass the two crossings where the gain is as told.
    slope = (decibels[1] - decibels[0]) / np.log(10.0)
    log_gain = np.log(10.0) / 20.0 * (decibels[0] + slope * np.log(f / 10.0))
    found = _gain_margin(f, log_gain, np.array([-1.0, 1.0, 1.0, -1.0]), np.array([10.0, 100.0]))
    np.testing.assert_allclose(found, margin)
