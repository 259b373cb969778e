"""The master's end of a mailbox as a transcript: SDO transfers in pieces (ETG.1000.6, 5.6.2)."""

from __future__ import annotations

import struct

import pytest

from drive_env.dictionary.aborts import TOGGLE_NOT_ALTERNATED
from drive_env.ethercat.coe import CoeService, message, split
from drive_env.ethercat.mailbox import COUNTER_SHIFT, MailboxProtocol
from drive_env.master.ethercat.mailbox_client import MailboxClient, SdoAbortError

LENGTH, HEADER = 32, 6  # bytes of the mailbox, and of a message's head; CoE and SDO have 24
KEY = bytes.fromhex("05 20 01")  # 2005h:01


class Slave:
    """A mailbox that answers in turn what it is told to, and keeps what it was asked."""

    def __init__(self, *answers):
        self.answers, self.asked, self._waiting = [bytes.fromhex(answer) for answer in answers], [], []
        self._count = 0
        self.client = MailboxClient(self._take, self._give, lambda: None, (LENGTH, LENGTH), lambda: None)

    def _take(self, whole):
        length, _, _, kind = struct.unpack_from("<HHBB", whole)
        assert len(whole) == LENGTH and kind & 0xF == MailboxProtocol.COE
        service, request = split(whole[HEADER : HEADER + length])
        assert service == CoeService.SDO_REQUEST
        self.asked.append(request.hex(" "))
        content = message(CoeService.SDO_RESPONSE, self.answers.pop(0))
        self._count = self._count % 7 + 1
        head = struct.pack("<HHBB", len(content), 0, 0, MailboxProtocol.COE | self._count << COUNTER_SHIFT)
        self._waiting.append(head + content)
        return True

    def _give(self):
        return self._waiting.pop(0) if self._waiting else b""


def emergency(*content):
    """A message of the mailbox with an emergency, whose counter is none of a transfer's."""
    head = message(CoeService.EMERGENCY, bytes(content))
    return struct.pack("<HHBB", len(head), 0, 0, MailboxProtocol.COE) + head


def numbers(first, count):
    return bytes(range(first, first + count)).hex(" ")


@pytest.mark.parametrize(
    ("size", "segments"),
    [
        (16, []),  # the first message has room for 16 bytes
        (39, [f"01 {numbers(16, 23)}"]),  # a segment for 23: the last one, bit 0
        (40, [f"00 {numbers(16, 23)}", f"1d {numbers(39, 1)} 00 00 00 00 00 00"]),  # toggle, 6 of 7 bytes unused, last
        (50, [f"00 {numbers(16, 23)}", f"11 {numbers(39, 11)}"]),
        (63, [f"00 {numbers(16, 23)}", f"10 {numbers(39, 23)}", f"0d {numbers(62, 1)} 00 00 00 00 00 00"]),
    ],
)
def test_a_long_write_goes_in_segments_whose_toggle_bit_alternates(size, segments):
    answers = ("20", "30", "20")[: len(segments)]
    slave = Slave(f"60 {KEY.hex()} 00 00 00 00", *(f"{first} 00 00 00 00 00 00 00" for first in answers))
    slave.client.download(0x2005, 1, bytes(range(size)), 1.0)
    assert slave.asked == [f"21 {KEY.hex(' ')} {size:02x} 00 00 00 {numbers(0, 16)}", *segments]


@pytest.mark.parametrize(
    ("data", "request_"), [("aa", "2f 05 20 01 aa 00 00 00"), ("aa bb", "2b 05 20 01 aa bb 00 00"),
                           ("aa bb cc dd", "23 05 20 01 aa bb cc dd")],
)  # fmt: skip
def test_four_bytes_at_most_go_in_one_message(data, request_):
    slave = Slave(f"60 {KEY.hex()} 00 00 00 00")
    slave.client.download(0x2005, 1, bytes.fromhex(data), 1.0)
    assert slave.asked == [request_]


def test_a_long_read_comes_in_segments():
    slave = Slave(
        f"41 {KEY.hex()} 28 00 00 00 {numbers(0, 16)}",  # 40 bytes
        f"00 {numbers(16, 23)}",
        f"1d {numbers(39, 1)} 00 00 00 00 00 00",
    )
    assert slave.client.upload(0x2005, 1, 1.0) == bytes(range(40))
    assert slave.asked == ["40 05 20 01 00 00 00 00", "60 00 00 00 00 00 00 00", "70 00 00 00 00 00 00 00"]


def test_a_segment_with_the_toggle_bit_of_the_last_one_is_refused():
    slave = Slave(f"41 {KEY.hex()} 28 00 00 00 {numbers(0, 16)}", f"10 {numbers(16, 23)}")
    with pytest.raises(SdoAbortError, match="did not alternate") as error:
        slave.client.upload(0x2005, 1, 1.0)
    assert error.value.abort_code == TOGGLE_NOT_ALTERNATED == 0x0503_0000


def test_emergencies_between_are_kept_and_answer_nothing():
    """Code, error register and five bytes of the device (ETG.1000.6, 5.6.4); one that is cut short is none."""
    slave = Slave(f"4b {KEY.hex()} 34 12 00 00")
    slave._waiting = [emergency(0x11, 0x86, 0x20, 1, 2, 3, 4, 5), emergency(0x11, 0x86), emergency(0x00, 0x00, 0x00)]
    assert slave.client.upload(0x2005, 1, 1.0) == bytes.fromhex("34 12")
    assert list(slave.client.emergencies) == [(0x8611, 0x20, (1, 2, 3, 4, 5)), (0x0000, 0x00, ())]
