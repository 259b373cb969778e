"""SLOW_STRIDE=n: slow tests do the n-th part of their work. SLOW_SHARE=k/n: each n-th of them runs, from the k-th."""

import os

STRIDE = int(os.environ.get("SLOW_STRIDE", "1"))
FIRST, EACH = map(int, os.environ.get("SLOW_SHARE", "0/1").split("/"))


def part(whole: int, least: int) -> int:
    """Return how much of the whole a slow test does, `least` at least."""
    return max(whole // STRIDE, min(least, whole))
