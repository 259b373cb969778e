"""Objects that no process data carry, read by SDO while cycles pass: each row has the value that was read last.

Only for states, which change seldom: a position would be wrong, since its value is some milliseconds old.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import TracebackType

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from mechanics.arrays import Integers

CAN_BE_ASKED = ((cia402.STATUSWORD, 0),)
PAUSE = 0.004  # s between two answers and the next question


class AskedRows:
    """Asks for objects in a thread, as long as a with statement lasts.

    Args:
        entries: The objects.
        read: Reads one object of every axis.
        passed: Returns the number of rows so far.
    """

    def __init__(self, entries: Sequence[Entry], read: Callable[[Entry], Integers], passed: Callable[[], int]) -> None:
        self._entries = tuple(entries)
        self._read, self._passed = read, passed
        self._told: list[tuple[int, list[Integers]]] = []
        self._error: BaseException | None = None
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="asked meanwhile", daemon=True)

    def _run(self) -> None:
        try:
            while not self._told or not self._is_over.wait(PAUSE):
                # A value belongs to the first row that is not yet complete when it arrives.
                values = [self._read(entry) for entry in self._entries]
                self._told.append((self._passed(), values))
        except BaseException as error:  # raised in `rows`
            self._error = error

    def rows(self, count: int) -> dict[Key, Integers]:
        """Return each object of shape (count, num_axes); raises the error that ended the reads."""
        if self._error is not None:
            raise self._error
        # The first value is also used for the rows before it.
        begins = np.minimum([0, *(row for row, _ in self._told[1:])], count)
        times = np.diff(begins, append=count)
        return {
            (entry.index, entry.sub): np.repeat(np.stack([values[k] for _, values in self._told]), times, axis=0)
            for k, entry in enumerate(self._entries)
        }

    def __enter__(self) -> AskedRows:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_over.set()
        self._thread.join()
