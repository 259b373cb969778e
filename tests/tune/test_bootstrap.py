"""Intervals by drawing anew: they hold what they should, pairs stay pairs, and the draws never change."""

import numpy as np
import pytest

from tuning.bootstrap import bootstrap_interval


def mean(x):
    return x.mean(axis=1)


def difference(x, y):
    return y.mean(axis=1) - x.mean(axis=1)


def test_an_interval_of_a_mean_is_as_wide_as_its_standard_error_says():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = bootstrap_interval(mean, values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2.0 * 1.96 * values.std() / np.sqrt(400), rel=0.05)


def test_pairs_stay_pairs_unless_they_are_none():
    first = np.random.default_rng(2).normal(0.0, 5.0, 50)
    low, high = bootstrap_interval(difference, first, first + 1.0)
    assert (low, high) == pytest.approx((1.0, 1.0))
    low, high = bootstrap_interval(difference, first, first + 1.0, paired=False)
    assert low < 0.0 < 2.0 < high
    low, high = bootstrap_interval(difference, first, first[:20], paired=False)
    assert low < high


def test_the_draws_are_those_of_the_figures_that_are_published():
    values = np.arange(1.0, 8.0) ** 2
    assert bootstrap_interval(mean, values) == (8.571428571428571, 31.714285714285715)
    low, high = bootstrap_interval(lambda x: np.median(x, axis=1), values)
    assert (low, high) == (4.0, 36.0)


def test_every_value_of_a_sample_is_drawn_its_first_and_its_last_too():
    seen = []
    bootstrap_interval(lambda x: seen.append(np.unique(x)) or mean(x), np.arange(5.0))
    bootstrap_interval(lambda x, y: seen.extend([np.unique(x), np.unique(y)]) or difference(x, y), np.arange(5.0),
                       np.arange(5.0), paired=True)  # fmt: skip
    assert [one.tolist() for one in seen] == [[0.0, 1.0, 2.0, 3.0, 4.0]] * 3


def test_an_interval_is_of_2000_draws_from_their_40th_to_their_1960th_part():
    """2.5 and 97.5 % of the values, in order."""
    shapes = []

    def statistic(anew):
        shapes.append(anew.shape)
        return np.arange(2001.0)

    assert bootstrap_interval(statistic, np.arange(7.0)) == (50.0, 1950.0)
    assert shapes == [(2000, 7)]
