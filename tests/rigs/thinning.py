"""SLOW_STRIDE=n: slow tests do the n-th part of what they do; unset, all."""

import os

STRIDE = int(os.environ.get("SLOW_STRIDE", "1"))


def part(whole: int, least: int) -> int:
    """Return how much of the whole a slow test does, `least` at least."""
    return max(whole // STRIDE, min(least, whole))
