"""Every command of a datagram as a transcript with its working counter (ETG.1000.4, 5.4), and broken frames."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from rigs.ethercat_rig import STATION, Rig
from rigs.thinning import part

from drive_env.ethercat import datagrams, fmmu, registers
from drive_env.ethercat.application import AlState
from drive_env.ethercat.datagrams import Datagram, DatagramCommand, at_station, build_frame

COMMANDS = {
    "NOP": """
        tx NOP  0000 0010  00 00
        rx NOP  0000 0010  00 00  wkc 0
    """,
    "APRD": """
        tx APRD 0000 0000  00                  # type of the first
        rx APRD 0002 0000  11  wkc 1           # two slaves have counted the address up
        tx APRD FFFF 0004  00 00               # FMMUs and sync managers of the second
        rx APRD 0001 0004  08 08  wkc 1
        tx APRD FFFE 0000  00                  # there is no third
        rx APRD 0000 0000  00  wkc 0
    """,
    "APWR": """
        tx APWR FFFF 0010  22 20
        rx APWR 0001 0010  22 20  wkc 1
        tx FPRD 2022 0010  00 00
        rx FPRD 2022 0010  22 20  wkc 1
    """,
    "APRW": """
        tx APRW 0000 0F80  55                  # what was there comes back
        rx APRW 0002 0F80  00  wkc 3
        tx APRW 0000 0F80  66
        rx APRW 0002 0F80  55  wkc 3
    """,
    "FPRD": """
        tx FPRD 1002 0130  00 00
        rx FPRD 1002 0130  01 00  wkc 1
        tx FPRD 1003 0130  00 00
        rx FPRD 1003 0130  00 00  wkc 0
    """,
    "FPWR": """
        tx FPWR 1001 0F80  01 02
        rx FPWR 1001 0F80  01 02  wkc 1
        tx FPWR 1001 0000  FF                  # the type is read-only
        rx FPWR 1001 0000  FF  wkc 0
        tx FPRD 1001 0000  00
        rx FPRD 1001 0000  11  wkc 1
    """,
    "FPRW": """
        tx FPRW 1001 0F80  01 02
        rx FPRW 1001 0F80  00 00  wkc 3
        tx FPRW 1001 0000  FF                  # it reads, and does not write
        rx FPRW 1001 0000  11  wkc 1
    """,
    "BRD": """
        tx BRD  0000 0010  00 00               # 1001h or 1002h
        rx BRD  0002 0010  03 10  wkc 2
        tx BRD  0000 0130  40 00               # what was in the datagram stays
        rx BRD  0002 0130  41 00  wkc 2
    """,
    "BWR": """
        tx BWR  0000 0F80  12
        rx BWR  0002 0F80  12  wkc 2
        tx FPRD 1002 0F80  00
        rx FPRD 1002 0F80  12  wkc 1
    """,
    "BRW": """
        tx BWR  0000 0F80  12
        rx BWR  0002 0F80  12  wkc 2
        tx BRW  0000 0F80  01
        rx BRW  0002 0F80  13  wkc 6
    """,
    "ARMW": """
        tx FPWR 1001 0F80  77
        rx FPWR 1001 0F80  77  wkc 1
        tx ARMW 0000 0F80  00                  # the first is read, the others are written
        rx ARMW 0002 0F80  77  wkc 2
        tx FPRD 1002 0F80  00
        rx FPRD 1002 0F80  77  wkc 1
    """,
    "FRMW": """
        tx FPWR 1001 0F80  88
        rx FPWR 1001 0F80  88  wkc 1
        tx FRMW 1001 0F80  00
        rx FRMW 1001 0F80  88  wkc 2
        tx FPRD 1002 0F80  00
        rx FPRD 1002 0F80  88  wkc 1
        tx FRMW 1002 0F80  0F                  # the first is written before the second is read
        rx FRMW 1002 0F80  88  wkc 2
        tx FPRD 1001 0F80  00
        rx FPRD 1001 0F80  0F  wkc 1
    """,
}


@pytest.fixture
def pair():
    rig = Rig(2)
    rig.address()
    return rig


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command(pair, command):
    pair.play(COMMANDS[command])


def test_several_datagrams_in_a_frame_are_done_in_their_order(pair):
    pair.play("""
        tx+ FPWR 1001 0F80  05
        tx+ FPRD 1001 0F80  00
        tx  BRD  0000 0000  00
        rx  FPWR 1001 0F80  05  wkc 1
        rx  FPRD 1001 0F80  05  wkc 1
        rx  BRD  0002 0000  11  wkc 2
    """)


def test_an_alias_addresses_once_it_is_enabled(pair):
    pair.play("""
        tx FPRD 0777 0012  00 00
        rx FPRD 0777 0012  00 00  wkc 0
        tx FPWR 1001 0103  01                  # DL control, bit 24
        rx FPWR 1001 0103  01  wkc 1
        tx FPRD 0777 0012  00 00
        rx FPRD 0777 0012  77 07  wkc 1
    """)


def test_the_description_of_the_controller():
    rig = Rig()
    rig.address()
    # Type, revision, build, FMMUs, sync managers, KiB of RAM, ports 0 and 1 MII, features.
    assert rig.read(0x0000, 10) == bytes.fromhex("11 00 02 00 08 08 08 0F CC 00")
    assert rig.read(0x0400, 2) == bytes.fromhex("C2 09") and rig.read(0x0420, 2) == bytes.fromhex("E8 03")


def test_dl_status_tells_who_ends_the_line():
    rig = Rig(3)
    rig.address()
    status = [rig.value(0x0110, station=STATION + k) for k in range(3)]
    assert [value >> 8 for value in status] == [0x5A, 0x5A, 0x56]  # port 1 communicates, or is a closed loop
    assert [value & 0x30 for value in status] == [0x30, 0x30, 0x10]  # links


# --- logical addresses ------------------------------------------------------------------------------------------------
def test_lrd_lwr_and_lrw_of_four_slaves():
    rig = Rig(4)
    rig.address()
    for k in range(4):
        rig.bring_to(AlState.OP, STATION + k)
    sent = bytes(range(64))
    assert rig.send(Datagram(DatagramCommand.LWR, 0x10000, sent))[0].counter == 4
    answer = rig.send(Datagram(DatagramCommand.LRD, 0x10000, bytes(64)))[0]
    assert answer.counter == 4
    for k in range(4):
        assert answer.data[16 * k + 4 : 16 * k + 8] == sent[16 * k : 16 * k + 4]  # the echo
        assert answer.data[16 * k : 16 * k + 4] == bytes(4)  # outputs are not read
    answer = rig.send(Datagram(DatagramCommand.LRW, 0x10000, sent))[0]
    assert answer.counter == 4 * 3
    assert answer.data[:4] == sent[:4]
    assert rig.send(Datagram(DatagramCommand.LRW, 0x20000, sent))[0] == (12, 0x20000, sent, 0, 0, 0)  # nobody's


def test_an_fmmu_maps_bits():
    rig = Rig()
    rig.address()
    rig.write(0x1000, "A5 3C")
    rig.write(0x0600, struct.pack("<IHBBHBBB", 0x100, 2, 6, 1, 0x1000, 3, 3, 1))  # 4 bits, from bit 6, of bit 3 on
    answer = rig.send(Datagram(DatagramCommand.LRD, 0x100, b"\0\0"))[0]
    assert (answer.data, answer.counter) == (bytes.fromhex("00 01"), 1)  # A5h has bits 3 to 6 = 0100b
    answer = rig.send(Datagram(DatagramCommand.LRW, 0x100, bytes.fromhex("C0 03")))[0]
    assert (answer.data, answer.counter) == (bytes.fromhex("00 01"), 3)
    assert rig.read(0x1000, 2) == bytes.fromhex("FD 3C")  # all four are set, the others stay
    # A datagram that begins in the middle of what is mapped gets the rest.
    assert rig.send(Datagram(DatagramCommand.LRD, 0x101, b"\0"))[0].data == b"\x03"


@pytest.mark.parametrize("seed", range(5))
def test_bits_are_copied_as_one_by_one(seed):
    random = np.random.default_rng(seed)
    source, target = random.bytes(8), bytearray(random.bytes(8))
    count = int(random.integers(1, 40))
    start, end = (int(random.integers(0, 64 - count)) for _ in range(2))
    bits = [value >> k & 1 for value in target for k in range(8)]
    bits[end : end + count] = [value >> k & 1 for value in source for k in range(8)][start : start + count]
    fmmu.copy_bits(source, start, target, end, count)
    assert [value >> k & 1 for value in target for k in range(8)] == bits


def test_an_fmmu_that_is_off_maps_nothing():
    assert fmmu.parse(struct.pack("<IHBBHBBB", 0, 4, 0, 7, 0x1000, 0, 3, 0).ljust(16, b"\0")) is None
    assert fmmu.parse(struct.pack("<IHBBHBBB", 0, 0, 0, 7, 0x1000, 0, 3, 1).ljust(16, b"\0")) is None


# --- sync managers ----------------------------------------------------------------------------------------------------
def test_a_buffer_is_taken_whole():
    """Outputs that come in two datagrams are one image once the last byte is there."""
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.OP)
    device = rig.devices[0]
    assert rig.write(0x1102, "03 04") == 0  # not opened by its first byte
    assert rig.write(0x1100, "01 02") == 1
    assert device.taken == bytes(4)
    assert rig.write(0x1102, "03 04") == 1
    assert device.taken == bytes.fromhex("01 02 03 04")
    assert rig.read(0x1100, 4) is None  # the master writes it, and reads none of it


def test_a_sync_manager_that_is_on_keeps_its_place():
    rig = Rig()
    rig.address()
    rig.write(0x0800, "00 10 40 00 26 00 01 00")
    rig.write(0x0800, "00 12 40 00 26 00 01 00")
    assert rig.read(0x0800, 8) == bytes.fromhex("00 10 40 00 26 00 01 00")
    rig.write(0x0806, "00")
    rig.write(0x0800, "00 12 40 00 26 00 01 00")
    assert rig.read(0x0800, 2) == bytes.fromhex("00 12")


def test_mailbox_status_says_full_and_empty():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.PRE_OP)
    assert rig.value(0x080D, 1) & 0x08 == 0
    rig.mail(3, b"\x09\x20")
    assert rig.value(0x080D, 1) & 0x08
    rig.fetch()
    assert rig.value(0x080D, 1) & 0x08 == 0


def test_reset_by_three_letters():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.PRE_OP)
    for letter in ("52", "45", "45", "52", "45"):  # one that is wrong begins anew
        rig.write(0x0040, letter)
    assert rig.value(0x0130) == 2
    rig.write(0x0040, "53")
    assert rig.read(0x0130, 2) is None  # its station address is gone
    assert rig.read(0x0130, 2, station=0) == b"\x01\x00"


def test_one_write_of_many_registers_acts_on_all_of_them():
    rig = Rig()
    rig.address()
    controller = rig.slaves[0].controller
    for address in (registers.RX_ERRORS, registers.UNIT_ERRORS, registers.LOST_LINKS):
        controller.count(address)
    assert rig.write(0x0300, bytes(0x14)) == 1
    assert rig.read(0x0300, 0x14) == bytes(0x14), "counters of three groups"
    unit = struct.pack("<IHBBHBBB", 0x10000, 4, 0, 7, 0x0F80, 0, 3, 1)
    manager = struct.pack("<HHBBBB", 0x1000, 64, 0x26, 0, 1, 0)
    assert rig.write(0x0600, unit.ljust(0x200, b"\0") + manager) == 1
    assert rig.send(Datagram(DatagramCommand.LWR, 0x10000, b"abcd"))[0].counter == 1, "the FMMU maps"
    assert rig.value(0x0F80, 4) == int.from_bytes(b"abcd", "little")
    assert rig.write(0x1000, bytes(64)) == 1 and rig.value(0x0805, 1) & 0x08, "the sync manager is full"


def test_counters_are_cleared_by_a_write():
    rig = Rig()
    rig.address()
    rig.world.receive(build_frame([at_station(4, STATION, 0, b"\0")])[:20])
    assert rig.value(0x030C, 1) == 1
    assert rig.write(0x030C, "00") == 1
    assert rig.value(0x030C, 1) == 0


# --- frames that are not whole ----------------------------------------------------------------------------------------
@pytest.fixture
def moving():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.OP)
    rig.exchange(bytes.fromhex("11 22 33 44"))
    return rig


def process_data(data):
    return build_frame([Datagram(DatagramCommand.LRW, 0x10000, data + bytes(6))])


def test_a_frame_cut_anywhere_changes_nothing(moving):
    device = moving.devices[0]
    end = datagrams.ETHERNET + datagrams.HEADER + datagrams.DATAGRAM + 10 + datagrams.COUNTER
    for size in range(end):
        assert moving.world.receive(process_data(b"\xee" * 4)[:size]) is None
    assert device.taken == bytes.fromhex("11 22 33 44")
    assert moving.world.receive(process_data(b"\xee" * 4)[:end]) is not None
    assert device.taken == b"\xee" * 4


def test_an_error_is_counted_where_it_came_and_told_behind():
    rig = Rig(3)
    rig.address()
    rig.world.receive(process_data(bytes(4))[:20])
    assert [rig.value(0x030C, 1, STATION + k) for k in range(3)] == [1, 0, 0]
    assert [rig.value(0x0308, 1, STATION + k) for k in range(3)] == [0, 1, 1]


def test_doubled_and_reordered_frames(moving):
    device = moving.devices[0]
    first, second = process_data(b"\1\2\3\4"), process_data(b"\5\6\7\x08")
    for frame in (second, second, first, second, first):
        assert datagrams.read(moving.world.receive(frame), datagrams.ETHERNET)[0].counter == 3
    assert device.taken == b"\1\2\3\4"  # the last that came, whichever was sent last


def test_other_protocols_pass_by(moving):
    assert moving.world.receive(b"\xff" * 12 + b"\x08\x00" + bytes(50)) is None
    assert moving.world.receive(b"") is None
    tagged = process_data(b"\xee" * 4)
    tagged = tagged[:12] + bytes.fromhex("8100 2000") + tagged[12:]  # with a VLAN tag it is one of ours
    assert moving.world.receive(tagged) is not None
    assert moving.devices[0].taken == b"\xee" * 4


def damaged(random, frame):
    """A frame with bytes changed, cut, or put in."""
    frame = bytearray(frame)
    kind = random.integers(4)
    if kind == 0:
        for _ in range(random.integers(1, 6)):
            frame[random.integers(datagrams.ETHERNET, len(frame))] = random.integers(256)
    elif kind == 1:
        del frame[random.integers(datagrams.ETHERNET, len(frame)) :]
    elif kind == 2:
        place = int(random.integers(datagrams.ETHERNET, len(frame)))
        frame[place:place] = random.bytes(int(random.integers(1, 30)))
    else:
        frame[datagrams.ETHERNET :] = random.bytes(int(random.integers(0, 200)))
    return bytes(frame)


def fuzz(number, seed):
    """Send frames of chance to four slaves; after each the process image is one that a whole frame has brought."""
    rig = Rig(4)
    rig.address()
    for k in range(4):
        rig.bring_to(AlState.OP, STATION + k)
    random = np.random.default_rng(seed)
    commands = list(DatagramCommand)
    places = (0x0010, 0x0120, 0x0130, 0x0500, 0x0600, 0x0800, 0x0900, 0x0980, 0x1000, 0x1080, 0x1100, 0x1180, 0x2FF0)
    refused = answered = 0
    for _ in range(number):
        asked = [
            at_station(
                commands[random.integers(len(commands))], int(random.choice((0, 0xFFFF, STATION, 0x10000, 7))),
                int(random.choice(places) + random.integers(0, 8)), random.bytes(int(random.integers(0, 40))),
            )
            for _ in range(random.integers(1, 4))
        ]  # fmt: skip
        frame = build_frame(asked)
        if random.integers(2):
            frame = damaged(random, frame)
        before = [bytes(slave.controller.memory[0x1000:]) for slave in rig.slaves]
        taken = [device.taken for device in rig.devices]
        answer = rig.world.segment.transfer(frame, 0.0)
        if answer is None:
            refused += 1
            assert [bytes(slave.controller.memory[0x1000:]) for slave in rig.slaves] == before
            assert [device.taken for device in rig.devices] == taken
        else:
            answered += 1
            assert len(answer) == len(frame)
        assert all(len(device.taken) == 4 for device in rig.devices)
    return refused, answered


def test_frames_of_chance():
    refused, answered = fuzz(3000, 1)
    assert refused > 300 and answered > 1000


@pytest.mark.slow
def test_a_million_frames_of_chance():
    frames = part(1_000_000, 50_000)
    refused, answered = fuzz(frames, 2)
    assert refused + answered == frames
