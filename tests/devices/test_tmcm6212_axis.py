"""What the TMCM-6212's axes do over the bus beside moving: brake, index, latch, counter, refused services, NMT."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.truth import brake_is_closed

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary

DEVICE, AXES = find_device("tmcm6212"), 6
TURN = 51_200


@pytest.fixture
def wire():
    with EmulatedDrives("tmcm6212", load="inertia", num_machines=AXES, num_threads=1) as drives:
        yield Wire(drives)


def of(index, axis):
    return index + (0x200 if index < 0x6000 else 0x800) * axis


def states(wire):
    return [int(word) & 0x4F for word in wire.drives.read(0x6041)]


def enable(wire, *axes):
    for axis in axes:
        for word in (6, 7, 15):
            assert wire.download(of(0x6040, axis), 0, word, 2) == 0


@pytest.mark.parametrize("key", ["3000:0", "3001:0"])
def test_what_no_source_explains_is_refused_with_the_reason(wire, key):
    index = int(key[:4], 16)
    assert wire.download(index, 0, 1, 4) == 0x08000020
    assert wire.value(index) == 0
    reason = DEVICE.unsupported[index, 0]
    with pytest.raises(ObjectAccessError, match=reason.split(":")[0]):
        wire.drives.write(index, 1)
    assert wire.node.dictionary.section(DEVICE.new_dictionary().find(index)) is None, "nothing to store"


def test_the_os_command_takes_none(wire):
    assert wire.download(0x1023, 1, 0x6C, 1) >= 0x06000000
    assert wire.value(0x1023, 2) == 0


def test_each_axis_has_a_brake_output_of_its_own(wire):
    for axis in (1, 4):
        assert wire.download(of(0x200C, axis), 2, 255, 1) == 0
        assert wire.download(of(0x200A, axis), 0, 20, 2) == 0
    wire.drives.machine.brake = ["open", "output", "open", "open", "output", "output"]
    enable(wire, 0, 1)
    wire.wait(100)
    assert states(wire)[:2] == [0x07, 0x07]
    np.testing.assert_array_equal(wire.drives.machine.brake_output, [0, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(brake_is_closed(wire.drives), [False, False, False, False, True, True])


def test_an_axis_homes_by_its_index_and_its_latch_and_counter_read_over_the_bus(wire):
    """Axis 2 to the left of an index at 5 rad; 200Fh and 210Bh are of the same way."""
    wire.drives.machine.set("motor.index_angle", 5.0)
    axis = 2
    speeds = (20_000, 20_000)
    assert wire.download(of(0x2005, axis), 0, 3, 4) == 0
    assert wire.download(of(0x6098, axis), 0, 33, 1) == 0
    for sub, speed in enumerate(speeds, 1):
        assert wire.download(of(0x6099, axis), sub, speed, 4) == 0
    assert wire.download(of(0x6060, axis), 0, 6, 1) == 0
    enable(wire, axis)
    assert wire.download(of(0x200F, axis), 1, 1, 1) == 0
    assert wire.download(of(0x6040, axis), 0, 0x1F, 2) == 0
    wire.wait(3_000)
    assert int(wire.drives.read(0x6041)[axis]) & 0x1400 == 0x1400
    way = 2.0 * math.pi - 5.0
    assert wire.drives.machine.rotor_angle[axis] == pytest.approx(-way, abs=0.01)
    assert wire.value(of(0x200F, axis), 1) == 0
    latched = wire.value(of(0x200F, axis), 2)
    assert latched == pytest.approx(-way * TURN / (2.0 * math.pi), abs=100)
    low, high = wire.value(of(0x210B, axis), 1), wire.value(of(0x210B, axis), 2)
    assert high == 0 and low > -latched
    assert wire.value(of(0x210B, axis), 3) == low


def test_no_object_of_the_makers_eds_is_left_out_but_those_that_nothing_explains():
    """Objects that stand in the maker's EDS alone; 300Eh has eight channels there, of which four are inputs."""
    dictionary = ObjectDictionary(DEVICE.eds)
    for index in (0x3009, 0x300B, 0x300C, 0x300F):
        assert not dictionary.has(index)
    assert not dictionary.has((0x300E, 5))


def test_a_turned_off_axis_takes_its_position_from_the_encoder_by_default():
    with EmulatedDrives("tmcm6212", load="inertia", num_threads=1) as drives:
        assert drives.read((0x200B, 3))[0] == 1
        drives.write(0x606A, 0)
        motion.enable(drives, mode="pp")
        motion.disable(drives)
        drives.machine.load_torque = 0.05
        drives.advance(0.3)
        drives.machine.load_torque = 0.0
        drives.advance(0.5)
        turned = drives.machine.rotor_angle[0] / (2.0 * math.pi) * TURN
        assert abs(turned) > 2_000
        assert drives.read(0x6062)[0] == pytest.approx(turned, abs=10)
