"""The master by SOEM, over a pysoem of this test: what is asked of SOEM, in what times, what its errors become."""

from __future__ import annotations

import struct
import sys
import threading
from types import SimpleNamespace

import pytest
from rigs.clock import Clock

from drive_env.ethercat.coe import CoeService, message, split
from drive_env.fieldbus.errors import BusError, NoAnswerError, OpenError
from drive_env.master.ethercat import clocks, mailbox_client, soem_master, state_names
from drive_env.master.ethercat.ethercat_master import ImageSizes, SlaveIdentity, SlaveStatus, Sync0
from drive_env.master.ethercat.mailbox_client import SdoAbortError
from drive_env.master.ethercat.soem_master import SoemMaster

SIZES = ImageSizes(4, 6)
STATUS = 0x0130
RECEIVE, ROOM, SEND, LENGTH = 0x1000, 48, 0x1080, 64  # mailboxes: what the master writes, what it reads
SEND_STATUS, SEND_ACTIVATION, HAS_MAIL = 0x080D, 0x080E, 0x0B
PROBE = "40 00 10 00 00 00 00 00"  # a read of 1000h


class SdoError(Exception):
    abort_code = 0


class MailboxError(Exception):
    error_code = 0


class WkcError(Exception):
    pass


class PacketError(Exception):
    pass


class EepromError(Exception):
    pass


class ConfigMapError(Exception):
    pass


class Emergency(Exception):  # noqa: N818 - its name in pysoem
    def __init__(self, code=0x8611, register=0x20, first=1, second=0x0302, third=0x0504):
        self.error_code, self.error_reg, self.b1, self.w1, self.w2 = code, register, first, second, third


class Slave:
    """A slave of SOEM; what is done with it goes into its master's log."""

    man, id, rev = 0x1234, 0x5678, 1

    def __init__(self, position, log):
        self.position, self.log = position, log
        self.statuses, self.state = [(2, 0)], 0
        self.registers = {0x0008: b"\xcc\0", 0x0910: struct.pack("<Q", 5_000_100), 0x0984: b"\0"}
        self.output, self.input = bytes(4), b"inputs"
        self.registers[0x0800] = struct.pack("<HHBBBBHHBBBB", RECEIVE, ROOM, 0x26, 0, 1, 0, SEND, LENGTH, 0x22, 0, 1, 0)
        self.registers[SEND_ACTIVATION] = b"\1"
        self.serial, self.to_soem = struct.pack("<I", 42), []
        # Messages that wait; what answers requests in turn, None: nothing; counters of the last request and answer.
        self.mail, self.answers, self.counter, self.number = [], [], 0, 0
        self.given, self.lost_answers, self.full = b"", 0, 0
        self.probed = "43 00 10 00 92 01 02 00"  # what answers a read of 1000h
        self.silent = 0  # reads of registers that are lost

    def note(self, *what):
        self.log.append((self.position, *what))

    def write_state(self):
        self.note("state", self.state)

    def _fprd(self, address, size, timeout):
        assert timeout == 20_000  # us
        if self.silent > 0:
            self.silent -= 1
            raise WkcError
        if address == STATUS:
            state, code = self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]
            return bytearray(struct.pack("<HHH", state, 0xFFFF, code)[:size])
        if address == SEND:
            return self._give(size)
        if address == SEND_STATUS:
            return bytearray((HAS_MAIL if self.mail else 0x02,))
        return bytearray(self.registers[address][:size])

    def _fpwr(self, address, data, timeout):
        assert timeout == 20_000  # us
        if self.silent > 0:
            raise WkcError
        if address == RECEIVE:
            self._take(data)
            return
        self.note("write", address, data)
        if address == SEND_ACTIVATION:
            self.registers[address] = data
            self.mail.insert(0, self.given)

    def _give(self, size):
        """Let the master have the next message; `lost_answers`: it is gone, though nobody has it."""
        assert size == LENGTH
        if not self.mail:
            raise WkcError
        self.given = self.mail.pop(0)
        if self.lost_answers:
            self.lost_answers -= 1
            raise WkcError
        return bytearray(self.given.ljust(LENGTH, b"\0"))

    def _take(self, data):
        """Take a request, unless it has the counter of the one before: note its SDO and put what answers it."""
        assert len(data) == ROOM
        if self.full:
            self.full -= 1
            raise WkcError
        length, _, _, kind = struct.unpack_from("<HHBB", data)
        assert kind & 0xF == 3
        if kind >> 4 == self.counter:
            return
        self.counter = kind >> 4
        service, request = split(data[6 : 6 + length])
        assert service == CoeService.SDO_REQUEST
        self.note("sdo", request.hex(" "))
        if request.hex(" ") == PROBE and self.answers[:1] != [None]:
            self.put(message(CoeService.SDO_RESPONSE, bytes.fromhex(self.probed)))
        elif self.answers and (answer := self.answers.pop(0)) is not None:
            self.put(answer if isinstance(answer, bytes) else message(CoeService.SDO_RESPONSE, bytes.fromhex(answer)))

    def put(self, content, kind=3):
        self.number = self.number % 7 + 1
        self.mail.append(struct.pack("<HHBB", len(content), 0, 0, kind | self.number << 4) + content)

    def eeprom_read(self, word):
        assert word == 0x0E
        if self.serial is None:
            raise EepromError
        return self.serial

    def add_emergency_callback(self, call):
        self.emergency = call

    def sdo_read(self, index, sub):
        """SOEM's own transfer, with its own counter."""
        self.note("SOEM reads", index, sub)
        if self.to_soem:
            raise self.to_soem.pop(0)
        return b""


class Master:
    """SOEM itself, with two slaves."""

    def __init__(self):
        self.log = []
        self.slaves = [Slave(k, self.log) for k in range(2)]
        self.count, self.error, self.state, self.gone = 2, None, 0, []
        self.counter, self.expected_wkc, self.dc_time = 6, 6, 0
        self.sdo_read_timeout = 700_000  # us, as in pysoem

    def open(self, interface):
        if interface != "eth0":
            raise ConnectionError
        self.log.append("open")

    def config_init(self):
        self.log.append("find")
        self.slaves = [*self.slaves, *self.gone]
        self.slaves, self.gone = self.slaves[: max(self.count, 0)], self.slaves[max(self.count, 0) :]
        return self.count

    def config_dc(self):
        self.log.append("clocks")

    def config_map(self):
        self.log.append("map")
        if self.error:
            raise self.error

    def send_processdata(self, release_gil):
        self.log.append(("send", [slave.output for slave in self.slaves], release_gil))

    def receive_processdata(self, timeout, release_gil):
        self.log.append(("receive", timeout, release_gil))
        return self.counter

    def write_state(self):
        self.log.append(("state", self.state))

    def close(self):
        self.log.append("close")


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(soem_master, "time", found)
    monkeypatch.setattr(state_names, "time", found)
    monkeypatch.setattr(mailbox_client, "time", found)
    return found


@pytest.fixture
def pysoem(monkeypatch, clock):
    found = SimpleNamespace(
        Master=Master, SdoError=SdoError, MailboxError=MailboxError, WkcError=WkcError, PacketError=PacketError,
        EepromError=EepromError, ConfigMapError=ConfigMapError, Emergency=Emergency, STATE_ACK=0x10,
        settings=SimpleNamespace(timeouts=SimpleNamespace(ret=2000, tx_mailbox=20_000)),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "pysoem", found)
    return found


@pytest.fixture
def master(pysoem):
    found = SoemMaster("eth0")
    found.begin()
    found._master.log.clear()
    return found


@pytest.fixture
def soem(master):
    return master._master


@pytest.fixture
def counted(master, soem):
    """Slaves that take the counter of our mailbox."""
    for slave in soem.slaves:
        master.upload(slave.position, 0x1000, 0, 1.0)
    soem.log.clear()
    return master


def take(soem):
    taken, soem.log[:] = list(soem.log), []
    return taken


# --- the interface ----------------------------------------------------------------------------------------------------
def test_soem_waits_longer_than_it_would_for_a_chip(pysoem):
    assert SoemMaster("eth0")._master.log == ["open"]
    assert (pysoem.settings.timeouts.ret, pysoem.settings.timeouts.tx_mailbox) == (20_000, 200_000)  # us


def test_an_interface_that_cannot_be_opened_is_told(pysoem):
    with pytest.raises(
        OpenError, match=r"^eth7 cannot be opened: it is no network interface here, or the right CAP_NE"
    ):
        SoemMaster("eth7")


def test_without_pysoem_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pysoem", None)
    with pytest.raises(OpenError, match=r"^a master on EtherCAT needs pysoem: pip install"):
        SoemMaster("eth0")


@pytest.mark.parametrize("count", [0, -1])
def test_nobody_there_is_told(master, soem, count):
    soem.count = count
    with pytest.raises(NoAnswerError, match=r"^no slave answers on eth0; check cable, power and channel$"):
        master.begin()
    soem.count = 1
    assert master.begin() == 1


def test_slaves_that_are_found_no_more_do_not_answer(counted, soem):
    """SOEM has forgotten them; they may come back."""
    soem.count = -1
    with pytest.raises(NoAnswerError):
        counted.begin()
    assert counted.status(1) == SlaveStatus(0, False, 0) and counted.take_emergencies() == []
    for call in (lambda: counted.write_register(1, 0x0420, b"\1"), lambda: counted.identity(1)):
        with pytest.raises(NoAnswerError, match=r"^position 1 does not answer; check cable and power$"):
            call()
    with pytest.raises(NoAnswerError, match=r"^no answer came in time$"):
        counted.upload(1, 0x2005, 0, 0.01)
    counted.post(1, 0x6040, 0, b"\6\0")
    soem.count = 2
    assert counted.recover(1) is True and counted.upload(1, 0x1000, 0, 1.0) == b"\x92\1\2\0"


def test_the_end_takes_all_slaves_to_init(pysoem, master, soem):
    master.close()
    assert take(soem) == [("state", 1), "close"]
    other = SoemMaster("eth0")
    other.close()
    assert other._master.log == ["open", "close"], "it has found no slaves"


def test_the_end_ends_sync0_of_all_that_answer(master, soem):
    master.clock = Sync0(0.001, False)
    soem.slaves[0].silent = 1
    master.close()
    assert take(soem) == [("state", 1), (1, "write", 0x0981, b"\0"), "close"]


# --- slaves -----------------------------------------------------------------------------------------------------------
def test_all_slaves_come_to_pre_op(master, soem, clock):
    soem.slaves[1].statuses = [(1, 0), (1, 0), (2, 0)]
    told = []
    master.alive = lambda: told.append(clock.now)
    assert master.begin() == 2
    assert take(soem) == ["find"]
    assert clock.slept == [0.001] * 2 and len(told) == 2
    soem.slaves[1].statuses = [(0x12, 0x16)]
    with pytest.raises(BusError, match=r"^position 1 stays in Pre-Op and .* to Pre-Op; AL status code 0016h"):
        master.begin()
    assert len(clock.slept) == 2, "a refusal is told at once"


def test_a_state_is_waited_for_5_s(master, soem, clock):
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + 0.5)
    soem.slaves[0].statuses = [(4, 0)]
    with pytest.raises(
        BusError, match=r"^position 0 stays in Safe-Op and does not come to Pre-Op; it gives no reason$"
    ):
        master.leave_op(0)
    assert clock.now == 1005.5, "at 1005.0 the time is not over"
    assert take(soem) == [(0, "state", 0x12)]


@pytest.mark.parametrize("state", [2, 4, 8])
def test_a_slave_that_has_its_mailbox_is_taken_to_pre_op(master, soem, state):
    soem.slaves[1].statuses = [(state, 0), (2, 0)]
    assert master.recover(1) is False
    assert take(soem) == [(1, "state", 0x12)]


@pytest.mark.parametrize(("silent", "restarted"), [(0, False), (5, True)])
def test_other_slaves_get_their_addresses_with_all(master, soem, silent, restarted):
    soem.slaves[1].statuses, soem.slaves[1].silent = [(1, 0), (2, 0)], silent
    assert master.recover(1) is restarted
    assert take(soem) == ["find"]


def test_a_register_is_asked_five_times(master, soem):
    slave = soem.slaves[1]
    slave.statuses, slave.silent = [(0x0018, 0x8001)], 4
    assert master.status(1) == SlaveStatus(8, True, 0x8001)
    slave.statuses = [(0xFFE8, 0)]
    assert master.status(1) == SlaveStatus(8, False, 0), "four bits are the state, the fifth is the error"
    slave.silent = 5
    assert master.status(1) == SlaveStatus(0, False, 0)
    assert slave.silent == 0
    assert master.register(1, 0x0008, 2) == b"\xcc\0" and type(master.register(1, 0x0008, 1)) is bytes


def test_a_register_that_is_not_taken_is_told(master, soem):
    master.write_register(1, 0x0420, b"\x01\x02")
    assert take(soem) == [(1, "write", 0x0420, b"\x01\x02")]
    soem.slaves[1].silent = 1
    with pytest.raises(NoAnswerError, match=r"^position 1 does not answer; check cable and power$"):
        master.write_register(1, 0x0420, b"\x01\x02")


def test_identity_is_what_the_eeprom_says(master, soem):
    assert master.identity(1) == SlaveIdentity(0x1234, 0x5678, 1, 42)
    soem.slaves[1].serial = None
    assert master.identity(1).serial == 0, "it cannot be read"


# --- images -----------------------------------------------------------------------------------------------------------
def test_images_are_soem_s_to_map_and_must_have_the_length_that_is_expected(master, soem):
    for slave in soem.slaves:
        slave.statuses = [(4, 0)]
    master.map({0: SIZES, 1: SIZES})
    assert take(soem) == ["map"]
    soem.slaves[1].input = b"input"
    with pytest.raises(BusError, match=r"^position 1 has images of 4 and 5 bytes, not of 4 and 6; compare the EDS"):
        master.map({0: SIZES, 1: SIZES})
    soem.error = ConfigMapError("no room")
    with pytest.raises(BusError, match=r"^SOEM cannot map the images: no room; see the drive's manual$"):
        master.map({0: SIZES, 1: SIZES})


def test_a_slave_that_refuses_its_images_is_told(master, soem):
    soem.slaves[1].statuses = [(0x12, 0x1D)]
    soem.slaves[0].statuses = [(4, 0)]
    with pytest.raises(BusError, match=r"^position 1 .* does not come to Safe-Op; AL status code 001Dh"):
        master.map({0: SIZES, 1: SIZES})


def test_clocks_are_soem_s_and_sync0_starts_in_pre_op_alone(master, soem, monkeypatch):
    master.clock = Sync0(0.001, False)
    soem.slaves[0].statuses = [(4, 0)]
    soem.slaves[1].statuses = [(2, 0), (4, 0)]
    master.map({0: SIZES, 1: SIZES})
    start = (round(clocks.AHEAD * 1e9) + 5_000_100) // 1_000_000 * 1_000_000 + 1_000_000
    assert take(soem) == [
        "clocks", (1, "write", 0x0981, b"\0"), (1, "write", 0x0990, struct.pack("<Q", start)),
        (1, "write", 0x09A0, struct.pack("<I", 1_000_000)), (1, "write", 0x0981, b"\x03"), "map",
    ]  # fmt: skip
    soem.slaves[1].registers[0x0008] = b"\0\0"
    with pytest.raises(BusError, match=r"^position 1 has no distributed clocks; open it without sync0$"):
        master.map({0: SIZES})


def test_slaves_are_taken_to_op_while_images_are_exchanged(master, soem, clock):
    exchanged, told = [], []
    master.alive = lambda: told.append(1)
    soem.slaves[0].statuses = [(4, 0), (4, 0), (8, 0)]
    soem.slaves[1].statuses = [(0x14, 0x1B), (4, 0), (8, 0)]
    master.operate([0, 1], lambda: exchanged.append(1), 1.0)
    assert take(soem) == [(0, "state", 8), (1, "state", 0x14), (1, "state", 8)]
    assert exchanged == told == [1] and clock.slept == [0.001]
    master.operate([0, 1], None, 1.0)


def test_a_slave_whose_watchdog_was_quicker_than_a_busy_computer_is_asked_again(master, soem, clock):
    soem.slaves[0].statuses = [(4, 0), (0x14, 0x1B), (0x14, 0x1B), (4, 0), (8, 0)]
    master.operate([0], None, 1.0)
    assert take(soem) == [(0, "state", 8), (0, "state", 0x14), (0, "state", 8)]


def test_op_that_does_not_come_in_time_is_told(master, soem, clock):
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + 0.5)
    soem.slaves[0].statuses, soem.slaves[1].statuses = [(4, 0)], [(8, 0)]
    with pytest.raises(BusError, match=r"^position 0 stays in Safe-Op and does not come to Op; it gives no reason$"):
        master.operate([1, 0], None, 1.0)
    assert clock.now == 1001.5


def test_op_that_is_refused_is_told_at_once_and_of_the_slave_that_refuses(master, soem, clock):
    soem.slaves[0].statuses, soem.slaves[1].statuses = [(4, 0)], [(4, 0), (0x14, 0x1D)]
    with pytest.raises(BusError, match=r"^position 1 stays in Safe-Op and does not come to Op; AL status code 001Dh"):
        master.operate([0, 1], None, 1.0)
    assert clock.slept == []


@pytest.fixture
def in_op(master, soem):
    for slave in soem.slaves:
        slave.statuses = [(4, 0)]
    master.map({0: SIZES, 1: SIZES})
    for slave in soem.slaves:
        slave.statuses = [(8, 0)]
    master.operate([0, 1], None, 1.0)
    soem.log.clear()
    return master


def test_an_exchange_sends_outputs_and_brings_inputs(in_op, soem):
    soem.slaves[1].input = b"others"
    assert in_op.exchange([b"abcd", b"efgh"], 0.02) == [b"inputs", b"others"]
    assert take(soem) == [("send", [b"abcd", b"efgh"], True), ("receive", 20_000, True)]
    for soem.counter in (5, 7, -1):
        assert in_op.exchange([b"abcd", b"efgh"], 0.02) == [None, None]
    assert in_op.system_time is None


def test_the_reference_s_time_comes_with_the_images(in_op, soem):
    soem.dc_time, in_op.clock = 123_456, Sync0(0.001, False)
    in_op.exchange([b"abcd", b"efgh"], 0.02)
    assert in_op.system_time == 123_456


def test_a_slave_that_has_left_op_gives_no_image_and_states_are_asked_each_5_ms(in_op, soem, clock):
    outputs = [b"abcd", b"efgh"]
    assert in_op.exchange(outputs, 0.02) == [b"inputs"] * 2
    soem.slaves[1].statuses = [(4, 0)]
    clock.now += 0.0049
    assert in_op.exchange(outputs, 0.02) == [b"inputs"] * 2
    clock.now += 0.0002
    assert in_op.exchange(outputs, 0.02) == [b"inputs", None]
    soem.slaves[1].statuses = [(8, 0)]
    clock.now += 0.0049
    assert in_op.exchange(outputs, 0.02) == [b"inputs", None]
    in_op.operate([0, 1], None, 1.0)
    assert in_op.exchange(outputs, 0.02) == [b"inputs"] * 2, "it has just been taken there"


# --- objects ----------------------------------------------------------------------------------------------------------
def test_an_object_is_read_and_written_by_datagrams_of_soem(counted, soem):
    """In the mailbox that the sync managers tell, whose room is that of what the master writes."""
    soem.slaves[1].answers = ["4b 05 20 03 34 12 00 00", "60 05 20 03 00 00 00 00"]
    assert counted.upload(1, 0x2005, 3, 1.5) == b"\x34\x12"
    assert take(soem) == [(1, "sdo", "40 05 20 03 00 00 00 00")]
    counted.download(1, 0x2005, 3, b"\x34\x12", 1.5)
    assert take(soem) == [(1, "sdo", "2b 05 20 03 34 12 00 00")]
    soem.slaves[1].answers = ["60 05 20 03 00 00 00 00", "20 00 00 00 00 00 00 00"]
    counted.download(1, 0x2005, 3, bytes(40), 1.5)  # 32 fit into 48 bytes
    assert take(soem) == [(1, "sdo", "21 05 20 03 28 00 00 00" + " 00" * 32), (1, "sdo", "01" + " 00" * 8)]


def test_a_slave_without_a_mailbox_to_be_read_is_told(master, soem):
    soem.slaves[1]._fprd = lambda address, size, timeout: (
        Slave._fprd(soem.slaves[1], address, size, timeout) if address == STATUS else _lost()
    )
    with pytest.raises(NoAnswerError, match=r"^position 1 does not answer; check cable and power$"):
        master.begin()


def _lost():
    raise WkcError


@pytest.mark.parametrize("soem_s", range(8))
def test_the_first_message_may_have_the_counter_of_soem_s_last(master, soem, clock, soem_s):
    """Which is not told; the slave ignores it, so it is a read of 1000h that nobody wants."""
    soem.slaves[0].counter = soem_s
    soem.slaves[0].answers = ["4f 61 60 00 08 00 00 00", "4f 61 60 00 08 00 00 00"]
    assert master.upload(0, 0x6061, 0, 1.0) == b"\x08"
    assert take(soem) == [(0, "sdo", PROBE), (0, "sdo", "40 61 60 00 00 00 00 00")]
    assert clock.now < 1000.2 and (soem_s == 1) == (clock.now > 1000.1)
    assert master.upload(0, 0x6061, 0, 1.0) == b"\x08"
    assert take(soem) == [(0, "sdo", "40 61 60 00 00 00 00 00")], "once is enough"


def test_a_slave_that_does_not_answer_is_probed_three_times(master, soem, clock):
    soem.slaves[0].answers = [None] * 5
    with pytest.raises(NoAnswerError, match=r"^no answer came in time$"):
        master.upload(0, 0x6061, 0, 0.5)
    assert [what[2] for what in take(soem)] == [PROBE] * 3 + ["40 61 60 00 00 00 00 00"]
    assert clock.now == pytest.approx(1000.8, abs=0.003)


def test_a_refusal_of_the_probe_is_an_answer(master, soem, clock):
    soem.slaves[0].probed, soem.slaves[0].answers = "80 00 10 00 00 00 02 06", ["4f 61 60 00 08 00 00 00"]
    assert master.upload(0, 0x6061, 0, 1.0) == b"\x08"
    assert len(take(soem)) == 2 and clock.slept == []


def test_soem_gets_the_mailbox_back_before_it_maps(counted, soem):
    """Its first message may be ignored, so it is a read that nobody wants either."""
    soem.slaves[0].to_soem = [WkcError()]
    for slave in soem.slaves:
        slave.statuses = [(4, 0)]
    counted.map({0: SIZES, 1: SIZES})
    assert take(soem) == [(0, "SOEM reads", 0x1000, 0), (1, "SOEM reads", 0x1000, 0), "map"]
    assert soem.sdo_read_timeout == 100_000  # us
    counted.map({0: SIZES})
    assert take(soem) == ["map"], "it has had it since"
    soem.slaves[1].answers = ["4f 61 60 00 08 00 00 00"]
    counted.upload(1, 0x6061, 0, 1.0)
    assert take(soem) == [(1, "sdo", PROBE), (1, "sdo", "40 61 60 00 00 00 00 00")]


@pytest.mark.parametrize("error", [WkcError, PacketError, SdoError, MailboxError])
def test_what_soem_makes_of_a_read_that_nobody_wants_is_let_go(counted, soem, error):
    soem.slaves[0].to_soem, soem.slaves[0].statuses = [error()], [(4, 0)]
    counted.map({0: SIZES})
    assert take(soem)[-1] == "map"


def test_an_abort_and_a_mailbox_error_are_told(counted, soem):
    soem.slaves[0].answers = ["80 05 20 00 00 00 02 06"]
    with pytest.raises(SdoAbortError) as error:
        counted.upload(0, 0x2005, 0, 1.0)
    assert error.value.abort_code == 0x06020000
    soem.slaves[0].put(struct.pack("<HH", 1, 4), kind=0)
    with pytest.raises(BusError, match=r"^a mailbox error of the slave, detail 4$"):
        counted.upload(0, 0x2005, 0, 1.0)


def test_an_answer_is_waited_for_and_the_program_told(counted, soem, clock):
    told = []
    counted.alive = lambda: told.append(clock.now)
    with pytest.raises(NoAnswerError, match=r"^no answer came in time$"):
        counted.upload(0, 0x2005, 0, 0.01)
    assert len(told) > 15 and clock.now == pytest.approx(1000.01, abs=0.001)
    assert len(take(soem)) == 1, "it is sent once"


def test_a_request_for_which_there_is_no_room_is_sent_again(counted, soem):
    soem.slaves[0].full, soem.slaves[0].answers = 3, ["60 05 20 00 00 00 00 00"]
    counted.download(0, 0x2005, 0, b"\1", 1.0)
    assert take(soem) == [(0, "sdo", "2f 05 20 00 01 00 00 00")]


def test_an_answer_whose_frame_is_lost_is_asked_for_again(counted, soem):
    """By the second bit of 080Eh, which changes; the slave repeats, and does nothing twice."""
    soem.slaves[0].lost_answers, soem.slaves[0].answers = 2, ["4b 05 20 03 34 12 00 00"]
    assert counted.upload(0, 0x2005, 3, 1.0) == b"\x34\x12"
    assert take(soem) == [
        (0, "sdo", "40 05 20 03 00 00 00 00"),
        (0, "write", SEND_ACTIVATION, b"\3"),
        (0, "write", SEND_ACTIVATION, b"\1"),
    ]


def in_another_thread(call):
    thread = threading.Thread(target=call)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()


def test_a_post_waits_for_no_answer_and_for_no_transfer(counted, soem, clock):
    counted.post(0, 0x6040, 0, b"\6\0")
    assert take(soem) == [(0, "sdo", "2b 40 60 00 06 00 00 00")] and clock.slept == []
    with counted._mailboxes[0]._turn:
        in_another_thread(lambda: counted.post(0, 0x6040, 0, b"\6\0"))
    assert take(soem) == [], "a transfer was under way"
    in_another_thread(lambda: counted.post(0, 0x6040, 0, b"\6\0"))
    assert len(take(soem)) == 1, "and the turn is free again"


def test_images_go_while_an_answer_is_waited_for(in_op, soem):
    """A transfer takes the turn of frames for each of its datagrams alone."""
    found = []
    in_op.upload(0, 0x1000, 0, 1.0)
    soem.slaves[0].answers = [None]
    in_op.alive = lambda: in_another_thread(lambda: found.append(in_op.exchange([b"abcd", b"efgh"], 0.02)))
    with pytest.raises(NoAnswerError):
        in_op.upload(0, 0x2005, 0, 0.001)
    assert found and all(one == [b"inputs"] * 2 for one in found)


# --- emergencies ------------------------------------------------------------------------------------------------------
EMERGENCY = message(CoeService.EMERGENCY, bytes.fromhex("11 86 20 01 02 03 04 05"))
TAKEN = (0x8611, 0x20, (1, 2, 3, 4, 5))


def test_emergencies_come_between_transfers_and_by_a_look(counted, soem):
    soem.slaves[0].put(EMERGENCY)
    soem.slaves[1].put(EMERGENCY)
    soem.slaves[1].answers = ["4b 05 20 03 34 12 00 00"]
    assert counted.upload(1, 0x2005, 3, 1.0) == b"\x34\x12"
    assert counted.take_emergencies() == [(0, *TAKEN), (1, *TAKEN)]
    assert counted.take_emergencies() == []


def test_emergencies_that_come_to_soem_are_kept(counted, soem):
    soem.slaves[1].emergency(Emergency(0x7500, 0x11))
    soem.slaves[0].emergency(Emergency())
    assert counted.take_emergencies() == [(1, 0x7500, 0x11, (1, 2, 3, 4, 5)), (0, *TAKEN)]
    assert counted.take_emergencies() == []


def test_emergencies_are_kept_where_slaves_are_found_anew(counted, soem):
    soem.slaves[1].put(EMERGENCY)
    soem.slaves[1].answers = ["4b 05 20 03 34 12 00 00"]
    counted.upload(1, 0x2005, 3, 1.0)
    counted.begin()
    assert counted.take_emergencies() == [(1, *TAKEN)]


def test_answers_that_nobody_waits_for_are_let_go(counted, soem):
    soem.slaves[0].put(struct.pack("<HH", 1, 4), kind=0)
    soem.slaves[0].put(message(CoeService.SDO_RESPONSE, bytes.fromhex("80 05 20 00 00 00 02 06")))
    soem.slaves[1].put(EMERGENCY)
    assert [one.node for one in counted.take_emergencies()] == [1]
    assert soem.slaves[0].mail == []
    in_another_thread(lambda: counted.post(0, 0x6040, 0, b"\6\0"))
    assert len(take(soem)) == 1, "and its turn is free again"


def test_a_look_leaves_a_slave_whose_transfer_is_under_way(counted, soem):
    for slave in soem.slaves:
        slave.put(EMERGENCY)
    found = []
    with counted._mailboxes[0]._turn:
        in_another_thread(lambda: found.extend(counted.take_emergencies()))
    assert [one.node for one in found] == [1]
    assert [one.node for one in counted.take_emergencies()] == [0]
