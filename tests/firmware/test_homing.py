"""Homing on a belt axis with two limit switches and a home switch: section 8 of the TMCM-1636 manual."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.dictionary.homing_methods import METHODS, PLACES, SKETCHES
from drive_env.firmware.record import get_lanes, set_lanes

COUNT = 16  # axes side by side, one per start region
TURN = 0.006366 * 2.0 * np.pi  # m of belt per turn
INC = 65536 / TURN  # increments per metre
ENCODER_COUNT = TURN / 4096  # m
LEFT, RIGHT, HOME_LOW, HOME_HIGH = -0.23, 0.23, -0.06, -0.02  # m, mechanics/loads.py
EDGES = {17: LEFT, 18: RIGHT, 19: HOME_LOW, 21: HOME_HIGH}

FAST, SLOW, ACCELERATION = 0.2, 0.02, 4.0  # m/s, m/s^2
STRETCH = 2 * 1.2 / 1.2e5  # m: breakaway friction on the belt's stiffness, one way at the edge, the other at rest
# The edge is seen by the first look, once a millisecond, after it was passed at the slow speed; one encoder count when
# it is seen, one when the axis is read at rest: 0.06 mm.
TOLERANCE = SLOW * 0.001 + 2 * ENCODER_COUNT + STRETCH

REACHED, ATTAINED, ERROR = 0x0400, 0x1000, 0x2000  # statusword bits 10, 12, 13

# Outside, on and just beside each switch, and between them.
STARTS = np.array(
    [-0.245, -0.232, -0.2295, -0.15, -0.0605, -0.0595, -0.05, -0.04, -0.03, -0.0205, -0.0195, 0.0, 0.1, 0.2295, 0.232,
     0.245]
)  # fmt: skip


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="belt", num_machines=COUNT, num_threads=1) as made:
        yield made


@pytest.fixture
def belt(shared):
    """Sixteen commissioned belt axes at 0 m in switch on disabled, limit switches on."""
    shared.machine.reset()
    set_home_switch(shared, np.full(COUNT, HOME_LOW), np.full(COUNT, HOME_HIGH))
    shared.emergencies()
    return shared


def set_home_switch(drives, low, high):
    set_lanes(drives.inside.records, "switch_low", low, part=2)
    set_lanes(drives.inside.records, "switch_high", high, part=2)


def carriage(drives):
    return get_lanes(drives.inside.records, "load_position", COUNT).astype(float)


def zero(drives):
    """Where on the axis [m] position 0 lies."""
    return carriage(drives) - drives.read(0x6064) / INC


def set_up(drives, method, *, fast=FAST, slow=SLOW, acceleration=ACCELERATION):
    drives.write(0x6098, method)
    drives.write((0x6099, 1), round(fast * INC))
    drives.write((0x6099, 2), round(slow * INC))
    drives.write(0x609A, round(acceleration * INC))


def bring(drives, positions, settings=0):
    """Put the carriages to positions [m], past the limit switches if need be; then 2005h gets `settings`."""
    drives.write(0x2005, 3)
    drives.write(0x6081, round(0.5 * INC))
    motion.enable(drives, "pp")
    motion.move_to(drives, np.rint(np.asarray(positions) * INC).astype(int) + np.zeros(COUNT, int))
    drives.advance(0.3)
    motion.disable(drives)
    drives.write(0x2005, settings)


def start(drives):
    motion.enable(drives, "hm")
    drives.write(0x6040, 0x1F)


def wait(drives, seconds=8.0):
    """Let time pass until bit 10 of every axis, then until they rest."""
    for _ in range(round(seconds / 0.05)):
        drives.advance(0.05)
        if (drives.read(0x6041) & REACHED != 0).all():
            break
    drives.advance(0.4)
    return drives.read(0x6041)


def assert_homed(drives, edge):
    word = drives.read(0x6041)
    assert (word & (REACHED | ATTAINED | ERROR) == REACHED | ATTAINED).all(), [hex(w) for w in word]
    np.testing.assert_allclose(zero(drives), edge, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(carriage(drives), edge, rtol=0, atol=TOLERANCE + 5 * ENCODER_COUNT)
    assert [m for m in drives.emergencies() if m.code] == [], "limit switches are what homing looks for"


# --- the manual's recipe ----------------------------------------------------------------------------------------------
def test_recipe_of_section_8_3_homes_a_commissioned_drive_by_a_switch_that_is_pressed_by_hand():
    """Word for word; the preset has what the recipe does not name, the acceleration 609Ah."""
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        set_lanes(drives.inside.records, "wired", np.array([4]))  # the home switch; 2005h has the limit switches off
        released, pressed = (np.array([np.inf]), np.array([np.inf])), (np.array([-np.inf]), np.array([np.inf]))
        set_home_switch(drives, *released)
        drives.write(0x6060, 6)
        drives.write(0x6040, 6)
        drives.write(0x6040, 7)
        drives.write(0x6040, 15)
        drives.write(0x6098, 19)
        drives.write((0x6099, 1), 50_000)
        drives.write((0x6099, 2), 10_000)
        drives.write(0x6040, 31)
        drives.advance(1.0)
        word, before = drives.read(0x6041)[0], drives.read(0x6064)[0]
        assert word & (REACHED | ATTAINED | ERROR) == 0
        assert before == pytest.approx(50_000, rel=0.1), "the switch is searched with the fast speed"
        set_home_switch(drives, *pressed)
        drives.advance(0.5)
        set_home_switch(drives, *released)
        drives.advance(1.0)
        assert drives.read(0x6041)[0] & (REACHED | ATTAINED | ERROR) == REACHED | ATTAINED
        assert abs(drives.read(0x6064)[0]) < 200
        drives.write(0x6040, 15)
        assert drives.read(0x6041)[0] & 0x6F == 0x27
        assert drives.emergencies() == []


# --- table 209: from everywhere to the edge ---------------------------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize("method", [17, 18, 19, 21])
def test_every_method_ends_at_its_edge_from_every_region_at_rest(belt, method):
    bring(belt, STARTS)
    set_up(belt, method)
    start(belt)
    wait(belt)
    assert_homed(belt, EDGES[method])


@pytest.mark.every(6)
@pytest.mark.parametrize("direction", [-1, 1])
@pytest.mark.parametrize("method", [17, 18, 19, 21])
def test_every_method_ends_at_its_edge_from_every_region_while_moving(belt, method, direction):
    """The mode changes from pv and bit 4 rises at once; the axis brakes with the homing acceleration."""
    run_up = 0.0165  # m, until homing is started
    starts = np.array([-0.2295, -0.2, -0.07, -0.0605, -0.0595, -0.058, -0.05, -0.04, -0.03, -0.022, -0.0205, -0.0195,
                       -0.015, 0.1, 0.2, 0.2295])  # fmt: skip
    bring(belt, starts - direction * run_up)
    set_up(belt, method)
    motion.enable(belt, "pv")
    belt.write(0x60FF, direction * round(FAST * INC))
    belt.advance(0.1)
    between = np.abs(starts) < 0.21
    assert (direction * belt.read(0x606C)[between] > 0.9 * FAST * INC).all()
    np.testing.assert_allclose(carriage(belt)[between], starts[between], rtol=0, atol=3e-3)
    belt.emergencies()  # a limit switch stopped pv
    belt.write(0x6060, 6)
    belt.write(0x6040, 0x1F)
    wait(belt)
    assert_homed(belt, EDGES[method])


@pytest.mark.every(3)
@pytest.mark.parametrize("method", [19, 21])
@pytest.mark.parametrize("from_right", [False, True])
def test_a_cam_of_any_width_gives_the_same_edge_whatever_braking_does(belt, method, from_right):
    """Braking from the fast speed takes about 10 mm: narrow cams are crossed, wide ones are not."""
    width = np.linspace(0.002, 0.032, COUNT)
    low = -0.04 - 0.5 * width
    set_home_switch(belt, low, low + width)
    bring(belt, 0.1 if from_right else -0.15)
    set_up(belt, method)
    start(belt)
    wait(belt)
    assert_homed(belt, low if method == 19 else low + width)


@pytest.mark.parametrize(("method", "way"), [(17, -1), (18, 1), (19, 1), (21, -1)])
def test_the_search_begins_in_the_methods_direction_at_the_fast_speed_on_the_ramp(belt, method, way):
    bring(belt, 0.0)
    set_up(belt, method)
    motion.enable(belt, "hm")
    # The rising edge starts it; the ramp of ACCELERATION takes 50 ms.
    trace = belt.record([0x6062], 0.1, play={0x6040: np.r_[0x0F, np.full(99, 0x1F)]})
    speed = np.diff(trace[0x6062], axis=0) * 1000 / INC * way
    assert (np.abs(speed[0]) < 1e-6).all()
    np.testing.assert_allclose(speed[1:51].mean(0), 0.5 * FAST, rtol=0.02)
    np.testing.assert_allclose(np.diff(speed[2:49], axis=0), ACCELERATION * 0.001, atol=0.0015)
    np.testing.assert_allclose(speed[60:], FAST, rtol=0.01)


def test_a_home_search_that_leads_away_turns_round_at_the_limit_switch(belt):
    bring(belt, 0.1)
    set_up(belt, 19)
    start(belt)
    path = []
    for _ in range(60):
        belt.advance(0.05)
        path.append(carriage(belt))
    path = np.array(path)
    assert (path.max(0) > RIGHT - 0.005).all()
    assert (path.max(0) < RIGHT + 0.018).all(), "it does not reach the end stop"
    wait(belt)
    assert_homed(belt, HOME_LOW)


def test_the_edge_is_sought_at_the_slow_speed(belt):
    bring(belt, -0.04)
    set_up(belt, 19)
    start(belt)
    belt.advance(0.2)
    np.testing.assert_allclose(
        np.diff(belt.record([0x6062], 0.2)[0x6062], axis=0).mean(0), -SLOW * INC / 1000, rtol=1e-3
    )


@pytest.mark.parametrize("slow", [0.005, 0.05])
def test_the_error_of_the_edge_grows_with_the_slow_speed_and_never_beyond_a_cycle_of_it(belt, slow):
    # A phase of the millisecond grid per axis.
    bring(belt, -0.05 + np.arange(COUNT) * slow * 0.001 / COUNT)
    set_up(belt, 21, slow=slow)
    start(belt)
    wait(belt, 12.0)
    late = zero(belt) - HOME_HIGH
    assert late.max() < slow * 0.001 + 2 * ENCODER_COUNT + STRETCH
    assert late.min() > -2 * ENCODER_COUNT - STRETCH


# --- CiA 402-2: methods that the TMCM-1636 lacks, of drives that are known by their EDS -------------------------------
# Method without an index, which way it searches, the edge, and the way in which that is passed in the end; the same
# method with an index has 16 less, and looks for it that way.
STANDARD = [
    (17, -1, LEFT, 1), (18, 1, RIGHT, -1),
    (19, 1, HOME_LOW, -1), (20, 1, HOME_LOW, 1), (21, -1, HOME_HIGH, 1), (22, -1, HOME_HIGH, -1),
    (23, 1, HOME_LOW, -1), (24, 1, HOME_LOW, 1), (25, 1, HOME_HIGH, -1), (26, 1, HOME_HIGH, 1),
    (27, -1, HOME_HIGH, 1), (28, -1, HOME_HIGH, -1), (29, -1, HOME_LOW, 1), (30, -1, HOME_LOW, -1),
    (23, 1, HOME_LOW, -1), (30, -1, HOME_LOW, -1),
]  # fmt: skip
NUMBERS, WAYS, ENDS, LAST_WAYS = (np.array(column) for column in zip(*STANDARD, strict=True))


@pytest.mark.every(6)
@pytest.mark.parametrize("with_index", [False, True])
@pytest.mark.parametrize("where", [-0.15, -0.0605, -0.04, -0.0195, 0.1])
def test_each_method_of_the_standard_ends_at_its_edge_or_at_the_index_beyond_it(belt, where, with_index):
    """An axis for each method: left of the home switch, at its edges, on it, right of it."""
    radius = TURN / (2.0 * np.pi)
    index = 2.0  # rad
    belt.machine.set("motor.index_angle", index)
    bring(belt, where)
    set_up(belt, 17)
    set_lanes(belt.inside.records, "homing_method", NUMBERS - (16 if with_index else 0))
    start(belt)
    belt.advance(0.05)
    moved = carriage(belt) - where
    if where in (-0.15, 0.1):  # beside the home switch
        assert (WAYS * moved > 5e-4).all()
    wait(belt)
    word = belt.read(0x6041)
    assert (word & (REACHED | ATTAINED) == REACHED | ATTAINED).all(), dict(zip(NUMBERS, word, strict=True))
    assert belt.emergencies() == []
    if not with_index:
        np.testing.assert_allclose(zero(belt), ENDS, rtol=0, atol=TOLERANCE)
        return
    beyond = LAST_WAYS * (index - ENDS / radius) % (2.0 * np.pi)
    assert (np.minimum(beyond, 2.0 * np.pi - beyond) > 0.1).all()
    angle = belt.machine.rotor_angle - belt.read(0x6064) / 65536 * 2.0 * np.pi
    np.testing.assert_allclose(angle, ENDS / radius + LAST_WAYS * beyond, rtol=0, atol=3 * 2.0 * np.pi / 4096)


@pytest.mark.parametrize("width", [0.002, 0.03])
def test_a_narrow_cam_gives_each_method_the_same_edges(belt, width):
    """Braking from the fast speed crosses a cam of 2 mm, and not one of 30 mm."""
    low, high = -0.04 - 0.5 * width, -0.04 + 0.5 * width
    set_home_switch(belt, np.full(COUNT, low), np.full(COUNT, high))
    bring(belt, np.where(np.arange(COUNT) % 2 == 0, -0.15, 0.1))
    set_up(belt, 17)
    set_lanes(belt.inside.records, "homing_method", NUMBERS)
    start(belt)
    wait(belt)
    ends = np.where(ENDS == HOME_LOW, low, np.where(ENDS == HOME_HIGH, high, ENDS))
    assert (belt.read(0x6041) & ATTAINED != 0).all()
    np.testing.assert_allclose(zero(belt), ends, rtol=0, atol=TOLERANCE)


def test_a_method_whose_edge_does_not_exist_fails_at_the_limit_switch(belt):
    """A home switch that is active up to the right end has no right edge."""
    set_home_switch(belt, np.full(COUNT, -0.04), np.full(COUNT, 1.0))
    bring(belt, 0.0)
    set_up(belt, 17)
    set_lanes(belt.inside.records, "homing_method", NUMBERS)
    start(belt)
    wait(belt, 16.0)
    word = belt.read(0x6041)
    homed = (ENDS == LEFT) | (ENDS == RIGHT) | (ENDS == HOME_LOW)
    np.testing.assert_array_equal(word & ATTAINED != 0, homed)
    assert (word & REACHED != 0).all()
    assert (np.abs(carriage(belt)) < 0.25).all()


# --- 2005h ------------------------------------------------------------------------------------------------------------
def test_deactivated_home_switch_both_limits_hit_is_the_documented_error(belt):
    bring(belt, np.linspace(-0.2, 0.2, COUNT), settings=0x10)
    for method in (19, 21):
        set_up(belt, method)
        start(belt)
        word = wait(belt)
        assert (word & (REACHED | ATTAINED | ERROR) == REACHED).all()
        at = carriage(belt)
        assert (np.abs(at) < 0.25).all()
        assert (at < LEFT + 0.02).all() if method == 19 else (at > RIGHT - 0.02).all()
        before = at
        belt.advance(0.2)
        np.testing.assert_allclose(carriage(belt), before, atol=1e-4)
        assert (belt.read(0x2140) == 0).all()
        belt.write(0x6040, 0x0F)
        motion.disable(belt)


def test_an_inverted_home_switch_homes_on_the_same_flank_the_other_way_round(belt):
    """With bit 5 of 2005h the switch is active outside the cam: method 19 seeks the end of the cam seen from left."""
    bring(belt, -0.04, settings=0x20)
    set_up(belt, 19)
    start(belt)
    wait(belt)
    assert_homed(belt, HOME_HIGH)


# --- statusword, start and stop by bit 4 (tables 211 and 217) ---------------------------------------------------------
def test_bits_10_and_12_are_clear_while_homing_and_set_together_at_the_end(belt):
    bring(belt, STARTS)
    set_up(belt, 17)
    motion.enable(belt, "hm")
    assert (belt.read(0x6041) & ATTAINED == 0).all()
    belt.write(0x6040, 0x1F)
    trace = belt.record([0x6041, 0x6062], 8.0, period=0.001)
    reached, attained = trace[0x6041] & REACHED != 0, trace[0x6041] & ATTAINED != 0
    assert not reached[0].any()
    assert not attained[0].any()
    assert (trace[0x6041] & ERROR == 0).all(), "homing error is not supported"
    np.testing.assert_array_equal(reached, attained)
    assert (np.diff(reached.astype(int), axis=0) >= 0).all(), "once homed, homed"
    assert reached[-1].all()
    # They rise when the demand is back at the edge.
    first = reached.argmax(0)
    for axis in range(COUNT):
        assert (trace[0x6062][first[axis] :, axis] == 0).all()


def test_falling_bit_4_stops_homing_and_bit_10_tells_when_at_rest(belt):
    bring(belt, 0.1)
    set_up(belt, 17)
    start(belt)
    belt.advance(0.3)
    trace = belt.record([0x6041, 0x6062], 0.2, play={0x6040: np.full(200, 0x0F)})
    moving = np.diff(trace[0x6062], axis=0) != 0
    reached = trace[0x6041] & REACHED != 0
    braking = round(FAST / ACCELERATION * 1000)
    assert moving[: braking - 2].all()
    assert not reached[: braking - 2].any()
    assert not moving[braking + 2 :].any()
    assert reached[braking + 2 :].all()
    assert (trace[0x6041] & (ATTAINED | ERROR) == 0).all()
    assert (belt.read(0x2140) == 0).all()
    # A new edge starts anew.
    belt.write(0x6040, 0x1F)
    assert (belt.read(0x6041) & REACHED == 0).all()
    wait(belt)
    assert_homed(belt, LEFT)


def test_bit_4_back_to_0_after_homing_keeps_home_attained_and_a_new_edge_homes_again(belt):
    bring(belt, -0.1)
    set_up(belt, 17)
    start(belt)
    wait(belt)
    belt.write(0x6040, 0x0F)
    belt.advance(0.05)
    assert_homed(belt, LEFT)
    belt.write(0x6040, 0x1F)
    belt.advance(0.002)
    assert (belt.read(0x6041) & (REACHED | ATTAINED) == 0).all()
    wait(belt)
    assert_homed(belt, LEFT)


def test_leaving_the_mode_ends_homing_without_an_edge_and_the_axis_holds(belt):
    bring(belt, 0.1)
    set_up(belt, 17)
    start(belt)
    belt.advance(0.3)
    belt.write(0x6060, 1)
    belt.advance(0.3)
    at = carriage(belt)
    belt.advance(0.3)
    np.testing.assert_allclose(carriage(belt), at, atol=1e-4)
    belt.write(0x6040, 0x0F)
    belt.write(0x6060, 6)
    belt.advance(0.01)
    assert (belt.read(0x6041) & ATTAINED == 0).all()
    assert (belt.read(0x2140) == 0).all()


def test_disabled_while_homing_nothing_goes_on_after_enabling(belt):
    bring(belt, 0.1)
    set_up(belt, 17)
    start(belt)
    belt.advance(0.3)
    motion.disable(belt)
    belt.advance(0.3)
    motion.enable(belt, "hm")  # bit 4 is 0
    at = carriage(belt)
    belt.advance(0.3)
    np.testing.assert_allclose(carriage(belt), at, atol=2e-4)
    assert (belt.read(0x6041) & ATTAINED == 0).all()


# --- what is refused or cannot be -------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", [-4, 1, 2, 16, 20, 22, 23, 33, 34, 36, 37, 127])
def test_methods_that_table_209_does_not_list_are_refused(belt, method):
    with pytest.raises(ObjectAccessError) as refused:
        belt.write(0x6098, method)
    assert refused.value.abort_code == (0x06090032 if method < 0 else 0x06090031 if method > 35 else 0x06090030)


@pytest.mark.parametrize("missing", ["method 0", "fast", "slow", "acceleration", "factory"])
def test_without_a_method_or_a_speed_it_ends_at_once_and_nothing_moves(belt, missing):
    bring(belt, 0.1)
    set_up(belt, 0 if missing == "method 0" else 17)
    if missing in ("fast", "factory"):
        belt.write((0x6099, 1), 0)
    if missing in ("slow", "factory"):
        belt.write((0x6099, 2), 0)
    if missing in ("acceleration", "factory"):
        belt.write(0x609A, 0)
    motion.enable(belt, "hm")
    belt.advance(0.1)
    at = belt.read(0x6062)
    belt.write(0x6040, 0x1F)
    belt.advance(0.2)
    assert (belt.read(0x6041) & (REACHED | ATTAINED | ERROR) == REACHED).all()
    np.testing.assert_array_equal(belt.read(0x6062), at)
    np.testing.assert_allclose(carriage(belt), 0.1, atol=5e-4)


# --- method 35 --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("enabled", [False, True])
def test_method_35_takes_the_present_position_for_zero_and_does_not_move(belt, enabled):
    bring(belt, STARTS, settings=0x3)
    belt.write(0x6098, 35)  # speeds are 0
    if enabled:
        motion.enable(belt, "hm")
    else:
        motion.select_mode(belt, "hm")
    belt.advance(0.2)
    before = belt.read(0x6064)
    at = carriage(belt)
    belt.write(0x6040, 0x1F if enabled else 0x10)
    for name in (0x6062, 0x6063, 0x6064):
        np.testing.assert_array_equal(belt.read(name), 0)
    assert (belt.read(0x6041) & (REACHED | ATTAINED) == REACHED | ATTAINED).all()
    trace = belt.record([0x6062, 0x6064], 0.2)
    assert (np.abs(trace[0x6062]) <= (0 if enabled else 1 * 32)).all()
    assert (np.abs(trace[0x6064]) <= 3 * 16).all()
    np.testing.assert_allclose(carriage(belt), at, atol=2e-5)
    np.testing.assert_array_equal(belt.read(0x2140), np.rint(before / 16))


# --- home offset and limits -------------------------------------------------------------------------------------------
def test_home_offset_makes_the_position_at_the_edge_minus_607c(belt):
    """Zero position = home position + home offset (figure 10)."""
    offset = np.linspace(-100_000, 100_000, COUNT).astype(int)
    bring(belt, -0.1)
    set_up(belt, 19)
    belt.write(0x607C, offset)
    start(belt)
    wait(belt)
    assert (belt.read(0x6041) & ATTAINED != 0).all()
    np.testing.assert_array_equal(belt.read(0x6062), -offset)
    np.testing.assert_allclose(zero(belt) - offset / INC, HOME_LOW, rtol=0, atol=TOLERANCE)


def test_2140h_tells_home_in_encoder_increments_without_607ch(belt):
    """2140h: home on the counter that began at 0 where the carriage was at power-on, whatever value it was given."""
    offset = np.linspace(-100_000, 100_000, COUNT).astype(int)
    bring(belt, -0.1)
    assert (belt.read(0x2140) == 0).all()
    set_up(belt, 19)
    belt.write(0x607C, offset)
    start(belt)
    wait(belt)
    np.testing.assert_allclose(belt.read(0x2140), HOME_LOW / ENCODER_COUNT, atol=TOLERANCE / ENCODER_COUNT + 2)
    start(belt)  # homed again it is the same place, although the position's zero has moved meanwhile
    wait(belt)
    np.testing.assert_allclose(belt.read(0x2140), HOME_LOW / ENCODER_COUNT, atol=TOLERANCE / ENCODER_COUNT + 2)
    belt.machine.power_cycle()
    assert (belt.read(0x2140) == 0).all()


SLOW_DOWN, QUICK_STOP, DISABLE = 5, 0x0B, 0x07


@pytest.mark.parametrize(("option", "word"), [(SLOW_DOWN, QUICK_STOP), (2, DISABLE)])
@pytest.mark.parametrize("acceleration", [2.0, 4.0])
def test_stops_on_the_slow_down_ramp_use_609ah(belt, option, word, acceleration):
    """Tables 115, 121: the slow down ramp is the deceleration of the mode; section 8.2.7: in homing that is 609Ah."""
    bring(belt, 0.1)
    set_up(belt, 17, acceleration=acceleration)
    belt.write(0x605A, option)
    start(belt)
    belt.advance(0.2)  # at the fast speed
    belt.write(0x6040, word)
    demand = belt.record([0x6062], 0.04)[0x6062] / INC
    slowing = np.diff(demand, 2, axis=0)[2:] / 0.001**2
    np.testing.assert_allclose(slowing, acceleration, rtol=0, atol=4.0 / INC / 0.001**2)  # whole increments
    belt.write(0x6040, 0x00)


def test_software_limits_are_ignored_while_homing_and_corrected_by_the_home_offset_after_it(belt):
    bring(belt, 0.1)
    set_up(belt, 17)
    low, high, offset = round(0.05 * INC), round(0.2 * INC), round(0.01 * INC)
    belt.write((0x607D, 1), low)
    belt.write((0x607D, 2), high)
    belt.write(0x607C, offset)
    start(belt)
    wait(belt)
    assert (belt.read(0x6041) & (REACHED | ATTAINED) == REACHED | ATTAINED).all()
    np.testing.assert_allclose(zero(belt) - offset / INC, LEFT, rtol=0, atol=TOLERANCE)
    assert belt.emergencies() == []
    belt.write(0x6040, 0x0F)
    belt.write(0x6060, 1)
    motion.move_to(belt, 10_000_000)
    # Corrected limit = limit - home offset (section 6.1.11).
    np.testing.assert_array_equal(belt.read(0x6062), high - offset)
    assert (belt.read(0x6041) & 0x0800 != 0).all()


def test_limit_switches_stop_the_axis_again_in_other_modes(belt):
    bring(belt, 0.0)
    set_up(belt, 17)
    start(belt)
    wait(belt)
    belt.write(0x6040, 0x0F)
    belt.write(0x6060, 3)
    belt.write(0x60FF, round(-0.1 * INC))
    belt.advance(0.5)
    assert (belt.read(0x6041) & 0x0800 != 0).all()
    assert {message.name for message in belt.emergencies()} == {"negative_limit_switch"}
    assert (carriage(belt) > -0.25).all()
    belt.write(0x60FF, round(0.1 * INC))
    belt.advance(0.5)
    assert (carriage(belt) > LEFT + 0.01).all()


@pytest.mark.every(3)
@pytest.mark.parametrize(("method", "begins"), [(17, 0.0), (18, 0.0), (19, -0.15), (21, 0.1)])
def test_the_sketch_of_a_method_turns_round_as_the_axis_does(belt, method, begins):
    """Its legs, and on which side of its switch it begins; 0.002 m are what settling may be."""
    bring(belt, np.full(COUNT, begins))
    set_up(belt, method)
    start(belt)
    seen = [carriage(belt)[0]]
    for _ in range(600):
        belt.advance(0.01)
        if abs(carriage(belt)[0] - seen[-1]) > 0.002:
            seen.append(carriage(belt)[0])
    legs = [way for k, way in enumerate(np.sign(np.diff(seen))) if k == 0 or way != np.sign(np.diff(seen))[k - 1]]
    sketch = SKETCHES[method]
    assert legs == list(np.sign(np.diff(sketch.way)))
    low, high = PLACES[sketch.switch]
    assert sketch.way[-1] in (low, high) and not low <= sketch.way[0] <= high


def test_every_method_that_is_described_has_a_sketch_that_ends_at_its_edge_or_index():
    assert set(SKETCHES) == set(METHODS) | {-1, -2, -3, -4}
    for method in range(1, 15):
        with_index, edge = SKETCHES[method], SKETCHES[method + 16]
        assert with_index.has_index and with_index.way[:-1] == edge.way
        assert np.sign(with_index.way[-1] - edge.way[-1]) == np.sign(edge.way[-1] - edge.way[-2])
