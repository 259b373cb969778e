"""Block transfers of the master as frames, with a server of this test (CiA 301, 7.2.4.3.9 and following)."""

from __future__ import annotations

import pytest
from canopen.sdo import SdoCommunicationError

from drive_env.master.can import block_transfer
from drive_env.master.can.block_transfer import BLOCK_FROM
from drive_env.node.block_transfer import crc

NOTHING = None  # no frame comes within the time
BEGUN_UPLOAD, BEGUN_DOWNLOAD = bytes.fromhex("C6 21 10 00 00 00 00 00"), bytes.fromhex("A4 21 10 00 7F 00 00 00")


class Channel:
    """A client that is answered in turn; what it sends is noted, in hexadecimal."""

    def __init__(self, *answers):
        self.answers = [answer if answer is None else frame(answer) for answer in answers]
        self.sent, self.segments, self.aborted = [], [], []

    def send_request(self, request):
        assert len(request) == 8
        self.sent.append(shown(request))

    def send_patiently(self, request):
        assert len(request) == 8
        self.segments.append(shown(request))

    def read_response(self):
        answer = self.answers.pop(0)
        if answer is NOTHING:
            raise SdoCommunicationError("No SDO response received")
        return answer

    def abort(self, abort_code):
        self.aborted.append(abort_code)


def frame(text):
    return bytes.fromhex(text).ljust(8, b"\0")


def shown(data):
    """Bytes up to the last that is not 0."""
    return data.rstrip(b"\0").hex(" ").upper()


def hexed(data):
    return data.hex(" ").upper()


TEXT = b"ABCDEFGHIJKLMNOPQ"  # 17 bytes: three segments, four bytes of the last one unused
SEGMENTS = [f"01 {hexed(TEXT[:7])}", f"02 {hexed(TEXT[7:14])}", f"83 {hexed(TEXT[14:])}"]
SUM = crc(TEXT).to_bytes(2, "little").hex(" ").upper()
END = f"D1 {SUM}"  # C1h and 4 bytes unused


# --- reading ----------------------------------------------------------------------------------------------------------
def test_requests_name_the_object():
    assert hexed(block_transfer.upload_request(0x1021, 3)) == "A4 21 10 03 7F 00 00 00"
    assert hexed(block_transfer.download_request(0x1021, 3, 0x010203)) == "C6 21 10 03 03 02 01 00"
    assert BLOCK_FROM == 128


@pytest.mark.parametrize(("first", "upload", "download"), [
    (0xC6, True, False), (0xC0, True, False), (0xC4, True, False), (0xC2, True, False),
    (0xC1, False, False),  # the end of one
    (0xA4, False, True), (0xA0, False, True), (0xA2, False, False), (0xA1, False, False),  # an answer, an end
    (0x60, False, False), (0x43, False, False), (0xE0, False, False),
])  # fmt: skip
def test_answers_that_begin_a_transfer(first, upload, download):
    answer = bytes((first,)) + bytes(7)
    assert (block_transfer.is_upload(answer), block_transfer.is_download(answer)) == (upload, download)


def test_a_read_acknowledges_a_sub_block_and_the_end():
    channel = Channel(*SEGMENTS, END)
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    assert channel.sent == ["A3", "A2 03 7F", "A1"] and channel.aborted == []


def test_whole_segments_have_nothing_unused():
    channel = Channel("81 41 42 43 44 45 46 47", f"C1 {crc(b'ABCDEFG').to_bytes(2, 'little').hex()}")
    assert block_transfer.read(channel, BEGUN_UPLOAD) == b"ABCDEFG"


def test_a_sub_block_ends_with_segment_127():
    content = bytes(k & 0xFF for k in range(7 * 128))
    rows = [f"{k + 1:02X} {hexed(content[7 * k : 7 * k + 7])}" for k in range(127)]
    checksum = crc(content).to_bytes(2, "little").hex()
    channel = Channel(*rows, f"81 {hexed(content[-7:])}", f"C1 {checksum}")
    assert block_transfer.read(channel, BEGUN_UPLOAD) == content
    assert channel.sent == ["A3", "A2 7F 7F", "A2 01 7F", "A1"]


def test_what_is_lost_is_asked_for_again():
    """The second of three: the first is acknowledged, and the server begins behind it."""
    channel = Channel(SEGMENTS[0], SEGMENTS[2], f"01 {hexed(TEXT[7:14])}", f"82 {hexed(TEXT[14:])}", END)
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    assert channel.sent == ["A3", "A2 01 7F", "A2 02 7F", "A1"]


def test_a_segment_that_comes_twice_counts_once():
    channel = Channel(SEGMENTS[0], SEGMENTS[0], SEGMENTS[1], SEGMENTS[2], END)
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    assert channel.sent == ["A3", "A2 03 7F", "A1"]


def test_a_sub_block_whose_last_segment_is_lost_is_acknowledged_as_far_as_it_came():
    channel = Channel(SEGMENTS[0], NOTHING, f"01 {hexed(TEXT[7:14])}", f"82 {hexed(TEXT[14:])}", END)
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    assert channel.sent == ["A3", "A2 01 7F", "A2 02 7F", "A1"]


def test_three_sub_blocks_in_a_row_may_be_lost_and_the_fourth_ends_it():
    channel = Channel(
        *[NOTHING] * 3, SEGMENTS[0], *[NOTHING] * 4, f"01 {hexed(TEXT[7:14])}", f"82 {hexed(TEXT[14:])}", END
    )
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    channel = Channel(SEGMENTS[0], *[NOTHING] * 5, SEGMENTS[0])
    with pytest.raises(SdoCommunicationError, match=r"^No SDO response received$"):
        block_transfer.read(channel, BEGUN_UPLOAD)
    assert channel.sent == ["A3", "A2 01 7F", *["A2 00 7F"] * 3] and len(channel.answers) == 1


def test_segments_that_were_sent_twice_are_no_end():
    channel = Channel(*SEGMENTS, SEGMENTS[1], SEGMENTS[2], "A1", "C2", END)
    assert block_transfer.read(channel, BEGUN_UPLOAD) == TEXT
    assert channel.answers == []


def test_a_wrong_checksum_is_told():
    channel = Channel(*SEGMENTS, "D1 34 12")
    with pytest.raises(SdoCommunicationError, match=r"^the checksum of 17 bytes is wrong$"):
        block_transfer.read(channel, BEGUN_UPLOAD)
    assert channel.aborted == [0x05040004] and channel.sent[-1] == "A2 03 7F"
    channel = Channel(*SEGMENTS, "D1 34 12")
    assert block_transfer.read(channel, frame("C2 21 10")) == TEXT, "a server that has none"


# --- writing ----------------------------------------------------------------------------------------------------------
def test_a_write_sends_a_sub_block_and_the_end():
    channel = Channel("A2 03 7F", "A1")
    block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)
    assert channel.segments == [row.removesuffix(" 00") for row in SEGMENTS]
    assert channel.sent == [f"D1 {SUM}"] and channel.aborted == []


def test_whole_segments_are_written_as_they_are():
    channel = Channel("A2 02 7F", "A1")
    block_transfer.write(channel, BEGUN_DOWNLOAD, b"ABCDEFGHIJKLMN")
    assert channel.segments == ["01 41 42 43 44 45 46 47", "82 48 49 4A 4B 4C 4D 4E"]
    assert channel.sent == [shown(b"\xc1" + crc(b"ABCDEFGHIJKLMN").to_bytes(2, "little"))]


def test_the_server_says_how_many_segments_a_sub_block_has():
    channel = Channel("A2 01 02", "A2 02 7F", "A1")
    block_transfer.write(channel, frame("A0 21 10 00 01"), TEXT)
    assert channel.segments == [SEGMENTS[0], f"01 {hexed(TEXT[7:14])}", f"82 {hexed(TEXT[14:])}"]
    assert channel.sent == ["D1"], "a server without a checksum gets none"


def test_what_the_server_has_not_got_is_sent_again():
    channel = Channel("A2 01 7F", "A2 02 7F", "A1")
    block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)
    assert channel.segments == [*SEGMENTS, f"01 {hexed(TEXT[7:14])}", f"82 {hexed(TEXT[14:])}"]
    channel = Channel("A2 7F 7F", "A1")
    block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)
    assert channel.segments == SEGMENTS, "who says more than was sent has all"


def test_a_server_that_loses_four_sub_blocks_in_a_row_is_given_up():
    channel = Channel(*["A2 00 7F"] * 3, "A2 01 7F", *["A2 00 7F"] * 4)
    with pytest.raises(SdoCommunicationError, match=r"^the server takes no blocks of 127 segments, or loses all$"):
        block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)
    assert channel.aborted == [0x05040001] and len(channel.segments) == 4 * 3 + 4 * 2
    channel = Channel(*["A2 00 7F"] * 3, "A2 03 7F", "A1")
    block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)


@pytest.mark.parametrize("size", [0, 128])
def test_a_block_has_1_to_127_segments(size):
    channel = Channel()
    with pytest.raises(SdoCommunicationError, match=f"^the server takes no blocks of {size} segments, or loses all$"):
        block_transfer.write(channel, frame(f"A4 21 10 00 {size:02X}"), TEXT)
    assert channel.aborted == [0x05040001] and channel.segments == []
    for least in (1, 127):
        channel = Channel("A2 01 7F", "A1")
        block_transfer.write(channel, frame(f"A4 21 10 00 {least:02X}"), b"ABC")


@pytest.mark.parametrize("answers", [("A1",), ("C2 03 7F",), ("A2 03 7F", "A2"), ("A2 03 7F", "60")])
def test_another_answer_than_the_expected_one_ends_it(answers):
    channel = Channel(*answers)
    with pytest.raises(SdoCommunicationError, match=f"^Unexpected response 0x{answers[-1][:2]}$"):
        block_transfer.write(channel, BEGUN_DOWNLOAD, TEXT)
    assert channel.aborted == [0x05040001]
