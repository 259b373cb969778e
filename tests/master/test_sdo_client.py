"""The master's SDO client on a port of this test: expedited transfers as frames, time-outs, and what passes them by."""

from __future__ import annotations

import struct
import threading
from collections import deque

import pytest

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.can import sdo as module
from drive_env.master.can.sdo import SdoClient

READ_6041 = bytes.fromhex("40 41 60 00 00 00 00 00")
IS_0237 = bytes.fromhex("4B 41 60 00 37 02 00 00")
WRITE_6040 = bytes.fromhex("2B 40 60 00 0F 00 00 00")
WRITTEN_6040 = bytes.fromhex("60 40 60 00 00 00 00 00")
TIMED_OUT = bytes.fromhex("80 41 60 00 00 00 04 05")


class Line:
    """A port: each frame that is sent has its answers, which come after `delay` seconds of a clock of its own."""

    def __init__(self, monkeypatch, *answers):
        self.answers, self.sent, self.waiting, self.waits = deque(answers), [], deque(), []
        self.now, self.delay, self.refusals = 50.0, 0.0, 0
        self.client = None
        monkeypatch.setattr(module.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(module.time, "sleep", self._pass)

    def _pass(self, seconds):
        self.now += seconds

    def subscribe(self, can_id, handler):
        assert can_id == 0x585
        self.handler = handler

    def send(self, can_id, data):
        if self.refusals:
            self.refusals -= 1
            raise BusError("full")
        self.sent.append((can_id, data))
        if can_id == 0x605 and data[0] != 0x80 and self.answers:
            self.waiting.extend((self.now + self.delay, answer) for answer in self.answers.popleft())

    def drain(self):
        while self.receive():
            pass

    def receive(self, timeout=0.0, done=None):
        self.waits.append(timeout)
        if self.waiting and self.waiting[0][0] <= self.now + timeout:
            due, answer = self.waiting.popleft()
            self.now = max(self.now, due)
            self.handler(answer) if isinstance(answer, bytes) else answer()
            return True
        self.now += timeout
        return False


@pytest.fixture
def made(monkeypatch):
    def make(*answers, alive=lambda: None):
        line = Line(monkeypatch, *answers)
        return line, SdoClient(line, 5, alive)

    return make


def frames(line):
    return [data for can_id, data in line.sent if can_id == 0x605]


# --- reads and writes -------------------------------------------------------------------------------------------------
def test_a_read(made):
    line, client = made([IS_0237])
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"
    assert line.sent == [(0x605, READ_6041)]


def test_a_write(made):
    line, client = made([WRITTEN_6040])
    client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.5)
    assert line.sent == [(0x605, WRITE_6040)]


def test_an_abort_is_told_with_its_code_and_object(made):
    _, client = made([bytes.fromhex("80 40 60 00 10 00 09 06")])
    with pytest.raises(ObjectAccessError, match=r"node 5.*the write of Controlword") as refused:
        client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.5)
    assert refused.value.abort_code == 0x06090010


def test_an_abort_that_names_no_object_is_of_this_transfer(made):
    _, client = made([bytes.fromhex("80 00 00 00 00 00 00 08")])
    with pytest.raises(ObjectAccessError) as refused:
        client.read(0x6041, 0, "Statusword", 0.5)
    assert refused.value.abort_code == 0x08000000


@pytest.mark.parametrize(
    "foreign",
    [
        "4B 64 60 00 00 00 00 00",  # another index
        "4B 41 60 01 00 00 00 00",  # another sub-index
        "60 64 60 00 00 00 00 00",  # the end of an earlier write
        "80 64 60 00 10 00 09 06",  # an abort of another
        "4B 41 60 00 55 55 00",  # too short
    ],
)
def test_answers_of_another_transfer_are_passed_over(made, foreign):
    _, client = made([bytes.fromhex(foreign), IS_0237])
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"


def test_an_answer_that_came_before_the_request_is_none(made):
    line, client = made([IS_0237])
    line.waiting.append((0.0, bytes.fromhex("4B 41 60 00 FF FF 00 00")))
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"


def test_an_answer_of_the_wrong_kind_is_told(made):
    line, client = made([WRITTEN_6040[:1] + READ_6041[1:]])
    with pytest.raises(BusError, match=r"node 5 answered the read of Statusword wrongly: .*; is another master"):
        client.read(0x6041, 0, "Statusword", 0.5)
    assert len(frames(line)) <= 2, "it is not asked again"


# --- time-outs --------------------------------------------------------------------------------------------------------
def test_a_read_whose_frame_was_lost_is_asked_once_more(made):
    line, client = made([], [IS_0237])
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"
    assert frames(line) == [READ_6041, TIMED_OUT, READ_6041]
    assert line.now == pytest.approx(50.5)


def test_a_read_without_an_answer_takes_its_time_twice(made):
    line, client = made()
    said = r"node 5 did not answer the read of Statusword within 0\.5 s; check power, bit rate and node-ID"
    with pytest.raises(NoAnswerError, match=said):
        client.read(0x6041, 0, "Statusword", 0.5)
    assert line.now == pytest.approx(51.0)
    assert frames(line) == [READ_6041, TIMED_OUT] * 2


def test_a_write_is_not_tried_twice(made):
    line, client = made()
    with pytest.raises(NoAnswerError, match=r"did not answer the write of Controlword within 0\.2 s"):
        client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.2)
    assert line.now == pytest.approx(50.2)
    assert frames(line)[0] == WRITE_6040 and len(frames(line)) == 2 and frames(line)[1][0] == 0x80


def test_an_answer_just_in_time_counts_and_waiting_is_in_short_pieces(made):
    seen = []
    line, client = made([IS_0237], alive=lambda: seen.append(1))
    line.delay = 0.499
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"
    assert max(line.waits) == 0.05, "what must be kept alive is not left waiting"
    assert len(seen) == 10


def test_an_answer_that_came_while_the_thread_slept_counts(made):
    line, client = made([IS_0237])
    sleeps = iter([10.0])
    receive = line.receive

    def slept(timeout=0.0, done=None):
        if timeout > 0.0:
            line.now += next(sleeps)
            return False
        return receive(timeout, done)

    line.receive = slept
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"
    assert len(frames(line)) == 1


def test_a_node_that_missed_our_heartbeats_is_named_as_the_cause_until_it_answers(made):
    line, client = made()
    client.may_be_stopped()
    with pytest.raises(NoAnswerError, match=r"node 5 did not answer .* missed this program's heartbeats \(8130h\)"):
        client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.5)
    line.answers.append([IS_0237])
    client.read(0x6041, 0, "Statusword", 0.5)
    with pytest.raises(NoAnswerError, match="check power"):
        client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.5)


def test_a_node_that_boots_ends_the_transfer_at_once(made):
    line, client = made()
    line.answers.extend([[client.forget], [client.forget]])
    with pytest.raises(NoAnswerError, match=r"node 5 has restarted during the write of Controlword; check its power"):
        client.write(0x6040, 0, b"\x0f\x00", "Controlword", 0.5)
    assert line.now == 50.0
    with pytest.raises(NoAnswerError, match=r"has restarted during the read"):
        client._transfer(0x6041, 0, None, "the read of Statusword", 0.5)


def test_a_node_that_booted_before_is_asked_as_any_other(made):
    _, client = made([IS_0237])
    client.forget()
    assert client.read(0x6041, 0, "Statusword", 0.5) == b"\x37\x02"


def test_putting_back_wakes_the_node_and_waits_four_times_as_long(made):
    line, client = made([], [WRITTEN_6040])
    line.delay = 0.5
    client.put_back(0x6040, 0, b"\x0f\x00", "Controlword", 0.2)
    abort = bytes.fromhex("80 40 60 00 00 00 04 05")
    assert line.sent == [(0x605, WRITE_6040), (0x605, abort), (0x000, b"\x80\x05"), (0x605, WRITE_6040)]
    line, client = made()
    with pytest.raises(NoAnswerError):
        client.put_back(0x6040, 0, b"\x0f\x00", "Controlword", 0.2)
    assert line.now == pytest.approx(50.0 + 0.2 + 4 * 0.2)


def test_putting_back_what_the_drive_refuses_is_not_tried_again(made):
    line, client = made([bytes.fromhex("80 40 60 00 10 00 09 06")])
    with pytest.raises(ObjectAccessError):
        client.put_back(0x6040, 0, b"\x0f\x00", "Controlword", 0.2)
    assert line.sent == [(0x605, WRITE_6040)]


def test_who_waits_is_done_when_an_answer_has_come_or_the_node_has_booted(made):
    line, client = made([IS_0237])
    client.read(0x6041, 0, "Statusword", 0.5)
    assert not client._answered()
    line.handler(IS_0237)
    assert client._answered()
    client._answers.clear()
    client.forget()
    assert client._answered()


# --- looks and commands -----------------------------------------------------------------------------------------------
def test_a_look_says_nothing_of_what_went_wrong(made):
    line, client = made([IS_0237], [], [bytes.fromhex("80 41 60 00 00 00 02 06")])
    assert client.ask(0x6041, 0, 0.1) == b"\x37\x02"
    assert client.ask(0x6041, 0, 0.1) is None
    assert line.now == pytest.approx(50.1)
    assert client.ask(0x6041, 0, 0.1) is None
    assert client._turn.acquire(blocking=False)


def test_a_look_waits_for_its_turn_no_longer_than_for_an_answer(made):
    line, client = made()
    held, go_on = threading.Event(), threading.Event()

    def hold():
        with client._turn:
            held.set()
            go_on.wait(30.0)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait(30.0)
    assert client.ask(0x6041, 0, 0.01) is None and line.sent == []
    go_on.set()
    thread.join()


def test_a_command_is_one_frame_and_waits_for_nothing(made):
    line, client = made()
    client.command(0x6040, 0, b"\x0f\x00")
    client.command(0x6060, 0, b"\x03")
    client.command(0x60FF, 2, b"\x01\x02\x03\x04")
    assert frames(line) == [
        WRITE_6040,
        bytes.fromhex("2F 60 60 00 03 00 00 00"),
        bytes.fromhex("23 FF 60 02 01 02 03 04"),
    ]
    assert line.waits == []


def test_a_command_ends_a_block_transfer_first(made):
    line, client = made()
    client._object, client._in_block = (0x1021, 0), True
    client.command(0x6040, 0, b"\x06\x00")
    assert frames(line) == [bytes.fromhex("80 21 10 00 00 00 00 08"), bytes.fromhex("2B 40 60 00 06 00 00 00")]


def test_a_frame_that_a_full_buffer_does_not_take_is_tried_again_for_a_while(made):
    line, client = made()
    line.refusals = 3
    client.send_patiently(READ_6041)
    assert line.sent == [(0x605, READ_6041)] and line.now == pytest.approx(50.003)
    line.refusals = 10**6
    with pytest.raises(BusError):
        client.send_patiently(READ_6041)
    assert line.now == pytest.approx(50.003 + 0.5, abs=0.003)


def test_without_a_code_an_abort_is_a_general_error(made):
    line, client = made()
    client._object = (0x6041, 3)
    client.abort()
    client.abort(0x05040000)
    assert frames(line) == [struct.pack("<BHBL", 0x80, 0x6041, 3, code) for code in (0x08000000, 0x05040000)]
