"""Signals that end a program, as Ctrl-C, wait for the end of a block, so that drives are not left half stopped."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_ENDS = ("SIGINT", "SIGTERM", "SIGHUP")


@contextmanager
def held_signals() -> Iterator[list[int]]:
    """Note the signals that would end the program in the list given, as often as they come, and do nothing else.

    Handlers are back afterwards; what then follows from a signal is the caller's to say. In another thread than the
    main one, which signals do not reach, nothing is noted.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = {getattr(signal, name): signal.getsignal(getattr(signal, name)) for name in _ENDS if hasattr(signal, name)}
    # One that is ignored (nohup) stays so; None is a handler that is not Python's.
    held = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in held:
        signal.signal(number, lambda number, frame: noted.append(number))
    try:
        yield noted
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
