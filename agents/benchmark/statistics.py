"""Figures of scores over seeds and episodes, with 95 % intervals.

After Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021
(arXiv:2108.13264). A task is a stratum: its seeds and its episodes are drawn anew with replacement. All seeds are
judged in the same episodes: one that is drawn twice counts twice for every seed, and for the rival. The draws are
reproducible. With a single seed an interval does not cover the variation between trainings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mechanics.arrays import Floats
from tuning.bootstrap import ENDS, RESAMPLES


class ScoreEstimate(NamedTuple):
    """A figure with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def interquartile_mean(tables: Sequence[Floats]) -> ScoreEstimate:
    """Return the mean of the middle half of the scores: a quarter, rounded down, is cut off at each end.

    Args:
        tables: Scores of each task, shape (seeds, episodes).
    """

    def middle(rows: Floats) -> Floats:
        cut = rows.shape[1] // 4
        found: Floats = np.sort(rows, axis=1)[:, cut : rows.shape[1] - cut].mean(axis=1)
        return found

    return _estimate(middle, tables)


def probability_of_improvement(tables: Sequence[Floats], rivals: Sequence[Floats]) -> ScoreEstimate:
    """Return the probability that a score is above the rival's in the same episode; an equal one counts half.

    Args:
        tables: Scores of each task, shape (seeds, episodes).
        rivals: The rival's scores, shape (episodes,) each.
    """
    wins = [np.heaviside(table - rival, 0.5) for table, rival in zip(tables, rivals, strict=True)]
    return _estimate(lambda rows: rows.mean(axis=1), wins)


def _estimate(statistic: Callable[[Floats], Floats], tables: Sequence[Floats]) -> ScoreEstimate:
    """Return a statistic of all values with its interval; it takes rows of values and returns one value for each."""
    rng = np.random.default_rng(0)
    drawn = []
    for table in tables:
        seeds, episodes = (rng.integers(0, size, (RESAMPLES, size)) for size in table.shape)
        drawn.append(table[seeds[:, :, None], episodes[:, None, :]].reshape(RESAMPLES, -1))
    value = statistic(np.concatenate([table.reshape(1, -1) for table in tables], axis=1))[0]
    low, high = np.quantile(statistic(np.concatenate(drawn, axis=1)), ENDS)
    return ScoreEstimate(float(value), float(low), float(high))
