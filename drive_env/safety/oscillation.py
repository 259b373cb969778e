"""Detects an oscillating loop by how often its current swings from one side to the other."""

from __future__ import annotations

from collections import deque

# An oscillation: the current swings past plus and minus half its limit SWINGS times within the window. A change of
# speed of the load swings it once or twice; an oscillating loop once per period, at 40 Hz and more.
SWING, SWINGS, SWING_WINDOW = 0.5, 8, 100  # [1], [1], [cycles]


class Swings:
    """Counts how often a current swung from one side of a threshold to the other within the window."""

    def __init__(self) -> None:
        self._side = 0
        self._cycle = 0
        self._times: deque[int] = deque()

    def count(self, current: int, threshold: float) -> int:
        """Add a sample; return the number of swings within the window."""
        self._cycle += 1
        side = 1 if current > threshold else -1 if current < -threshold else 0
        if side and side != self._side:
            if self._side:
                self._times.append(self._cycle)
            self._side = side
        while self._times and self._times[0] <= self._cycle - SWING_WINDOW:
            self._times.popleft()
        return len(self._times)
