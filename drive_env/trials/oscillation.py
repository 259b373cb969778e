"""The criterion of oscillation of a moving axis, for trials, tuners and audits.

RMS change of the current from millisecond to millisecond, over the rated current. The edges of a profile make 0.1 on a
fast loop; a limit cycle, whose current goes from limit to limit, 1 and more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

OSCILLATION = 0.4


def shakes(current: NDArray[np.floating], rated_current: float) -> NDArray[np.bool_]:
    """Return which axes oscillate.

    Args:
        current: Torque-producing current, a sample per millisecond [A], shape (n, axes).
        rated_current: Of the motor [A].
    """
    change = np.diff(current, axis=0)
    return np.asarray(np.sqrt(np.mean(change**2, axis=0)) > OSCILLATION * rated_current)


def strongest_frequency(current: NDArray[np.floating], step: float = 0.001) -> NDArray[np.float64]:
    """Return at which frequency each axis' current swings most [Hz], to 1 over the samples' duration.

    What swings faster than half the rate of the samples is seen below it.

    Args:
        current: Torque-producing current [A], shape (n, axes).
        step: Between samples [s].
    """
    power = np.abs(np.fft.rfft(current - current.mean(axis=0), axis=0)) ** 2
    return np.asarray(np.fft.rfftfreq(len(current), step)[power.argmax(axis=0)])
