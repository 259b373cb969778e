"""Multisines and chirps: what they hold, how high they reach, what dimensions them."""

import numpy as np
import pytest

from tuning.response.excitation import Lines, dimension, peak, periodic, plan_lines

LINES = plan_lines(5.0, 400.0, 5.0, 1000.0)
FLAT = np.ones((80, 1))


def spectrum(wave):
    return np.fft.rfft(wave[:, 0]) * 2.0 / len(wave)


def test_lines_are_the_multiples_of_the_resolution():
    assert LINES.f[0] == 5.0
    assert LINES.f[-1] == 400.0
    assert len(LINES.f) == 80
    assert LINES.samples == 200
    assert list(LINES.bins[:3]) == [1, 2, 3]


def test_a_multisine_holds_its_lines_with_their_amplitudes_and_nothing_else():
    amplitude = np.linspace(1.0, 2.0, 80)[:, None]
    found = np.abs(spectrum(periodic("multisine", LINES, amplitude)))
    assert found[LINES.bins] == pytest.approx(amplitude[:, 0])
    assert np.delete(found, LINES.bins) == pytest.approx(0.0, abs=1e-12)


def test_schroeders_phases_keep_the_peak_low():
    wave = periodic("multisine", LINES, FLAT)
    assert np.abs(wave).max() / wave.std() < 2.0


def test_a_chirp_has_the_same_power_at_its_lines():
    wave = periodic("chirp", LINES, FLAT)
    found = np.abs(spectrum(wave))[LINES.bins]
    assert np.median(found) == pytest.approx(1.0, rel=0.15)
    assert np.abs(wave).max() / wave.std() < 1.6
    assert wave.mean() == pytest.approx(0.0, abs=1e-12)


def test_a_chirp_sweeps_upwards():
    wave = periodic("chirp", LINES, FLAT)[:, 0]
    signs = [np.count_nonzero(np.diff(np.sign(part))) for part in np.array_split(wave, 4)]
    assert signs == sorted(signs)
    assert signs[-1] > 4 * signs[0]


def test_the_peak_of_an_answer_is_that_of_the_wave():
    wave = periodic("multisine", LINES, FLAT)
    assert peak("multisine", LINES, FLAT, np.ones((80, 1), complex)) == pytest.approx(np.abs(wave).max(), rel=0.15)
    assert peak("multisine", LINES, FLAT, np.full((80, 1), 3.0 + 0.0j)) >= 3.0 * np.abs(wave).max() - 1e-9


def test_current_dimensions_an_axis_that_hardly_moves():
    amplitude = dimension(LINES, 2.0 * FLAT, 1e-6 * FLAT / LINES.f[:, None], np.array([5.0]), np.array([100.0]))
    rms = np.sqrt(0.5 * ((2.0 * amplitude) ** 2).sum())
    assert rms == pytest.approx(5.0 / 2.5)


def test_velocity_dimensions_an_axis_that_moves_easily():
    gain = 1e3 / LINES.f[:, None]
    amplitude = dimension(LINES, FLAT, gain, np.array([5.0]), np.array([1.0]))
    speeds = (amplitude * gain)[:, 0]
    assert np.sqrt(0.5 * (speeds**2).sum()) == pytest.approx(1.0 / 2.5, rel=1e-3)
    # The fastest lines are cut to one level, the others have what the current gives.
    assert np.ptp(speeds[:3]) == pytest.approx(0.0, abs=1e-12)


def test_an_anti_resonance_gets_more():
    gain = 1.0 / LINES.f[:, None]
    gain[20] /= 50.0
    amplitude = dimension(LINES, FLAT, gain, np.array([5.0]), np.array([1e6]))[:, 0]
    assert amplitude[20] == pytest.approx(3.0 * amplitude[19], rel=0.05)


def test_the_current_of_a_rigid_axis_rises_with_the_frequency_and_towards_the_lowest():
    """f over the highest, at least 0.4 of it, and 25 Hz over f; at 25 Hz and below as much as at the highest."""
    amplitude = dimension(LINES, FLAT, 1.0 / LINES.f[:, None], np.array([5.0]), np.array([1e6]))[:, 0]
    at = dict(zip(LINES.f.tolist(), amplitude / amplitude[-1], strict=True))
    expected = {
        5: 1.0,
        20: 1.0,
        25: 1.0,
        30: 25 / 30,
        50: 0.5,
        65: 0.4,
        100: 0.4,
        160: 0.4,
        165: 165 / 400,
        200: 0.5,
        395: 395 / 400,
    }
    assert {f: at[f] for f in expected} == pytest.approx(expected)
    assert np.sqrt(0.5 * (amplitude**2).sum()) == pytest.approx(2.0)  # 5 A at a crest of 2.5


def test_an_axis_that_does_not_answer_at_all_is_no_division_by_zero():
    amplitude = dimension(LINES, 0.0 * FLAT, 0.0 * FLAT, np.array([5.0]), np.array([1.0]))
    assert np.isfinite(amplitude).all()
    assert not periodic("multisine", LINES, 0.0 * FLAT).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5.0, 400.0, 3.1, 1000.0), r"resolution 3\.1 Hz must divide 1000 Hz; use 3\.09598 Hz"),
        ((5.0, 500.0, 5.0, 1000.0), r"highest frequency 500 Hz must be below 500 Hz"),
        ((2.0, 400.0, 5.0, 1000.0), r"the resolution must be above 0 and at most the lowest frequency"),
        ((50.0, 40.0, 5.0, 1000.0), r"that below the highest"),
    ],
)
def test_frequencies_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        plan_lines(*arguments)


def test_an_unknown_excitation_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="no excitation is named 'steps'; there are multisine, chirp"):
        periodic("steps", Lines(np.array([5.0]), 200, 1000.0), np.ones((1, 1)))
