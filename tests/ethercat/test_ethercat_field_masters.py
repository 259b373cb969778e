"""Start-up sequences of masters in the field, as tables of their writes: each reaches Op and moves every axis."""

from __future__ import annotations

import shutil
import struct
import subprocess

import numpy as np
import pytest
from rigs.coe_rig import CoeRig
from rigs.ethercat_segment import EmulatedSegment
from rigs.field_masters import AXES, CODESYS, ENABLED, HAS_STATE, ICUBE, STARTUPS, TWINCAT, FieldAxis
from rigs.namespaces import needs_namespaces, seen_by
from rigs.namespaces import spaces as spaces

from drive_env import EmulatedDrives, EtherCatDrives, motion
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.ethercat.pcap_log import PcapLog
from drive_env.master.ethercat.ethercat_master import ImageSizes, Sync0
from drive_env.master.ethercat.frame_master import FrameMaster
from drive_env.master.ethercat.frame_ways import CallWay
from drive_env.master.ethercat.mailbox_client import SdoAbortError
from drive_env.master.parameters import parameters

CYCLES, SETTLING = 150, 200
TSHARK = shutil.which("tshark")


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as made:
        yield made


@pytest.fixture
def pre_op(drives):
    rig = CoeRig(drives)
    rig.bring_to(AlState.PRE_OP)
    return rig


def answers(rig, startup):
    """Return the answer to each write, 0 or the abort code, in a row for each."""
    return [
        (f"{index:04X}", rig.download(index, sub or 0, data, complete=sub is None))
        for index, sub, data in startup.rows()
    ]


def moved(exchange, startup, slaves=1):
    """Enable and move all axes of slaves; return how far each moved, and what it shows at the end."""
    axes = [[FieldAxis(4 * (AXES * slave + k + 1), CYCLES) for k in range(AXES)] for slave in range(slaves)]
    for _ in range(400 + CYCLES + SETTLING):
        data = exchange([startup.pack([axis.now for axis in module]) for module in axes])
        for module, image in zip(axes, data, strict=True):
            for axis, shown in zip(module, startup.unpack(image), strict=True):
                axis.take(shown)
    rows = [axis for module in axes for axis in module]
    assert [axis.shown["word"] & HAS_STATE for axis in rows] == [ENABLED] * len(rows)
    assert {axis.shown.get("mode", 8) for axis in rows} == {8}
    return [axis.shown["position"] - axis.start for axis in rows]


@pytest.mark.every(3)
@pytest.mark.parametrize("name", STARTUPS)
def test_every_write_is_taken_and_every_axis_moves(pre_op, name):
    startup = STARTUPS[name]
    assert [row for row in answers(pre_op, startup) if row[1]] == []
    outputs, inputs = startup.sizes
    assert (pre_op.node.output_size, pre_op.node.input_size) == (outputs, inputs)
    pre_op.bring_to(AlState.OP, outputs=outputs, inputs=inputs)
    found = moved(lambda images: [pre_op.exchange_image(images[0], inputs)[0]], startup)
    assert found == pytest.approx([CYCLES * 4, CYCLES * 8, CYCLES * 12], abs=40)
    assert pre_op.request(4) == (4, 0)


@pytest.mark.parametrize("name", STARTUPS)
def test_a_start_up_can_be_repeated(pre_op, name):
    """A master that is started again finds the mapping that it left, or another master's."""
    for one in (*STARTUPS.values(), STARTUPS[name]):
        assert {code for _, code in answers(pre_op, one)} == {0}
    assert (pre_op.node.output_size, pre_op.node.input_size) == STARTUPS[name].sizes


@pytest.mark.every(9)
@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian: apt install tshark)")
@pytest.mark.parametrize("name", STARTUPS)
def test_wireshark_reads_the_same_writes_and_no_malformed_frame(drives, name, tmp_path):
    startup, path, rig = STARTUPS[name], tmp_path / "startup.pcap", CoeRig(drives)
    with PcapLog(path) as log:
        rig.world.segment.listeners.append(log.add)
        rig.bring_to(AlState.PRE_OP)
        answers(rig, startup)
        outputs, inputs = startup.sizes
        rig.bring_to(AlState.OP, outputs=outputs, inputs=inputs)
        moved(lambda images: [rig.exchange_image(images[0], inputs)[0]], startup)

    def dissected(*arguments):
        done = subprocess.run([TSHARK, "-r", path, *arguments], capture_output=True, text=True, timeout=60.0)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert dissected("-Y", "_ws.malformed") == []
    sent = "ecat_mailbox.coe.sdoccsid && eth.src[0] == 01"  # as they left the master
    fields = ("ecat_mailbox.coe.sdoidx", "ecat_mailbox.coe.sdosub")
    found = dissected("-Y", sent, "-T", "fields", *(part for field in fields for part in ("-e", field)))
    read = [tuple(int(word, 16) for word in line.split()) for line in found]
    assert read == [(index, sub or 0) for index, sub, _ in startup.rows()]


def test_codesys_with_the_assignment_taken_away_first(pre_op):
    whole = [row for row in CODESYS.rows() if row[1] is None]
    for index in (0x1C12, 0x1C13):
        assert pre_op.download(index, 0, b"\0\0", complete=True) == 0
    for index, _, data in whole:
        assert pre_op.download(index, 0, data, complete=True) == 0
    assert (pre_op.node.output_size, pre_op.node.input_size) == CODESYS.sizes


@pytest.mark.every(4)
@pytest.mark.parametrize("sync0", [False, True], ids=["free", "sync0"])
def test_six_axes_of_two_modules_under_icube_s_configuration(sync0):
    with EmulatedSegment(number=2) as segment:
        master = segment.master()
        assert master.begin() == 2
        for position in range(2):
            for index, sub, data in ICUBE.rows():
                master.download(position, index, sub, data, 5.0)
        master.clock = Sync0(0.001, True) if sync0 else None
        sizes = ImageSizes(*ICUBE.sizes)
        master.map({0: sizes, 1: sizes})
        held = ICUBE.pack([FieldAxis(0, 0).now] * AXES)
        master.operate([0, 1], lambda: master.exchange([held, held], 1.0), 20.0)
        found = moved(lambda images: master.exchange(images, 1.0), ICUBE, slaves=2)
        assert found == pytest.approx([CYCLES * 4 * k for k in range(1, 7)], abs=40)
        master.close()


@pytest.mark.every(9)
@pytest.mark.parametrize("name", STARTUPS)
def test_our_master_works_where_another_left_its_mapping_and_puts_it_back(pre_op, name):
    """Gaps are in it, which no image of ours has."""
    objects = (0x1600, 0x1A00, 0x1C12, 0x1C13)
    assert {code for _, code in answers(pre_op, STARTUPS[name])} == {0}
    left = [pre_op.upload(index, complete=True) for index in objects]
    master = FrameMaster(CallWay(pre_op.world.receive))
    with EtherCatDrives("tmcm3313", master=master, nodes=(0,), pace="lockstep") as drives:
        drives.record([0x6041, 0x6064], 0.002, {0x607A: np.tile(drives.read(0x6064), (2, 1))})  # maps both images
        motion.enable(drives, mode="csp")
        start = drives.read(0x6064)
        targets = start + np.minimum(np.arange(CYCLES + 50), CYCLES)[:, None] * 4
        trace = drives.record([0x6041, 0x6064], (CYCLES + 50) * 0.001, {0x607A: targets})
        np.testing.assert_allclose(trace[0x6064][-1] - start, CYCLES * 4, atol=40)
        backed_up = {(entry.index, entry.sub) for entry in parameters(drives)}
        assert {(index, 1) for index in objects} <= backed_up, "on EtherCAT they are parameters"
    pre_op.bring_to(AlState.PRE_OP)
    assert [pre_op.upload(index, complete=True) for index in objects] == left


def igh(master, position, rows):
    """Write as IgH's master does: it gives a mapping up at its first refusal, warns, and goes on with the assignment.

    Returns:
        The objects given up.
    """
    given_up = []
    for index, sub, data in rows:
        if index in given_up:
            continue
        try:
            master.download(position, index, sub, data, 5.0)
        except SdoAbortError:
            given_up.append(index)
    return given_up


def test_what_igh_s_master_makes_of_a_refusal():
    """The sync manager has the length that was asked for, and the slave refuses Safe-Op: its mapping stayed empty."""
    rows = [(index, sub, bytes.fromhex("10 00 B8 60") if (index, sub) == (0x1600, 3) else data)
            for index, sub, data in ICUBE.rows()]  # fmt: skip
    with EmulatedSegment() as segment:
        master = segment.master()
        master.begin()
        assert igh(master, 0, rows) == [0x1600]
        assert master.upload(0, 0x1600, 0, 5.0) == b"\0" and master.upload(0, 0x1A00, 0, 5.0) == b"\x09"
        with pytest.raises(Exception, match="does not come to Safe-Op; AL status code 001Dh"):
            master.map({0: ImageSizes(*ICUBE.sizes)})
        master.close()


def test_the_registers_of_an_eni(drives):
    """Init commands in an ENI's order: clear, SYNC0 by both bytes of its activation, sync managers, FMMUs, states."""
    rig = CoeRig(drives)
    outputs, inputs = TWINCAT.sizes
    rig.write(0x0120, "11 00")  # Init, with acknowledge
    rig.write(0x0980, "00 00")
    rig.write(0x0800, bytes(16))
    rig.write(0x0800, "00 10 00 01 26 00 01 00")
    rig.write(0x0808, "00 11 00 01 22 00 01 00")
    rig.write(0x0810, bytes(16))
    rig.write(0x0120, "12 00")
    assert rig.read(0x0130, 6) == bytes.fromhex("02 00 00 00 00 00")
    assert {code for _, code in answers(rig, TWINCAT)} == {0}
    rig.write(0x09A0, "40 42 0F 00 00 00 00 00")  # SYNC0 each millisecond, no SYNC1
    rig.write(0x0990, struct.pack("<Q", rig.value(0x0910, 8) // 1_000_000 * 1_000_000 + 1_500_000))
    rig.write(0x0980, "00 03")
    rig.write(0x09A8, "00 00")
    rig.write(0x0810, struct.pack("<HHBBBB", 0x1200, outputs, 0x64, 0, 1, 0))
    rig.write(0x0818, struct.pack("<HHBBBB", 0x1300, inputs, 0x20, 0, 1, 0))
    rig.write(0x0600, struct.pack("<IHBBHBBB", 0x10000, outputs, 0, 7, 0x1200, 0, 2, 1).ljust(16, b"\0"))
    rig.write(0x0610, struct.pack("<IHBBHBBB", 0x10000 + outputs, inputs, 0, 7, 0x1300, 0, 1, 1).ljust(16, b"\0"))
    assert rig.request(AlState.SAFE_OP) == (4, AlStatusCode.NO_ERROR)
    rig.exchange_image(bytes(outputs), inputs)
    assert rig.request(AlState.OP) == (8, AlStatusCode.NO_ERROR)
    found = moved(lambda images: [rig.exchange_image(images[0], inputs)[0]], TWINCAT)
    assert found == pytest.approx([CYCLES * 4, CYCLES * 8, CYCLES * 12], abs=40)
    rig.write(0x0120, "12 00")
    assert rig.value(0x0130) == 2


@pytest.mark.slow
@needs_namespaces
@pytest.mark.parametrize("name", STARTUPS)
def test_on_a_cable(spaces, name):
    """pysoem writes the tables to a drive that is served on a raw socket."""
    seen = seen_by(spaces, "--lockstep", "ethercat_field_master.py", name, CYCLES)
    assert seen["slaves"] == 1 and seen["refused"] == []
    assert tuple(seen["sizes"]) == STARTUPS[name].sizes and seen["safe_op"] and seen["op"]
    assert seen["enabled"] == [True] * AXES
    assert seen["moved"] == pytest.approx([CYCLES * 4, CYCLES * 8, CYCLES * 12], abs=40)
