"""The SDO server over objects of this test, as transcripts: lengths, toggle bits, time-outs, and what is left over."""

from __future__ import annotations

import pytest

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, VALUE_TOO_HIGH, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.node.axis import ObjectPort
from drive_env.node.block_transfer import BlockDownload, BlockUpload, crc
from drive_env.node.sdo_server import SdoServer

TIMEOUT = 1.0
BLOCK = 4  # segments
ROOM = 40  # bytes of a text


class Objects:
    """2000h: UNSIGNED8, at most 100; 2001h: INTEGER16; 2002h: INTEGER64; 2003h: a text; 2004h: a text that is fixed."""

    def __init__(self, block_size=0, longest_text=0):
        self.values = {0x2000: 7, 0x2001: -2, 0x2002: 1, 0x2003: "Motor of axis 1", 0x2004: "fixed"}
        self.bits = {0x2000: 8, 0x2001: 16, 0x2002: 64, 0x2003: None, 0x2004: None}
        self.server = SdoServer(self.port, TIMEOUT, block_size, longest_text)

    def port(self, index, sub):
        if index not in self.values or sub:
            raise ObjectAccessError(NO_SUCH_OBJECT, "there is none")
        bits = self.bits[index]
        entry = Entry(index, 0, "Object", bits, "rw", None, None, 0, "", False, signed=index in (0x2001, 0x2002))

        def check(raw):
            if index == 0x2000 and raw > 100:
                raise ObjectAccessError(VALUE_TOO_HIGH, "100 is the most")

        def write(raw):
            self.values[index] = raw

        return ObjectPort(
            entry, lambda: self.values[index], check, write, write_text=write if index == 0x2003 else None
        )

    def play(self, transcript):
        """Let frames go in and compare what comes out; "+0.5" lets half a second pass, "--" is no response."""
        now = getattr(self, "now", 0.0)
        for line in filter(None, map(str.strip, transcript.splitlines())):
            if line.startswith("+"):
                now += float(line)
                continue
            asked, answer = (part.strip() for part in line.split("->"))
            if asked == "expire":
                found = self.server.expire(now)
            elif asked == "next":
                found = self.server.next_segment(now)
            else:
                found = self.server.request(bytes.fromhex(asked), now)
            assert (found.hex(" ").upper() if found is not None else "--") == answer, line
        self.now = now


@pytest.fixture
def objects():
    return Objects()


@pytest.fixture
def blocks():
    return Objects(BLOCK, ROOM)


# --- expedited --------------------------------------------------------------------------------------------------------
def test_short_objects_are_read_in_one_frame(objects):
    objects.play("""
        40 00 20 00 00 00 00 00 -> 4F 00 20 00 07 00 00 00
        40 01 20 00 00 00 00 00 -> 4B 01 20 00 FE FF 00 00
        40 09 20 00 00 00 00 00 -> 80 09 20 00 00 00 02 06
        40 00 20 01 00 00 00 00 -> 80 00 20 01 00 00 02 06
    """)


def test_short_objects_are_written_in_one_frame(objects):
    objects.play("""
        2F 00 20 00 64 00 00 00 -> 60 00 20 00 00 00 00 00
        2F 00 20 00 65 00 00 00 -> 80 00 20 00 31 00 09 06
        2B 01 20 00 FD FF 00 00 -> 60 01 20 00 00 00 00 00
        22 00 20 00 05 FF FF FF -> 60 00 20 00 00 00 00 00
        2B 00 20 00 05 00 00 00 -> 80 00 20 00 12 00 07 06
        2F 01 20 00 05 00 00 00 -> 80 01 20 00 13 00 07 06
        27 01 20 00 05 00 00 00 -> 80 01 20 00 12 00 07 06
        2F 03 20 00 41 00 00 00 -> 80 03 20 00 10 00 07 06
    """)
    assert objects.values[0x2000] == 5 and objects.values[0x2001] == -3


def test_frames_that_are_no_requests(objects):
    objects.play("""
        40 00 20 00 00 00 00 -> --
        40 00 20 00 00 00 00 00 00 -> --
        80 00 20 00 00 00 00 00 -> --
        A0 00 20 00 04 00 00 00 -> 80 00 20 00 01 00 04 05
        C0 00 20 00 04 00 00 00 -> 80 00 20 00 01 00 04 05
        E0 00 20 00 00 00 00 00 -> 80 00 20 00 01 00 04 05
    """)


# --- segments ---------------------------------------------------------------------------------------------------------
def test_a_text_is_read_in_segments(objects):
    objects.play("""
        40 03 20 00 00 00 00 00 -> 41 03 20 00 0F 00 00 00
        60 00 00 00 00 00 00 00 -> 00 4D 6F 74 6F 72 20 6F
        70 00 00 00 00 00 00 00 -> 10 66 20 61 78 69 73 20
        60 00 00 00 00 00 00 00 -> 0D 31 00 00 00 00 00 00
        70 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
    """)


def test_texts_of_whole_segments_and_of_none(objects):
    objects.values[0x2003] = "ABCDEFG"
    objects.play("""
        40 03 20 00 00 00 00 00 -> 41 03 20 00 07 00 00 00
        60 00 00 00 00 00 00 00 -> 01 41 42 43 44 45 46 47
    """)
    objects.values[0x2003] = ""
    objects.play("""
        40 03 20 00 00 00 00 00 -> 41 03 20 00 00 00 00 00
        60 00 00 00 00 00 00 00 -> 0F 00 00 00 00 00 00 00
    """)
    objects.values[0x2003] = "ABCD"
    objects.play("40 03 20 00 00 00 00 00 -> 43 03 20 00 41 42 43 44")
    objects.values[0x2003] = "\u20ac\xe4"
    objects.play("40 03 20 00 00 00 00 00 -> 4B 03 20 00 3F E4 00 00")  # latin-1 has no euro


def test_a_toggle_bit_that_does_not_alternate_ends_the_transfer(objects):
    objects.play("""
        40 03 20 00 00 00 00 00 -> 41 03 20 00 0F 00 00 00
        70 00 00 00 00 00 00 00 -> 80 03 20 00 00 00 03 05
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
    """)


def test_a_long_number_is_written_in_segments(objects):
    objects.play("""
        21 02 20 00 08 00 00 00 -> 60 02 20 00 00 00 00 00
        00 01 02 03 04 05 06 07 -> 20 00 00 00 00 00 00 00
        1D FF 00 00 00 00 00 00 -> 30 00 00 00 00 00 00 00
        1D FF 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
    """)
    assert objects.values[0x2002] == int.from_bytes(bytes.fromhex("01020304050607FF"), "little", signed=True)


def test_lengths_of_segments_are_held_against_the_object_and_what_was_announced(objects):
    objects.play("""
        21 02 20 00 07 00 00 00 -> 80 02 20 00 13 00 07 06
        21 02 20 00 09 00 00 00 -> 80 02 20 00 12 00 07 06
        20 02 20 00 09 00 00 00 -> 60 02 20 00 00 00 00 00
        00 01 02 03 04 05 06 07 -> 20 00 00 00 00 00 00 00
        1B 08 09 00 00 00 00 00 -> 80 02 20 00 12 00 07 06
        20 02 20 00 00 00 00 00 -> 60 02 20 00 00 00 00 00
        01 01 02 03 04 05 06 07 -> 80 02 20 00 13 00 07 06
    """)
    assert objects.values[0x2002] == 1
    several = Objects(0, ROOM)
    several.play("""
        21 03 20 00 03 00 00 00 -> 60 03 20 00 00 00 00 00
        0B 41 42 00 00 00 00 00 -> 80 03 20 00 13 00 07 06
        21 03 20 00 01 00 00 00 -> 60 03 20 00 00 00 00 00
        0B 41 42 00 00 00 00 00 -> 80 03 20 00 12 00 07 06
        21 03 20 00 28 00 00 00 -> 60 03 20 00 00 00 00 00
        21 03 20 00 29 00 00 00 -> 80 03 20 00 05 00 04 05
        20 03 20 00 00 00 00 00 -> 60 03 20 00 00 00 00 00
        0B 41 E4 00 00 00 00 00 -> 20 00 00 00 00 00 00 00
    """)
    assert several.values[0x2003] == "A\xe4"
    several.play("""
        20 04 20 00 00 00 00 00 -> 60 04 20 00 00 00 00 00
        0B 41 42 00 00 00 00 00 -> 80 04 20 00 20 00 00 08
    """)


def test_a_text_of_three_segments_is_written():
    objects = Objects(0, ROOM)
    objects.play("""
        21 03 20 00 10 00 00 00 -> 60 03 20 00 00 00 00 00
        00 41 42 43 44 45 46 47 -> 20 00 00 00 00 00 00 00
        10 48 49 4A 4B 4C 4D 4E -> 30 00 00 00 00 00 00 00
        0B 4F 50 00 00 00 00 00 -> 20 00 00 00 00 00 00 00
    """)
    assert objects.values[0x2003] == "ABCDEFGHIJKLMNOP"


def test_more_than_an_object_has_room_for_is_refused_before_the_last_segment(objects):
    objects.play("""
        20 02 20 00 00 00 00 00 -> 60 02 20 00 00 00 00 00
        00 01 02 03 04 05 06 07 -> 20 00 00 00 00 00 00 00
        10 01 02 03 04 05 06 07 -> 80 02 20 00 12 00 07 06
    """)


@pytest.mark.parametrize("closed", [False, True])
def test_a_segment_that_comes_first_of_all_is_none_of_a_transfer(closed):
    for made in (Objects(), Objects(BLOCK, ROOM)):
        if closed:
            made.server.close()
        made.play("00 41 42 43 44 45 46 47 -> 80 00 00 00 01 00 04 05")


def test_segments_of_the_other_direction_are_none_of_the_open_transfer(objects):
    objects.play("""
        40 03 20 00 00 00 00 00 -> 41 03 20 00 0F 00 00 00
        00 01 02 03 04 05 06 07 -> 80 03 20 00 01 00 04 05
        21 02 20 00 08 00 00 00 -> 60 02 20 00 00 00 00 00
        60 00 00 00 00 00 00 00 -> 80 02 20 00 01 00 04 05
    """)


def test_another_request_and_an_abort_and_closing_end_the_open_transfer(objects):
    for between in (
        "40 00 20 00 00 00 00 00 -> 4F 00 20 00 07 00 00 00",
        "2F 00 20 00 07 00 00 00 -> 60 00 20 00 00 00 00 00",
        "80 03 20 00 00 00 00 08 -> --",
        "E0 03 20 00 00 00 00 00 -> 80 03 20 00 01 00 04 05",
        "",
    ):
        objects.play("40 03 20 00 00 00 00 00 -> 41 03 20 00 0F 00 00 00")
        objects.play(between) if between else objects.server.close()
        objects.play("60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05")


# --- time-outs --------------------------------------------------------------------------------------------------------
def test_a_transfer_is_given_up_after_its_time_counted_from_the_last_segment(objects):
    objects.play("""
        expire -> --
        40 03 20 00 00 00 00 00 -> 41 03 20 00 0F 00 00 00
        +0.9
        expire -> --
        60 00 00 00 00 00 00 00 -> 00 4D 6F 74 6F 72 20 6F
        +0.9
        expire -> --
        +0.1
        expire -> 80 03 20 00 00 00 04 05
        expire -> --
        70 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
    """)


def test_a_block_is_given_up_after_its_time(blocks):
    blocks.play("""
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        +0.9
        01 41 42 43 44 45 46 47 -> --
        +0.9
        expire -> --
        +0.1
        expire -> 80 03 20 00 00 00 04 05
        expire -> --
        A4 03 20 00 04 00 00 00 -> C6 03 20 00 0F 00 00 00
        A3 00 00 00 00 00 00 00 -> --
        +0.9
        next -> 01 4D 6F 74 6F 72 20 6F
        +0.9
        expire -> --
        +0.1
        expire -> 80 03 20 00 00 00 04 05
        next -> --
    """)


# --- blocks -----------------------------------------------------------------------------------------------------------
def test_a_text_is_read_in_blocks(blocks):
    check = crc(b"Motor of axis 1").to_bytes(2, "little").hex(" ").upper()
    blocks.play(f"""
        A4 03 20 00 02 00 00 00 -> C6 03 20 00 0F 00 00 00
        next -> --
        A3 00 00 00 00 00 00 00 -> --
        next -> 01 4D 6F 74 6F 72 20 6F
        next -> 02 66 20 61 78 69 73 20
        next -> --
        A2 02 02 00 00 00 00 00 -> --
        next -> 81 31 00 00 00 00 00 00
        next -> --
        A2 01 02 00 00 00 00 00 -> D9 {check} 00 00 00 00 00
        A1 00 00 00 00 00 00 00 -> --
        A1 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
    """)
    assert blocks.server.block is None


def test_segments_that_were_lost_are_sent_again(blocks):
    blocks.play("""
        A4 03 20 00 7F 00 00 00 -> C6 03 20 00 0F 00 00 00
        A3 00 00 00 00 00 00 00 -> --
        next -> 01 4D 6F 74 6F 72 20 6F
        next -> 02 66 20 61 78 69 73 20
        next -> 83 31 00 00 00 00 00 00
        A2 01 7F 00 00 00 00 00 -> --
        next -> 01 66 20 61 78 69 73 20
        next -> 82 31 00 00 00 00 00 00
        A2 00 7F 00 00 00 00 00 -> --
        next -> 01 66 20 61 78 69 73 20
        A2 02 7F 00 00 00 00 00 -> 80 03 20 00 03 00 04 05
    """)


@pytest.mark.parametrize(("size", "is_taken"), [(0, False), (1, True), (127, True), (128, False)])
def test_a_block_has_1_to_127_segments(size, is_taken):
    answer = "C6 03 20 00 0F 00 00 00" if is_taken else "80 03 20 00 02 00 04 05"
    Objects(BLOCK, ROOM).play(f"A4 03 20 00 {size:02X} 00 00 00 -> {answer}")
    if not is_taken:
        Objects(BLOCK, ROOM).play(f"""
            A4 03 20 00 7F 00 00 00 -> C6 03 20 00 0F 00 00 00
            A3 00 00 00 00 00 00 00 -> --
            next -> 01 4D 6F 74 6F 72 20 6F
            A2 01 {size:02X} 00 00 00 00 00 -> 80 03 20 00 02 00 04 05
        """)


def test_up_to_the_threshold_of_the_client_a_text_is_read_in_segments(blocks):
    blocks.play("""
        A4 03 20 00 04 0E 00 00 -> C6 03 20 00 0F 00 00 00
        80 03 20 00 00 00 00 08 -> --
        A4 03 20 00 04 0F 00 00 -> 41 03 20 00 0F 00 00 00
        60 00 00 00 00 00 00 00 -> 00 4D 6F 74 6F 72 20 6F
    """)


def test_a_text_is_written_in_blocks(blocks):
    text = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefgh"  # five segments, of the last one byte is unused
    check = crc(text).to_bytes(2, "little").hex(" ").upper()
    blocks.play(f"""
        C6 03 20 00 22 00 00 00 -> A4 03 20 00 04 00 00 00
        01 {text[:7].hex(" ")} -> --
        02 {text[7:14].hex(" ")} -> --
        03 {text[14:21].hex(" ")} -> --
        04 {text[21:28].hex(" ")} -> A2 04 04 00 00 00 00 00
        81 {text[28:].hex(" ")} 00 -> A2 01 04 00 00 00 00 00
        C5 {check} 00 00 00 00 00 -> A1 00 00 00 00 00 00 00
    """)
    assert blocks.values[0x2003] == text.decode() and blocks.server.block is None


def test_a_segment_that_was_lost_is_asked_for(blocks):
    blocks.play("""
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        01 41 42 43 44 45 46 47 -> --
        03 41 42 43 44 45 46 47 -> --
        04 41 42 43 44 45 46 47 -> A2 01 04 00 00 00 00 00
        82 48 00 00 00 00 00 00 -> A2 00 04 00 00 00 00 00
        81 48 00 00 00 00 00 00 -> A2 01 04 00 00 00 00 00
        D9 00 00 00 00 00 00 00 -> 80 03 20 00 04 00 04 05
    """)


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        ("00 41 42 43 44 45 46 47", "03 00 04 05"),  # there is no segment 0
        ("05 41 42 43 44 45 46 47", "03 00 04 05"),  # nor a fifth
    ],
)
def test_sequence_numbers_that_cannot_be(blocks, frame, code):
    blocks.play(f"""
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        {frame} -> 80 03 20 00 {code}
    """)


def test_without_a_checksum_of_the_client_none_is_looked_at(blocks):
    blocks.play("""
        C0 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        81 41 42 00 00 00 00 00 -> A2 01 04 00 00 00 00 00
        D5 FF FF 00 00 00 00 00 -> A1 00 00 00 00 00 00 00
    """)
    assert blocks.values[0x2003] == "AB"


def test_blocks_longer_or_shorter_than_the_object_or_than_was_said(blocks):
    blocks.play("""
        C2 03 20 00 29 00 00 00 -> 80 03 20 00 05 00 04 05
        C2 02 20 00 07 00 00 00 -> 80 02 20 00 13 00 07 06
        C2 03 20 00 03 00 00 00 -> A4 03 20 00 04 00 00 00
        81 41 42 00 00 00 00 00 -> A2 01 04 00 00 00 00 00
        D5 00 00 00 00 00 00 00 -> 80 03 20 00 13 00 07 06
        C0 00 20 00 00 00 00 00 -> A4 00 20 00 04 00 00 00
        01 41 42 43 44 45 46 47 -> --
        02 41 42 43 44 45 46 47 -> 80 00 20 00 05 00 04 05
    """)


def test_segments_on_their_way_when_a_block_was_aborted_are_no_requests(blocks):
    """Their data name an object, as those of a request do."""
    blocks.play("""
        C0 00 20 00 00 00 00 00 -> A4 00 20 00 04 00 00 00
        01 41 42 43 44 45 46 47 -> --
        02 41 42 43 44 45 46 47 -> 80 00 20 00 05 00 04 05
        03 00 20 00 2A 00 00 00 -> --
        04 00 20 00 2A 00 00 00 -> --
        2F 00 20 00 2A 00 00 00 -> 60 00 20 00 00 00 00 00
    """)
    assert blocks.values[0x2000] == 0x2A


ABORTED_BLOCK = """
    C0 00 20 00 00 00 00 00 -> A4 00 20 00 04 00 00 00
    01 41 42 43 44 45 46 47 -> --
    02 41 42 43 44 45 46 47 -> 80 00 20 00 05 00 04 05
"""


@pytest.mark.parametrize("after", [
    "2F 00 20 00 2A 00 00 00 -> 60 00 20 00 00 00 00 00",  # no segment in turn
    "83 00 20 00 2A 00 00 00 -> --",  # the last segment
    "80 00 00 00 00 00 00 08 -> --",  # an abort
    "04 00 20 00 2A 00 00 00 -> 80 00 00 00 01 00 04 05",  # one was lost: the fourth is none in turn
])  # fmt: skip
def test_what_follows_an_aborted_block_out_of_turn_ends_its_segments(blocks, after):
    blocks.play(ABORTED_BLOCK)
    blocks.play(after)
    blocks.play(
        """
        04 41 42 43 44 45 46 47 -> 80 00 00 00 01 00 04 05
        00 41 42 43 44 45 46 47 -> 80 00 00 00 01 00 04 05
        40 00 20 00 00 00 00 00 -> 4F 00 20 00 %s 00 00 00
    """
        % ("2A" if after[:2] == "2F" else "07")
    )


@pytest.mark.parametrize("transcript", [
    """
    C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
    05 41 42 43 44 45 46 47 -> 80 03 20 00 03 00 04 05
    """, """
    C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
    01 41 42 43 44 45 46 47 -> --
    04 41 42 43 44 45 46 47 -> A2 01 04 00 00 00 00 00
    05 41 42 43 44 45 46 47 -> 80 03 20 00 03 00 04 05
    """, """
    A4 03 20 00 04 00 00 00 -> C6 03 20 00 0F 00 00 00
    A2 01 04 00 00 00 00 00 -> 80 03 20 00 01 00 04 05
    """,
], ids=["at once", "after a sub-block", "an upload"])  # fmt: skip
def test_nothing_follows_a_block_of_which_no_segment_is_on_its_way(blocks, transcript):
    blocks.play(transcript)
    blocks.play("00 41 42 43 44 45 46 47 -> 80 00 00 00 01 00 04 05")


def test_a_threshold_of_0_is_none(blocks):
    blocks.values[0x2003] = ""
    blocks.play("A4 03 20 00 04 00 00 00 -> C6 03 20 00 00 00 00 00")


def test_another_request_ends_a_block(blocks):
    blocks.play("""
        A4 03 20 00 02 00 00 00 -> C6 03 20 00 0F 00 00 00
        40 00 20 00 00 00 00 00 -> 4F 00 20 00 07 00 00 00
        A3 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
        A4 03 20 00 02 00 00 00 -> C6 03 20 00 0F 00 00 00
        A2 01 02 00 00 00 00 00 -> 80 03 20 00 01 00 04 05
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        80 03 20 00 00 00 00 08 -> --
        01 41 42 43 44 45 46 47 -> 80 00 00 00 01 00 04 05
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
        81 41 42 00 00 00 00 00 -> A2 01 04 00 00 00 00 00
        C4 03 20 00 00 00 00 00 -> A4 03 20 00 04 00 00 00
    """)


def test_the_room_of_a_block_is_whole_segments_and_at_least_one():
    for room, segments in ((0, 1), (7, 1), (8, 2), (14, 2)):
        download = BlockDownload(bytes.fromhex("C4 03 20 00 00 00 00 00"), 127, room)
        for number in range(1, segments + 1):
            assert download.request(bytes((number,)) + bytes(7)) is None
        with pytest.raises(ObjectAccessError):
            download.request(bytes((segments + 1,)) + bytes(7))


def test_of_no_data_there_is_one_empty_segment():
    upload = BlockUpload(bytes.fromhex("A4 03 20 00 04 00 00 00"), b"")
    assert upload.initiated().hex() == "c603200000000000"
    assert upload.request(bytes.fromhex("A3 00 00 00 00 00 00 00")) is None
    assert upload.next_segment() == b"\x81" + bytes(7)
    assert upload.request(bytes.fromhex("A2 01 04 00 00 00 00 00")) == b"\xdd" + bytes(7)
    assert not upload.is_confirmed(bytes.fromhex("A2 00 00 00 00 00 00 00"))
    assert upload.is_confirmed(bytes.fromhex("A1 00 00 00 00 00 00 00"))


def test_the_checksum_is_that_of_the_standard():
    assert crc(b"123456789") == 0x31C3
