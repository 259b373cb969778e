"""Communication cycles: set-points out, SYNC, samples in."""

from __future__ import annotations

from collections.abc import Callable

from drive_env.fieldbus.link import Link, Outputs, Samples
from drive_env.master.pace import Pace


def run_cycles(
    link: Link,
    pace: Pace,
    cycles: int,
    outputs: Outputs | None,
    samples: Samples | None,
    timeout: float,
    *,
    observe: Callable[[int, int], None] | None = None,
    barrier: Callable[[], None] | None = None,
    skip_missed: bool = False,
) -> None:
    """Let communication cycles pass: in cycle k row k of the outputs goes out, then SYNC; row k of the samples comes.

    Args:
        link: The bus.
        pace: When SYNCs are due.
        cycles: How many.
        outputs: A row for each cycle, or None for none.
        samples: What comes back, or None for nothing.
        timeout: Longest wait for them [s].
        observe: Called with the numbers of the first and the last (excluded) row that are complete and new; with it
            no SYNC goes out before the row of the one before was looked at, except where time does not wait.
        barrier: Called now and then, where no samples come back: returns when the nodes have caught up.
        skip_missed: Cycles that passed while a SYNC was late count: fewer are sent, and the time is kept.

    Raises:
        NoAnswerError: If samples stay out.
    """
    window = 0 if observe is not None and pace.time_waits else pace.window
    seen = needed = 0

    def look() -> None:
        nonlocal seen
        if samples is not None and observe is not None:
            # Where time waits, what is seen must not depend on how fast this computer is: only what was waited for.
            complete = min(samples.complete(), max(needed, 0) if pace.time_waits else cycles)
            if complete > seen:
                first, seen = seen, complete
                observe(first, complete)

    pace.begin()
    # The first row has no SYNC to wait for, and its frames take 0.1 ms each on the bus: a policy that computes it in
    # what is left of a cycle meets the next SYNC. Later rows go out just before theirs, and overtake none.
    if cycles and outputs is not None:
        outputs.send(0)
    sent = passed = 0
    while passed < cycles:
        missed = pace.wait(link.receive)
        passed += missed + 1 if skip_missed else 1
        look()
        if sent and outputs is not None:
            outputs.send(sent)
        link.sync()
        sent += 1
        if samples is not None:
            needed = sent - window if passed < cycles else sent
            if not link.wait(lambda needed=needed: samples.complete() >= needed, timeout):  # type: ignore[misc]
                raise samples.missing(sent, timeout)
        elif barrier is not None and sent % pace.window == 0:
            barrier()
    look()
