"""Excitations of an axis: multisines and periodic chirps of given amplitudes, and their dimensioning.

Both repeat exactly, so that every period holds the same lines and whatever differs between periods is noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import signal

from mechanics.arrays import Complex, Floats, Integers

KINDS = ("multisine", "chirp")
CREST = 2.5  # peak over RMS that is counted with before the wave is known

LEAST_SHARE = 0.4  # current of the lines in the middle over that of the highest
STIFF = (0.8, 3.0)  # bounds of what is added or taken where an axis moves little or much
LOW = 25.0  # Hz; few lines lie below, where cogging and friction disturb: they get as much as the highest


class Lines(NamedTuple):
    """The frequencies of an excitation [Hz], shape (n,), and the samples of a period at a rate [Hz]."""

    f: Floats
    samples: int
    rate: float

    @property
    def bins(self) -> Integers:
        """Which bins of a period's Fourier transform the lines are."""
        return np.rint(self.f * self.samples / self.rate).astype(np.int64)


def plan_lines(low: float, high: float, resolution: float, rate: float) -> Lines:
    """Return the multiples of the resolution from `low` to `high` [Hz].

    Raises:
        ValueError: If no whole number of samples makes a period, or the range is empty or too high.
    """
    if not 0.0 < resolution <= low < high:
        raise ValueError(
            f"an excitation from {low:g} to {high:g} Hz every {resolution:g} Hz is impossible; the resolution must be "
            "above 0 and at most the lowest frequency, and that below the highest"
        )
    samples = round(rate / resolution)
    if abs(samples * resolution - rate) > 1e-9 * rate:
        raise ValueError(f"resolution {resolution:g} Hz must divide {rate:g} Hz; use {rate / samples:g} Hz")
    if high >= 0.5 * rate:
        raise ValueError(f"highest frequency {high:g} Hz must be below {0.5 * rate:g} Hz, half the bus's rate")
    first, last = math.ceil(low / resolution - 1e-9), math.floor(high / resolution + 1e-9)
    return Lines(np.asarray(np.arange(first, last + 1) * resolution, float), samples, rate)


def periodic(kind: str, lines: Lines, amplitude: Floats) -> Floats:
    """Return one period of an excitation, shape (samples, axes).

    Args:
        kind: "multisine" or "chirp".
        lines: Its frequencies.
        amplitude: Of each line, shape (n, axes).

    Raises:
        ValueError: For another kind.
    """
    if kind not in KINDS:
        raise ValueError(f"no excitation is named {kind!r}; there are {', '.join(KINDS)}")
    return _multisine(lines, amplitude) if kind == "multisine" else _chirp(lines, amplitude)


def _multisine(lines: Lines, amplitude: Floats) -> Floats:
    """Phases after Schroeder (1970, doi:10.1109/TIT.1970.1054411): each line has its share of the period."""
    power = amplitude**2 / np.maximum((amplitude**2).sum(axis=0), np.finfo(float).tiny)
    before = np.cumsum(np.cumsum(power, axis=0), axis=0) - np.cumsum(power, axis=0)
    spectrum = np.zeros((lines.samples // 2 + 1, amplitude.shape[1]), complex)
    spectrum[lines.bins] = 0.5 * amplitude * np.exp(-2j * math.pi * before) * lines.samples
    return np.asarray(np.fft.irfft(spectrum, lines.samples, axis=0))


def _chirp(lines: Lines, amplitude: Floats) -> Floats:
    """A linear sweep has its line's whole amplitude for that line's share of the period."""
    t = np.arange(lines.samples) / lines.rate
    period = lines.samples / lines.rate
    sweep = signal.chirp(t, lines.f[0], period, lines.f[-1], phi=-90.0)
    now = lines.f[0] + (lines.f[-1] - lines.f[0]) * t / period
    envelope = np.stack([np.interp(now, lines.f, column) for column in amplitude.T], axis=1)
    whole = np.asarray(sweep[:, None] * envelope * math.sqrt(len(lines.f)))
    return np.asarray(whole - whole.mean(axis=0))


def peak(kind: str, lines: Lines, amplitude: Floats, response: Complex) -> Floats:
    """Return the peak of a response to an excitation at its lines, complex (n, axes); shape (axes,)."""
    spectrum = np.fft.rfft(periodic(kind, lines, amplitude), axis=0)
    answer = np.zeros_like(spectrum)
    answer[lines.bins] = spectrum[lines.bins] * response
    # Between the samples, too.
    return np.asarray(4.0 * np.abs(np.fft.irfft(answer, 4 * lines.samples, axis=0)).max(axis=0))


def dimension(
    lines: Lines, current: Floats, velocity: Floats, largest_current: Floats, largest_velocity: Floats
) -> Floats:
    """Return amplitudes of the set-point that make the most of an axis's limits, shape (n, axes).

    The current rises with the frequency, since what it moves falls and the encoder's noise rises with it, and towards
    the lowest lines, and where the axis hardly moves; where the velocity would be too large, its largest lines are cut
    to one level.

    Args:
        lines: The frequencies.
        current: Gain from set-point to current of each line [A per unit], shape (n, axes).
        velocity: Gain from set-point to velocity [rad/s per unit], likewise.
        largest_current: Peak [A], shape (axes,).
        largest_velocity: Peak [rad/s], shape (axes,).
    """
    share = np.maximum(np.maximum(lines.f / lines.f[-1], LEAST_SHARE), np.minimum(LOW / lines.f, 1.0))
    tiny = np.finfo(float).tiny
    # What an axis takes to move, over that of a rigid one: much at an anti-resonance, little at a resonance.
    stiff = current / np.maximum(velocity * lines.f[:, None], tiny)
    stiff = np.sqrt(stiff / np.maximum(np.median(stiff, axis=0), tiny))
    shares = share[:, None] * np.clip(stiff, *STIFF)
    shares /= np.sqrt(0.5 * (shares**2).sum(axis=0))  # for an RMS of 1
    amplitude = largest_current / CREST * shares / np.maximum(current, tiny)
    speeds = amplitude * velocity
    allowed = 2.0 * (largest_velocity / CREST) ** 2  # sum of squares
    low, high = np.zeros(speeds.shape[1]), speeds.max(axis=0)
    for _ in range(50):
        level = 0.5 * (low + high)
        fits = (np.minimum(speeds, level) ** 2).sum(axis=0) <= allowed
        low, high = np.where(fits, level, low), np.where(fits, high, level)
    level = np.where((speeds**2).sum(axis=0) <= allowed, np.inf, low)
    return np.asarray(amplitude * np.minimum(1.0, level / np.maximum(speeds, np.finfo(float).tiny)))
