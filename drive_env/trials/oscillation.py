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
