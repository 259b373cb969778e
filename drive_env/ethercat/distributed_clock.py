"""The clock of a slave controller: local time, system time, its correction, SYNC0 and SYNC1 (ETG.1000.4, 6.8).

Every slave has an oscillator of its own. A master measures the travel times of frames by port receive times, writes
each slave's offset and delay, and then sends the first slave's system time through all others (ARMW, FRMW): each
compares it and corrects its rate. World time, in nanoseconds here, is the true time; every slave's clock deviates from
it.
"""

from __future__ import annotations

import struct

from drive_env.ethercat import registers

SLOWEST_CORRECTION = 0.1  # of a clock tick: the ET1100 makes ticks of 9, 10 or 11 ns of 10
PHASE_SHARE, RATE_SHARE = 0.25, 0.03  # of a difference, corrected at each comparison; our choice
ACTIVE, SYNC0, SYNC1 = 0x01, 0x02, 0x04
NOT_IN_NEAR_FUTURE = 0x04  # of the activation status: the start time has passed
WORD = 1 << 32
TIMES = 1 << 64  # of system time [ns], which then wraps
MOST_PULSES = 64  # due at once; if it is further behind, the clock has leapt, and the pulses are skipped


class DistributedClock:
    """A slave's clock, and its registers from 0900h on.

    Args:
        memory: The controller's memory.
        drift: Share by which its oscillator is too fast: 50e-6 is 50 ppm.
        epoch: Its local time [ns] at world time 0; clocks count from power-on.
    """

    def __init__(self, memory: bytearray, drift: float = 0.0, epoch: int = 0) -> None:
        self._memory = memory
        self._drift = drift
        self._epoch = epoch
        self.reset(0)

    def reset(self, now: int) -> None:
        """Forget all corrections and pulses, as a reset does."""
        self._anchor = now
        self._anchor_local = self._epoch + now * (1.0 + self._drift)
        self._correction = 0.0
        self._compared: int | None = None
        self._mean = 0.0
        self._next_pulse: int | None = None  # of SYNC0, system time [ns]
        self._next_sync1: int | None = None  # of SYNC1, after the SYNC0 that it follows
        self.is_measuring = False  # receive times are also latched on the frame's return

    # --- times ------------------------------------------------------------------------------------------------------
    def local(self, now: int) -> int:
        """Return local time [ns] at world time `now` [ns]."""
        return int(self._anchor_local + (now - self._anchor) * (1.0 + self._drift + self._correction))

    def system(self, now: int) -> int:
        """Return system time [ns]: local time plus the master's offset."""
        (offset,) = struct.unpack_from("<Q", self._memory, registers.TIME_OFFSET)
        return (self.local(now) + int(offset)) % (1 << 64)

    def refresh(self, now: int) -> None:
        """Update the registers to the time `now` [ns]."""
        struct.pack_into("<Q", self._memory, registers.SYSTEM_TIME, self.system(now))

    def latch(self, port: int, now: int) -> None:
        """Latch the local time [ns] at which a frame came to port 0 or 1."""
        local = self.local(now)
        struct.pack_into("<I", self._memory, registers.RECEIVE_TIMES + 4 * port, local % WORD)
        if port == 0:
            struct.pack_into("<Q", self._memory, registers.RECEIVE_TIME_UNIT, local % (1 << 64))
        self.is_measuring = port == 0

    def compare(self, received: int, now: int) -> None:
        """Correct the clock by the low 32 bits of a reference's system time [ns], received at `now` [ns]."""
        memory = self._memory
        (delay,) = struct.unpack_from("<I", memory, registers.TIME_DELAY)
        behind = (received + delay - self.system(now)) % WORD
        difference = -(behind - WORD if behind >= WORD // 2 else behind)  # above 0: this clock is ahead
        local, elapsed = self.local(now), 0 if self._compared is None else now - self._compared
        self._compared = now
        most = SLOWEST_CORRECTION * elapsed
        step = min(max(-PHASE_SHARE * difference, -most), most)
        if elapsed > 0:
            rate = self._correction - RATE_SHARE * difference / elapsed
            self._correction = min(max(rate, -SLOWEST_CORRECTION), SLOWEST_CORRECTION)
        self._anchor, self._anchor_local = now, local + step
        depth = memory[registers.FILTER_DEPTHS]
        self._mean += (difference - self._mean) / (1 << depth)
        told = min(round(abs(self._mean)), WORD // 2 - 1)
        struct.pack_into("<I", memory, registers.TIME_DIFFERENCE, told | (1 << 31 if self._mean < 0.0 else 0))
        speed = min(max(round(self._correction * 0x1000), -0x8000), 0x7FFF)
        struct.pack_into("<h", memory, registers.SPEED_DIFFERENCE, speed)

    def restart_comparison(self, now: int) -> None:
        """Discard the results of comparisons, as a write of the speed counter's start does."""
        self._anchor, self._anchor_local = now, float(self.local(now))
        self._correction = self._mean = 0.0
        self._compared = None
        struct.pack_into("<I", self._memory, registers.TIME_DIFFERENCE, 0)
        struct.pack_into("<h", self._memory, registers.SPEED_DIFFERENCE, 0)

    # --- SYNC0 and SYNC1 ----------------------------------------------------------------------------------------------
    @property
    def has_sync0(self) -> bool:
        """Whether SYNC0 is switched on."""
        return self._memory[registers.SYNC_ACTIVATION] & (ACTIVE | SYNC0) == ACTIVE | SYNC0

    @property
    def has_sync1(self) -> bool:
        """Whether SYNC1 follows SYNC0."""
        return self.has_sync0 and bool(self._memory[registers.SYNC_ACTIVATION] & SYNC1)

    @property
    def cycle(self) -> int:
        """Cycle of SYNC0 [ns]; 0: one shot."""
        (cycle,) = struct.unpack_from("<I", self._memory, registers.SYNC0_CYCLE)
        return int(cycle)

    @property
    def sync1_cycle(self) -> int:
        """Time between two pulses of SYNC1 [ns], 0: one shot; a pulse after the next SYNC0 skips that SYNC0."""
        return (self._delay // self.cycle + 1) * self.cycle if self.cycle else 0

    @property
    def _delay(self) -> int:
        """Time from SYNC0 to the SYNC1 that follows it [ns]."""
        (delay,) = struct.unpack_from("<I", self._memory, registers.SYNC1_DELAY)
        return int(delay)

    def activate(self, now: int) -> None:
        """Act on 0981h: SYNC0 from its start time on. A start that has passed makes no pulse."""
        self._memory[registers.SYNC_STATUS] = 0
        self._next_pulse = self._next_sync1 = None
        if self.has_sync0:
            (start,) = struct.unpack_from("<Q", self._memory, registers.SYNC0_START)
            if start > self.system(now):
                self._next_pulse = start
                self._memory[registers.SYNC_STATUS] = 1
            else:
                self._memory[registers.SYNC_STATUS] = NOT_IN_NEAR_FUTURE

    def next_pulse(self) -> int | None:
        """Return the world time [ns] of the next pulse of SYNC0 or SYNC1; None without pulses."""
        pulse = self._next_sync1 if self._sync1_is_first() else self._next_pulse
        return None if pulse is None else self._world_time(pulse)

    def take_pulse(self, now: int) -> tuple[int, int] | None:
        """Return the pulse due at `now` [ns], SYNC0 or SYNC1, and its world time [ns], or None; schedule the next."""
        if self._sync1_is_first():
            following = self._next_sync1
            if following is None or (self.system(now) - following) % TIMES >= TIMES // 2:
                return None
            self._next_sync1 = None
            return SYNC1, self._world_time(following)
        pulse, cycle = self._next_pulse, self.cycle
        if pulse is None:
            return None
        behind = (self.system(now) - pulse) % TIMES
        if behind >= TIMES // 2:
            return None
        if cycle and behind > MOST_PULSES * cycle:
            pulse = (pulse + behind // cycle * cycle) % TIMES
        if self.has_sync1 and self._next_sync1 is None:
            self._next_sync1 = (pulse + self._delay) % TIMES
            struct.pack_into("<Q", self._memory, registers.SYNC1_NEXT, self._next_sync1)
        self._next_pulse = (pulse + cycle) % TIMES if cycle else None
        struct.pack_into(
            "<Q", self._memory, registers.SYNC0_START, pulse if self._next_pulse is None else self._next_pulse
        )
        return SYNC0, self._world_time(pulse)

    def _sync1_is_first(self) -> bool:
        """Return whether SYNC1 pulses next; at equal times SYNC0 is first."""
        if self._next_sync1 is None or self._next_pulse is None:
            return self._next_sync1 is not None
        return 0 < (self._next_pulse - self._next_sync1) % TIMES < TIMES // 2

    def _world_time(self, system: int) -> int:
        (offset,) = struct.unpack_from("<Q", self._memory, registers.TIME_OFFSET)
        local = (system - int(offset)) % TIMES
        # The anchor is recent: a pulse that has just passed lies before it.
        ahead = local - self._anchor_local
        return self._anchor + int(ahead / (1.0 + self._drift + self._correction)) + 1
