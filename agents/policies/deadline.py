"""Calls that are waited for no longer than a deadline: a policy is anybody's code, and may never come back.

Each call is made in a thread of its own, so that the one that acts on drives goes on whatever the other does: it
computes for ever, waits for what never comes, or sleeps. What holds the interpreter's lock all the while (a compiled
extension can) stops this process altogether; the drives then miss its heartbeat and stop by themselves.
"""

from __future__ import annotations

import contextlib
import contextvars
import ctypes
import queue
import sys
import threading
from collections.abc import Callable
from typing import Any

from drive_env.realtime_section import SWITCH_INTERVAL


class DeadlineError(TimeoutError):
    """A call did not come back in time."""


class Deadline:
    """Makes calls one after the other in one thread; one that is late is given up, and with it the thread."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ends: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def call(self, function: Callable[..., Any], *arguments: Any, within: float) -> Any:
        """Return what the function returns, or raise what it raises.

        Args:
            function: What is called.
            arguments: With what.
            within: How long it may take [s].

        Raises:
            DeadlineError: If it has not come back by then; the next call begins a new thread.
        """
        if self._thread is None:
            context = contextvars.copy_context()  # NumPy's error handling, for one, is as it is here
            run = (_serve, self._calls, self._ends)
            self._thread = threading.Thread(target=context.run, args=run, name="policy", daemon=True)
            self._thread.start()
        self._calls.put((function, arguments))
        try:
            error, value = self._ends.get(timeout=within)
        except queue.Empty:
            self._give_up()
            raise DeadlineError(f"no answer within {within:g} s") from None
        except BaseException:  # Ctrl-C while it is waited for
            self._give_up()
            raise
        if error is not None:
            raise error
        return value

    def close(self) -> None:
        """End the thread."""
        if self._thread is not None:
            self._calls.put(None)
            self._thread.join()
            self._thread = None

    def __del__(self) -> None:
        self._calls.put(None)

    def _give_up(self) -> None:
        """Leave the thread behind; what it says later nobody hears, and if it runs Python, it is ended there."""
        thread, self._thread = self._thread, None
        self._calls.put(None)
        self._calls, self._ends = queue.SimpleQueue(), queue.SimpleQueue()
        # It may compute on, and would keep the interpreter for 5 ms at a time while the drives are being stopped.
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL))
        if thread is not None and thread.ident is not None:
            with contextlib.suppress(Exception):  # of CPython alone
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))


def _serve(calls: queue.SimpleQueue[Any], ends: queue.SimpleQueue[Any]) -> None:
    with contextlib.suppress(SystemExit):  # of a thread that was given up, wherever it is by now
        while (call := calls.get()) is not None:
            function, arguments = call
            try:
                ends.put((None, function(*arguments)))
            except BaseException as error:  # the caller's, whatever it is
                ends.put((error, None))
