"""The limits that hold now: read once and again when something changed, capped by the quick stop's ramp, and lent."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.held_objects import CURRENT_LIMIT, HeldObjects

from drive_env import Limits
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.lending import Lending
from drive_env.safety.limits_in_force import LimitsInForce, bound_text

TURN = 65536
POSITION, VELOCITY, BRAKING, RESOLUTION = (0x6064, 0), (0x606C, 0), (0x6085, 0), (0x608F, 1)
LOW, HIGH, OFFSET = (0x607D, 1), (0x607D, 2), (0x607C, 0)
WINDOW, FASTEST, FASTEST_MOTOR = (0x6065, 0), (0x607F, 0), (0x6080, 0)
SLACK = 200 + 1311  # inc beyond a limit that are no leaving: SETTLED, and SLACK_TURNS of this scale


def in_force(limits=None, values=None, *, scale=TURN, num_axes=1, is_armed=False, **options):
    """Limits of drives that are at 0, and the drives."""
    there = {POSITION: 0, VELOCITY: 0, BRAKING: 1000 * TURN, RESOLUTION: scale, (0x608F, 2): 1} | (values or {})
    drives = HeldObjects(there, num_axes, own=lambda key, axis, found: lending.own(key, axis, found), **options)
    lending, axes = Lending(drives), Axes(drives)
    made = LimitsInForce(limits or Limits(), drives, axes, lending)
    axes.is_armed = is_armed
    return made, drives, axes


def lent(limits, values, **options):
    """What drives have while limits are lent to them, by object."""
    made, drives, _ = in_force(limits, values, **options)
    made.lend()
    return {key: value for key, _, value in drives.log}


def test_an_end_of_a_range_for_a_message():
    assert [bound_text(np.int64(x)) for x in (5, -5, NO_LIMIT, -NO_LIMIT, NO_LIMIT - 1)] == [
        "5", "-5", "(none)", "(none)", str(NO_LIMIT - 1)
    ]  # fmt: skip


# --- how fast: no faster than a quick stop brings to rest within a second -----------------------------------------
@pytest.mark.parametrize(
    ("braking", "own", "allowed"),
    [
        (0, 5000, 5000),  # it is not known
        (4999, 5000, 4999),
        (5000, 5000, 5000),
        (5001, 5000, 5000),
        (5001, 0, 5001),  # 607Fh = 0 is none
        (200 * TURN, 0, 100 * TURN),
    ],
)
def test_no_axis_is_faster_than_its_quick_stop_brings_to_rest_within_a_second(braking, own, allowed):
    made, _, _ = in_force(None, {BRAKING: braking, FASTEST: own})
    assert made.bounds().velocity == allowed


def test_a_ramp_in_rpm_per_second_caps_a_speed_in_rpm():
    made, _, _ = in_force(None, {BRAKING: 300}, units={0x606C: "rpm", 0x6085: "rpm/s"})
    assert made.bounds().velocity == 300
    made, _, _ = in_force(None, {BRAKING: 300}, units={0x606C: "", 0x6085: ""})
    assert made.bounds().velocity == NO_LIMIT


# --- read once, and again -----------------------------------------------------------------------------------------
def test_limits_are_read_once_until_something_changes():
    made, drives, _ = in_force(None, {FASTEST: 500})
    made.place()
    first = made.bounds()
    drives.values[FASTEST][:] = 400
    assert made.bounds() is first and first.velocity == 500
    made.forget()
    assert made.latest is None
    assert made.bounds().velocity == 400


def test_what_changed_while_it_was_read_is_read_again():
    """Another thread had something written meanwhile: what was read may be of before."""
    made, drives, _ = in_force(None, {FASTEST: 500})
    made.place()
    read = drives.read_entry

    def read_entry(entry):
        made.forget()
        return read(entry)

    drives.read_entry = read_entry
    made.bounds()
    assert made.latest is None
    drives.read_entry = read
    made.bounds()
    assert made.latest is not None


@pytest.mark.parametrize("limits", [Limits(), Limits(current=5.0)])
def test_without_limits_of_places_or_speeds_the_rotors_need_not_be_placed(limits):
    made, _, axes = in_force(limits)
    assert not axes.rotor.is_placed
    made.bounds()
    assert axes.rotor.is_placed


@pytest.mark.parametrize(
    "limits", [Limits(position=(-1, 1)), Limits(velocity=1.0), Limits(following_error=1.0)], ids=str
)
def test_a_limit_that_a_scale_moves_is_taken_at_the_scale_of_now(limits):
    assert in_force(limits)[2].rotor.is_placed


def test_a_scale_that_nobody_knows_is_read_before_a_limit_is_used_again_and_once():
    made, drives, _ = in_force(Limits(position=(-TURN, TURN)))
    drives.values[RESOLUTION][:] = 2 * TURN
    made.forget()
    assert made.bounds().high == TURN  # nobody wrote it
    made.place_again()
    assert made.bounds().high == 2 * TURN
    drives.values[RESOLUTION][:] = 4 * TURN
    made.forget()
    assert made.bounds().high == 2 * TURN


def test_a_rotor_keeps_its_place_while_its_scale_and_zero_are_written():
    made, drives, axes = in_force(Limits(position=(-TURN, TURN)), {POSITION: TURN // 2})
    made.keep_place()
    drives.values[RESOLUTION][:], drives.values[POSITION][:] = TURN // 2, 0  # zero at the rotor's place
    made.place()
    assert axes.rotor.turns(axes.position) == 0.0  # half a turn is where the drives were opened
    assert (made.bounds().low, made.bounds().high) == (-TURN * 3 // 4, TURN // 4)


def test_a_drive_that_tells_no_position_is_taken_to_be_at_0():
    made, drives, axes = in_force()
    del drives.entries[POSITION]
    for act in (made.place, made.keep_place):
        axes.position[:] = 5
        act()
        assert axes.position == 0


def test_other_limits_are_places_of_the_rotor_as_it_is_now():
    made, drives, _ = in_force(Limits(position=(-100, 100)))
    drives.values[POSITION][:] = 40
    made.change(Limits(position=(-100, 100), velocity=7.0))
    assert (made.bounds().low, made.bounds().high, made.bounds().velocity) == (-100, 100, 7)


@pytest.mark.parametrize("is_armed", [False, True])
def test_what_changes_is_lent_again_only_while_the_drives_are_armed(is_armed):
    made, drives, _ = in_force(None, {WINDOW: 1000}, is_armed=is_armed)
    made.change(Limits(following_error=100.0))
    assert drives.values[WINDOW] == (100 if is_armed else 1000)
    drives.values[RESOLUTION][:] = 2 * TURN
    made.place()
    assert drives.values[WINDOW] == (200 if is_armed else 1000)


# --- what is lent -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("own", "limit", "has"),
    [
        (1000, 100, 100),
        (100, 100, None),
        (99, 100, None),
        (101, 100, 100),
        (0, 100, 100),  # off in the drive: it is switched on
        (1000, math.inf, None),
    ],
)
def test_a_limit_is_lent_where_it_is_tighter_than_the_drives_own(own, limit, has):
    expected = {} if has is None else {WINDOW: has}
    assert lent(Limits(following_error=float(limit)), {WINDOW: own}) == expected
    expected = {} if has is None else {FASTEST: has}
    assert lent(Limits(velocity=float(limit)), {FASTEST: own}) == expected


@pytest.mark.parametrize(("own", "has"), [(1000, 100), (100, None), (0, None)])
def test_a_current_limit_of_0_is_no_current_at_all(own, has):
    assert lent(Limits(current=100.0), {CURRENT_LIMIT: own}) == ({} if has is None else {CURRENT_LIMIT: has})


def test_without_limits_nothing_is_lent():
    assert lent(Limits(), {WINDOW: 1000, FASTEST: 1000, CURRENT_LIMIT: 1000, LOW: -5, HIGH: 5}) == {}


@pytest.mark.parametrize(
    ("own", "offset", "position", "has"),
    [
        ((-(2**31), 2**31 - 1), 0, (-TURN, TURN), (-TURN - SLACK, TURN + SLACK)),
        ((-(2**31), 2**31 - 1), 300, (-TURN, TURN), (-TURN - SLACK + 300, TURN + SLACK + 300)),
        ((-5, 5), 0, (-TURN, TURN), (None, None)),
        ((-(2**31), 5), 0, (-TURN, TURN), (-TURN - SLACK, None)),
        ((-(2**31), 2**31 - 1), 0, (None, TURN), (None, TURN + SLACK)),
        ((-(2**31), 2**31 - 1), 0, (-TURN, None), (-TURN - SLACK, None)),
    ],
)
def test_a_travel_is_lent_with_its_slack_and_the_home_offset(own, offset, position, has):
    found = lent(Limits(position=position), {LOW: own[0], HIGH: own[1], OFFSET: offset})
    assert found == {key: value for key, value in zip((LOW, HIGH), has, strict=True) if value is not None}


@pytest.mark.parametrize("own", [(0, 0), (7, 7), (8, 7)])
def test_a_range_that_is_none_is_looser_than_any_travel(own):
    """607Dh with its lower end at or above the upper one. One end alone would make a range of it and the other's 0."""
    found = lent(Limits(position=(-TURN, TURN)), {LOW: own[0], HIGH: own[1]})
    assert found == {LOW: -TURN - SLACK, HIGH: TURN + SLACK}
    assert lent(Limits(position=(None, TURN)), {LOW: own[0], HIGH: own[1]}) == {LOW: -(2**31), HIGH: TURN + SLACK}
    assert lent(Limits(position=(-TURN, None)), {LOW: own[0], HIGH: own[1]}) == {LOW: -TURN - SLACK, HIGH: 2**31 - 1}
    assert lent(Limits(position=(-TURN, TURN)), {LOW: 7, HIGH: 8}) == {}
    assert lent(Limits(position=(-TURN, TURN)), {HIGH: own[1]}) == {}
    assert lent(Limits(position=(-TURN, TURN)), {HIGH: own[1]}, refused=(LOW,)) == {}


def test_a_travel_beyond_the_type_is_lent_to_its_end():
    found = lent(Limits(position=(-(2**31) + 10, 2**31 - 10)), {LOW: 0, HIGH: 0})
    assert found == {LOW: -(2**31), HIGH: 2**31 - 1}


@pytest.mark.parametrize(
    ("scale", "velocity", "own", "has"),
    [
        (TURN, 100.0 * TURN, 0, 6000),
        (TURN, 100.0 * TURN + 1, 9000, 6001),  # whole rpm above: the drive's own rounding must not trip it
        (TURN, 100.0 * TURN, 5999, None),
        (2, 20.0, 9000, 600),
        (1, 20.0, 9000, None),  # the scale is not known
    ],
)
def test_the_motors_highest_speed_6080h_is_lent_in_rpm(scale, velocity, own, has):
    found = lent(Limits(velocity=velocity), {FASTEST_MOTOR: own}, scale=scale)
    assert found == ({} if has is None else {FASTEST_MOTOR: has})


def test_the_motors_highest_speed_is_not_lent_without_a_limit_of_the_users_or_where_speeds_are_in_rpm():
    assert lent(Limits(), {FASTEST_MOTOR: 9000}) == {}
    assert lent(Limits(velocity=60.0), {FASTEST_MOTOR: 9000}, units={0x606C: "rpm"}) == {}


def test_a_limit_that_is_no_tighter_any_more_gives_the_drive_its_own_again():
    made, drives, _ = in_force(Limits(following_error=100.0), {WINDOW: 1000}, is_armed=True)
    made.lend()
    assert drives.values[WINDOW] == 100
    made.change(Limits(following_error=2000.0))
    assert drives.values[WINDOW] == 1000


def test_every_axis_has_its_own():
    made, drives, _ = in_force(Limits(following_error=(100.0, 2000.0)), {WINDOW: (1000, 1500)}, num_axes=2)
    made.lend()
    assert drives.values[WINDOW].tolist() == [100, 1500]


def test_what_the_eds_lists_and_the_drive_has_not_is_watched_here_alone():
    assert lent(Limits(following_error=100.0), {}, refused=(WINDOW,)) == {}


def test_whose_limit_it_is():
    made, _, _ = in_force()
    assert made.origin(None, "velocity", "607Fh") == "the drive's own limit, 607Fh"
    assert made.origin(5.0, "velocity", "607Fh") == "Limits(velocity=...)"
