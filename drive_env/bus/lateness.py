"""How late each communication cycle was, as a histogram of constant size."""

from __future__ import annotations

BIN = 10e-6  # s
BINS = 10_000  # the last one counts everything above 100 ms


class Lateness:
    """Counts of cycles by lateness [s].

    Attributes:
        count: Cycles counted.
        largest: The latest [s].
    """

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0.0
        self._bins = [0] * BINS

    def add(self, late: float) -> None:
        """Count a cycle that began `late` [s] after its time."""
        self.count += 1
        self._bins[min(int(max(late, 0.0) / BIN), BINS - 1)] += 1
        self.largest = max(self.largest, late)

    def percentile(self, share: float) -> float:
        """Return the lateness [s] that a share (0 to 1) of all cycles did not exceed, to 10 us; nan without cycles."""
        if not self.count:
            return float("nan")
        needed, seen = share * self.count, 0
        for k, count in enumerate(self._bins):
            seen += count
            if seen >= needed:
                return min((k + 1) * BIN, self.largest)
        return self.largest
