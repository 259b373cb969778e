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
        ((5.0, 400.0, 3.1, 1000.0), r"resolution 3\.1 Hz must divide 1000 Hz; use 3\.09597523"),
        ((5.0, 500.0, 5.0, 1000.0), r"highest frequency 500 Hz must be below 500 Hz"),
        ((2.0, 400.0, 5.0, 1000.0), r"the resolution must be above 0 and at most the lowest frequency"),
        ((50.0, 40.0, 5.0, 1000.0), r"that below the highest"),
    ],
)
def test_frequencies_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        plan_lines(*arguments)


@pytest.mark.parametrize("resolution", [0.3, 3.0, 3.1])
def test_the_resolution_that_a_refusal_gives_is_accepted(resolution):
    with pytest.raises(ValueError, match="must divide 1000 Hz") as refused:
        plan_lines(5.0, 400.0, resolution, 1000.0)
    plan_lines(5.0, 400.0, float(str(refused.value).split()[-2]), 1000.0)


def test_an_unknown_excitation_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="no excitation is named 'steps'; there are multisine, chirp"):
        periodic("steps", Lines(np.array([5.0]), 200, 1000.0), np.ones((1, 1)))


# --- by hand ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("low", "high", "resolution", "rate", "lines"),
    [
        (0.3, 0.7, 0.1, 10.0, [0.3, 0.4, 0.5, 0.6, 0.7]),  # also where 0.7 / 0.1 is less than 7
        (12.0, 23.0, 5.0, 1000.0, [15.0, 20.0]),
        (5.0, 6.0, 5.0, 1000.0, [5.0]),
        (1.0, 499.0, 1.0, 1000.0, list(range(1, 500))),
    ],
)
def test_lines_lie_within_the_range(low, high, resolution, rate, lines):
    found = plan_lines(low, high, resolution, rate)
    assert found.f.tolist() == pytest.approx(lines)
    assert (found.samples, found.rate) == (round(rate / resolution), rate)
    assert found.bins.tolist() == [round(f / resolution) for f in lines] and found.bins.dtype == np.int64


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5.0, 5.0, 5.0, 1000.0), "an excitation from 5 to 5 Hz every 5 Hz is impossible"),
        ((5.0, 9.0, 0.0, 1000.0), "every 0 Hz is impossible"),
        ((5.0, 9.0, -1.0, 1000.0), "every -1 Hz is impossible"),
        ((5.0, 500.1, 5.0, 1000.0), "highest frequency 500.1 Hz must be below 500 Hz, half the bus's rate"),
        ((5.0, 9.0, 1.0000001, 1000.0), "resolution 1.0000001 Hz must divide 1000 Hz; use 1 Hz"),
    ],
)
def test_ranges_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        plan_lines(*arguments)


def test_a_chirp_is_a_sine_whose_frequency_rises_evenly_with_its_lines_amplitudes():
    """sqrt(80) times as high as one of 80 lines: it is at each of them for an 80th of the period."""
    amplitude = np.stack([np.linspace(1.0, 3.0, 80), np.full(80, 0.5)], axis=1)
    t = np.arange(200) / 1000.0
    sine = np.sin(2.0 * np.pi * (5.0 * t + 0.5 * 395.0 / 0.2 * t**2))
    for k, envelope in ((0, 1.0 + 2.0 * t / 0.2), (1, 0.5)):
        wave = sine * envelope * np.sqrt(80.0)
        np.testing.assert_allclose(periodic("chirp", LINES, amplitude)[:, k], wave - wave.mean(), atol=1e-9)


def test_schroeders_phases_of_two_lines():
    """The first begins at 0, the second is turned by its predecessors' share of the power: 1 of 1 + 4."""
    lines = Lines(np.array([10.0, 20.0]), 100, 1000.0)
    t = np.arange(100) / 1000.0
    wave = periodic("multisine", lines, np.array([[1.0], [2.0]]))[:, 0]
    expected = np.cos(2.0 * np.pi * 10.0 * t) + 2.0 * np.cos(2.0 * np.pi * 20.0 * t - 2.0 * np.pi * 0.2)
    np.testing.assert_allclose(wave, expected, atol=1e-12)


@pytest.mark.parametrize("turn", [1.0, 1j, np.exp(0.25j * np.pi)])
def test_the_peak_of_one_line_is_its_amplitude_also_between_samples(turn):
    """250 Hz of 1,000 samples a second: four samples a period, turned by an eighth of it."""
    lines = Lines(np.array([250.0]), 200, 1000.0)
    found = peak("multisine", lines, np.array([[2.0, 3.0]]), 1.5 * turn * np.ones((1, 2)))
    np.testing.assert_allclose(found, [3.0, 4.5], rtol=1e-9)


def test_a_resonance_gets_less_and_an_anti_resonance_three_times_as_much_at_most():
    """By the root of how stiff an axis is there over the middle of all lines, from 0.8 to 3 times."""
    for factor, share in ((50.0, 0.8), (1.3, 1.3**-0.5), (1.0 / 4.0, 2.0), (1.0 / 50.0, 3.0)):
        gain = 1.0 / LINES.f[:, None]
        gain[20] *= factor
        amplitude = dimension(LINES, FLAT, gain, np.array([5.0]), np.array([1e6]))[:, 0]
        assert amplitude[20] / amplitude[19] == pytest.approx(share)


def test_each_axis_has_its_own_limits():
    """The first is limited by its current, the second by its speed."""
    gain = 1e3 / LINES.f[:, None] * np.array([1e-9, 1.0])
    amplitude = dimension(LINES, np.tile(FLAT, 2), gain, np.array([5.0, 5.0]), np.array([1.0, 2.0]))
    rms = np.sqrt(0.5 * (amplitude**2).sum(axis=0))
    speeds = np.sqrt(0.5 * ((amplitude * gain) ** 2).sum(axis=0))
    assert rms[0] == pytest.approx(2.0) and rms[1] < 2.0
    assert speeds[1] == pytest.approx(0.8, rel=1e-3)
