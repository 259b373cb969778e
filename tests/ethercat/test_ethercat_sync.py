"""How a slave is synchronised: SYNC0, and 1C32h and 1C33h, which show it and count what goes wrong (ETG.1020, 22)."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from rigs.coe_rig import CoeRig

from drive_env import EmulatedDrives
from drive_env.cia402 import State
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.firmware.record import get_lanes

CYCLE = 1_000_000  # ns
OUTPUT = struct.Struct("<HiiHiiHii")  # table 22 of the TMCM-3313's manual
OUTPUTS, INPUTS = 0x1C32, 0x1C33
TYPE, CYCLE_TIME, SUPPORTED, LEAST, MISSED, TOO_SHORT, SYNC_ERROR = 1, 2, 4, 5, 11, 12, 32


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as made:
        yield made


@pytest.fixture
def rig(drives):
    rig = CoeRig(drives)
    rig.bring_to(AlState.PRE_OP)
    return rig


def value(rig, sub, index=OUTPUTS):
    return int.from_bytes(rig.upload(index, sub), "little")


def start_sync0(rig, cycle=CYCLE, shift=500_000):
    """SYNC0 from half a millisecond after the next cycle's begin on."""
    now = rig.value(0x0910, 8)
    rig.write(0x0990, struct.pack("<Q", now // CYCLE * CYCLE + CYCLE + shift))
    rig.write(0x09A0, struct.pack("<I", cycle))
    rig.write(0x0981, "03")


def send(rig, speed):
    """Exchange images with a target velocity; then a cycle passes, and a pulse in its middle."""
    rig.exchange_image(OUTPUT.pack(0, 0, speed, 0, 0, 0, 0, 0, 0))


@pytest.mark.every(8)
@pytest.mark.parametrize(("sub", "of_outputs", "of_inputs"), [
    (TYPE, 1, 0x22), (CYCLE_TIME, CYCLE, CYCLE), (SUPPORTED, 6, 6), (LEAST, 250_000, 250_000), (MISSED, 0, 0),
    (TOO_SHORT, 0, 0), (SYNC_ERROR, 0, 0), (0, 32, 32),
])  # fmt: skip
def test_without_clocks_outputs_go_with_their_sync_manager(rig, sub, of_outputs, of_inputs):
    assert (value(rig, sub), value(rig, sub, INPUTS)) == (of_outputs, of_inputs)


def test_without_clocks_outputs_take_effect_as_they_come(rig, drives):
    rig.bring_to(AlState.OP)
    send(rig, 1234)
    assert drives.read(0x60FF)[0] == 1234


@pytest.mark.every(3)
@pytest.mark.parametrize("cycle", [250_000, 1_000_000, 4_000_000])
def test_sync0_shows_its_type_and_cycle_from_safe_op_to_pre_op(rig, cycle):
    start_sync0(rig, cycle)
    rig.bring_to(AlState.SAFE_OP)
    for index in (OUTPUTS, INPUTS):
        assert (value(rig, TYPE, index), value(rig, CYCLE_TIME, index)) == (2, cycle)
    rig.request(AlState.PRE_OP)
    assert (value(rig, TYPE), value(rig, CYCLE_TIME)) == (1, CYCLE)


def test_with_sync0_outputs_take_effect_at_its_pulse(rig, drives):
    start_sync0(rig)
    rig.bring_to(AlState.OP)
    node = rig.node
    node.outputs(OUTPUT.pack(0, 0, 77, 0, 0, 0, 0, 0, 0), rig.world.time)
    before = drives.read(0x60FF)[0]
    rig.slave.run_until(rig.world.time + 0.0014)
    assert drives.read(0x60FF)[0] == before, "the first pulse is 1.5 ms ahead"
    rig.slave.run_until(rig.world.time + 0.0016)
    assert drives.read(0x60FF)[0] == 77


def test_pulses_without_new_outputs_are_counted(rig):
    start_sync0(rig)
    rig.bring_to(AlState.OP)
    for speed in range(5):
        send(rig, speed)
    assert (value(rig, MISSED), value(rig, SYNC_ERROR)) == (0, 0)
    for _ in range(3):
        rig.world.cycle()
    assert (value(rig, MISSED), value(rig, MISSED, INPUTS), value(rig, SYNC_ERROR)) == (3, 3, 1)
    send(rig, 5)
    assert (value(rig, MISSED), value(rig, SYNC_ERROR)) == (3, 0)
    rig.request(AlState.PRE_OP)
    rig.bring_to(AlState.OP)
    assert value(rig, MISSED) == 0, "counted anew"


def test_outputs_that_come_too_soon_are_counted(rig):
    rig.bring_to(AlState.OP)
    image = OUTPUT.pack(*[0] * 9)
    for _ in range(3):
        rig.write(0x1200, image)  # no time passes: three within no time
    assert value(rig, TOO_SHORT) == 2
    send(rig, 0)
    assert value(rig, TOO_SHORT) == 3
    send(rig, 0)
    assert value(rig, TOO_SHORT) == 3, "a millisecond after the last ones"


@pytest.mark.every(9)
@pytest.mark.parametrize(("index", "sub", "content", "code"), [
    (OUTPUTS, TYPE, "02 00", 0), (INPUTS, TYPE, "02 00", 0), (OUTPUTS, CYCLE_TIME, "90 D0 03 00", 0),
    (OUTPUTS, TYPE, "03 00", 0x06090030), (OUTPUTS, TYPE, "22 00", 0x06090030), (INPUTS, TYPE, "01 00", 0x06090030),
    (OUTPUTS, CYCLE_TIME, "8F D0 03 00", 0x06090032), (OUTPUTS, SUPPORTED, "02 00", 0x06010002),
    (OUTPUTS, MISSED, "00 00", 0x06010002),
])  # fmt: skip
def test_what_they_can_be_set_to(rig, index, sub, content, code):
    content = bytes.fromhex(content)
    assert rig.download(index, sub, content) == code
    if not code:
        assert rig.upload(index, sub) == content


def test_they_are_set_in_pre_op_alone(rig):
    rig.bring_to(AlState.SAFE_OP)
    assert rig.download(OUTPUTS, CYCLE_TIME, struct.pack("<I", CYCLE)) == 0x08000022


@pytest.mark.parametrize("index", [OUTPUTS, INPUTS])
def test_sync0_that_was_asked_for_and_is_not_there_is_refused(rig, index):
    assert rig.download(index, TYPE, b"\2\0") == 0
    rig.configure(30, 30)
    assert rig.request(4) == (0x12, AlStatusCode.DC_SYNC_CONFIGURATION)
    start_sync0(rig)
    assert rig.request(0x14) == (4, 0)


@pytest.mark.slow
def test_a_cycle_of_sync0_that_is_too_short_is_refused(rig):
    rig.configure(30, 30)
    rig.write(0x09A0, struct.pack("<I", 249_999))  # ns
    rig.write(0x0981, "03")
    assert rig.request(4) == (0x12, AlStatusCode.DC_CYCLE_TIME)


@pytest.mark.every(4)
@pytest.mark.parametrize(("register", "content"), [
    (0x0981, "00"),  # SYNC0 off
    (0x09A0, "FF FF FF FF"),  # its cycle 4.3 s
    (0x09A0, "00 00 00 00"),  # one more pulse
    (0x0920, "00 00 00 00 00 00 00 F0"),  # the system time leaps back
])  # fmt: skip
def test_a_slave_whose_sync0_stays_away_leaves_op_and_stops_its_axes(rig, drives, register, content):
    """Its outputs would never take effect: images went on, and a stop in them was void."""
    start_sync0(rig)
    rig.bring_to(AlState.OP)
    enabled = [15, 0, 20_000] * 3
    assert [rig.download(0x6060 + 0x800 * axis, 0, b"\3") for axis in range(3)] == [0, 0, 0]
    for word in (6, 7, 15):
        for _ in range(2):
            rig.exchange_image(OUTPUT.pack(*[word, 0, 20_000] * 3))
    assert (get_lanes(drives.inside.records, "fsa", 3) == State.OPERATION_ENABLED).all()
    rig.write(register, content)
    for _ in range(8):
        rig.exchange_image(OUTPUT.pack(*enabled))
    assert (rig.slave.state, rig.slave.code) == (AlState.SAFE_OP, AlStatusCode.FATAL_SYNC)
    assert (get_lanes(drives.inside.records, "fsa", 3) != State.OPERATION_ENABLED).all()
    for _ in range(500):
        rig.exchange_image(OUTPUT.pack(*enabled))
    assert (get_lanes(drives.inside.records, "stage_on", 3) == 0.0).all()
    assert np.abs(get_lanes(drives.inside.records, "omega_m", 3)).max() < 1.0


@pytest.mark.every(6)
@pytest.mark.parametrize("leap", [1 << 60, (1 << 63) + 5, 10**9])
@pytest.mark.parametrize("cycle", [CYCLE, 1])
def test_a_leap_of_the_system_time_is_no_row_of_pulses(rig, leap, cycle):
    """A write of 0920h by another master was 10^12 pulses, and the server did nothing else."""
    start_sync0(rig)
    rig.bring_to(AlState.OP)
    rig.write(0x09A0, struct.pack("<I", cycle))
    rig.write(0x0920, struct.pack("<Q", leap))
    for _ in range(5):
        send(rig, 0)
    assert rig.value(0x0990, 8) != 0
