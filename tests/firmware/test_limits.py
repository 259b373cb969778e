"""What a user may state as limits, and what is refused at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.tables import every_row

from drive_env import Limits
from drive_env.drives.limits import given


def test_what_holds_unless_it_is_said():
    limits = Limits()
    assert (limits.position, limits.velocity, limits.current, limits.following_error) == (None, None, None, None)
    assert limits.oscillation and (limits.stall, limits.silence) == (1.0, 0.5)


@pytest.mark.parametrize(
    "position",
    [(-1, 1), (None, 1), (-1, None), (None, None), (-math.inf, math.inf), ((-1, None), (1, 5)), (0, (1, 2)),
     (-1e-9, 0.0)],
)  # fmt: skip
def test_a_travel_has_a_lower_end_and_an_upper_one(position):
    Limits(position=position)


@pytest.mark.parametrize(
    "position",
    [(1, 1), (2, 1), (0,), (0, 1, 2), (math.nan, 1), (0, math.nan), (math.inf, None), ((0, 1), (1, 1)), (3, (4, 2)),
     ((0, math.nan), (1, 2)), ((0, 0), (1, math.nan))],
)  # fmt: skip
def test_what_is_no_travel(position):
    with pytest.raises(ValueError, match="position limits are lowest and highest, not"):
        Limits(position=position)


@every_row("name", ["velocity", "current", "following_error"])
@every_row(("value", "holds"), [
    (1e-9, True), (None, True), (math.inf, True), ((1, None), True), (0, False), (-1, False), (math.nan, False),
    ((1, 0), False), ((None, -1), False),
])  # fmt: skip
def test_a_limit_of_0_would_let_nothing_move_and_none_takes_the_drives_own(name, value, holds):
    if holds:
        Limits(**{name: value})
        return
    with pytest.raises(ValueError, match=f"{name} must be above 0, not .*; None takes the drive's own limit"):
        Limits(**{name: value})


@pytest.mark.parametrize(("stall", "holds"), [(None, True), (1e-9, True), (1e9, True), (0.0, False), (-1.0, False),
                                              (math.inf, False), (math.nan, False)])  # fmt: skip
def test_a_pause_that_ends(stall, holds):
    if holds:
        Limits(stall=stall)
        return
    with pytest.raises(ValueError, match=r"stall must be above 0 s, not .*; None is for any"):
        Limits(stall=stall)


@pytest.mark.parametrize(("silence", "holds"), [(None, True), (0.02, True), (65.535, True), (0.0199, False),
                                                (65.536, False), (0.0, False), (math.nan, False)])  # fmt: skip
def test_a_silence_that_a_drive_can_count(silence, holds):
    if holds:
        Limits(silence=silence)
        return
    with pytest.raises(ValueError, match=r"is impossible: a drive counts it in milliseconds.* choose 0.02 to 65.535 s"):
        Limits(silence=silence)


@every_row("name", ["velocity", "current", "following_error", "position", "position's upper end"])
@every_row(("count", "axes", "holds"), [(1, 3, True), (3, 3, True), (2, 3, False), (4, 3, False), (2, 1, False)])
def test_one_value_for_all_axes_or_one_each(name, count, axes, holds):
    values = tuple(range(1, count + 1))
    given_as = {"position": {"position": (values, 9)}, "position's upper end": {"position": (0, values)}}
    limits = Limits(**given_as.get(name, {name: values}))
    if holds:
        limits.check_axes(axes)
        return
    with pytest.raises(ValueError, match=f"{name} has {count} values for {axes} axes; give one for all, or one each"):
        limits.check_axes(axes)


def test_one_number_and_none_fit_any_number_of_axes():
    for limits in (Limits(), Limits(position=(-1, 1), velocity=5.0, current=5.0, following_error=5.0)):
        limits.check_axes(7)


@pytest.mark.parametrize(("value", "each"), [
    (None, [math.nan] * 2), (5, [5.0, 5.0]), ((5, 6), [5.0, 6.0]), ((None, 6), [math.nan, 6.0]), ((7,), [7.0, 7.0]),
    (math.inf, [math.inf] * 2),
])  # fmt: skip
def test_what_was_given_for_each_axis(value, each):
    np.testing.assert_array_equal(given(value, 2), each)
