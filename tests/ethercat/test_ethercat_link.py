"""The link over EtherCAT over a master of this test: states, resets, objects and images, and what is told of them."""

from __future__ import annotations

import socket
import threading
from types import SimpleNamespace

import pytest
from rigs.clock import Clock
from rigs.small_eds import I16, I32, U16, described, small_eds

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.ethercat import datagrams
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.fieldbus.errors import BusError, NoAnswerError, OpenError
from drive_env.fieldbus.link import ReceivedEmergency
from drive_env.master.ethercat import ethercat_link, frame_ways
from drive_env.master.ethercat.clocks import check_clocks, set_offsets, start_sync0
from drive_env.master.ethercat.ethercat_link import EtherCatLink
from drive_env.master.ethercat.ethercat_master import SlaveStatus, Sync0
from drive_env.master.ethercat.frame_ways import CallWay, RawWay, UdpWay
from drive_env.master.ethercat.mailbox_client import SdoAbortError
from drive_env.master.ethercat.slave_objects import SlaveObjects
from drive_env.master.ethercat.state_names import refusal, state_name

PRE_OP, SAFE_OP, OP = 2, 4, 8


@pytest.fixture(scope="module")
def drive():
    rows = [(0x6040, "Controlword", U16, "rww", 1), (0x6041, "Statusword", U16, "ro", 1),
            (0x6064, "Position", I32, "ro", 1), (0x6071, "Target torque", I16, "rww", 1)]  # fmt: skip
    further = [(index + 0x800, f"{name} 2", *rest) for index, name, *rest in rows]
    pdos = [(0x1600, "rw", 4, None), (0x1A00, "rw", 4, None)]
    return described(small_eds([*rows, *further], pdos), 2)


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(ethercat_link, "time", found)
    return found


class Master:
    """A master of four slaves; what is asked of it is noted."""

    def __init__(self, count=4):
        self.count, self.log, self.states, self.objects, self.emergencies = count, [], [PRE_OP] * count, {}, []
        self.errors, self.restarted, self.system_time, self.rows = {}, set(), None, []
        self.registers = {0x0008: b"\x04\0", 0x0910: [bytes(8), b"\1" + bytes(7)]}
        self.clock, self.alive = "nothing", None

    def begin(self):
        self.log.append("begin")
        if self.count == 0:
            raise NoAnswerError("nobody")
        return self.count

    def close(self):
        self.log.append("close")

    def status(self, position):
        return SlaveStatus(self.states[position], False, 0)

    def recover(self, position):
        self.log.append(("recover", position))
        if position in self.errors:
            error = self.errors[position]
            if isinstance(error, list):
                error = error.pop(0) if error else None
            if error:
                raise error
        self.states[position] = PRE_OP
        return position in self.restarted

    def map(self, sizes):
        self.log.append(("map", list(sizes)))
        for position in sizes:
            self.states[position] = SAFE_OP

    def operate(self, positions, exchange, timeout):
        self.log.append(("operate", positions, exchange is not None))
        for position in positions:
            self.states[position] = OP

    def leave_op(self, position):
        self.log.append(("leave", position))
        self.states[position] = PRE_OP

    def exchange(self, outputs, timeout):
        self.log.append(("exchange", [one.hex() for one in outputs], timeout))
        return self.rows.pop(0) if self.rows else [bytes(4)] * len(outputs)

    def upload(self, position, index, sub, timeout):
        self.log.append(("upload", position, index, sub, timeout))
        return self._answer(self.objects.get((index, sub), b"\1\0" if index in (0x6040, 0x6840) else b"\0"))

    def download(self, position, index, sub, data, timeout):
        self.log.append(("download", position, index, sub, data, timeout))
        self._answer(self.objects.get(("w", index, sub)))

    @staticmethod
    def _answer(found):
        found = found.pop(0) if isinstance(found, list) else found
        if isinstance(found, Exception):
            raise found
        return found

    def post(self, position, index, sub, data):
        self.log.append(("post", position, index, sub, data))

    def register(self, position, address, size):
        self.log.append(("register", position, address, size))
        found = self.registers[address]
        return found.pop(0) if isinstance(found, list) else found

    def write_register(self, position, address, data):
        self.log.append(("write", position, address, data))

    def take_emergencies(self):
        return self.emergencies

    def take(self):
        taken, self.log = [one for one in self.log if one[0] not in ("upload", "download")], []
        return taken


@pytest.fixture
def master():
    return Master()


def linked(master, drive, lockstep=True, sync0=False):
    found = EtherCatLink(master, (1, 3), drive, lockstep, sync0)
    master.log.clear()
    return found


@pytest.fixture
def link(master, drive, clock):
    return linked(master, drive)


# --- opening ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("count", "said"), [
    (1, "^there is no position 1: 1 slave answers; count from 0, or look with `drive-env scan`$"),
    (3, "^there is no position 3: 3 slaves answer; count from 0"),
])  # fmt: skip
def test_positions_that_are_not_there_are_told_and_the_segment_let_go(drive, count, said):
    master = Master(count)
    with pytest.raises(BusError, match=said):
        EtherCatLink(master, (1, 3), drive, True)
    assert master.log == ["begin", "close"] and master.clock is None


def test_nobody_there_lets_go_of_the_segment(drive):
    master = Master(0)
    with pytest.raises(NoAnswerError):
        EtherCatLink(master, (0,), drive, True)
    assert master.log == ["begin", "close"]


def test_distributed_clocks_are_those_of_all_slaves_with_the_drive_s_cycle(drive):
    master = Master(4)
    link = EtherCatLink(master, (1, 3), drive, False, sync0=True)
    assert master.clock == Sync0(0.001, False) and link.process.phase is not None
    assert [one for one in master.log if one != "begin"] == [("register", k, 0x0008, 2) for k in range(4)]
    assert EtherCatLink(master, (1,), drive, True).process.phase is None and master.clock is None
    master.registers[0x0008] = b"\xfb\xff"
    with pytest.raises(BusError, match=r"^position 0 has no distributed clocks; open it without sync0$"):
        EtherCatLink(master, (1, 3), drive, False, sync0=True)


# --- states -----------------------------------------------------------------------------------------------------------
def test_a_start_gives_images_and_goes_to_op_once(link, master):
    link.start()
    assert master.take() == [("recover", 1), ("recover", 3), ("map", [1, 3]), ("operate", (1, 3), False)]
    assert link.states() == [OP, OP]
    link.start()
    assert master.take() == []
    master.states[3] = SAFE_OP
    link.start()
    assert master.take() == [("operate", (3,), False)]


def test_a_slave_that_has_lost_its_images_gets_them_anew(link, master):
    told = []
    link.hear(lambda: None, told.append)
    link.start()
    master.take()
    master.states[3], master.restarted = 1, {3}
    link.start()
    assert [one for one in master.take() if one[0] not in ("write",)] == [
        ("recover", 3), ("map", [1, 3]), ("operate", (1, 3), False)
    ]  # fmt: skip
    assert told == [1], "it has restarted by itself: number 1 of ours"


@pytest.mark.parametrize(("state", "recovers"), [(0, True), (1, True), (3, True), (2, False), (4, False), (8, False)])
def test_a_slave_is_woken_where_its_mailbox_does_not_answer(link, master, state, recovers):
    master.states[3] = state
    link.wake(1)
    assert master.take() == ([("recover", 3)] if recovers else [])


def test_a_reset_is_three_letters_and_a_wait_until_it_is_back(link, master, clock):
    link.start()
    master.take()
    told = []
    link.hear(lambda: None, told.append)
    master.states[3], master.errors = 0, {3: [NoAnswerError("not yet")] * 2}
    link.reset([1])
    assert master.take() == [("write", 3, 0x0040, b"R"), ("write", 3, 0x0040, b"E"), ("write", 3, 0x0040, b"S"),
                             *[("recover", 3)] * 3]  # fmt: skip
    assert clock.slept == [0.001] * 2 and link.process.missing == [1]
    assert told == [], "this program reset it"


@pytest.mark.parametrize("state", [2, 3, 4, 8])
def test_a_slave_that_does_not_restart_is_told(link, master, state):
    master.states[3] = state
    with pytest.raises(BusError, match=r"^position 3 does not restart by its reset register; switch it off and on$"):
        link.reset([1])
    master.states[3] = 1
    link.reset([1])


def test_a_slave_that_does_not_come_back_is_told_after_10_s(link, master, clock, monkeypatch):
    monkeypatch.setattr(ethercat_link, "LOOK", 0.5)
    master.states[1], master.errors = 0, {1: NoAnswerError("it is silent")}
    with pytest.raises(NoAnswerError, match=r"^it is silent$"):
        link.reset([0])
    assert clock.now == 1010.5, "at 1010.0 the time is not over"


def test_another_master_is_noticed_by_the_states(link, master):
    others = link.other_masters()
    others.check()
    master.states[3] = OP
    with pytest.raises(
        BusError, match=r"^position 3 is in Op, and this program took it to Pre-Op: another master uses"
    ):
        others.check()
    link.start()
    others.check()
    master.states[1] = SAFE_OP
    with pytest.raises(
        BusError, match=r"^position 1 is in Safe-Op, and this program took it to Op: another master uses"
    ):
        others.check()


def test_emergencies_are_those_of_our_slaves(link, master):
    ours = [ReceivedEmergency(3, 0x8611, 0x20, ()), ReceivedEmergency(1, 0, 0, ())]
    master.emergencies = [ours[0], ReceivedEmergency(2, 0x8611, 0x20, ()), ours[1]]
    assert link.take_emergencies() == ours


@pytest.mark.parametrize(("times", "passes"), [
    ([b"\1", b"\2"], True), ([b"\1", b"\1"], False), ([None, b"\1"], None), ([b"\1", None], None),
])  # fmt: skip
def test_whether_time_passes_is_seen_by_the_first_slave_s_clock(link, master, clock, times, passes):
    master.registers[0x0910] = [None if one is None else bytes(bytearray(one)) for one in times]
    assert link.time_passes() is passes
    assert master.take() == [("register", 1, 0x0910, 8)] * 2 and clock.slept == [0.012]


# --- cycles -----------------------------------------------------------------------------------------------------------
def test_a_sync_exchanges_images_of_a_cycle(link, master, drive):
    """In lockstep a frame may take as long as an answer; in real time 20 ms."""
    link.start()
    master.take()
    link.sync()
    assert master.take() == [("exchange", ["01000100"] * 2, 0.5)] and link.process.owed == 0
    master.rows = [[None] * 2] * 2
    link.sync()
    assert link.process.owed == 1
    link.sync()
    link.sync()
    assert link.process.owed == 0 and len(master.take()) == 2 + 3
    master = Master()
    link = linked(master, drive, lockstep=False)
    link.start()
    assert ("operate", (1, 3), True) in master.take()
    link.sync()
    assert master.take()[-1][2] == 0.02


def test_what_did_not_come_back_is_waited_for(link, master, clock):
    link.start()
    link.process.owed, master.rows = 1, [[None] * 2] * 3
    assert link.wait(lambda: link.process.owed == 0, 1.0)
    assert clock.slept == [0.001] * 3
    assert not link.wait(lambda: clock.sleep(0.5), 1.0)
    assert clock.now == pytest.approx(1000.003 + 1.5), "at 1.0 s the time is not over"


def test_a_wait_for_nothing_sleeps(link, clock):
    assert link.receive() is False and clock.slept == []
    assert link.receive(0.25) is False and clock.slept == [0.25]
    link.drain()
    assert link.is_dry is False


@pytest.mark.parametrize(("lockstep", "idle", "exchanges"), [
    (False, 0.033, 0), (False, 0.034, 1), (True, 10.0, 0),  # a third of the watchdogs' 100 ms
])  # fmt: skip
def test_while_an_answer_is_waited_for_images_keep_watchdogs_quiet(master, drive, clock, lockstep, idle, exchanges):
    link = linked(master, drive, lockstep)
    told = []
    link.hear(lambda: told.append(1), lambda node: None)
    link.start()
    master.take()
    link.process.exchanged_at = clock.now - idle
    samples = link.process.samples()
    master.alive()
    assert told == [1] and len(master.take()) == exchanges and samples.complete() == 0


def test_who_waits_for_an_answer_does_not_wait_for_the_images_too(master, drive, clock):
    """Two threads waited for each other for ever: one gave images by the mailbox, the other asked by it meanwhile."""
    link = linked(master, drive, lockstep=False)
    clock.now += 60.0
    with link.process.turn:
        asking = threading.Thread(target=link._while_waiting, daemon=True)
        asking.start()
        asking.join(5.0)
        assert not asking.is_alive()


def test_the_end_lets_go_of_the_segment(link, master):
    link.close()
    assert master.take() == ["close"]


def test_a_drive_without_a_controlword_has_none(drive):
    bare = described(small_eds([(0x6041, "Statusword", U16, "ro", 1)], []), 1)
    assert ethercat_link._controlwords(bare) == set()
    assert ethercat_link._controlwords(drive) == {(0x6040, 0), (0x6840, 0)}


# --- objects ----------------------------------------------------------------------------------------------------------
class Data:
    """Output images: what is put into one is noted; 6071h is in none."""

    def __init__(self):
        self.log = []

    def put(self, node, key, data):
        self.log.append(("put", node, key, data))
        return None if key == (0x6071, 0) else b"before"

    def exchange(self, *, is_cycle):
        self.log.append(("exchange", is_cycle))


@pytest.fixture
def data():
    return Data()


def client(master, data, lockstep=False):
    return SlaveObjects(
        master, 0, 3, data, {(0x6840, 0)}, lambda: data.log.append("operate"), lambda: data.log.append("wake"), lockstep
    )


def test_a_read_is_told_by_position_and_name(master, data):
    sdo = client(master, data)
    master.objects[0x6064, 0] = b"\1\2\3\4"
    assert sdo.read(0x6064, 0, "Position", 0.5) == b"\1\2\3\4"
    assert master.log == [("upload", 3, 0x6064, 0, 0.5)]
    master.objects[0x6064, 0] = [SdoAbortError(0x06020000, "none"), NoAnswerError("silent"), BusError("damaged")]
    with pytest.raises(ObjectAccessError, match=r"position 3.*the read of Position") as error:
        sdo.read(0x6064, 0, "Position", 0.5)
    assert error.value.abort_code == 0x06020000
    with pytest.raises(NoAnswerError, match=r"^position 3 did not answer the read of Position within 0.5 s; check its"):
        sdo.read(0x6064, 0, "Position", 0.5)
    with pytest.raises(BusError, match=r"^position 3, the read of Position: damaged$"):
        sdo.read(0x6064, 0, "Position", 0.5)


def test_a_write_is_in_the_image_before_it_is_sent(master, data):
    sdo = client(master, data)
    sdo.write(0x6064, 2, b"\1\0", "Position", 0.5)
    assert data.log == [("put", 0, (0x6064, 2), b"\1\0")]
    assert master.log == [("download", 3, 0x6064, 2, b"\1\0", 0.5)]


@pytest.mark.parametrize(("key", "put_back"), [((0x6064, 0), True), ((0x6071, 0), False)])
def test_what_the_drive_refuses_is_taken_out_of_the_image(master, data, key, put_back):
    master.objects["w", *key] = SdoAbortError(0x06090030, "none")
    with pytest.raises(ObjectAccessError, match="the write of It"):
        client(master, data).write(*key, b"\1\0", "It", 0.5)
    assert data.log == [("put", 0, key, b"\1\0"), *([("put", 0, key, b"before")] if put_back else [])]


@pytest.mark.parametrize(("key", "word", "operates"), [
    ((0x6840, 0), b"\x0f\0", True), ((0x6840, 0), b"\x07\0", False), ((0x6040, 0), b"\x0f\0", False),
])  # fmt: skip
def test_a_controlword_that_enables_wants_op(master, data, key, word, operates):
    client(master, data).write(*key, word, "Controlword", 0.5)
    assert (data.log[0] == "operate") is operates


def test_putting_back_wakes_a_silent_slave(master, data):
    master.objects["w", 0x6064, 0] = [NoAnswerError("silent"), None]
    client(master, data).put_back(0x6064, 0, b"\1", "Position", 0.5)
    assert data.log.count("wake") == 1 and len(master.log) == 2
    master.objects["w", 0x6064, 0] = [SdoAbortError(0x06090030, "none")]
    with pytest.raises(ObjectAccessError):
        client(master, data).put_back(0x6064, 0, b"\1", "Position", 0.5)
    assert data.log.count("wake") == 1


def test_a_look_says_nothing_of_what_went_wrong(master, data):
    master.objects[0x6041, 0] = [b"\x37\2", NoAnswerError("silent"), SdoAbortError(0x06020000, "none")]
    sdo = client(master, data)
    assert [sdo.ask(0x6041, 0, 0.1) for _ in range(3)] == [b"\x37\2", None, None]


@pytest.mark.parametrize(("lockstep", "index", "posted"), [
    (False, 0x6040, False), (False, 0x6071, True), (True, 0x6040, True),  # in lockstep an exchange would be a cycle
])  # fmt: skip
def test_a_command_goes_out_at_once_in_the_image_or_by_the_mailbox(master, data, lockstep, index, posted):
    client(master, data, lockstep).command(index, 0, b"\6\0")
    assert data.log[0] == ("put", 0, (index, 0), b"\6\0")
    assert (data.log[1:] == [("exchange", False)]) is not posted
    assert master.log == ([("post", 3, index, 0, b"\6\0")] if posted else [])


# --- clocks -----------------------------------------------------------------------------------------------------------
class Registers:
    """The registers of slaves, by position; SYNC0 starts late so many times."""

    def __init__(self, late=0, now=0):
        self.late, self.now, self.writes, self.found = late, now, [], {}

    def register(self, position, address, size):
        found = self._register(position, address)
        return None if found is None else found[:size]

    def _register(self, position, address):
        if (position, address) in self.found:
            return self.found[position, address]
        if address == 0x0910:
            return (self.now % (1 << 64)).to_bytes(8, "little") + b"\xff"
        if address == 0x0984:
            self.late -= position == 5
            return b"\xfb\xff" if self.late < 0 or position != 5 else b"\x04\xff"
        return None

    def write_register(self, position, address, data):
        self.writes.append((position, address, int.from_bytes(data, "little"), len(data)))


@pytest.mark.parametrize(("features", "has"), [(b"\x04\0", True), (b"\xfb\xff", False), (None, False)])
def test_a_clock_is_bit_2_of_the_features(features, has):
    found = Registers()
    found.found = {(3, 0x0008): features, (4, 0x0008): b"\xcc\0"}
    if has:
        check_clocks(found, [4, 3])
    else:
        with pytest.raises(BusError, match=r"^position 3 has no distributed clocks; open it without sync0$"):
            check_clocks(found, [4, 3])


@pytest.mark.parametrize(("lockstep", "now", "start"), [
    (True, 0, 2_000_000), (True, 1_999_999, 2_000_000), (True, 2_000_000, 4_000_000),
    (False, 0, 102_000_000), (False, 1_999_999, 102_000_000), (False, 2_000_000, 104_000_000),
    (True, (1 << 64) - 1, 448_384),  # the clock wraps: 2^64 is no multiple of 2 ms
])  # fmt: skip
def test_sync0_starts_at_a_multiple_of_its_cycle_that_is_to_come(lockstep, now, start):
    found = Registers(now=now)
    start_sync0(found, [3, 4], Sync0(0.002, lockstep))
    rows = [[(k, 0x0990, start, 8), (k, 0x09A0, 2_000_000, 4), (k, 0x0981, 3, 1)] for k in (3, 4)]
    assert found.writes == [(3, 0x0981, 0, 1), (4, 0x0981, 0, 1), *rows[0], *rows[1]]


def test_a_start_that_was_too_late_is_tried_again_twice_as_far_ahead():
    found = Registers(late=4)
    start_sync0(found, [5], Sync0(0.001, False))
    assert [value for _, address, value, _ in found.writes if address == 0x0990] == [
        101_000_000, 201_000_000, 401_000_000, 801_000_000, 1_601_000_000
    ]  # fmt: skip


@pytest.mark.parametrize(("lockstep", "starts"), [(False, 5), (True, 1)])
def test_sync0_that_does_not_start_is_told(lockstep, starts):
    found = Registers(late=100)
    with pytest.raises(BusError, match=r"^SYNC0 of position 5 does not start; this computer or the cable is too slow$"):
        start_sync0(found, [3, 5], Sync0(0.001, lockstep))
    assert sum(address == 0x0990 and k == 5 for k, address, _, _ in found.writes) == starts


def test_clocks_of_slaves_that_do_not_answer_are_told():
    found = Registers()
    with pytest.raises(NoAnswerError, match=r"^position 0 does not answer; check cable and power$"):
        set_offsets(found, 2)
    found.found[0, 0x0910] = None
    with pytest.raises(NoAnswerError, match=r"^position 0 does not answer; check cable and power$"):
        start_sync0(found, [3], Sync0(0.001, True))


def test_offsets_by_the_times_at_which_a_frame_came():
    """The first slave's local time is 100 when the frame is there, the second's 1000; the way is 25 ns."""
    found = Registers()
    far = 1 << 56  # the eighth byte of a time of 64 bits

    def times(forth, back, unit):
        return b"".join(one.to_bytes(4, "little") for one in (forth, back, 9, 9, 9, 9)) + unit.to_bytes(8, "little")

    found.found = {(0, 0x0900): times(100, 160, 100), (1, 0x0900): times(1000, 1010, 1000),
                   (2, 0x0900): times(7, 99, far + 7)}  # fmt: skip
    set_offsets(found, 3)
    assert found.writes == [
        (0, 0x0920, 0, 8), (0, 0x0928, 0, 4),
        (1, 0x0920, (1 << 64) - 900 + 25, 8), (1, 0x0928, 25, 4),
        (2, 0x0920, (1 << 64) - far + 93 + 30, 8), (2, 0x0928, 30, 4),
    ]  # fmt: skip


# --- what a slave's state is called -----------------------------------------------------------------------------------
def test_states_have_names():
    assert [state_name(k) for k in (1, 2, 3, 4, 8, 0, 5, 15)] == [
        "Init", "Pre-Op", "Bootstrap", "Safe-Op", "Op", "state 0", "state 5", "state 15"
    ]  # fmt: skip


@pytest.mark.parametrize(("status", "said"), [
    (SlaveStatus(0, False, 0), "position 3 does not answer; check cable and power"),
    (SlaveStatus(2, True, 0), "position 3 stays in Pre-Op and does not come to Op; it gives no reason"),
    (SlaveStatus(4, True, AlStatusCode.SM_WATCHDOG), "position 3 stays in Safe-Op and does not come to Op; AL "
     "status code 001Bh: no process data came within its watchdog"),
    (SlaveStatus(4, True, 0x8001), "position 3 stays in Safe-Op and does not come to Op; AL status code 8001h: see the "
     "drive's manual"),
])  # fmt: skip
def test_why_a_slave_does_not_come(status, said):
    assert refusal(3, AlState.OP, status) == said


# --- ways of frames ---------------------------------------------------------------------------------------------------
def test_a_segment_of_this_process_is_called():
    seen = []
    way = CallWay(lambda frame: seen.append(frame) or (frame[:14] + b"answer" if len(seen) != 2 else None))
    for _ in range(3):
        way.send(b"asked")
    head = bytes.fromhex("FF FF FF FF FF FF 01 01 01 01 01 01 88 A4")
    assert seen[0] == (head + b"asked").ljust(60, b"\0")
    assert [way.receive(0.0) for _ in range(3)] == [b"answer", b"answer", None]
    way.send(b"asked")
    way.close()
    assert way.receive(0.0) is None


def test_udp_carries_payloads_and_a_wait_ends():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        other.settimeout(10.0)
        way = UdpWay(other.getsockname()[1])
        assert way.name == f"127.0.0.1:{other.getsockname()[1]}"
        assert way.receive(0.0) is None
        way.send(b"asked")
        data, address = other.recvfrom(2000)
        assert data == b"asked"
        other.sendto(bytes(range(256)) * 5, address)
        assert way.receive(10.0) == bytes(range(256)) * 5
    way.send(b"nobody is there")
    slept = []
    patched = SimpleNamespace(sleep=slept.append)
    before, frame_ways.time = frame_ways.time, patched
    try:
        assert way.receive(10.0) is None, "that is no error: it may come"
    finally:
        frame_ways.time = before
    assert slept == [0.001]
    way.close()


class Raw:
    """A raw socket of this test."""

    def __init__(self, error=None):
        self.error, self.sent, self.open = error, [], True

    def bind(self, address):
        if self.error:
            raise self.error
        self.bound = address

    def setblocking(self, blocks):
        self.blocks = blocks

    def send(self, data):
        if self.sent:
            raise OSError
        self.sent.append(data)

    def close(self):
        self.open = False


def test_a_raw_socket_is_bound_to_the_interface_and_ethercat(monkeypatch):
    found, asked = Raw(), []
    fake = SimpleNamespace(
        AF_PACKET=17, SOCK_RAW=3, htons=socket.htons, socket=lambda *what: asked.append(what) or found
    )
    monkeypatch.setattr(frame_ways, "socket", fake)
    way = RawWay("veth0")
    assert asked == [(17, 3, socket.htons(0x88A4))] and found.bound == ("veth0", 0x88A4) and found.blocks is False
    way.send(b"asked")
    way.send(b"lost: the interface is down")
    head = datagrams.BROADCAST + datagrams.MASTER + b"\x88\xa4"
    assert found.sent == [(head + b"asked").ljust(60, b"\0")]
    monkeypatch.setattr(frame_ways, "_receive", lambda sock, timeout: {0.5: head + b"answer"}.get(timeout))
    assert way.receive(0.5) == b"answer" and way.receive(0.25) is None
    way.close()
    assert not found.open


def test_an_interface_that_cannot_be_opened_is_told(monkeypatch):
    found = Raw(OSError(19, "No such device"))
    fake = SimpleNamespace(AF_PACKET=17, SOCK_RAW=3, htons=socket.htons, socket=lambda *what: found,
                           if_nameindex=lambda: [(1, "lo"), (2, "eth0")])  # fmt: skip
    monkeypatch.setattr(frame_ways, "socket", fake)
    with pytest.raises(OpenError, match=r"^veth0 cannot be opened: No such device; there are lo, eth0$"):
        RawWay("veth0")
    assert not found.open
    monkeypatch.setattr(frame_ways, "socket", SimpleNamespace())
    with pytest.raises(OpenError, match=r"has no raw sockets for veth0; use --interface ethercat-udp$"):
        RawWay("veth0")
