"""The master's end of a mailbox as a transcript: SDO transfers in pieces (ETG.1000.6, 5.6.2)."""

from __future__ import annotations

import struct
import threading

import pytest
from rigs.clock import Clock

from drive_env.dictionary.aborts import TOGGLE_NOT_ALTERNATED
from drive_env.ethercat.coe import CoeService, message, split
from drive_env.ethercat.mailbox import COUNTER_SHIFT, MailboxProtocol
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.ethercat import mailbox_client
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


# --- message by message -----------------------------------------------------------------------------------------------


class Mailbox:
    """A mailbox whose frames are told: what a write of it brings, and what each read of it has."""

    def __init__(self, reads, writes=()):
        self.reads, self.writes = list(reads), list(writes)
        self.sent, self.repeats, self.told = [], 0, 0
        self.client = MailboxClient(self._send, self._fetch, self._repeat, (LENGTH, LENGTH), self._tell)

    def _send(self, data):
        self.sent.append(data.hex(" "))
        return self.writes.pop(0) if self.writes else True

    def _fetch(self):
        return self.reads.pop(0) if self.reads else b""

    def _repeat(self):
        self.repeats += 1

    def _tell(self):
        self.told += 1


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(mailbox_client, "time", found)
    return found


def answer(text, counter, kind=3, service=CoeService.SDO_RESPONSE):
    content = message(service, bytes.fromhex(text))
    return struct.pack("<HHBB", len(content), 0, 0, kind | counter << 4) + content + bytes(3)


IS_1234 = f"4b {KEY.hex()} 34 12 00 00"


def test_a_request_fills_the_mailbox_and_each_has_the_next_counter_of_seven():
    """Length, address, priority; CoE (3) and the counter; SDO request (2 in bits 12 to 15), upload of 2005h:01."""
    mailbox = Mailbox([answer(IS_1234, k % 7 + 1) for k in range(8)])
    for _ in range(8):
        assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    rest = "00 20 40 05 20 01 00 00 00 00" + " 00" * 16
    assert mailbox.sent == [f"0a 00 00 00 00 {counter}3 {rest}" for counter in (1, 2, 3, 4, 5, 6, 7, 1)]


@pytest.mark.parametrize(("first", "data"), [
    ("43", "01 02 03 04"), ("47", "01 02 03"), ("4b", "01 02"), ("4f", "01"),
    ("42", "01 02 03 04"), ("4e", "01 02 03 04"),  # without a size all four
])  # fmt: skip
def test_a_short_object_comes_in_its_answer(first, data):
    mailbox = Mailbox([answer(f"{first} {KEY.hex()} 01 02 03 04", 1)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == bytes.fromhex(data)


def test_what_is_longer_than_it_says_is_cut():
    mailbox = Mailbox([answer(f"41 {KEY.hex()} 05 00 00 00 01 02 03 04 05 06 07", 1)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == bytes(range(1, 6))


def test_a_segment_that_says_it_is_the_last_ends_the_read():
    mailbox = Mailbox([answer(f"41 {KEY.hex()} 09 00 00 00 01 02", 1), answer("05 03 04 05 06 07 08 09", 2)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == bytes(range(1, 8)), "two of seven bytes are unused"


@pytest.mark.parametrize(("size", "first"), [(0, "21"), (1, "2f"), (4, "23"), (5, "21")])
def test_of_nothing_a_write_is_no_expedited_one(size, first):
    mailbox = Mailbox([answer(f"60 {KEY.hex()} 00 00 00 00", 1)])
    mailbox.client.download(0x2005, 1, bytes(size), 1.0)
    assert mailbox.sent[0].split()[8] == first and len(mailbox.sent) == 1


def test_an_abort_is_told_with_its_code():
    mailbox = Mailbox([answer(f"80 {KEY.hex()} 10 00 09 06", 1)])
    with pytest.raises(SdoAbortError, match=r"^abort 06090010h") as error:
        mailbox.client.download(0x2005, 1, b"\1", 1.0)
    assert error.value.abort_code == 0x06090010


def test_an_abort_of_a_segment_names_whatever_object():
    mailbox = Mailbox([answer(f"60 {KEY.hex()} 00 00 00 00", 1), answer("80 00 00 00 00 00 04 05", 2)])
    with pytest.raises(SdoAbortError):
        mailbox.client.download(0x2005, 1, bytes(40), 1.0)


@pytest.mark.parametrize("other", [
    answer("4b 06 20 01 00 00 00 00", 2),  # another object
    answer("80 06 20 01 00 00 00 00", 2),  # an abort of another
    answer(f"4b {KEY.hex()} 00 00 00 00", 1),  # the counter of the last message: the same one again
    answer(f"4b {KEY.hex()} 00 00 00 00", 2, kind=4),  # of FoE
    answer(f"4b {KEY.hex()} 00 00 00 00", 2, service=CoeService.INFORMATION),
    struct.pack("<HHBB", 1, 0, 0, 3 | 2 << 4) + b"\0",  # cut short
])  # fmt: skip
def test_messages_that_are_no_answer_are_passed_over(clock, other):
    mailbox = Mailbox([answer(f"60 {KEY.hex()} 00 00 00 00", 1), other, answer(IS_1234, 3)])
    mailbox.client.download(0x2005, 1, b"\1", 1.0)
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    assert clock.slept == [], "the next message is looked for at once"


def test_an_answer_may_have_the_service_of_a_request():
    mailbox = Mailbox([answer(IS_1234, 0, service=CoeService.SDO_REQUEST), answer(IS_1234, 0)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12", "a counter of 0 is none"


def test_segments_are_answered_by_segments_alone(clock):
    """Neither an upload's initiate (2), nor what names an object; 0 and 1 are the answers of segments."""
    mailbox = Mailbox([answer(f"60 {KEY.hex()} 00 00 00 00", 1), answer(f"43 {KEY.hex()} 00 00 00 00", 2),
                       answer(f"60 {KEY.hex()} 00 00 00 00", 3), answer("20 00 00 00 00 00 00 00", 4)])  # fmt: skip
    mailbox.client.download(0x2005, 1, bytes(17), 1.0)
    assert mailbox.reads == []


def test_an_error_of_the_mailbox_is_told():
    error = struct.pack("<HHBBHH", 4, 0, 0, 1 << 4, 1, 6)
    with pytest.raises(BusError, match=r"^a mailbox error of the slave, detail 6$"):
        Mailbox([error]).client.upload(0x2005, 1, 1.0)


def test_an_answer_is_waited_for_and_the_program_told(clock):
    mailbox = Mailbox([b"", bytes(5), answer(IS_1234, 1)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    assert clock.slept == [0.0005] * 2 and mailbox.told == 2 and len(mailbox.sent) == 1


def test_an_answer_that_does_not_come_in_time_is_told(clock, monkeypatch):
    monkeypatch.setattr(mailbox_client, "LOOK", 0.25)
    with pytest.raises(NoAnswerError, match=r"^no answer came in time$"):
        Mailbox([]).client.upload(0x2005, 1, 1.0)
    assert clock.now == 1001.25, "at 1.0 s the time is not over"
    with pytest.raises(NoAnswerError):
        Mailbox([]).client.download(0x2005, 1, b"\1", 1.0)
    assert clock.now == 1002.5
    with pytest.raises(NoAnswerError):
        Mailbox([answer(f"60 {KEY.hex()} 00 00 00 00", 1)]).client.download(0x2005, 1, bytes(17), 1.0)
    assert clock.now == 1003.75
    with pytest.raises(NoAnswerError):
        Mailbox([answer(f"41 {KEY.hex()} 09 00 00 00 01 02", 1)]).client.upload(0x2005, 1, 1.0)
    assert clock.now == 1005.0


@pytest.mark.parametrize("lost", [None, False], ids=["its frame is lost", "there is no room"])
def test_a_request_that_did_not_get_there_is_sent_again_as_it_was(clock, lost):
    """The slave may have had it all the same: its answer is looked for, too."""
    mailbox = Mailbox([b"", b"", answer(IS_1234, 1)], [lost, lost])
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    assert len(mailbox.sent) == 3 and len(set(mailbox.sent)) == 1
    mailbox = Mailbox([answer(IS_1234, 1)], [lost])
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12" and len(mailbox.sent) == 1


def test_a_message_whose_frame_is_lost_is_asked_for_again(clock):
    mailbox = Mailbox([None, None, b"", answer(IS_1234, 1)])
    assert mailbox.client.upload(0x2005, 1, 1.0) == b"\x34\x12"
    assert mailbox.repeats == 2 and len(clock.slept) == 3


def test_a_post_is_sent_once_and_nothing_is_waited_for(clock):
    mailbox = Mailbox([], [False])
    mailbox.client.post(0x6040, 0, b"\x06\x00")
    assert mailbox.sent == ["0a 00 00 00 00 13 00 20 2b 40 60 00 06 00 00 00" + " 00" * 16] and clock.slept == []


def in_another_thread(call):
    thread = threading.Thread(target=call)
    thread.start()
    thread.join(30.0)
    assert not thread.is_alive()


def test_neither_a_post_nor_a_look_waits_for_a_transfer_under_way():
    mailbox = Mailbox([emergency(0x11, 0x86, 0x20)])
    with mailbox.client._turn:
        in_another_thread(lambda: mailbox.client.post(0x6040, 0, b"\x06\x00"))
        in_another_thread(lambda: mailbox.client.look(0.0))
        in_another_thread(lambda: mailbox.client.look(-1.0))
    assert mailbox.sent == [] and len(mailbox.reads) == 1
    in_another_thread(lambda: mailbox.client.post(0x6040, 0, b"\x06\x00"))
    in_another_thread(lambda: mailbox.client.look(0.0))
    assert len(mailbox.sent) == 1 and mailbox.reads == [], "and the turn is free again"


def test_a_look_takes_all_that_waits(clock):
    mailbox = Mailbox([emergency(0x11, 0x86, 0x20), answer(IS_1234, 1), emergency(0, 0, 0, 9)])
    mailbox.client.look(0.0)
    assert list(mailbox.client.emergencies) == [(0x8611, 0x20, ()), (0, 0, (9,))] and mailbox.reads == []


def test_a_look_lets_go_of_an_error_that_nobody_waits_for(clock):
    error = struct.pack("<HHBBHH", 4, 0, 0, 1 << 4, 1, 6)
    mailbox = Mailbox([error, emergency(0x11, 0x86, 0x20)])
    mailbox.client.look(0.0)
    assert list(mailbox.client.emergencies) == [(0x8611, 0x20, ())]


def test_a_read_of_three_segments():
    slave = Slave(
        f"41 {KEY.hex()} 3f 00 00 00 {numbers(0, 16)}",  # 63 bytes
        f"00 {numbers(16, 23)}", f"10 {numbers(39, 23)}", f"0d {numbers(62, 1)} 00 00 00 00 00 00",
    )  # fmt: skip
    assert slave.client.upload(0x2005, 1, 1.0) == bytes(range(63))
    assert slave.asked[1:] == ["60" + " 00" * 7, "70" + " 00" * 7, "60" + " 00" * 7]
