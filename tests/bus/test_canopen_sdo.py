"""The SDO server, as transcripts (CiA 301, 7.2.4): transfers, their abort codes, and what ends one."""

from __future__ import annotations

import time

import pytest


# --- expedited upload -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("request_", "response"),
    [
        ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 FC FF"),  # UNSIGNED32: device type
        ("40 01 10 00 00 00 00 00", "4F 01 10 00 00 00 00 00"),  # UNSIGNED8
        ("40 05 10 00 00 00 00 00", "43 05 10 00 80 00 00 00"),
        ("40 09 10 00 00 00 00 00", "47 09 10 00 31 2E 30 00"),  # three letters: 1.0
        ("40 0A 10 00 00 00 00 00", "43 0A 10 00 31 2E 30 39"),  # four: 1.09
        ("40 14 10 00 00 00 00 00", "43 14 10 00 85 00 00 00"),  # 80h + node
        ("40 10 10 00 00 00 00 00", "4F 10 10 00 04 00 00 00"),
        ("40 10 10 01 00 00 00 00", "43 10 10 01 01 00 00 00"),  # can be stored
        ("40 11 10 04 00 00 00 00", "43 11 10 04 01 00 00 00"),
        ("40 17 10 00 00 00 00 00", "4B 17 10 00 00 00 00 00"),  # UNSIGNED16
        ("40 18 10 00 00 00 00 00", "4F 18 10 00 03 00 00 00"),
        ("40 18 10 01 00 00 00 00", "43 18 10 01 86 02 00 00"),
        ("40 18 10 02 00 00 00 00", "43 18 10 02 64 06 00 00"),
        ("40 00 14 01 00 00 00 00", "43 00 14 01 05 02 00 40"),  # bit 30 reads 1
        ("40 03 14 02 00 00 00 00", "4F 03 14 02 FE 00 00 00"),
        ("40 02 18 01 00 00 00 00", "43 02 18 01 85 03 00 40"),
        ("40 02 16 02 00 00 00 00", "43 02 16 02 20 00 7A 60"),
        ("40 03 1A 02 00 00 00 00", "43 03 1A 02 20 00 6C 60"),
        ("40 41 60 00 00 00 00 00", "4B 41 60 00 50 02 00 00"),
        ("40 61 60 00 00 00 00 00", "4F 61 60 00 00 00 00 00"),  # INTEGER8
        ("40 C2 60 02 00 00 00 00", "4F C2 60 02 FD 00 00 00"),  # INTEGER8: -3
        ("40 7D 60 01 00 00 00 00", "43 7D 60 01 00 00 00 80"),  # INTEGER32: -2147483648
        ("40 67 60 00 00 00 00 00", "43 67 60 00 .. .. .. .."),
        ("40 04 27 00 00 00 00 00", "4B 04 27 00 E8 03 00 00"),
        ("40 05 27 00 00 00 00 00", "4F 05 27 00 05 00 00 00"),
        ("40 07 27 00 00 00 00 00", "4B 07 27 00 E8 03 00 00"),
        ("40 08 27 00 00 00 00 00", "4F 08 27 00 05 00 00 00"),
        ("40 FF 5F 00 00 00 00 00", "43 FF 5F 00 00 00 00 00"),  # always reads as zero
        ("5F 41 60 00 FF FF FF FF", "4B 41 60 00 50 02 00 00"),  # reserved bits and bytes are ignored
    ],
)
def test_expedited_upload(wire, request_, response):
    wire.play(f"rx 605  {request_}\ntx 585  {response}")


# --- expedited download -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("request_", "index", "sub", "value"),
    [
        ("2F 29 10 01 01 00 00 00", 0x1029, 1, 1),  # one byte
        ("2B 17 10 00 E8 03 00 00", 0x1017, 0, 1000),  # two
        ("23 81 60 00 FF FF FF FF", 0x6081, 0, 0xFFFF_FFFF),  # four
        ("23 7A 60 00 FF FF FF FF", 0x607A, 0, -1),
        ("2F 60 60 00 0A 00 00 00", 0x6060, 0, 10),
        ("2B 71 60 00 00 80 00 00", 0x6071, 0, -32768),
        ("2F C2 60 02 FD 00 00 00", 0x60C2, 2, -3),
        ("22 81 60 00 78 56 34 12", 0x6081, 0, 0x1234_5678),  # size not indicated: the object's
        ("22 17 10 00 64 00 AA BB", 0x1017, 0, 100),
        ("2F 41 20 01 07 00 00 00", 0x2041, 1, None),  # see below: too short
        ("23 6C 60 00 00 00 00 00", 0x606C, 0, None),
        ("23 05 10 00 81 00 00 00", 0x1005, 0, 0x81),
        ("23 16 10 01 64 00 07 00", 0x1016, 1, 0x0007_0064),
        ("2B 04 27 00 7D 00 00 00", 0x2704, 0, 125),
        ("2F 05 27 00 7F 00 00 00", 0x2705, 0, 127),
        ("23 03 27 01 00 00 0F 00", 0x2703, 1, 0x000F_0000),
    ],
)
def test_expedited_download(wire, request_, index, sub, value):
    if value is None:
        before = wire.value(index, sub)
        (answer,) = wire.receive(0x605, request_)
        assert answer.data[0] == 0x80
        assert wire.value(index, sub) == before
        return
    multiplexor = request_[3:11]
    wire.play(f"rx 605  {request_}\ntx 585  60 {multiplexor} 00 00 00 00")
    assert wire.value(index, sub) == value


# --- what is refused --------------------------------------------------------------------------------------------------
REFUSED = [
    # does not exist
    ("40 99 99 00 00 00 00 00", "06020000"),
    ("40 44 60 00 00 00 00 00", "06020000"),  # vl target velocity: no vl mode
    ("40 03 10 00 00 00 00 00", "06020000"),  # this device has no error history
    ("40 06 10 00 00 00 00 00", "06020000"),  # nor a SYNC period
    ("40 00 00 00 00 00 00 00", "06020000"),
    ("40 40 68 00 00 00 00 00", "06020000"),  # nor a second axis
    ("2B 44 60 00 00 00 00 00", "06020000"),
    ("40 41 60 01 00 00 00 00", "06090011"),  # a sub-index above 0 of a VAR
    ("40 00 10 01 00 00 00 00", "06090011"),
    ("2B 40 60 01 06 00 00 00", "06090011"),
    ("40 18 10 04 00 00 00 00", "06090011"),
    ("40 18 10 FF 00 00 00 00", "06090011"),
    ("40 10 10 05 00 00 00 00", "06090011"),  # no second motor
    ("23 16 10 02 00 00 00 00", "06090011"),
    # access
    ("2B 41 60 00 00 00 00 00", "06010002"),
    ("23 00 10 00 00 00 00 00", "06010002"),
    ("23 41 60 00 00 00 00 00", "06010002"),  # also with the wrong length
    ("2F 18 10 00 03 00 00 00", "06010002"),
    ("23 64 60 00 00 00 00 00", "06010002"),
    ("2F 04 18 00 00 00 00 00", "06020000"),
    ("2F 00 18 04 00 00 00 00", "06010002"),  # compatibility entry
    ("2B 07 27 00 E8 03 00 00", "06010002"),
    ("2F 08 27 00 05 00 00 00", "06010002"),
    ("23 08 10 00 41 42 43 44", "06010002"),
    # length
    ("2F 17 10 00 01 00 00 00", "06070013"),
    ("23 17 10 00 01 00 00 00", "06070012"),
    ("2B 60 60 00 01 00 00 00", "06070012"),
    ("2B 81 60 00 01 00 00 00", "06070013"),
    ("27 81 60 00 01 00 00 00", "06070013"),  # three bytes
    ("2B 10 10 01 73 61 00 00", "06070013"),
    ("2F 41 20 01 07 00 00 00", "06070013"),
    # range
    ("2F 60 60 00 0B 00 00 00", "06090031"),
    ("2F 60 60 00 FF 00 00 00", "06090032"),  # -1
    ("2F 60 60 00 02 00 00 00", "06090030"),  # vl
    ("2B 5A 60 00 03 00 00 00", "06090030"),
    ("2B 5A 60 00 00 00 00 00", "06090032"),
    ("2B 5A 60 00 07 00 00 00", "06090031"),
    ("23 03 20 00 C9 AF 00 00", "06090031"),  # 45,001 mA
    ("23 65 60 00 00 00 00 80", "06090031"),
    ("23 58 20 00 00 00 00 00", "06090032"),  # no increments per revolution
    ("2F 50 20 00 02 00 00 00", "06090030"),
    ("2F 56 20 00 00 00 00 00", "06090032"),
    ("2B 04 27 00 1E 00 00 00", "06090030"),  # 30 kbit/s
    ("2B 04 27 00 0A 00 00 00", "06090032"),
    ("2B 04 27 00 D0 07 00 00", "06090031"),
    ("2F 05 27 00 00 00 00 00", "06090032"),
    ("2F 05 27 00 80 00 00 00", "06090031"),
    ("2F 29 10 01 03 00 00 00", "06090031"),
    ("2F 29 10 02 FF 00 00 00", "06090031"),
    # identifiers
    ("23 05 10 00 80 00 00 40", "06090030"),  # SYNC producer
    ("23 05 10 00 80 00 00 20", "06090030"),  # 29 bits
    ("23 05 10 00 80 00 00 80", "06090030"),
    ("23 05 10 00 80 08 00 00", "06090030"),
    ("23 05 10 00 00 00 00 00", "06090030"),  # NMT's
    ("23 05 10 00 05 06 00 00", "06090030"),  # an SDO's
    ("23 05 10 00 05 07 00 00", "06090030"),  # a heartbeat's
    ("23 14 10 00 86 00 00 00", "08000022"),  # in use: its bit 31 first
    ("23 14 10 00 85 00 00 20", "06090030"),
    ("23 14 10 00 85 00 00 40", "06090030"),
    ("23 00 14 01 06 02 00 40", "08000022"),
    ("23 00 18 01 86 01 00 40", "08000022"),
    ("23 00 14 01 05 02 00 20", "06090030"),
    ("23 00 14 01 05 0A 00 40", "06090030"),
    # transmission types that are reserved or need remote frames, and what must not change while a PDO is in use
    ("2F 00 14 02 F1 00 00 00", "06090030"),
    ("2F 00 14 02 FC 00 00 00", "06090030"),
    ("2F 00 14 02 FD 00 00 00", "06090030"),
    ("2F 00 18 02 F1 00 00 00", "06090030"),
    ("2F 00 18 02 FC 00 00 00", "06090030"),
    ("2F 00 18 02 FD 00 00 00", "06090030"),
    ("2B 00 18 03 05 00 00 00", "08000022"),
    # signatures
    ("23 10 10 01 6C 6F 61 64", "08000020"),  # "load" to store
    ("23 10 10 02 00 00 00 00", "08000020"),
    ("23 11 10 01 73 61 76 65", "08000020"),  # "save" to restore
    ("23 11 10 04 65 76 61 73", "08000020"),
    ("23 06 27 00 00 00 00 00", "08000020"),
    ("23 FF 5F 00 01 00 00 00", "06090030"),
    ("23 FF 5F 00 79 56 34 12", "06090030"),
    # state
    ("2F 60 60 00 00 00 00 00", "08000022"),  # the same mode again
]


@pytest.mark.parametrize(("request_", "code"), REFUSED)
def test_a_refused_access_names_the_object_and_changes_nothing(wire, request_, code):
    abort = bytes.fromhex(code)[::-1].hex(" ").upper()
    index, sub = int(request_[6:8] + request_[3:5], 16), int(request_[9:11], 16)
    before = {key: port.read() for key, port in wire.node.dictionary._ports.items() if key != (index, sub)}
    wire.play(f"rx 605  {request_}\ntx 585  80 {request_[3:11]} {abort}")
    assert all(wire.value(*key) == value for key, value in before.items())


def test_an_object_of_one_state_is_refused_in_another(wire):
    wire.play("""
        rx 605  2B 40 60 00 06 00 00 00   # ready to switch on
        tx 585  60 40 60 00 00 00 00 00
        rx 605  23 05 20 00 00 00 00 00   # limit switches: in switch on disabled only
        tx 585  80 05 20 00 22 00 00 08
        rx 605  2B 40 60 00 00 00 00 00
        tx 585  60 40 60 00 00 00 00 00
        rx 605  23 05 20 00 00 00 00 00
        tx 585  60 05 20 00 00 00 00 00
    """)


# --- segmented upload -------------------------------------------------------------------------------------------------
def test_a_text_is_uploaded_in_segments(wire):
    wire.play("""
        rx 605  40 08 10 00 00 00 00 00
        tx 585  41 08 10 00 09 00 00 00   # nine letters
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 54 4D 43 4D 2D 31 36   # TMCM-16
        rx 605  70 00 00 00 00 00 00 00
        tx 585  1B 33 36 00 00 00 00 00   # 36, five bytes without data, the last
        rx 605  60 00 00 00 00 00 00 00   # it is over
        tx 585  80 00 00 00 01 00 04 05
    """)


# --- segmented download -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("initiate", "code"),
    [
        ("21 81 60 00 05 00 00 00", "12 00 07 06"),
        ("21 81 60 00 02 00 00 00", "13 00 07 06"),
        ("21 81 60 00 00 00 00 00", "13 00 07 06"),
        ("21 81 60 00 FF FF FF FF", "12 00 07 06"),
        ("21 41 60 00 02 00 00 00", "02 00 01 06"),
        ("20 41 60 00 00 00 00 00", "02 00 01 06"),
        ("21 99 99 00 04 00 00 00", "00 00 02 06"),
        ("21 81 60 01 04 00 00 00", "11 00 09 06"),
    ],
)
def test_a_segmented_download_is_refused_at_once(wire, initiate, code):
    wire.play(f"""
        rx 605  {initiate}
        tx 585  80 {initiate[3:11]} {code}
        rx 605  07 78 56 34 12 00 00 00
        tx 585  80 00 00 00 01 00 04 05
    """)


@pytest.mark.parametrize(
    ("segment", "code"),
    [
        ("00 01 02 03 04 05 06 07", "12 00 07 06"),  # more than the object has, and more to come
        ("05 01 02 03 04 05 00 00", "12 00 07 06"),
        ("0B 01 02 00 00 00 00 00", "13 00 07 06"),  # the last, with two bytes
        ("0F 00 00 00 00 00 00 00", "13 00 07 06"),  # the last, with none
        ("17 01 02 03 04 00 00 00", "00 00 03 05"),  # toggle
    ],
)
@pytest.mark.parametrize("initiate", ["21 81 60 00 04 00 00 00", "20 81 60 00 00 00 00 00"])
def test_a_wrong_segment_ends_the_download(wire, initiate, segment, code):
    before = wire.value(0x6081)
    wire.play(f"""
        rx 605  {initiate}
        tx 585  60 81 60 00 00 00 00 00
        rx 605  {segment}
        tx 585  80 81 60 00 {code}
        rx 605  07 78 56 34 12 00 00 00   # it is over
        tx 585  80 00 00 00 01 00 04 05
    """)
    assert wire.value(0x6081) == before


def test_a_value_out_of_range_is_refused_with_the_last_segment(wire):
    wire.play("""
        rx 605  21 03 20 00 04 00 00 00
        tx 585  60 03 20 00 00 00 00 00
        rx 605  07 C9 AF 00 00 00 00 00   # 45,001 mA
        tx 585  80 03 20 00 31 00 09 06
    """)


def test_the_client_aborts_a_download(wire):
    before = wire.value(0x6081)
    wire.play("""
        rx 605  21 81 60 00 04 00 00 00
        tx 585  60 81 60 00 00 00 00 00
        rx 605  0A 01 02 00 00 00 00 00
        tx 585  20 00 00 00 00 00 00 00
        rx 605  80 81 60 00 00 00 00 08
        rx 605  1B 03 04 00 00 00 00 00
        tx 585  80 00 00 00 01 00 04 05
    """)
    assert wire.value(0x6081) == before


# --- one transfer at a time -------------------------------------------------------------------------------------------
def test_a_second_transfer_replaces_an_open_one(wire):
    before = wire.value(0x6081)
    wire.play("""
        rx 605  21 81 60 00 04 00 00 00   # a download is open
        tx 585  60 81 60 00 00 00 00 00
        rx 605  0A 01 02 00 00 00 00 00
        tx 585  20 00 00 00 00 00 00 00
        rx 605  40 41 60 00 00 00 00 00   # something else in between
        tx 585  4B 41 60 00 50 02 00 00
        rx 605  1B 03 04 00 00 00 00 00   # the download is no more
        tx 585  80 00 00 00 01 00 04 05
        rx 605  40 08 10 00 00 00 00 00   # an upload is open
        tx 585  41 08 10 00 09 00 00 00
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 54 4D 43 4D 2D 31 36
        rx 605  40 08 10 00 00 00 00 00   # and again, from the beginning
        tx 585  41 08 10 00 09 00 00 00
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 54 4D 43 4D 2D 31 36
        rx 605  21 81 60 00 04 00 00 00   # replaced by a download
        tx 585  60 81 60 00 00 00 00 00
        rx 605  07 01 00 00 00 00 00 00
        tx 585  20 00 00 00 00 00 00 00
    """)
    assert before != 1
    assert wire.value(0x6081) == 1


def test_a_segment_of_the_other_direction_ends_the_transfer(wire):
    wire.play("""
        rx 605  21 81 60 00 04 00 00 00
        tx 585  60 81 60 00 00 00 00 00
        rx 605  60 00 00 00 00 00 00 00
        tx 585  80 81 60 00 01 00 04 05
        rx 605  40 08 10 00 00 00 00 00
        tx 585  41 08 10 00 09 00 00 00
        rx 605  07 01 00 00 00 00 00 00
        tx 585  80 08 10 00 01 00 04 05
    """)


@pytest.mark.parametrize("segment", ["00 01 02 03 04 05 06 07", "60 00 00 00 00 00 00 00"])
def test_a_segment_out_of_nowhere(wire, segment):
    wire.play(f"rx 605  {segment}\ntx 585  80 00 00 00 01 00 04 05")


@pytest.mark.parametrize("length", [0, 1, 4, 7])
def test_a_request_has_eight_bytes(wire, length):
    assert wire.receive(0x605, "4041600000000000"[: 2 * length]) == []


# --- time-out ---------------------------------------------------------------------------------------------------------
def test_a_silent_client_is_given_up(wire):
    wire.play("""
        rx 605  21 81 60 00 04 00 00 00
        tx 585  60 81 60 00 00 00 00 00
        wait 999 ms
        rx 605  0A 01 02 00 00 00 00 00   # in time: the second begins anew
        tx 585  20 00 00 00 00 00 00 00
        wait 999 ms
        wait 1 ms
        tx 585  80 81 60 00 00 00 04 05
        wait 2000 ms                      # once
        rx 605  1B 03 04 00 00 00 00 00
        tx 585  80 00 00 00 01 00 04 05
    """)


def test_no_transfer_no_time_out(wire):
    wire.play("""
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 50 02 00 00
        wait 1500 ms
    """)


# --- state ------------------------------------------------------------------------------------------------------------
def test_5000_transfers_a_second(wire):
    """DESIGN, section 10; it does some hundred thousand, so a busy machine passes too."""
    request, count = bytes.fromhex("40 64 60 00 00 00 00 00"), 5000
    from drive_env.canopen.frames import Frame

    start = time.process_time()  # a computer that does something else meanwhile does not count
    for _ in range(count):
        wire.node.receive(Frame(0x605, request), 0.0)
    elapsed = time.process_time() - start
    assert len(wire.take()) == count
    assert elapsed < 1.0
