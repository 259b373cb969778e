"""What a bus sees of a faster loop, against the same loop simulated sample by sample."""

import math

import numpy as np
import pytest
from scipy.signal import freqz, lfilter

from drive_env.devices import find_device
from tuning.response.held_samples import seen_by_bus, split, unhold

DEVICE = find_device("tmcm1636")
B, A = [0.02, 0.05], [1.0, -1.4, 0.5]  # a loop at 5 kHz with much left above 500 Hz


def loop(f):
    return freqz(B, A, f, fs=DEVICE.velocity_rate)[1]


def test_held_set_points_and_folded_samples():
    n = 100  # 10 Hz apart
    played = np.tile(np.random.default_rng(0).normal(size=n), 6)
    fast = lfilter(B, A, np.repeat(played, 5))
    seen = np.concatenate([[0.0], fast])[: 5 * len(played) : 5]  # what the window before had
    bins = np.arange(1, 50)
    ratio = (np.fft.rfft(seen[-n:]) / np.fft.rfft(played[-n:]))[bins]
    assert seen_by_bus(DEVICE, bins * 10.0, loop) == pytest.approx(ratio, abs=1e-9)


def test_images_hardly_count_below_a_fifth_of_the_bus_s_rate_and_much_at_two_fifths():
    f = np.array([50.0, 400.0])
    own, images = split(DEVICE, f, loop)
    share = np.abs(images / own)
    assert share[0] < 0.05
    assert share[1] > 0.15


def test_without_its_images_the_loop_comes_back():
    f = np.arange(10.0, 500.0, 10.0)
    own, images = split(DEVICE, f, loop)
    assert unhold(DEVICE, f, own + images, images) == pytest.approx(loop(f))
    late = np.angle(own / loop(f))
    assert late == pytest.approx(-2.0 * math.pi * f * (1e-3 / 2 - 1e-4 + 2e-4), abs=1e-9)  # half a hold, and a window
