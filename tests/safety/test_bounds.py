"""The limits of every axis as integers of its drive: what is a limit, what switches one off, and what a scale makes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.held_objects import CURRENT_LIMIT, HeldObjects

from drive_env import Limits
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.bounds import increments_per_count, read_bounds, rotor_limits
from drive_env.safety.rotor import RotorAngle

TURN = 65536.0
LOW, HIGH, OFFSET = (0x607D, 1), (0x607D, 2), (0x607C, 0)
VELOCITY, WINDOW, FASTEST = (0x606C, 0), (0x6065, 0), (0x607F, 0)
RAMPS = {"acceleration": (0x6083, 0), "deceleration": (0x6084, 0), "quick stop": (0x6085, 0)}


def bounds_of(values=None, limits=None, *, scale=TURN, then=None, here=0, num_axes=1, **options):
    """Limits at a scale [inc/rev], given at that scale and read at another one, `then`."""
    drives = HeldObjects({VELOCITY: 0} | (values or {}), num_axes, **options)
    rotor = RotorAngle(num_axes)
    position = np.full(num_axes, here)
    rotor.place(position, np.full(num_axes, float(scale)))
    of_rotors = rotor_limits(limits or Limits(), drives, rotor, position)
    if then is not None:
        turns = rotor.turns(position)
        rotor.place(np.rint(position * then / scale).astype(np.int64), np.full(num_axes, float(then)), turns)
    return read_bounds(limits or Limits(), drives, rotor, of_rotors)


@pytest.mark.parametrize(
    ("unit", "scale", "count"),
    [
        ("velocity unit", TURN, 2.5 * TURN / 60.0), ("velocity unit", 1.0, math.nan),  # 2.5 rpm, by the ratio below
        ("0.1 rpm", TURN, 0.1 * TURN / 60.0),
        ("pps", TURN, 1.0), ("pps^2", TURN, 1.0), ("pps", 1.0, 1.0),
        ("rpm", TURN, TURN / 60.0), ("rpm/s", TURN, TURN / 60.0),
        ("rpm", 2.0, 2.0 / 60.0),  # the least scale that a drive may say
        ("rpm", 1.0, math.nan), ("rpm/s", 1.0, math.nan),  # it does not say it
        ("", TURN, math.nan), ("mm/s", TURN, math.nan),
    ],
)  # fmt: skip
def test_a_count_of_a_speed_is_so_many_increments(unit, scale, count):
    rotor = RotorAngle(2)
    rotor.scale, rotor.ratio = np.array([scale, scale]), np.array([2.5, 2.5])
    np.testing.assert_allclose(increments_per_count(unit, rotor), [count, count], rtol=1e-15)


def test_a_drive_without_limits_may_turn_at_6000_rpm_and_go_anywhere():
    found = bounds_of()
    assert (found.low, found.high) == (-NO_LIMIT, NO_LIMIT) and not found.has_position and not found.given
    assert found.velocity == 100 * TURN and found.default_speed
    assert found.current == found.following == NO_LIMIT
    assert found.braking == found.profile == 0.0
    assert found.rest == 0.15 * TURN and found.speed == math.inf


@pytest.mark.parametrize(
    ("low", "high", "offset", "expected"),
    [
        (-100, 200, 0, (-100, 200)),
        (-100, 200, 30, (-130, 170)),  # CiA 402: corrected by the home offset
        (-(2**31), 200, 5, (-NO_LIMIT, 195)),  # the ends of the type are the factory's
        (-(2**31) + 1, 2**31 - 2, 0, (-(2**31) + 1, 2**31 - 2)),
        (-100, 2**31 - 1, 5, (-105, NO_LIMIT)),
        (-(2**31), 2**31 - 1, 5, (-NO_LIMIT, NO_LIMIT)),
        (0, 0, 0, (-NO_LIMIT, NO_LIMIT)),  # switched off
        (7, 7, 0, (-NO_LIMIT, NO_LIMIT)),
        (8, 7, 0, (-NO_LIMIT, NO_LIMIT)),
        (7, 8, 0, (7, 8)),
    ],
)
def test_the_drives_own_range_and_what_is_none(low, high, offset, expected):
    found = bounds_of({LOW: low, HIGH: high, OFFSET: offset})
    assert (found.low, found.high) == expected
    assert found.has_position == (expected != (-NO_LIMIT, NO_LIMIT))
    assert not found.given  # from which homing is exempt


@pytest.mark.parametrize(
    ("own", "limit"),
    [(0, NO_LIMIT), (-1, NO_LIMIT), (1, 1), (5000, 5000), (2**31 - 2, 2**31 - 2), (2**31 - 1, NO_LIMIT),
     (2**32 - 1, NO_LIMIT)],
)  # fmt: skip
def test_zero_and_the_end_of_the_type_switch_a_drives_own_limit_off(own, limit):
    found = bounds_of({WINDOW: own, FASTEST: own, CURRENT_LIMIT: own})
    assert (found.following, found.current) == (limit, limit)
    assert found.velocity == (100 * TURN if limit == NO_LIMIT else limit)
    assert found.default_speed == (limit == NO_LIMIT)


def test_what_the_eds_lists_and_the_drive_has_not_is_no_limit():
    found = bounds_of(refused=(LOW, HIGH, WINDOW, FASTEST, CURRENT_LIMIT, RAMPS["quick stop"]))
    assert (found.low, found.high, found.following, found.current) == (-NO_LIMIT, NO_LIMIT, NO_LIMIT, NO_LIMIT)
    assert found.default_speed and found.braking == 0.0


def test_a_limit_of_the_users_holds_whatever_the_drive_has_and_none_of_it_is_infinite():
    values = {WINDOW: 50, FASTEST: 60, CURRENT_LIMIT: 70}
    found = bounds_of(values, Limits(velocity=600.0, current=700.0, following_error=500.0))
    assert (found.following, found.velocity, found.current) == (500, 600, 700)
    found = bounds_of(values, Limits(velocity=math.inf, current=math.inf, following_error=math.inf))
    assert (found.following, found.current) == (NO_LIMIT, NO_LIMIT)
    assert found.velocity == 100 * TURN  # 6,000 rpm, and no more
    found = bounds_of(values, Limits(velocity=(None, 6.0), current=(7.0, None)), num_axes=2)
    assert found.velocity.tolist() == [60, 6] and found.current.tolist() == [7, 70]
    assert found.following.tolist() == [50, 50]


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((-100.0, 200.0), (-100, 200)),
        ((-100.5, 200.5), (-101, 201)),  # whole increments around what was given
        ((None, 200.0), (-NO_LIMIT, 200)),  # one end alone takes the drive's own range away: it would be another's
        ((-100.0, None), (-100, NO_LIMIT)),
        ((-math.inf, math.inf), (-NO_LIMIT, NO_LIMIT)),
    ],
)
def test_a_travel_of_the_users(position, expected):
    found = bounds_of({LOW: -50, HIGH: 60}, Limits(position=position), here=10)
    assert (found.low, found.high) == expected
    assert found.given


def test_an_axis_for_which_the_user_gives_none_keeps_its_own_travel():
    found = bounds_of({LOW: -50, HIGH: 60}, Limits(position=((None, -7.0), (None, 8.0))), num_axes=2)
    assert (found.low.tolist(), found.high.tolist()) == ([-50, -7], [60, 8])
    assert found.given.tolist() == [False, True]


def test_the_users_limits_stay_with_the_rotor_when_the_scale_changes():
    limits = Limits(position=(-TURN, 2 * TURN), velocity=1001.0, following_error=101.0)
    found = bounds_of(limits=limits, scale=TURN, then=TURN / 2, here=100)
    assert (found.low, found.high) == (-TURN / 2, TURN)
    assert (found.velocity, found.following) == (500, 50)  # whole counts below
    found = bounds_of(limits=limits, scale=TURN, then=2 * TURN, here=100)
    assert (found.low, found.high, found.velocity, found.following) == (-2 * TURN, 4 * TURN, 2002, 202)
    found = bounds_of(limits=Limits(velocity=1.0, following_error=1.0), scale=TURN, then=TURN / 4)
    assert (found.velocity, found.following) == (1, 1)  # never 0, which would be no limit in a drive


@pytest.mark.parametrize(("scale", "expected"), [(2.0, 4.0), (1.0, 4.0)])
def test_limits_at_the_least_scale_and_without_one_are_as_they_were_given(scale, expected):
    found = bounds_of(limits=Limits(velocity=4.0, following_error=4.0), scale=scale)
    assert found.velocity == found.following == expected


def test_what_a_settled_axis_and_an_axis_at_rest_may_show():
    """200 increments, though no more than 0.02 of a turn; a move that ends at a limit may go 0.02 of a turn beyond."""
    found = bounds_of(scale=TURN)
    assert (found.settled, found.slack, found.rest) == (200.0, 200.0 + 0.02 * TURN, 0.15 * TURN)
    found = bounds_of(scale=1000.0)
    assert (found.settled, found.slack, found.rest) == (20.0, 40.0, 150.0)
    found = bounds_of(scale=2.0)
    np.testing.assert_allclose([found.settled, found.slack, found.rest], [[0.04], [0.08], [0.3]])
    found = bounds_of(scale=1.0)  # it is not known
    assert (found.settled, found.slack, found.rest) == (200.0, 200.0, 2000.0)


@pytest.mark.parametrize(
    ("ramps", "braking", "profile"),
    [
        ({"quick stop": 500}, 500, 500),
        ({"quick stop": 500, "acceleration": 900, "deceleration": 700}, 500, 900),
        ({"quick stop": 500, "acceleration": 600, "deceleration": 700}, 500, 700),
        ({"quick stop": 500, "acceleration": 300, "deceleration": 400}, 500, 500),
        ({"acceleration": 300}, 0, 300),
    ],
)
def test_ramps_of_a_quick_stop_and_of_a_profile(ramps, braking, profile):
    found = bounds_of({RAMPS[name]: value for name, value in ramps.items()})
    assert (found.braking, found.profile) == (braking, profile)


def test_speeds_in_rpm_are_held_by_positions_besides():
    """606Ch counts no increments, so positions tell the speed: 6,000 rpm, or the limit where that is higher."""
    units = {0x606C: "rpm", 0x6085: "rpm/s"}
    found = bounds_of({RAMPS["quick stop"]: 300}, units=units)
    assert (found.velocity, found.count, found.braking) == (6000, TURN / 60, 300 * TURN / 60)
    assert found.default_speed and found.speed == 100 * TURN
    found = bounds_of({FASTEST: 9000}, units=units)
    assert (found.velocity, found.speed) == (9000, 150 * TURN) and not found.default_speed
    found = bounds_of(limits=Limits(velocity=60.0), units=units, then=TURN / 2)
    assert (found.velocity, found.speed) == (60, 50 * TURN)  # rpm stay rpm whatever the scale
    found = bounds_of({RAMPS["quick stop"]: 300}, units={0x606C: "", 0x6085: ""})
    assert (found.velocity, found.braking, found.speed) == (NO_LIMIT, 0.0, 100 * TURN)
    found = bounds_of(units={0x606C: ""}, scale=1.0)
    assert (found.velocity, found.speed) == (NO_LIMIT, math.inf)
