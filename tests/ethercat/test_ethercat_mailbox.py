"""The mailbox: counter, repetition, error replies (ETG.1000.4, 5.6), and FoE in Bootstrap (ETG.1000.6, 5.8)."""

from __future__ import annotations

import struct

import pytest
from rigs.ethercat_rig import STATION, Rig

from drive_env.ethercat.application import AlState
from drive_env.ethercat.foe import LARGEST_IMAGE
from drive_env.ethercat.mailbox import MOST_WAITING

ERR, AOE, EOE, COE, FOE, SOE, VOE = 0, 1, 2, 3, 4, 5, 15
HELLO = b"\x09 hello"  # the echo answers it once


@pytest.fixture
def rig():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.PRE_OP)
    return rig


def error(detail):
    return struct.pack("<HH", 1, detail)


def test_an_answer_has_a_counter_of_its_own(rig):
    for k in range(9):
        assert rig.mail(COE, HELLO) == 1
        assert rig.fetch() == (COE, k % 7 + 1, HELLO)  # 1 to 7, never 0
    assert rig.fetch() is None


def test_the_header_on_the_wire(rig):
    rig.play("""
        tx FPWR 1001 1000  03 00 00 00 00 13 09 20 21
        rx FPWR 1001 1000  03 00 00 00 00 13 09 20 21  wkc 1
        tx FPRD 1001 1080  00 00                             # its last byte was not written: nothing came
        rx FPRD 1001 1080  00 00  wkc 0
        tx FPWR 1001 103F  00
        rx FPWR 1001 103F  00  wkc 1
        tx FPRD 1001 1080  00 00 00 00 00 00 00 00 00
        rx FPRD 1001 1080  03 00 00 00 00 13 09 20 21  wkc 1
        tx FPRD 1001 10BF  00                                # the last byte empties it
        rx FPRD 1001 10BF  00  wkc 1
        tx FPRD 1001 1080  00
        rx FPRD 1001 1080  00  wkc 0
    """)


def test_the_same_counter_twice_is_the_same_message(rig):
    rig.mail(COE, HELLO, counter=3)
    rig.mail(COE, b"\x09 again", counter=3)
    assert rig.fetch() == (COE, 1, HELLO)
    assert rig.fetch() is None
    rig.mail(COE, b"\x09 next", counter=4)
    assert rig.fetch() == (COE, 2, b"\x09 next")


def test_counter_0_is_none(rig):
    for _ in range(2):
        rig.mail(COE, HELLO, counter=0)
        assert rig.fetch()[2] == HELLO


def repeat(rig, bit):
    """Ask for the last answer once more, and wait for the acknowledgement."""
    rig.write(0x080E, bytes((0x01 | bit << 1,)))
    assert rig.value(0x080F, 1) & 2 == bit << 1


def test_an_answer_whose_frame_was_lost_comes_again(rig):
    rig.mail(COE, HELLO)
    rig.fetch()  # and the frame did not come back
    repeat(rig, 1)
    assert rig.fetch() == (COE, 1, HELLO)
    repeat(rig, 0)
    assert rig.fetch() == (COE, 1, HELLO)
    rig.mail(COE, b"\x09 next")
    assert rig.fetch() == (COE, 2, b"\x09 next")


def test_a_repetition_comes_before_what_waits(rig):
    rig.mail(COE, b"\x03 three")
    assert rig.fetch()[1] == 1
    repeat(rig, 1)
    assert [rig.fetch()[1] for _ in range(3)] == [1, 2, 3]
    assert rig.fetch() is None


def test_nothing_to_repeat(rig):
    repeat(rig, 1)
    assert rig.fetch() is None


def test_a_full_mailbox_takes_nothing(rig):
    for _ in range(MOST_WAITING // 7 + 1):
        rig.mail(COE, b"\x07 seven")
    assert rig.mail(COE, HELLO) == 1  # lies in the mailbox: too many answers wait
    assert rig.mail(COE, HELLO) == 0
    answers = []
    while (answer := rig.fetch()) is not None:
        answers.append(answer[2])
    assert answers[-1] == HELLO and answers.count(HELLO) == 1


@pytest.mark.parametrize("protocol", [ERR, AOE, EOE, SOE, VOE, 6, 14])
def test_a_protocol_that_a_drive_does_not_have(rig, protocol):
    rig.mail(protocol, bytes(12))
    assert rig.fetch() == (ERR, 1, error(2))


@pytest.mark.parametrize(("length", "channel", "message", "detail"), [
    (59, 0, HELLO, 8),  # more than the mailbox has
    (0xFFFF, 0, HELLO, 8),
    (7, 1, HELLO, 3),
    (1, 0, b"\x09", 6),
    (0, 0, b"", 6),
    (3, 0, b"\xEE 1", 4),  # what the application cannot read
])  # fmt: skip
def test_an_error_reply_says_what_is_wrong(rig, length, channel, message, detail):
    data = struct.pack("<HHBB", length, 0, channel, COE | 0x10) + message
    rig.write(0x1000, data.ljust(64, b"\0"))
    assert rig.fetch() == (ERR, 1, error(detail))


def test_the_priority_is_no_channel(rig):
    rig.write(0x1000, (struct.pack("<HHBB", len(HELLO), 0, 0xC0, COE | 0x10) + HELLO).ljust(64, b"\0"))
    assert rig.fetch() == (COE, 1, HELLO)


def test_what_the_device_has_to_say(rig):
    rig.devices[0].pending = [b"\x01\x10emergency"]
    rig.world.cycle()
    assert rig.fetch() == (COE, 1, b"\x01\x10emergency")


def test_init_forgets_what_waits(rig):
    rig.mail(COE, b"\x03 three")
    rig.request(1)
    assert rig.request(2) == (2, 0)
    rig.fetch()  # the one that lay in the mailbox
    assert rig.fetch() is None


def test_there_is_no_mailbox_in_init():
    rig = Rig()
    rig.address()
    rig.write(0x0800, "00 10 40 00 26 00 01 00  80 10 40 00 22 00 01 00")
    rig.mail(COE, HELLO)
    assert rig.fetch() is None


# --- FoE --------------------------------------------------------------------------------------------------------------
READ, WRITE, DATA, ACK, ERROR, BUSY = range(1, 7)
FULL = 64 - 6 - 6  # bytes of data in a packet


@pytest.fixture
def boot():
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.BOOTSTRAP)
    return rig


def foe(rig, operation, number, content=b""):
    """Return operation, number and content of the answer; None: there is none."""
    rig.mail(FOE, struct.pack("<BBI", operation, 0, number) + content)
    answer = rig.fetch()
    if answer is None:
        return None
    protocol, _, message = answer
    assert protocol == FOE
    return (message[0], *struct.unpack_from("<I", message, 2), message[6:])


def write_image(rig, name, image):
    assert foe(rig, WRITE, 0, name) == (ACK, 0, b"")
    for k in range(len(image) // FULL + 1):
        assert foe(rig, DATA, k + 1, image[k * FULL : (k + 1) * FULL]) == (ACK, k + 1, b"")


@pytest.mark.parametrize("size", [0, 1, FULL - 1, FULL, FULL + 1, 1000])
def test_an_image_is_taken_and_given_back(boot, size):
    image = bytes(k * 7 & 0xFF for k in range(size))
    write_image(boot, b"firmware.bin", image)
    assert boot.slaves[0].mailbox.files.images == {"firmware.bin": image}
    answer, back, number = foe(boot, READ, 0, b"firmware.bin"), b"", 1
    while answer is not None:
        assert answer[:2] == (DATA, number)
        back += answer[2]
        answer, number = foe(boot, ACK, number), number + 1
    assert back == image


@pytest.mark.parametrize(("operation", "number", "content", "code"), [
    (READ, 0, b"nothing", 0x8001),
    (DATA, 1, b"x", 0x8004),  # of a file that nobody writes
    (ACK, 1, b"", 0x8004),
    (9, 0, b"", 0x8004),
])  # fmt: skip
def test_what_foe_refuses(boot, operation, number, content, code):
    assert foe(boot, operation, number, content)[:2] == (ERROR, code)


def test_a_packet_out_of_turn(boot):
    foe(boot, WRITE, 0, b"a")
    foe(boot, DATA, 1, bytes(FULL))
    assert foe(boot, DATA, 3, bytes(FULL))[:2] == (ERROR, 0x8005)
    assert foe(boot, DATA, 2, b"")[:2] == (ERROR, 0x8004)  # the transfer is over
    assert boot.slaves[0].mailbox.files.images == {}


def test_an_image_that_is_too_large(boot):
    foe(boot, WRITE, 0, b"a")
    boot.slaves[0].mailbox.files._data = bytearray(LARGEST_IMAGE - 1)
    assert foe(boot, DATA, 1, bytes(FULL))[:2] == (ERROR, 0x8003)


def test_an_error_of_the_master_ends_the_transfer(boot):
    foe(boot, WRITE, 0, b"a")
    assert foe(boot, ERROR, 0x8000, b"no") is None
    assert foe(boot, DATA, 1, b"")[:2] == (ERROR, 0x8004)


def test_files_are_for_bootstrap(rig):
    assert foe(rig, WRITE, 0, b"a")[:2] == (ERROR, 0x8008)


def test_there_are_no_objects_in_bootstrap(boot):
    boot.mail(COE, HELLO)
    assert boot.fetch() == (ERR, 1, error(2))


def test_a_header_of_foe_that_is_short(boot):
    boot.mail(FOE, b"\1\0\0")
    assert boot.fetch() == (ERR, 1, error(6))


def test_the_station_is_in_the_answer_that_asked(rig):
    rig.write(0x1000, (struct.pack("<HHBB", len(HELLO), 0x0042, 0, COE | 0x10) + HELLO).ljust(64, b"\0"))
    data = rig.read(0x1080, 64, STATION)
    assert data[2:4] == b"\x42\x00"
