"""The node of a TMCM-6212, as transcripts: its six axes by SDO, NMT, PDO, EMCY (manual, sections 1.1, 2.2, 2.5)."""

from __future__ import annotations

import pytest
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.bus.bits import frame_bits
from drive_env.bus.wire import Wire as Bus
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.cia402 import State, state_of
from drive_env.dictionary.aborts import (
    CANNOT_BE_STORED,
    NO_SUCH_OBJECT,
    NO_SUCH_SUB_INDEX,
    READ_ONLY,
    VALUE_RANGE,
    VALUE_TOO_HIGH,
    VALUE_TOO_LOW,
    WRONG_STATE,
)

AXES = 6
EACH = range(AXES)
PROFILE, MOTOR, PDO = 0x800, 0x200, 0x40  # from an axis to the next
OFF = 0x8000_0000
DISABLED, READY = State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON
ENABLED, FAULT = State.OPERATION_ENABLED, State.FAULT


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1) as made:
        yield made


@pytest.fixture
def wire(drives):
    """Node 5, pre-operational."""
    drives.machine.reset()
    drives.machine.enable_input = True
    drives.machine.set_temperatures(25.0, 25.0)
    return Wire(drives)


def enable(wire, axes=EACH, mode=3):
    for axis in axes:
        assert wire.download(0x6060 + PROFILE * axis, 0, mode, 1) == 0
        for word in (6, 7, 15):
            assert wire.download(0x6040 + PROFILE * axis, 0, word, 2) == 0


def states(wire):
    return [state_of(wire.value(0x6041 + PROFILE * axis)) for axis in EACH]


# --- SDO --------------------------------------------------------------------------------------------------------------
def test_it_says_what_it_is(wire):
    wire.play("""
        rx 605  40 00 10 00 00 00 00 00
        tx 585  43 00 10 00 92 01 FC FF   # several axes, of steppers
        rx 605  40 18 10 02 00 00 00 00
        tx 585  43 18 10 02 44 18 00 00   # product code: 6212
        rx 605  40 08 10 00 00 00 00 00
        tx 585  41 08 10 00 09 00 00 00   # nine letters, in segments
        rx 605  60 00 00 00 00 00 00 00
        tx 585  00 54 4D 43 4D 2D 36 32   # TMCM-62
        rx 605  70 00 00 00 00 00 00 00
        tx 585  1B 31 32 00 00 00 00 00   # 12
    """)


@pytest.mark.parametrize(
    ("index", "sub", "raw", "size", "abort"),
    [
        (0x6041, 0, 0, 2, READ_ONLY),
        (0x8841, 0, 0, 2, READ_ONLY),
        (0x9041, 0, 0, 2, NO_SUCH_OBJECT),  # a seventh axis
        (0x2C03, 0, 0, 1, NO_SUCH_OBJECT),
        (0x1580, 1, 0, 4, NO_SUCH_OBJECT),
        (0x1440, 2, 1, 1, READ_ONLY),  # received PDOs are asynchronous for ever
        (0x1840, 2, 245, 1, VALUE_RANGE),
        (0x8860, 0, 10, 1, VALUE_TOO_HIGH),  # cst
        (0x8860, 0, 2, 1, VALUE_RANGE),
        (0x2A01, 0, 0, 2, VALUE_TOO_LOW),
        (0x1B40, 4, 0, 4, NO_SUCH_SUB_INDEX),  # a fourth object in a PDO
        (0x300E, 1, 0, 4, READ_ONLY),
        (0x1010, 9, 0, 4, CANNOT_BE_STORED),  # without the signature
    ],
)
def test_what_no_axis_takes(wire, index, sub, raw, size, abort):
    assert wire.download(index, sub, raw, size) == abort


@pytest.mark.parametrize("axis", EACH)
def test_limit_switches_and_units_are_chosen_before_an_axis_is_enabled(wire, axis):
    assert wire.download(0x2005 + MOTOR * axis, 0, 3, 4) == 0
    enable(wire, [axis])
    assert wire.download(0x2005 + MOTOR * axis, 0, 0, 4) == WRONG_STATE
    other = (axis + 1) % AXES
    assert wire.download(0x2005 + MOTOR * other, 0, 3, 4) == 0, "that is its own affair"


# --- PDO --------------------------------------------------------------------------------------------------------------
def test_factory_pdos_are_those_of_axis_0(wire):
    wire.start()
    wire.play(
        """
        rx 205  06 00                 # RPDO 1: controlword
        wait 1 ms
        tx 185  31 02                 # TPDO 1: statusword
        tx 285  31 02 00              # TPDO 2: statusword, mode
        rx 305  07 00 01              # RPDO 2: controlword, mode
        wait 1 ms
        tx 185  33 02
        tx 285  33 02 01
        rx 405  0F 00 10 27 00 00     # RPDO 3: controlword, target position
        wait 1 ms
        tx 185  37 ..
        tx 285  37 .. 01
        rx 080
        tx 385  .. .. 00 00 00 00     # TPDO 3 with SYNC: statusword, position
    """
    )
    assert wire.value(0x607A) == 10_000
    assert states(wire) == [ENABLED] + [DISABLED] * 5
    for index in (0x1403, 0x1803, *(base + PDO * axis + k for base in (0x1400, 0x1800) for axis in range(1, AXES)
                                    for k in range(4))):  # fmt: skip
        assert wire.value(index, 1) & OFF, f"{index:04X}h is off"


def give(wire, index, can_id, kind=None, objects=None):
    """Give a PDO an identifier, a transmission type, and objects: off, none, these, their number, on."""
    assert wire.download(index, 1, can_id | OFF, 4) == 0
    if kind is not None:
        assert wire.download(index, 2, kind, 1) == 0
    if objects is not None:
        assert wire.download(index + 0x200, 0, 0, 1) == 0
        for sub, raw in enumerate(objects, 1):
            assert wire.download(index + 0x200, sub, raw, 4) == 0
        assert wire.download(index + 0x200, 0, len(objects), 1) == 0
    assert wire.download(index, 1, can_id, 4) == 0


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("axis", EACH)
def test_each_of_the_24_sent_pdos_tells_of_its_axis(wire, axis, place):
    enable(wire, [axis])
    give(wire, 0x1800 + PDO * axis + place, 0x345, 1)
    wire.start()
    assert wire.download(0x60FF + PROFILE * axis, 0, 51_200, 4) == 0
    wire.wait(200)
    wire.take()
    (frame,) = [one for one in wire.receive(0x80) if one.can_id == 0x345]
    status = int.from_bytes(frame.data[:2], "little")
    assert status & 0x6F == 0x27
    rest = int.from_bytes(frame.data[2:], "little", signed=True)
    assert rest == [0, 3, wire.value(0x6064 + PROFILE * axis), wire.value(0x606C + PROFILE * axis)][place]
    assert place < 2 or rest > 1000


def test_thirty_frames_per_sync_take_four_milliseconds_of_a_bus_of_1_mbit_s(wire):
    """24 sent PDOs and six received ones: too many for a cycle of 1 ms, not for one of 4 ms."""
    for axis in EACH:
        for place in range(4):
            give(wire, 0x1800 + PDO * axis + place, 0x300 + 4 * axis + place, 1)
        give(wire, 0x1402 + PDO * axis, 0x211 + axis)
    sync = Frame(0x80)
    targets = [Frame(0x211 + axis, bytes.fromhex("0F 00 D2 04 00 00")) for axis in EACH]
    wire.start()
    wire.take()
    for frame in targets:
        wire.node.receive(frame, wire.now)
    answers = wire.receive(0x80)
    assert len(answers) == 24
    bits = [frame_bits(frame) for frame in (sync, *targets, *answers)]
    took = sum(bits) / 1e6
    assert 0.002 < took < 0.004, "s"
    bus = Bus(1_000_000)
    for k, frame in enumerate((sync, *targets, *answers)):
        bus.send(frame, k, 0.0)
    time, count = 0.0, 0
    while (event := bus.next_event()) < 1.0:
        time = event
        count += bus.take(time) is not None
    assert count == 31
    assert time == pytest.approx(took, rel=0.02)


# --- EMCY -------------------------------------------------------------------------------------------------------------
def test_the_enable_input_belongs_to_the_module_which_tells_of_it_once(wire, drives):
    """Table 380 of the TMCM-3313 has FFh in place of the motor; CiA 301 has one emergency for one event."""
    enable(wire, (0, 3))
    drives.machine.enable_input = False
    wire.wait(1)
    assert [str(frame) for frame in wire.take()] == ["085  41 54 81 00 FF 00 00 00"]
    assert states(wire) == [FAULT if axis in (0, 3) else DISABLED for axis in EACH]
    drives.machine.enable_input = True
    wire.wait(20)
    for axis in (0, 3):
        assert wire.download(0x6040 + PROFILE * axis, 0, 0x80, 2) == 0
    wire.wait(1)
    wire.take()
    enable(wire, (3,))
    wire.wait(2)
    assert states(wire)[3] == ENABLED
    wire.take()
    drives.machine.enable_input = False
    wire.wait(1)
    assert [str(frame) for frame in wire.take()] == ["085  41 54 81 00 FF 00 00 00"], "once more: another event"


# --- in real time -----------------------------------------------------------------------------------------------------
def test_a_set_of_received_pdos_of_all_axes_is_taken_in_one_cycle():
    """24 frames within a communication cycle of a node that takes time: none is lost."""
    world = World(lockstep=False)
    with EmulatedDrives("tmcm6212", "inertia", num_machines=AXES, num_threads=1) as made:
        (node,) = world.add(made, [5])
        world.power_on()
        world.run_until(0.1)
        port = lambda index, sub=0: node.dictionary.port(index, sub)  # noqa: E731
        for axis in EACH:
            for place in range(4):
                port(0x1400 + PDO * axis + place, 1).write(0x200 + 4 * axis + place)
        node.receive(Frame(0, bytes((1, 5))), world.time)
        for axis in EACH:
            frames = ("06 00", "06 00 03", "06 00 D2 04 00 00", "06 00 2E FB FF FF")
            for place, data in enumerate(frames):
                node.receive(Frame(0x200 + 4 * axis + place, bytes.fromhex(data)), world.time)
        assert [port(0x60FF + PROFILE * axis).read() for axis in EACH] == [-1234] * AXES
