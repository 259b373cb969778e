"""Predicts steps of velocity and position set-points with other gains from a measured velocity loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.loops.margins import is_as_stable
from mechanics.arrays import Complex, Floats, Integers

if TYPE_CHECKING:
    from tuning.response.measured_loop import MeasuredLoop

LINES = 2.0  # s, one over the spacing of the frequencies: a response that has not decayed by then wraps round
SHOWN = 0.25  # s


class PredictedStep(NamedTuple):
    """Responses to a step of 1 at t = 0, without limits and friction; all of shape (n,).

    t: [s].
    velocity: Filtered velocity after a step of its set-point.
    position: Angle after a step of its set-point.
    """

    t: Floats
    velocity: Floats
    position: Floats


def predicted_step(measured: MeasuredLoop, gains: Sequence[int] | Integers, axis: int = 0) -> PredictedStep | None:
    """Predict the step with gains; None if a loop would be unstable.

    At lines that are not trusted, and beyond the measured frequencies, the fitted model is used.

    Args:
        measured: The velocity loop, with a good fit.
        gains: Raw gains, shape (count,).
        axis: Number of the axis.
    """
    rate = measured.device.velocity_rate
    whole = measured.extended(np.arange(1, round(rate * LINES / 2.0)) / LINES, axis)
    then, now = (whole.loops(row, axis, refined=False) for row in (measured.gains[axis], gains))
    if not all(is_as_stable(before, after) for before, after in zip(then[1:3], now[1:3], strict=True)):
        return None
    count = round(rate * SHOWN)
    return PredictedStep(np.arange(count) / rate, _step(now.velocity)[:count], _step(now.position)[:count])


def _step(open_loop: Complex) -> Floats:
    """Return the step response of an integrating loop at the frequencies of a discrete Fourier transform."""
    closed = open_loop / (1.0 + open_loop)
    return np.asarray(np.cumsum(np.fft.irfft(np.concatenate([[1.0], closed, [0.0]]))))
