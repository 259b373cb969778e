"""When the envelope takes a current for that of a loop that shakes: eight swings past the threshold in 100 cycles."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env.safety.oscillation import SWING_WINDOW, SWINGS, Swings

THRESHOLD = 1000.0  # mA


def swings(current):
    counter = Swings()
    return max(counter.count(int(value), THRESHOLD) for value in current)


def square(period, offset=0, amplitude=1500, cycles=1000):
    """Return a square wave [mA] around an offset, its period in cycles."""
    return offset + amplitude * np.where(np.arange(cycles) // (period // 2) % 2, -1, 1)


@pytest.mark.parametrize(
    ("current", "shakes"),
    [
        (square(24), True),  # 42 Hz
        (square(30), False),  # 33 Hz: seven in the window
        (square(4), True),
        (square(4, amplitude=1001), True),
        (square(4, amplitude=1000), False),  # the threshold itself is not past it
        (square(4, offset=600), False),  # +2100 and -900: one side alone
        (np.full(1000, 30_000), False),  # a large constant current is no oscillation, whatever it is
        (square(4, offset=30_000), False),  # nor what rides on it
        (np.repeat([30_000, -30_000, 30_000], 400), False),  # nor a reversal
        (30_000 + np.random.default_rng(1).normal(0.0, 3000.0, 1000), False),
    ],
)
def test_a_loop_shakes_where_its_current_swings_from_side_to_side(current, shakes):
    assert (swings(current) >= SWINGS) == shakes


def test_swings_are_forgotten_after_the_window():
    counter = Swings()
    for value in [1500, -1500] * 4:
        found = counter.count(value, THRESHOLD)
    assert found == 7
    for _ in range(SWING_WINDOW - 1):
        found = counter.count(0, THRESHOLD)
    assert found == 1  # the last one
    assert counter.count(0, THRESHOLD) == 0
