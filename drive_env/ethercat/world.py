"""A world on EtherCAT: emulated machines, their slaves in a line, and one time."""

from __future__ import annotations

from collections.abc import Callable

from drive_env.drives.interface import CYCLE
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.ethercat import datagrams
from drive_env.ethercat.controller import LOGICAL
from drive_env.ethercat.segment import Segment
from drive_env.ethercat.slave import EtherCatSlave

NANOSECONDS = 1e9  # of a second


def _nanoseconds(duration: float) -> int:
    return round(duration * NANOSECONDS)


class EtherCatWorld:
    """Slaves in a line and the drives behind them.

    In lockstep each frame with process data (LRD, LWR, LRW), and only such a frame, is followed by one communication
    cycle, or by as many as the drives' process images are apart. Frames take no time, and return the values from before
    that cycle. Otherwise `run_until` sets the time.

    Attributes:
        segment: The line.
        drives: All emulated drives.
        time: Time since the world began [s].
        cycles: Communication cycles that have passed.

    Args:
        lockstep: Whether time advances only with process data.
        cycle_time: Length of a communication cycle [s] if it has no drives of its own.
    """

    def __init__(self, *, lockstep: bool = True, cycle_time: float = CYCLE) -> None:
        self.lockstep = lockstep
        self._cycle_time = cycle_time
        self.segment = Segment()
        self.drives: list[EmulatedDrives] = []
        self.time = 0.0
        self.cycles = 0
        self._began = 0  # when the present cycle began [ns]
        self._passed: dict[int, int] = {}  # time that each of the drives has reached [ns]

    def add(self, slave: EtherCatSlave, drives: EmulatedDrives | None = None) -> None:
        """Put a slave at the end of the line; `drives` are new ones that advance with the world."""
        self.segment.add(slave)
        if drives is not None:
            self.drives.append(drives)

    def power_on(self) -> None:
        """Switch all slaves on."""
        self.segment.power_on(self.time)

    def receive(self, frame: bytes) -> bytes | None:
        """Return an Ethernet frame without FCS after it has passed all slaves; None if it is lost."""
        return self._after(self.segment.transfer(frame, self.time), datagrams.ETHERNET)

    def receive_payload(self, payload: bytes) -> bytes | None:
        """Return the payload of a UDP datagram after it has passed all slaves; None if it is lost."""
        return self._after(self.segment.transfer_payload(payload, self.time), 0)

    def run_until(self, now: float, begins: Callable[[float], None] | None = None, early: float = 0.0) -> None:
        """Run all events due until `now` [s], in their order; not in lockstep.

        Args:
            now: New time of the world [s].
            begins: Called at the beginning of a communication cycle, with its due time [s].
            early: A cycle due within this time [s] after `now` happens already.
        """
        while self.next_cycle <= now + early:
            if begins is not None:
                begins(self.next_cycle)
            self.cycle()
        self.pass_time(now)

    def pass_time(self, now: float) -> None:
        """Handle the pulses and watchdogs that are due until `now` [s]."""
        self.time = max(self.time, now)
        for slave in self.segment.slaves:
            slave.run_until(self.time)

    @property
    def cycle_time(self) -> float:
        """Length of a communication cycle [s]: the shortest one of its drives."""
        return min((drives.device.cycle for drives in self.drives), default=self._cycle_time)

    @property
    def image_period(self) -> float:
        """Time between two process images [s]: the shortest one of its drives."""
        return min((drives.image_period for drives in self.drives), default=self._cycle_time)

    @property
    def next_cycle(self) -> float:
        """When the next communication cycle ends [s]."""
        return (self._began + _nanoseconds(self.cycle_time)) / NANOSECONDS

    def next_event(self) -> float:
        """Return when `run_until` next has something to do [s]."""
        return min(self.next_cycle, *(slave.next_event() for slave in self.segment.slaves))

    def cycle(self) -> None:
        """Let one communication cycle pass."""
        self.begin_cycle()
        due = self._began + _nanoseconds(self.cycle_time)
        for k, drives in enumerate(self.drives):
            end = self._passed.setdefault(k, self._began) + _nanoseconds(drives.device.cycle)
            if end <= due:
                drives.advance(drives.device.cycle)
                self._passed[k] = end
        self.end_cycle()

    def begin_cycle(self) -> None:
        """Run everything due before the drives advance."""
        for slave in self.segment.slaves:
            slave.before_cycle(self.time)

    def end_cycle(self) -> None:
        """Run everything due after the drives have advanced."""
        self.cycles += 1
        self._began += _nanoseconds(self.cycle_time)
        self.time = max(self.time, self._began / NANOSECONDS)
        for slave in self.segment.slaves:
            slave.run_until(self.time)
            slave.after_cycle(self.time)

    def close(self) -> None:
        """End the drives."""
        for drives in self.drives:
            drives.close()

    # --- inside -----------------------------------------------------------------------------------------------------
    def _after(self, done: bytes | None, start: int) -> bytes | None:
        """In lockstep, let the time to the next image pass after a frame with process data; return `done`."""
        if done is not None and self.lockstep:
            start = datagrams.begin(done) or start if start else start
            if any(place.command in LOGICAL for place in datagrams.find(done, start) or ()):
                due = self._began + _nanoseconds(self.image_period)
                while self._began < due:
                    self.cycle()
        return done
