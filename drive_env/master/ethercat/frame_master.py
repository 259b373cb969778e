"""Our own master, over anything that carries frames as bytes: states, mailbox and images by datagrams (ETG.1000.4).

It is small: slaves in a line, one image per direction. SOEM (`soem_master.py`) can do more, but needs a network
interface.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from drive_env.ethercat import datagrams, registers
from drive_env.ethercat.application import AlState
from drive_env.ethercat.datagrams import Datagram, DatagramCommand, at_station
from drive_env.ethercat.state_machine import ACKNOWLEDGE
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.link import ReceivedEmergency
from drive_env.master.ethercat.clocks import check_clocks, set_offsets, start_sync0
from drive_env.master.ethercat.ethercat_master import ERROR, READS, STATE, ImageSizes, SlaveIdentity, SlaveStatus, Sync0
from drive_env.master.ethercat.frame_ways import FrameWay
from drive_env.master.ethercat.mailbox_client import MailboxClient
from drive_env.master.ethercat.state_names import refusal, take_to_op

C = DatagramCommand
FIRST_STATION, LOGICAL = 0x1001, 0x10000
FRAME = 0.02  # s for a frame to come back
PATIENCE = 5.0  # s for a state, and for the EEPROM
TRIES = 50  # of a frame that is lost
LOOK = 0.001  # s between two looks at a state
SII_BUSY = 0x8000
IDENTITY_WORD, MAILBOX_WORD, FIRST_CATEGORY, SYNC_MANAGER_CATEGORY, END = 0x08, 0x18, 0x40, 41, 0xFFFF
LAST_WORD = 16_384  # of an EEPROM, at which reading a list without an end stops
LONGEST_IMAGE = 1400  # bytes of all slaves' images in one frame


class SlavePlaces(NamedTuple):
    """A slave's EEPROM: identity, (address, length) of its mailboxes, (address, control) of its images."""

    identity: SlaveIdentity
    receive: tuple[int, int]
    send: tuple[int, int]
    outputs: tuple[int, int]
    inputs: tuple[int, int]


class FrameMaster:
    """A master over a carrier of frames.

    Args:
        way: The carrier.
        frame_timeout: Longest wait for a frame's return [s].

    Attributes:
        alive: Called again and again while an answer is waited for.
        clock: Settings of the distributed clocks for `map`.
        system_time: The reference's time from the last exchange [ns].
    """

    def __init__(self, way: FrameWay, frame_timeout: float = FRAME) -> None:
        self.alive: Callable[[], None] = lambda: None
        self.clock: Sync0 | None = None
        self.system_time: int | None = None
        self._way = way
        self._timeout = frame_timeout
        self._number = 0
        self._turn = threading.RLock()  # a frame and its answer
        self._places: list[SlavePlaces] = []
        self._mailboxes: list[MailboxClient] = []
        self._repeats: dict[int, bool] = {}  # position -> repeat-request bit of its mailbox, toggled each time
        self._mapped: dict[int, tuple[int, ImageSizes]] = {}  # position -> logical address, sizes

    # --- frames -----------------------------------------------------------------------------------------------------
    def _transfer(self, asked: Sequence[Datagram], timeout: float) -> list[Datagram] | None:
        """Return the datagrams of a frame as it returns; None if it is lost."""
        with self._turn:
            self._number = (self._number + 1) & 0xFF
            sent = [one._replace(number=self._number) for one in asked]
            self._way.send(datagrams.build(sent))
            deadline = time.monotonic() + timeout
            while True:
                left = deadline - time.monotonic()
                payload = self._way.receive(max(left, 0.0))
                if payload is None:
                    return None
                found = datagrams.read(payload, 0)
                shape = [(one.command, one.number, len(one.data)) for one in found]
                if shape == [(one.command, one.number, len(one.data)) for one in sent]:
                    return found

    def _one(self, command: int, station: int, address: int, data: bytes) -> Datagram | None:
        found = self._transfer([at_station(command, station, address, data)], self._timeout)
        return None if found is None else found[0]

    def _surely(self, command: int, station: int, address: int, data: bytes, what: str) -> bytes:
        """Repeat an idempotent datagram until a slave has handled it.

        Raises:
            NoAnswerError: If no slave handles it.
        """
        for _ in range(TRIES):
            found = self._one(command, station, address, data)
            if found is not None and found.counter:
                return found.data
            self.alive()
        raise NoAnswerError(f"{what}: no slave answers on {self._way.name}; check cable, power and channel")

    def _write(self, position: int, address: int, data: bytes) -> None:
        self._surely(C.FPWR, FIRST_STATION + position, address, data, f"position {position}")

    def _read(self, position: int, address: int, size: int) -> bytes:
        return self._surely(C.FPRD, FIRST_STATION + position, address, bytes(size), f"position {position}")

    def register(self, position: int, address: int, size: int) -> bytes | None:
        """Return a slave's register; None if it does not answer."""
        for _ in range(READS):
            found = self._one(C.FPRD, FIRST_STATION + position, address, bytes(size))
            if found is not None:
                return found.data if found.counter else None
        return None

    def write_register(self, position: int, address: int, data: bytes) -> None:
        """Write a slave's register; NoAnswerError if it does not accept it."""
        self._write(position, address, data)

    # --- slaves -----------------------------------------------------------------------------------------------------
    def look(self) -> list[tuple[SlaveStatus, SlaveIdentity]]:
        """Return state and identity of every slave, addressed by position and left unchanged.

        Raises:
            NoAnswerError: If no slave answers.
        """
        found = []
        for position in range(self._count()):
            what = f"position {position}"
            status = self._surely(C.APRD, -position, registers.AL_STATUS, bytes(6), what)
            # A previous master may have left the EEPROM to the device, where we cannot read it.
            owner = self._surely(C.APRD, -position, registers.SII_ACCESS, bytes(1), what)
            self._surely(C.APWR, -position, registers.SII_ACCESS, bytes(1), what)
            try:
                found.append((_status(status), self._identity(C.APRD, C.APWR, -position)))
            finally:
                self._surely(C.APWR, -position, registers.SII_ACCESS, owner, what)
        return found

    def begin(self) -> int:
        """Find the slaves, give them addresses, and take them to Pre-Op, from any state. Returns their number."""
        count = self._count()
        self._mapped.clear()
        self._places, self._mailboxes = [], []
        for position in range(count):
            self._address(position)
            self._to(position, AlState.INIT)
            places = self._read_places(position)
            self._places.append(places)
            self._mailboxes.append(self._mailbox(position, places))
            self._open_mailbox(position)
        return count

    def recover(self, position: int) -> bool:
        """Take a slave to Pre-Op; return whether it had restarted, and so lost its address."""
        status = self.status(position)
        has_restarted = not status.state
        if has_restarted:
            self._address(position)
        if has_restarted or status.state not in (AlState.PRE_OP, AlState.SAFE_OP, AlState.OP):
            self._to(position, AlState.INIT)
            self._open_mailbox(position)
        else:
            self._to(position, AlState.PRE_OP)
        return has_restarted

    def identity(self, position: int) -> SlaveIdentity:
        """Return the identity in a slave's EEPROM."""
        return self._places[position].identity

    def status(self, position: int) -> SlaveStatus:
        """Read a slave's present state."""
        data = self.register(position, registers.AL_STATUS, 6)
        return SlaveStatus(0, False, 0) if data is None else _status(data)

    def _count(self) -> int:
        """Return the number of slaves; NoAnswerError if no slave answers."""
        for _ in range(TRIES):
            found = self._one(C.BRD, 0, registers.AL_STATUS, bytes(2))
            if found is not None and found.counter:
                return found.counter
        raise NoAnswerError(f"no slave answers on {self._way.name}; check cable, power and channel")

    def _address(self, position: int) -> None:
        station = struct.pack("<H", FIRST_STATION + position)
        self._surely(C.APWR, -position, registers.STATION_ADDRESS, station, f"position {position}")

    def _open_mailbox(self, position: int) -> None:
        """Take a slave from Init to Pre-Op with its sync managers and FMMUs set anew."""
        places = self._places[position]
        off = bytes(registers.SYNC_MANAGER_SIZE)
        for k in range(4):
            self._write(position, registers.SYNC_MANAGERS + k * registers.SYNC_MANAGER_SIZE, off)
        for k, (place, control) in enumerate(((places.receive, 0x26), (places.send, 0x22))):
            setting = struct.pack("<HHBBBB", *place, control, 0, 1, 0)
            self._write(position, registers.SYNC_MANAGERS + k * registers.SYNC_MANAGER_SIZE, setting)
        self._repeats[position] = False
        self._to(position, AlState.PRE_OP)

    def _to(self, position: int, state: AlState) -> None:
        """Acknowledge a slave's last error and take it to a state.

        Raises:
            BusError: If it refuses, with its AL status code; NoAnswerError if it does not answer.
        """
        self._write(position, registers.AL_CONTROL, struct.pack("<H", state | ACKNOWLEDGE))
        deadline = time.monotonic() + PATIENCE
        while True:
            status = _status(self._read(position, registers.AL_STATUS, 6))
            if status.state == state and not status.has_error:
                return
            if status.has_error or time.monotonic() > deadline:
                raise BusError(refusal(position, state, status))
            self.alive()
            time.sleep(LOOK)

    # --- EEPROM -----------------------------------------------------------------------------------------------------
    def _words(self, read: int, write: int, station: int, address: int) -> bytes:
        """Return four bytes of the EEPROM, from a word address on."""
        what = f"the EEPROM of the slave at {station & 0xFFFF:04X}h"
        self._surely(write, station, registers.SII_CONTROL, struct.pack("<HI", 0x0100, address), what)
        deadline = time.monotonic() + PATIENCE
        while True:
            found = self._surely(read, station, registers.SII_CONTROL, bytes(10), what)
            control, taken = struct.unpack_from("<HI", found)
            if not control & SII_BUSY and taken == address:
                return found[6:10]
            if time.monotonic() > deadline:
                raise NoAnswerError(f"{what} stays busy; check its power")
            time.sleep(LOOK)

    def _identity(self, read: int, write: int, station: int) -> SlaveIdentity:
        words = [self._words(read, write, station, IDENTITY_WORD + 2 * k) for k in range(4)]
        return SlaveIdentity(*(int.from_bytes(one, "little") for one in words))

    def _read_places(self, position: int) -> SlavePlaces:
        station = FIRST_STATION + position

        def words(address: int) -> tuple[int, int]:
            first, second = struct.unpack("<HH", self._words(C.FPRD, C.FPWR, station, address))
            return first, second

        self._write(position, registers.SII_ACCESS, bytes(1))
        address, managers = FIRST_CATEGORY, []
        while True:
            kind, length = words(address)
            if kind == END or address > LAST_WORD:
                break
            if kind == SYNC_MANAGER_CATEGORY:
                managers = [(words(address + 2 + 4 * k)[0], words(address + 4 + 4 * k)[0]) for k in range(length // 4)]
                break
            address += 2 + length
        if len(managers) < 4:
            raise BusError(f"position {position}: its EEPROM names {len(managers)} sync managers; a drive has 4")
        outputs, inputs = ((start, control & 0xFF) for start, control in managers[2:4])
        identity = self._identity(C.FPRD, C.FPWR, station)
        return SlavePlaces(identity, words(MAILBOX_WORD), words(MAILBOX_WORD + 2), outputs, inputs)

    # --- images -----------------------------------------------------------------------------------------------------
    def map(self, sizes: Mapping[int, ImageSizes]) -> None:
        """Assign addresses to images, and take the slaves from Pre-Op to Safe-Op; BusError if images do not fit."""
        self._mapped.clear()
        total = sum(size.outputs + size.inputs for size in sizes.values())
        if total > LONGEST_IMAGE:
            raise BusError(
                f"the images of {len(sizes)} slaves have {total} bytes, and a frame {LONGEST_IMAGE}; open fewer"
            )
        address = LOGICAL
        if self.clock is not None:
            self._synchronise([k for k in sizes if self.status(k).state == AlState.PRE_OP], self.clock)
        for position, size in sizes.items():
            self._mapped[position] = (address, size)
            if self.status(position).state == AlState.PRE_OP:  # slaves in other states are mapped already
                self._place(position, address, size)
            address += size.outputs + size.inputs

    def _synchronise(self, positions: Sequence[int], clock: Sync0) -> None:
        """Set the clocks of all slaves, and start SYNC0 of those at `positions`."""
        check_clocks(self, range(len(self._places)))
        self._surely(C.BWR, 0, registers.RECEIVE_TIMES, bytes(4), "the clocks")
        set_offsets(self, len(self._places))
        start_sync0(self, positions, clock)

    def _place(self, position: int, address: int, size: ImageSizes) -> None:
        """Assign physical and logical addresses to the images of one slave; take it to Safe-Op."""
        places = self._places[position]
        rows = (
            (2, places.outputs, size.outputs, address, 2),
            (3, places.inputs, size.inputs, address + size.outputs, 1),
        )
        for number, (start, control), length, logical, kind in rows:
            base = registers.SYNC_MANAGERS + number * registers.SYNC_MANAGER_SIZE
            self._write(position, base, bytes(registers.SYNC_MANAGER_SIZE))
            self._write(position, base, struct.pack("<HHBBBB", start, length, control, 0, bool(length), 0))
            unit = struct.pack("<IHBBHBBBBBB", logical, length, 0, 7, start, 0, kind, bool(length), 0, 0, 0)
            self._write(position, registers.FMMUS + (number - 2) * registers.FMMU_SIZE, unit)
        self._to(position, AlState.SAFE_OP)

    def operate(self, positions: Sequence[int], exchange: Callable[[], None] | None, timeout: float) -> None:
        """Take slaves to Op; `exchange` sends images meanwhile."""
        take_to_op(self, positions, self._ask_for_op, exchange, timeout)

    def _ask_for_op(self, position: int) -> None:
        if self.status(position).has_error:
            self._to(position, AlState.SAFE_OP)
        self._write(position, registers.AL_CONTROL, struct.pack("<H", AlState.OP))

    def leave_op(self, position: int) -> None:
        """Take a slave to Pre-Op."""
        self._to(position, AlState.PRE_OP)

    def exchange(self, outputs: Sequence[bytes], timeout: float) -> list[bytes | None]:
        """Send the images of the mapped slaves and return their answers, in the order of `map`."""
        image = b"".join(
            data + bytes(size.inputs) for data, (_, size) in zip(outputs, self._mapped.values(), strict=True)
        )
        asked = [Datagram(C.LRW, LOGICAL, image)]
        asked += [at_station(C.FPRD, FIRST_STATION + k, registers.AL_STATUS, bytes(6)) for k in self._mapped]
        if self.clock is not None:
            asked.append(at_station(C.FRMW, FIRST_STATION, registers.SYSTEM_TIME, bytes(8)))
        found = self._transfer(asked, timeout)
        expected = sum(2 * bool(size.outputs) + bool(size.inputs) for _, size in self._mapped.values())
        if found is None or found[0].counter != expected:
            return [None] * len(self._mapped)
        if self.clock is not None:
            self.system_time = int.from_bytes(found.pop().data, "little")
        parts: list[bytes | None] = []
        for (address, size), answer in zip(self._mapped.values(), found[1:], strict=True):
            start = address - LOGICAL + size.outputs
            is_op = answer.counter and _status(answer.data).is_op
            parts.append(found[0].data[start : start + size.inputs] if is_op else None)
        return parts

    # --- objects ----------------------------------------------------------------------------------------------------
    def upload(self, position: int, index: int, sub: int, timeout: float) -> bytes:
        """Return the bytes of an object."""
        return self._mailboxes[position].upload(index, sub, timeout)

    def download(self, position: int, index: int, sub: int, data: bytes, timeout: float) -> None:
        """Write the bytes of an object."""
        self._mailboxes[position].download(index, sub, data, timeout)

    def post(self, position: int, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting for its answer."""
        self._mailboxes[position].post(index, sub, data)

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies."""
        found = []
        for position, mailbox in enumerate(self._mailboxes):
            mailbox.look(0.0)
            while mailbox.emergencies:
                found.append(ReceivedEmergency(position, *mailbox.emergencies.popleft()))
        return found

    def close(self) -> None:
        """Take all slaves to Init, as far as they answer, and close the carrier."""
        for position in range(len(self._places)):
            self._one(
                C.FPWR, FIRST_STATION + position, registers.AL_CONTROL, struct.pack("<H", AlState.INIT | ACKNOWLEDGE)
            )
            if self.clock is not None:
                self._one(C.FPWR, FIRST_STATION + position, registers.SYNC_ACTIVATION, bytes(1))
        self._way.close()

    def _mailbox(self, position: int, places: SlavePlaces) -> MailboxClient:
        station = FIRST_STATION + position

        def send(data: bytes) -> bool | None:
            found = self._one(C.FPWR, station, places.receive[0], data)
            return None if found is None else bool(found.counter)

        def fetch() -> bytes | None:
            found = self._one(C.FPRD, station, places.send[0], bytes(places.send[1]))
            if found is None:
                return None
            return found.data if found.counter else b""

        def repeat() -> None:
            self._repeats[position] = not self._repeats[position]
            activate = 1 | self._repeats[position] << 1
            self._one(C.FPWR, station, registers.SYNC_MANAGERS + registers.SYNC_MANAGER_SIZE + 6, bytes((activate,)))

        return MailboxClient(send, fetch, repeat, (places.receive[1], places.send[1]), lambda: self.alive())


def _status(data: bytes) -> SlaveStatus:
    status, code = struct.unpack("<H2xH", data)
    return SlaveStatus(status & STATE, bool(status & ERROR), code)
