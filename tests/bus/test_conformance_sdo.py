"""SDO of every CAN device of ours, each object of its EDS (CiA 301, 7.2.4); can_devices.py has the facts."""

from __future__ import annotations

import re
from collections import Counter

import pytest
from rigs.can_devices import (
    DEVICES,
    EACH_AXIS,
    EACH_DEVICE,
    PROFILE,
    PROFILE_VELOCITY,
    STATUSWORD,
    TARGET_VELOCITY,
    VELOCITY,
    another,
    enable,
    fresh,
    read,
    request,
    upload,
    write,
)

READ_ONLY, WRITE_ONLY, NO_OBJECT, NO_SUB_INDEX = 0x0601_0002, 0x0601_0001, 0x0602_0000, 0x0609_0011
TOO_LONG, TOO_SHORT, TOO_HIGH, TOO_LOW = 0x0607_0012, 0x0607_0013, 0x0609_0031, 0x0609_0032
HISTORY = 0x1003
TEXT = pytest.mark.parametrize(
    "facts",
    [pytest.param(facts, id=repr(facts), marks=[] if facts.text() else pytest.mark.skip(
        reason=f"{facts} has no text of more than four letters, and nothing else takes segments to be read"))
     for facts in DEVICES],
)  # fmt: skip


@pytest.fixture
def wire(emulated, facts):
    """Node 5, pre-operational."""
    return fresh(emulated(facts.name))


# --- what there is ----------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_every_object_is_read_with_the_length_of_its_type(wire, facts):
    for entry in facts.entries.values():
        data = upload(wire, entry.index, entry.sub)
        if entry.access == "wo":
            assert data == WRITE_ONLY, entry.label
        elif entry.index == HISTORY and entry.sub > 0:
            assert data == facts.manual.empty_history, "no error yet"
        elif entry.bits is None:
            assert isinstance(data, bytes), entry.label
        else:
            assert isinstance(data, bytes) and len(data) == entry.size, entry.label


@EACH_DEVICE
def test_what_communication_has_is_the_factory_s(wire, facts):
    for entry in facts.entries.values():
        if 0x1000 <= entry.index < 0x2000 and (entry.index != HISTORY or entry.sub == 0):
            known = entry.default.encode() if entry.bits is None else facts.default(entry.index, entry.sub)
            if (entry.index, entry.sub) == (0x1018, 4):
                continue  # the serial number, which each node has of its own
            found = upload(wire, entry.index, entry.sub)
            assert found == known or read(wire, facts, entry.index, entry.sub) == known, entry.label


@EACH_DEVICE
def test_an_object_that_does_not_exist_and_a_sub_index_that_does_not(wire, facts):
    indices = {index for index, _ in facts.entries}
    for index in sorted(indices):
        subs = facts.subs(index)
        for sub in {max(subs) + 1, 0xFF, *range(max(subs))} - set(subs):
            answers = upload(wire, index, sub), wire.download(index, sub, 0, 4)
            assert answers == (NO_SUB_INDEX, NO_SUB_INDEX), f"{index:04X}h:{sub:02X}"
    beside = {index + step for index in indices for step in (-1, 1)}
    for index in {0, 0x1FFF, 0x5FFE, 0xFFFF, *beside} - indices:
        assert upload(wire, index) == wire.download(index, 0, 0, 4) == NO_OBJECT, f"{index:04X}h"
    beyond = PROFILE * len(facts.axes)
    assert upload(wire, STATUSWORD + beyond) == NO_OBJECT, "an axis more than it has"


@EACH_DEVICE
def test_what_can_only_be_read_refuses_every_write(wire, facts):
    for entry in facts.entries.values():
        if entry.access in ("ro", "const"):
            before = upload(wire, entry.index, entry.sub)
            for size in (1, 4):
                assert wire.download(entry.index, entry.sub, 0, size) == READ_ONLY, entry.label
            assert entry.mappable or upload(wire, entry.index, entry.sub) == before


@EACH_DEVICE
def test_a_write_of_another_length_is_refused(wire, facts):
    for entry in facts.entries.values():
        if entry.is_written and entry.bits is not None:
            for size in {1, 4, entry.size % 4 + 1} - {entry.size}:
                code = TOO_LONG if size > entry.size else TOO_SHORT
                assert wire.download(entry.index, entry.sub, 0, size) == code, entry.label


@EACH_DEVICE
def test_a_value_beyond_the_limits_of_the_eds_is_refused(wire, facts):
    found = 0
    for entry in facts.entries.values():
        if not entry.is_written or entry.bits is None or entry.index in facts.manual.refuses:
            continue
        for limit, step, code in ((entry.high, 1, TOO_HIGH), (entry.low, -1, TOO_LOW)):
            if limit is not None and limit + step in entry.room:
                before = read(wire, facts, entry.index, entry.sub)
                assert write(wire, facts, entry.index, limit + step, entry.sub) == code, entry.label
                assert read(wire, facts, entry.index, entry.sub) == before
                found += 1
    assert found > 5


@EACH_DEVICE
def test_what_the_documents_say_is_refused_is_refused_whatever_is_written(wire, facts):
    for entry in facts.entries.values():
        if entry.index in facts.manual.refuses and entry.is_written and entry.bits is not None:
            assert write(wire, facts, entry.index, facts.default(*entry.key), entry.sub) == 0x0800_0020, entry.label


# --- the file ---------------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_the_file_is_ascii_lists_its_objects_in_the_right_place_and_names_each_once(facts):
    assert facts.path.read_bytes().isascii()
    eds = facts.eds
    indices = [int(name, 16) for name in eds.sections() if re.fullmatch("[0-9A-F]{4}", name)]
    subs = Counter(name[:4] for name in eds.sections() if name[4:7] == "sub")
    listed = {}
    for group in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        count = int(eds[group]["SupportedObjects"])
        assert list(eds[group]) == ["supportedobjects", *map(str, range(1, count + 1))]
        listed[group] = [int(eds[group][str(k)], 16) for k in range(1, count + 1)]
    assert listed["MandatoryObjects"] == [0x1000, 0x1001, 0x1018]
    assert listed["ManufacturerObjects"] == [index for index in sorted(indices) if 0x2000 <= index < 0x6000]
    assert sorted(index for group in listed.values() for index in group) == sorted(indices)
    # The TGZ's maker has "Digital inputs" in both areas; the name means the profile's.
    names = [(0x2000 <= index < 0x6000, eds[f"{index:04X}"]["ParameterName"].casefold()) for index in indices]
    assert len(names) == len(set(names))
    assert not any("." in name for _, name in names)  # python-canopen splits "record.entry" there
    for index in indices:
        if "SubNumber" in eds[f"{index:04X}"]:
            assert int(eds[f"{index:04X}"]["SubNumber"], 16) == subs[f"{index:04X}"]


# --- axes -------------------------------------------------------------------------------------------------------------
@EACH_AXIS
def test_a_write_reaches_its_axis_alone(wire, facts, axis):
    """Each parameter of the profile that an axis has: all the axes are read before and after."""
    index = PROFILE_VELOCITY + PROFILE * axis
    before = [read(wire, facts, PROFILE_VELOCITY + PROFILE * one) for one in facts.axes]
    wire.play(f"""
        rx 605  23 {request(index, 0)} 39 30 00 00
        tx 585  60 {request(index, 0)} 00 00 00 00
        rx 605  40 {request(index, 0)} 00 00 00 00
        tx 585  43 {request(index, 0)} 39 30 00 00
    """)
    after = [read(wire, facts, PROFILE_VELOCITY + PROFILE * one) for one in facts.axes]
    assert after == [12345 if one == axis else before[one] for one in facts.axes]


@pytest.mark.parametrize("facts", [facts for facts in DEVICES if len(facts.axes) > 1], ids=repr)
def test_every_parameter_of_an_axis_is_its_own(wire, facts):
    """Each is changed on the first and on the last axis; others stay, but for what the manual says they share."""
    for first, last, step in facts.manual.areas:
        for entry in [e for e in facts.entries.values() if first <= e.index <= last and facts.axis_of(e.index) == 0]:
            if not entry.is_written or entry.bits is None or entry.index in facts.manual.shared:
                continue
            places = [(entry.index + step * axis, entry.sub) for axis in facts.axes]
            assert all(facts.has(*place) for place in places), entry.label
            for axis in (facts.axes[0], facts.axes[-1]):
                before = [read(wire, facts, *place) for place in places]
                raw = another(wire, facts, facts.entries[places[axis]], before[axis])
                if raw is None:
                    continue  # a command, or it takes the value alone that it has
                after = [read(wire, facts, *place) for place in places]
                del before[axis], after[axis]
                assert after == before, facts.entries[places[axis]].label


@EACH_DEVICE
def test_every_object_of_an_axis_reads_as_the_drives_have_it_while_they_move(wire, facts):
    enable(wire, facts)
    for axis in facts.axes:
        speed = facts.manual.speed * (axis + 1) // len(facts.axes)
        assert write(wire, facts, TARGET_VELOCITY + PROFILE * axis, speed) == 0
    wire.wait(100)
    wire.take()
    seen = set()
    of_node = {*facts.manual.bus, *(index for index, _ in facts.manual.address or ())}
    for first, last, step in facts.manual.areas or ((0x2000, 0x67FF, 0x4800),):
        for entry in facts.entries.values():
            if not first <= entry.index <= last or entry.bits is None or entry.index in of_node:
                continue
            known = wire.drives.read(entry.key)
            for axis in facts.axes:
                value = wire.value(entry.index + step * axis, entry.sub)
                assert value == known[axis], f"{entry.label} of axis {axis}"
                seen.add((entry.index, axis, value))
    speeds = [value for index, _, value in sorted(seen) if index == VELOCITY]
    assert speeds == sorted(set(speeds)) and speeds[0] > 0, "each moves, and at its own speed"


# --- segments ---------------------------------------------------------------------------------------------------------
@EACH_AXIS
@pytest.mark.parametrize("size", ["04 00 00 00", "00 00 00 00"], ids=["size", "no size"])
def test_a_number_comes_in_segments(wire, facts, axis, size):
    where = request(PROFILE_VELOCITY + PROFILE * axis, 0)
    wire.play(f"""
        rx 605  2{int(size[:2] != "00")} {where} {size}
        tx 585  60 {where} 00 00 00 00
        rx 605  0C 39 00 00 00 00 00 00   # one byte
        tx 585  20 00 00 00 00 00 00 00
        rx 605  19 30 00 00 00 00 00 00   # three: the last
        tx 585  30 00 00 00 00 00 00 00
        rx 605  40 {where} 00 00 00 00
        tx 585  43 {where} 39 30 00 00
    """)


@TEXT
def test_a_text_is_read_in_segments(wire, facts):
    text = facts.text()
    where, letters = request(*text.key), text.default.encode()
    first, rest = letters[:7].hex(" ").upper(), letters[7:]
    wire.play(f"""
        rx 605  40 {where} 00 00 00 00
        tx 585  41 {where} {len(letters):02X} 00 00 00
        rx 605  70 00 00 00 00 00 00 00   # the first has toggle 0
        tx 585  80 {where} 00 00 03 05
        rx 605  40 {where} 00 00 00 00
        tx 585  41 {where} {len(letters):02X} 00 00 00
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 {first}
        rx 605  60 00 00 00 00 00 00 00   # the same toggle again
        tx 585  80 {where} 00 00 03 05
        rx 605  40 {where} 00 00 00 00
        tx 585  41 {where} {len(letters):02X} 00 00 00
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 {first}
        rx 605  70 00 00 00 00 00 00 00
        tx 585  {0x11 | (7 - len(rest)) << 1:02X} {rest.ljust(7, bytes(1)).hex(" ").upper()}
        rx 605  40 {where} 00 00 00 00
        tx 585  41 {where} {len(letters):02X} 00 00 00
        rx 605  80 {where} 00 00 00 08   # the client aborts
        rx 605  60 00 00 00 00 00 00 00
        tx 585  80 00 00 00 01 00 04 05
    """)


@EACH_DEVICE
@pytest.mark.parametrize("specifier", ["A0", "A4", "C2", "C6", "E0"])
def test_a_block_transfer_is_refused(wire, facts, specifier):
    """None of the manuals has it."""
    where = request(PROFILE_VELOCITY, 0)
    wire.play(f"""
        rx 605  21 {where} 04 00 00 00
        tx 585  60 {where} 00 00 00 00
        rx 605  {specifier} {where} 04 00 00 00
        tx 585  80 {where} 01 00 04 05
        rx 605  07 01 00 00 00 00 00 00   # what was open is no more
        tx 585  80 00 00 00 01 00 04 05
    """)
