"""What `record` returns, from an emulator and from a bus alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.entries import ObjectDictionary, ObjectName

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


class Trace:
    """A recorded move: sample times `t` [s], shape (n,), and each object's integers, shape (n, num_axes)."""

    def __init__(self, t: Floats, values: dict[tuple[int, int], Integers], dictionary: ObjectDictionary) -> None:
        self.t = t
        self._values = values
        self._dictionary = dictionary

    def __getitem__(self, name: ObjectName) -> Integers:
        entry = self._dictionary.find(name)
        if (entry.index, entry.sub) not in self._values:
            recorded = ", ".join(self._dictionary.find(key).label for key in self._values)
            raise KeyError(f"{entry.label} was not recorded; there are {recorded}")
        return self._values[entry.index, entry.sub]

    @classmethod
    def joined(cls, traces: Sequence[Trace], period: float) -> Trace:
        """Return as one what was recorded in parts, at least one, of the same objects at the same period [s]."""
        first = traces[0]
        values = {key: np.concatenate([trace._values[key] for trace in traces]) for key in first._values}
        rows = sum(map(len, traces))
        return cls(np.arange(rows, dtype=np.float64) * period, values, first._dictionary)

    def __len__(self) -> int:
        return len(self.t)
