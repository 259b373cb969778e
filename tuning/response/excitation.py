"""Excitations of an axis: multisines and periodic chirps with given amplitudes, and the choice of these amplitudes.

Both repeat exactly, so that every period contains the same lines, and differences between periods are noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import signal

from mechanics.arrays import Complex, Floats, Integers

KINDS = ("multisine", "chirp")
CREST = 2.5  # assumed peak over RMS until the wave is computed

LEAST_SHARE = 0.4  # current of the middle lines over that of the highest
STIFF = (0.8, 3.0)  # limits of the factor on lines at which an axis moves little or much
LOW = 25.0  # Hz; the few lines below get as much current as the highest, because of cogging and friction


class Lines(NamedTuple):
    """The frequencies of an excitation [Hz], shape (n,), and the samples of a period at a rate [Hz]."""

    f: Floats
    samples: int
    rate: float

    @property
    def bins(self) -> Integers:
        """Bins of the lines in the Fourier transform of a period."""
        return np.rint(self.f * self.samples / self.rate).astype(np.int64)


def plan_lines(low: float, high: float, resolution: float, rate: float) -> Lines:
    """Return the multiples of the resolution from `low` to `high` [Hz].

    Raises:
        ValueError: If a period is not a whole number of samples, or the range is empty or too high.
    """
    if not 0.0 < resolution <= low < high:
        raise ValueError(
            f"an excitation from {low:g} to {high:g} Hz every {resolution:g} Hz is impossible; the resolution must be "
            "above 0 and at most the lowest frequency, and that below the highest"
        )
    samples = round(rate / resolution)
    if abs(samples * resolution - rate) > 1e-9 * rate:
        raise ValueError(f"resolution {resolution:.12g} Hz must divide {rate:g} Hz; use {rate / samples:.12g} Hz")
    if high >= 0.5 * rate:
        raise ValueError(f"highest frequency {high:g} Hz must be below {0.5 * rate:g} Hz, half the bus's rate")
    first, last = math.ceil(low / resolution - 1e-9), math.floor(high / resolution + 1e-9)
    return Lines(np.asarray(np.arange(first, last + 1) * resolution, float), samples, rate)


def periodic(kind: str, lines: Lines, amplitude: Floats) -> Floats:
    """Return one period of an excitation, shape (samples, axes).

    Args:
        kind: "multisine" or "chirp".
        lines: Its frequencies.
        amplitude: Amplitude of each line, shape (n, axes).

    Raises:
        ValueError: For an unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"no excitation is named {kind!r}; there are {', '.join(KINDS)}")
    return _multisine(lines, amplitude) if kind == "multisine" else _chirp(lines, amplitude)


def _multisine(lines: Lines, amplitude: Floats) -> Floats:
    """Return a multisine with Schroeder's phases (1970, doi:10.1109/TIT.1970.1054411), by the power of the lines."""
    power = amplitude**2 / np.maximum((amplitude**2).sum(axis=0), np.finfo(float).tiny)
    before = np.cumsum(np.cumsum(power, axis=0), axis=0) - np.cumsum(power, axis=0)
    spectrum = np.zeros((lines.samples // 2 + 1, amplitude.shape[1]), complex)
    spectrum[lines.bins] = 0.5 * amplitude * np.exp(-2j * math.pi * before) * lines.samples
    return np.asarray(np.fft.irfft(spectrum, lines.samples, axis=0))


def _chirp(lines: Lines, amplitude: Floats) -> Floats:
    """Return a linear sweep, which has each line's whole amplitude during the line's share of the period."""
    t = np.arange(lines.samples) / lines.rate
    period = lines.samples / lines.rate
    sweep = signal.chirp(t, lines.f[0], period, lines.f[-1], phi=-90.0)
    now = lines.f[0] + (lines.f[-1] - lines.f[0]) * t / period
    envelope = np.stack([np.interp(now, lines.f, column) for column in amplitude.T], axis=1)
    whole = np.asarray(sweep[:, None] * envelope * math.sqrt(len(lines.f)))
    return np.asarray(whole - whole.mean(axis=0))


def peak(kind: str, lines: Lines, amplitude: Floats, response: Complex) -> Floats:
    """Return the peak of the response to an excitation, (axes,); `response` at its lines is complex, (n, axes)."""
    spectrum = np.fft.rfft(periodic(kind, lines, amplitude), axis=0)
    answer = np.zeros_like(spectrum)
    answer[lines.bins] = spectrum[lines.bins] * response
    # Interpolated, to find peaks between the samples.
    return np.asarray(4.0 * np.abs(np.fft.irfft(answer, 4 * lines.samples, axis=0)).max(axis=0))


def dimension(
    lines: Lines, current: Floats, velocity: Floats, largest_current: Floats, largest_velocity: Floats
) -> Floats:
    """Return the greatest amplitudes of the set-point within an axis' limits, shape (n, axes).

    The current increases with frequency, since the motion decreases and the encoder's noise increases; it also
    increases towards the lowest lines, and where the axis hardly moves. If the velocity would be too large, its largest
    lines are limited to one level.

    Args:
        lines: The frequencies.
        current: Gain from set-point to current of each line [A per unit], shape (n, axes).
        velocity: Gain from set-point to velocity of each line [rad/s per unit], shape (n, axes).
        largest_current: Greatest peak of the current [A], shape (axes,).
        largest_velocity: Greatest peak of the velocity [rad/s], shape (axes,).
    """
    share = np.maximum(np.maximum(lines.f / lines.f[-1], LEAST_SHARE), np.minimum(LOW / lines.f, 1.0))
    tiny = np.finfo(float).tiny
    # Current per motion over that of a rigid axis: large at an anti-resonance, small at a resonance.
    stiff = current / np.maximum(velocity * lines.f[:, None], tiny)
    stiff = np.sqrt(stiff / np.maximum(np.median(stiff, axis=0), tiny))
    shares = share[:, None] * np.clip(stiff, *STIFF)
    shares /= np.sqrt(0.5 * (shares**2).sum(axis=0))  # for an RMS of 1
    amplitude = largest_current / CREST * shares / np.maximum(current, tiny)
    speeds = amplitude * velocity
    allowed = 2.0 * (largest_velocity / CREST) ** 2  # limit of the sum of squares
    low, high = np.zeros(speeds.shape[1]), speeds.max(axis=0)
    for _ in range(50):
        level = 0.5 * (low + high)
        fits = (np.minimum(speeds, level) ** 2).sum(axis=0) <= allowed
        low, high = np.where(fits, level, low), np.where(fits, high, level)
    level = np.where((speeds**2).sum(axis=0) <= allowed, np.inf, low)
    return np.asarray(amplitude * np.minimum(1.0, level / np.maximum(speeds, np.finfo(float).tiny)))
