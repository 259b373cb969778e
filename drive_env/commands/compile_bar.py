"""The progress of a cold start on stderr while Numba compiles the kernels: a line, and on a terminal a bar."""

from __future__ import annotations

import atexit
import logging
import sys
from typing import TYPE_CHECKING

from drive_env.commands.progress import progress_on, shown

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

KERNELS = "mechanics.kernels.kernel_files"  # logger of compilations
# Number of functions that Numba compiles for a kernel, including its stages, after those above. Programs that run
# drives need the first three.
FUNCTIONS = {
    "cycle.power_on": 24, "cycle.write_events": 54, "cycle.run": 107, "prepared_record.from_od": 2,
    "prepared_record.to_od": 2, "tracking_cycle.describe_lanes": 3, "tracking_cycle.act": 5,
    "tracking_cycle.observe": 1, "cyclic_control.convert_in": 1, "cyclic_control.convert_out": 1,
}  # fmt: skip
ALWAYS = ("cycle.power_on", "cycle.write_events", "cycle.run")
OF_OTHERS = 1


def show_compiling() -> CompileBar:
    """Show kernels as they compile from now on, and return the bar that shows them."""
    kernels = logging.getLogger(KERNELS)
    for handler in [one for one in kernels.handlers if isinstance(one, CompileBar)]:
        kernels.removeHandler(handler)
    bar = CompileBar()
    kernels.addHandler(bar)
    kernels.setLevel(logging.DEBUG)
    return bar


class CompileBar(logging.Handler):
    """Shows the log of `kernel_files`: lines unchanged, kernels as a progress bar over functions."""

    def __init__(self) -> None:
        super().__init__()
        self.done = self.total = 0
        self._needed: set[str] = set()
        self._own: Progress | None = None  # created if no other bars are shown
        self._bars: Progress | None = None
        self._task: TaskID | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record."""
        from mechanics.kernels.kernel_files import COMPILED, COMPILING

        if record.levelno > logging.DEBUG:
            if not logging.getLogger().handlers:  # with --verbose the log contains it
                print(record.getMessage(), file=sys.stderr, flush=True)
        elif sys.stderr.isatty() and record.msg == COMPILING:
            self._begin(str(record.args[0]).partition("-")[0] if isinstance(record.args, tuple) else "")
        elif record.msg == COMPILED:
            self._end()

    def count(self) -> None:
        """Count a function that was compiled."""
        self.done += 1
        self.total = max(self.total, self.done)
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, completed=self.done, total=self.total)

    def _begin(self, kernel: str) -> None:
        from rich.console import Console

        if not self._needed:
            self._watch()
        needed = set(ALWAYS if kernel in ALWAYS else [kernel]) - self._needed
        self._needed |= needed
        self.total += sum(FUNCTIONS.get(name, OF_OTHERS) for name in needed)
        self._end()
        self._own = self._own or progress_on(Console(file=sys.stderr), transient=True)
        bars = next((one for one in reversed(shown) if one.console.is_terminal), self._own)
        if bars is not self._bars or self._task is None:
            self._bars, self._task = bars, bars.add_task("compiling, once", total=self.total)
        # One bar for all kernels, which keeps counting the time.
        bars.update(self._task, completed=self.done, total=self.total, visible=True)
        if bars is self._own:
            bars.start()

    def _end(self) -> None:
        if self._bars is not None and self._task is not None:
            if self._bars is self._own:
                self._bars.stop()
            self._bars.update(self._task, visible=False)

    def _watch(self) -> None:
        from mechanics.kernels.compiled import call_after_each_function

        call_after_each_function(self.count)
        atexit.register(self._end)  # restores a terminal's cursor, however the program ends
