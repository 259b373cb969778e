"""Restoring a drive: every step is tried, even after one failed; the error names those that failed."""

from __future__ import annotations

from collections.abc import Callable

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError

SILENT = 2  # consecutive steps without an answer after which the node is not asked any more: each takes seconds


class Tidying:
    """Independent steps, all of which are tried unless the node is silent."""

    def __init__(self) -> None:
        self._failures: list[str] = []
        self._silent = 0

    def step(self, act: Callable[[], None]) -> None:
        """Run a step; a failure is remembered."""
        if self._silent >= SILENT:
            return
        try:
            act()
            self._silent = 0
        except (BusError, ObjectAccessError) as error:
            self._failures.append(str(error))
            self._silent = self._silent + 1 if isinstance(error, NoAnswerError) else 0

    def end(self) -> None:
        """Raise BusError with all failures in one line, if there were any."""
        if self._failures:
            more = f" (and {len(self._failures) - 1} more)" if len(self._failures) > 1 else ""
            raise BusError(f"{self._failures[0]}{more}")
