"""The criterion of oscillation of a moving axis, for trials, tuners and audits.

It is the RMS change of the current from millisecond to millisecond, over the rated current. The edges of a profile
cause 0.1 in a fast loop; a limit cycle, whose current goes from limit to limit, 1 and more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mechanics.arrays import Floats, Mask

OSCILLATION = 0.4
NEAR = 10.0  # Hz


def shakes(current: NDArray[np.floating], rated_current: float) -> Mask:
    """Return which axes oscillate, (axes,).

    Args:
        current: Torque-producing current, a sample per millisecond [A], shape (n, axes).
        rated_current: Rated current of the motor [A].
    """
    change = np.diff(current, axis=0)
    return np.asarray(np.sqrt(np.mean(change**2, axis=0)) > OSCILLATION * rated_current)


def strongest_frequency(current: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Return the frequency of the strongest oscillation of each axis' current [Hz], and the share of power within NEAR.

    The resolution is 1 over the samples' duration; frequencies above 500 Hz are aliased below it.

    Args:
        current: Torque-producing current, a sample per millisecond [A], shape (n, axes).
    """
    power = np.abs(np.fft.rfft(current - current.mean(axis=0), axis=0)) ** 2
    f = np.fft.rfftfreq(len(current), 0.001)
    found = f[power.argmax(axis=0)]
    near = np.abs(f[:, None] - found) <= NEAR
    return found, np.asarray((power * near).sum(axis=0) / np.maximum(power.sum(axis=0), np.finfo(float).tiny))
