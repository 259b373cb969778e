"""95 % confidence intervals by the percentile bootstrap: machines or episodes are resampled with replacement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mechanics.arrays import Floats

RESAMPLES = 2000
ENDS = (0.025, 0.975)


def bootstrap_interval(statistic: Callable[..., Any], *samples: Floats, paired: bool = True) -> tuple[float, float]:
    """Return the ends of the 95 % confidence interval of a statistic by the percentile bootstrap.

    The random draws are fixed: figures in cards and tables change only if the data change.

    Args:
        statistic: Takes each resampled sample, shape (RESAMPLES, n), and returns one value per resample; it may leave
            out resamples for which it is undefined.
        samples: One or several non-empty samples, shape (n,).
        paired: Whether entry k of one sample belongs to entry k of the others: then they are resampled together.
    """
    rng = np.random.default_rng(0)
    if paired:
        drawn = rng.integers(0, len(samples[0]), (RESAMPLES, len(samples[0])))
        anew = [sample[drawn] for sample in samples]
    else:
        anew = [sample[rng.integers(0, len(sample), (RESAMPLES, len(sample)))] for sample in samples]
    low, high = np.quantile(statistic(*anew), ENDS)
    return float(low), float(high)
