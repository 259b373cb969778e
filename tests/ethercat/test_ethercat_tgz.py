"""The TGZ on EtherCAT: its images byte by byte by the manual's structures, chosen in Pre-Op, and moved by a master."""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from rigs.coe_rig import CoeRig
from rigs.eeproms import categories, pdos
from rigs.ethercat_segment import EmulatedSegment
from rigs.tgz_images import SIZES, select, structure

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.devices import find_device
from drive_env.drives.limits import Limits
from drive_env.ethercat.application import AlState, AlStatusCode, ClockSetting
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.esi import esi_text
from drive_env.ethercat.sii_content import sii_content
from drive_env.firmware.record import set_lanes
from drive_env.master.ethercat_drives import EtherCatDrives
from drive_env.node.node_axes import NodeAxes
from drive_env.safety.errors import SafetyError

FACTORY = (0x1701, 0x1B01)
SAMPLED = [0x6041, 0x6064, 0x606C, 0x6077]


@pytest.fixture(scope="module")
def machine():
    with EmulatedDrives("tgz_d", "gantry", num_threads=1) as drives:
        yield drives


@pytest.fixture
def rig(machine):
    machine.machine.reset()
    rig = CoeRig(machine)
    rig.bring_to(AlState.PRE_OP)
    return rig


def to_op(rig, outputs, inputs):
    for number in (outputs, inputs):
        if number not in FACTORY:
            assert select(rig, number) == [0, 0, 0]
    rig.bring_to(AlState.OP, outputs=SIZES[outputs], inputs=SIZES[inputs])


def value(rig, name, size):
    """Return what an object has, as the bits of a field of so many bytes."""
    index, _, sub = name.partition(":")
    return int.from_bytes(rig.upload(int(index, 16), int(sub or 0)), "little", signed=True) % 256**size


# --- layout on the wire ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("outputs", [0x1701, 0x1702, 0x1703, 0x1721], ids=lambda number: f"{number:04X}")
def test_each_output_goes_to_its_object_from_its_bytes_of_the_frame(rig, outputs):
    to_op(rig, outputs, 0x1B01)
    fields, length = structure(outputs)
    for name, start, size in fields:
        sent = 6 if name in ("6040", "6840") else 0x150000 if "60FE" in name else 0x11
        data = bytearray(length)
        data[start : start + size] = sent.to_bytes(size, "little")
        _, counter = rig.exchange_image(bytes(data), 40)
        assert counter == 3, "written and read"
        for other, _, width in fields:
            if other != "-":
                assert value(rig, other, width) == (sent if other == name else 0), (name, other)


@pytest.mark.parametrize("inputs", [0x1B01, 0x1B21], ids=lambda number: f"{number:04X}")
def test_each_input_has_its_object_at_its_bytes_of_the_frame(rig, machine, inputs):
    machine.machine.analog_inputs = [[1111, 0], [2222, 0]]
    to_op(rig, 0x1701, inputs)
    fields, length = structure(inputs)
    rig.exchange_image(bytes(40), length)
    before = {name: value(rig, name, size) for name, _, size in fields if name not in "@-"}
    data, _ = rig.exchange_image(bytes(40), length)  # what there was as the frame came
    for name, start, size in fields:
        if name in before:
            assert int.from_bytes(data[start : start + size], "little") == before[name], name
    assert len(data) == length


def test_a_field_can_carry_the_object_that_a_register_names(rig):
    assert rig.download(0x25C2, 0, struct.pack("<I", 0x608F0120)) == 0
    to_op(rig, 0x1701, 0x1B21)
    data, _ = rig.exchange_image(bytes(40), 44)
    assert struct.unpack_from("<I", data, 36) == (value(rig, "608F:1", 4),)


# --- choice in Pre-Op -------------------------------------------------------------------------------------------------
def test_another_order_than_the_manuals_is_refused(rig):
    assert rig.download(0x1C12, 1, struct.pack("<H", 0x1721)) == 0x06010003, "sub-index 0 is not 0"
    assert rig.download(0x1C12, 0, b"\0") == 0
    assert rig.download(0x1C12, 1, struct.pack("<H", 0x1B01)) == 0x06090030, "an image of the other way"
    assert rig.download(0x1C12, 1, struct.pack("<H", 0x1700)) == 0x06090030
    assert rig.download(0x1C12, 0, b"\2") == 0x06090031, "one image"


def test_it_is_chosen_in_pre_op_alone(rig):
    to_op(rig, 0x1701, 0x1B01)
    for state in (AlState.OP, AlState.SAFE_OP):
        rig.request(state)
        assert select(rig, 0x1721) == [0x08000022] * 3
        assert rig.upload(0x1C12, 1) == b"\x01\x17"


def test_a_sync_manager_of_another_length_than_the_image_is_refused(rig):
    assert select(rig, 0x1721) == [0, 0, 0]
    rig.configure(40, 40)
    assert rig.request(4) == (0x12, AlStatusCode.OUTPUT_CONFIGURATION)
    rig.configure(44, 44)
    assert rig.request(0x14) == (0x12, AlStatusCode.INPUT_CONFIGURATION)
    rig.configure(44, 40)
    assert rig.request(0x14) == (4, 0)


def mapped(rig, index):
    number = rig.upload(index, 0)[0]
    return [int.from_bytes(rig.upload(index, sub), "little") for sub in range(1, number + 1)]


@pytest.mark.parametrize("index", SIZES, ids=lambda number: f"{number:04X}")
def test_an_image_can_be_read_as_a_mapping_object(rig, index):
    """ETG.1000.6, 5.6.7.4; what is reserved has no index."""
    found, expected = mapped(rig, index), []
    for name, _, size in structure(index)[0]:
        object_, _, sub = name.partition(":")
        own = {"6040": 16, "6840": 16}.get(object_, 8 * size)
        if name not in "@-":
            expected.append(int(object_, 16) << 16 | int(sub or 0) << 8 | own)
        if name in "@-" or own < 8 * size:
            expected.append(8 * size - own if name not in "@-" else 8 * size)
    assert found == expected
    assert sum(raw & 0xFF for raw in found) == 8 * SIZES[index]
    assert rig.download(index, 1, bytes(4)) == 0x06010002, "read only"
    assert rig.upload(0x1C00, complete=True) == bytes((4, 0, 1, 2, 3, 4))


def test_objects_of_can_are_not_there(rig):
    for index in (0x1005, 0x1014, 0x1400, 0x1600, 0x1803, 0x1A03):
        assert rig.upload(index) == 0x06020000


def test_eeprom_and_esi_have_the_factorys_image_first_and_the_others_to_choose():
    device = find_device("tgz_d")
    parts = categories(sii_content(device))
    assert [row[:2] for row in pdos(parts[51])] == [(0x1701, 2), (0x1702, 0xFF), (0x1703, 0xFF), (0x1721, 0xFF)]
    assert [row[:2] for row in pdos(parts[50])] == [(0x1B01, 3), (0x1B21, 0xFF)]
    assert [struct.unpack_from("<HH", parts[41], 8 * k) for k in (2, 3)] == [(0x1000, 40), (0x1400, 40)]
    root = ET.fromstring(esi_text(device)).find("Descriptions/Devices/Device")
    for tag, manager, category in (("RxPdo", "2", 51), ("TxPdo", "3", 50)):
        rows = root.findall(tag)
        assert [row.get("Sm") for row in rows] == [manager, *[None] * (len(rows) - 1)]
        assert {row.get("Fixed") for row in rows} == {"1"}
        bits = [
            [(int(one.findtext("Index")[2:], 16), int(one.findtext("BitLen"))) for one in row.iter("Entry")]
            for row in rows
        ]
        assert bits == [[(index, size) for index, _, size in one[2]] for one in pdos(parts[category])]
    assert root.find("Mailbox/CoE").get("PdoConfig") == "0"
    assert not parts[30][5] & 0x08, "no configuration of PDOs"


# --- the slave, as its maker's page has it ----------------------------------------------------------------------------
def test_there_is_no_bootstrap(rig):
    rig.request(1)
    assert rig.request(3) == (0x11, 0x0013)


def test_an_identification_request_is_answered_by_c_id_which_is_the_alias_too(rig):
    """From the next power-on on: AL status bit 5, and the number in place of a code; word 4 of the EEPROM, 0012h."""
    assert rig.value(0x0012) == 1
    assert rig.download(0x200D, 0, struct.pack("<I", 0)) == 0x06090032, "never 0"
    assert rig.download(0x200D, 0, struct.pack("<I", 77)) == 0
    assert rig.download(0x1010, 1, b"save") == 0
    rig.world.power_on()
    rig.address()
    assert rig.value(0x0012) == 77
    assert struct.unpack_from("<H", rig.node.read_sii(), 8) == (77,)
    rig.bring_to(AlState.PRE_OP)
    assert rig.request(0x22) == (0x22, 77)
    assert rig.request(2) == (2, 0)
    assert rig.request(0x28) == (0x12, 0x0011), "an error goes before"


def test_the_serial_number_is_that_of_the_eeprom(machine):
    node = CoeNode(machine, serial=7)
    node.power_on(0.0)
    assert node.dictionary.port(0x1018, 4).read() == 7
    assert struct.unpack_from("<I", node.read_sii(), 2 * 0x0E) == (7,)


@pytest.mark.parametrize(
    ("cycle", "taken"), [(250, True), (500, True), (1000, True), (2000, True), (750, False), (4000, False)]
)
def test_sync0_has_one_of_four_cycles(rig, cycle, taken):
    assert rig.node.request_state(AlState.PRE_OP, AlState.SAFE_OP, [], ClockSetting(True, cycle * 1e-6), 0.0) == (
        0 if taken else 0x0035
    )
    code = rig.download(0x1C32, 2, struct.pack("<I", 1000 * cycle))
    assert code == (0 if taken else 0x06090030)


def test_the_times_of_packets_are_measured(rig):
    to_op(rig, 0x1701, 0x1B01)
    assert value(rig, "3340", 4) == 0
    for _ in range(3):
        rig.exchange_image(bytes(40), 40)
    assert value(rig, "3340", 4) == 1000  # us: a cycle passes with each frame


def test_esi_and_eeprom_of_both_variants_are_the_same():
    """M: both versions use the same description files."""
    assert esi_text(find_device("tgz_d")) == esi_text(find_device("tgz_s"))
    assert sii_content(find_device("tgz_d")) == sii_content(find_device("tgz_s"))
    assert "FoE" not in esi_text(find_device("tgz_d"))


# --- a master ---------------------------------------------------------------------------------------------------------
def csp(drives):
    motion.enable(drives, mode="csp")
    steps = 4 * np.arange(1, drives.num_axes + 1)
    targets = drives.read(0x6064) + np.minimum(np.arange(250), 200)[:, None] * steps
    traces = [drives.record(SAMPLED, 0.25, {0x607A: targets}), drives.record(SAMPLED, 0.05)]
    motion.disable(drives)
    return np.concatenate([np.stack([trace[index] for index in SAMPLED]) for trace in traces], axis=1)


@pytest.mark.every(2)
@pytest.mark.parametrize(("device", "load"), [("tgz_d", "gantry"), ("tgz_s", "inertia")])
def test_a_master_moves_every_axis_in_csp_and_gets_the_integers_of_the_emulator(device, load):
    with EmulatedDrives(device, load, num_threads=1) as inside:
        inside.advance(0.002)
        NodeAxes(inside, 0, None).restart()  # as the segment: compiled, then switched on
        expected = csp(inside)
    with (
        EmulatedSegment(device, load=load) as segment,
        EtherCatDrives(device, master=segment.master(), pace="lockstep") as drives,
    ):
        found = csp(drives)
        assert segment.slaves[0].state is AlState.OP
        slave = segment.slaves[0].application
        assert (slave.output_size, slave.input_size) == (40, 40)
    np.testing.assert_array_equal(found, expected)
    assert (np.ptp(expected[1], axis=0) > 500).all(), "every axis moved"


def test_a_master_takes_the_image_that_has_what_is_played_and_puts_the_factorys_back():
    with EmulatedSegment("tgz_d", load="gantry") as segment:
        slave = segment.slaves[0].application
        with EtherCatDrives("tgz_d", master=segment.master(), pace="lockstep") as drives:
            before = drives.read(0x33C0)
            drives.record([0x33C0, 0x6077], 0.002, {0x23C7: np.stack([before] * 2)})  # once, before enabling
            assert (slave.output_size, slave.input_size) == (44, 44)
            motion.enable(drives, mode="csp")
            targets = before + np.minimum(np.arange(300), 120)[:, None] * [1 << 17, 1 << 18]
            trace = drives.record([0x33C0, 0x6077], 0.3, {0x23C7: targets})
            assert trace[0x33C0][-1] - before == pytest.approx(targets[-1] - before, rel=0.2)
            motion.disable(drives)
        assert (slave.output_size, slave.input_size) == (40, 40)


TURN, TURN_INSIDE = 2**20, 2**32
NATIVE = {0x23C7: np.zeros((2, 2), int)}  # what is played before enabling selects the native image


@pytest.fixture
def within_two_turns():
    with (
        EmulatedSegment("tgz_d", load="gantry") as segment,
        EtherCatDrives(
            "tgz_d", master=segment.master(), pace="lockstep", safety=Limits(position=(-2 * TURN, 2 * TURN))
        ) as drives,
    ):
        yield drives, segment.drives


def test_a_target_beyond_the_limits_is_refused_by_whatever_object_and_in_whatever_mode(within_two_turns):
    """607Ah in ip, 60C1h:01, and the native image's 64 bits in both modes went out unchecked, and ended at 2.05."""
    drives, inside = within_two_turns
    drives.record([0x33C0, 0x6077], 0.002, NATIVE)
    ramp = np.linspace(0.0, 4.0, 100)
    for mode in ("csp", "ip"):
        motion.enable(drives, mode=mode)
        for name, turn in ((0x607A, TURN), ((0x60C1, 1), TURN), (0x23C7, TURN_INSIDE)):
            with pytest.raises(SafetyError, match="beyond the limits -2097152 to 2097152; nothing was sent"):
                drives.write(name, 3 * turn)
        with pytest.raises(SafetyError, match=r"would lead to 21\d+, .*; nothing was sent"):
            drives.record([0x33C0, 0x6077], 0.1, {0x23C7: np.stack([ramp * TURN_INSIDE] * 2, axis=1).astype(int)})
        motion.disable(drives)
    assert np.abs(inside.machine.rotor_angle).max() < 0.1


def test_a_target_of_64_bits_is_held_against_the_limits_by_all_of_them(within_two_turns):
    """4,096 turns from zero 6064h shows 0, too: the target beside the axis is allowed, the one at zero is far away."""
    drives, inside = within_two_turns
    set_lanes(inside.inside.records, "home_shift", np.full(2, -2.0 * np.pi * 4096))
    drives.advance(0.01)
    assert drives.read(0x6064) == pytest.approx(0, abs=800)
    assert drives.read(0x33C0) == pytest.approx(2**44, abs=800 * 4096)
    motion.enable(drives, mode="csp")
    drives.write(0x23C7, 2**44 + TURN_INSIDE // 100)
    with pytest.raises(SafetyError, match="would lead to -4294956810, beyond the limits"):
        drives.write(0x23C7, TURN_INSIDE // 100)


def test_beside_the_native_image_each_d_mode_obeys_its_own_set_point(rig, machine):
    """607Ah, written by SDO, is pp's, and what the image has meanwhile moves nothing; csp has the image's."""
    for index, raw, size in ((0x2303, 7, 4), (0x6060, 1, 1)):
        assert rig.download(index, 0, raw.to_bytes(size, "little")) == 0
    to_op(rig, 0x1721, 0x1B21)
    image = bytearray(44)

    def exchange(position, control, cycles=1):
        struct.pack_into("<qI", image, 0, round(position * TURN_INSIDE), control)
        for _ in range(cycles):
            data, _ = rig.exchange_image(bytes(image), 44)
        return struct.unpack_from("<q", data)[0] / TURN_INSIDE

    for word in (0x80, 0x06, 0x07, 0x0F):
        assert rig.download(0x6040, 0, struct.pack("<H", word)) == 0
        exchange(0.3, 0, 20)
    assert rig.download(0x607A, 0, struct.pack("<i", TURN // 10)) == 0
    exchange(0.3, 0)
    assert rig.download(0x6040, 0, b"\x1f\x00") == 0
    assert exchange(0.3, 0, 400) == pytest.approx(0.1, abs=0.01)
    assert rig.download(0x6040, 0, bytes(2)) == 0
    begin = exchange(0.3, 0)
    for index, raw, size in ((0x2303, 3, 4), (0x6060, 8, 1)):
        assert rig.download(index, 0, raw.to_bytes(size, "little")) == 0
    exchange(begin, 0, 5)
    exchange(begin, 2, 20)
    for share in np.linspace(0.0, 0.1, 200):
        assert rig.download(0x607A, 0, struct.pack("<i", -TURN)) == 0
        exchange(begin + share, 2)
    assert exchange(begin + 0.1, 2, 200) == pytest.approx(begin + 0.1, abs=0.01)
    exchange(begin + 0.1, 0, 3)
    assert machine.read(0x6041)[0] & 0x6F != 0x27


@pytest.mark.every(2)
@pytest.mark.parametrize("lockstep", [True, False])
def test_what_the_native_image_had_moves_no_axis_that_is_enabled_nor_keeps_one_from_its_move(lockstep):
    """Its set-point is csp's alone: an axis enabled in csp went 0.1 turns to it, and moves in pp ended there."""
    pace = {"pace": "lockstep"} if lockstep else {}
    with (
        EmulatedSegment("tgz_d", load="gantry", lockstep=lockstep) as segment,
        EtherCatDrives("tgz_d", master=segment.master(), **pace) as drives,
    ):
        drives.record([0x6064, 0x6077], 0.002, NATIVE)
        motion.enable(drives, mode="pp")
        motion.move_to(drives, TURN // 10)
        motion.disable(drives)
        drives.advance(0.1)
        there = segment.drives.machine.rotor_angle
        assert there / (2.0 * np.pi) == pytest.approx([0.1, 0.1], abs=0.01)
        motion.enable(drives, mode="csp")
        drives.advance(0.2)
        assert segment.drives.machine.rotor_angle == pytest.approx(there, abs=0.01)


def test_in_real_time_what_no_image_has_for_every_axis_is_refused():
    with (
        EmulatedSegment("tgz_d", load="gantry", lockstep=False) as segment,
        EtherCatDrives("tgz_d", master=segment.master()) as drives,
        pytest.raises(ObjectAccessError, match=r"60FDh:00 .* is in no image of this drive, for every axis"),
    ):
        drives.record([0x60FD], 0.002)


def test_while_the_d_mode_does_not_fit_commands_of_the_image_are_ignored(rig):
    for index in (0x6060, 0x6860):
        assert rig.download(index, 0, b"\x08") == 0
    for index, mode in ((0x2303, 3), (0x2403, 2)):
        assert rig.download(index, 0, struct.pack("<I", mode)) == 0
    to_op(rig, 0x1701, 0x1B01)
    image = bytearray(40)
    for word in (0x80, 0x06, 0x07, 0x0F):
        image[12:14] = image[32:34] = struct.pack("<H", word)
        for _ in range(30):
            data, _ = rig.exchange_image(bytes(image), 40)
    words = struct.unpack_from("<H", data, 12)[0], struct.unpack_from("<H", data, 32)[0]
    assert words[0] & 0x6F == 0x27, "operation enabled"
    assert words[1] & 0x6F != 0x27 and not words[1] & 0x200, "not remote: its D-Mode is another one"
