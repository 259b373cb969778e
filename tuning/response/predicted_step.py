"""The step that a measured velocity loop predicts with other gains, of its own set-point and of the position's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.loops.margins import is_as_stable
from mechanics.arrays import Complex, Floats, Integers

if TYPE_CHECKING:
    from tuning.response.measured_loop import MeasuredLoop

LINES = 2.0  # s, one over the distance of the frequencies: what has not died away by then wraps round
SHOWN = 0.25  # s


class PredictedStep(NamedTuple):
    """Answers to a step of 1 at t = 0, without limits and friction; all of shape (n,).

    t: [s]. velocity: Of the filtered velocity to its set-point. position: Of the angle to its set-point.
    """

    t: Floats
    velocity: Floats
    position: Floats


def predicted_step(
    measured: MeasuredLoop, gains: Sequence[int] | Integers, axis: int = 0, shown: float = SHOWN
) -> PredictedStep | None:
    """Return the predicted step with gains, None where a loop would be unstable.

    Where nothing was trusted, and beyond the frequencies that were measured, the fitted model stands.

    Args:
        measured: The velocity loop; a model fits it well.
        gains: Raw gains, shape (count,).
        axis: Number of the axis.
        shown: How long [s].
    """
    rate = measured.device.velocity_rate
    whole = measured.extended(np.arange(1, round(rate * LINES / 2.0)) / LINES, axis)
    then, now = (whole.loops(row, axis, refined=False) for row in (measured.gains[axis], gains))
    if not all(is_as_stable(before, after) for before, after in zip(then[1:3], now[1:3], strict=True)):
        return None
    count = round(rate * shown)
    return PredictedStep(np.arange(count) / rate, _step(now.velocity)[:count], _step(now.position)[:count])


def _step(open_loop: Complex) -> Floats:
    """Return the answer to a step of a loop that integrates, its frequencies those of a discrete Fourier transform."""
    closed = open_loop / (1.0 + open_loop)
    return np.asarray(np.cumsum(np.fft.irfft(np.concatenate([[1.0], closed, [0.0]]))))
