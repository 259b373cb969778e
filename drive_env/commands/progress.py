"""Bars of work under way, on stderr; none with --quiet."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

# Bars on the terminal, the last one on top: a second display beside them would garble both.
shown: list[Progress] = []


def progress_on(console: Console, *, transient: bool = False) -> Progress:
    """Return bars for a console: the task, the share done and the time since; transient ones vanish."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

    class Bars(Progress):
        def start(self) -> None:
            shown.append(self)
            super().start()

        def stop(self) -> None:
            if self in shown:
                shown.remove(self)
            super().stop()

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    return Bars(*columns, console=console, transient=transient, disable=is_quiet())


def is_quiet() -> bool:
    """Return whether the program runs with --quiet: warnings are off."""
    return not logging.getLogger("drive_env").isEnabledFor(logging.WARNING)
