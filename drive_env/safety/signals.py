"""Signals that end a program: the motors are stopped first, and a second signal does not cut the stop short.

A program that gets SIGTERM or SIGHUP would end at once and leave its motors to the drives' watchdogs.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Protocol

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


class Guarded(Protocol):
    """Receives signals."""

    def interrupt(self) -> bool:
        """Begin to stop; return whether a stop that a signal before began is still under way."""

    def carry_on(self) -> None:
        """Note that the program continues despite the signal."""


_guarded: list[Guarded] = []
_before: dict[int, Any] = {}


def guard(one: Guarded) -> None:
    """Stop this one first at a signal. Only the main thread can; elsewhere the drives' watchdogs must do."""
    if threading.current_thread() is not threading.main_thread():
        return
    if one not in _guarded:
        _guarded.append(one)
    for name in NAMES:
        number = getattr(signal, name, None)
        if number is None or number in _before:
            continue
        found = signal.getsignal(number)
        # Ignored: the program was started to outlive its terminal (nohup). None: set by something that is not Python.
        if found not in (signal.SIG_IGN, None):
            _before[number] = found
            signal.signal(number, _handle)


def release(one: Guarded) -> None:
    """Undo `guard`; after the last one the previous signal handlers are restored."""
    if one in _guarded:
        _guarded.remove(one)
    if _guarded or threading.current_thread() is not threading.main_thread():
        return
    for number, found in list(_before.items()):
        if signal.getsignal(number) is _handle:
            signal.signal(number, found)
        del _before[number]


def _handle(number: int, frame: FrameType | None) -> None:
    guarded = list(_guarded)
    under_way = [one.interrupt() for one in guarded]  # a list: every one must be interrupted
    if any(under_way):
        return
    before = _before.get(number, signal.SIG_DFL)
    if not callable(before):
        raise SystemExit(128 + number)
    before(number, frame)
    for one in guarded:
        one.carry_on()
