"""The loop that serves a world on EtherCAT to its master, in lockstep or in real time."""

from __future__ import annotations

import threading
import time
from contextlib import nullcontext

from drive_env.bus.lateness import Lateness
from drive_env.ethercat.ways import EtherCatWay, UdpSocket
from drive_env.ethercat.world import EtherCatWorld
from drive_env.realtime_section import undisturbed

LONGEST_WAIT = 0.05  # s until a request to stop is seen
MOST_BEHIND = 0.25  # s; after a longer pause of the host the time is skipped
EARLY = 100e-6  # s by which cycles may begin early: select() wakes about as late


class EtherCatServer:
    """Serves a world over a transport.

    `run` serves in the calling thread, a with statement in a separate thread.

    Attributes:
        world: The world to serve.
        way: Connects its master.
        lateness: Lateness of the cycles begun in real time [s].
        answer_times: How long frames waited for their answer [s].
        skipped: Time that was skipped [s].
    """

    def __init__(self, world: EtherCatWorld, way: EtherCatWay) -> None:
        self.world = world
        self.way = way
        self.lateness, self.answer_times = Lateness(), Lateness()
        self.skipped = 0.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._start = 0.0
        self._receive = world.receive_payload if isinstance(way, UdpSocket) else world.receive

    def run(self, duration: float | None = None) -> None:
        """Serve for `duration` [s] of the wall clock, or until `stop`."""
        world = self.world
        world.power_on()
        with undisturbed() if not world.lockstep else nullcontext():
            self._start = time.perf_counter() - world.time
            end = float("inf") if duration is None else time.perf_counter() + duration
            late = self.answer_times.add
            while not self._stop.is_set() and (now := time.perf_counter()) < end:
                wait = min(LONGEST_WAIT, end - now)
                if world.lockstep:
                    self.way.serve(wait, self._receive, late)
                    continue
                self._catch_up()
                wait = min(wait, world.next_event() - self._now() - EARLY)
                self.way.serve(max(0.0, wait), self._receive_in_time, late)

    def stop(self) -> None:
        """End serving; also from a signal handler or another thread."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        """Stop, and close the transport."""
        self.stop()
        self.way.close()

    def __enter__(self) -> EtherCatServer:
        self._thread = threading.Thread(target=self.run, name="EtherCAT server", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- inside -----------------------------------------------------------------------------------------------------
    def _now(self) -> float:
        return time.perf_counter() - self._start

    def _receive_in_time(self, frame: bytes) -> bytes | None:
        world = self.world
        world.time = max(world.time, min(self._now(), world.next_cycle))  # never beyond the cycle due next
        return self._receive(frame)

    def _catch_up(self) -> None:
        """Run everything due, but at most one cycle: waiting frames must not wait for several."""
        world, now = self.world, self._now()
        late = now - world.next_cycle
        if late > MOST_BEHIND:
            self.skipped += late
            self._start += late
            now -= late
        world.run_until(min(now, world.next_cycle), self._count_lateness, EARLY if late < 0.0 else 0.0)

    def _count_lateness(self, due: float) -> None:
        self.lateness.add(self._now() - due)
