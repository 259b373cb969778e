"""The modelled wire: bit rate, arbitration, length of frames, faults by seed. Its callers pass the time."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from drive_env.bus.bits import broken_frame_bits, frame_bits
from drive_env.bus.faults import Faults
from drive_env.canopen.frames import Frame

BIT_RATE = 1_000_000  # bit/s, the factory bit rate of the TMCM-1636
REORDER_WINDOW = 0.001  # s for which a frame to be overtaken waits for the next one
MOST_SENDERS = 256  # beyond that, senders without waiting frames are forgotten
# ISO 11898-1, fault confinement: the transmit error counter.
ERROR_STEP, PASSIVE_LIMIT, BUS_OFF_LIMIT = 8, 128, 256
BUS_OFF_RECOVERY = 128 * 11  # bits of silence until a controller that was bus-off may send again

Outcome = Literal["received", "lost", "error", "error passive", "bus off"]


class Transmission(NamedTuple):
    """A transmission that ended on the bus at time `end` [s], and its result.

    "received": all nodes but the sender have it. "lost": because of a fault no node has it. "error": an error frame
    ended it and the sender tries again; "error passive": the same, and the sender's controller has become error
    passive; "bus off": the controller has dropped its waiting frames and is silent for 128 times 11 bits.
    """

    frame: Frame
    sender: Hashable
    end: float
    extended: bool
    outcome: Outcome


@dataclass
class WireStatistics:
    """Counts since the wire began."""

    frames: int = 0
    bits: int = 0
    lost: int = 0
    errors: int = 0
    bus_offs: int = 0
    most_waiting: int = 0

    def load(self, bit_rate: float, duration: float) -> float:
        """Return the share of time [s] in which the bus was busy; above 1 only if frames take no time."""
        return self.bits / (bit_rate * duration) if duration > 0.0 else 0.0


@dataclass
class _Waiting:
    frame: Frame
    extended: bool
    ready: float  # s; not sent before
    overtakable: bool = False


class _Sender:
    """A CAN controller: its frames leave in the order in which they were given."""

    def __init__(self) -> None:
        self.queue: deque[_Waiting] = deque()
        self.error_counter = 0
        self.silent_until = -math.inf


class Wire:
    """One bus.

    Whenever it falls idle, the senders whose first frame is ready arbitrate: the lowest identifier wins, a data frame
    over a remote one, a standard frame over an extended one with the same first eleven bits; among equals the first to
    arrive (on a real bus they would collide; two nodes with one identifier are a mistake of the master).

    Args:
        bit_rate: [bit/s].
        instant: Whether frames take no time, as in lockstep; order, length and faults stay.
        faults: Its permanent faults.
        seed: Seed of the faults.

    Attributes:
        injected: Further faults that act at present.
    """

    def __init__(
        self, bit_rate: float = BIT_RATE, *, instant: bool = False, faults: Faults | None = None, seed: int = 0
    ) -> None:
        if not bit_rate > 0.0:
            raise ValueError(f"bit_rate must be above 0 bit/s, not {bit_rate:g}")
        self.bit_rate = bit_rate
        self.faults = faults or Faults()
        self.injected: list[Faults] = []
        self.statistics = WireStatistics()
        self._bit_time = 0.0 if instant else 1.0 / bit_rate
        self._random = random.Random(seed)
        self._senders: dict[Hashable, _Sender] = {}
        self._num_waiting = 0
        self._free_at = -math.inf
        self._on_wire: Transmission | None = None

    def send(self, frame: Frame, sender: Hashable, now: float, extended: bool = False) -> None:
        """Hand a frame to a sender's controller at `now` [s]; times must not decrease."""
        controller = self._senders.get(sender)
        if controller is None:
            controller = self._add(sender)
        waiting = _Waiting(frame, extended, max(now, controller.silent_until))
        self._enqueue(controller, waiting)
        for faults in self._disturbing(frame):
            self._disturb_sending(faults, controller, waiting, now)
        self.statistics.most_waiting = max(self.statistics.most_waiting, self._num_waiting)

    def silence(self, sender: Hashable, until: float) -> None:
        """Take a sender's controller off the bus until `until` [s], as many errors do; its waiting frames are lost."""
        controller = self._senders.get(sender)
        self._give_up(self._add(sender) if controller is None else controller, until)

    def waiting(self, sender: Hashable) -> int:
        """Return the number of a sender's frames that wait for the bus."""
        controller = self._senders.get(sender)
        return len(controller.queue) if controller else 0

    def forget(self, sender: Hashable) -> None:
        """Remove a sender's controller with its waiting frames; a transmission that has begun is completed."""
        controller = self._senders.pop(sender, None)
        if controller is not None:
            self._num_waiting -= len(controller.queue)
            self.statistics.lost += len(controller.queue)

    @property
    def recovery_time(self) -> float:
        """Time [s] from bus-off until the controller may send again."""
        return BUS_OFF_RECOVERY / self.bit_rate

    def next_event(self) -> float:
        """Return when a transmission next ends or can begin [s]; inf if no frame waits."""
        if self._on_wire is not None:
            return self._on_wire.end
        if not self._num_waiting:
            return math.inf
        return max(self._free_at, min(c.queue[0].ready for c in self._senders.values() if c.queue))

    def take(self, until: float) -> Transmission | None:
        """Return the next transmission that ends at `until` [s] or before, None if every one ends later.

        Arbitration is decided only when the bus is free, so call it with the present time, not a future one.
        """
        if self._on_wire is None:
            start = self.next_event()
            if start > until or start == math.inf:
                return None
            self._on_wire = self._begin(start)
        ended = self._on_wire
        if ended.end > until:
            return None
        self._on_wire = None
        return ended

    # --- inside ---------------------------------------------------------------------------------------------------
    def _add(self, sender: Hashable) -> _Sender:
        if len(self._senders) >= MOST_SENDERS:  # clients that have left are not reported
            self._senders = {name: c for name, c in self._senders.items() if c.queue}
        controller = self._senders[sender] = _Sender()
        return controller

    def _enqueue(self, controller: _Sender, waiting: _Waiting) -> None:
        queue = controller.queue
        self._num_waiting += 1
        if queue and queue[-1].overtakable:
            overtaken = queue.pop()
            overtaken.overtakable = False
            overtaken.ready = waiting.ready
            queue.extend((waiting, overtaken))
        else:
            queue.append(waiting)

    def _disturbing(self, frame: Frame) -> Sequence[Faults]:
        if not self.faults and not self.injected:
            return ()
        return [one for one in (self.faults, *self.injected) if one and (not one.only or frame.can_id in one.only)]

    def _disturb_sending(self, faults: Faults, controller: _Sender, waiting: _Waiting, now: float) -> None:
        draw = self._random.random
        if faults.delay and draw() < faults.delay:
            waiting.ready = max(waiting.ready, now + self._random.uniform(0.0, faults.delay_max))
        if faults.duplicate and draw() < faults.duplicate:
            self._enqueue(controller, _Waiting(waiting.frame, waiting.extended, waiting.ready))
        if faults.reorder and draw() < faults.reorder and controller.queue[-1] is waiting:
            waiting.overtakable = True
            waiting.ready = max(waiting.ready, now + REORDER_WINDOW)

    def _begin(self, start: float) -> Transmission:
        """Arbitrate at `start` [s] and return the winner's transmission with its result."""
        name, controller = min(
            ((name, c) for name, c in self._senders.items() if c.queue and c.queue[0].ready <= start),
            key=lambda pair: (_arbitration_field(pair[1].queue[0]), pair[1].queue[0].ready),
        )
        waiting = controller.queue[0]
        frame, extended = waiting.frame, waiting.extended
        outcome: Outcome = "received"
        for faults in self._disturbing(frame):
            if outcome == "received":
                frame, outcome = self._disturb_transmission(faults, frame)
        bits = (broken_frame_bits if outcome == "error" else frame_bits)(frame, extended)
        end = start + bits * self._bit_time
        if outcome == "error":
            outcome = self._count_error(controller, end)  # still first in its queue, unless bus-off has emptied it
        else:
            controller.queue.popleft()
            self._num_waiting -= 1
            controller.error_counter = max(0, controller.error_counter - 1)
        self._free_at = end
        counts = self.statistics
        counts.bits += bits
        counts.frames += outcome in ("received", "lost")
        counts.lost += outcome == "lost"
        return Transmission(frame, name, end, extended, outcome)

    def _disturb_transmission(self, faults: Faults, frame: Frame) -> tuple[Frame, Outcome]:
        draw = self._random.random
        if faults.corrupt and draw() < faults.corrupt:
            return frame, "error"
        if faults.drop and draw() < faults.drop:
            return frame, "lost"
        if faults.corrupt_undetected and draw() < faults.corrupt_undetected and frame.data:
            data = int.from_bytes(frame.data, "big")
            for bit in self._random.sample(range(8 * len(frame.data)), self._random.randint(1, 3)):
                data ^= 1 << bit
            return frame._replace(data=data.to_bytes(len(frame.data), "big")), "received"
        return frame, "received"

    def error_counter(self, sender: Hashable) -> int:
        """Return the error counter of a sender's controller."""
        ending = self._on_wire
        if ending is not None and ending.sender == sender and ending.outcome == "bus off":
            return BUS_OFF_LIMIT  # its last frame has not ended yet
        controller = self._senders.get(sender)
        return 0 if controller is None else controller.error_counter

    def _count_error(self, controller: _Sender, end: float) -> Outcome:
        self.statistics.errors += 1
        controller.error_counter += ERROR_STEP
        if controller.error_counter < BUS_OFF_LIMIT:
            return "error passive" if 0 <= controller.error_counter - PASSIVE_LIMIT < ERROR_STEP else "error"
        self._give_up(controller, end + self.recovery_time)
        return "bus off"

    def _give_up(self, controller: _Sender, until: float) -> None:
        self.statistics.bus_offs += 1
        self.statistics.lost += len(controller.queue)
        self._num_waiting -= len(controller.queue)
        controller.queue.clear()
        controller.error_counter = 0
        controller.silent_until = until


def _arbitration_field(waiting: _Waiting) -> tuple[int, bool, int, bool]:
    """Return the bits of arbitration: base identifier, extended or not, extension, remote or not; dominant is lower.

    A standard frame has its remote bit where an extended one has the recessive substitute bit: a standard frame of
    either kind wins, since its identifier extension bit is dominant.
    """
    can_id = waiting.frame.can_id
    if waiting.extended:
        return can_id >> 18, True, can_id & 0x3FFFF, waiting.frame.rtr
    return can_id, False, 0, waiting.frame.rtr
