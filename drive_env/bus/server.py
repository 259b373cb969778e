"""The one loop that serves a world to its masters, in lockstep or in real time."""

from __future__ import annotations

import threading
import time
from contextlib import nullcontext

from drive_env.bus.lateness import Lateness
from drive_env.bus.transport import Transport
from drive_env.bus.world import World
from drive_env.realtime_section import undisturbed

LONGEST_WAIT = 0.05  # s until a request to stop is seen
MOST_BEHIND = 0.25  # s; after a longer pause of the host the time is skipped
# s. select() wakes 80 to 110 us late (Linux, idle): events due within that time happen at once. Measured on two idle
# cores, 1 kHz SYNC with four PDOs: 0.43 instead of 0.59 ms from SYNC to TPDO, and 2,150 instead of 1,950 SDO answers a
# second while those took no time.
EARLY = 100e-6


class Server:
    """Serves a world over a transport.

    In real time a cycle is due every millisecond of the wall clock; late cycles follow at once. `run` serves in the
    calling thread; `start` and `stop`, or a with statement, in a separate thread.

    Attributes:
        lateness: Lateness of the cycles begun in real time [s].
        skipped: Time that was skipped [s].
        guard: Held while the world is changed; take it for changes from another thread.

    Args:
        world: The world to serve.
        transport: Connects its masters.
    """

    def __init__(self, world: World, transport: Transport) -> None:
        self.world = world
        self.transport = transport
        self.lateness = Lateness()
        self.skipped = 0.0
        self.guard = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self._start = 0.0
        self._end = float("inf")
        world.listeners.append(transport.deliver)

    def run(self, duration: float | None = None) -> None:
        """Serve for `duration` [s] of the wall clock, or until `stop`.

        Raises:
            can.CanError: If a python-can interface fails.
        """
        self.world.power_on()
        with undisturbed() if not self.world.lockstep else nullcontext():
            self._start = time.perf_counter() - self.world.time
            self._end = float("inf") if duration is None else time.perf_counter() + duration
            if self.world.lockstep:
                self._run_lockstep()
            else:
                self._run_real_time()
        self.transport.flush()

    def start(self) -> None:
        """Serve in a separate thread; all nodes are on when this returns."""
        self.world.power_on()
        self._thread = threading.Thread(target=self._run_guarded, name="bus server", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End serving; also from a signal handler or another thread. Raises the error that ended a serving thread."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def close(self) -> None:
        """Stop, and close the transport."""
        try:
            self.stop()
        finally:
            self.transport.close()

    def __enter__(self) -> Server:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _run_guarded(self) -> None:
        try:
            self.run()
        except Exception as error:  # raised again in `stop`
            self._failure = error

    def _over(self) -> bool:
        return self._stop.is_set() or time.perf_counter() >= self._end

    def _run_lockstep(self) -> None:
        world, transport, wire = self.world, self.transport, self.world.wire
        while not self._over():
            transport.flush()
            wait = min(LONGEST_WAIT, self._end - time.perf_counter())
            for frame, sender, extended in transport.wait(max(0.0, wait), wire):
                world.receive(frame, sender, extended=extended)
                transport.flush()

    def _run_real_time(self) -> None:
        world, transport, wire = self.world, self.transport, self.world.wire
        while not self._over():
            with self.guard:
                self.catch_up()
                transport.flush()
                wait = min(LONGEST_WAIT, world.next_event() - self._now() - EARLY)
            for frame, sender, extended in transport.wait(max(0.0, wait), wire):
                with self.guard:
                    self.catch_up()
                    world.receive(frame, sender, extended=extended)

    def _now(self) -> float:
        return time.perf_counter() - self._start

    @property
    def is_serving(self) -> bool:
        """Whether real time has begun."""
        return self._start > 0.0

    def catch_up(self) -> None:
        """Run everything that is due in real time; the caller holds the guard."""
        late = self._now() - self.world.next_cycle
        if late > MOST_BEHIND:
            self.skipped += late
            self._start += late
        self.world.run_until(self._now(), self._count_lateness, EARLY)

    def _count_lateness(self, due: float) -> None:
        self.lateness.add(self._now() - due)
