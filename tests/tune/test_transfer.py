"""What whole periods say at the lines of an excitation: gain and delay by hand, noise, an axis that was not shaken."""

from __future__ import annotations

import numpy as np
import pytest

from tuning.response.excitation import periodic, plan_lines
from tuning.response.transfer import directions, transfer

LINES = plan_lines(10.0, 400.0, 10.0, 1000.0)  # 100 samples a period
PERIODS = 8
WAVE = np.tile(periodic("multisine", LINES, np.ones((40, 2))), (PERIODS, 1))


def answer(gain=2.0, delay=3, noise=0.0):
    """Gain and delay of the first axis; the second does not answer."""
    rng = np.random.default_rng(1)
    found = np.stack([gain * np.roll(WAVE[:, 0], delay), np.zeros(len(WAVE))], axis=1)
    return found + noise * rng.standard_normal(found.shape) * [1.0, 0.0]


@pytest.mark.parametrize("delay", [0, 3])
def test_a_gain_and_a_delay(delay):
    response, coherence, spread = transfer(WAVE, answer(delay=delay), LINES)
    expected = 2.0 * np.exp(-2j * np.pi * LINES.f * delay / 1000.0)
    np.testing.assert_allclose(response[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(coherence[:, 0], 1.0)
    np.testing.assert_allclose(spread[:, 0], 0.0, atol=1e-6)


def test_an_axis_that_does_not_answer_has_no_coherence():
    response, coherence, spread = transfer(WAVE, answer(), LINES)
    assert not response[:, 1].any() and not coherence[:, 1].any()
    assert np.all(spread[:, 1] > 1e10)
    response, coherence, _ = transfer(0.0 * WAVE, 0.0 * WAVE, LINES)
    assert not response.any() and not coherence.any()


def test_an_answer_equal_to_its_set_point_has_no_error_to_be_coherent():
    """The smaller coherence counts, of answer and of error: near a gain of 1 the error is noise alone."""
    _, coherence, _ = transfer(WAVE, WAVE, LINES)
    assert not coherence.any()
    _, coherence, _ = transfer(WAVE, answer(1.0, 0, noise=0.1), LINES)
    assert coherence[:, 0].max() < 0.9


def test_noise_is_the_spread_of_the_response_over_its_size():
    """Coherence of SNR: 1 / (1 + 1/SNR); the mean of periods has noise over the root of their number."""
    noise = 0.5
    response, coherence, spread = transfer(WAVE, answer(2.0, 0, noise), LINES)
    snr = 4.0 * 0.5 * 100 / 2 / noise**2  # 2 a line of amplitude 1 each, over noise spread on 50 bins
    assert np.median(coherence[:, 0]) == pytest.approx(1.0 / (1.0 + 1.0 / snr), abs=0.02)
    scatter = np.abs(response[:, 0] - 2.0) / 2.0
    assert np.sqrt(np.mean(scatter**2)) == pytest.approx(np.sqrt(np.mean(spread[:, 0] ** 2)), rel=0.35)


def test_one_period_leaves_one_degree_of_freedom():
    _, _, spread = transfer(WAVE[:100], answer(delay=0)[:100], LINES)
    assert np.isfinite(spread[:, 0]).all()


def test_passes_of_either_direction_and_how_they_differ_beyond_noise():
    """Four passes of two periods: 2.0 forwards and 2.2 backwards differ by 0.1 of 2.1 to either side."""
    pass_gain = np.repeat([2.0, 2.2, 2.0, 2.2], 200)[:, None]
    found, distortion = directions(WAVE, WAVE * pass_gain * [1.0, 0.0], LINES, 4)
    assert len(found) == 2
    np.testing.assert_allclose(found[0][:, 0], 2.0)
    np.testing.assert_allclose(found[1][:, 0], 2.2)
    np.testing.assert_allclose(distortion, [np.sqrt(4 * 0.1**2 / 3) / 2.1, 0.0], atol=1e-9)
    assert not found[0][:, 1].any()
    same, none = directions(WAVE, answer(delay=0), LINES, 4)
    np.testing.assert_allclose(same[0], same[1], atol=1e-9)
    np.testing.assert_allclose(none, 0.0, atol=1e-9)


@pytest.mark.parametrize(("count", "passes"), [(4, 2), (5, 0), (8, 0)])
def test_a_pass_has_two_periods_at_least(count, passes):
    found, distortion = directions(WAVE, answer(), LINES, count)
    assert len(found) == passes and distortion.shape == (2,)
    if not passes:
        assert not distortion.any()


def test_noise_is_no_distortion():
    _, distortion = directions(WAVE, answer(2.0, 0, 0.5), LINES, 4)
    assert distortion[0] < 0.05


def backwards_by(lines):
    """Four passes of two periods, of which every other answers a tenth less at some lines [Hz]."""
    spectrum = np.fft.rfft(WAVE[:100, 0])
    less = spectrum.copy()
    less[[round(f / 10.0) for f in lines]] *= 0.9
    one, other = (np.tile(np.fft.irfft(part, 100), 2) for part in (spectrum, less))
    return np.concatenate([one, other, one, other])[:, None] * [1.0, 1.0]


@pytest.mark.parametrize(
    ("lines", "seen"),
    [
        ((50.0, 60.0), False),  # a tenth of the 20 lines up to 200 Hz is left out at each end
        ((50.0, 60.0, 70.0), True),
        ((180.0, 190.0, 200.0), True),
        ((190.0, 200.0, 210.0), False),
        (tuple(np.arange(210.0, 401.0, 10.0)), False),  # what differs above 200 Hz is none
    ],
)
def test_passes_are_compared_up_to_200_hz_without_the_tenth_of_lines_that_differ_most(lines, seen):
    _, distortion = directions(WAVE, backwards_by(lines), LINES, 4)
    assert np.all(distortion > 1e-3) if seen else np.all(distortion < 1e-6)


def test_how_passes_differ_is_the_mean_of_the_lines_that_are_left():
    """One of 16 lines differs by 0.05 of 0.95 to either side, in two of four passes."""
    _, distortion = directions(WAVE, backwards_by((50.0, 60.0, 70.0)), LINES, 4)
    np.testing.assert_allclose(distortion, np.sqrt(4 * 0.05**2 / 3 / 0.95**2 / 16))


def test_the_spread_of_few_periods_is_theirs():
    """sqrt((1 - c) / c / (periods - 1)), of a coherence c; one period has one degree of freedom, too."""
    found = answer(2.0, 0, 0.5)
    for periods, freedom in ((8, 7), (3, 2), (2, 1)):
        _, _, spread = transfer(WAVE[: 100 * periods], found[: 100 * periods], LINES)
        x, y = (np.fft.rfft(part[: 100 * periods, 0].reshape(periods, 100), axis=1)[:, LINES.bins] for part in
                (WAVE, found))  # fmt: skip
        c = np.abs((x.conj() * y).mean(axis=0)) ** 2 / ((np.abs(x) ** 2).mean(axis=0) * (np.abs(y) ** 2).mean(axis=0))
        np.testing.assert_allclose(spread[:, 0], np.sqrt((1.0 - c) / c / freedom), rtol=1e-6)
