"""What a program does that has to be punctual to a millisecond: keep the interpreter from taking turns of its own."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# s. A busy thread of the same process (a master on the virtual bus) gives the interpreter up that soon. Lateness of
# cycles beside one, p99: with Python's 5 ms above 100 ms, with 0.5 ms 1.8 ms, with 0.1 ms 0.3 ms; it loses 5 %.
SWITCH_INTERVAL = 0.0001


@contextmanager
def undisturbed() -> Iterator[None]:
    """Keep garbage collection and long turns of other threads away.

    A full collection takes 50 ms with the compiler and MuJoCo loaded; frozen, what exists now is never looked at
    again, and collecting the rest takes microseconds.
    """
    interval = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()
