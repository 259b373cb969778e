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
    """Let communication cycles pass: in cycle k, send row k of the outputs, then SYNC; receive row k of the samples.

    Args:
        link: The bus.
        pace: When SYNCs are due.
        cycles: Number of cycles.
        outputs: A row for each cycle; None: nothing is sent.
        samples: Collects the samples; None: nothing is sampled.
        timeout: Longest wait for samples [s].
        observe: Called with the numbers of the first and the last (excluded) row that are complete and new; in lockstep
            no SYNC is sent before the previous one's row was observed.
        barrier: Called now and then if there are no samples: waits until the nodes have caught up.
        skip_missed: Whether cycles missed by a late SYNC count: fewer SYNCs are sent, and the time is kept.

    Raises:
        NoAnswerError: If samples do not come.
    """
    window = 0 if observe is not None and pace.time_waits else pace.window
    seen = needed = 0

    def look() -> None:
        nonlocal seen
        if samples is not None and observe is not None:
            # In lockstep the observed rows must not depend on this computer's speed: only awaited ones are observed.
            complete = min(samples.complete(), max(needed, 0) if pace.time_waits else cycles)
            if complete > seen:
                first, seen = seen, complete
                observe(first, complete)

    pace.begin()
    # The first row waits for no SYNC, and its frames take 0.1 ms each on the bus: sent at once, a row that a policy
    # computes late in a cycle still makes the next SYNC. Later rows are sent just before their SYNC, and overtake none.
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
