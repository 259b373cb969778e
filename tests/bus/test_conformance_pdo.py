"""PDOs of every CAN device of ours, as its EDS has them (CiA 301, 7.2.2 and 7.5.2); can_devices.py has the facts."""

from __future__ import annotations

import pytest
from rigs.can_devices import (
    CONTROLWORD,
    EACH_AXIS,
    EACH_DEVICE,
    EACH_RPDO,
    EACH_TPDO,
    MODE,
    MODE_DISPLAY,
    NO_REMOTE,
    NODE,
    OFF,
    PROFILE,
    PV,
    READY,
    STATUSWORD,
    SWITCH_ON_DISABLED,
    configure,
    fresh,
    give,
    others,
    read,
    set_mode,
    silence,
    states,
    write,
)

READ_ONLY, RANGE, WRONG_STATE = 0x0601_0002, 0x0609_0030, 0x0800_0022
UNSUPPORTED, NO_OBJECT, NO_SUB_INDEX, NOT_MAPPABLE, TOO_MUCH, TOO_HIGH = (
    0x0601_0000,
    0x0602_0000,
    0x0609_0011,
    0x0604_0041,
    0x0604_0042,
    0x0609_0031,
)
FREE_ID = 0x2F5  # none of the predefined connection set of node 5
RESERVED = [*range(241, 254)]  # of the transmission types; 252 and 253 need remote frames, which none of them has
# CiA 301, table 41.
RESTRICTED = [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x7FF]


@pytest.fixture
def wire(emulated, facts):
    """Node 5, pre-operational."""
    return fresh(emulated(facts.name))


def value_for(entry, facts):
    """Return a harmless value of another kind than an object's factory value, and what reads then."""
    axis = facts.axis_of(entry.index) or 0
    kind = entry.index - PROFILE * axis if entry.index >= 0x6000 else entry.index
    if kind == CONTROLWORD:
        return 0x06
    if kind == MODE:
        return PV
    return 0x15 if entry.bits == 8 else 1234


def data_of(entries, values):
    return b"".join(value.to_bytes(entry.size, "little", signed=value < 0)
                    for entry, value in zip(entries, values, strict=True))  # fmt: skip


def parts(data, entries):
    """Return the numbers in a PDO."""
    found, place = [], 0
    for entry in entries:
        found.append(int.from_bytes(data[place : place + entry.size], "little", signed=entry.signed))
        place += entry.size
    assert place == len(data), "nothing behind the mapped objects"
    return found


# --- what there is ----------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_the_first_four_have_the_predefined_identifiers_and_the_others_none(facts):
    for indices, first in ((facts.rpdos, 0x200), (facts.tpdos, 0x180)):
        for place, index in enumerate(indices):
            cob_id = facts.default(index, 1)
            assert cob_id & OFF or cob_id & 0x7FF == first + 0x100 * place + NODE, f"{index:04X}h"
            assert place < 4 or cob_id & OFF, f"{index:04X}h: the connection set has four"
            assert cob_id & NO_REMOTE


@EACH_DEVICE
def test_the_pdos_of_an_axis_map_its_own_objects(facts):
    """TMCM-6212, section 1.1: four of an axis, numbers 1 to 4, 65 to 68 and so on; TGZ: its default mappings."""
    step = facts.manual.pdo_set
    for indices in (facts.rpdos, facts.tpdos):
        if step:
            assert indices == [indices[0] + step * axis + place for axis in facts.axes for place in range(4)]
        for index in indices:
            axes = {facts.axis_of(entry.index) for entry in facts.mapped(index)} - {None}
            assert len(axes) == 1, f"{index:04X}h"
            assert not step or axes == {(index - indices[0]) // step}
            assert all(entry.travels(index in facts.tpdos) for entry in facts.mapped(index)), f"{index:04X}h"


# --- received ---------------------------------------------------------------------------------------------------------
@pytest.mark.every(9)
@EACH_RPDO
def test_what_is_received_reaches_the_mapped_objects_alone(wire, facts, pdo):
    entries = facts.mapped(pdo)
    everywhere = {key for index in facts.rpdos for key in ((e.index, e.sub) for e in facts.mapped(index))}
    give(wire, pdo, FREE_ID)
    axis = facts.axis_of(entries[0].index)
    if any(entry.index == MODE + PROFILE * axis for entry in entries):
        set_mode(wire, facts, axis)
        write(wire, facts, MODE + PROFILE * axis, 0)
    wire.start()
    silence(wire, facts)
    before = {key: read(wire, facts, *key) for key in everywhere}
    values = [value_for(entry, facts) for entry in entries]
    assert wire.receive(FREE_ID, data_of(entries, values).hex(" ")) == []
    wire.wait(1)
    given = {entry.key: value for entry, value in zip(entries, values, strict=True)}
    for key in everywhere:
        assert read(wire, facts, *key) == given.get(key, before[key]), f"{key[0]:04X}h"
    word = any(entry.index == CONTROLWORD + PROFILE * axis for entry in entries)
    assert states(wire, facts) == others(facts, axis, READY if word else SWITCH_ON_DISABLED, SWITCH_ON_DISABLED)


@pytest.mark.every(19)
@EACH_RPDO
@pytest.mark.parametrize(("bytes_", "code"), [(-8, "10 82"), (-1, "10 82"), (1, "20 82")])
def test_another_length_is_told_once_and_not_processed(wire, facts, pdo, bytes_, code):
    entries = facts.mapped(pdo)
    good = data_of(entries, [value_for(entry, facts) for entry in entries])
    wrong = (good + b"\x01")[: max(len(good) + bytes_, 0)]
    if len(wrong) > 8:
        pytest.skip(f"a PDO of 8 bytes cannot be longer: {facts} {pdo:04X}h")
    give(wire, pdo, FREE_ID)
    wire.start()
    before = [read(wire, facts, *entry.key) for entry in entries]
    wire.play(f"""
        rx {FREE_ID:03X}  {wrong.hex(" ")}
        tx 085  {code} 11 00 FF 00 00 00
        rx {FREE_ID:03X}  {wrong.hex(" ")}
    """)
    assert [read(wire, facts, *entry.key) for entry in entries] == before
    assert read(wire, facts, 0x1001) == 0x11
    same = data_of(entries, before)  # nothing that would move an axis
    wire.receive(FREE_ID, same.hex(" "))
    wire.wait(1)
    assert "085  00 00 00 00 00 00 00 00" in map(str, wire.take()), "a good one ends it"
    assert read(wire, facts, 0x1001) == 0


@EACH_AXIS
def test_a_mode_that_an_axis_has_not_is_told_and_nothing_of_the_frame_taken(wire, facts, axis):
    word, mode = (facts.entries[index + PROFILE * axis, 0] for index in (CONTROLWORD, MODE))
    pdo = facts.rpdos[0]
    give(wire, pdo, FREE_ID, mapped=[word.mapping, mode.mapping])
    silence(wire, facts)
    wire.start()
    wire.play(f"""
        rx {FREE_ID:03X}  06 00 02        # vl
        tx 085  20 63 {facts.manual.refused:02X} 00 FF 00 00 00
        wait 1 ms
        rx {FREE_ID:03X}  00 00 00
        wait 1 ms
        tx 085  00 00 00 00 00 00 00 00
    """)
    assert states(wire, facts) == [SWITCH_ON_DISABLED] * len(facts.axes)


@EACH_RPDO
def test_received_data_wait_for_sync_where_their_type_says_so(wire, facts, pdo):
    entries = facts.mapped(pdo)
    silence(wire, facts)
    if not facts.writes_type(pdo):
        assert wire.download(pdo, 2, 1, 1) == READ_ONLY
        assert facts.default(pdo, 2) in (254, 255), "taken as they come"
        return
    for kind in range(256):
        assert (wire.download(pdo, 2, kind, 1) == RANGE) == (kind in RESERVED), kind
    give(wire, pdo, FREE_ID, 240)
    wire.start()
    plain = [entry for entry in entries if entry.size == 4]
    values = [1234 if entry.size == 4 else 0 for entry in entries]
    before = [read(wire, facts, *entry.key) for entry in plain]
    assert wire.receive(FREE_ID, data_of(entries, values).hex(" ")) == []
    wire.wait(3)
    assert [read(wire, facts, *entry.key) for entry in plain] == before
    assert wire.receive(0x080) == []
    assert [read(wire, facts, *entry.key) for entry in plain] == [1234] * len(plain)
    assert wire.value(0x1001) == 0


# --- sent -------------------------------------------------------------------------------------------------------------
@EACH_TPDO
def test_what_is_sent_is_what_an_sdo_reads(wire, facts, pdo):
    entries = facts.mapped(pdo)
    silence(wire, facts)
    give(wire, pdo, FREE_ID, 1)
    wire.start()
    wire.wait(3)
    (frame,) = wire.receive(0x080)
    assert frame.can_id == FREE_ID
    assert parts(frame.data, entries) == [read(wire, facts, *entry.key) for entry in entries]


@pytest.mark.every(9)
@EACH_TPDO
def test_every_transmission_type(wire, facts, pdo):
    """0: at a SYNC after a change; n: at every nth; 254 and 255: once, at the change."""
    silence(wire, facts)
    for kind in range(256):
        assert (wire.download(pdo, 2, kind, 1) == RANGE) == (kind in RESERVED), kind
    axis = facts.axis_of(facts.mapped(pdo)[0].index)
    word = facts.entries[STATUSWORD + PROFILE * axis, 0]
    configure(wire, pdo, 3, 0, 2)
    wire.start()
    for kind in (0, 1, 2, 240, 254, 255):
        assert write(wire, facts, CONTROLWORD + PROFILE * axis, 0) == 0
        wire.wait(2)
        give(wire, pdo, FREE_ID, kind, [word.mapping])
        low, new = read(wire, facts, *word.key), None
        seen = []
        for k in range(5):
            if k == 2:
                assert write(wire, facts, CONTROLWORD + PROFILE * axis, 6) == 0
                new = read(wire, facts, *word.key)
            seen.append([frame.data for frame in wire.receive(0x080)])
            wire.wait(1)
            seen[-1] += [frame.data for frame in wire.take()]
        first, second = low.to_bytes(2, "little"), new.to_bytes(2, "little")
        expected = {0: [[first], [], [second], [], []], 1: [[first]] * 2 + [[second]] * 3,
                    2: [[], [first], [], [second], []], 240: [[]] * 5}  # fmt: skip
        assert seen == expected.get(kind, [[first], [], [second], [], []]), kind
        configure(wire, pdo, 1, FREE_ID | OFF | NO_REMOTE, 4)


@EACH_DEVICE
@pytest.mark.parametrize("kind", [3, 240])
def test_every_nth_sync_is_counted_by_each_pdo(wire, facts, kind):
    first, last = facts.tpdos[0], facts.tpdos[-1]
    silence(wire, facts)
    give(wire, first, FREE_ID, kind)
    wire.start()
    wire.receive(0x080)
    give(wire, last, FREE_ID + 1, kind)  # counts from here on
    seen = {FREE_ID: [], FREE_ID + 1: []}
    for k in range(2, 2 * kind + 2):
        for frame in wire.receive(0x080):
            seen[frame.can_id].append(k)
    assert seen == {FREE_ID: [kind, 2 * kind], FREE_ID + 1: [kind + 1, 2 * kind + 1]}


@EACH_TPDO
def test_inhibit_time_and_event_timer_in_their_units(wire, facts, pdo):
    """The event timer in ms; the inhibit time in 100 us by CiA 301, in ms by some manuals."""
    silence(wire, facts)
    axis = facts.axis_of(facts.mapped(pdo)[0].index)
    word = facts.entries[STATUSWORD + PROFILE * axis, 0]
    give(wire, pdo, FREE_ID, 255, [word.mapping])
    ticks = round(0.02 / facts.manual.inhibit_unit)
    assert wire.download(pdo, 3, ticks, 2) == WRONG_STATE, "not while it is on (CiA 301, 1800h)"
    configure(wire, pdo, 1, FREE_ID | OFF | NO_REMOTE, 4)
    configure(wire, pdo, 3, ticks, 2)
    configure(wire, pdo, 1, FREE_ID | NO_REMOTE, 4)
    configure(wire, pdo, 5, 5, 2)  # shorter than the inhibit time, which counts
    wire.node.receive(FrameOf.START, wire.now)
    told = []
    for k in range(45):
        wire.wait(1)
        told += [k for frame in wire.take() if frame.can_id == FREE_ID]
    assert told == [0, 20, 40]
    configure(wire, pdo, 1, FREE_ID | OFF | NO_REMOTE, 4)
    configure(wire, pdo, 3, 0, 2)
    configure(wire, pdo, 5, 7, 2)
    configure(wire, pdo, 1, FREE_ID | NO_REMOTE, 4)
    told = []
    for k in range(20):
        wire.wait(1)
        told += [k for frame in wire.take() if frame.can_id == FREE_ID]
    assert told == [0, 7, 14]


class FrameOf:
    """Frames that tests hand over without looking at the answers."""

    from drive_env.canopen.frames import Frame

    START = Frame(0, bytes((1, NODE)))


# --- identifiers ------------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_identifiers_follow_cia_301(wire, facts):
    for pdo in (*facts.rpdos, *facts.tpdos):
        if wire.value(pdo, 1) & OFF:
            configure(wire, pdo, 1, FREE_ID | NO_REMOTE, 4)
        before = wire.value(pdo, 1)
        assert wire.download(pdo, 1, (before ^ 0x10) & ~OFF, 4) == WRONG_STATE, "in use"
        for bad in (*RESTRICTED, FREE_ID | 1 << 29, FREE_ID | 1 << 11):
            assert wire.download(pdo, 1, bad | NO_REMOTE, 4) == RANGE, f"{pdo:04X}h {bad:08X}h"
        configure(wire, pdo, 1, before | OFF, 4)
        for bad in RESTRICTED:
            assert wire.download(pdo, 1, bad | NO_REMOTE, 4) == RANGE
        assert wire.value(pdo, 1) == before | OFF
        configure(wire, pdo, 1, FREE_ID, 4)
        assert wire.value(pdo, 1) == FREE_ID | NO_REMOTE, "bit 30 reads 1: no remote frames"
        configure(wire, pdo, 1, before | OFF, 4)


@EACH_DEVICE
def test_the_identifier_of_sync(wire, facts):
    """CiA 301, 1005h: of 11 bits, none that is reserved; none of them produces SYNC (bit 30), which has no 1006h."""
    assert facts.default(0x1005) & 0x7FF == 0x80 and not facts.has(0x1006)
    silence(wire, facts)
    give(wire, facts.tpdos[-1], FREE_ID, 1)
    wire.start()
    for bad in (0x4000_0080, 0x2000_0080, 0x880, *(one for one in RESTRICTED)):
        assert wire.download(0x1005, 0, bad, 4) == RANGE, f"{bad:08X}h"
    configure(wire, 0x1005, 0, 0x81, 4)
    assert wire.receive(0x080) == []
    assert [frame.can_id for frame in wire.receive(0x081)] == [FREE_ID]
    assert [frame.can_id for frame in wire.receive(0x081, "07")] == [FREE_ID], "with a counter, too"
    for data in ("01 02", "00 00 00 00 00 00 00 00"):
        assert wire.receive(0x081, data) == [], "no SYNC"
    wire.play("rx 081  RTR")


@EACH_DEVICE
def test_no_remote_frame_is_answered(wire, facts):
    wire.start()
    for pdo in (*facts.rpdos, *facts.tpdos):
        if not wire.value(pdo, 1) & OFF:
            wire.play(f"rx {wire.value(pdo, 1) & 0x7FF:03X}  RTR")


# --- mapping ----------------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_every_mappable_object_travels_each_way_that_it_can(wire, facts):
    """An object with PDOMapping=1: in a TPDO if it can be read, in an RPDO if it can be written, and nothing else."""
    silence(wire, facts)
    receive, transmit = facts.rpdos[0], facts.tpdos[0]
    give(wire, transmit, FREE_ID + 1, 1, [])
    give(wire, receive, FREE_ID, None, [])
    wire.start()
    for entry in facts.entries.values():
        if entry.bits is None:
            continue
        for pdo in (transmit, receive):
            configure(wire, pdo, 1, wire.value(pdo, 1) | OFF, 4)
            configure(wire, pdo + 0x200, 0, 0, 1)
            code = wire.download(pdo + 0x200, 1, entry.mapping, 4)
            assert code == (0 if entry.travels(pdo == transmit) else NOT_MAPPABLE), f"{entry.label} in {pdo:04X}h"
            if code:
                continue
            configure(wire, pdo + 0x200, 0, 1, 1)
            configure(wire, pdo, 1, wire.value(pdo, 1) & ~OFF, 4)
            known = read(wire, facts, *entry.key)
            if pdo == transmit:
                (frame,) = [one for one in wire.receive(0x080) if one.can_id == FREE_ID + 1]
                assert parts(frame.data, [entry]) == [known], entry.label
            else:
                assert wire.receive(FREE_ID, data_of([entry], [known]).hex(" ")) == [], entry.label
                assert read(wire, facts, *entry.key) == known


@EACH_DEVICE
def test_every_breach_of_the_order_of_mapping_is_refused(wire, facts):
    plain = next(e for e in facts.entries.values() if e.bits and not e.mappable and e.access == "rw")
    for pdo in (*facts.rpdos, *facts.tpdos):
        mapping, room, first = pdo + 0x200, facts.room(pdo), facts.default(pdo + 0x200, 1)
        is_sent = pdo in facts.tpdos
        if wire.value(pdo, 1) & OFF:
            configure(wire, pdo, 1, FREE_ID | NO_REMOTE, 4)
        assert wire.download(mapping, 0, 0, 1) == UNSUPPORTED, "the PDO is on"
        assert wire.download(mapping, 1, first, 4) == UNSUPPORTED
        configure(wire, pdo, 1, wire.value(pdo, 1) | OFF, 4)
        assert wire.download(mapping, 1, first, 4) == UNSUPPORTED, "the number of entries is not 0"
        configure(wire, mapping, 0, 0, 1)
        for raw, code in (
            (0x5FFE_0010, NO_OBJECT), (0x0005_0008, NO_OBJECT), (first | 0x7F00, NO_SUB_INDEX),
            (first ^ 0x0030, NOT_MAPPABLE), (plain.mapping, NOT_MAPPABLE),
            ((CONTROLWORD if is_sent else STATUSWORD) << 16 | 0x0008, NOT_MAPPABLE),
        ):  # fmt: skip
            assert wire.download(mapping, 1, raw, 4) == code, f"{mapping:04X}h {raw:08X}h"
        assert wire.download(mapping, 0, room + 1, 1) == TOO_HIGH
        assert wire.download(mapping, room + 1, first, 4) == NO_SUB_INDEX
        configure(wire, mapping, 2, 0, 4)
        assert wire.download(mapping, 0, 2, 1) == NO_OBJECT, "the second entry is empty"
        wide = facts.entries[0x6064 if is_sent else 0x607A, 0].mapping
        for sub in range(1, 4):
            configure(wire, mapping, sub, wide, 4)
        assert wire.download(mapping, 0, 3, 1) == TOO_MUCH, "12 bytes"
        configure(wire, mapping, 0, 2, 1)
        assert wire.value(mapping, 0) == 2


@EACH_DEVICE
def test_a_pdo_is_filled_with_objects_of_all_axes(wire, facts):
    """As many as it takes, in their order; eight bytes at most."""
    silence(wire, facts)
    pdo = facts.tpdos[-1]
    words = [facts.entries[index + PROFILE * axis, 0] for axis in facts.axes for index in (STATUSWORD, MODE_DISPLAY)]
    chosen = (words * 8)[: facts.room(pdo)]
    while sum(entry.size for entry in chosen) > 8:
        chosen.pop()
    axis = facts.axes[-1]
    set_mode(wire, facts, axis)
    assert write(wire, facts, CONTROLWORD + PROFILE * axis, 6) == 0
    give(wire, pdo, FREE_ID, 1, [entry.mapping for entry in chosen])
    wire.start()
    (frame,) = wire.receive(0x080)
    assert parts(frame.data, chosen) == [read(wire, facts, *entry.key) for entry in chosen]
