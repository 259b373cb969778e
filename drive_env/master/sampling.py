"""Communication cycles: set-points out, SYNC, samples in."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drive_env.canopen.frames import SYNC
from drive_env.master.can.pdo import RemotePdo
from drive_env.master.can.port import Port
from drive_env.master.errors import BusError, NoAnswerError
from drive_env.master.pace import Pace

Bytes = NDArray[np.uint8]


class Samples:
    """The TPDOs that come with the SYNCs of a run; the k-th frame of each belongs to the k-th SYNC.

    Args:
        port: The bus.
        pdos: What to collect.
    """

    def __init__(self, port: Port, pdos: Sequence[RemotePdo]) -> None:
        self._port = port
        self._pdos = pdos
        port.drain()  # what an earlier run left behind belongs to its SYNCs
        self.frames: list[list[bytes]] = [[] for _ in pdos]
        for pdo, frames in zip(pdos, self.frames, strict=True):
            port.subscribe(pdo.can_id, frames.append)

    def complete(self) -> int:
        """Return how many rows are complete."""
        return min((len(frames) for frames in self.frames), default=0)

    def close(self) -> None:
        """Take nothing more."""
        for pdo in self._pdos:
            self._port.subscribe(pdo.can_id, None)

    def missing(self, rows: int, timeout: float) -> NoAnswerError:
        """Return the error for a TPDO that did not come."""
        pdo, frames = min(zip(self._pdos, self.frames, strict=True), key=lambda pair: len(pair[1]))
        return NoAnswerError(
            f"{pdo.label} ({pdo.can_id:03X}h) came {len(frames)} times for {rows} SYNCs, and no more within "
            f"{timeout:g} s; check that the node is operational and takes SYNC as {SYNC:03X}h (1005h), and the bus "
            "load"
        )

    def bytes_of(self, number: int, first: int, last: int) -> Bytes:
        """Return rows `first` to `last` (excluded) of TPDO `number` of this run, shape (rows, length).

        Raises:
            BusError: If a frame has another length than its mapping.
        """
        pdo = self._pdos[number]
        rows = self.frames[number][first:last]
        wrong = [row for row in rows if len(row) != pdo.length]
        if wrong:
            raise BusError(
                f"{pdo.label} ({pdo.can_id:03X}h) has {pdo.length} bytes by its mapping, and {len(wrong[0])} came: "
                f"{wrong[0].hex(' ')}; is another node or master using this identifier?"
            )
        return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), pdo.length)


def run_cycles(
    port: Port,
    pace: Pace,
    cycles: int,
    rpdos: Sequence[tuple[int, Bytes]],
    samples: Samples | None,
    timeout: float,
    *,
    observe: Callable[[int, int], None] | None = None,
    barrier: Callable[[], None] | None = None,
    skip_missed: bool = False,
) -> None:
    """Let communication cycles pass: in cycle k row k of each RPDO goes out, then SYNC; row k of the TPDOs comes back.

    Args:
        port: The bus.
        pace: When SYNCs are due.
        cycles: How many.
        rpdos: Identifier, and a row of bytes for each cycle.
        samples: The TPDOs that come back, or None for none.
        timeout: Longest wait for them [s].
        observe: Called with the numbers of the first and the last (excluded) row that are complete and new; with it
            no SYNC goes out before the row of the one before was looked at, except where time does not wait.
        barrier: Called now and then, where no samples come back: returns when the nodes have caught up.
        skip_missed: Cycles that passed while a SYNC was late count: fewer are sent, and the time is kept.

    Raises:
        NoAnswerError: If TPDOs stay out.
    """
    window = 1 if observe is not None and pace.time_waits else pace.window
    frames = [(can_id, [row.tobytes() for row in rows]) for can_id, rows in rpdos]
    seen = 0

    def look() -> None:
        nonlocal seen
        if samples is not None and observe is not None:
            complete = min(samples.complete(), cycles)
            if complete > seen:
                first, seen = seen, complete
                observe(first, complete)

    def send_row(number: int) -> None:
        for can_id, rows in frames:
            port.send(can_id, rows[number])

    pace.begin()
    # The first row has no SYNC to wait for, and its frames take 0.1 ms each on the bus: a policy that computes it in
    # what is left of a cycle meets the next SYNC. Later rows go out just before theirs, and overtake none.
    if cycles:
        send_row(0)
    sent = passed = 0
    while passed < cycles:
        missed = pace.wait(port.receive)
        passed += missed + 1 if skip_missed else 1
        look()
        if sent:
            send_row(sent)
        port.send(SYNC)
        sent += 1
        if samples is not None:
            needed = sent - window if passed < cycles else sent
            if not port.wait(lambda needed=needed: samples.complete() >= needed, timeout):  # type: ignore[misc]
                raise samples.missing(sent, timeout)
        elif barrier is not None and sent % pace.window == 0:
            barrier()
    look()
