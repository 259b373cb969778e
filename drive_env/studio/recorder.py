"""Samples of the drives in a ring buffer: the newest minutes of some objects, at every communication cycle."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from drive_env.cia402 import Key
from drive_env.drives.trace import Trace
from mechanics.arrays import Floats, Integers

CAPACITY = 120_000  # samples: two minutes at 1 kHz
GAP = 1.5  # of the time between two samples: a larger distance is a gap


@dataclass(frozen=True)
class RingSamples:
    """Consecutive samples.

    first: Number of the first sample since the ring began.
    t: Times [s], shape (n,).
    values: Integers of each object, shape (n, num_axes).
    """

    first: int
    t: Floats
    values: dict[Key, Integers]

    def __len__(self) -> int:
        return len(self.t)


class SampleRing:
    """The newest samples of some objects, as raw integers.

    Args:
        keys: The objects.
        num_axes: Number of axes.
        capacity: Number of samples that are kept.
    """

    def __init__(self, keys: tuple[Key, ...], num_axes: int, capacity: int = CAPACITY) -> None:
        self.keys = keys
        self.total = 0  # samples so far, with those that were overwritten
        self._capacity = capacity
        self._t = np.zeros(capacity)
        self._values = np.zeros((capacity, len(keys), num_axes), np.int64)

    @property
    def oldest(self) -> int:
        """The number of the oldest sample that is kept."""
        return max(0, self.total - self._capacity)

    def append(self, t: Floats, values: dict[Key, Integers]) -> None:
        """Add samples."""
        skipped = max(0, len(t) - self._capacity)
        places = (self.total + np.arange(skipped, len(t))) % self._capacity
        self._t[places] = t[skipped:]
        for k, key in enumerate(self.keys):
            self._values[places, k] = values[key][skipped:]
        self.total += len(t)

    def read(self, first: int, last: int) -> RingSamples:
        """Return the samples from number `first` to before `last`, without those that are not kept."""
        first, last = max(first, self.oldest), min(last, self.total)
        places = np.arange(first, max(first, last)) % self._capacity
        values = self._values[places]
        return RingSamples(first, self._t[places], {key: values[:, k] for k, key in enumerate(self.keys)})


class ScopeRecorder:
    """Records the samples of every call that lets time pass; read by any thread.

    Args:
        num_axes: Number of axes.
        period: Time between two samples [s].

    Attributes:
        period: Time between two samples [s].
        now: End of the newest sample [s], since the beginning.
        generation: Increases when other objects are sampled: numbers of samples then begin again.
    """

    def __init__(self, num_axes: int, period: float) -> None:
        self.period = period
        self.now = 0.0
        self.generation = 0
        self.lock = threading.RLock()
        self._num_axes = num_axes
        self._objects: tuple[Key, ...] = ()
        self._ring = SampleRing((), num_axes, 1)

    @property
    def objects(self) -> tuple[Key, ...]:
        """The objects to sample in each cycle."""
        return self._objects

    @objects.setter
    def objects(self, keys: tuple[Key, ...]) -> None:
        self._objects = tuple(dict.fromkeys(keys))

    @property
    def ring(self) -> SampleRing:
        """The ring with the newest samples."""
        return self._ring

    def keep(self, trace: Trace, asked: tuple[Key, ...], start: float, end: float) -> None:
        """Add a trace that began and ended at times [s], with the objects that were asked for."""
        with self.lock:
            if asked != self._ring.keys:
                self._ring = SampleRing(asked, self._num_axes)
                self.generation += 1
            if len(trace):
                self._ring.append(start + trace.t, {key: trace[key] for key in asked})
            self.now = end

    def newest(self) -> dict[Key, Integers]:
        """Return the newest sample of each object, shape (num_axes,); empty before the first one."""
        with self.lock:
            rows = self._ring.read(self._ring.total - 1, self._ring.total)
        return {key: values[0] for key, values in rows.values.items()} if len(rows) else {}
