"""The TMCM-3313 behind a slave controller: SDO, SDO information, states, process data, by ETG.1000.6 and its manual."""

from __future__ import annotations

import struct

import pytest
from rigs.coe_rig import CoeRig

from drive_env import EmulatedDrives
from drive_env.cia402 import State
from drive_env.ethercat.application import AlState, AlStatusCode

OUTPUT = struct.Struct("<HiiHiiHii")  # table 22
INPUT = struct.Struct("<HiiHiiHii")  # table 24


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as made:
        yield made


@pytest.fixture
def rig(drives):
    return CoeRig(drives)


@pytest.fixture
def pre_op(rig):
    rig.bring_to(AlState.PRE_OP)
    return rig


# --- SDO --------------------------------------------------------------------------------------------------------------
@pytest.mark.every(18)
@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("40 18 10 01 00 00 00 00", "3 43 18 10 01 86 02 00 00"),  # vendor 286h, expedited
        ("40 00 10 00 00 00 00 00", "3 43 00 10 00 92 01 FC FF"),  # table 9
        ("40 41 60 00 00 00 00 00", "3 4B 41 60 00 "),  # two bytes
        ("40 08 10 00 00 00 00 00", "3 41 08 10 00 09 00 00 00 54 4D 43 4D 2D 33 33 31 33"),  # normal: TMCM-3313
        ("50 18 10 00 00 00 00 00", "3 51 18 10 00 0E 00 00 00 03 00 86 02 00 00 F1 0C 00 00 09 00 01 00"),
        ("50 18 10 01 00 00 00 00", "3 51 18 10 01 0C 00 00 00 86 02 00 00 F1 0C 00 00 09 00 01 00"),
        ("50 12 1C 00 00 00 00 00", "3 53 12 1C 00 01 00 00 16"),  # 16 bits of number, then 1600h
        ("40 FF 5F 00 00 00 00 00", "2 80 FF 5F 00 00 00 02 06"),  # no such object
        ("40 18 10 09 00 00 00 00", "2 80 18 10 09 11 00 09 06"),  # no such sub-index
        ("40 05 10 00 00 00 00 00", "2 80 05 10 00 00 00 02 06"),  # 1005h is CAN's
        ("23 18 10 01 00 00 00 00", "2 80 18 10 01 02 00 01 06"),  # read only
        ("2F 60 60 00 03 00 00 00", "3 60 60 60 00 00 00 00 00"),  # mode pv
        ("2F 60 60 00 05 00 00 00", "2 80 60 60 00 30 00 09 06"),  # table 188 has no 5
        ("2B 60 60 00 03 00 00 00", "2 80 60 60 00 12 00 07 06"),  # two bytes for one
        ("50 41 60 00 00 00 00 00", "2 80 41 60 00 00 00 01 06"),  # complete access to a variable
        ("50 18 10 02 00 00 00 00", "2 80 18 10 02 00 00 01 06"),  # begins at 0 or 1
        ("60 00 00 00 00 00 00 00", "2 80 00 00 00 01 00 04 05"),  # a segment of nothing
        ("E0 41 60 00 00 00 00 00", "2 80 41 60 00 01 00 04 05"),
    ],
)  # fmt: skip
def test_sdo(pre_op, request_, answer):
    assert pre_op.sdo(request_).startswith(answer)


def test_a_segmented_download_and_its_toggle_bit(pre_op):
    """A normal download whose data come in segments: 607Ah takes four bytes, two with the request and two after it."""
    assert pre_op.sdo("21 7A 60 00 04 00 00 00 40 E2") == "3 60 7A 60 00 00 00 00 00"
    assert pre_op.sdo("0B 01 00 00 00 00 00 00") == "3 20 00 00 00 00 00 00 00"
    assert pre_op.upload(0x607A) == struct.pack("<i", 123_456)
    pre_op.sdo("21 7A 60 00 04 00 00 00 40 E2")
    assert pre_op.sdo("1B 01 00 00 00 00 00 00") == "2 80 7A 60 00 00 00 03 05"
    assert pre_op.sdo("0B 01 00 00 00 00 00 00") == "2 80 00 00 00 01 00 04 05", "the abort ended the transfer"


def test_an_upload_that_does_not_fit_the_mailbox_comes_in_segments(drives):
    rig = CoeRig(drives)
    rig.node._sdo._room = 20  # of the mailbox, less its headers
    rig.bring_to(AlState.PRE_OP)
    whole = rig.upload(0x1600, complete=True)
    assert struct.unpack("<H9I", whole)[:3] == (9, 0x60400010, 0x607A0020)
    assert len(whole) == 38


# --- the process image ------------------------------------------------------------------------------------------------
def test_a_mapping_is_changed_whole_or_not_at_all(pre_op):
    """Assignment off, mapping, assignment on; the sync manager then has the length of what is mapped."""
    entries = struct.pack("<H3I", 3, 0x60400010, 0x60600008, 0x60FF0020)
    assert pre_op.download(0x1C12, 0, b"\0\0", complete=True) == 0
    wrong = struct.pack("<H2I", 2, 0x60400010, 0x60410010)  # the statusword is no output
    assert pre_op.download(0x1600, 0, wrong, complete=True) == 0x06040041
    assert len(pre_op.upload(0x1600, complete=True)) == 38, "nine entries, as before"
    assert pre_op.download(0x1600, 0, entries, complete=True) == 0
    assert pre_op.upload(0x1600, complete=True) == entries
    assert pre_op.download(0x1C12, 0, struct.pack("<HH", 1, 0x1600), complete=True) == 0
    pre_op.configure(30, 30)
    assert pre_op.request(4) == (0x12, AlStatusCode.OUTPUT_CONFIGURATION)
    assert pre_op.request(0x12) == (2, 0)
    pre_op.configure(7, 29)
    assert pre_op.request(4) == (0x12, AlStatusCode.INPUT_CONFIGURATION)
    assert pre_op.request(0x12) == (2, 0)
    pre_op.bring_to(AlState.OP, outputs=7)
    assert pre_op.download(0x1C12, 0, b"\0\0", complete=True) == 0x08000022, "in pre-operational alone"
    assert pre_op.download(0x1600, 0, b"\0\0\0", complete=True) == 0x06070012


def command(word, positions=(0, 0, 0), speeds=(0, 0, 0)):
    return OUTPUT.pack(*(value for axis in range(3) for value in (word, positions[axis], speeds[axis])))


def enable(rig, mode=8):
    """Bring all axes to operation enabled by process data, in a mode; returns their positions."""
    for k in range(3):
        assert rig.download(0x6060 + 0x800 * k, 0, bytes((mode,))) == 0
    rig.bring_to(AlState.OP)
    data, counter = rig.exchange_image(command(0))
    for word in (0x80, 0, 6, 7, 15):
        for _ in range(60):
            here = INPUT.unpack(data)[1::3]
            data, counter = rig.exchange_image(command(word, here))
            assert counter == 3
    values = INPUT.unpack(data)
    assert [word & 0x6F for word in values[::3]] == [0x27, 0x27, 0x27], "operation enabled"
    return values[1::3]


def states(rig):
    return [State(axis.state) for axis in rig.node._axes]


def test_all_axes_follow_their_own_targets_in_csp(pre_op):
    start = enable(pre_op)
    steps, data = 300, b""
    for k in range(1, steps + 201):
        at = min(k, steps)
        data, _ = pre_op.exchange_image(command(15, [start[n] + at * (n + 1) * 4 for n in range(3)]))
    moved = [there - before for there, before in zip(INPUT.unpack(data)[1::3], start, strict=True)]
    assert moved == pytest.approx([steps * 4, steps * 8, steps * 12], abs=200)
    assert pre_op.request(4) == (4, 0)


@pytest.mark.every(3)
@pytest.mark.parametrize("target", [1, 2, 4], ids=["init", "pre_op", "safe_op"])
def test_who_leaves_op_has_its_motors_stopped(pre_op, target):
    enable(pre_op, mode=9)
    for _ in range(100):
        pre_op.exchange_image(command(15, speeds=(20_000, 20_000, 20_000)))
    pre_op.emergencies.clear()
    assert pre_op.request(target) == (target, 0)
    assert State.OPERATION_ENABLED not in states(pre_op)
    for _ in range(600):
        pre_op.world.cycle()
    assert states(pre_op) == [State.FAULT] * 3
    assert abs(pre_op.drives.read(0x606C)).max() < 500, "and stand"
    if target != 1:
        pre_op.answers()
        assert [one[:2] for one in pre_op.emergencies][:1] == [b"\x00\x81"], "8100h: the table's communication error"


def test_the_watchdog_stops_the_motors(drives):
    rig = CoeRig(drives)
    rig.bring_to(AlState.PRE_OP)
    enable(rig)
    begun = rig.world.time
    while rig.slave.state is AlState.OP:
        assert rig.world.time < begun + 0.2
        rig.world.cycle()  # no frame comes
    assert rig.world.time - begun == pytest.approx(0.1, abs=2e-3), "100 ms is the controller's own time"
    assert (rig.slave.state, rig.slave.code) == (AlState.SAFE_OP, AlStatusCode.SM_WATCHDOG)
    assert State.OPERATION_ENABLED not in states(rig)
    rig.answers()
    assert rig.emergencies[0][:2] == b"\x00\x81"
    assert rig.request(0x14) == (4, 0)
    assert rig.request(8) == (8, 0), "and Op is there again"


@pytest.mark.parametrize("state", [AlState.PRE_OP, AlState.SAFE_OP])
def test_no_sdo_starts_a_motor_outside_op(rig, state):
    """Manual, section 2.2: outputs cannot be switched and the motor cannot be run."""
    rig.bring_to(state)
    for word in (0x80, 0, 6, 7):
        assert rig.download(0x6040, 0, struct.pack("<H", word)) == 0
        rig.world.cycle()
    assert rig.download(0x6040, 0, struct.pack("<H", 15)) == 0x08000022
    assert rig.download(0x6040, 0, struct.pack("<H", 7)) == 0


def test_an_output_that_its_object_does_not_take_changes_nothing_and_the_others_act(pre_op):
    """6320h of the device's table, once until a good image comes."""
    assert pre_op.download(0x1C12, 0, b"\0\0", complete=True) == 0
    entries = struct.pack("<H2I", 2, 0x60600008, 0x60FF0020)
    assert pre_op.download(0x1600, 0, entries, complete=True) == 0
    assert pre_op.download(0x1C12, 0, struct.pack("<HH", 1, 0x1600), complete=True) == 0
    pre_op.bring_to(AlState.OP, outputs=5)
    pre_op.exchange_image(struct.pack("<bi", 3, 1234))
    assert pre_op.drives.read(0x60FF)[0] == 1234
    for _ in range(3):
        pre_op.exchange_image(struct.pack("<bi", 5, 4321))  # no mode 5
    assert (pre_op.drives.read(0x6060)[0], pre_op.drives.read(0x60FF)[0]) == (3, 4321)
    pre_op.answers()
    assert [one[:2] for one in pre_op.emergencies] == [b"\x20\x63"]


# --- SDO information --------------------------------------------------------------------------------------------------
def information(rig, operation, content):
    """Return the content of the fragments of an answer, put together, and how many there were."""
    found = rig.ask(8, bytes((operation, 0, 0, 0)) + content)
    assert {service for service, _ in found} == {8}
    assert [int.from_bytes(data[2:4], "little") for _, data in found] == list(range(len(found) - 1, -1, -1))
    assert [bool(data[0] & 0x80) for _, data in found] == [True] * (len(found) - 1) + [False]
    assert {data[0] & 0x7F for _, data in found} == {operation + 1} or found[0][1][0] == 7
    return b"".join(data[4:] for _, data in found), len(found)


def test_the_lists_of_objects(pre_op):
    content, _ = information(pre_op, 1, struct.pack("<H", 0))
    lengths = struct.unpack("<6H", content)[1:]
    for kind, length in enumerate(lengths, 1):
        content, fragments = information(pre_op, 1, struct.pack("<H", kind))
        words = struct.unpack(f"<{len(content) // 2}H", content)
        assert words[0] == kind
        indices = words[1:]
        assert len(indices) == length
        assert list(indices) == sorted(set(indices))
        if kind == 1:
            assert fragments > 1
            assert {0x1000, 0x1018, 0x1600, 0x1A00, 0x1C00, 0x1C12, 0x1C13, 0x6041, 0x6841, 0x7041} <= set(indices)
            assert not {0x1005, 0x1440, 0x1640} & set(indices), "the extension for CAN"
        if kind in (2, 3):
            assert 0x6040 in indices, "it can be written, and read back"
            assert (0x6041 in indices) == (kind == 3)
    assert information(pre_op, 1, struct.pack("<H", 9))[0] == struct.pack("<I", 0x05040001)


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("index", "kind", "last", "code", "name"),
    [
        (0x1000, 7, 0, 7, "Device type"),
        (0x1018, 0x23, 3, 9, "Identity object"),
        (0x1600, 0x21, 9, 9, None),
        (0x6064, 4, 0, 7, None),
    ],
)
def test_the_description_of_an_object(pre_op, index, kind, last, code, name):
    content, _ = information(pre_op, 3, struct.pack("<H", index))
    assert struct.unpack_from("<HHBB", content) == (index, kind, last, code)
    assert content[6:]
    if name is not None:
        assert content[6:].decode().lower() == name.lower()


@pytest.mark.parametrize(
    ("index", "sub", "kind", "bits", "access"),
    [
        (0x6041, 0, 6, 16, 0x87),  # read in all states, an input
        (0x6040, 0, 6, 16, 0xFF),  # read and written, output and input
        (0x1600, 1, 7, 32, 0x0F),  # read; written in Pre-Op
        (0x1018, 1, 7, 32, 0x07),
    ],
)
def test_the_description_of_an_entry(pre_op, index, sub, kind, bits, access):
    content, _ = information(pre_op, 5, struct.pack("<HBB", index, sub, 0))
    assert struct.unpack_from("<HBBHHH", content) == (index, sub, 0, kind, bits, access)


@pytest.mark.slow
def test_the_description_of_an_entry_with_its_values(pre_op):
    """2000h: table 35 has 0 to 8, default 8."""
    content, _ = information(pre_op, 5, struct.pack("<HBB", 0x2000, 0, 0x70))
    assert content[3] == 0x70
    assert tuple(content[10:13]) == (8, 0, 8)


@pytest.mark.parametrize(("sub", "code"), [(0, 0x06020000), (9, 0x06090011)])
def test_what_is_not_there_has_no_description(pre_op, sub, code):
    index = 0x1018 if sub else 0x5FFF
    assert information(pre_op, 5, struct.pack("<HBB", index, sub, 0))[0] == struct.pack("<I", code)


@pytest.mark.parametrize("content", [b"", b"\x01\0\0\0", b"\x81\0\0\0\1\0", b"\x05\0\0\0\0\x60"])
def test_a_message_that_is_cut_is_a_mailbox_error(pre_op, content):
    assert [service for service, _ in pre_op.ask(8, content)] == [-1]
