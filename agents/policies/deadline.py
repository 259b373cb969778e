"""Calls with a deadline: a policy is foreign code, and may never return.

Calls are made in a separate thread, so that the thread that acts on drives continues even if a call computes, waits or
sleeps for ever. Code that holds the interpreter's lock all the time (a compiled extension can) stops the whole process;
the drives then miss its heartbeat and stop by themselves.
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
    """A call did not return in time."""


class Deadline:
    """Makes calls one after the other in one thread; a late one is abandoned together with the thread."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ends: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def call(self, function: Callable[..., Any], *arguments: Any, within: float) -> Any:
        """Call a function in the thread; return its result, or raise its exception.

        Args:
            function: The function.
            arguments: Its arguments.
            within: Longest duration [s].

        Raises:
            DeadlineError: If it has not returned by then; the next call begins a new thread.
        """
        if self._thread is None:
            context = contextvars.copy_context()  # keeps, for example, NumPy's error handling
            run = (_serve, self._calls, self._ends)
            self._thread = threading.Thread(target=context.run, args=run, name="policy", daemon=True)
            self._thread.start()
        self._calls.put((function, arguments))
        try:
            error, value = self._ends.get(timeout=within)
        except queue.Empty:
            self._give_up()
            raise DeadlineError(f"no answer within {within:g} s") from None
        except BaseException:  # Ctrl-C during the wait
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
        """Abandon the thread: its answer is dropped, and if it runs Python code, it is ended."""
        thread, self._thread = self._thread, None
        self._calls.put(None)
        self._calls, self._ends = queue.SimpleQueue(), queue.SimpleQueue()
        # It might compute on, and hold the interpreter for 5 ms at a time while the drives are being stopped.
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL))
        if thread is not None and thread.ident is not None:
            with contextlib.suppress(Exception):  # only on CPython
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))


def _serve(calls: queue.SimpleQueue[Any], ends: queue.SimpleQueue[Any]) -> None:
    with contextlib.suppress(SystemExit):  # of an abandoned thread, at any point
        while (call := calls.get()) is not None:
            function, arguments = call
            try:
                ends.put((None, function(*arguments)))
            except BaseException as error:  # passed to the caller, of any type
                ends.put((error, None))
