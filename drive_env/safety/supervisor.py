"""The thread that watches the drives independently of the program: it looks, stops, and feeds the drives' watchdogs.

While the program runs communication cycles, their samples are watched, and this thread only looks at the clock. While
the program computes, sleeps, reads or writes, this thread asks the drives itself. If the program blocks the
interpreter, the master's signs of life end, too, and the drives stop by themselves.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable

from drive_env.fieldbus.errors import BusError

logger = logging.getLogger(__name__)

PERIOD = 0.004  # s between two turns
SWITCH_INTERVAL = 0.0005  # s after which a computing program yields the interpreter, instead of 5 ms


class Supervisor:
    """Runs a turn every few milliseconds.

    Args:
        turn: The function to call; its BusErrors are reported once, any other exception ends the thread.
        fail: Called when a turn has raised such an exception.
    """

    def __init__(self, turn: Callable[[], None], fail: Callable[[], None]) -> None:
        self._turn = turn
        self._fail = fail
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._interval = sys.getswitchinterval()
        self._thread = threading.Thread(target=self._run, name="drive supervisor", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._interval = sys.getswitchinterval()
        sys.setswitchinterval(min(self._interval, SWITCH_INTERVAL))
        self._thread.start()

    def wake(self) -> None:
        """Take the next turn now; callable from a signal handler."""
        self._wake.set()

    def is_this_thread(self) -> bool:
        """Return whether the caller runs in this thread."""
        return threading.get_ident() == self._thread.ident

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._wake.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(2.0)
        sys.setswitchinterval(self._interval)

    def _run(self) -> None:
        told = ""  # a BusError is reported once, not at every turn
        while not self._ended.is_set():
            begun = time.monotonic()
            try:
                self._turn()
                told = ""
            except BusError as error:
                # Signs of life that are not sent make the drives stop by themselves.
                if str(error) != told:
                    told = str(error)
                    logger.error("%s", told)
            except Exception:
                logger.exception("the drives cannot be monitored any more; they stop by their own watchdogs")
                self._fail()
                return
            self._wake.wait(max(PERIOD - (time.monotonic() - begun), 0.0005))
            self._wake.clear()
