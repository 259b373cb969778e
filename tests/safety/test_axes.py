"""What is known of the axes: live or not, where, how fast, and when a new zero is no movement."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from rigs.held_objects import HeldObjects

from drive_env.safety.axes import BASELINE, Axes
from drive_env.safety.rotor import RotorAngle, read_scale, scale_objects, wrapped

STATUS, POSITION, VELOCITY, CURRENT = (0x6041, 0), (0x6064, 0), (0x606C, 0), (0x6077, 0)
OFF, ENABLED, QUICK_STOP = 0x0240, 0x0637, 0x0617
HM, PV = 6, 3
TURN = 1000.0  # increments


def axes_of(count=2, unit="pps", **options):
    """Axes of drives whose time is `clock`, in cycles of 1 ms."""
    drives = HeldObjects(
        dict.fromkeys((STATUS, POSITION, VELOCITY, CURRENT), 0), count, units={0x606C: unit}, **options
    )
    drives.time_waits = True
    axes = Axes(drives)
    axes.place(np.zeros(count, np.int64), np.full(count, TURN))
    return axes


def take(axes, epoch=None, where=None, seconds=0.001, **rows):
    """Take samples: each a list of rows, of one number for each axis."""
    axes.clock += seconds
    keys = {"status": STATUS, "position": POSITION, "velocity": VELOCITY, "current": CURRENT}
    count = len(axes.everywhere)
    return axes.take(
        {keys[name]: np.array(value, np.int64).reshape(-1, count) for name, value in rows.items()},
        axes.epoch if epoch is None else epoch, axes.everywhere if where is None else np.array(where),
    )  # fmt: skip


# --- live or not --------------------------------------------------------------------------------------------------
def test_at_first_nothing_is_seen_and_nothing_was_written():
    drives = HeldObjects({STATUS: 0, POSITION: 0}, 2)
    axes = Axes(drives)
    assert (axes.seen == -math.inf).all() and (axes.mode_written == -math.inf).all()
    assert not axes.may_turn.any() and not axes.is_armed and not axes.in_flight.any() and not axes.lost and not axes.aim
    assert (axes.outside == -1).all() and not axes.has_scale.any() and (axes.epoch, axes.clock) == (0, 0.0)
    assert not axes.is_counted  # it has no 606Ch
    drives.time_waits = True
    assert axes.now() == 0.0
    drives.time_waits = False
    assert abs(axes.now() - time.monotonic()) < 60.0


def test_an_axis_is_live_by_its_newest_statusword():
    axes = axes_of()
    take(axes, status=[[OFF, ENABLED], [QUICK_STOP, OFF]])
    assert axes.live.tolist() == [True, False] and axes.status.tolist() == [QUICK_STOP, OFF]
    assert axes.seen.tolist() == [axes.clock] * 2
    take(axes, where=[False, True], status=[[OFF, ENABLED]])
    assert axes.live.tolist() == [True, True] and axes.is_enabled().tolist() == [False, True]
    assert axes.seen[1] > axes.seen[0]


def test_what_a_frame_could_have_enabled_is_live_until_a_later_sample_shows_otherwise():
    axes = axes_of()
    before = axes.epoch
    axes.assume(np.array([True, False]))
    assert axes.epoch == before + 1
    assert axes.live.tolist() == axes.may_turn.tolist() == axes.in_flight.tolist() == [True, False]
    take(axes, epoch=before, status=[[OFF, OFF]])  # asked for before the frame
    assert axes.live.tolist() == [True, False]
    take(axes, status=[[OFF, OFF]])  # the frame may still be on its way
    assert axes.live.tolist() == [True, False]
    axes.in_flight[0] = False
    take(axes, where=[False, True], status=[[OFF, OFF]])  # of the other axis
    assert axes.live.tolist() == [True, False]
    take(axes, status=[[OFF, OFF]])
    assert not axes.may_turn.any()


def test_an_axis_that_becomes_live_has_not_been_seen_inside_its_limits():
    axes = axes_of()
    axes.outside[:] = 5
    take(axes, status=[[ENABLED, OFF]])
    assert axes.outside.tolist() == [-1, 5]
    axes.outside[0] = 3
    take(axes, status=[[ENABLED, OFF]])
    axes.assume(np.array([True, True]))
    assert axes.outside.tolist() == [3, -1]  # the one was live


def test_a_move_is_forgotten_when_its_axis_is_off():
    axes = axes_of()
    take(axes, status=[[ENABLED, ENABLED]])
    axes.aim = {0: 10, 1: 20}
    take(axes, status=[[ENABLED, OFF]])
    assert axes.aim == {0: 10}
    take(axes, status=[[ENABLED, OFF]])
    assert axes.aim == {0: 10}


def test_what_was_proved_off_is_off():
    axes = axes_of()
    axes.assume(np.array([True, True]))
    axes.take_for_off(np.array([True, False]))
    assert axes.may_turn.tolist() == axes.in_flight.tolist() == axes.live.tolist() == [False, True]


# --- how fast -----------------------------------------------------------------------------------------------------
def test_a_speed_by_positions_is_of_8_ms_at_least():
    axes = axes_of(1)
    take(axes, position=[0])
    for k in range(1, 9):
        take(axes, position=[5 * k])
        # 5 increments in a millisecond, once the baseline is full
        np.testing.assert_allclose(axes.speed, 5000.0 if k >= 8 else 0.0)
    take(axes, position=[41])  # a new baseline begins
    np.testing.assert_allclose(axes.speed, 5000.0)
    take(axes, seconds=BASELINE, position=[49])
    np.testing.assert_allclose(axes.speed, 9 / (BASELINE + 0.001))


def test_a_baseline_that_is_too_old_tells_no_speed():
    axes = axes_of(1)
    take(axes, position=[0], velocity=[77])
    assert axes.speed == 77.0  # the drive's own meanwhile
    take(axes, seconds=10 * BASELINE - 1e-6, position=[79])
    np.testing.assert_allclose(axes.speed, 79 / (10 * BASELINE), rtol=1e-3)
    take(axes, seconds=10 * BASELINE + 1e-6, position=[179], velocity=[66])
    assert axes.speed == 66.0


def test_a_speed_across_the_end_of_32_bits():
    assert wrapped(np.array([2**31 - 1, 2**31, -(2**31), -(2**31) - 1, 5])).tolist() == [
        2**31 - 1, -(2**31), -(2**31), 2**31 - 1, 5
    ]  # fmt: skip
    axes = axes_of(1)
    take(axes, position=[2**31 - 10])
    take(axes, seconds=BASELINE, position=[-(2**31) + 6])
    np.testing.assert_allclose(axes.speed, 16 / BASELINE)


@pytest.mark.parametrize(("unit", "expected"), [("pps", 300.0), ("rpm", 500.0)])
def test_the_drives_own_speed_where_it_counts_increments_and_that_of_positions_otherwise(unit, expected):
    axes = axes_of(1, unit)
    take(axes, position=[0], velocity=[0])
    take(axes, seconds=BASELINE, position=[4], velocity=[[200], [300]])
    np.testing.assert_allclose(axes.velocity, expected)
    take(axes, seconds=BASELINE, position=[8])  # none of the drive's own
    np.testing.assert_allclose(axes.velocity, 500.0)


def test_axes_that_samples_are_not_of_stay_as_they_were():
    axes = axes_of()
    take(axes, position=[[0, 0]], velocity=[[1, 1]], current=[[30, 30]])
    take(axes, where=[True, False], seconds=BASELINE, position=[[8, 8]], velocity=[[2, 2]], current=[[60, 60]])
    assert axes.position.tolist() == [8, 0] and axes.velocity.tolist() == [2.0, 1.0]
    np.testing.assert_allclose(axes.speed, [8 / BASELINE, 1.0])
    assert axes.mean_current[0] > axes.mean_current[1]


# --- current ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("seconds", "share"), [(0.0, 1 / 30), (0.0005, 1 / 30), (0.003, 0.1), (0.015, 0.5), (0.03, 1.0), (5.0, 1.0)]
)
def test_the_mean_current_is_of_the_last_30_ms(seconds, share):
    axes = axes_of(1)
    take(axes, seconds=1.0, current=[0])
    take(axes, seconds=seconds, current=[[200], [400]])
    np.testing.assert_allclose(axes.mean_current, 300.0 * share)
    take(axes, seconds=1.0, current=[40])
    np.testing.assert_allclose(axes.mean_current, 40.0)


# --- a new zero ---------------------------------------------------------------------------------------------------
def homing(mode=HM, status=ENABLED, speed=0):
    axes = axes_of(1)
    take(axes, status=[status], position=[100], velocity=[speed])
    axes.mode[:] = mode
    take(axes, status=[status], position=[100], velocity=[speed])
    return axes


@pytest.mark.parametrize("jump", [4, -4, 700, -100])
def test_a_jump_while_homing_is_a_new_zero_and_the_rotor_stays_where_it_is(jump):
    axes = homing()
    assert take(axes, status=[ENABLED], position=[100 + jump], velocity=[0])
    np.testing.assert_allclose(axes.rotor.turns(axes.position), 100 / TURN)
    take(axes, seconds=BASELINE, status=[ENABLED], position=[100 + jump], velocity=[0])
    assert axes.speed == 0.0
    assert not take(axes, status=[ENABLED], position=[100 + jump], velocity=[0])


def test_a_jump_in_the_middle_of_a_run_of_samples():
    axes = homing()
    assert take(axes, status=[[ENABLED]] * 3, position=[[100], [0], [1]], velocity=[[0]] * 3)
    np.testing.assert_allclose(axes.rotor.turns(axes.position), 101 / TURN)  # it went on by one increment


@pytest.mark.parametrize("jump", [3, -3, 0])
def test_three_thousandths_of_a_turn_are_a_movement(jump):
    axes = homing()
    assert not take(axes, status=[ENABLED], position=[100 + jump], velocity=[0])
    np.testing.assert_allclose(axes.rotor.turns(axes.position), (100 + jump) / TURN)


def test_what_twice_the_speed_explains_is_a_movement():
    """At 10 increments a cycle up to 3 + 20 are one."""
    for step, is_jump in ((23, False), (24, True), (-24, True)):
        assert take(homing(speed=10_000), status=[ENABLED], position=[100 + step], velocity=[10_000]) is is_jump
    axes = homing()  # a drive that says no speed: by the step before
    assert not take(axes, status=[ENABLED], position=[103])
    assert not take(axes, status=[ENABLED], position=[112])
    assert take(axes, status=[ENABLED], position=[137])


@pytest.mark.parametrize(("mode", "status", "found"), [(PV, ENABLED, False), (HM, OFF, False), (HM, QUICK_STOP, False),
                                                       (HM, ENABLED, True)])  # fmt: skip
def test_only_an_axis_that_homes_gets_a_new_zero(mode, status, found):
    axes = homing(mode, status)
    assert take(axes, status=[status], position=[800], velocity=[0]) is found


def test_an_axis_that_was_enabled_at_the_look_before_may_have_homed_since():
    axes = homing()
    assert take(axes, status=[OFF], position=[800], velocity=[0])
    axes = homing()
    take(axes, status=[OFF], position=[100], velocity=[0])
    assert not take(axes, status=[OFF], position=[800], velocity=[0])


def test_the_first_position_is_no_jump():
    axes = axes_of(1)
    axes._placed[:] = False
    axes.mode[:] = HM
    assert not take(axes, status=[ENABLED], position=[800], velocity=[0])


# --- where the rotors are -----------------------------------------------------------------------------------------
def test_the_way_between_increments_and_revolutions():
    rotor = RotorAngle(2)
    assert not rotor.is_placed and rotor.scale.tolist() == [1.0, 1.0]
    rotor.place(np.array([100, 200]), np.array([1000.0, 500.0]))
    assert rotor.is_placed
    np.testing.assert_array_equal(rotor.turns(np.array([600, -300])), [0.5, -1.0])
    np.testing.assert_array_equal(rotor.increments(np.array([0.5, -1.0])), [600.0, -300.0])
    np.testing.assert_array_equal(rotor.increments(np.array([math.inf, -math.inf])), [math.inf, -math.inf])
    rotor.place(np.array([600, -300]), np.array([2000.0, 1000.0]))  # where they were believed
    np.testing.assert_array_equal(rotor.turns(np.array([600, -300])), [0.5, -1.0])
    rotor.place(np.array([0, 0]), np.array([2000.0, 1000.0]), np.array([3.0, 4.0]))
    np.testing.assert_array_equal(rotor.turns(np.array([1000, -1000])), [3.5, 3.0])
    assert RotorAngle(1).turns(np.array([-(2**31)])) == -(2.0**31)


def test_the_place_is_that_of_the_samples_when_the_scale_is_written():
    axes = axes_of(1)
    take(axes, position=[500])
    axes.keep_place()
    take(axes, position=[250])  # of the new scale already
    axes.place(np.array([250]), np.array([TURN / 2]))
    assert axes.rotor.turns(axes.position) == 0.5 and axes.position == 250
    axes.place(np.array([0]), np.array([math.nan]))
    assert not axes.has_scale and axes.rotor.scale == 1.0
    assert axes.rotor.turns(axes.position) == 0.5


GEARED = {(0x6091, 1): 3, (0x6091, 2): 2, (0x6092, 1): 600, (0x6092, 2): 5}  # motor : shaft, feed : shaft


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ({}, math.nan),
        (GEARED, 600 / 5 * 2 / 3),
        (GEARED | {(0x608F, 1): 77, (0x608F, 2): 1}, 80.0),
        (GEARED | {(0x6091, 1): 0}, math.nan),
        (GEARED | {(0x6092, 2): 0}, math.nan),
        (GEARED | {(0x6092, 2): -1}, math.nan),
        (GEARED | {(0x6091, 1): 1, (0x6091, 2): 1, (0x6092, 2): 1}, 600.0),
        ({(0x608F, 1): 4096, (0x608F, 2): 2}, 2048.0),
        ({(0x608F, 1): 4096, (0x608F, 2): 1}, 4096.0),
        ({(0x608F, 1): 4096, (0x608F, 2): 0}, math.nan),
        ({(0x608F, 1): 0, (0x608F, 2): 1}, math.nan),
        ({(0x608F, 1): -4096, (0x608F, 2): 1}, math.nan),
        ({(0x608F, 1): 4096}, 4096.0),
        ({(0x608F, 1): 2, (0x608F, 2): 1}, 2.0),
        ({key: value for key, value in GEARED.items() if key != (0x6092, 2)} | {(0x608F, 1): 77}, 77.0),
    ],
)
def test_what_a_revolution_counts_by_the_objects_that_there_are(values, scale):
    drives = HeldObjects(values, 2)
    np.testing.assert_array_equal(read_scale(drives), [scale, scale])
    assert set(scale_objects(drives.description)) <= set(values)


def test_what_the_eds_lists_and_the_drive_has_not_says_nothing():
    assert np.isnan(read_scale(HeldObjects({(0x608F, 1): 4096}, refused=((0x608F, 2),)))).all()
