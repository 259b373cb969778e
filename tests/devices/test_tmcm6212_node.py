"""The node of a TMCM-6212, as transcripts: its six axes by SDO, NMT, PDO, EMCY (manual, sections 1.1, 2.2, 2.5)."""

from __future__ import annotations

import pytest
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.cia402 import State, state_of
from drive_env.dictionary.aborts import WRONG_STATE

AXES = 6
EACH = range(AXES)
PROFILE, MOTOR, PDO = 0x800, 0x200, 0x40  # from an axis to the next
DISABLED, ENABLED, FAULT = State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED, State.FAULT


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
@pytest.mark.parametrize("axis", EACH)
def test_limit_switches_and_units_are_chosen_before_an_axis_is_enabled(wire, axis):
    assert wire.download(0x2005 + MOTOR * axis, 0, 3, 4) == 0
    enable(wire, [axis])
    assert wire.download(0x2005 + MOTOR * axis, 0, 0, 4) == WRONG_STATE
    other = (axis + 1) % AXES
    assert wire.download(0x2005 + MOTOR * other, 0, 3, 4) == 0, "that is its own affair"


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
