"""Evaluates whole periods of an excitation at its lines: response, coherence, noise, and difference of directions."""

from __future__ import annotations

import numpy as np
from scipy import signal, stats

from mechanics.arrays import Complex, Floats
from tuning.response.excitation import Lines

STANDS = 1e-9  # of the set-point: an axis with a smaller response was not excited
DISTORTION_HIGH, TRIMMED = 200.0, 0.1  # Hz up to which passes are compared, and the share of lines omitted at each end
DIRECTIONS = 2  # of the excitation in time, alternating from pass to pass


def transfer(set_point: Floats, answer: Floats, lines: Lines) -> tuple[Complex, Floats, Floats]:
    """Return response to set-point at the lines, its coherence, and its relative standard deviation, (n, axes)."""
    periods = len(set_point) // lines.samples

    def cross(x: Floats, y: Floats) -> Complex:
        # Whole periods need no window function.
        spectrum = signal.csd(x, y, lines.rate, "boxcar", lines.samples, 0, detrend="constant", axis=0)[1]
        return np.asarray(spectrum)[lines.bins]

    error = set_point - answer
    power, answers, errors = (np.abs(cross(x, x)) for x in (set_point, answer, error))
    to_answer, to_error = cross(set_point, answer), cross(set_point, error)
    tiny = 1e-30  # for axes that were not excited
    with_answer = np.abs(to_answer) ** 2 / np.maximum(power * answers, tiny)
    with_error = np.abs(to_error) ** 2 / np.maximum(power * errors, tiny)
    freedom = max(periods - 1, 1)
    spread = np.sqrt(np.maximum(1.0 - with_answer, 0.0) / np.maximum(with_answer, tiny) / freedom)
    return to_answer / np.maximum(power, tiny), np.minimum(with_answer, with_error), spread


def directions(set_point: Floats, answer: Floats, lines: Lines, count: int) -> tuple[list[Complex], Floats]:
    """Return the responses of the passes of either direction, and the relative difference of passes beyond noise.

    Within a pass, periods differ by noise only; from pass to pass the excitation is reversed in time, and non-linear
    effects differ (Pintelon and Schoukens, System Identification, 2nd ed., chapter 4).
    """
    periods = len(set_point) // lines.samples
    if periods < 2 * count:
        return [], np.zeros(set_point.shape[1])
    shape = (count, periods // count, lines.samples, -1)
    into, out = (np.fft.rfft(x.reshape(shape), axis=2)[:, :, lines.bins] for x in (set_point, answer))
    each = out / np.where(into == 0.0, np.inf, into)
    passes = each.mean(axis=1)
    noise = np.sum(np.abs(each - passes[:, None]) ** 2, axis=(0, 1)) / (count * (shape[1] - 1)) / shape[1]
    between = np.sum(np.abs(passes - passes.mean(axis=0)) ** 2, axis=0) / (count - 1)
    size = np.abs(passes.mean(axis=0))
    excess = ((between - noise) / np.where(size > STANDS, size, np.inf) ** 2)[lines.f <= DISTORTION_HIGH]
    distortion = np.sqrt(np.maximum(stats.trim_mean(excess, TRIMMED, axis=0), 0.0))
    # Passes of one direction differ by noise only.
    return [passes[k::DIRECTIONS].mean(axis=0) for k in range(DIRECTIONS)], distortion
