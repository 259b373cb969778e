"""A master on a network interface: SOEM, by pysoem (extra `ethercat`), finds slaves, maps and exchanges images.

Objects are transferred by our own mailbox client over SOEM's datagrams. SOEM's own transfers in one thread would delay
the images of another: its threads take each other's frames from the socket, and a thread that waits for a frame already
taken waits for the socket's shortest time, 1 us, which Linux extends to one or two ticks, 4 to 20 ms.
"""

from __future__ import annotations

import contextlib
import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from drive_env.ethercat import registers
from drive_env.ethercat.application import AlState
from drive_env.fieldbus.errors import BusError, NoAnswerError, OpenError
from drive_env.fieldbus.link import ReceivedEmergency
from drive_env.master.ethercat.clocks import check_clocks, start_sync0
from drive_env.master.ethercat.ethercat_master import ERROR, READS, STATE, ImageSizes, SlaveIdentity, SlaveStatus, Sync0
from drive_env.master.ethercat.mailbox_client import MailboxClient, SdoAbortError
from drive_env.master.ethercat.state_names import refusal, take_to_op

MICROSECONDS = 1e6
REGISTER_TIMEOUT = 20_000  # us
# us. SOEM has 2 ms for a frame and 20 ms for room in a mailbox: enough only for a computer that does nothing else.
FRAME_TIMEOUT, ROOM_TIMEOUT = 20_000, 200_000
STATE_LOOK = 0.005  # s between two looks at the slaves' states while images are exchanged
PATIENCE = 5.0  # s for a state
PROBE, PROBES = 0.1, 3  # s for an answer, which shows that the slave accepts our mailbox counter; number of tries
HAS_MAIL = 0x08  # of a sync manager's status
DEVICE_TYPE = 0x1000


class SoemMaster:
    """SOEM on a network interface.

    Args:
        interface: Its name, e.g. eth0.

    Raises:
        OpenError: If pysoem is not installed, or the interface cannot be opened.

    Attributes:
        alive: Called again and again while an answer is waited for.
        clock: Settings of the distributed clocks for `map`; SOEM measures delays and offsets.
        system_time: The reference's time from the last exchange [ns].
    """

    def __init__(self, interface: str) -> None:
        try:
            import pysoem
        except ImportError:
            raise OpenError(
                "a master on EtherCAT needs pysoem: pip install 'drive-env[ethercat]'; --interface ethercat-udp goes "
                "without"
            ) from None
        self.alive: Callable[[], None] = lambda: None
        self.clock: Sync0 | None = None
        self.system_time: int | None = None
        self._soem = pysoem
        self._interface = interface
        pysoem.settings.timeouts.ret, pysoem.settings.timeouts.tx_mailbox = FRAME_TIMEOUT, ROOM_TIMEOUT
        self._master = pysoem.Master()
        try:
            self._master.open(interface)
        except ConnectionError:
            raise OpenError(
                f"{interface} cannot be opened: it is no network interface here, or the right CAP_NET_RAW is missing: "
                "run as root, or see the page on EtherCAT for how to give it to Python"
            ) from None
        self._turn = threading.RLock()  # a frame and its answer
        self._mailboxes: list[MailboxClient] = []
        self._has_counted: list[bool] = []  # whether the last message to a slave's mailbox was sent by our client
        self._emergencies: deque[ReceivedEmergency] = deque()  # received by SOEM, or by earlier mailbox clients
        self._mapped: dict[int, ImageSizes] = {}
        self._looked, self._states = -math.inf, dict[int, SlaveStatus]()

    # --- slaves -----------------------------------------------------------------------------------------------------
    def begin(self) -> int:
        """Find the slaves, give them addresses, and take them to Pre-Op, from any state. Returns their number."""
        with self._turn:
            self._mapped.clear()
            count = int(self._master.config_init())
            if count <= 0:
                raise NoAnswerError(f"no slave answers on {self._interface}; check cable, power and channel")
            self._keep_emergencies()
            for position, slave in enumerate(self._master.slaves):
                # Comes while SOEM itself reads an object; if not handled, it would be raised there.
                slave.add_emergency_callback(lambda one, position=position: self._take_emergency(position, one))
            for position in range(count):
                self._await(position, AlState.PRE_OP)
            self._mailboxes = [self._mailbox(position) for position in range(count)]
            self._has_counted = [False] * count
            return count

    def recover(self, position: int) -> bool:
        """Take a slave to Pre-Op; return whether it had restarted, and so lost its address."""
        status = self.status(position)
        if status.state in (AlState.PRE_OP, AlState.SAFE_OP, AlState.OP):
            self._request(position, AlState.PRE_OP)
            return False
        self.begin()  # SOEM assigns addresses only to all slaves at once
        return not status.state

    def identity(self, position: int) -> SlaveIdentity:
        """Return the identity in a slave's EEPROM."""
        slave = self._slave(position)
        serial = self._quietly(lambda: slave.eeprom_read(0x0E))
        return SlaveIdentity(slave.man, slave.id, slave.rev, int.from_bytes(serial or b"", "little"))

    def status(self, position: int) -> SlaveStatus:
        """Read a slave's present state."""
        data = self.register(position, registers.AL_STATUS, 6)
        if data is None:
            return SlaveStatus(0, False, 0)
        status, code = struct.unpack("<H2xH", data)
        return SlaveStatus(status & STATE, bool(status & ERROR), code)

    def _slave(self, position: int) -> Any:
        slaves = self._master.slaves
        if position >= len(slaves):  # SOEM has found fewer slaves than before
            raise NoAnswerError(f"position {position} does not answer; check cable and power")
        return slaves[position]

    def _request(self, position: int, state: AlState) -> None:
        with self._turn:
            slave = self._slave(position)
            slave.state = int(state) | self._soem.STATE_ACK
            slave.write_state()
        self._await(position, state)

    def _await(self, position: int, state: AlState) -> None:
        """Wait until a slave is in a state; BusError if it refuses or does not reach it."""
        deadline = time.monotonic() + PATIENCE
        while True:
            status = self.status(position)
            if status.state == state and not status.has_error:
                return
            if status.has_error or time.monotonic() > deadline:
                raise BusError(refusal(position, state, status))
            self.alive()
            time.sleep(0.001)

    # --- registers --------------------------------------------------------------------------------------------------
    def register(self, position: int, address: int, size: int) -> bytes | None:
        """Return a slave's register; None if it does not answer."""
        for _ in range(READS):
            with self._turn:
                found = self._quietly(lambda: self._slave(position)._fprd(address, size, REGISTER_TIMEOUT))
            if found is not None:
                return bytes(found)
        return None

    def write_register(self, position: int, address: int, data: bytes) -> None:
        """Write a slave's register; NoAnswerError if it does not accept it."""
        with self._turn:
            try:
                self._slave(position)._fpwr(address, data, REGISTER_TIMEOUT)
            except self._soem.WkcError:
                raise NoAnswerError(f"position {position} does not answer; check cable and power") from None

    def _quietly(self, call: Callable[[], Any]) -> Any:
        soem = self._soem
        try:
            return call()
        except (soem.WkcError, soem.EepromError, soem.PacketError, soem.SdoError, soem.MailboxError, NoAnswerError):
            return None

    # --- images -----------------------------------------------------------------------------------------------------
    def map(self, sizes: Mapping[int, ImageSizes]) -> None:
        """Assign addresses to the images of all slaves, and take them from Pre-Op to Safe-Op."""
        with self._turn:
            if self.clock is not None:
                check_clocks(self, range(len(self._mailboxes)))
                self._master.config_dc()
                waiting = [k for k in sizes if self.status(k).state == AlState.PRE_OP]
                start_sync0(self, waiting, self.clock)
            for position in sizes:
                self._give_the_mailbox_back(position)
            try:
                self._master.config_map()
            except self._soem.ConfigMapError as error:
                raise BusError(f"SOEM cannot map the images: {error}; see the drive's manual") from None
            for position, size in sizes.items():
                slave = self._slave(position)
                found = (len(slave.output), len(slave.input))
                if found != size:
                    raise BusError(
                        f"position {position} has images of {found[0]} and {found[1]} bytes, not of {size.outputs} and "
                        f"{size.inputs}; compare the EDS with the drive's firmware"
                    )
                self._await(position, AlState.SAFE_OP)
            self._mapped = dict(sizes)

    def operate(self, positions: Sequence[int], exchange: Callable[[], None] | None, timeout: float) -> None:
        """Take slaves to Op; `exchange` sends images meanwhile."""
        take_to_op(self, positions, self._ask_for_op, exchange, timeout)
        self._looked = -math.inf

    def _ask_for_op(self, position: int) -> None:
        with self._turn:
            if self.status(position).has_error:
                self._request(position, AlState.SAFE_OP)
            slave = self._slave(position)
            slave.state = int(AlState.OP)
            slave.write_state()

    def leave_op(self, position: int) -> None:
        """Take a slave to Pre-Op."""
        self._request(position, AlState.PRE_OP)

    def exchange(self, outputs: Sequence[bytes], timeout: float) -> list[bytes | None]:
        """Send the images of the mapped slaves and return their answers, in the order of `map`."""
        with self._turn:
            for position, data in zip(self._mapped, outputs, strict=True):
                self._slave(position).output = data
            self._master.send_processdata(release_gil=True)
            counter = self._master.receive_processdata(round(timeout * MICROSECONDS), release_gil=True)
            if counter != self._master.expected_wkc:
                return [None] * len(self._mapped)
            if self.clock is not None:
                self.system_time = int(self._master.dc_time)
            now = time.monotonic()
            if now - self._looked > STATE_LOOK:
                # A slave that has left Op still answers process data; only its state shows that.
                self._looked, self._states = now, {position: self.status(position) for position in self._mapped}
            return [bytes(self._slave(k).input) if self._states[k].is_op else None for k in self._mapped]

    # --- objects ----------------------------------------------------------------------------------------------------
    def upload(self, position: int, index: int, sub: int, timeout: float) -> bytes:
        """Return the bytes of an object."""
        return self._our_mailbox(position).upload(index, sub, timeout)

    def download(self, position: int, index: int, sub: int, data: bytes, timeout: float) -> None:
        """Write the bytes of an object."""
        self._our_mailbox(position).download(index, sub, data, timeout)

    def post(self, position: int, index: int, sub: int, data: bytes) -> None:
        """Send a short write without waiting for its answer, unless a transfer is under way."""
        self._our_mailbox(position).post(index, sub, data)

    def take_emergencies(self) -> list[ReceivedEmergency]:
        """Return and forget the received emergencies."""
        for mailbox in self._mailboxes:
            mailbox.look(0.0)
        self._keep_emergencies()
        return [self._emergencies.popleft() for _ in range(len(self._emergencies))]

    def _keep_emergencies(self) -> None:
        for position, mailbox in enumerate(self._mailboxes):
            while mailbox.emergencies:
                self._emergencies.append(ReceivedEmergency(position, *mailbox.emergencies.popleft()))

    def _take_emergency(self, position: int, one: Any) -> None:
        extra = (one.b1, one.w1 & 0xFF, one.w1 >> 8, one.w2 & 0xFF, one.w2 >> 8)
        self._emergencies.append(ReceivedEmergency(position, one.error_code, one.error_reg, extra))

    def _our_mailbox(self, position: int) -> MailboxClient:
        """Return the client of a slave's mailbox, after the slave has accepted its counter.

        A slave ignores a message with the same counter as the previous one, and SOEM's counter cannot be read.
        """
        mailbox = self._mailboxes[position]
        if not self._has_counted[position]:
            for _ in range(PROBES):
                with contextlib.suppress(NoAnswerError):
                    with contextlib.suppress(SdoAbortError):  # an abort is an answer, too
                        mailbox.upload(DEVICE_TYPE, 0, PROBE)
                    break
            self._has_counted[position] = True
        return mailbox

    def _give_the_mailbox_back(self, position: int) -> None:
        """Let SOEM send a message that the slave may ignore, so that it accepts the next."""
        if self._has_counted[position]:
            self._master.sdo_read_timeout = round(PROBE * MICROSECONDS)
            self._quietly(lambda: self._slave(position).sdo_read(DEVICE_TYPE, 0))
            self._has_counted[position] = False

    def _mailbox(self, position: int) -> MailboxClient:
        """Return a client of a slave's mailbox, at the addresses set by SOEM."""
        found = self.register(position, registers.SYNC_MANAGERS, 2 * registers.SYNC_MANAGER_SIZE)
        if found is None:
            raise NoAnswerError(f"position {position} does not answer; check cable and power")
        receive, room, send, length = struct.unpack("<HH4xHH4x", found)
        second = registers.SYNC_MANAGERS + registers.SYNC_MANAGER_SIZE

        def write(data: bytes) -> bool:
            with self._turn:
                found = self._quietly(lambda: self._slave(position)._fpwr(receive, data, REGISTER_TIMEOUT) or True)
                return found is not None

        def fetch() -> bytes | None:
            with self._turn:
                status = self.register(position, second + 5, 1)
                if status is None or not status[0] & HAS_MAIL:
                    return b""
                found = self._quietly(lambda: self._slave(position)._fprd(send, length, REGISTER_TIMEOUT))
            return None if found is None else bytes(found)

        def repeat() -> None:
            activate = self.register(position, second + 6, 1)
            if activate is not None:
                with contextlib.suppress(NoAnswerError):
                    self.write_register(position, second + 6, bytes((activate[0] ^ 2,)))

        return MailboxClient(write, fetch, repeat, (room, length), lambda: self.alive())

    def close(self) -> None:
        """Take all slaves to Init, as far as they answer, and close the interface."""
        with self._turn:
            if self._mailboxes:
                self._master.state = int(AlState.INIT)
                self._master.write_state()
            for position in range(len(self._mailboxes) if self.clock is not None else 0):
                with contextlib.suppress(NoAnswerError):
                    self.write_register(position, registers.SYNC_ACTIVATION, bytes(1))
            self._master.close()
