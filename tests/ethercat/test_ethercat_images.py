"""Process images as the master plans, writes and exchanges them: objects and bytes, over slaves of this test.

The drive has two axes, whose profile objects lie 800h apart, images of at most five entries that can be written
(1600h, 1A00h), and one of each direction that cannot (1602h, 1A02h).
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.small_eds import I8, I16, I32, U8, U16, U32, described, small_eds

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.ethercat import image_data
from drive_env.master.ethercat.ethercat_master import ImageSizes
from drive_env.master.ethercat.image_data import EtherCatProcessData
from drive_env.master.ethercat.image_layout import INPUTS, OUTPUTS, ImagePlanner, changed
from drive_env.master.ethercat.slave_images import SlaveImages

ROWS = [
    (0x6040, "Controlword", U16, "rww", 1), (0x6041, "Statusword", U16, "ro", 1), (0x6060, "Mode", I8, "rww", 1),
    (0x6061, "Mode display", I8, "ro", 0), (0x6064, "Position", I32, "ro", 1), (0x606C, "Velocity", I32, "ro", 1),
    (0x6071, "Target torque", I16, "rww", 1), (0x607A, "Target position", I32, "rww", 1),
    (0x6077, "Torque", I16, "ro", 1), (0x6098, "Homing method", I8, "rw", 0), (0x60FF, "Secret", I32, "wo", 1),
    (0x6081, "Limit", U32, "const", 1),
]  # fmt: skip
NODE_ROWS = [(0x2001, "Temperature", I16, "ro", 1), (0x2002, "Lamp", U8, "rww", 1)]
PDOS = [(0x1600, "rw", 5, None), (0x1602, "const", 2, None), (0x1A00, "rw", 5, None), (0x1A02, "rw/ro", 2, None)]


@pytest.fixture(scope="module")
def drive():
    further = [(index + 0x800, f"{name} 2", *rest) for index, name, *rest in ROWS]
    return described(small_eds([*ROWS, *further, *NODE_ROWS], PDOS), 2)


@pytest.fixture(scope="module")
def planner(drive):
    return ImagePlanner(drive)


@pytest.fixture(scope="module")
def one(drive):
    """Return the entry of an index."""
    return lambda *names: tuple(drive.dictionary.find(name) for name in names)


class Slave:
    """The objects of a slave; each write is noted, and each read of one that is not a list."""

    def __init__(self, objects):
        self.objects, self.log, self.refuses = dict(objects), [], ()

    def read(self, index, sub, label, timeout):
        assert timeout == 0.5 and label.startswith(f"{index:04X}h:{sub:02X}")
        if (index, sub) not in self.objects:
            raise ObjectAccessError(0x06020000, "there is none")
        self.log.append(f"R {index:04X}:{sub:02X}")
        return self.objects[index, sub]

    def write(self, index, sub, data, label, timeout):
        assert timeout == 0.5
        assert label == f"{int.from_bytes(data, 'little'):X}h to {index:04X}h:{sub:02X}"
        if (index, sub) in self.refuses:
            raise NoAnswerError(f"{index:04X}h does not answer")
        self.log.append(f"{index:04X}:{sub:02X} {data.hex(' ').upper()}")
        self.objects[index, sub] = data

    def put(self, index, size, *values):
        self.objects[index, 0] = bytes((len(values),))
        for sub, value in enumerate(values, 1):
            self.objects[index, sub] = value.to_bytes(size, "little")

    def take(self):
        taken, self.log = [row for row in self.log if row[0] != "R"], []
        return taken


def new_slave():
    found = Slave({})
    found.put(OUTPUTS, 2, 0x1600)
    found.put(INPUTS, 2, 0x1A00)
    found.put(0x1600, 4, 0x60400010, 0x68400010)
    found.put(0x1A00, 4, 0x60410010, 0x68410010)
    return found


@pytest.fixture
def slave():
    return new_slave()


# --- layouts ----------------------------------------------------------------------------------------------------------
def shape(layout):
    return [(m.entry.index, m.axis, m.start, m.size) for m in layout.members], layout.size


def test_an_image_has_the_entries_axis_by_axis(planner, one):
    layout = planner.free(0x1A00, one(0x6041, 0x6064))
    assert layout.mapped == (0x60410010, 0x60640020, 0x68410010, 0x68640020)
    assert shape(layout) == ([(0x6041, 0, 0, 2), (0x6064, 0, 2, 4), (0x6041, 1, 6, 2), (0x6064, 1, 8, 4)], 12)
    assert layout.entries == one(0x6041, 0x6064) and layout.pdo == 0x1A00


def test_an_object_of_the_node_is_there_once_and_of_each_axis(planner, one, drive):
    layout = planner.free(0x1A00, one(0x2001, 0x6077))
    assert layout.mapped == (0x20010010, 0x60770010, 0x68770010)
    assert shape(layout) == ([(0x2001, 0, 0, 2), (0x6077, 0, 2, 2), (0x2001, 1, 0, 2), (0x6077, 1, 4, 2)], 6)
    assert layout.places(drive) == {(0x2001, 0): (0, 2), (0x6077, 0): (2, 2), (0x6877, 0): (4, 2)}


def test_what_one_axis_alone_has_is_no_entry_of_the_image(planner, one):
    layout = planner.free(0x1A00, one(0x6041, 0x6064))
    assert layout._replace(members=layout.members[:3]).entries == one(0x6041)


@pytest.mark.parametrize(("mapped", "entries"), [
    ((0x60410010, 0x60640020, 0x68410010, 0x68640020), (0x6041, 0x6064)),
    ((0x20010010,), (0x2001,)),
    ((), ()),
    ((0x60410010, 0x68410010, 0x60640020, 0x68640020), None),  # not axis by axis
    ((0x60410010,), None),  # of one axis alone
    ((0x60410020, 0x68410020), None),  # it has 16 bits
    ((0x12340010,), None),  # there is none
    ((0x60410110,), None),  # nor that sub-index
])  # fmt: skip
def test_of_the_image_that_a_slave_has_each_axis_must_have_the_same(planner, one, mapped, entries):
    layout = planner.parsed(INPUTS, [0x1A00], mapped)
    assert layout == (None if entries is None else planner.free(0x1A00, one(*entries)))


@pytest.mark.parametrize("pdo", [0x1602, 0x1A02], ids=["const", "ro"])
def test_an_image_that_cannot_be_written_is_taken_as_it_is(planner, pdo):
    """What is reserved (no index) and what no program can name is left out, as what begins within a byte."""
    layout = planner.parsed(INPUTS, [pdo], (0x68410010, 0x00000008, 0x12340010, 0x60640020, 0x20010010))
    assert layout.mapped is None and layout.pdo == pdo
    assert shape(layout) == ([(0x6041, 1, 0, 2), (0x6064, 0, 5, 4), (0x2001, 0, 9, 2), (0x2001, 1, 9, 2)], 11)
    layout = planner.parsed(INPUTS, [pdo], (0x00000004, 0x60410010, 0x00000004, 0x60640010, 0x60770020, 0x00000003))
    assert shape(layout) == ([(0x6064, 0, 3, 2), (0x6077, 0, 5, 2)], 10), "the narrower of field and object"


def test_what_is_wanted_comes_with_what_a_drive_is_commanded_and_watched_by(planner, one):
    """1A00h has five entries: torque and status of two axes, and no room for positions; 2001h is one entry."""
    empty = planner.free(0x1A00, ())
    assert planner.completed(INPUTS, empty).entries == one(0x6041, 0x6064)
    assert planner.plan(INPUTS, one(0x6077), empty).entries == one(0x6077, 0x6041)
    assert planner.plan(INPUTS, one(0x2001), planner.free(0x1A00, one(0x6077))).entries == one(0x2001, 0x6041, 0x6064)
    assert planner.plan(INPUTS, one(0x2001, 0x6041), planner.free(0x1A00, one(0x6077))).entries == one(
        0x2001, 0x6041, 0x6064
    )
    assert planner.plan(OUTPUTS, one(0x607A), planner.free(0x1600, one(0x2002))).entries == one(0x607A, 0x6040, 0x2002)
    current = planner.free(0x1A00, one(0x6077, 0x6064))
    assert planner.plan(INPUTS, one(0x6064), current) is current, "it has it already"


def test_what_is_too_much_for_one_image_is_told(planner, one):
    empty = planner.free(0x1600, ())
    assert planner.plan(OUTPUTS, one(0x607A, 0x6071, 0x2002), empty).entries == one(0x607A, 0x6071, 0x2002)
    with pytest.raises(ObjectAccessError, match=r"^3 objects of 2 axes are more than the 5 that the process image "
                       "1600h ta") as error:  # fmt: skip
        planner.plan(OUTPUTS, one(0x607A, 0x6071, 0x6040), empty)
    assert error.value.abort_code == 0x06040042


def test_where_the_eds_does_not_list_entries_there_are_eight(planner, one):
    assert planner._room(0x1601) == 8 and planner._room(0x1A00) == 5
    everything = ImagePlanner(described(small_eds(ROWS, [(0x1A00, "rw", 255, None)]), 1))
    assert everything._room(0x1A00) == 254, "255 is none"
    empty = planner.free(0x1A03, ())
    assert planner.completed(INPUTS, empty).entries == one(0x6041, 0x6064, 0x606C)
    with pytest.raises(ObjectAccessError, match="more than the 8"):
        planner.plan(INPUTS, one(0x6041, 0x6064, 0x606C, 0x6077, 0x2001), empty)


def test_directions_that_differ(planner, one):
    assert (OUTPUTS, INPUTS) == (0x1C12, 0x1C13)
    first, second = planner.free(0x1600, one(0x6040)), planner.free(0x1A00, one(0x6041))
    assert changed({}, {OUTPUTS: first}) == [OUTPUTS]
    assert changed({OUTPUTS: first, INPUTS: first}, {OUTPUTS: first, INPUTS: second}) == [INPUTS]


# --- ready-made images ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def tgz():
    return describe("tgz_d", None)


@pytest.fixture(scope="module")
def tgz_planner(tgz):
    return ImagePlanner(tgz)


def test_ready_made_images_are_those_of_the_device_s_data(tgz, tgz_planner):
    """1701h: 20 bytes of each axis, with what is reserved; 6060h and others are in none."""
    layout = tgz_planner.parsed(OUTPUTS, [0x1701], ())
    assert layout.mapped is None and layout.size == 40
    find = tgz.dictionary.find
    places = layout.places(tgz)
    assert places[0x607A, 0] == (0, 4) and places[0x6040, 0] == (12, 2) and places[0x6840, 0] == (32, 2)
    start, size = places[0x6840, 0]
    assert bytes(range(40))[start : start + size] == bytes((32, 33))
    assert tgz_planner.completed(OUTPUTS, layout) is layout
    assert find(0x607A) in tgz_planner.carried(OUTPUTS) and find(0x607A) not in tgz_planner.carried(INPUTS)
    assert find(0x6064) in tgz_planner.carried(INPUTS)
    assert tgz_planner.parsed(INPUTS, [0x1701], (1 << 16,)) is None, "it is one of outputs"


def test_the_first_ready_made_image_that_has_what_is_wanted_is_taken(tgz, tgz_planner):
    find = tgz.dictionary.find
    current = tgz_planner.parsed(OUTPUTS, [0x1703], ())
    assert tgz_planner.plan(OUTPUTS, (find(0x6071),), current) is current
    assert tgz_planner.plan(OUTPUTS, (find(0x607A), find(0x6040)), current).pdo == 0x1701
    with pytest.raises(ObjectAccessError, match=f"^{find(0x6060).label} is in no image of this drive, for every axis "):
        tgz_planner.plan(OUTPUTS, (find(0x6071), find(0x6060)), current)
    names = f"{find(0x607A).label} and {find(0x23C7).label}"
    with pytest.raises(ObjectAccessError, match=f"^no ready-made image of this drive has {names} together "):
        tgz_planner.plan(OUTPUTS, (find(0x607A), find(0x23C7)), current)


# --- what a slave has mapped ------------------------------------------------------------------------------------------
def test_the_image_of_a_slave_is_read(drive, planner, one, slave):
    images = SlaveImages(slave, drive)
    assert images.found(OUTPUTS, planner) == planner.free(0x1600, one(0x6040))
    slave.objects[INPUTS, 1] = bytes.fromhex("02 1A FF FF")  # more bytes than the type has
    slave.put(0x1A02, 4, 0x60410010)
    slave.objects[0x1A02, 1] += b"\xff"
    assert images.found(INPUTS, planner) == planner.parsed(INPUTS, [0x1A02], [0x60410010])
    slave.put(INPUTS, 2, 0x1A03)
    assert images.found(INPUTS, planner) == planner.free(0x1A03, ()), "it has no entries"
    slave.put(INPUTS, 2, 0x1A00, 0x1A01)
    assert images.found(INPUTS, planner) == planner.free(0x1A00, ()), "two are not ours"
    slave.put(INPUTS, 2, 0x1A00)
    slave.put(0x1A00, 4, 0x60410010)
    assert images.found(INPUTS, planner) == planner.free(0x1A00, ()), "nor what one axis alone has"
    slave.put(INPUTS, 2)
    slave.objects.pop((OUTPUTS, 0))
    assert images.found(INPUTS, planner) == planner.free(0x1A00, ())
    assert images.found(OUTPUTS, planner) == planner.free(0x1600, ())
    assert slave.take() == []


def test_an_image_is_changed_from_the_outside_in_and_put_back(drive, planner, one, slave):
    images = SlaveImages(slave, drive)
    images.change(INPUTS, planner.free(0x1A00, one(0x6041)))
    assert slave.take() == [], "it has it"
    images.change(INPUTS, planner.free(0x1A00, one(0x6077)))
    changed_ = ["1C13:00 00", "1A00:00 00", "1A00:01 10 00 77 60", "1A00:02 10 00 77 68", "1A00:00 02",
                "1C13:00 00", "1C13:01 00 1A", "1C13:00 01"]  # fmt: skip
    assert slave.take() == changed_
    images.change(INPUTS, planner.free(0x1A00, one(0x2001)))
    slave.take()
    images.restore()
    assert slave.take() == ["1C13:00 00", "1A00:00 00", "1A00:01 10 00 41 60", "1A00:02 10 00 41 68", "1A00:00 02",
                            "1C13:00 00", "1C13:01 00 1A", "1C13:00 01"]  # fmt: skip
    images.restore()
    assert slave.take() == [], "nothing is left to put back"


def test_an_image_that_has_its_entries_is_only_assigned(drive, planner, one, slave):
    slave.put(INPUTS, 2, 0x1A02)
    images = SlaveImages(slave, drive)
    images.change(INPUTS, planner.free(0x1A00, one(0x6041)))
    assert slave.take() == ["1C13:00 00", "1C13:00 00", "1C13:01 00 1A", "1C13:00 01"]
    ready_made = planner.parsed(INPUTS, [0x1A02], ())
    images.change(INPUTS, ready_made)
    assert slave.take() == ["1C13:00 00", "1C13:00 00", "1C13:01 02 1A", "1C13:00 01"]
    images.change(INPUTS, ready_made)
    assert slave.take() == []


def test_what_a_slave_has_that_restarted_is_not_put_back(drive, planner, one, slave):
    images = SlaveImages(slave, drive)
    images.change(INPUTS, planner.free(0x1A00, one(0x6077)))
    slave.take()
    images.forget()
    images.restore()
    assert slave.take() == []


def test_what_cannot_be_put_back_keeps_nothing_else_from_it(drive, planner, one, slave):
    images = SlaveImages(slave, drive)
    images.change(INPUTS, planner.free(0x1A00, one(0x6077)))
    slave.take()
    slave.refuses = {(0x1A00, 0)}
    with pytest.raises(BusError, match=r"^1A00h does not answer$"):
        images.restore()
    assert slave.take() == ["1C13:00 00", "1C13:00 00", "1C13:01 00 1A", "1C13:00 01"]


# --- what is exchanged ------------------------------------------------------------------------------------------------
class Segment:
    """A master of two slaves, which notes what is asked of it; its inputs are those of `rows`, one after another."""

    def __init__(self):
        self.log, self.rows, self.sent, self.system_time = [], [], [], None

    def leave_op(self, position):
        self.log.append(("leave", position))

    def map(self, sizes):
        self.log.append(("map", dict(sizes)))

    def status(self, position):
        return SimpleNamespace(is_op=position != 5)

    def operate(self, nodes, exchange, timeout):
        self.log.append(("operate", nodes, timeout))
        self.meanwhile = exchange

    def exchange(self, images, timeout):
        self.sent.append((images, timeout))
        return self.rows.pop(0) if self.rows else [None] * len(images)

    def take(self):
        taken, self.log = self.log, []
        return taken


NODES = (3, 5)
FULL = ImageSizes(4, 12)  # 6040h; 6041h, 6064h


class Bench:
    """Process data of two slaves at positions 3 and 5, in lockstep or not."""

    def __init__(self, drive, lockstep=False):
        self.master, self.slaves = Segment(), [new_slave() for _ in NODES]
        for slave in self.slaves:
            for index, value in ((0x6040, "06 00"), (0x6840, "07 00"), (0x6041, "40 02"), (0x6841, "40 02"),
                                 (0x607A, "00" * 4), (0x687A, "00" * 4)):  # fmt: skip
                slave.objects[index, 0] = bytes.fromhex(value)
        self.data = EtherCatProcessData(self.master, NODES, drive, lockstep)
        self.data.connect(self.slaves)

    def reads(self):
        taken = [[row for row in slave.log if row[:2] == "R " and row[2] in "26"] for slave in self.slaves]
        for slave in self.slaves:
            slave.log.clear()
        return taken


@pytest.fixture
def bench(drive):
    return Bench(drive)


@pytest.fixture
def data(bench):
    return bench.data


@pytest.fixture
def lockstep(drive):
    return Bench(drive, lockstep=True)


def test_images_begin_with_what_the_slaves_have(bench, data):
    assert (data.mapping, data.owed, data.exchanged_at, data.is_silent) == (0, 0, 0.0, False)
    assert data.missing == [0, 1] and data.num_axes == 4 and not data.has((0x6040, 0))
    assert data.sampled_entries() == () and data.samples() is None
    assert data.put(0, (0x6040, 0), b"\x0f\0") is None, "there are no images yet"
    bench.slaves[1].objects[0x6840, 0] = bytes.fromhex("0F 00")
    data.prepare()
    assert data.missing == []
    assert [image.hex(" ") for image in data.images] == ["06 00 07 00", "06 00 0f 00"]
    assert bench.master.take() == [("map", {3: FULL, 5: FULL})]
    assert [index for index, *_ in [(entry.index,) for entry in data.sampled_entries()]] == [0x6041, 0x6064]
    assert data.has((0x6840, 0)) and not data.has((0x607A, 0))
    data.prepare()
    assert data.mapping == 0 and bench.slaves[0].take() == [
        "1C13:00 00", "1A00:00 00", "1A00:01 10 00 41 60", "1A00:02 20 00 64 60", "1A00:03 10 00 41 68",
        "1A00:04 20 00 64 68", "1A00:00 04", "1C13:00 00", "1C13:01 00 1A", "1C13:00 01",
    ]  # fmt: skip


def test_what_an_object_has_is_filled_by_its_sign(bench, data, one):
    """What a slave answers with may be narrower than the field: -1 of one byte is -1 of two, 200 is 200."""
    for slave in bench.slaves:
        slave.objects |= {(0x6071, 0): b"\xff", (0x6871, 0): b"\x7f\x01\x55", (0x6040, 0): b"\xc8", (0x6840, 0): b""}
    data.map(one(0x6071), ())
    assert data.images[0].hex(" ") == "ff ff c8 00 7f 01 00 00"


def test_what_can_only_be_written_begins_with_0(bench, data, one):
    data.map(one(0x60FF), ())
    assert data.images[0].hex(" ") == "00 00 00 00 06 00 00 00 00 00 07 00"


def test_a_map_goes_by_pre_op_and_back_to_op(bench, data, one):
    data.prepare()
    bench.master.log.clear()
    assert data.is_mapped(one(0x6040), one(0x6041, 0x6064)) and not data.is_mapped(one(0x6071), ())
    assert not data.is_mapped((), one(0x6077))
    data.map(one(0x6040), one(0x6041))
    assert bench.master.take() == [] and data.mapping == 1, "they carry it"
    data.map(one(0x6040), one(0x6077))
    assert bench.master.take() == [("leave", 3), ("leave", 5), ("map", {3: ImageSizes(4, 8), 5: ImageSizes(4, 8)}),
                                   ("operate", NODES, 5.0)]  # fmt: skip
    assert data.mapping == 2 and data.missing == [] and data.sampled_entries() == one(0x6077, 0x6041)
    assert data.exchanged_at > 0.0
    samples, bench.master.rows = data.samples(), [[bytes(8)] * 2]
    bench.master.meanwhile()
    assert len(bench.master.sent) == 1, "images are exchanged while Op is waited for"
    assert samples.complete() == 0, "and are nobody's sample"


def test_images_are_not_changed_while_an_axis_is_enabled(bench, data, one):
    data.prepare()
    bench.slaves[1].objects[0x6841, 0] = bytes.fromhex("37 02")
    bench.master.log.clear()
    with pytest.raises(ObjectAccessError, match=r"^6077h:00 Torque is not in the process image, which cannot be "
                       "changed while axis 3 is enabled; record or play it once before ") as error:  # fmt: skip
        data.map(one(0x6040), one(0x6041, 0x6077))
    assert error.value.abort_code == 0x08000022
    assert bench.master.take() == []
    bench.slaves[0].objects[0x6841, 0] = bytes.fromhex("37 02")
    with pytest.raises(ObjectAccessError, match="while axis 1 is enabled"):
        data.map(one(0x6040), one(0x6041, 0x6077))


def test_what_is_in_no_image_can_be_neither_recorded_nor_played(data, one):
    data.check_sampled(one(0x6041, 0x6064))
    data.check_played(one(0x6040, 0x60FF))
    for entry in (0x6061, 0x60FF, 0x6081, 0x6040):  # rww: sent alone
        with pytest.raises(
            ObjectAccessError, match=f"^{entry:04X}h:00 .* cannot be recorded: it is no process data "
        ) as e:
            data.check_sampled(one(0x6041, entry))
        assert e.value.abort_code == 0x06040041
    for entry in (0x6041, 0x6098, 0x6081):
        with pytest.raises(ObjectAccessError, match=f"^{entry:04X}h:00 .* cannot be played: it is no process data "):
            data.check_played(one(0x6040, entry))


def test_what_a_ready_made_image_has_can_be_recorded_whatever_the_eds_says(tgz):
    """3325h is in image 1B21h, and the EDS has it as no process data."""
    data = EtherCatProcessData(Segment(), (0,), tgz, False)
    data.connect(
        [SimpleNamespace(read=lambda index, sub, label, timeout: {0x1C13: b"\1\x1b"}.get(index, b"") if sub else b"\1")]
    )
    assert not tgz.dictionary.find(0x3325).pdo_mappable
    data.check_sampled([tgz.dictionary.find(0x3325)])
    with pytest.raises(ObjectAccessError, match="cannot be recorded: it is no process data"):
        data.check_sampled([tgz.dictionary.find((0x1018, 1))])


def test_what_is_welcome_comes_where_the_image_has_it(data, one):
    assert data.choose(one(0x6077), one(0x6041, 0x6064, 0x6077)) == one(0x6077, 0x6041)
    with pytest.raises(ObjectAccessError, match="are more than the 5"):
        data.choose(one(0x6041, 0x6064, 0x606C), ())


def test_in_lockstep_what_no_image_has_is_read_before_each_frame(lockstep, one):
    """6061h cannot be mapped, and 606Ch has no room: both are read; the rows have all."""
    data, master = lockstep.data, lockstep.master
    data.check_sampled(one(0x6061))
    wanted = one(0x6041, 0x6061, 0x6064, 0x606C)
    assert data.choose(wanted, one(0x6077, 0x6041)) == wanted
    for k, slave in enumerate(lockstep.slaves):
        slave.objects |= {(0x6061, 0): bytes((8 + k, 0x55)), (0x6861, 0): b"\xff",
                          (0x606C, 0): b"\1\0\0\0", (0x686C, 0): b"\xfe\xff\xff\xff"}  # fmt: skip
    data.map((), wanted)
    assert master.meanwhile is None, "no frame goes meanwhile"
    assert data.is_mapped((), wanted) and not data.is_mapped((), one(0x6041))
    assert data.sampled_entries() == one(0x6041, 0x6064, 0x6061, 0x606C)
    lockstep.reads()
    samples = data.samples()
    master.rows = [[bytes.fromhex("37 02 01 00 00 00 37 06 FF FF FF FF")] * 2] * 2
    assert data.exchange(is_cycle=False) and lockstep.reads() == [[], []]
    assert data.exchange(is_cycle=True)
    assert lockstep.reads() == [["R 6061:00", "R 6861:00", "R 606C:00", "R 686C:00"]] * 2
    found = samples.decode(0, 1)
    assert {key: value.tolist() for key, value in found.items()} == {
        (0x6041, 0): [[0x237, 0x637] * 2], (0x6064, 0): [[1, -1] * 2],
        (0x6061, 0): [[8, -1, 9, -1]], (0x606C, 0): [[1, -2] * 2],
    }  # fmt: skip
    data.map((), one(0x6041))
    assert data.is_mapped((), one(0x6041)) and data.sampled_entries() == one(0x6041, 0x6064)


def test_in_lockstep_an_enabled_axis_keeps_its_image_and_the_rest_is_read(lockstep, one):
    data, master = lockstep.data, lockstep.master
    data.prepare()
    lockstep.slaves[0].objects[0x6041, 0] = bytes.fromhex("37 02")
    master.log.clear()
    data.map(one(0x6040), one(0x6041, 0x6077))
    assert master.take() == [] and data.sampled_entries() == one(0x6041, 0x6064, 0x6077)
    with pytest.raises(
        ObjectAccessError, match=r"^6071h:00 Target torque is not in the process image, .* while axis 0"
    ):
        data.map(one(0x6071), one(0x6041))


def test_rows_of_what_is_played_go_into_the_images(bench, data, one):
    data.map(one(0x607A), ())
    assert data.outputs({}) is None
    rows = data.outputs({one(0x607A)[0]: np.array([[1, 2, 3, 4], [-1, 0x1_2345_6789, 256, -256]])})
    rows.send(0)
    assert [image.hex(" ") for image in data.images] == [
        "01 00 00 00 06 00 02 00 00 00 07 00", "03 00 00 00 06 00 04 00 00 00 07 00"
    ]  # fmt: skip
    rows.send(1)
    assert [image.hex(" ") for image in data.images] == [
        "ff ff ff ff 06 00 89 67 45 23 07 00", "00 01 00 00 06 00 00 ff ff ff 07 00"
    ]  # fmt: skip


def test_what_an_object_gets_goes_into_the_image_at_its_width(data, one):
    data.map(one(0x607A), ())
    assert data.put(1, (0x607A, 0), bytes.fromhex("FF FF FF FF")) == bytes(4)
    assert data.put(1, (0x687A, 0), bytes.fromhex("80")) == bytes(4)
    assert data.put(1, (0x6040, 0), bytes.fromhex("0F 00 55")) == b"\6\0"
    assert data.put(1, (0x6040, 0), b"\x7f") == b"\x0f\0"
    assert data.put(1, (0x6071, 0), b"\1\0") is None
    assert data.images[1].hex(" ") == "ff ff ff ff 7f 00 80 ff ff ff 07 00"
    assert data.put(1, (0x6040, 0), b"") == b"\x7f\0" and data.images[1][4:6] == b"\0\0"
    data.forget([0])
    assert data.put(0, (0x607A, 0), bytes(4)) is None and data.put(1, (0x607A, 0), bytes(4)) is not None


ROW = [bytes(range(12)), bytes(range(12, 24))]


def test_an_exchange_is_a_row_where_all_images_come_back(bench, data, monkeypatch):
    assert not data.exchange(is_cycle=True) and bench.master.sent == [], "there are no images"
    data.prepare()
    samples, clock = data.samples(), SimpleNamespace(monotonic=lambda: 12.5)
    monkeypatch.setattr(image_data, "time", clock)
    bench.master.rows = [ROW, [ROW[0], None], ROW, ROW]
    assert data.exchange(is_cycle=True) and data.exchanged_at == 12.5
    clock.monotonic = lambda: 13.5
    assert not data.exchange(is_cycle=True) and data.exchanged_at == 12.5
    assert data.exchange(is_cycle=False, timeout=0.5) and data.exchanged_at == 13.5
    assert samples.complete() == 1 and samples.rows == [ROW]
    assert bench.master.sent == [([b"\6\0\7\0"] * 2, 0.02)] * 2 + [([b"\6\0\7\0"] * 2, 0.5)]
    other, empty = data.samples(), data.samples()
    empty.close()
    samples.close()
    assert data.exchange(is_cycle=True) and (samples.complete(), other.complete()) == (1, 1)
    data.is_silent = True
    assert not data.exchange(is_cycle=True) and len(bench.master.sent) == 4, "nothing may go out any more"


def test_no_image_goes_out_while_a_slave_has_none(bench, data):
    data.prepare()
    data.forget([1])
    assert data.missing == [1] and data.mapping == 1
    assert not data.exchange(is_cycle=False) and bench.master.sent == []
    bench.slaves[0].log.clear()
    data.prepare()
    assert bench.slaves[0].take() == [], "only who has none gets it anew"


def test_samples_that_stay_out_are_told(bench, data):
    data.prepare()
    bench.master.rows = [ROW]
    samples = data.samples()
    data.exchange(is_cycle=True)
    assert samples.missing(7, 0.25).silent == (1,)
    assert str(samples.missing(7, 0.25)) == (
        "1 input images came in 7 cycles, and no more within 0.25 s; check cable and power, and whether every drive is "
        "in Op"
    )


def test_samples_are_of_all_axes_in_their_order(bench, data, one):
    data.prepare()
    rows = [[bytes.fromhex("010000000080 0200FFFFFFFF"), bytes.fromhex("038005000000 040006000000")],
            [bytes.fromhex("07 00 08 00 00 00 09 00 0A 00 00 00"), bytes(12)], [bytes(12)] * 2]  # fmt: skip
    bench.master.rows, samples = list(rows), data.samples()
    for _ in range(3):
        data.exchange(is_cycle=True)
    found = samples.decode(0, 2)
    assert found[0x6041, 0].tolist() == [[1, 2, 0x8003, 4], [7, 9, 0, 0]]
    assert found[0x6064, 0].tolist() == [[-(1 << 31), -1, 5, 6], [8, 10, 0, 0]]
    assert samples.decode(1, 3)[0x6064, 0].tolist() == [[8, 10, 0, 0], [0, 0, 0, 0]]


def test_the_row_of_a_frame_that_was_lost_is_taken_by_the_next_one(bench, data):
    data.prepare()
    data.owed = 5
    samples = data.samples()
    assert data.owed == 0, "what was owed to others is nobody's"
    data.owed, bench.master.rows = 3, [ROW, [None, None], ROW, ROW]
    assert not data.settle(0.1) and (data.owed, samples.complete()) == (2, 1)
    assert data.settle(0.3) and (data.owed, samples.complete()) == (0, 3)
    assert [timeout for _, timeout in bench.master.sent] == [0.1, 0.1, 0.3, 0.3]
    assert data.settle(0.1) and len(bench.master.sent) == 4


def test_the_reference_s_time_is_learnt_with_each_exchange(bench, data):
    data.prepare()
    taken = []
    bench.master.system_time = 5
    data.exchange(is_cycle=False)
    data.phase = SimpleNamespace(take=taken.append)
    data.exchange(is_cycle=False)
    bench.master.system_time = None
    data.exchange(is_cycle=False)
    assert taken == [5]


def test_a_node_is_put_back_in_pre_op(bench, data, one):
    data.map((), one(0x6077))
    bench.master.log.clear()
    bench.slaves[0].take(), bench.slaves[1].take()
    data.restore(1)
    assert bench.master.take() == [("leave", 5)] and data.missing == [1]
    assert bench.slaves[0].take() == [] and bench.slaves[1].take()[0] == "1C13:00 00"
    data.forget([0])
    data.restore(0)
    assert bench.slaves[0].take() == [], "it has restarted, and has its own mapping"
