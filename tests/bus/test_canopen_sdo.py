"""SDO of the TMCM-1636, as transcripts: its objects on the wire, and what it refuses with which abort code."""

from __future__ import annotations

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


# --- what is refused (unknown objects, access, length and limits: test_conformance_sdo.py) ----------------------------
REFUSED = [
    # values between the limits
    ("2F 60 60 00 02 00 00 00", "06090030"),  # vl
    ("2B 5A 60 00 03 00 00 00", "06090030"),
    ("2F 50 20 00 02 00 00 00", "06090030"),
    ("2B 04 27 00 1E 00 00 00", "06090030"),  # 30 kbit/s
    ("2F 00 18 04 00 00 00 00", "06010002"),  # compatibility entry
    ("27 81 60 00 01 00 00 00", "06070013"),  # three bytes
    ("23 41 60 00 00 00 00 00", "06010002"),  # read only, also with the wrong length
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


@pytest.mark.every(7)
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
