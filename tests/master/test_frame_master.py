"""The master of its own, by the datagrams that it sends and what it makes of those that come back (ETG.1000.4).

Transcripts have a datagram in each line: `W station register bytes`, `R station register length`; EEPROM: words asked.
"""

from __future__ import annotations

import struct
from types import SimpleNamespace

import pytest
from rigs.clock import Clock
from rigs.ethercat_rig import Rig, category

from drive_env.ethercat import datagrams
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.ethercat.datagrams import DatagramCommand, at_station
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.ethercat import frame_master, state_names
from drive_env.master.ethercat.ethercat_master import ImageSizes, SlaveIdentity, SlaveStatus, Sync0
from drive_env.master.ethercat.frame_master import FrameMaster

SIZES = ImageSizes(4, 6)
WORDS = 0x0502
SILENT = "{}: no slave answers on the cable; check cable, power and channel"


class Way:
    """A cable that notes what is sent, and may lose or change what comes back."""

    name = "the cable"

    def __init__(self, receive):
        self._receive = receive
        self.sent, self.came, self.waits, self.is_open = [], [], [], True
        self.change = lambda asked, found: [found]
        self.takes = lambda: None

    def send(self, payload):
        asked = datagrams.read(payload, 0)
        self.sent.append(asked)
        self.came += [one for one in self.change(asked, self._receive(payload)) if one is not None]

    def receive(self, timeout):
        self.waits.append(timeout)
        self.takes()
        return self.came.pop(0) if self.came else None

    def close(self):
        self.is_open = False

    def take(self):
        """Return the frames since the last call, a line each."""
        taken, self.sent = [" + ".join(map(line, frame)) for frame in self.sent], []
        return taken


def line(one):
    station, register = one.address & 0xFFFF, one.address >> 16
    kind = DatagramCommand(one.command).name
    if register == WORDS:
        asked = one.data.hex(" ").upper().replace("00 01 ", "").replace(" 00 00 00", "") if any(one.data) else ""
        return f"{kind} {station:04X} word {asked}".rstrip()
    content = one.data.hex(" ").upper() if any(one.data) or kind.endswith("WR") else str(len(one.data))
    return f"{kind} {station:04X} {register:04X} {content}"


def split(text):
    return [row.strip() for row in text.splitlines() if row.strip()]


@pytest.fixture
def rig():
    return Rig(2)


@pytest.fixture
def way(rig):
    return Way(rig.world.receive_payload)


@pytest.fixture
def master(way):
    found = FrameMaster(way)
    found.begin()
    way.sent.clear()
    return found


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(frame_master, "time", found)
    monkeypatch.setattr(state_names, "time", found)
    return found


# --- frames -----------------------------------------------------------------------------------------------------------
def test_frames_have_numbers_from_1_that_wrap_at_256(way):
    master = FrameMaster(way)
    for _ in range(257):
        master.register(0, 0x0130, 2)
    assert [frame[0].number for frame in way.sent] == [*range(1, 256), 0, 1]


@pytest.mark.parametrize("other", [
    lambda one: one._replace(number=one.number + 1), lambda one: one._replace(number=one.number - 1),
    lambda one: one._replace(command=DatagramCommand.FPWR), lambda one: one._replace(command=DatagramCommand.APRD),
    lambda one: one._replace(data=one.data + b"\0"), lambda one: one._replace(data=one.data[:-1]),
])  # fmt: skip
def test_a_frame_that_was_not_asked_for_is_not_taken_for_the_answer(rig, way, master, clock, other):
    def after_others(asked, found):
        return [datagrams.build([other(datagrams.read(found, 0)[0])]), b"\0", found]

    way.waits.clear()
    way.change, way.takes = after_others, lambda: clock.sleep(0.005)
    assert master.register(0, 0x0012, 2) == b"\x77\x07"
    assert way.waits == pytest.approx([0.02, 0.015, 0.01]), "of the 20 ms some have passed"


def test_a_frame_that_is_late_is_taken_where_it_waits(way, master, clock):
    way.waits.clear()
    way.change, way.takes = lambda asked, found: [b"\0", found], lambda: clock.sleep(0.03)
    assert master.register(0, 0x0012, 2) == b"\x77\x07"
    assert way.waits == [pytest.approx(0.02), 0.0]


def test_the_wait_for_a_frame_is_given(way, clock):
    assert FrameMaster(way, frame_timeout=0.5).register(0, 0x0130, 2) is None  # it has no address yet
    assert way.waits == [0.5]


def test_a_register_is_asked_five_times_where_frames_are_lost(rig, way, master):
    way.change = lambda asked, found: [found] if len(way.sent) == 5 else []
    assert master.register(1, 0x0010, 2) == b"\x02\x10"
    assert way.take() == ["FPRD 1002 0010 2"] * 5
    way.change = lambda asked, found: []
    assert master.register(1, 0x0010, 2) is None
    assert way.take() == ["FPRD 1002 0010 2"] * 5
    assert master.status(1) == SlaveStatus(0, False, 0)


def test_a_register_of_nobody_is_asked_once(way, master):
    assert master.register(2, 0x0010, 2) is None
    assert way.take() == ["FPRD 1003 0010 2"]


@pytest.mark.parametrize("lost", [True, False], ids=["frames are lost", "nobody has them"])
@pytest.mark.parametrize("tries", [50, 51])
def test_what_may_be_done_twice_is_tried_fifty_times(way, master, lost, tries):
    """Meanwhile the program is told that it waits."""
    told = []
    master.alive = lambda: told.append(len(way.sent))

    def only_the_last(asked, found):
        if len(way.sent) == tries:
            return [found]
        return [] if lost else [datagrams.build([one._replace(counter=0) for one in datagrams.read(found, 0)])]

    way.change = only_the_last
    if tries > 50:
        with pytest.raises(NoAnswerError, match=f"^{SILENT.format('position 1')}$"):
            master.write_register(1, 0x0981, b"\x03")
    else:
        master.write_register(1, 0x0981, b"\x03")
    assert way.take() == ["FPWR 1002 0981 03"] * 50
    assert told == list(range(1, tries))


def test_what_is_read_surely_is_told_by_its_position(way, master):
    way.change = lambda asked, found: []
    with pytest.raises(NoAnswerError, match=f"^{SILENT.format('position 0')}$"):
        master.leave_op(0)
    assert way.take() == ["FPWR 1001 0120 12 00"] * 50


@pytest.mark.parametrize("lost", [True, False], ids=["frames are lost", "no slaves"])
def test_slaves_are_counted_by_a_broadcast_that_is_tried_fifty_times(way, lost):
    master = FrameMaster(way)

    def nothing(asked):
        return [] if lost else [datagrams.build(asked)]

    way.change = lambda asked, found: [found] if len(way.sent) >= 50 else nothing(asked)
    assert len(master.look()) == 2
    assert way.take()[:51] == ["BRD 0000 0130 2"] * 50 + ["APRD 0000 0130 6"]
    way.change = lambda asked, found: nothing(asked)
    with pytest.raises(NoAnswerError, match=r"^no slave answers on the cable; check cable, power and channel$"):
        master.begin()
    assert len(way.sent) == 50


# --- slaves -----------------------------------------------------------------------------------------------------------
def test_a_look_changes_no_slave(rig, way):
    master = FrameMaster(way)
    assert [frame[:0] for frame in master.look()] == [()] * 2
    assert way.take() == split("""
        BRD 0000 0130 2
        APRD 0000 0130 6
        APRD 0000 0500 1
        APWR 0000 0500 00
        APWR 0000 word 08
        APRD 0000 word
        APWR 0000 word 0A
        APRD 0000 word
        APWR 0000 word 0C
        APRD 0000 word
        APWR 0000 word 0E
        APRD 0000 word
        APWR 0000 0500 00
        APRD FFFF 0130 6
        APRD FFFF 0500 1
        APWR FFFF 0500 00
        APWR FFFF word 08
        APRD FFFF word
        APWR FFFF word 0A
        APRD FFFF word
        APWR FFFF word 0C
        APRD FFFF word
        APWR FFFF word 0E
        APRD FFFF word
        APWR FFFF 0500 00
    """)
    identity = SlaveIdentity(0x1234, 0x5678, 1, 42)
    assert master.look() == [(SlaveStatus(AlState.INIT, False, 0), identity)] * 2
    rig.address()
    assert rig.request(4, 0x1002) == (0x11, AlStatusCode.INVALID_CHANGE)
    assert master.look()[1] == (SlaveStatus(AlState.INIT, True, 0x0011), identity)


def test_a_look_reads_an_eeprom_that_was_left_to_the_device_and_leaves_it_so(rig, way, clock):
    rig.address()
    rig.write(0x0500, "01", station=0x1002)
    assert FrameMaster(way).look()[1][1] == SlaveIdentity(0x1234, 0x5678, 1, 42)
    assert rig.read(0x0500, 1, station=0x1002) == b"\1" and rig.read(0x0500, 1) == b"\0"
    rig.write(0x0500, "01")
    way.change = busy(10**6)
    with pytest.raises(NoAnswerError, match="stays busy"):
        FrameMaster(way).look()
    assert rig.read(0x0500, 1) == b"\1", "also where it could not be read"


def test_words_of_another_address_are_not_taken(way, clock):
    """A slave may answer the look before it has the request: what its registers hold is of the one before."""
    late = []

    def change(asked, found):
        rows = datagrams.read(found, 0)
        if rows[0].address >> 16 == WORDS and len(rows[0].data) == 10 and len(late) < 2:
            late.append(rows[0])
            rows[0] = rows[0]._replace(data=b"\x40\0" + struct.pack("<I", 7) + b"else")
        return [datagrams.build(rows)]

    way.change = change
    assert [identity for _, identity in FrameMaster(way).look()] == [SlaveIdentity(0x1234, 0x5678, 1, 42)] * 2
    assert clock.slept == [0.001] * 2


BEGIN = """
    APWR {line} 0010 0{k} 10
    FPWR 100{k} 0120 11 00
    FPRD 100{k} 0130 6
    FPWR 100{k} 0500 00
    FPWR 100{k} word 40
    FPRD 100{k} word
    FPWR 100{k} word 45
    FPRD 100{k} word
    FPWR 100{k} word 57
    FPRD 100{k} word
    FPWR 100{k} word 5B
    FPRD 100{k} word
    FPWR 100{k} word 5D
    FPRD 100{k} word
    FPWR 100{k} word 5F
    FPRD 100{k} word
    FPWR 100{k} word 61
    FPRD 100{k} word
    FPWR 100{k} word 63
    FPRD 100{k} word
    FPWR 100{k} word 65
    FPRD 100{k} word
    FPWR 100{k} word 67
    FPRD 100{k} word
    FPWR 100{k} word 69
    FPRD 100{k} word
    FPWR 100{k} word 6B
    FPRD 100{k} word
    FPWR 100{k} word 08
    FPRD 100{k} word
    FPWR 100{k} word 0A
    FPRD 100{k} word
    FPWR 100{k} word 0C
    FPRD 100{k} word
    FPWR 100{k} word 0E
    FPRD 100{k} word
    FPWR 100{k} word 18
    FPRD 100{k} word
    FPWR 100{k} word 1A
    FPRD 100{k} word
"""
OPEN_MAILBOX = """
    FPWR 100{k} 0800 00 00 00 00 00 00 00 00
    FPWR 100{k} 0808 00 00 00 00 00 00 00 00
    FPWR 100{k} 0810 00 00 00 00 00 00 00 00
    FPWR 100{k} 0818 00 00 00 00 00 00 00 00
    FPWR 100{k} 0800 00 10 40 00 26 00 01 00
    FPWR 100{k} 0808 80 10 40 00 22 00 01 00
    FPWR 100{k} 0120 12 00
    FPRD 100{k} 0130 6
"""


def test_slaves_get_addresses_and_their_mailboxes_as_their_eeprom_says(rig, way):
    """Init, the list of the EEPROM to its sync managers (word 57h), four rows of them, identity, mailbox; Pre-Op."""
    master = FrameMaster(way)
    assert master.begin() == 2
    rows = [(BEGIN + OPEN_MAILBOX).format(k=k, line=line) for k, line in ((1, "0000"), (2, "FFFF"))]
    assert way.take() == ["BRD 0000 0130 2", *split("".join(rows))]
    found = [master.status(k) for k in range(2)]
    assert found == [SlaveStatus(AlState.PRE_OP, False, 0)] * 2
    assert master.identity(1) == SlaveIdentity(0x1234, 0x5678, 1, 42)


@pytest.mark.parametrize("state", [AlState.PRE_OP, AlState.SAFE_OP, AlState.OP])
def test_a_slave_that_has_its_mailbox_is_taken_to_pre_op(rig, way, master, state):
    master.map({0: SIZES, 1: SIZES})
    if state is AlState.OP:
        master.operate([0, 1], None, 1.0)
    if state is AlState.PRE_OP:
        master.leave_op(1)
    way.sent.clear()
    assert rig.slaves[1].state is state
    assert master.recover(1) is False
    assert way.take() == ["FPRD 1002 0130 6", "FPWR 1002 0120 12 00", "FPRD 1002 0130 6"]
    assert rig.slaves[1].state is AlState.PRE_OP


def test_a_slave_in_init_gets_its_mailbox_anew(way, master):
    master.write_register(1, 0x0120, b"\x11\x00")
    way.sent.clear()
    assert master.recover(1) is False
    assert way.take() == split("FPRD 1002 0130 6\nFPWR 1002 0120 11 00\nFPRD 1002 0130 6" + OPEN_MAILBOX.format(k=2))


def test_a_slave_that_has_restarted_gets_its_address_too(rig, way, master):
    rig.slaves[1].power_on(0.0)
    assert master.recover(1) is True
    assert way.take() == split(
        "FPRD 1002 0130 6\nAPWR FFFF 0010 02 10\nFPWR 1002 0120 11 00\nFPRD 1002 0130 6" + OPEN_MAILBOX.format(k=2)
    )
    assert rig.slaves[1].state is AlState.PRE_OP


def status_of(*answers):
    """A change of what comes back: AL status (and its code) is this, one after another, and the last one for ever."""
    waiting = list(answers)

    def change(asked, found):
        rows = datagrams.read(found, 0)
        for k, one in enumerate(rows):
            if one.address >> 16 == 0x0130:
                state, code = waiting.pop(0) if len(waiting) > 1 else waiting[0]
                rows[k] = one._replace(data=struct.pack("<HHH", state, 0xFFFF, code)[: len(one.data)])
        return [datagrams.build(rows)]

    return change


def test_a_state_is_waited_for(way, master, clock):
    told = []
    master.alive = lambda: told.append(clock.now)
    way.change = status_of((4, 0), (4, 0), (2, 0))
    master.leave_op(0)
    assert way.take() == ["FPWR 1001 0120 12 00"] + ["FPRD 1001 0130 6"] * 3
    assert clock.slept == [0.001] * 2 and len(told) == 2


def test_a_state_is_waited_for_5_s(way, master, clock, monkeypatch):
    monkeypatch.setattr(frame_master, "LOOK", 0.5)
    way.change = status_of((4, 0))
    with pytest.raises(
        BusError, match=r"^position 1 stays in Safe-Op and does not come to Pre-Op; it gives no reason$"
    ):
        master.leave_op(1)
    assert clock.now == 1005.5, "at 1005.0 the time is not over"


@pytest.mark.parametrize("status", [0x12, 0x14])
def test_a_state_that_is_refused_is_not_waited_for(way, master, clock, status):
    way.change = status_of((status, 0x16))
    with pytest.raises(BusError, match=r"AL status code 0016h: its mailbox is not set as its EEPROM says$"):
        master.leave_op(1)
    assert clock.slept == []


def test_of_a_status_four_bits_are_the_state_and_the_fifth_is_the_error(way, master):
    way.change = status_of((0xFFE8, 0), (0x0018, 0x8001))
    assert master.status(0) == SlaveStatus(8, False, 0) and master.status(0) == SlaveStatus(8, True, 0x8001)


# --- EEPROM -----------------------------------------------------------------------------------------------------------
def busy(times):
    """A change of what comes back: the EEPROM is busy for so many looks."""
    left = [times]

    def change(asked, found):
        rows = datagrams.read(found, 0)
        if rows[0].address >> 16 == WORDS and len(rows[0].data) == 10 and left[0] > 0:
            left[0] -= 1
            rows[0] = rows[0]._replace(data=b"\x40\x80" + bytes(8))
        return [datagrams.build(rows)]

    return change


def test_an_eeprom_that_is_busy_is_waited_for(way, clock):
    way.change = busy(3)
    assert [identity for _, identity in FrameMaster(way).look()] == [SlaveIdentity(0x1234, 0x5678, 1, 42)] * 2
    assert clock.slept == [0.001] * 3


def test_an_eeprom_that_may_be_written_is_not_busy(way, clock):
    def may_be_written(asked, found):
        rows = datagrams.read(found, 0)
        if rows[0].address >> 16 == WORDS and len(rows[0].data) == 10:
            rows[0] = rows[0]._replace(data=b"\xff\x7f" + rows[0].data[2:])
        return [datagrams.build(rows)]

    way.change = may_be_written
    FrameMaster(way).look()
    assert clock.slept == [], "bit 15 alone says busy"


def test_an_eeprom_that_stays_busy_is_told_after_5_s(way, clock, monkeypatch):
    monkeypatch.setattr(frame_master, "LOOK", 0.5)
    way.change = busy(10**6)
    with pytest.raises(NoAnswerError, match=r"^the EEPROM of the slave at 0000h stays busy; check its power$"):
        FrameMaster(way).look()
    assert clock.now == 1005.5
    write_of_the_second = at_station(DatagramCommand.APWR, -1, WORDS, b"")
    way.change = lambda asked, found: [] if asked[0][:2] == write_of_the_second[:2] else [found]
    with pytest.raises(NoAnswerError, match=f"^{SILENT.format('the EEPROM of the slave at FFFFh')}$"):
        FrameMaster(way).look()


def with_managers(rig, count, words_before=0):
    """Give the first slave an EEPROM of so many sync managers, behind a category of so many words."""
    rows = [(0x1000, 64, 0x26, 1), (0x1080, 64, 0x22, 2), (0x1100, 4, 0x64, 3), (0x1180, 6, 0x20, 4), (0x1200, 1, 2, 5)]
    managers = b"".join(struct.pack("<HHBBBB", a, n, c, 0x5A, 1, kind) for a, n, c, kind in rows[:count])
    before = category(10, bytes(2 * words_before)) if words_before else b""
    rig.devices[0].content = rig.devices[0].content[:0x80] + before + category(41, managers) + b"\xff" * 512
    rig.slaves[0].power_on(0.0)


def test_the_status_byte_of_a_sync_manager_in_the_eeprom_is_none_of_its_control(rig, way):
    with_managers(rig, 5)
    master = FrameMaster(way)
    master.begin()
    way.sent.clear()
    master.map({0: SIZES})
    assert "FPWR 1001 0810 00 11 04 00 64 00 01 00" in way.take()


@pytest.mark.parametrize("count", [0, 3])
def test_a_drive_has_four_sync_managers(rig, way, count):
    with_managers(rig, count)
    with pytest.raises(BusError, match=f"^position 0: its EEPROM names {count} sync managers; a drive has 4$"):
        FrameMaster(way).begin()


@pytest.mark.parametrize(("at", "found"), [(16_384, 4), (16_385, 0)])
def test_an_eeprom_without_an_end_is_given_up_behind_its_last_word(rig, way, at, found):
    with_managers(rig, 4, at - 0x40 - 2)
    master = FrameMaster(way)
    if found:
        assert master.begin() == 2
    else:
        with pytest.raises(BusError, match="names 0 sync managers"):
            master.begin()


# --- images -----------------------------------------------------------------------------------------------------------
MAP = """
    FPRD 100{k} 0130 6
    FPWR 100{k} 0810 00 00 00 00 00 00 00 00
    FPWR 100{k} 0810 00 11 04 00 64 00 01 00
    FPWR 100{k} 0600 {outputs} 00 01 00 04 00 00 07 00 11 00 02 01 00 00 00
    FPWR 100{k} 0818 00 00 00 00 00 00 00 00
    FPWR 100{k} 0818 80 11 06 00 20 00 01 00
    FPWR 100{k} 0610 {inputs} 00 01 00 06 00 00 07 80 11 00 01 01 00 00 00
    FPWR 100{k} 0120 14 00
    FPRD 100{k} 0130 6
"""


def test_images_lie_one_behind_the_other(way, master):
    """Outputs of a slave (FMMU 0, written) and its inputs (FMMU 1, read), from 10000h on; then Safe-Op."""
    master.map({0: SIZES, 1: SIZES})
    assert way.take() == split(MAP.format(k=1, outputs="00", inputs="04") + MAP.format(k=2, outputs="0A", inputs="0E"))


def test_a_slave_that_has_its_images_keeps_them(way, master):
    master.map({0: SIZES, 1: SIZES})
    master.leave_op(1)
    way.sent.clear()
    master.map({0: SIZES, 1: SIZES})
    assert way.take() == ["FPRD 1001 0130 6", *split(MAP.format(k=2, outputs="0A", inputs="0E"))]


def test_an_image_of_nothing_is_switched_off(rig, way, master):
    rig.devices[1].output_size = 0
    master.map({1: ImageSizes(0, 6)})
    assert way.take()[:7] == split("""
        FPRD 1002 0130 6
        FPWR 1002 0810 00 00 00 00 00 00 00 00
        FPWR 1002 0810 00 11 00 00 64 00 00 00
        FPWR 1002 0600 00 00 01 00 00 00 00 07 00 11 00 02 00 00 00 00
        FPWR 1002 0818 00 00 00 00 00 00 00 00
        FPWR 1002 0818 80 11 06 00 20 00 01 00
        FPWR 1002 0610 00 00 01 00 06 00 00 07 80 11 00 01 01 00 00 00
    """)


def test_all_images_together_have_1400_bytes_at_most(way):
    master = FrameMaster(way)
    master.map({0: ImageSizes(500, 200), 1: ImageSizes(600, 100)})
    with pytest.raises(BusError, match=r"^the images of 2 slaves have 1401 bytes, and a frame 1400; open fewer$"):
        master.map({0: ImageSizes(500, 200), 1: ImageSizes(600, 101)})


def test_clocks_are_set_before_images_and_sync0_starts_in_pre_op_alone(way, master):
    master.map({0: SIZES, 1: SIZES})
    master.leave_op(1)
    way.sent.clear()
    master.clock = Sync0(0.002, True)
    master.map({0: SIZES, 1: SIZES})
    assert way.take() == split("""
        FPRD 1001 0130 6
        FPRD 1002 0130 6
        FPRD 1001 0008 2
        FPRD 1002 0008 2
        BWR 0000 0900 00 00 00 00
        FPRD 1001 0900 32
        FPRD 1002 0900 32
        FPWR 1001 0920 00 00 00 00 00 00 00 00
        FPWR 1001 0928 00 00 00 00
        FPWR 1002 0920 00 00 00 00 00 00 00 00
        FPWR 1002 0928 C2 01 00 00
        FPWR 1002 0981 00
        FPRD 1001 0910 8
        FPWR 1002 0990 80 84 1E 00 00 00 00 00
        FPWR 1002 09A0 80 84 1E 00
        FPWR 1002 0981 03
        FPRD 1002 0984 1
        FPRD 1001 0130 6
    """ + MAP.format(k=2, outputs="0A", inputs="0E"))  # fmt: skip


def test_slaves_are_taken_to_op_while_images_are_exchanged(way, master, clock):
    exchanged, told = [], []
    master.alive = lambda: told.append(clock.now)
    way.change = status_of((4, 0), (4, 0), (4, 0), (8, 0), (8, 0))
    master.operate([0, 1], lambda: exchanged.append(len(way.sent)), 1.0)
    assert way.take() == split("""
        FPRD 1001 0130 6
        FPWR 1001 0120 08 00
        FPRD 1002 0130 6
        FPWR 1002 0120 08 00
        FPRD 1001 0130 6
        FPRD 1002 0130 6
        FPRD 1001 0130 6
        FPRD 1002 0130 6
    """)
    assert exchanged == [6] and len(told) == 1 and clock.slept == [0.001]


def test_an_error_is_acknowledged_in_safe_op_before_op_is_asked_for(way, master, clock):
    way.change = status_of((0x14, 0x1B), (4, 0), (8, 0))
    master.operate([1], None, 1.0)
    assert way.take() == split("""
        FPRD 1002 0130 6
        FPWR 1002 0120 14 00
        FPRD 1002 0130 6
        FPWR 1002 0120 08 00
        FPRD 1002 0130 6
    """)


def test_a_slave_whose_watchdog_was_quicker_than_a_busy_computer_is_asked_again(way, master, clock):
    """Between the request of Op and the first images more than 100 ms went by: it was told as a refusal."""
    way.change = status_of((4, 0), (0x14, 0x1B), (0x14, 0x1B), (4, 0), (8, 0))
    master.operate([0], None, 1.0)
    assert [line for line in way.take() if "FPWR" in line] == split("""
        FPWR 1001 0120 08 00
        FPWR 1001 0120 14 00
        FPWR 1001 0120 08 00
    """)


def test_op_that_does_not_come_in_time_is_told(way, master, clock, monkeypatch):
    monkeypatch.setattr(state_names, "LOOK", 0.5)
    way.change = status_of((4, 0))
    with pytest.raises(BusError, match=r"^position 0 stays in Safe-Op and does not come to Op; it gives no reason$"):
        master.operate([0, 1], None, 1.0)
    assert clock.now == 1001.5


def test_op_that_is_refused_is_told_at_once_and_of_the_slave_that_refuses(way, master, clock):
    way.change = status_of((4, 0), (4, 0), (4, 0), (0x14, 0x1D))
    with pytest.raises(BusError, match=r"^position 1 stays in Safe-Op and does not come to Op; AL status code 001Dh"):
        master.operate([0, 1], None, 1.0)
    assert clock.slept == []


def test_an_exchange_is_one_frame_and_each_slave_has_its_part(rig, way, master):
    master.map({0: SIZES, 1: SIZES})
    master.operate([0, 1], None, 1.0)
    way.sent.clear()
    assert master.exchange([b"abcd", b"efgh"], 0.5) == [bytes(6)] * 2, "what the frame finds was there before it"
    assert master.exchange([b"abcd", b"efgh"], 0.25) == [b"abcd\1\0", b"efgh\1\0"]
    assert way.take()[1] == (
        "LRW 0000 0001 61 62 63 64 00 00 00 00 00 00 65 66 67 68 00 00 00 00 00 00"
        " + FPRD 1001 0130 6 + FPRD 1002 0130 6"
    )
    assert way.waits[-1] == pytest.approx(0.25, abs=0.05)
    assert master.system_time is None
    rig.request(4, 0x1001)
    assert master.exchange([b"abcd", b"efgh"], 0.5)[0] is None, "it is not in Op"
    way.change = lambda asked, found: []
    assert master.exchange([b"abcd", b"efgh"], 0.5) == [None, None]


def test_the_reference_s_time_comes_with_the_images(way, master):
    master.clock = Sync0(0.001, True)
    master.map({0: SIZES})
    master.operate([0], None, 1.0)
    master.exchange([b"abcd"], 0.5)
    master.exchange([b"abcd"], 0.5)
    assert way.take()[-1] == "LRW 0000 0001 61 62 63 64 00 00 00 00 00 00 + FPRD 1001 0130 6 + FRMW 1001 0910 8"
    assert master.system_time == 1_000_000, "a cycle has passed, in ns"


@pytest.mark.parametrize(("sizes", "counter"), [
    ((4, 6), 3), ((0, 6), 1), ((4, 0), 2),  # what is written counts 2, what is read 1
])  # fmt: skip
def test_all_slaves_must_have_had_their_part(sizes, counter):
    counters = [0, 1]

    def answer(payload):
        rows = [one._replace(counter=count) for one, count in zip(datagrams.read(payload, 0), counters, strict=True)]
        rows[1:] = [one._replace(data=b"\x08\0\0\0\0\0") for one in rows[1:]]
        return datagrams.build(rows)

    master = FrameMaster(Way(answer))
    master._mapped = {0: (0x10000, ImageSizes(*sizes))}
    for counters[0] in range(5):
        expected = bytes(sizes[1]) if counters[0] == counter else None
        assert master.exchange([bytes(sizes[0])], 0.5) == [expected]
    counters[:] = counter, 0
    assert master.exchange([bytes(sizes[0])], 0.5) == [None], "its state did not come"


# --- objects ----------------------------------------------------------------------------------------------------------
@pytest.fixture
def answers(rig):
    """Have devices answer each SDO with a first byte, the object that was asked for, and four bytes."""

    def set_first(first, content=b"\x34\x12\0\0"):
        for slave in rig.slaves:
            slave.mailbox._coe = lambda message, now: [b"\x00\x30" + bytes((first,)) + message[3:6] + content]

    return set_first


def test_a_transfer_goes_by_the_slave_s_mailbox(way, master, answers):
    answers(0x4B)
    assert master.upload(1, 0x2005, 1, 1.0) == b"\x34\x12"
    request = "0A 00 00 00 00 13 00 20 40 05 20 01" + " 00" * 52
    assert way.take() == [f"FPWR 1002 1000 {request}", "FPRD 1002 1080 64"]
    answers(0x60, bytes(4))
    master.download(1, 0x2005, 1, b"\x34\x12", 1.0)
    assert way.take()[0].startswith("FPWR 1002 1000 0A 00 00 00 00 23 00 20 2B 05 20 01 34 12 00 00 00")
    master.post(1, 0x6040, 0, b"\x06\x00")
    assert way.take()[0].startswith("FPWR 1002 1000 0A 00 00 00 00 33 00 20 2B 40 60 00 06 00 00 00 00")
    assert len(way.sent) == 0


def test_a_message_whose_frame_is_lost_is_asked_for_again(way, master, answers):
    """Bit 1 of the activation of sync manager 1 changes each time."""
    answers(0x4B)
    way.change = lambda asked, found: [] if 2 <= len(way.sent) <= 5 else [found]
    assert master.upload(0, 0x2005, 1, 1.0) == b"\x34\x12"
    assert way.take()[1:] == split("""
        FPRD 1001 1080 64
        FPWR 1001 080E 03
        FPRD 1001 1080 64
        FPWR 1001 080E 01
        FPRD 1001 1080 64
    """)


def test_emergencies_are_those_of_their_slaves(rig, way, master):
    rig.devices[1].pending = [
        bytes.fromhex("00 10 11 86 20 01 02 03 04 05"),
        bytes.fromhex("00 10 00 00 00 00 00 00 00 00"),
    ]
    rig.world.cycle()
    assert master.take_emergencies() == [(1, 0x8611, 0x20, (1, 2, 3, 4, 5)), (1, 0, 0, (0, 0, 0, 0, 0))]
    assert master.take_emergencies() == []


def test_emergencies_do_not_wait_for_a_transfer_that_is_under_way(master):
    waits = []
    master._mailboxes[0] = SimpleNamespace(look=waits.append, emergencies=[])
    assert master.take_emergencies() == []
    assert waits == [0.0]


# --- the end ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("clock", [None, Sync0(0.001, True)])
def test_the_end_takes_all_slaves_to_init_and_ends_sync0(rig, way, master, clock):
    master.clock = clock
    way.change = lambda asked, found: []
    master.close()
    off = [["FPWR 1001 0981 00"], ["FPWR 1002 0981 00"]] if clock else [[], []]
    assert way.take() == ["FPWR 1001 0120 11 00", *off[0], "FPWR 1002 0120 11 00", *off[1]]
    assert [slave.state for slave in rig.slaves] == [AlState.INIT] * 2 and not way.is_open
