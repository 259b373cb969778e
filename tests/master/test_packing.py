"""Integers of axes in the bytes of process data, which PDO an object goes into, and what comes with each SYNC."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env.devices.image_rows import ImageField
from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, UNSUPPORTED_ACCESS, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.mapping import Slots, pack
from drive_env.master.can.pdo import RemotePdo
from drive_env.master.can.samples import PdoSamples
from drive_env.master.packing import Member, integers, pack_rows, unpack_rows
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.fixed_images import PackedFields
from drive_env.node.process_data import MappedObjects


def entry(index=0x6064, bits=32, signed=True, access="rw", mappable=True, sub=0):
    return Entry(index, sub, "an object", bits, access, None, None, 0, "", mappable, signed)


# --- bytes --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("size", range(1, 9))
@pytest.mark.parametrize("signed", [True, False])
def test_integers_of_any_whole_number_of_bytes(size, signed):
    top = 2 ** (8 * size - 1)
    values = [0, 1, top - 1, *([-1, -top] if signed else [top, 2 * top - 1] if size < 8 else [])]
    data = np.array([list(value.to_bytes(size, "little", signed=signed)) for value in values], np.uint8)
    assert integers(data, signed).tolist() == values


def test_members_lie_one_behind_the_other_and_axes_of_a_node_at_its_columns():
    long, short = entry(), entry(0x6040, 16, signed=False)
    played = {long: np.array([[1, 2, -2], [3, 4, 5]]), short: np.array([[7, 8, 0xABCD], [0, 0, 1]])}
    members = [Member(short, 1, 0, 2), Member(long, 1, 2, 4), Member(short, 0, 6, 2)]
    packed = pack_rows(members, played, first_axis=1)
    assert [bytes(row).hex(" ") for row in packed] == ["cd ab fe ff ff ff 08 00", "01 00 05 00 00 00 00 00"]
    values = {}
    unpack_rows(values, packed, members, first_axis=1, num_axes=3)
    assert values[0x6064, 0][:, 2].tolist() == [-2, 5]
    assert values[0x6040, 0][:, 1:].tolist() == [[8, 0xABCD], [0, 1]]
    first = values[0x6040, 0]
    unpack_rows(values, packed[:, :2], [Member(short, 0, 0, 2)], first_axis=0, num_axes=3)
    assert values[0x6040, 0] is first and first[:, 0].tolist() == [0xABCD, 1]


# --- which PDO ----------------------------------------------------------------------------------------------------
def widths(found):
    return found if found is None else [[one.bits for one in pdo] for pdo in found]


@pytest.mark.parametrize(
    ("bits", "slots", "keep_order", "expected"),
    [
        ([], Slots((0,), 3), False, []),
        ([64], Slots((0,), 3), False, [[64]]),
        ([32, 32, 8], Slots((0,), 3), False, None),  # one bit more than 64 does not fit
        ([32, 32, 8], Slots((0, 1), 3), False, [[32, 32], [8]]),
        ([8, 8, 8, 8], Slots((0,), 3), False, None),  # nor one entry more than it takes
        ([8, 8, 8, 8], Slots((0,), 4), False, [[8, 8, 8, 8]]),
        ([16, 32, 16, 32, 32], Slots((0, 1), 3), False, [[32, 32], [32, 16, 16]]),
        ([16, 32, 16, 32, 32], Slots((0, 1), 3), True, [[16, 32, 16], [32, 32]]),
        ([32, 16, 32, 32, 16], Slots((0, 1), 3), True, [[32, 32], [32, 16, 16]]),  # in order it takes three
        ([40, 40, 24, 24], Slots((0, 1), 3), False, [[40, 24], [40, 24]]),
        ([40, 40], Slots((0,), 3), True, None),
        ([8], Slots((), 3), False, None),
        ([8], Slots((), 3), True, None),
        ([24, 24, 24, 16, 16, 16], Slots((0, 1), 3), False, [[24, 24, 16], [24, 16, 16]]),
        ([48, 16, 48, 16], Slots((0, 1), 1), False, None),
    ],
)
def test_what_goes_into_which_pdo(bits, slots, keep_order, expected):
    assert widths(pack([entry(bits=one) for one in bits], slots, keep_order=keep_order)) == expected


# --- the device's side --------------------------------------------------------------------------------------------
def test_a_mapping_entry_is_index_sub_index_and_bits():
    assert mapping.parse(0x20430710) == (0x2043, 0x07, 0x10)
    assert mapping.parse(0x6041FF08) == (0x6041, 0xFF, 0x08)


@pytest.mark.parametrize(("sub", "is_on", "count", "refused"), [
    (0, False, 0, False), (0, False, 3, False), (1, False, 0, False), (1, False, 1, True), (0, True, 0, True),
    (2, True, 0, True),
])  # fmt: skip
def test_a_mapping_is_changed_while_its_pdo_is_off_and_no_entry_is_in_use(sub, is_on, count, refused):
    if not refused:
        mapping.check_may_change(entry(0x1600, sub=sub), is_on, count)
        return
    with pytest.raises(ObjectAccessError) as caught:
        mapping.check_may_change(entry(0x1600, sub=sub), is_on, count)
    assert caught.value.abort_code == UNSUPPORTED_ACCESS


@pytest.mark.parametrize(
    ("mapped", "raw", "transmit", "refused"),
    [
        (entry(), 0x60640020, True, False),
        (entry(), 0x60640020, False, False),
        (entry(access="ro"), 0x60640020, True, False),
        (entry(access="ro"), 0x60640020, False, True),
        (entry(access="wo"), 0x60640020, False, False),
        (entry(access="wo"), 0x60640020, True, True),
        (entry(access="const"), 0x60640020, True, True),
        (entry(mappable=False), 0x60640020, True, True),
        (entry(bits=None), 0x60640020, True, True),
        (entry(bits=24), 0x60640018, True, True),  # no whole word of a PDO
        (entry(bits=16), 0x60640020, True, True),
        (entry(bits=64), 0x60640040, True, False),
        (entry(bits=8), 0x60640008, True, False),
    ],
)
def test_what_a_pdo_carries(mapped, raw, transmit, refused):
    if not refused:
        assert mapping.check_mappable(entry(0x1A00, sub=1), raw, transmit, lambda index, sub: mapped) is mapped
        return
    with pytest.raises(ObjectAccessError) as caught:
        mapping.check_mappable(entry(0x1A00, sub=1), raw, transmit, lambda index, sub: mapped)
    assert caught.value.abort_code == CANNOT_BE_MAPPED


@pytest.mark.parametrize(("bits", "refused"), [([], False), ([64], False), ([32, 32], False), ([32, 32, 8], True),
                                               ([64, 8], True)])  # fmt: skip
def test_a_pdo_carries_64_bits(bits, refused):
    objects = {0x6000 + k: entry(0x6000 + k, one) for k, one in enumerate(bits)}
    raws = [(0x6000 + k) << 16 | one for k, one in enumerate(bits)]
    if not refused:
        mapping.check_mapping(entry(0x1600), raws, False, lambda index, sub: objects[index])
        return
    with pytest.raises(ObjectAccessError, match=f"{len(bits)} entries make 72 bits; a PDO carries 64") as caught:
        mapping.check_mapping(entry(0x1600), raws, False, lambda index, sub: objects[index])
    assert caught.value.abort_code == PDO_LENGTH_EXCEEDED


# --- what comes with each SYNC ------------------------------------------------------------------------------------
class Port:
    """A port that hands frames to who subscribed."""

    def __init__(self):
        self.takers, self.drained = {}, 0

    def subscribe(self, can_id, taker):
        if taker is None:
            del self.takers[can_id]
        else:
            self.takers[can_id] = taker

    def drain(self):
        self.drained += 1


def pdo(label, can_id, *members):
    return RemotePdo(label, can_id, sum(member.size for member in members), members)


def test_the_kth_frame_of_each_pdo_belongs_to_the_kth_sync():
    status, position = entry(0x6041, 16, signed=False), entry()
    port = Port()
    of_nodes = [
        [
            pdo("TPDO 1 of node 1", 0x181, Member(status, 0, 0, 2)),
            pdo("TPDO 2 of node 1", 0x281, Member(position, 0, 0, 4)),
        ],
        [pdo("TPDO 1 of node 2", 0x182, Member(status, 0, 0, 2), Member(position, 0, 2, 4))],
    ]
    samples = PdoSamples(port, of_nodes, 1)
    assert port.drained == 1 and samples.complete() == 0
    for k in range(3):
        port.takers[0x181](bytes([k, 1]))
        port.takers[0x182](bytes([k + 8, 1, 255 - k, 255, 255, 255]))
        if k < 2:
            port.takers[0x281](bytes([k, 0, 0, 0]))
    assert samples.complete() == 2
    values = samples.decode(1, 2)
    assert values[0x6041, 0].tolist() == [[0x101, 0x109]] and values[0x6064, 0].tolist() == [[1, -2]]
    assert samples.decode(0, 2)[0x6064, 0].tolist() == [[0, -1], [1, -2]]
    error = str(samples.missing(3, 0.5))
    assert error.startswith("TPDO 2 of node 1 (281h) came 2 times for 3 SYNCs, and no more within 0.5 s")
    port.takers[0x281](bytes([1, 2]))
    with pytest.raises(BusError, match=r"TPDO 2 of node 1 \(281h\) has 4 bytes by its mapping, and 2 came: 01 02;"):
        samples.decode(2, 3)
    assert samples.decode(0, 2)[0x6064, 0].tolist() == [[0, -1], [1, -2]]  # of other rows nothing is said
    samples.close()
    assert not port.takers
    assert PdoSamples(port, [[], []], 1).complete() == 0


# --- the node's process data ------------------------------------------------------------------------------------------
class Objects:
    """Objects of a node, by index: values, and what is written, in its order; some values are refused."""

    def __init__(self, **rows):
        self.values, self.written, self.refused, self.ports = {}, [], set(), {}
        for name, (bits, signed, event, value) in rows.items():
            index = int(name.removeprefix("i"), 16)
            self.values[index] = value
            self.ports[index] = self._port(entry(index, bits, signed), event)

    def _port(self, found, event):
        def check(raw):
            if raw in self.refused:
                raise ObjectAccessError(CANNOT_BE_MAPPED, "refused")

        def write(raw):
            self.values[found.index] = raw
            self.written.append((found.index, raw))

        return ObjectPort(found, lambda: self.values[found.index], check, write, event)

    def find(self, index, sub=0):
        if index not in self.ports or sub:
            raise ObjectAccessError(CANNOT_BE_MAPPED, "none")
        return self.ports[index]

    def take(self):
        taken, self.written = self.written, []
        return taken


@pytest.fixture
def drive():
    return Objects(
        i6040=(16, False, "controlword", 0x0F), i6060=(8, True, "mode", 8), i607A=(32, True, "set_point", -2),
        i2000=(8, False, "", 0xFF), i2001=(64, True, "", -3),
    )  # fmt: skip


def test_a_node_s_objects_travel_one_behind_the_other(drive):
    mapped = MappedObjects([drive.ports[index] for index in (0x6040, 0x6060, 0x607A, 0x2000, 0x2001)])
    assert mapped.size == 16 and len(mapped) == 5
    assert mapped.pack().hex(" ") == "0f 00 08 fe ff ff ff ff fd ff ff ff ff ff ff ff"
    assert len(MappedObjects([])) == 0 and MappedObjects([]).pack() == b"" and MappedObjects([]).write(b"")


def test_a_stop_comes_first_and_what_enables_behind_set_points_and_mode(drive):
    mapped = MappedObjects([drive.ports[index] for index in (0x6040, 0x6060, 0x607A, 0x2000)])
    assert mapped.write(bytes.fromhex("1F 01 FF 00 01 00 00 80"))
    assert drive.take() == [(0x607A, 256), (0x2000, 128), (0x6060, -1), (0x6040, 0x011F)]
    assert mapped.write(bytes.fromhex("0F 00 FF 00 01 00 00 80"))
    assert drive.take() == [(0x607A, 256), (0x2000, 128), (0x6040, 15)], "a mode that is repeated is no write"
    drive.refused = {-1}
    assert mapped.write(bytes.fromhex("0F 00 FF 00 01 00 00 80")), "nor would it be refused"
    drive.take()
    for word in (0x00, 0x02, 0x06, 0x07, 0x0B, 0x80):
        assert mapped.write(bytes((word,)) + bytes.fromhex("00 01 00 01 00 00 80"))
        assert drive.take()[0] == (0x6040, word)


def test_of_data_that_one_object_refuses_the_others_are_written(drive):
    mapped = MappedObjects([drive.ports[index] for index in (0x6040, 0x607A, 0x2000)])
    drive.refused = {7}
    assert not mapped.write(bytes.fromhex("07 00 00 01 00 00 80"))
    assert drive.take() == [(0x607A, 256), (0x2000, 128)]
    drive.refused = {256}
    assert not mapped.write(bytes.fromhex("0F 00 00 01 00 00 80"))
    assert drive.take() == [(0x2000, 128), (0x6040, 15)]


def test_a_value_beyond_the_range_is_fitted_where_the_object_has_a_rule(drive):
    fitted = drive.ports[0x2000]._replace(fit=lambda raw: raw & 0x3F)
    drive.refused = {0xFF}
    assert MappedObjects([fitted]).write(b"\xff")
    assert drive.take() == [(0x2000, 0x3F)]


def fields(*rows):
    return [ImageField(kind, key, is_name) for kind, key, is_name in rows]


READY_MADE = fields(
    ("i32", (0x607A, 0), False), ("u16", None, False), ("u32", (0x6060, 0), False), ("i16", (0x6040, 0), False),
    ("u32", (0x2002, 0), True), ("i64", (0x2001, 0), False),
)  # fmt: skip


def test_a_ready_made_image_has_fields_of_its_own_width(drive):
    """What is reserved is 0; what names another object carries that one: here 2000h, as an entry 20000008h."""
    drive.values[0x2002] = 0x20000008
    drive.ports[0x2002] = drive._port(entry(0x2002, 32, False), "")
    image = PackedFields(READY_MADE, drive.find)
    assert image.size == 24
    assert image.pack().hex(" ") == (
        "fe ff ff ff 00 00 08 00 00 00 0f 00 ff 00 00 00 fd ff ff ff ff ff ff ff"
    )  # fmt: skip
    drive.values[0x6060] = -1
    assert image.pack()[6:10].hex(" ") == "ff ff ff ff"
    for named in (0x12340010, 0x20000108, 0):
        drive.values[0x2002] = named
        assert image.pack()[12:16] == bytes(4), "it names none"
    drive.ports[0x2003] = ObjectPort(entry(0x2003, None), lambda: "a text", lambda raw: None, lambda raw: None)
    drive.values[0x2002] = 0x20030000
    assert image.pack()[12:16] == bytes(4)


def test_of_a_field_an_object_takes_its_own_bits(drive):
    image = PackedFields(fields(("u16", None, False), ("u32", (0x6040, 0), False), ("u32", (0x6060, 0), False),
                                ("i32", (0x607A, 0), False), ("u16", (0x2000, 0), False)), drive.find)  # fmt: skip
    assert image.write(bytes.fromhex("FF FF 07 00 FF FF 80 12 34 56 00 00 00 80 7F 01"))
    assert drive.take() == [(0x6040, 7), (0x607A, -(1 << 31)), (0x2000, 0x7F), (0x6060, -128)]
    assert image.write(bytes.fromhex("00 00 0F 80 00 00 7F 00 00 00 FF FF FF FF FF FF"))
    assert drive.take() == [(0x607A, -1), (0x2000, 0xFF), (0x6060, 127), (0x6040, 0x800F)]
    drive.refused = {7}
    assert not image.write(bytes.fromhex("FF FF 07 00 FF FF 80 12 34 56 00 00 00 80 7F 01"))
    assert drive.take() == [(0x607A, -(1 << 31)), (0x2000, 0x7F), (0x6060, -128)]


def test_a_field_that_is_not_taken_leaves_its_object_as_it_is(drive):
    image = PackedFields([ImageField("u16", (0x2000, 0), False, ((0x6060, 0), (3, 8)))], drive.find)
    for mode, taken in ((3, True), (7, False), (8, True)):
        drive.values[0x6060] = mode
        assert image.write(bytes.fromhex("55 00"))
        assert drive.take() == ([(0x2000, 0x55)] if taken else [])


@pytest.mark.parametrize(("raw", "transmit", "taken"), [
    (0x00050008, False, True), (0x00070020, False, True), (0x00020008, False, True),
    (0x00050008, True, False),  # nothing is passed over that goes out
    (0x00050010, False, False), (0x00080008, False, False), (0x00010008, False, False),
])  # fmt: skip
def test_a_dummy_passes_over_what_comes_in(raw, transmit, taken):
    dummies = {2: 8, 3: 16, 4: 32, 5: 8, 6: 16, 7: 32, 8: 8, 1: 8}

    def find(index, sub):
        return entry(index, dummies[index], mappable=False)

    if taken:
        assert mapping.check_mappable(entry(0x1600, sub=1), raw, transmit, find).index == raw >> 16
    else:
        with pytest.raises(ObjectAccessError):
            mapping.check_mappable(entry(0x1600, sub=1), raw, transmit, find)
    with pytest.raises(ObjectAccessError, match=r"^1600h:01 an object cannot map 0005h:03: none ") as error:
        mapping.check_mappable(entry(0x1600, sub=1), 0x00050308, False, Objects().find)
    assert error.value.abort_code == CANNOT_BE_MAPPED
