"""Reduces samples to columns of pixels: each column keeps its least and greatest value, so that no spike is lost."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mechanics.arrays import Integers


class Columns(NamedTuple):
    """Samples in columns.

    starts: Index of the first sample of each column, shape (columns,).
    low, high: Least and greatest value of each column, shape (columns, ...).
    """

    starts: Integers
    low: NDArray[Any]
    high: NDArray[Any]


def stride_of(count: int, columns: int) -> int:
    """Return the number of samples per column with which at most `columns` columns are needed."""
    return max(1, -(-count // max(1, columns)))


def min_max(values: NDArray[Any], stride: int, first: int = 0) -> Columns:
    """Reduce samples to columns; their borders do not move when samples are added: they are multiples of the stride.

    Args:
        values: Samples, shape (n, ...).
        stride: Samples per column.
        first: Number of the first sample since the beginning; columns begin at multiples of the stride.
    """
    count = len(values)
    if count == 0:
        return Columns(np.empty(0, np.int64), values, values)
    begins = np.arange((-first) % stride, count, stride)
    starts = begins if len(begins) and begins[0] == 0 else np.concatenate([[0], begins])
    if stride == 1:
        return Columns(starts, values, values)
    low = np.minimum.reduceat(values, starts, axis=0)
    high = np.maximum.reduceat(values, starts, axis=0)
    return Columns(starts, low, high)
