"""Store and restore of every CAN device of ours (CiA 301, 1010h and 1011h); can_devices.py has the facts."""

from __future__ import annotations

import pytest
from rigs.can_devices import (
    DEVICES,
    LOAD,
    NO_REMOTE,
    NODE,
    OFF,
    SAVE,
    another,
    configure,
    fresh,
    give,
    read,
    silence,
    upload,
    write,
)

STORE, RESTORE = 0x1010, 0x1011
NO_OBJECT, NOT_STORED = 0x0602_0000, 0x0800_0020
FREE_ID = 0x2F5
STORING = [facts for facts in DEVICES if facts.manual.groups]
EACH_STORE = pytest.mark.parametrize("facts", STORING, ids=repr)
EACH_GROUP = pytest.mark.parametrize(
    ("facts", "sub"),
    [pytest.param(facts, sub, id=f"{facts}-{sub}") for facts in STORING for sub in facts.manual.groups],
)


@pytest.fixture
def wire(emulated, facts):
    """Node 5 with a memory of its own, pre-operational."""
    drives = emulated(facts.name)
    before = [dict(drives.inside.objects.stored(axis)) for axis in facts.axes]
    yield fresh(drives)
    for axis in facts.axes:  # the drives are everybody's: what they found at power-on they find again
        drives.inside.objects.store(axis, before[axis])


def power_cycled(wire):
    wire.node.power_on(wire.now)
    assert [str(frame) for frame in wire.take()] == ["705  00"]


def reset(wire, facts, sub):
    """Reset the node, which has the factory's number, 1, once group `sub` is restored with what it keeps of the bus."""
    forgets = bool(facts.manual.address or facts.manual.bus) and "communication" in facts.manual.groups[sub]
    wire.play(f"rx 000  81 05\ntx 70{1 if forgets else 5}  00")


def samples(wire, facts):
    """Change a parameter of each area; return its place and new value by area."""
    found = {}
    for entry in facts.parameters():
        area = facts.area_of(entry.index)
        if area in found or 0x1400 <= entry.index < 0x1C00 or entry.index == 0x1005:
            continue
        raw = another(wire, facts, entry, read(wire, facts, *entry.key))
        if raw is not None:
            found[area] = entry.key, raw
    return found


@EACH_STORE
def test_1010h_has_a_group_for_each_sub_index(facts):
    assert facts.subs(STORE)[1:] == facts.subs(RESTORE)[1:] == list(facts.manual.groups)
    assert facts.default(STORE) == facts.default(RESTORE) == len(facts.manual.groups)


@pytest.mark.every(4)
@EACH_GROUP
def test_a_group_stores_its_areas_and_no_other(wire, facts, sub):
    before = {entry.key: read(wire, facts, *entry.key) for entry in facts.parameters()}
    changed = samples(wire, facts)
    assert set(changed) == set(facts.manual.groups[1]), "each area has a parameter"
    assert wire.download(STORE, sub, SAVE, 4) == 0
    power_cycled(wire)
    for area, (key, raw) in changed.items():
        kept = area in facts.manual.groups[sub]
        assert read(wire, facts, *key) == (raw if kept else before[key]), area
    assert wire.value(STORE, sub) == wire.value(RESTORE, sub) == 1


@pytest.mark.every(4)
@EACH_GROUP
def test_a_group_is_restored_alone_and_after_a_reset_only(wire, facts, sub):
    changed = samples(wire, facts)
    assert wire.download(STORE, 1, SAVE, 4) == 0
    assert wire.download(RESTORE, sub, LOAD, 4) == 0
    assert all(read(wire, facts, *key) == raw for key, raw in changed.values()), "not yet"
    reset(wire, facts, sub)
    for area, (key, raw) in changed.items():
        restored = area in facts.manual.groups[sub]
        assert wire.value(*key) == (facts.default(*key) if restored else raw), area


@EACH_GROUP
def test_another_signature_stores_and_restores_nothing(wire, facts, sub):
    key, raw = samples(wire, facts)["profile"]
    for index, signature in ((STORE, LOAD), (STORE, 0x6461_7673), (STORE, 0x7361_7665), (RESTORE, SAVE), (RESTORE, 1)):
        assert wire.download(index, sub, signature, 4) == NOT_STORED
    power_cycled(wire)
    assert read(wire, facts, *key) != raw


@EACH_STORE
def test_every_parameter_is_stored_and_every_one_restored(wire, facts):
    """Each is changed to another value that it takes; after power-off and on it has that, after 1011h its default."""
    for entry in facts.parameters():
        if not (0x1400 <= entry.index < 0x1C00 or entry.index == 0x1005):
            another(wire, facts, entry, read(wire, facts, *entry.key))
    changed = {entry.key: read(wire, facts, *entry.key) for entry in facts.parameters()}
    assert sum(raw != facts.default(*key) for key, raw in changed.items()) > 0.5 * len(
        [key for key in changed if not 0x1400 <= key[0] < 0x1C00]
    )
    assert wire.download(STORE, 1, SAVE, 4) == 0
    power_cycled(wire)
    assert {key: read(wire, facts, *key) for key in changed} == changed
    assert wire.download(RESTORE, 1, LOAD, 4) == 0
    reset(wire, facts, 1)
    for entry in facts.parameters():
        assert wire.value(*entry.key) == facts.default(*entry.key, wire.node.node_id), entry.label


@EACH_STORE
def test_what_commands_or_counts_is_not_stored(wire, facts):
    """Outputs, set-points of images, an armed latch, a counter."""
    written = []
    for entry in facts.entries.values():
        if entry.index in facts.manual.commands and entry.is_written and entry.bits is not None:
            raw = another(wire, facts, entry, read(wire, facts, *entry.key))
            if raw is not None and read(wire, facts, *entry.key) == raw != facts.default(*entry.key):
                written.append(entry)
    assert wire.download(STORE, 1, SAVE, 4) == 0
    stored = {key for section in wire.node._store.sections.values() for key in section}
    assert stored.isdisjoint(entry.key for entry in written)
    power_cycled(wire)
    assert written, "each device that stores has such a one"
    for entry in written:
        assert read(wire, facts, *entry.key) == facts.default(*entry.key), entry.label


@EACH_STORE
def test_mapping_and_identifiers_of_every_axis_come_back(wire, facts):
    """The last of the PDOs that are sent, and of those that are received."""
    sent, received = facts.tpdos[-1], facts.rpdos[-1]
    words = [facts.entries[index, 0] for index in (0x6041, 0x6061)]
    give(wire, sent, FREE_ID, 1, [entry.mapping for entry in words])
    give(wire, received, FREE_ID + 1, None, [facts.entries[0x607A, 0].mapping])
    silence(wire, facts, (sent,))
    assert wire.download(STORE, min(sub for sub, areas in facts.manual.groups.items() if "communication" in areas),
                         SAVE, 4) == 0  # fmt: skip
    wire.play("rx 000  82 05\ntx 705  00")
    wire.start()
    wire.receive(FREE_ID + 1, "D2 04 00 00")
    assert read(wire, facts, 0x607A) == 1234
    (frame,) = wire.receive(0x080)
    assert frame.can_id == FREE_ID
    assert frame.data == b"".join(upload(wire, *entry.key) for entry in words)
    assert wire.value(received, 1) == FREE_ID + 1 | NO_REMOTE


@EACH_STORE
def test_commands_and_set_points_are_no_parameters(wire, facts):
    for axis in facts.axes:
        for index in (0x60FF, 0x607A):
            assert write(wire, facts, index + 0x800 * axis, 1000) == 0
        assert write(wire, facts, 0x6040 + 0x800 * axis, 6) == 0
    assert wire.download(STORE, 1, SAVE, 4) == 0
    power_cycled(wire)
    for axis in facts.axes:
        assert [read(wire, facts, index + 0x800 * axis) for index in (0x6040, 0x6060, 0x60FF, 0x607A)] == [0] * 4


@pytest.mark.parametrize("facts", [facts for facts in DEVICES if facts.manual.address], ids=repr)
def test_a_stored_node_id_is_in_force_after_a_reset_and_the_identifiers_follow(wire, facts):
    new, active, command = facts.manual.address
    configure(wire, *new, 33, 1)
    configure(wire, *command, SAVE, 4)
    assert wire.value(*active) == NODE, "not yet"
    wire.play("rx 000  82 05\ntx 705  00")  # reset communication is no reset of the module
    wire.play("rx 000  81 05\ntx 721  00")
    assert (wire.node.node_id, wire.value(*active)) == (33, 33)
    for pdo in (*facts.rpdos, *facts.tpdos):
        assert wire.value(pdo, 1) == facts.default(pdo, 1, 33), f"{pdo:04X}h"
        assert wire.value(pdo, 1) & OFF or wire.value(pdo, 1) & 0x7F == 33
    assert wire.value(0x1014) == 0x80 + 33


@pytest.mark.parametrize("facts", [facts for facts in DEVICES if not facts.manual.groups], ids=repr)
def test_a_device_that_stores_nothing_says_so_and_has_the_factory_s_values_after_power_on(wire, facts):
    for index, signature in ((STORE, SAVE), (RESTORE, LOAD)):
        assert upload(wire, index) == wire.download(index, 1, signature, 4) == NO_OBJECT
    configure(wire, 0x1017, 0, 1234, 2)
    power_cycled(wire)
    assert read(wire, facts, 0x1017) == facts.default(0x1017)
