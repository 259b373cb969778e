"""Arithmetic that vectorises: sine and cosine without a library call, limits, and even series.

A call to the C library's sin() in a lane loop is eight scalar calls. These polynomials are straight-line code.
"""

from __future__ import annotations

import numpy as np

from mechanics.kernels.compiled import inlined

TWO_PI = 2.0 * np.pi
# pi/2 in three parts whose products with small integers are exact (Cody and Waite).
_HALF_PI_1 = 1.57079632673412561417e00
_HALF_PI_2 = 6.07710050630396597660e-11
_HALF_PI_3 = 2.02226624879595063154e-21


@inlined
def sine_cosine(x):
    """Return sin(x), cos(x) to 2e-16 for |x| < 1e6 rad."""
    q = np.floor(x * (2.0 / np.pi) + 0.5)
    r = ((x - q * _HALF_PI_1) - q * _HALF_PI_2) - q * _HALF_PI_3
    z = r * r
    # Taylor coefficients up to r^15 and r^16: the remainder at pi/4 is below 1e-17.
    s = r + r * z * (
        -1.0 / 6.0
        + z
        * (
            1.0 / 120.0
            + z
            * (
                -1.0 / 5040.0
                + z
                * (1.0 / 362880.0 + z * (-1.0 / 39916800.0 + z * (1.0 / 6227020800.0 - z * (1.0 / 1307674368000.0))))
            )
        )
    )
    c = 1.0 + z * (
        -0.5
        + z
        * (
            1.0 / 24.0
            + z
            * (
                -1.0 / 720.0
                + z
                * (
                    1.0 / 40320.0
                    + z
                    * (
                        -1.0 / 3628800.0
                        + z * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0 + z * (1.0 / 20922789888000.0)))
                    )
                )
            )
        )
    )
    half = np.floor(q * 0.5)
    odd = q - 2.0 * half
    sign_s = 1.0 - 2.0 * (half - 2.0 * np.floor(half * 0.5))
    sign_c = sign_s * (1.0 - 2.0 * odd)
    sine = sign_s * (c if odd > 0.5 else s)
    cosine = sign_c * (s if odd > 0.5 else c)
    return sine, cosine


@inlined
def clip(x, limit):
    """Return x limited to +-limit; a nan stays nan."""
    low = -limit
    x = low if x < low else x
    return limit if x > limit else x


@inlined
def between(x, low, high):
    """Return x limited to low and high; a nan stays nan."""
    x = low if x < low else x
    return high if x > high else x


@inlined
def exponential(x):
    """Return exp(x) to 1e-15 for -1 <= x <= 0; below -1, the series is applied to x/8 and squared three times."""
    y = x * 0.125
    e = 1.0 + y * (
        1.0
        + y
        * (
            0.5
            + y
            * (
                1.0 / 6.0
                + y
                * (
                    1.0 / 24.0
                    + y
                    * (
                        1.0 / 120.0
                        + y
                        * (
                            1.0 / 720.0
                            + y * (1.0 / 5040.0 + y * (1.0 / 40320.0 + y * (1.0 / 362880.0 + y * (1.0 / 3628800.0))))
                        )
                    )
                )
            )
        )
    )
    e = e * e
    e = e * e
    return e * e


@inlined
def cosine_series(y):
    """Return sum y^n / (2n)!: cosh(sqrt(y)) for y > 0, cos(sqrt(-y)) for y < 0, to 1e-15 for |y| < 2."""
    s = 1.0 + y * (1.0 / 240.0) * (1.0 + y * (1.0 / 306.0))
    s = 1.0 + y * (1.0 / 132.0) * (1.0 + y * (1.0 / 182.0) * s)
    s = 1.0 + y * (1.0 / 56.0) * (1.0 + y * (1.0 / 90.0) * s)
    return 1.0 + y * 0.5 * (1.0 + y * (1.0 / 12.0) * (1.0 + y * (1.0 / 30.0) * s))


@inlined
def sine_series(y):
    """Return sum y^n / (2n+1)!: sinh(sqrt(y))/sqrt(y) for y > 0, sin(sqrt(-y))/sqrt(-y) for y < 0."""
    s = 1.0 + y * (1.0 / 272.0) * (1.0 + y * (1.0 / 342.0))
    s = 1.0 + y * (1.0 / 156.0) * (1.0 + y * (1.0 / 210.0) * s)
    s = 1.0 + y * (1.0 / 72.0) * (1.0 + y * (1.0 / 110.0) * s)
    return 1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 20.0) * (1.0 + y * (1.0 / 42.0) * s))
