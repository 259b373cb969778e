"""A segment: slaves in a line. A frame passes each of them on its way out and comes back through all.

An incomplete frame (its datagrams must fill its length) changes nothing: the first slave counts it (030Ch), and the
following ones count that an earlier slave did (0308h).
"""

from __future__ import annotations

from collections.abc import Callable

from drive_env.ethercat import datagrams, registers
from drive_env.ethercat.slave import EtherCatSlave

HOP = 450  # ns from one slave's port to the next one's: a metre of cable, receiver, processing unit; our choice
SOURCE, LOCAL = 6, 0x02  # a controller sets this bit of the source address to mark a frame that has passed


class Segment:
    """Slaves in a line.

    Attributes:
        slaves: In the order of the line.
        listeners: Called with time [s], the frame as sent or as returned, and whether it is the returned one.
    """

    def __init__(self) -> None:
        self.slaves: list[EtherCatSlave] = []
        self.listeners: list[Callable[[float, bytes, bool], None]] = []

    def add(self, slave: EtherCatSlave) -> None:
        """Put a slave at the end of the line."""
        if self.slaves:
            self.slaves[-1].controller.connect(ends_line=False)
        self.slaves.append(slave)

    def power_on(self, now: float) -> None:
        """Switch all slaves on."""
        for slave in self.slaves:
            slave.power_on(now)

    def transfer(self, frame: bytes, now: float) -> bytes | None:
        """Return an Ethernet frame without FCS after it has passed all slaves at `now` [s]; None if it is lost."""
        start = datagrams.begin(frame)
        if start is None:
            return None
        body = bytearray(frame)
        if not self._pass(body, start, now):
            return None
        body[SOURCE] |= LOCAL
        done = bytes(body)
        for listener in self.listeners:
            listener(now, frame, False)
            listener(now, done, True)
        return done

    def transfer_payload(self, payload: bytes, now: float) -> bytes | None:
        """Return the payload of a UDP datagram after it has passed all slaves; None if it is lost."""
        frame = datagrams.BROADCAST + datagrams.MASTER + datagrams.ETHERTYPE + payload
        done = self.transfer(frame, now)
        return None if done is None else done[datagrams.ETHERNET :]

    # --- inside -----------------------------------------------------------------------------------------------------
    def _pass(self, body: bytearray, start: int, now: float) -> bool:
        """Pass a frame through all slaves; return whether it was complete."""
        places = datagrams.find(body, start)
        if places is None:
            for k, slave in enumerate(self.slaves):
                slave.controller.count(registers.UNIT_ERRORS if k == 0 else registers.FORWARDED_ERRORS)
            return False
        time = round(now * 1e9)
        last = len(self.slaves) - 1
        for k, slave in enumerate(self.slaves):
            slave.controller.process(body, places, time + k * HOP)
        for k, slave in enumerate(self.slaves):
            clock = slave.controller.clock
            if clock.is_measuring:
                clock.is_measuring = False
                if k < last:
                    clock.latch(1, time + (2 * last - k) * HOP)
            slave.after_frame(now)
        return True
