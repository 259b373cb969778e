"""Distributed clocks as set by a master: delays and offsets in a line, SYNC0, time of frames (ETG.1000.4, 6.8).

The first slave is the reference: its system time goes through all others with every frame of process data, and each
corrects its clock by it. SYNC0 comes at whole multiples of its cycle in that time, and frames are sent in the middle
between two pulses: one that is early or late by less than half a cycle arrives in time.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence

from drive_env.ethercat import registers
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.ethercat.ethercat_master import EtherCatMaster, Sync0

NANOSECOND = 1e-9  # s
HAS_CLOCKS = 0x04  # of the features, 0008h
FEATURES = 0x0008
OFF, SYNC0_ON, SYNC1_ON = 0x00, 0x03, 0x04  # of the activation, 0981h
TOO_LATE = 0x04  # of the activation's status, 0984h: the start time had passed
AHEAD = 0.1  # s from reading the reference's time to the first pulse, as in SOEM
LATEST_START = 3.0  # s
WORD = 1 << 32
TURN = 1 << 64


def check_clocks(master: EtherCatMaster, positions: Sequence[int]) -> None:
    """Raise BusError unless all of these slaves have distributed clocks of 64 bits."""
    for position in positions:
        found = master.register(position, FEATURES, 2)
        if found is None or not found[0] & HAS_CLOCKS:
            raise BusError(f"position {position} has no distributed clocks; open it without sync0")


def delays_in_a_line(received: Sequence[tuple[int, int]]) -> list[int]:
    """Return the delay of a frame from the first slave to each [ns].

    Args:
        received: For each slave, the local times [ns] at which a frame arrived at port 0, and returned to port 1; equal
            for the last slave.
    """
    loops = [(back - forth) % WORD for forth, back in received]
    return [(loops[0] - loop) // 2 for loop in loops]


def set_offsets(master: EtherCatMaster, count: int) -> None:
    """Set delay and offset of each slave by the receive times that a frame has just left there.

    Raises:
        NoAnswerError: If a slave does not answer.
    """
    times, units = [], []
    for position in range(count):
        data = master.register(position, registers.RECEIVE_TIMES, 32)
        if data is None:
            raise NoAnswerError(f"position {position} does not answer; check cable and power")
        forth, back = struct.unpack_from("<II", data)
        times.append((forth, back if position < count - 1 else forth))
        units.append(int.from_bytes(data[24:32], "little"))  # 0918h
    for position, delay in enumerate(delays_in_a_line(times)):
        offset = (units[0] - units[position] + delay) % TURN
        master.write_register(position, registers.TIME_OFFSET, struct.pack("<Q", offset))
        master.write_register(position, registers.TIME_DELAY, struct.pack("<I", delay))


def start_sync0(master: EtherCatMaster, positions: Sequence[int], clock: Sync0) -> None:
    """Start SYNC0 of slaves at the same whole multiple of its cycle [s].

    Args:
        master: The segment's master.
        positions: Slaves in Pre-Op.
        clock: Its cycle; in lockstep no time passes meanwhile, and the first pulse is that of the next cycle.

    Raises:
        BusError: If a slave's clock does not start; NoAnswerError if the first slave does not answer.
    """
    length = round(clock.cycle / NANOSECOND)
    activation = SYNC0_ON | (SYNC1_ON if clock.sync1 else 0)
    ahead = 0.0 if clock.is_lockstep else AHEAD
    while True:
        for position in positions:
            master.write_register(position, registers.SYNC_ACTIVATION, bytes((OFF,)))
        now = master.register(0, registers.SYSTEM_TIME, 8)
        if now is None:
            raise NoAnswerError("position 0 does not answer; check cable and power")
        start = ((int.from_bytes(now, "little") + round(ahead / NANOSECOND)) // length + 1) * length
        for position in positions:
            master.write_register(position, registers.SYNC0_START, struct.pack("<Q", start % TURN))
            master.write_register(position, registers.SYNC0_CYCLE, struct.pack("<I", length))
            if clock.sync1:
                master.write_register(position, registers.SYNC1_DELAY, bytes(4))
            master.write_register(position, registers.SYNC_ACTIVATION, bytes((activation,)))
        late = [k for k in positions if (master.register(k, registers.SYNC_STATUS, 1) or b"\0")[0] & TOO_LATE]
        if not late:
            return
        ahead = 2.0 * ahead
        if not 0.0 < ahead < LATEST_START:
            raise BusError(f"SYNC0 of position {late[0]} does not start; this computer or the cable is too slow")


class FramePhase:
    """Times frames so that they arrive in the middle between two pulses of SYNC0.

    Args:
        cycle: Cycle of SYNC0 [s].
    """

    def __init__(self, cycle: float) -> None:
        self._cycle = round(cycle / NANOSECOND)
        self._seen: tuple[float, int] | None = None

    def take(self, system_time: int) -> None:
        """Note the reference's time [ns], which a frame has just brought."""
        self._seen = (time.perf_counter(), system_time)

    def wait(self, due: float) -> float:
        """Return the delay [s], below a cycle, of the next frame after `due` [s, of perf_counter]."""
        if self._seen is None:
            return 0.0
        at, system = self._seen
        phase = (system + round((due - at) / NANOSECOND)) % self._cycle
        return (self._cycle // 2 - phase) % self._cycle * NANOSECOND
