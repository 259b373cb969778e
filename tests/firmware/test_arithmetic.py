"""The arithmetic that vectorises, over its stated ranges and to its stated errors, against NumPy's functions.

NumPy's own results are rounded to half a unit in the last place, at most 1.1e-16 of a value near 1: it is added to the
stated error of a function where that is of the same size.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from drive_env.firmware.common import arithmetic
from mechanics.kernels.compiled import cached

ROUNDING = 1.2e-16  # of the reference, relative to a value of 1


@cached()
def sine_cosine(x, sine, cosine):
    for k in range(x.shape[0]):
        sine[k], cosine[k] = arithmetic.sine_cosine(x[k])


@cached()
def exponential(x, y):
    for k in range(x.shape[0]):
        y[k] = arithmetic.exponential(x[k])


@cached()
def cosine_series(x, y):
    for k in range(x.shape[0]):
        y[k] = arithmetic.cosine_series(x[k])


@cached()
def sine_series(x, y):
    for k in range(x.shape[0]):
        y[k] = arithmetic.sine_series(x[k])


@cached()
def clip(x, limit, y):
    for k in range(x.shape[0]):
        y[k] = arithmetic.clip(x[k], limit)


def evaluate(function, x):
    y = np.empty_like(x)
    function(x, y)
    return y


@pytest.mark.parametrize("span", [1e-8, 1e-3, np.pi, 100.0, 1e4, 1e6])
def test_sine_and_cosine_are_right_to_2e_16_up_to_a_million_radians(span):
    x = np.random.default_rng(1).uniform(-span, span, 100_000)
    sine, cosine = np.empty_like(x), np.empty_like(x)
    sine_cosine(x, sine, cosine)
    assert np.max(np.abs(sine - np.sin(x))) <= 2e-16 + ROUNDING
    assert np.max(np.abs(cosine - np.cos(x))) <= 2e-16 + ROUNDING


def test_sine_and_cosine_at_the_quarter_turns_and_on_both_sides_of_the_eighths():
    turns = np.arange(-40, 41)
    x = np.concatenate([turns * (np.pi / 2), turns * (np.pi / 4) + 1e-12, turns * (np.pi / 4) - 1e-12, [0.0]])
    sine, cosine = np.empty_like(x), np.empty_like(x)
    sine_cosine(x, sine, cosine)
    assert np.max(np.abs(sine - np.sin(x))) <= 2e-16 + ROUNDING
    assert np.max(np.abs(cosine - np.cos(x))) <= 2e-16 + ROUNDING
    assert sine[-1] == 0.0
    assert cosine[-1] == 1.0


def test_exponential_is_right_to_1e_15_from_minus_one_to_zero():
    x = np.linspace(-1.0, 0.0, 20_001)
    assert np.max(np.abs(evaluate(exponential, x) / np.exp(x) - 1.0)) <= 1e-15
    assert evaluate(exponential, np.zeros(1))[0] == 1.0


def exact_series(y, first):
    """Return sum y^n / (2n + first)! by exact fractions: no function of a library, no rounding but the last."""
    y = Fraction(float(y))
    return float(sum(y**n / math.factorial(2 * n + first) for n in range(20)))


@pytest.mark.parametrize(("function", "first"), [(cosine_series, 0), (sine_series, 1)])
def test_even_series_are_right_to_1e_15_for_arguments_up_to_two(function, first):
    y = np.linspace(-2.0, 2.0, 401)
    exact = np.array([exact_series(value, first) for value in y])
    assert np.max(np.abs(evaluate(function, y) - exact)) <= 1e-15


def test_even_series_are_the_hyperbolic_and_the_circular_functions():
    x = np.linspace(1e-3, math.sqrt(2.0), 1001)
    assert np.allclose(evaluate(cosine_series, x * x), np.cosh(x), rtol=1e-15, atol=0)
    assert np.allclose(evaluate(cosine_series, -x * x), np.cos(x), rtol=0, atol=1e-15)
    assert np.allclose(evaluate(sine_series, x * x), np.sinh(x) / x, rtol=1e-15, atol=0)
    assert np.allclose(evaluate(sine_series, -x * x), np.sin(x) / x, rtol=0, atol=1e-15)


def test_clip_limits_on_both_sides_and_keeps_a_nan():
    x = np.array([-3.0, -2.0, -1.9, 0.0, 1.9, 2.0, 3.0, np.inf, -np.inf, np.nan])
    y = np.empty_like(x)
    clip(x, 2.0, y)
    assert np.array_equal(y, [-2.0, -2.0, -1.9, 0.0, 1.9, 2.0, 2.0, 2.0, -2.0, np.nan], equal_nan=True)
