"""95 % intervals by the percentile bootstrap: machines or episodes drawn anew, as many as there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mechanics.arrays import Floats

RESAMPLES = 2000
ENDS = (0.025, 0.975)


def bootstrap_interval(statistic: Callable[..., Any], *samples: Floats, paired: bool = True) -> tuple[float, float]:
    """Return the ends of a statistic's interval: of its values on samples drawn anew, with replacement.

    The draws are the same every time: figures in cards and tables do not change where nothing else has.

    Args:
        statistic: Takes each sample drawn anew, shape (RESAMPLES, n), and returns a value for each draw; a draw on
            which it is undefined may be left out.
        samples: One or several, shape (n,), none of them empty.
        paired: Whether entry k of one sample belongs to entry k of the others: then they are drawn together.
    """
    rng = np.random.default_rng(0)
    if paired:
        drawn = rng.integers(0, len(samples[0]), (RESAMPLES, len(samples[0])))
        anew = [sample[drawn] for sample in samples]
    else:
        anew = [sample[rng.integers(0, len(sample), (RESAMPLES, len(sample)))] for sample in samples]
    low, high = np.quantile(statistic(*anew), ENDS)
    return float(low), float(high)
