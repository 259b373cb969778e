"""A slave controller: datagrams read and write its registers and its memory (ETG.1000.4; ET1100 data sheet).

It only handles bytes and addresses. States, mailbox and process data are handled by the firmware (`slave.py`), which
checks after each frame what has changed.
"""

from __future__ import annotations

import struct

from drive_env.ethercat import fmmu, registers
from drive_env.ethercat.application import SyncManagerSetting
from drive_env.ethercat.datagrams import DATAGRAM, DatagramCommand, DatagramPlace
from drive_env.ethercat.distributed_clock import DistributedClock
from drive_env.ethercat.fmmu import Fmmu
from drive_env.ethercat.registers import REGISTERS_END
from drive_env.ethercat.sii_interface import SiiInterface
from drive_env.ethercat.sync_manager import SyncManager

C = DatagramCommand
AUTO_INCREMENT = frozenset((C.APRD, C.APWR, C.APRW, C.ARMW))
CONFIGURED = frozenset((C.FPRD, C.FPWR, C.FPRW, C.FRMW))
BROADCAST = frozenset((C.BRD, C.BWR, C.BRW))
LOGICAL = frozenset((C.LRD, C.LWR, C.LRW))
MULTIPLE = frozenset((C.ARMW, C.FRMW))  # the addressed slave is read, all others are written
READING = frozenset((C.APRD, C.APRW, C.FPRD, C.FPRW, C.BRD, C.BRW, C.LRD, C.LRW))
WRITING = frozenset((C.APWR, C.APRW, C.FPWR, C.FPRW, C.BWR, C.BRW, C.LWR, C.LRW))
MASKS = registers.write_masks()
ALIAS_ENABLE = 0x01  # of 0103h
RESET_SEQUENCE = b"RES"
SYNC_MANAGERS_END = registers.SYNC_MANAGERS + registers.NUM_SYNC_MANAGERS * registers.SYNC_MANAGER_SIZE
FMMUS_END = registers.FMMUS + registers.NUM_FMMUS * registers.FMMU_SIZE
REPEAT = 0x02  # bit of byte 6 of a sync manager's registers
PDI_CONTROL, DEACTIVATED = 7, 0x01  # alike, the device's side
UNUSED_PORTS = 0b01010000_00000000  # of 0110h: ports 2 and 3 are closed
DL_EVENT, AL_EVENT = 0x04, 0x08  # events in 0210h
WATCHDOG_IS_GOOD = 0x01


class SlaveController:
    """One controller; it is in reset until `power_on`.

    Args:
        takes_time: Whether the EEPROM takes time.
        drift: Share by which its oscillator is too fast.
        epoch: Local time [ns] of its clock at world time 0.

    Attributes:
        memory: Registers and RAM.
        managers: The sync managers.
        clock: Distributed clocks.
        sii: The EEPROM interface.
        al_control: The master's last write to 0120h since the firmware last looked; None without one.
        settings_changed: Whether a sync manager was switched on or off.
        reset_requested: Whether the master wrote the reset sequence.
        ends_line: Whether no slave follows.
    """

    def __init__(self, *, takes_time: bool = False, drift: float = 0.0, epoch: int = 0) -> None:
        self.memory = registers.reset_values()
        self.managers = [SyncManager() for _ in range(registers.NUM_SYNC_MANAGERS)]
        self.clock = DistributedClock(self.memory, drift, epoch)
        self.sii = SiiInterface(self.memory, takes_time)
        self.ends_line = True
        self.power_on(b"", 0.0)

    def power_on(self, sii: bytes, now: float) -> None:
        """Reset all registers, and read the configuration of the EEPROM's content `sii`."""
        self.memory[:] = registers.reset_values()
        for manager in self.managers:
            manager.is_locked = False
            manager.configure(SyncManagerSetting(0, 0, 0, False))
            manager.reset()
        self._units: list[Fmmu] = []
        self.al_control: int | None = None
        self.settings_changed = self.reset_requested = False
        self._reset_step = 0
        self._station = self._alias = 0
        self._triggered = now  # when process data last came [s]
        self.clock.reset(round(now * 1e9))
        self.sii.power_on(sii)
        self.connect(self.ends_line)

    def connect(self, ends_line: bool) -> None:
        """Show in 0110h whether a slave follows: port 0 has a link, port 1 only then; others are closed."""
        self.ends_line = ends_line
        status = UNUSED_PORTS | 0x0001 | 0x0010 | 0x0200 | (0x0400 if ends_line else 0x0820)
        self.put_register(registers.DL_STATUS, status, 2)
        self._raise_event(DL_EVENT)

    # --- the firmware's side of registers -----------------------------------------------------------------------------
    def register(self, address: int, size: int) -> int:
        """Return a register."""
        return int.from_bytes(self.memory[address : address + size], "little")

    def put_register(self, address: int, value: int, size: int) -> None:
        """Write a register, regardless of the master's write mask."""
        self.memory[address : address + size] = value.to_bytes(size, "little")

    def put_al_status(self, status: int, code: int) -> None:
        """Set AL status and AL status code, and raise their event."""
        self.put_register(registers.AL_STATUS, status, 2)
        self.put_register(registers.AL_STATUS_CODE, code, 2)
        self._raise_event(AL_EVENT)

    def count(self, address: int) -> None:
        """Add 1 to a counter of one byte, which stops at 255."""
        self.memory[address] = min(self.memory[address] + 1, 255)

    def acknowledge_repeat(self, number: int) -> None:
        """Acknowledge the repeat request of a sync manager."""
        base = registers.SYNC_MANAGERS + number * registers.SYNC_MANAGER_SIZE
        self.memory[base + PDI_CONTROL] = self.memory[base + PDI_CONTROL] & ~REPEAT | (
            REPEAT if self.managers[number].repeat_request else 0
        )

    def deactivate(self, number: int, is_locked: bool) -> None:
        """Deactivate or reactivate a sync manager from the device's side (0807h); both empty it."""
        manager = self.managers[number]
        if manager.is_locked != is_locked:
            manager.is_locked = is_locked
            manager.reset()
            at = registers.SYNC_MANAGERS + number * registers.SYNC_MANAGER_SIZE + PDI_CONTROL
            self.memory[at] = self.memory[at] & ~DEACTIVATED | (DEACTIVATED if is_locked else 0)

    # --- watchdog of process data -------------------------------------------------------------------------------------
    @property
    def watchdog_time(self) -> float:
        """Time of the process-data watchdog [s], 0: off. The divider counts 40 ns, the time the divider's ticks."""
        divider = self.register(registers.WATCHDOG_DIVIDER, 2) + 2
        return self.register(registers.SM_WATCHDOG, 2) * divider * 40e-9

    def trigger_watchdog(self, now: float) -> None:
        """Restart the watchdog."""
        self._triggered = now
        self.memory[registers.WATCHDOG_STATUS] |= WATCHDOG_IS_GOOD

    def watchdog_deadline(self) -> float | None:
        """Return when it expires [s]; None if it is off, or no sync manager is monitored."""
        time = self.watchdog_time
        watched = any(
            m.end and not m.is_locked and m.setting.has_watchdog and m.setting.is_written_by_master
            for m in self.managers
        )
        return self._triggered + time if time > 0.0 and watched else None

    def expire_watchdog(self) -> None:
        """Show that it has expired, and increment its counter."""
        self.memory[registers.WATCHDOG_STATUS] &= ~WATCHDOG_IS_GOOD
        self.count(registers.WATCHDOG_COUNTER)

    # --- datagrams ----------------------------------------------------------------------------------------------------
    def process(self, frame: bytearray, places: list[DatagramPlace], now: int) -> None:
        """Process the datagrams of a frame at world time `now` [ns]."""
        memory = self.memory
        for command, at, length in places:
            if command in LOGICAL:
                self._process_logical(frame, command, at, length, now)
            elif command in AUTO_INCREMENT or command in BROADCAST or command in CONFIGURED:
                self._process_physical(frame, command, at, length, now)
            frame[at + 8] |= memory[registers.ECAT_EVENT] & memory[registers.ECAT_EVENT_MASK]

    def _process_physical(self, frame: bytearray, command: int, at: int, length: int, now: int) -> None:
        station = frame[at + 2] | frame[at + 3] << 8
        if command in CONFIGURED:
            is_meant = station == self._station or (bool(self._alias) and station == self._alias)
        else:
            is_meant = command in BROADCAST or station == 0
            next_station = (station + 1) & 0xFFFF
            frame[at + 2], frame[at + 3] = next_station & 0xFF, next_station >> 8
        if command in MULTIPLE:
            reads, writes = is_meant, not is_meant
        else:
            reads, writes = is_meant and command in READING, is_meant and command in WRITING
        if not reads and not writes:
            return
        address = frame[at + 4] | frame[at + 5] << 8
        first = at + DATAGRAM
        sent = frame[first : first + length]
        done = 0
        if reads:
            data = self.read(address, length, now)
            if data is not None:
                done = 1
                if command in BROADCAST:
                    data = bytes(map(int.__or__, data, sent))
                frame[first : first + length] = data
        if writes and self.write(address, sent, now):
            done += 2 if command in READING else 1
        _add(frame, first + length, done)

    def _process_logical(self, frame: bytearray, command: int, at: int, length: int, now: int) -> None:
        (start,) = struct.unpack_from("<I", frame, at + 2)
        end, first = start + length, at + DATAGRAM
        has_read = has_written = False
        sent = frame[first : first + length] if command in WRITING else b""
        for unit in self._units:
            if unit.first >= end or unit.end <= start:
                continue
            if unit.reads and command in READING:
                has_read |= self._read_unit(unit, frame, first, start, end, now)
            if unit.writes and command in WRITING:
                has_written |= self._write_unit(unit, sent, start, end, now)
        _add(frame, first + length, has_read + has_written * (2 if command in READING else 1))

    def _read_unit(self, unit: Fmmu, frame: bytearray, place: int, start: int, end: int, now: int) -> bool:
        """Read the data that an FMMU maps to the logical addresses from `start` to `end`, at `place` of the frame."""
        low, high = max(unit.first, start), min(unit.end, end)
        if unit.offset is not None:
            data = self.read(low + unit.offset, high - low, now)
            if data is None:
                return False
            frame[place + low - start : place + high - start] = data
            return True
        first_bit, count, physical, size = _bits(unit, low, high)
        if count <= 0:
            return False
        data = self.read(physical // 8, size, now)
        if data is None:
            return False
        target = frame[place + low - start : place + high - start]
        fmmu.copy_bits(data, physical % 8, target, first_bit - 8 * low, count)
        frame[place + low - start : place + high - start] = target
        return True

    def _write_unit(self, unit: Fmmu, sent: bytes | bytearray, start: int, end: int, now: int) -> bool:
        """Write the data `sent` that an FMMU maps to the logical addresses from `start` to `end`."""
        low, high = max(unit.first, start), min(unit.end, end)
        source = sent[low - start : high - start]
        if unit.offset is not None:
            return self.write(low + unit.offset, source, now)
        first_bit, count, physical, size = _bits(unit, low, high)
        if count <= 0:
            return False
        target = bytearray(self._peek(physical // 8, size))
        fmmu.copy_bits(source, first_bit - 8 * low, target, physical % 8, count)
        return self.write(physical // 8, target, now)

    # --- memory -------------------------------------------------------------------------------------------------------
    def read(self, address: int, length: int, now: int) -> bytes | None:
        """Return the bytes that a master reads at world time `now` [ns]; None if the range cannot be read."""
        end = address + length
        if length == 0 or end > registers.RAM_END:
            return None
        if address < REGISTERS_END:
            if end > REGISTERS_END:
                return None
            self._refresh(address, end, now)
            data = bytes(self.memory[address:end])
            self._acknowledge(address, end)
            return data
        parts = [m for m in self.managers if m.end > address and m.setting.start < end]
        if not parts:
            return bytes(self.memory[address:end])
        found, done = bytearray(self.memory[address:end]), False
        for manager in parts:
            start = manager.setting.start
            low, high = max(start, address), min(manager.end, end)
            part = manager.master_read(low - start, high - low)
            if part is not None:
                found[low - address : high - address] = part
                done = True
        return bytes(found) if done else None

    def write(self, address: int, data: bytes | bytearray, now: int) -> bool:
        """Write a master's bytes at world time `now` [ns]; returns whether any of them could be written."""
        end = address + len(data)
        if not data or end > registers.RAM_END:
            return False
        if address < REGISTERS_END:
            return end <= REGISTERS_END and self._write_registers(address, data, now)
        parts = [m for m in self.managers if m.end > address and m.setting.start < end]
        if not parts:
            self.memory[address:end] = data
            return True
        done = False
        for manager in parts:
            start = manager.setting.start
            low, high = max(start, address), min(manager.end, end)
            if manager.master_write(low - start, data[low - address : high - address]):
                done = True
                self.memory[low:high] = data[low - address : high - address]
                if high == manager.end and manager.setting.has_watchdog:
                    self.trigger_watchdog(now * 1e-9)
        return done

    def _peek(self, address: int, length: int) -> bytes:
        """Return the bytes that the master last wrote, so that some of their bits can be changed."""
        return bytes(self.memory[address : address + length]).ljust(length, b"\0")

    def _refresh(self, address: int, end: int, now: int) -> None:
        """Update registers from the time and the sync managers."""
        if address < registers.TIME_OFFSET and end > registers.SYSTEM_TIME:
            self.clock.refresh(now)
        elif address < SYNC_MANAGERS_END and end > registers.SYNC_MANAGERS:
            for k, manager in enumerate(self.managers):
                self.memory[registers.SYNC_MANAGERS + k * registers.SYNC_MANAGER_SIZE + 5] = manager.status
        elif address < registers.SII_ADDRESS and end > registers.SII_CONTROL:
            self.sii.refresh(now * 1e-9)

    def _acknowledge(self, address: int, end: int) -> None:
        """Clear the events whose register a master has read."""
        if address < registers.DL_STATUS + 2 and end > registers.DL_STATUS:
            self.memory[registers.ECAT_EVENT] &= ~DL_EVENT
        if address < registers.AL_STATUS + 2 and end > registers.AL_STATUS:
            self.memory[registers.ECAT_EVENT] &= ~AL_EVENT

    def _raise_event(self, event: int) -> None:
        self.memory[registers.ECAT_EVENT] |= event

    # --- what writing registers sets off ------------------------------------------------------------------------------
    def _write_registers(self, address: int, data: bytes | bytearray, now: int) -> bool:
        end = address + len(data)
        done = False
        for first, last in registers.COUNTERS:
            if address < last and end > first:
                self.memory[first:last] = bytes(last - first)
                done = True
        locked = self._locked(address, end)
        for k, byte in enumerate(data, address):
            mask = MASKS[k]
            if mask and k not in locked:
                done = True
                self.memory[k] = self.memory[k] & ~mask | byte & mask
        if done:
            self._react(address, end, data, now)
        return done

    def _locked(self, address: int, end: int) -> set[int]:
        """Return the registers of active sync managers: address, length and control can only be changed while off."""
        if address >= SYNC_MANAGERS_END or end <= registers.SYNC_MANAGERS:
            return set()
        size = registers.SYNC_MANAGER_SIZE
        locked: set[int] = set()
        for k, manager in enumerate(self.managers):
            if manager.setting.is_enabled:
                base = registers.SYNC_MANAGERS + k * size
                locked.update(range(base, base + 5))
        return locked

    def _react(self, address: int, end: int, data: bytes | bytearray, now: int) -> None:
        def has(first: int, size: int) -> bool:
            return address < first + size and end > first

        if has(registers.STATION_ADDRESS, 2) or has(registers.DL_CONTROL, 4):
            self._station = self.register(registers.STATION_ADDRESS, 2)
            is_on = self.memory[registers.DL_CONTROL + 3] & ALIAS_ENABLE
            self._alias = self.register(registers.ALIAS, 2) if is_on else 0
        if has(registers.AL_CONTROL, 1):
            self.al_control = self.register(registers.AL_CONTROL, 2)
        if has(registers.RESET, 1):
            self._step_reset(self.memory[registers.RESET])
        if has(registers.FMMUS, FMMUS_END - registers.FMMUS):
            size = registers.FMMU_SIZE
            parsed = [fmmu.parse(self.memory[k : k + size]) for k in range(registers.FMMUS, FMMUS_END, size)]
            self._units = [unit for unit in parsed if unit is not None]
        if has(registers.SYNC_MANAGERS, SYNC_MANAGERS_END - registers.SYNC_MANAGERS):
            self._configure_managers()
        if has(registers.SII_CONTROL + 1, 1):
            self.sii.command(now * 1e-9)
        if has(registers.RECEIVE_TIMES, 4):
            self.clock.latch(0, now)
        if has(registers.SYSTEM_TIME, 4) and len(data) >= 4 and address == registers.SYSTEM_TIME:
            self.clock.compare(int.from_bytes(data[:4], "little"), now)
        if has(registers.SPEED_START, 2):
            self.clock.restart_comparison(now)
        if has(registers.SYNC_ACTIVATION, 1):
            self.clock.activate(now)

    def _configure_managers(self) -> None:
        for k, manager in enumerate(self.managers):
            base = registers.SYNC_MANAGERS + k * registers.SYNC_MANAGER_SIZE
            start, length, control, _, activate, _ = struct.unpack_from("<HHBBBB", self.memory, base)
            manager.repeat_request = bool(activate & REPEAT)
            if manager.configure(SyncManagerSetting(start, length, control, bool(activate & 1 and length))):
                self.settings_changed = True

    def _step_reset(self, byte: int) -> None:
        """Advance in the reset sequence, whose letters are written one by one."""
        self._reset_step = self._reset_step + 1 if byte == RESET_SEQUENCE[self._reset_step] else 0
        self.memory[registers.RESET] = self._reset_step
        if self._reset_step == len(RESET_SEQUENCE):
            self._reset_step = 0
            self.reset_requested = True


def _bits(unit: Fmmu, low: int, high: int) -> tuple[int, int, int, int]:
    """Return, for logical bytes `low` to `high`: first mapped bit, number of bits, first bit in memory, bytes there."""
    first = max(unit.logical_bit, 8 * low)
    count = min(unit.logical_bit + unit.num_bits, 8 * high) - first
    physical = unit.physical_bit + first - unit.logical_bit
    return first, count, physical, (physical + count + 7) // 8 - physical // 8


def _add(frame: bytearray, at: int, amount: int) -> None:
    """Add to the working counter at a place of a frame."""
    if amount:
        value = (frame[at] | frame[at + 1] << 8) + amount
        frame[at], frame[at + 1] = value & 0xFF, value >> 8 & 0xFF
