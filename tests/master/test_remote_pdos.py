"""PDOs of a node as its master finds, maps and puts them back: SDO writes as transcripts, over objects of this test.

The node has two axes, whose profile objects lie 800h apart, and of each direction six PDOs, three for an axis.
"""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.small_eds import I8, I16, I32, TEXT, U16, described, small_eds

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import EdsText
from drive_env.fieldbus.errors import BusError, NoAnswerError, RefusedError
from drive_env.master.can import pdo
from drive_env.master.can.bus_time import BusTime
from drive_env.master.can.network import Network, check_nodes
from drive_env.master.can.pdo import INTO_DRIVE, OUT_OF_DRIVE, PdoConfiguration, RemotePdo
from drive_env.master.can.process_data import PdoProcessData
from drive_env.master.packing import Member

ROWS = [
    (0x6040, "Controlword", U16, "rww", 1), (0x6041, "Statusword", U16, "ro", 1), (0x6060, "Mode", I8, "rw", 1),
    (0x6064, "Position", I32, "ro", 1), (0x606C, "Velocity", I32, "rwr", 1), (0x6071, "Target torque", I16, "wo", 1),
    (0x607A, "Target position", I32, "rww", 1), (0x6061, "Mode display", I8, "ro", 0),
    (0x6081, "Limit", I32, "const", 1),
]  # fmt: skip
ODD = [(0x2000, "Flag", 0x01, "rw", 1), (0x2001, "Name", TEXT, "rw", 1)]
NUMBERS = range(6)


def node_eds(entries=4, most=None, odd=()):
    further = [(index + 0x800, f"{name} 2", *rest) for index, name, *rest in ROWS]
    records = []
    for number in NUMBERS:
        records += [(0x1400 + number, "rw", 2, None), (0x1600 + number, "rw", entries, most),
                    (0x1800 + number, "rw", 2, None), (0x1A00 + number, "rw", entries, most)]  # fmt: skip
    return small_eds([*ROWS, *further, *ODD], [*records, *odd])


@pytest.fixture(scope="module")
def drive():
    return described(node_eds(), 2)


@pytest.fixture(scope="module")
def one(drive):
    """Return the entries of indices."""
    return lambda *indices: [drive.dictionary.find(index) for index in indices]


class Node:
    """The objects of a node; writes are noted."""

    def __init__(self):
        self.objects, self.log, self.refused, self.silent = {}, [], {}, set()
        for number in NUMBERS:
            for base, cob_id, kind in ((0x1400, 0x80000000, 255), (0x1800, 0xC0000000, 254)):
                self.put(base + number, 1, cob_id, 4)
                self.put(base + number, 2, kind, 1)
            for base, mapped in ((0x1600, (0x60400010,)), (0x1A00, (0x60410010,))):
                self.put(base + number, 0, len(mapped), 1)
                for sub in range(1, 5):
                    self.put(base + number, sub, mapped[sub - 1] if sub <= len(mapped) else 0, 4)

    def put(self, index, sub, value, size):
        self.objects[index, sub] = value.to_bytes(size, "little")

    def read(self, index, sub, label, timeout):
        assert timeout == 0.5 and label == f"{index:04X}h:{sub:02X}"
        return self.objects[index, sub]

    def write(self, index, sub, data, label, timeout, back=""):
        value = int.from_bytes(data, "little")
        assert timeout == 0.5 and label == f"{index:04X}h:{sub:02X} = {value:X}h"
        if index in self.silent:
            raise NoAnswerError(f"{index:04X}h is silent")
        if value in self.refused.get((index, sub), ()):
            raise RefusedError(0x06090030, f"{value} is none")
        self.log.append(f"{index:04X}:{sub:02X} {value:0{2 * len(data)}X}{back}")
        self.objects[index, sub] = data

    def put_back(self, index, sub, data, label, timeout):
        self.write(index, sub, data, label, timeout, " back")

    def take(self):
        taken, self.log = self.log, []
        return taken


@pytest.fixture
def node():
    return Node()


@pytest.fixture
def borrowed():
    return SimpleNamespace(node_of=lambda node, axis: 10 * node + axis)


@pytest.fixture
def pdos(node, drive, borrowed):
    return PdoConfiguration(5, node, drive, borrowed)


def split(text):
    return [row.strip() for row in text.splitlines() if row.strip()]


# --- what a PDO can carry ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("index", "into", "out"), [
    (0x6040, True, False), (0x6041, False, True), (0x6060, True, True), (0x606C, False, True), (0x6071, True, False),
    (0x6061, False, False), (0x6081, False, False),
    (0x2000, False, False), (0x2001, False, False),  # a bit, a text
])  # fmt: skip
def test_what_a_pdo_of_each_direction_carries(drive, index, into, out):
    entry = drive.dictionary.find(index)
    found = [pdo.is_mappable(drive, entry, direction) for direction in (INTO_DRIVE, OUT_OF_DRIVE)]
    assert found == [into, out]


def test_what_no_pdo_carries_is_told_with_what_one_does(drive, one):
    pdo.check_mappable(drive, one(0x6041, 0x6064), OUT_OF_DRIVE)
    listed = ", ".join(entry.label for entry in one(0x6041, 0x6060, 0x6064, 0x606C))
    further = ", ".join(entry.label for entry in one(0x6841, 0x6860, 0x6864, 0x686C))
    with pytest.raises(ObjectAccessError) as error:
        pdo.check_mappable(drive, one(0x6041, 0x6061), OUT_OF_DRIVE)
    assert error.value.abort_code == 0x06040041
    assert str(error.value).startswith(
        f"6061h:00 Mode display cannot be recorded: no TPDO of small carries it; they carry {listed}, {further}. "
        "Read or write it instead"
    )
    with pytest.raises(ObjectAccessError, match=r"^6041h:00 Statusword cannot be played: no RPDO of small carries it"):
        pdo.check_mappable(drive, one(0x6041), INTO_DRIVE)
    none = described(small_eds([(0x6041, "Statusword", U16, "ro", 0)], []), 1)
    assert pdo.mappable_names(none, INTO_DRIVE) == "none"


@pytest.mark.parametrize(("axis", "numbers"), [(0, (0, 1, 2)), (1, (3, 4, 5))])
def test_axes_have_equal_shares_of_the_pdos(drive, axis, numbers):
    assert pdo.slots(drive, OUT_OF_DRIVE, axis) == (numbers, 4)
    assert pdo.slots(drive, INTO_DRIVE, axis) == (numbers, 4)


@pytest.mark.parametrize(("entries", "most", "expected"), [
    (4, None, 4), (4, 3, 3), (4, 64, 4), (12, None, 8),  # of 8 bits at least, a PDO has room for 8
    (0, None, 0),
])  # fmt: skip
def test_entries_of_a_pdo_are_those_that_the_eds_lists_and_sub_index_0_takes(entries, most, expected):
    assert pdo.slots(described(node_eds(entries=entries, most=most), 2), INTO_DRIVE, 0).entries == expected


def test_a_pdo_has_both_its_parameters_and_there_are_512_of_a_direction():
    odd = [(0x15FF, "rw", 2, None), (0x17FF, "rw", 3, None), (0x1407, "rw", 2, None), (0x1608, "rw", 2, None)]
    drive = described(node_eds(odd=odd), 1)
    assert pdo.slots(drive, INTO_DRIVE, 0).numbers == (*NUMBERS, 0x1FF)
    assert pdo.slots(described(node_eds(odd=odd), 3), INTO_DRIVE, 2).numbers == (4, 5), "what is over is nobody's"
    assert pdo.slots(described(small_eds(ROWS, []), 1), INTO_DRIVE, 0) == ((), 0)


def test_what_goes_into_the_drive_keeps_its_order(drive, one):
    assert pdo.plan(drive, (), INTO_DRIVE) == []
    entries = one(0x6040, 0x607A, 0x6060)
    assert pdo.plan(drive, entries, INTO_DRIVE) == [entries]
    assert pdo.plan(drive, one(0x6041, 0x6064), OUT_OF_DRIVE) == [one(0x6064, 0x6041)], "widest first"
    six = one(0x6064, 0x606C) * 3
    assert pdo.plan(drive, six, OUT_OF_DRIVE) == [one(0x6064, 0x606C)] * 3
    assert pdo.plan(drive, six + one(0x6060), OUT_OF_DRIVE) is None
    error = pdo.too_many(drive, six + one(0x6060), OUT_OF_DRIVE)
    assert error.abort_code == 0x06040042
    assert str(error).startswith(
        "7 objects of 200 bits do not fit: small has 3 TPDOs for an axis, each with at most 4 objects of 64 bits "
        "together; take fewer at a time of 6041h:00 Statusword, 6060h:00 Mode"
    )


# --- mapping ----------------------------------------------------------------------------------------------------------
def test_a_tpdo_is_mapped_in_the_order_of_cia_301(pdos, node, one):
    """Off, with each SYNC, no entries, entries, their number, on; the second axis has borrowed identifiers."""
    found = pdos.configure([one(0x6064, 0x6041)], OUT_OF_DRIVE)
    assert node.take() == split("""
        1800:01 C0000185
        1800:02 01
        1A00:00 00
        1A00:01 60640020
        1A00:02 60410010
        1A00:00 02
        1800:01 40000185
        1803:01 C0000485
        1803:02 01
        1A03:00 00
        1A03:01 68640020
        1A03:02 68410010
        1A03:00 02
        1803:01 40000485
    """)
    position, status = one(0x6064, 0x6041)
    assert found == [
        RemotePdo("TPDO 1 of node 5", 0x185, 6, ((position, 0, 0, 4), (status, 0, 4, 2))),
        RemotePdo("TPDO 4 of node 5", 0x485, 6, ((position, 1, 0, 4), (status, 1, 4, 2))),
    ]


def test_an_rpdo_waits_for_sync(pdos, node, one):
    pdos.configure([one(0x6040)], INTO_DRIVE)
    assert node.take() == split("""
        1400:01 80000205
        1400:02 01
        1600:00 00
        1600:01 60400010
        1600:00 01
        1400:01 00000205
        1403:01 80000505
        1403:02 01
        1603:00 00
        1603:01 68400010
        1603:00 01
        1403:01 00000505
    """)


def test_an_identifier_that_the_node_has_is_kept(pdos, node, one):
    node.put(0x1400, 1, 0x321, 4)
    node.put(0x1403, 1, 0x80000322, 4)
    found = pdos.configure([one(0x6040)], INTO_DRIVE)
    assert [one.can_id for one in found] == [0x321, 0x322]
    assert [row for row in node.take() if ":01 " in row and row[1] == "4"] == [
        "1400:01 80000321", "1400:01 00000321", "1403:01 80000322", "1403:01 00000322"
    ]  # fmt: skip


def test_an_identifier_of_29_bits_is_none_of_ours(pdos, node, one):
    node.put(0x1400, 1, 0x20000321, 4)
    with pytest.raises(
        BusError, match=r"^RPDO 1 of node 5 has no 11-bit identifier \(20000321h in 1400h:01\); give it "
    ):
        pdos.configure([one(0x6040)], INTO_DRIVE)


def test_a_fifth_pdo_of_an_axis_has_no_identifier():
    drive = described(node_eds(odd=()), 1)
    groups = [[drive.dictionary.find(0x6040)]] * 5
    node = Node()
    with pytest.raises(BusError, match=r"^RPDO 5 of node 5 has no 11-bit identifier \(80000000h in 1404h:01\); give"):
        PdoConfiguration(5, node, drive, None).configure(groups, INTO_DRIVE)
    node.put(0x1404, 1, 0x555, 4)
    found = PdoConfiguration(5, node, drive, None).configure(groups, INTO_DRIVE)
    assert [one.can_id for one in found] == [0x205, 0x305, 0x405, 0x505, 0x555]


def test_further_axes_borrow_identifiers_in_their_order(pdos, drive, one):
    """PDO 5 and 6 of the node are the second and third of axis 1: 300h, 400h and the node that they are borrowed of."""
    found = pdos.configure([one(0x6040), one(0x6060), one(0x607A)], INTO_DRIVE)
    assert [one.can_id for one in found] == [0x205, 0x305, 0x405, 0x505, 0x300 + 51, 0x400 + 51]


def test_only_the_first_four_pdos_of_a_further_axis_can_borrow(borrowed):
    records = [(base + k, "rw", 2, None) for base in (0x1400, 0x1600) for k in range(6, 10)]
    drive = described(node_eds(odd=records), 2)
    node = Node()
    for number in range(6, 10):
        node.put(0x1400 + number, 1, 0, 4)
        node.put(0x1400 + number, 2, 255, 1)
        node.put(0x1600 + number, 0, 0, 1)
        node.put(0x1600 + number, 1, 0, 4)
    node.put(0x1404, 1, 0x321, 4)
    groups = [[drive.dictionary.find(0x6040)]] * 5
    with pytest.raises(BusError, match=r"^RPDO 10 of node 5 has no 11-bit identifier "):
        PdoConfiguration(5, node, drive, borrowed).configure(groups, INTO_DRIVE)
    assert [row for row in node.take() if row[:7] in ("1408:01",)][-1] == f"1408:01 {0x500 + 51:08X}"


@pytest.mark.parametrize(("refused", "own", "taken"), [((1,), 1, 0), ((), 1, 1), ((), 240, 240), ((240,), 240, 1)])
def test_of_the_types_that_wait_for_sync_the_first_is_taken_that_the_drive_takes(node, drive, one, refused, own, taken):
    node.refused[0x1400, 2] = refused
    known = dataclasses.replace(drive, hints=drive.hints._replace(rpdo_type=own))
    PdoConfiguration(5, node, known, SimpleNamespace(node_of=lambda node, axis: 6)).configure([one(0x6040)], INTO_DRIVE)
    assert [row for row in node.take() if row.startswith("1400:02")] == [f"1400:02 {taken:02X}"]


def test_a_drive_that_takes_none_of_them_is_told(pdos, node, one):
    node.refused[0x1400, 2] = (0, 1)
    with pytest.raises(RefusedError, match=r"^0 is none"):
        pdos.configure([one(0x6040)], INTO_DRIVE)


@pytest.mark.parametrize("access", ["ro", "const"])
def test_a_type_that_nobody_can_write_is_left(node, access):
    eds = node_eds()
    fixed = re.sub(r"(\[14..sub2\]\n[^[]*?AccessType=)rw", rf"\g<1>{access}", eds.text)
    assert fixed.count(f"AccessType={access}") > eds.text.count(f"AccessType={access}")
    drive = described(EdsText("fixed.eds", fixed), 2)
    found = PdoConfiguration(5, node, drive, SimpleNamespace(node_of=lambda node, axis: 6))
    found.configure([[drive.dictionary.find(0x6040)]], INTO_DRIVE)
    assert node.take()[:3] == ["1400:01 80000205", "1600:00 00", "1600:01 60400010"]
    found.configure([[drive.dictionary.find(0x6041)]], OUT_OF_DRIVE)
    assert node.take()[:2] == ["1800:01 C0000185", "1800:02 01"], "of a TPDO it must be written"


# --- putting back -----------------------------------------------------------------------------------------------------
def test_what_was_found_is_put_back_with_the_entries_that_were_overwritten(pdos, node, one):
    node.put(0x1A00, 2, 0x60770010, 4)  # not in use, and overwritten
    node.put(0x1A00, 3, 0x60780010, 4)
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    pdos.configure([one(0x6064, 0x6041)], OUT_OF_DRIVE)
    node.take()
    pdos.restore()
    assert node.take()[:8] == split("""
        1800:01 C0000000 back
        1800:02 FE back
        1A00:00 00 back
        1A00:01 60410010 back
        1A00:02 60770010 back
        1A00:00 01 back
        1800:01 C0000000 back
        1803:01 C0000000 back
    """)
    pdos.restore()
    assert node.take() == [], "nothing is left to put back"


def test_a_pdo_that_is_not_needed_any_more_is_put_back(pdos, node, one):
    pdos.configure([one(0x6041), one(0x6064)], OUT_OF_DRIVE)
    pdos.configure([one(0x6040)], INTO_DRIVE)
    node.take()
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    back = [row for row in node.take() if "back" in row]
    assert [row for row in back if row[:7] in ("1801:01", "1804:01")] == [
        "1801:01 C0000000 back", "1801:01 C0000000 back", "1804:01 C0000000 back", "1804:01 C0000000 back"
    ]  # fmt: skip
    assert {row[:4] for row in back} == {"1801", "1A01", "1804", "1A04"}


def test_what_cannot_be_put_back_keeps_nothing_else_from_it(pdos, node, one):
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    pdos.configure([one(0x6040)], INTO_DRIVE)
    node.take()
    node.silent = {0x1800}
    with pytest.raises(BusError, match=r"^1800h is silent$"):
        pdos.restore()
    assert {row[:4] for row in node.take()} == {"1803", "1A03", "1400", "1600", "1403", "1603"}


def test_what_a_node_has_that_was_reset_is_not_put_back(pdos, node, one):
    node.put(0x1801, 2, 1, 1)
    node.put(0x1801, 1, 0x285, 4)
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    node.take()
    pdos.forget()
    pdos.restore()
    assert node.take() == []


# --- TPDOs of others --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("cob_id", "kind", "silenced"), [
    (0x40000285, 0, True), (0x285, 1, True), (0x285, 240, True), (0x285, 241, False), (0x285, 254, False),
    (0xC0000285, 1, False),  # it is off
])  # fmt: skip
def test_tpdos_that_go_with_sync_are_silent_meanwhile(pdos, node, one, cob_id, kind, silenced):
    node.put(0x1801, 1, cob_id, 4)
    node.put(0x1801, 2, kind, 1)
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    off = [f"1801:01 {cob_id | 0x80000000:08X}"] if silenced else []
    assert [row for row in node.take() if row[:4] == "1801"] == off
    pdos.configure([one(0x6064)], OUT_OF_DRIVE)
    assert [row for row in node.take() if row[:4] == "1801"] == [], "once is enough"
    pdos.restore()
    back = [f"1801:01 {cob_id:08X} back"] if silenced else []
    assert [row for row in node.take() if row[:4] == "1801"] == back
    pdos.restore()
    assert node.take() == []


def test_a_silent_tpdo_that_is_needed_is_put_back_as_it_was_before(pdos, node, one):
    node.put(0x1801, 1, 0x285, 4)
    node.put(0x1801, 2, 1, 1)
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    pdos.configure([one(0x6041), one(0x6064)], OUT_OF_DRIVE)
    node.take()
    pdos.restore()
    assert [row for row in node.take() if row[:7] == "1801:01"] == ["1801:01 80000285 back", "1801:01 00000285 back"]


def test_a_tpdo_that_was_used_and_put_back_goes_with_sync_again(pdos, node, one):
    """So it is silenced when it is not used; what is put back counts as unknown."""
    node.put(0x1801, 1, 0x285, 4)
    node.put(0x1801, 2, 1, 1)
    pdos.configure([one(0x6041), one(0x6064)], OUT_OF_DRIVE)
    node.take()
    pdos.configure([one(0x6041)], OUT_OF_DRIVE)
    assert [row for row in node.take() if row[:7] == "1801:01"][-1] == "1801:01 80000285"
    pdos.restore()
    assert node.objects[0x1801, 1] == (0x285).to_bytes(4, "little")


def test_rpdos_silence_nobody(pdos, node, one):
    node.put(0x1801, 1, 0x285, 4)
    node.put(0x1801, 2, 1, 1)
    pdos.configure([one(0x6040)], INTO_DRIVE)
    assert not [row for row in node.take() if row.startswith("18")]


# --- several nodes ----------------------------------------------------------------------------------------------------
class Bus:
    """A port that notes what is sent, and hands frames to who subscribed."""

    def __init__(self):
        self.sent, self.takers = [], {}

    def send(self, can_id, data=b""):
        self.sent.append((can_id, data.hex(" ")))

    def subscribe(self, can_id, taker):
        if taker is None:
            del self.takers[can_id]
        else:
            self.takers[can_id] = taker

    def drain(self):
        pass


class Configured:
    """A node's PDOs that notes what is asked of it."""

    def __init__(self, node):
        self.node, self.asked = node, []

    def configure(self, groups, direction):
        self.asked.append((direction.name, [[entry.index for entry in group] for group in groups]))
        pdos = []
        for number, group in enumerate(groups):
            members, start = [], 0
            for entry in group:
                members.append(Member(entry, 0, start, entry.bits // 8))
                start += entry.bits // 8
            pdos.append(
                RemotePdo(f"PDO {number + 1}", direction.identifiers[number] + self.node, start, tuple(members))
            )
        return pdos

    def standing(self, direction):
        return ()

    def forget(self):
        self.asked.append("forget")

    def restore(self):
        self.asked.append("restore")


@pytest.fixture(scope="module")
def single():
    return described(small_eds(ROWS, [(base + k, "rw", 4, None) for base in (0x1400, 0x1600, 0x1800, 0x1A00)
                                      for k in range(2)]), 1)  # fmt: skip


@pytest.fixture(scope="module")
def of(single):
    return lambda *indices: tuple(single.dictionary.find(index) for index in indices)


@pytest.fixture
def nodes():
    return [Configured(5), Configured(7)]


@pytest.fixture
def bus():
    return Bus()


@pytest.fixture
def process(bus, single, nodes):
    return PdoProcessData(bus, single, nodes)


def test_process_data_are_mapped_once_on_every_node(process, nodes, of):
    assert not process.is_mapped((), of(0x6041)) and process.is_mapped((), ())
    process.map(of(0x6040), of(0x6041, 0x6064))
    assert nodes[0].asked == nodes[1].asked == [("RPDO", [[0x6040]]), ("TPDO", [[0x6064, 0x6041]])]
    assert process.mapping == 2 and process.sampled_entries() == of(0x6041, 0x6064)
    assert process.is_mapped(of(0x6040), of(0x6064)), "others may come besides"
    assert process.is_mapped((), of(0x6041)) and not process.is_mapped(of(0x6060), of(0x6064))
    assert not process.is_mapped(of(0x6040), of(0x606C))
    process.map(of(0x6040), of(0x6064))
    process.map((), of(0x6064))
    assert process.mapping == 2, "it is all there"
    process.map(of(0x6040), of(0x606C))
    assert process.mapping == 3 and nodes[0].asked[2:] == [("TPDO", [[0x606C]])]


def test_nothing_counts_as_mapped_of_nodes_that_have_restarted(process, nodes, of):
    process.map(of(0x6040), of(0x6041))
    process.forget([1])
    assert nodes[0].asked[-1] != "forget" and nodes[1].asked[-1] == "forget"
    assert process.mapping == 3 and process.sampled_entries() == () and not process.is_mapped(of(0x6040), ())
    process.restore(0)
    assert nodes[0].asked[-1] == "restore" and nodes[1].asked[-1] == "forget"


def test_what_does_not_fit_into_pdos_is_told_and_maps_nothing(process, nodes, of):
    five = of(0x6064, 0x606C, 0x6081, 0x6041, 0x6060)
    with pytest.raises(ObjectAccessError, match=r"^6 objects of 152 bits do not fit"):
        process.map((), (*five, of(0x6064)[0]))
    assert process.mapping == 0 and nodes[0].asked == []


def test_what_is_welcome_comes_as_far_as_there_is_room(process, single, nodes, bus, of):
    """Two TPDOs of 64 bits: three of 32 bits, and 16 and 8; what is last goes first."""
    wanted, welcome = of(0x6064), of(0x6041, 0x6064, 0x606C, 0x6081, 0x6060)
    assert process.choose(wanted, welcome) == of(0x6064, 0x6041, 0x606C, 0x6081, 0x6060)
    more = (*welcome, *of(0x6064, 0x606C))
    assert process.choose(wanted, more)[:5] == of(0x6064, 0x6041, 0x606C, 0x6081, 0x6060)
    with pytest.raises(ObjectAccessError, match=r"^5 objects of 160 bits do not fit"):
        process.choose(of(0x6064, 0x606C, 0x6081) + of(0x6064, 0x606C), welcome)
    # With all stuff bits: SYNC 47, of each PDO 47 + 64 + 24, of two nodes; the RPDO 47 + 16 + 12.
    for bits, expected in ((47 + 2 * 135 + 2 * 75, of(0x6064, 0x606C)), (47 + 2 * 135 + 2 * 75 - 1, of(0x6064))):
        room = PdoProcessData(bus, single, nodes, bus_time=BusTime(1e6, bits / 0.8 * 1e-6 * (1 + 1e-9)))
        assert room.choose(of(0x6064), of(0x606C), of(0x6040)) == expected
    none = PdoProcessData(bus, single, nodes, bus_time=BusTime(1e6, 1e-6))
    assert none.choose(of(0x6064), of(0x606C)) == of(0x6064), "what is wanted is wanted"
    with pytest.raises(ObjectAccessError, match="take at least") as error:
        none.map((), of(0x6064))
    assert error.value.abort_code == 0x06040042


def test_what_is_checked_is_told(process, of):
    process.check_sampled(of(0x6041))
    process.check_played(of(0x6040))
    with pytest.raises(ObjectAccessError, match="cannot be recorded"):
        process.check_sampled(of(0x6040))
    with pytest.raises(ObjectAccessError, match="cannot be played"):
        process.check_played(of(0x6041))


def test_rows_go_out_node_by_node(process, bus, of):
    assert process.outputs({}) is None
    process.map(of(0x607A, 0x6040, 0x6060), ())
    controlword, target, mode = of(0x6040, 0x607A, 0x6060)
    played = {
        controlword: np.array([[6, 7], [8, 9]]),
        target: np.array([[1, -1], [2, -2]]),
        mode: np.array([[8, 9]] * 2),
    }
    rows = process.outputs(played)
    rows.send(1)
    assert bus.sent == [(0x205, "02 00 00 00 08 00 08"), (0x207, "fe ff ff ff 09 00 09")]


def test_samples_are_of_the_mapped_tpdos(process, bus, single, nodes, of):
    assert process.samples() is None
    process.map((), of(0x6041))
    samples = process.samples()
    assert sorted(bus.takers) == [0x185, 0x187]
    bus.takers[0x185](b"\1\0")
    bus.takers[0x187](b"\2\0")
    assert samples.decode(0, 1)[0x6041, 0].tolist() == [[1, 2]]
    dry = PdoProcessData(bus, single, nodes, dry=True)
    dry.map((), of(0x6041))
    assert dry.samples() is None, "nobody is there"


# --- what nodes report by themselves ----------------------------------------------------------------------------------
@pytest.fixture
def network(bus):
    bus.waits = []
    bus.wait = lambda done, timeout: bus.waits.append(timeout) or done()
    return Network(bus, (5, 7))


def test_nmt_commands_go_to_our_nodes_alone(network, bus):
    network.command(1)
    network.command(0x80, (7,))
    assert bus.sent == [(0, "01 05"), (0, "01 07"), (0, "80 07")]


def test_a_reset_waits_for_boot_up_of_all(network, bus):
    """5 s; meanwhile nobody has restarted by itself."""
    restarted, booted = [], []
    network.on_restart, network.on_boot = restarted.append, booted.append

    def boots(done, timeout):
        assert timeout == 5.0
        bus.takers[0x705](b"\x7f"), bus.takers[0x705](b"\0\0"), bus.takers[0x707](b"\0")
        assert not done()
        bus.takers[0x705](b"\0")
        return done()

    bus.takers[0x705](b"\0")
    assert restarted == booted == [5], "nobody here has reset it"
    bus.wait = boots
    network.reset((5, 7))
    assert bus.sent == [(0, "81 05"), (0, "81 07")] and restarted == [5] and booted == [5, 7, 5]
    bus.takers[0x707](b"\0")
    assert restarted == [5, 7]


def test_nodes_that_do_not_boot_are_told(network, bus):
    restarted = []
    network.on_restart = restarted.append
    bus.takers[0x707](b"\0")  # before the reset: that is no boot-up after it
    bus.wait = lambda done, timeout: bus.takers[0x705](b"\0") or done()
    with pytest.raises(
        NoAnswerError, match=r"^node 7 sent no boot-up message \(700h \+ node\) within 5 s of its reset; "
    ):
        network.reset((5, 7))
    bus.takers[0x705](b"\0")
    assert restarted == [7, 5], "and the reset is over"


def test_emergencies_come_from_the_identifier_that_the_node_says(network, bus):
    bus.takers[0x85](bytes.fromhex("11 86 20 01 02 03 04 05"))
    bus.takers[0x87](bytes.fromhex("11 86 20 01 02 03 04"))  # cut short
    assert network.take_emergencies() == [(5, 0x8611, 0x20, (1, 2, 3, 4, 5))] and network.take_emergencies() == []
    network.move_emergencies(5, 0x80000321)
    network.move_emergencies(5, 0x85)
    assert 0x85 in bus.takers and 0x321 not in bus.takers
    network.move_emergencies(5, 0x40000321)
    assert 0x85 not in bus.takers
    bus.takers[0x321](bytes.fromhex("00 00 00 00 00 00 00 00"))
    assert network.take_emergencies() == [(5, 0, 0, (0, 0, 0, 0, 0))]


def test_error_control_is_passed_on(network, bus):
    heard = []
    bus.takers[0x705](b"\5")
    network.on_error_control = lambda *what: heard.append(what)
    bus.takers[0x707](b"\x7f")
    assert heard == [(7, b"\x7f")]


@pytest.mark.parametrize("nodes", [(), (0,), (128,), (5, 5), (-1, 3)])
def test_nodes_that_cannot_be(nodes):
    with pytest.raises(ValueError, match=r"^nodes are different numbers of 1 to 127, at least one; got \["):
        check_nodes(nodes)
    assert check_nodes([1, 127]) == (1, 127)
