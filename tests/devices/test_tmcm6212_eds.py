"""The TMCM-6212's object dictionary against its maker's EDS and the manuals, axis by axis.

A row: object, type, access, whether PDOs carry it, default, range. Types, access, mapping and defaults are those of the
maker's EDS of firmware 3.22 (1000h: of the manual; 300Eh: four inputs); ranges those of the manual of the TMCM-3313, or
of the chip's registers. Where either is silent stands -.
"""

from __future__ import annotations

import csv
import re

import pytest
from rigs import ROOT
from rigs.tables import every_row

from drive_env.dictionary.entries import ObjectDictionary

EDS = ROOT / "drive_env" / "devices" / "tmcm6212" / "tmcm6212.eds"
DECISIONS = ROOT / "docs" / "decisions" / "stepper.md"
FACT_TABLE = ROOT / "research" / "stepper_drives" / "tmcm6212.csv"
NODE, AXES = 5, 6
BITS = {
    "U8": (8, False),
    "U16": (16, False),
    "U32": (32, False),
    "U64": (64, False),
    "I8": (8, True),
    "I16": (16, True),
    "I32": (32, True),
}

ROWS = """
1000:0 U32 const 0 0xFFFC0192 -
1001:0 U8 ro 0 - -
1005:0 U32 rw 0 0x00000080 -
1008:0 STR const 0 - -
1009:0 STR const 0 - -
100A:0 STR const 0 - -
100C:0 U16 rw 0 0x00000000 -
100D:0 U8 rw 0 0x00000000 -
1010:0 U8 ro 0 0xA -
1010:1 U32 rw 0 - -
1010:2 U32 rw 0 - -
1010:3 U32 rw 0 - -
1010:4 U32 rw 0 - -
1010:5 U32 rw 0 - -
1010:6 U32 rw 0 - -
1010:7 U32 rw 0 - -
1010:8 U32 rw 0 - -
1010:9 U32 rw 0 - -
1010:A U32 rw 0 - -
1011:0 U8 ro 0 0xA -
1011:1 U32 rw 0 - -
1011:2 U32 rw 0 - -
1011:3 U32 rw 0 - -
1011:4 U32 rw 0 - -
1011:5 U32 rw 0 - -
1011:6 U32 rw 0 - -
1011:7 U32 rw 0 - -
1011:8 U32 rw 0 - -
1011:9 U32 rw 0 - -
1011:A U32 rw 0 - -
1014:0 U32 rw 0 $NODEID+0x80 -
1015:0 U16 rw 0 0x0000 -
1016:0 U8 ro 0 0x1 -
1016:1 U32 rw 0 0x0 -
1017:0 U16 rw 0 0x0 -
1018:0 U8 ro 0 0x4 -
1018:1 U32 ro 0 0x286 -
1018:2 U32 ro 0 0x1844 -
1018:3 U32 ro 0 - -
1018:4 U32 ro 0 - -
1023:0 U8 ro 0 0x3 -
1023:1 STR rw 0 - -
1023:2 U8 ro 0 - -
1023:3 STR ro 0 - -
1029:0 U8 ro 0 0x2 -
1029:1 U8 rw 0 0x0 0...2
1029:2 U8 rw 0 0x1 0...2
1400:0 U8 ro 0 0x02 -
1400:1 U32 rw 0 $NODEID+0x40000200 -
1400:2 U8 ro 0 0xFF -
1401:0 U8 ro 0 0x02 -
1401:1 U32 rw 0 $NODEID+0x40000300 -
1401:2 U8 ro 0 0xFF -
1402:0 U8 ro 0 0x02 -
1402:1 U32 rw 0 $NODEID+0x40000400 -
1402:2 U8 ro 0 0xFF -
1403:0 U8 ro 0 0x02 -
1403:1 U32 rw 0 $NODEID+0xC0000500 -
1403:2 U8 ro 0 0xFE -
1600:0 U8 rw 0 0x01 0...3
1600:1 U32 rw 0 0x60400010 -
1600:2 U32 rw 0 0x00000000 -
1600:3 U32 rw 0 0x00000000 -
1601:0 U8 rw 0 0x02 -
1601:1 U32 rw 0 0x60400010 -
1601:2 U32 rw 0 0x60600008 -
1601:3 U32 rw 0 0x00000000 -
1602:0 U8 rw 0 0x02 -
1602:1 U32 rw 0 0x60400010 -
1602:2 U32 rw 0 0x607A0020 -
1602:3 U32 rw 0 0x00000000 -
1603:0 U8 rw 0 0x02 -
1603:1 U32 rw 0 0x60400010 -
1603:2 U32 rw 0 0x60FF0020 -
1603:3 U32 rw 0 0x00000000 -
1800:0 U8 ro 0 0x05 -
1800:1 U32 rw 0 $NODEID+0x40000180 -
1800:2 U8 rw 0 0xFF -
1800:3 U16 rw 0 0x0 -
1800:4 U8 ro 0 - -
1800:5 U16 rw 0 0x0 -
1801:0 U8 ro 0 0x05 -
1801:1 U32 rw 0 $NODEID+0x40000280 -
1801:2 U8 rw 0 0xFF -
1801:3 U16 rw 0 0x0 -
1801:4 U8 ro 0 - -
1801:5 U16 rw 0 0x0 -
1802:0 U8 ro 0 0x05 -
1802:1 U32 rw 0 $NODEID+0x40000380 -
1802:2 U8 rw 0 0x1 -
1802:3 U16 rw 0 0x0 -
1802:4 U8 ro 0 - -
1802:5 U16 rw 0 0x0 -
1803:0 U8 ro 0 0x05 -
1803:1 U32 rw 0 $NODEID+0xC0000480 -
1803:2 U8 rw 0 0xFE -
1803:3 U16 rw 0 0x0 -
1803:4 U8 ro 0 - -
1803:5 U16 rw 0 0x0 -
1A00:0 U8 rw 0 0x01 0...3
1A00:1 U32 rw 0 0x60410010 -
1A00:2 U32 rw 0 0x00000000 -
1A00:3 U32 rw 0 0x00000000 -
1A01:0 U8 rw 0 0x02 -
1A01:1 U32 rw 0 0x60410010 -
1A01:2 U32 rw 0 0x60610008 -
1A01:3 U32 rw 0 0x00000000 -
1A02:0 U8 rw 0 0x02 -
1A02:1 U32 rw 0 0x60410010 -
1A02:2 U32 rw 0 0x60640020 -
1A02:3 U32 rw 0 0x00000000 -
1A03:0 U8 rw 0 0x02 -
1A03:1 U32 rw 0 0x60410010 -
1A03:2 U32 rw 0 0x606C0020 -
1A03:3 U32 rw 0 0x00000000 -
2000:0 U8 rw 0 - 0...8
2001:0 U16 rw 0 0xC8 1...65535
2002:0 U8 const 0 0x2 -
2002:1 U16 rw 0 - 0...65535
2002:2 U16 rw 0 - 0...65535
2003:0 U8 rw 0 - 0...255
2004:0 U8 rw 0 - 0...255
2005:0 U32 rw 0 - 0...63
200A:0 U16 rw 0 0x00 0...65535
200B:0 U8 const 0 0x3 -
200B:1 U8 rw 0 - 0...1
200B:2 U8 rw 0 - 0...1
200B:3 U8 rw 0 - 0...1
200C:0 U8 const 0 0x2 -
200C:1 U8 rw 0 - 0...255
200C:2 U8 rw 0 - 0...255
200F:0 U8 const 0 0x3 -
200F:1 U8 rw 0 0x00 0...1
200F:2 I32 ro 0 0x00000000 -
200F:3 I32 ro 0 0x00000000 -
2010:0 U32 rw 0 0x00 0...249999
2011:0 U32 rw 0 0x00 0...7629278
2012:0 U32 rw 0 0x00 0...999999
2013:0 U32 rw 0 0x00 0...7629278
2015:0 U16 rw 0 0x0 0...65535
2089:0 U16 rw 0 0x0 0...65535
208C:0 U8 rw 0 - 181...181
208E:0 U8 ro 0 - -
2092:0 U8 rw 0 - 0...3
2093:0 U8 rw 0 - 0...1
2094:0 U8 rw 0 - 0...3
2095:0 I8 rw 0 - -3...12
2096:0 U8 rw 0 - 0...8
2097:0 U8 rw 0 - -
2098:0 U8 rw 0 - 0...1
2099:0 U8 rw 0 - 0...3
209A:0 U8 rw 0 - 0...15
209B:0 U8 rw 0 - 0...3
209C:0 U8 rw 0 - 0...15
209D:0 U8 rw 0 - 0...1
209E:0 I8 rw 0 - -63...63
20A1:0 U8 rw 0 - 0...1
20A2:0 U8 rw 0 - 0...3
20A3:0 U8 rw 0 - 0...1
20A4:0 U32 rw 0 - 0...2147483647
20A5:0 U32 rw 0 - 0...2147483647
20B0:0 U32 rw 0 0x00 0...16777215
20B1:0 U8 rw 0 0x00 0...255
20B2:0 U8 rw 0 0x00 0...255
20B3:0 U32 rw 0 0x0 0...7999511
20B4:0 U16 rw 0 0x0 0...1023
20B5:0 U8 rw 0 0x00 0...255
20B6:0 U32 rw 0 0x0 0...7999511
20B7:0 U8 rw 0 0x0 0...1
20B8:0 U8 rw 0 0x0 0...1
20B9:0 U8 rw 0 0x0 0...15
2100:0 I32 ro 0 0x0 -
2101:0 U16 ro 0 - 0...1023
2102:0 U8 ro 0 - 0...255
2107:0 U8 ro 0 - 0...8
210B:0 U8 ro 0 0x3 -
210B:1 U32 rw 0 - 0...4294967295
210B:2 U32 rw 0 - 0...4294967295
210B:3 U64 ro 0 - 0...18446744073709551615
2121:0 U8 ro 0 0x00 0...255
2122:0 I32 ro 0 0x0 -
3000:0 U32 rw 0 0x0 -
3001:0 U32 rw 0 0x0 -
3002:0 U32 ro 1 - -
3003:0 U8 const 0 0x2 -
3003:1 U32 rww 1 0x0 -
3003:2 U32 rw 0 0x0 -
3004:0 U16 rw 0 - 20...1000
3005:0 U8 rw 0 - 1...127
3006:0 U8 const 0 0x1 -
3006:1 U32 rw 0 - -
3007:0 U16 ro 0 - 20...1000
3008:0 U8 ro 0 - 1...127
300E:0 U8 ro 0 4 -
300E:1 U32 ro 1 - 0...65535
300E:2 U32 ro 1 - 0...65535
300E:3 U32 ro 1 - 0...65535
300E:4 U32 ro 1 - 0...65535
6040:0 U16 rww 1 - -
6041:0 U16 ro 1 - -
605A:0 I16 rw 0 0x0002 -
605B:0 I16 ro 0 0x0000 -
605C:0 I16 ro 0 0x0001 -
605D:0 I16 ro 0 0x0001 -
605E:0 I16 ro 0 0x0002 -
6060:0 I8 rww 1 0x00 0...9
6061:0 I8 ro 1 - -
6062:0 I32 ro 1 - -
6063:0 I32 ro 1 - -
6064:0 I32 ro 1 - -
6065:0 U32 rw 0 - 0...2147483647
6067:0 U32 rw 0 0xFFFFFFFF -
6068:0 U16 rw 0 0x0000 -
606A:0 I16 rw 0 - -
606C:0 I32 ro 1 - -
607A:0 I32 rww 1 0x0 -
607C:0 I32 rw 0 0x0 -
607D:0 U8 const 0 0x2 -
607D:1 I32 rw 0 0x80000001 -
607D:2 I32 rw 0 0x7FFFFFFF -
6081:0 U32 rw 0 - 0...7999511
6082:0 U32 rw 0 0x0 0...249999
6083:0 U32 rw 0 - 0...7629278
6084:0 U32 rw 0 - 0...7629278
6085:0 U32 rw 0 - 0...7629278
608F:0 U8 const 0 0x00000002 -
608F:1 U32 rw 0 - 0...2147483647
608F:2 U32 ro 0 0x00000001 -
6098:0 I8 rw 0 0x00 0...35
6099:0 U8 const 0 0x2 -
6099:1 U32 rw 0 - 0...7999511
6099:2 U32 rw 0 - 0...7999511
609A:0 U32 rw 0 - 0...7629278
60B0:0 I32 rw 0 0x0 -
60B1:0 I32 rw 0 0x00 -
60C2:0 U8 const 0 0x02 -
60C2:1 U8 rw 0 0x01 -
60C2:2 I8 rw 0 0xFD -3...3
60F2:0 U16 rw 0 0x00 0...2
60FD:0 U32 ro 1 - -
60FF:0 I32 rw 1 0x0 -
6502:0 U32 ro 0 0x000001A5 -
67FF:0 U32 ro 0 0x00040192 -
"""

# What the maker's EDS has and ours has not: entry, type, access. docs/decisions/stepper.md has the reasons.
ABSENT = """
3009:0 U8 rw
300B:0 U32 ro
300C:0 U8 const
300C:1 U32 ro
300C:2 U32 ro
300C:3 U32 ro
300C:4 U32 ro
300C:5 U32 ro
300C:6 U32 ro
300E:5 U32 ro
300E:6 U32 ro
300E:7 U32 ro
300E:8 U32 ro
300F:0 I32 rw
"""
FACTS = 257  # entries of axis 0 in the maker's EDS

TABLE = {
    tuple(int(part, 16) for part in row.split()[0].split(":")): row.split()[1:] for row in ROWS.strip().splitlines()
}


LACKING = {
    tuple(int(part, 16) for part in row.split()[0].split(":")): row.split()[1:] for row in ABSENT.strip().splitlines()
}


@pytest.fixture(scope="module")
def dictionary():
    return ObjectDictionary(EDS, NODE)


def of_axis(index, axis):
    """Return the index of an object of axis 0 on another axis: section 2.5.1 of the manual, and its PDO numbers."""
    if 0x2000 <= index < 0x2200:
        return index + 0x200 * axis
    if 0x6000 <= index < 0x6800:
        return index + 0x800 * axis
    return index + 0x40 * axis if 0x1400 <= index < 0x1C00 else index


def number(text, signed, bits):
    """Return a default; identifiers follow the node."""
    value = sum(NODE if part == "$NODEID" else int(part, 0) for part in text.split("+"))
    return value - 2**bits if signed and value >= 2 ** (bits - 1) else value


@every_row("key", TABLE)
def test_an_entry_is_as_its_maker_has_it_on_every_axis(dictionary, key):
    kind, access, mappable, default, limits = TABLE[key]
    for axis in range(AXES):
        entry = dictionary.find((of_axis(key[0], axis), key[1]))
        assert (entry.access, entry.pdo_mappable) == (access, mappable == "1")
        if kind == "STR":
            assert entry.bits is None
            continue
        bits, signed = BITS[kind]
        assert (entry.bits, entry.signed) == (bits, signed)
        if limits != "-":
            assert f"{entry.low}...{entry.high}" == limits
        assert entry.low <= entry.default <= entry.high
        if default != "-":
            is_further_pdo = axis > 0 and 0x1400 <= key[0] < 0x1C00
            expected = number(default, signed, bits)
            if is_further_pdo and key[1] == 1 and key[0] & 0x200 == 0:
                expected = 0xC0000000  # off, without an identifier
            elif is_further_pdo and key[1] and key[0] & 0x200 and expected:
                expected += axis * 0x800 << 16  # the same object of this axis
            assert entry.default == expected


def test_there_is_nothing_else(dictionary):
    expected = {(of_axis(index, axis), sub) for index, sub in TABLE for axis in range(AXES)}
    assert {(entry.index, entry.sub) for entry in dictionary} == expected


def test_what_the_maker_has_is_there_or_absent_for_a_reason(dictionary):
    assert len(TABLE) + len(LACKING) == FACTS and not TABLE.keys() & LACKING.keys()
    assert not {(entry.index, entry.sub) for entry in dictionary} & LACKING.keys()
    told = {}
    for line in DECISIONS.read_text(encoding="utf-8").partition("## What the TMCM-6212 lacks")[2].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if found := re.fullmatch(r"([0-9A-F]{4})h(?::(\d\d) to (\d\d))?", cells[0]):
            assert len(cells[3]) > 30  # a reason
            first, last = int(found[2] or 0), int(found[3] or 0)
            told |= {(int(found[1], 16), sub): cells[1].split(", ") for sub in range(first, last + 1)}
    assert told.keys() == LACKING.keys()
    for key, kind in LACKING.items():
        assert " ".join(kind) in told[key]


def test_what_was_read_from_the_manuals_is_there_or_absent():
    """The table of the objects of axis 0; it has one row for all PDO sets."""
    with FACT_TABLE.open(encoding="utf-8", newline="") as file:
        read = {(int(row["index"][:4], 16), int(row["sub"][:2], 16)) for row in csv.DictReader(file)}
    whole = TABLE.keys() | LACKING.keys()
    assert read == {(index, sub) for index, sub in whole if not 0x1400 <= index < 0x1C00 or index & 0x3F == 0}


def test_the_numbers_of_pdos_are_the_manuals(dictionary):
    """Section 1.1: 1 to 4, 65 to 68, 129 to 132, 193 to 196, 257 to 260, 321 to 324, with three objects each."""
    numbers = [first + k for first in (1, 65, 129, 193, 257, 321) for k in range(4)]
    for base in (0x1400, 0x1600, 0x1800, 0x1A00):
        there = sorted({entry.index - base + 1 for entry in dictionary if base <= entry.index < base + 0x200})
        assert there == numbers
    mapped = [entry for entry in dictionary if entry.index in range(0x1600, 0x1800) and entry.sub == 0]
    assert {entry.high for entry in mapped} == {3}
