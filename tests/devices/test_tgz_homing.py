"""Homing of the TGZ at real switches: the ten methods of its manual, switch masks, the encoder's index, 60E3h.

A carriage on a belt has two limit switches and a home switch, of the load's row; each is wired to an input of its axis.
Home is known in closed form: the edge of the switch, or the first index beyond it.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env import EmulatedDrives, ObjectAccessError, cia402, motion
from drive_env.dictionary.aborts import VALUE_RANGE
from drive_env.firmware.record import get_lanes, set_lanes
from drive_env.motors import MOTORS

COUNT = 8
RADIUS = 0.04 / (2.0 * math.pi)  # m, of a belt of 40 mm a turn
INC = 2**20 / 0.04  # increments per metre
LEFT, RIGHT, HOME_LOW, HOME_HIGH = -0.23, 0.23, -0.06, -0.02  # m, mechanics/loads.py
NEGATIVE_MASK, POSITIVE_MASK, HOME_MASK = 0x23C0, 0x23C1, 0x23C2
REACHED, ATTAINED, ERROR = 0x0400, 0x1000, 0x2000  # statusword bits 10, 12, 13
# Manual: the method, the edge that it ends at, and the way in which it looks for the index from there.
METHODS = [
    (17, LEFT, 1.0), (18, RIGHT, -1.0), (19, HOME_LOW, -1.0), (21, HOME_HIGH, 1.0),
    (1, LEFT, 1.0), (2, RIGHT, -1.0), (3, HOME_LOW, -1.0), (5, HOME_HIGH, 1.0),
]  # fmt: skip
STARTS = np.array([-0.235, -0.15, -0.0605, -0.04, -0.0195, 0.0, 0.1, 0.235])  # around and on each switch
SLOW = 0.02  # m/s
STRETCH = 2 * 1.2 / 1.2e5  # m: breakaway friction on the belt's stiffness, one way at the edge, the other at rest
TOLERANCE = SLOW * 0.001 + STRETCH  # m: the edge is seen by the first look after it, once a millisecond
INDEX = np.linspace(0.3, 5.9, COUNT)  # rad, a rotor angle of each machine
INDEX_COUNT = 2.0 * math.pi / MOTORS["am3041_e"].encoder_counts


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives("tgz_d", "belt", num_machines=COUNT, num_threads=1, ideal=True) as made:
        yield made


@pytest.fixture
def belt(shared):
    """Eight commissioned carriages at 0 m, their masks as the factory has them."""
    shared.machine.reset()
    shared.machine.set("motor.index_angle", INDEX)
    for mask, bit in ((NEGATIVE_MASK, 0), (POSITIVE_MASK, 1), (HOME_MASK, 2)):
        shared.write(mask, [1 << bit, 8 << bit] * (COUNT // 2))
    shared.emergencies()
    return shared


def rpm(speed):
    """Return a speed [m/s] in velocity units, thousandths of rpm."""
    return round(speed / 0.04 * 60.0 * 1000.0)


def carriage(drives):
    return get_lanes(drives.inside.records, "load_position", COUNT).astype(float)


def bring(drives, positions):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", rpm(0.8))
    motion.move_to(drives, np.rint(np.asarray(positions) * INC).astype(int) + np.zeros(COUNT, int))
    np.testing.assert_allclose(carriage(drives), positions, atol=1e-3)


def home(drives, method, seconds=8.0):
    """Run a method until bit 10 of every axis, and let them rest; return the statuswords."""
    drives.write("Homing method", method)
    drives.write((0x6099, 1), rpm(0.3))
    drives.write((0x6099, 2), rpm(SLOW))
    drives.write("Homing acceleration", rpm(4.0))
    motion.enable(drives, mode="hm")
    drives.write(cia402.CONTROLWORD, 0x1F)
    for _ in range(round(seconds / 0.1)):
        drives.advance(0.1)
        if (drives.read(cia402.STATUSWORD) & REACHED != 0).all():
            break
    drives.advance(0.3)
    return drives.read(cia402.STATUSWORD)


def assert_homed(drives, method, edge, way):
    word = drives.read(cia402.STATUSWORD)
    assert (word & (REACHED | ATTAINED | ERROR) == REACHED | ATTAINED).all(), [hex(one) for one in word]
    position = drives.read(cia402.POSITION_ACTUAL)
    if method >= 17:
        np.testing.assert_allclose(carriage(drives) - position / INC, edge, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(carriage(drives), edge, rtol=0, atol=2 * TOLERANCE)
    else:
        turn = 2.0 * math.pi
        beyond = way * (INDEX - edge / RADIUS) % turn  # rad from the edge to the next index
        assert (np.minimum(beyond, turn - beyond) > 0.02).all(), "no index lies so near that friction decides"
        found = drives.machine.rotor_angle - position / 2**20 * turn
        np.testing.assert_allclose(found, edge / RADIUS + way * beyond, rtol=0, atol=2 * INDEX_COUNT + turn / 2**20)
        assert (np.abs(position) < 30).all(), "it has come back to the index"
    assert drives.emergencies() == []


@pytest.mark.every(6)
@pytest.mark.parametrize(("method", "edge", "way"), METHODS, ids=[str(row[0]) for row in METHODS])
def test_a_method_ends_where_the_manual_says_from_everywhere(belt, method, edge, way):
    bring(belt, STARTS)
    home(belt, method)
    assert_homed(belt, method, edge, way)


@pytest.mark.every(2)
@pytest.mark.parametrize(("method", "way"), [(1, -1), (2, 1), (17, -1), (18, 1), (19, 1), (21, -1)])
def test_the_initial_movement_is_the_methods(belt, method, way):
    bring(belt, 0.1)
    home(belt, method, 0.0)
    assert (way * (carriage(belt) - 0.1) > 0.02).all()


@pytest.mark.every(3)
@pytest.mark.parametrize("method", [3, 5, 19, 21])
def test_at_a_home_switch_the_initial_movement_depends_on_its_state(belt, method):
    """On the switch the axis leaves it by the edge; beside it the axis goes to it."""
    bring(belt, np.where(np.arange(COUNT) < 4, -0.04, 0.05 if method in (5, 21) else -0.12))
    belt.write((0x6099, 2), rpm(SLOW))
    home(belt, method, 0.0)
    moved = carriage(belt) - np.where(np.arange(COUNT) < 4, -0.04, 0.05 if method in (5, 21) else -0.12)
    way = -1.0 if method in (3, 19) else 1.0
    assert (way * moved[:4] > 0.002).all()
    assert (way * moved[4:] < -0.002).all()


@pytest.mark.parametrize(("method", "mask", "edge"), [(17, NEGATIVE_MASK, HOME_HIGH), (18, POSITIVE_MASK, HOME_LOW)])
def test_the_mask_says_which_input_a_switch_is(belt, method, mask, edge):
    """With the bit of the home switch's input a limit switch is where that one is."""
    bring(belt, 0.1 if method == 17 else -0.15)
    belt.write(mask, [4, 32] * (COUNT // 2))
    home(belt, method)
    assert_homed(belt, method, edge, 0.0)


def test_an_input_that_a_mask_does_not_name_is_no_switch(belt):
    """The home switch is looked for at an input that nothing presses: the limit switches turn and end the search."""
    bring(belt, 0.1)
    belt.write(HOME_MASK, 0x80)
    word = home(belt, 19)
    assert (word & (REACHED | ATTAINED) == REACHED).all()
    assert (carriage(belt) < LEFT + 0.02).all()
    belt.write(cia402.CONTROLWORD, 0x0F)
    bring(belt, 0.0)
    belt.machine.digital_inputs = 0x80  # pressed by hand
    home(belt, 19, 0.0)
    belt.machine.digital_inputs = 0
    belt.advance(0.5)
    assert (belt.read(cia402.STATUSWORD) & (REACHED | ATTAINED) == REACHED | ATTAINED).all()
    assert (np.abs(carriage(belt)) < 0.01).all()


def test_an_index_that_was_just_passed_comes_a_turn_later(belt):
    bring(belt, 0.0)
    belt.machine.set("motor.index_angle", HOME_HIGH / RADIUS - 0.05)  # behind the edge, where the search begins
    word = home(belt, 5)
    assert (word & ATTAINED != 0).all()
    assert np.abs(carriage(belt) - (HOME_HIGH + 0.04 - 0.05 * RADIUS)).max() < TOLERANCE


def test_a_limit_switch_before_the_index_ends_the_search(belt):
    bring(belt, 0.0)
    set_lanes(belt.inside.records, "switch_low", np.full(COUNT, HOME_HIGH + 0.01), part=1)
    belt.machine.set("motor.index_angle", HOME_HIGH / RADIUS + 3.0)  # 19 mm beyond the edge
    word = home(belt, 5)
    set_lanes(belt.inside.records, "switch_low", np.full(COUNT, RIGHT), part=1)
    assert (word & (REACHED | ATTAINED) == REACHED).all()
    np.testing.assert_allclose(carriage(belt), HOME_HIGH + 0.01, atol=1e-3)


def test_home_offset_is_the_position_that_home_has(belt):
    bring(belt, 0.0)
    belt.write("Home offset", 4000)
    home(belt, 21)
    zero = carriage(belt) - belt.read(cia402.POSITION_ACTUAL) / INC
    np.testing.assert_allclose(zero - 4000 / INC, HOME_HIGH, rtol=0, atol=TOLERANCE)
    belt.write("Home offset", 0)


def test_60e3h_lists_the_methods_that_6098h_takes(belt):
    """Sub-index 0 their number, sub-indices 1 to 10 their values; of both axes."""
    listed = [belt.read((cia402.HOMING_METHODS, sub)) for sub in range(11)]
    assert (listed[0] == 10).all()
    values = sorted(int(one[0]) for one in listed[1:])
    assert values == [1, 2, 3, 5, 17, 18, 19, 21, 35, 37]
    assert all((one == one[0]).all() for one in listed)
    taken = []
    for method in range(-128, 128):
        try:
            belt.write("Homing method", method)
        except ObjectAccessError as error:
            assert error.abort_code in (VALUE_RANGE, VALUE_RANGE + 1, VALUE_RANGE + 2)
        else:
            taken.append(method)
    assert taken == values
