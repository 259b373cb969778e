"""The TMCM-3313's object dictionary against its manual, axis by axis.

A row is what the manual prints, in its order: object, data type, access, mapping ("?": "see CiA 402"; "/": there is no
such column), range ("-": that of the type), default ("-": none). Where it cannot be so, `DECIDED` says what was taken.
Entries that the manual does not print are an extension for CAN, and their objects' names begin with "CAN: ".
"""

from __future__ import annotations

import re

import pytest
from rigs import ROOT
from rigs.tables import every_row

from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.ethercat.ethercat_objects import entries_on_ethercat

EDS = ROOT / "drive_env" / "devices" / "tmcm3313" / "tmcm3313.eds"
NODE, AXES = 5, 3
BITS = {"U8": (8, False), "U16": (16, False), "U32": (32, False), "U64": (64, False), "I8": (8, True),
        "I16": (16, True), "I32": (32, True)}  # fmt: skip

# Once in the module: sections 3 and 4.2.65 to 4.2.67.
MODULE = """
1000:0 U32 ro no - FFFC0192h
1001:0 U8 ro no - 0
1008:0 STR ro no - TMCM-3313
1009:0 STR ro no - -
100A:0 STR ro no - -
1018:0 U8 ro no 0...3 3
1018:1 U32 ro no - 0286h
1018:2 U32 ro no - 3313
1018:3 U32 ro no - -
1600:0 U8 rw / 0...9 9
1600:1 U32 rw / - 60400010h
1600:2 U32 rw / - 607A0020h
1600:3 U32 rw / - 60FF0020h
1600:4 U32 rw / - 68400010h
1600:5 U32 rw / - 687A0020h
1600:6 U32 rw / - 68FF0020h
1600:7 U32 rw / - 70400010h
1600:8 U32 rw / - 707A0020h
1600:9 U32 rw / - 70FF0020h
1A00:0 U8 rw / 0...9 9
1A00:1 U32 rw / - 60410010h
1A00:2 U32 rw / - 60640008h
1A00:3 U32 rw / - 606C0020h
1A00:4 U32 rw / - 68410010h
1A00:5 U32 rw / - 68640020h
1A00:6 U32 rw / - 686C0020h
1A00:7 U32 rw / - 70410010h
1A00:8 U32 rw / - 70640020h
1A00:9 U32 rw / - 706C0020h
1C00:0 U8 rw / 0...3 4
1C00:1 U8 rw / - 1
1C00:2 U8 rw / - 2
1C00:3 U8 rw / - 3
1C00:4 U8 rw / - 4
1C12:0 U8 rw / 0...1 1
1C12:1 U16 rw / - 1600h
1C13:0 U8 rw / 0...1 1
1C13:1 U16 rw / - 1A00h
2702:0 U32 ro yes - 0
2703:1 U32 rw yes - 0
2703:2 U32 rw yes - 0
270E:1 U32 ro yes 0...65535 -
270E:2 U32 ro yes 0...65535 -
270E:3 U32 ro yes 0...65535 -
270E:4 U32 ro yes 0...65535 -
"""

# Of motor 0: sections 4.2.1 to 4.2.64, and 5 to 11.
MOTOR = """
2000:0 U8 rw no 0...8 8
2001:0 U16 rw no 0...65535 200
2002:1 U16 rw no 0...65535 0
2002:2 U16 rw no 0...65535 0
2003:0 U8 rw no 0...255 128
2004:0 U8 rw no 0...255 8
2005:0 U32 rw no 0...63 0
200A:0 U16 rw no 0...65535 0
200B:1 U8 rw no 0/1 0
200B:2 U8 rw no 0/1 0
200B:3 U8 rw no 0/1 1
200C:1 U8 rw no 0...255 0
200C:2 U8 rw no 0...255 0
200F:1 U8 rw no 0/1 0
200F:2 I32 ro no - 0
200F:3 I32 ro no - 0
2010:0 U32 rw no 0...268435455 0
2011:0 U32 rw no 0...16777215 0
2012:0 U32 rw no 0...16777215 0
2013:0 U32 rw no 0...16777215 0
2014:0 U32 rw no - 0
2015:0 U8 rw no 1...255 1
2020:0 U8 rw no - 0
2021:0 U32 rw no 0...16777215 0
2022:0 U8 rw no 0...255 0
2027:0 U16 rw no 0...511 255
2028:0 I32 rw no -2147483648...2147483647 -
2029:0 U8 rw no 0...255 -
202A:0 U8 rw no 0...255 -
202B:0 U32 rw no 0...16777215 -
202C:0 U32 rw no 0...16777215 -
202D:0 U16 rw no 0...32767 -
202E:0 U16 rw no 0...32767 -
202F:0 U32 rw no - 2147483647
2030:0 U32 rw no 0...16777215 -
2031:0 U32 rw no 0...16777215 -
2033:0 U8 ro no 0...255 -
2034:0 U32 rw no 0...16777215 -
2035:0 U32 rw no 0...16777215 -
2036:0 U8 rw no 0...255 -
204E:0 U8 rw no 0...255 -
2089:0 U16 rw no 0...65535 200
208C:0 U8 rw no 0/181 181
208E:0 U8 ro no 0/179 179
2092:0 U8 rw no 0...3 2
2093:0 U8 rw no 0/1 0
2094:0 U8 rw no 0...3 0
2095:0 I8 rw no -3...12 0
2096:0 U8 rw no 0...8 3
2097:0 U8 rw no 0/2...15 5
2098:0 U8 rw no 0/1 0
2099:0 U8 rw no 0...3 0
209A:0 U8 rw no 0...15 0
209B:0 U8 rw no 0...3 0
209C:0 U8 rw no 0...15 0
209D:0 U8 rw no 0/1 0
209E:0 I8 rw no -63...63 0
20A1:0 U8 rw no 0/1 0
20A3:0 U8 rw no 0/1 0
20A4:0 U32 rw no 0...2147483647 0
20A5:0 U32 rw no 0...2147483647 0
20B0:0 U32 rw no 0...16777215 0
20B1:0 U8 rw no 0...255 0
20B2:0 U8 rw no 0...255 0
2100:0 I32 ro no -2147483648...2147483647 0
2101:0 U16 ro no 0...1023 0
2102:0 U8 ro no 0...255 0
2107:0 U8 ro no 0...8 8
210B:1 U32 ro no 0...4294967295 0
210B:2 U32 ro no 0...4294967295 0
210B:3 U64 ro no 0...18446744073709551615 0
2120:0 U8 ro no 0/1 -
605A:0 I16 rw no 1/2/5/6 2
605B:0 U16 rw no 0 0
605C:0 U16 rw no 1 1
605D:0 U16 rw no 1 1
605E:0 U16 rw no 2 2
6060:0 I8 rw ? 0/1/3/6/8/9/10 0
6061:0 I8 rw ? 0/1/3/6/8/9/10 0
606A:0 I16 rw no 0/-1 -1
608F:0 U8 ro no 2 2
608F:1 U32 rw no 0...2147483647 1
608F:2 U32 ro no 1 1
60FD:0 U32 rw yes - 0
6502:0 U32 ro no - -
6040:0 U16 rw ? - -
6041:0 U16 rw ? - -
6062:0 I32 ro ? - -
6063:0 I32 ro ? - -
6064:0 I32 ro ? - -
6065:0 U32 rw no 0...2147483647 0
6067:0 U32 rw no - FFFFFFFFh
6068:0 U16 rw no - 0
606C:0 I32 ro ? - -
607A:0 I32 rw ? - 0
607D:1 I32 rw no - -2147483648
607D:2 I32 rw no - 2147483647
6081:0 U32 rw no - 0
6082:0 U32 rw no - 0
6083:0 U32 rw no - 0
6084:0 U32 rw no - 0
6085:0 U32 rw no - 51200
6086:0 U16 rw no 0/1 0
60A4:0 U8 ro no 4 4
60A4:1 U32 rw no 0...2147483647 0
60A4:2 U32 rw no 0...2147483647 0
60A4:3 U32 rw no 0...2147483647 0
60A4:4 U32 rw no 0...2147483647 0
60F2:0 U16 rw no - 0
60FF:0 I32 rw ? - 0
607C:0 I32 rw no - 0
6098:0 I8 rw no 0/1/2/3/5/17/18/19/21/33/34/35 0
6099:1 U32 rw no - 0
6099:2 U32 rw no - 0
609A:0 U32 rw no - 0
60B0:0 I32 rw yes -2147483648...2147483647 0
60C2:0 U8 ro no - 2
60C2:1 U8 rw no - 1
60C2:2 I8 rw no -3...3 -3
60B1:0 I32 rw yes -2147483648...2147483647 0
6071:0 I16 rw yes -32768...32767 0
6077:0 I16 ro yes -32768...32767 0
60B2:0 I16 rw yes -32768...32767 0
"""

# What was taken where the manual cannot be right, or says nothing.
DECIDED = """
1A00:2 U32 rw / - 60640020h                   6064h has 32 bits, and entries 5 and 8 are printed so
1C00:0 U8 rw / 0...4 4                        there are four sync managers
1C00:1 U8 rw / 1...4 1                        table 25 knows four types
1C00:2 U8 rw / 1...4 2
1C00:3 U8 rw / 1...4 3
1C00:4 U8 rw / 1...4 4
2029:0 U8 rw no 0...255 255                   of the chip: after its reset nothing scales currents
202A:0 U8 rw no 0...255 255
2036:0 U8 rw no 0...255 255                   table 2 calls it the default
6041:0 U16 ro ? - -                           a state
6061:0 I8 ro ? 0/1/3/6/8/9/10 0               a display
60FD:0 U32 ro yes - 0                         inputs
6502:0 U32 ro no - 3A5h                       pp, pv, hm, csp, csv, cst: bits 0, 2, 5, 7, 8, 9
2001:0 U16 rw no 1...65535 200                0 full steps make no scale of positions
2020:0 U8 rw no 0...3 0                       what sections 4.2.17 and 1.6.2 know
208C:0 U8 rw no 181 181                       units of the chip are not emulated
60F2:0 U16 rw no 0...2 0                      table 248; 3 is reserved
"""
# Numbers of entries that the manual has no row for, of objects that have a first one.
UNPRINTED = {0x2002: 2, 0x200B: 3, 0x200C: 2, 0x200F: 3, 0x210B: 3, 0x2703: 2, 0x270E: 4, 0x607D: 2, 0x6099: 2}


def parse(rows):
    return {row.split()[0]: row.split()[1:6] for row in rows.strip().splitlines()}


PRINTED = parse(MODULE) | parse(MOTOR)
TAKEN = PRINTED | parse(DECIDED)


def split(key):
    index, sub = key.split(":")
    return int(index, 16), int(sub, 16)


def of_axis(index, axis):
    """Return the index of an object of axis 0 on another axis: section 2.4.1 and table 7."""
    if 0x2000 <= index < 0x2200:
        return index + 0x200 * axis
    return index + 0x800 * axis if 0x6000 <= index < 0x6800 else index


def number(text):
    return int(text[:-1], 16) if text.endswith("h") else int(text)


def values(text):
    """Return the single values that a range lists, None of one that is from...to."""
    if "/" not in text:
        return None
    found = set()
    for part in text.split("/"):
        low, _, high = part.partition("...")
        found |= set(range(int(low), int(high or low) + 1))
    return found


@pytest.fixture(scope="module")
def dictionary():
    return ObjectDictionary(EDS, NODE)


@pytest.fixture(scope="module")
def on_ethercat(dictionary):
    return entries_on_ethercat(find_device("tmcm3313"), dictionary)


@every_row("key", TAKEN)
def test_an_entry_is_as_the_manual_prints_it_on_every_axis(on_ethercat, key):
    kind, access, mapping, limits, default = TAKEN[key]
    index, sub = split(key)
    for axis in range(AXES):
        entry = on_ethercat.find((of_axis(index, axis), sub))
        assert (entry.access, entry.pdo_mappable) == (access, mapping in ("yes", "?"))
        if kind == "STR":
            assert entry.bits is None
            assert default in ("-", entry.default)
            continue
        assert (entry.bits, entry.signed) == BITS[kind]
        bits, signed = BITS[kind]
        whole = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        listed = values(limits)
        if limits == "-":
            assert (entry.low, entry.high) == whole or entry.sub == 0 == entry.low - entry.high
        elif listed is None:
            low, _, high = limits.partition("...")
            assert (entry.low, entry.high) == (number(low), number(high or low))
        else:  # the EDS has ends alone, and device.toml the values
            assert entry.low <= min(listed) and max(listed) <= entry.high
        assert entry.low <= entry.default <= entry.high
        if default != "-":
            assert entry.default == number(default)
        elif key != "1018:3":
            assert entry.default == 0
        assert listed is None or entry.default in listed


def test_what_was_decided_is_printed_otherwise():
    for key, row in parse(DECIDED).items():
        assert sum(printed != decided for printed, decided in zip(PRINTED[key], row, strict=True)) == 1


def test_there_is_nothing_else_but_the_extension_for_can(dictionary):
    manual = {(of_axis(index, axis), sub) for index, sub in map(split, PRINTED) for axis in range(AXES)}
    counts = {(of_axis(index, axis), 0): n for index, n in UNPRINTED.items() for axis in range(AXES)}
    for entry in dictionary:
        key = (entry.index, entry.sub)
        assert entry.name.startswith("CAN: ") == (key not in manual and key not in counts), entry.label
        if key in counts:
            assert (entry.access, entry.low, entry.default, entry.high) == ("ro", *3 * (counts[key],))
    assert manual | set(counts) <= {(entry.index, entry.sub) for entry in dictionary}


def test_in_the_eds_which_is_can_s_the_image_is_read_only(dictionary):
    """Its maps are longer than a frame, and only EtherCAT has sync managers."""
    image = [one for one in dictionary if one.index in (0x1600, 0x1A00, 0x1C00, 0x1C12, 0x1C13)]
    assert len(image) == 29 and {one.access for one in image} == {"ro"}


def test_the_extension_is_what_a_node_on_can_needs(dictionary):
    """CiA 301: SYNC, emergencies, heartbeat, error behaviour, and PDOs of each axis beside the numbers of the image."""
    found = {entry.index for entry in dictionary if entry.name.startswith("CAN: ")}
    numbers = [first + k for first in (65, 129, 193) for k in range(4)]
    pdos = {base + n - 1 for base in (0x1400, 0x1600, 0x1800, 0x1A00) for n in numbers}
    assert found == pdos | {0x1005, 0x1014, 0x1015, 0x1016, 0x1017, 0x1029}
    for base, usual in ((0x1400, (0x200, 0x300, 0x400, 0x500)), (0x1800, (0x180, 0x280, 0x380, 0x480))):
        for axis in range(AXES):
            for k in range(4):
                entry = dictionary.find((base + 0x40 * (axis + 1) + k, 1))
                assert entry.default == (usual[k] + NODE | 1 << 30 if axis == 0 else 0xC0000000)


def test_names_are_unique_and_tell_the_axis(dictionary):
    names = [entry.name.casefold() for entry in dictionary]
    assert len(names) == len(set(names))
    for key in parse(MOTOR):
        index, sub = split(key)
        first = dictionary.find((index, sub)).name
        for axis in range(1, AXES):
            name = dictionary.find((of_axis(index, axis), sub)).name
            assert re.sub(rf" axis {axis}(\.|$)", r"\1", name) == first != name


# What a binding counts in, and how the EDS writes it; `jog '60 rpm'` and monitors turn it into units.
WRITTEN = {
    **{unit: unit for unit in ("pps", "pps^2", "inc", "ms", "10ms", "mA", "512 clocks")},
    **dict.fromkeys(("counter", "position window", "position limit"), "inc"),
}


@pytest.mark.parametrize("name", ["tmcm3313", "tmcm6212"])
def test_the_eds_says_in_what_an_object_counts_on_every_axis(name):
    device = find_device(name)
    entries = {(entry.index, entry.sub): entry for entry in device.new_dictionary()}
    counted = [one for one in device.bindings.values() if one.unit in WRITTEN]
    assert len(counted) > 30
    for one in counted:
        step = 0x200 if one.index < 0x2200 else 0x800
        for axis in range(device.num_axes):
            assert entries[one.index + step * axis, one.sub].unit == WRITTEN[one.unit], f"{one.index:04X}h:{one.sub}"
