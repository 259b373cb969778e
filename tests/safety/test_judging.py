"""What the drives do, held against the limits: exactly at a limit is within it, and one count more is not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.held_objects import HeldObjects

from drive_env import Limits, SafetyError
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.bounds import Bounds
from drive_env.safety.judging import CURRENT_CYCLES, Judging
from drive_env.safety.oscillation import SWINGS
from drive_env.safety.stop_ends import LATENCY

CSP, CSV, PP, PV, HM, TQ = 8, 9, 1, 3, 6, 4
POSITION, DEMAND, VELOCITY, CURRENT = (0x6064, 0), (0x6062, 0), (0x606C, 0), (0x6077, 0)
SLACK, SETTLED = 50, 20


class Bench:
    """Axes that are judged, by what is known of them and the limits."""

    def __init__(self, axes=1, mode=CSV, user=None, **limits):
        def each(value, kind):
            return np.broadcast_to(np.asarray(value, kind), (axes,)).copy()

        free = {"low": -NO_LIMIT, "high": NO_LIMIT, "velocity": NO_LIMIT, "current": NO_LIMIT, "following": NO_LIMIT}
        whole = {name: each(limits.get(name, value), np.int64) for name, value in free.items()}
        parts = {"settled": SETTLED, "slack": SLACK, "count": 1.0, "braking": 1000.0, "profile": 2000.0, "slowing": 0.0,
                 "rest": 10.0, "speed": np.inf, "lag": 0.0, "windup": 0.0}  # fmt: skip
        floats = {name: each(limits.get(name, value), float) for name, value in parts.items()}
        masks = {name: each(limits.get(name, True), bool) for name in ("given", "default_speed")}
        self.bounds = Bounds(**whole, **floats, **masks)
        self.axes = SimpleNamespace(
            everywhere=np.ones(axes, bool), speed=np.zeros(axes), velocity=np.zeros(axes),
            outside=np.zeros(axes, np.int64), mode=each(mode, np.int64), mode_written=np.zeros(axes),
            demand=np.zeros(axes, np.int64), demand_seen=np.full(axes, -np.inf), led=np.full(axes, np.nan),
            aim=dict.fromkeys(range(axes), 0), moves=np.ones(axes, bool), asked_speed=np.zeros(axes),
            velocity_object=VELOCITY, asked_current=np.zeros(axes), position=np.zeros(axes, np.int64), clock=1.0,
        )  # fmt: skip
        self.axes.now, self.axes.newest_speed = lambda: self.axes.clock, lambda: self.axes.velocity
        self.user = user or Limits()
        in_force = SimpleNamespace(
            bounds=lambda: self.bounds, user=self.user, origin=lambda value, name, own: f"{name} or {own}"
        )
        known = HeldObjects(dict.fromkeys((POSITION, DEMAND, VELOCITY, CURRENT), 0)).description.dictionary
        self.judging = Judging(known, self.axes, in_force, lambda: self.axes.mode, self._stop_for)
        self.judged = np.ones(axes, bool)

    @staticmethod
    def _stop_for(what, remedy):
        raise SafetyError(f"{what}; {remedy}")

    def see(self, **rows):
        """Judge samples: each a list of rows, of one number for each axis."""
        keys = {"position": POSITION, "demand": DEMAND, "velocity": VELOCITY, "current": CURRENT}
        axes = len(self.judged)
        self.judging.judge(
            {keys[name]: np.array(value, np.int64).reshape(-1, axes) for name, value in rows.items()}, self.judged
        )

    def stops(self, match, **rows):
        with pytest.raises(SafetyError, match=match):
            self.see(**rows)


# --- speed --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1, -1])
def test_a_speed_beyond_its_limit_either_way(sign):
    bench = Bench(velocity=500)
    bench.see(velocity=[500 * sign])
    bench.stops("axis 0: 606Ch:00 object 606Ch is 501, and its limit is 500; lower the", velocity=[501 * sign])
    bench.stops("is 501", velocity=[501 * sign, 0])  # of any row
    bench.stops("is 501", velocity=[0, 501 * sign])


def test_the_axis_that_is_wrong_is_named_and_one_that_is_not_judged_is_left_alone():
    bench = Bench(axes=3, velocity=(500, 600, 500))
    bench.stops("axis 1: .* is 601, and its limit is 600", velocity=[[500, 601, 500]])
    bench.judged[1] = False
    bench.see(velocity=[[500, 601, 500]])
    bench.judged[:] = False
    bench.see(velocity=[[999, 999, 999]])


def test_of_several_axes_that_are_wrong_the_first_is_named():
    bench = Bench(axes=3, velocity=500, current=400, speed=1000.0, low=-1000, high=1000)
    bench.stops("axis 1: ", velocity=[[0, 501, 502]])
    bench.stops("axis 1: the position is 1000", position=[[0, 2000, 3000]])
    bench.stops("axis 1: the current is 501", current=[[0, 501, 502]] * CURRENT_CYCLES)
    bench.axes.speed[:] = (0.0, 1500.0, 1600.0)
    bench.stops("axis 1 turns by 1500", position=[[0, 0, 0]])


def test_a_speed_by_positions_where_the_drives_own_counts_something_else():
    bench = Bench(speed=1000.0)
    bench.axes.speed[:] = -1000.0
    bench.see(position=[0])
    bench.axes.speed[:] = -1000.5
    bench.stops(r"axis 0 turns by 1000 increments a second, and its limit is 1000 \(6,000 rpm", position=[0])
    bench.see(velocity=[0])  # no new position


# --- position -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("sign", "low", "high"), [(1, -NO_LIMIT, 1000), (-1, -1000, NO_LIMIT), (1, -1000, 1000),
                                                   (-1, -1000, 1000)])  # fmt: skip
def test_a_position_may_pass_its_limit_by_what_a_settled_axis_swings(sign, low, high):
    bench = Bench(low=low, high=high)
    bench.see(position=[1000 * sign])
    assert bench.axes.outside == 0
    bench.see(position=[1020 * sign])
    bench.stops("the position is 21 increments beyond the limits", position=[1021 * sign])
    bench.stops("the position is 21 increments", position=[1021 * sign, 1000 * sign])


def test_a_travel_that_is_none_is_not_judged():
    Bench().see(position=[2**31 - 1])
    Bench(low=-1000).see(position=[2**31 - 1])
    Bench(high=1000).see(position=[-(2**31)])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("mode", "way"),
    [
        (CSV, 300**2 / (2 * 1000.0) + 300 * LATENCY),  # 45 + 3 increments from 300 inc/s by 6085h
        (PV, 300**2 / (2 * 1000.0) + 300 * LATENCY),
        (PP, 300**2 / (2 * 1200.0)),  # 37.5: it stops by itself, by its profile
        (CSP, 300**2 / (2 * 1200.0)),
    ],
)
def test_where_a_stop_would_end_counts(mode, way, sign):
    """v^2 / 2a, and v times what passes until the drive begins; no more than the slack beyond the limit."""
    bench = Bench(mode=mode, low=-1000, high=1000, profile=1200.0)
    bench.axes.velocity[:] = 300.0 * sign
    last = 1000 + SLACK - way  # the last place from which it may be stopped
    bench.see(position=[int(np.floor(last)) * sign])
    bench.stops(
        "its stop would end 5[01] increments beyond the limits -1000 to 1000", position=[int(last + 1.001) * sign]
    )
    bench.axes.velocity[:] = -300.0 * sign  # on its way back in
    bench.see(position=[1000 * sign])


def test_where_the_ramp_is_not_known_a_stop_takes_as_long_as_it_may():
    bench = Bench(high=1000, braking=0.0)
    bench.axes.velocity[:] = 1000.0  # 500 in a second that falls evenly, 10 before it begins
    bench.see(position=[1000 + SLACK - 510])
    bench.stops("its stop would end 51 increments", position=[1000 + SLACK - 509])
    bench = Bench(high=1000, profile=0.0, mode=CSP)
    bench.axes.velocity[:] = 1000.0
    bench.see(position=[1000])


@pytest.mark.parametrize("sign", [1, -1])
def test_an_axis_in_csp_that_its_set_point_holds_within_its_limits_is_left_to_it(sign):
    """A stop would end 1400 increments outside; the loops brake it before."""
    bench = Bench(mode=CSP, low=-1000, high=1000, braking=1000.0, profile=1000.0, lag=0.1)
    bench.axes.velocity[:], bench.axes.demand[:], bench.axes.demand_seen[:] = 2000.0 * sign, 1000 * sign, 1.0
    bench.see(position=[200 * sign])
    bench.stops("the position is 21", position=[1021 * sign])
    bench.axes.demand[:] = 1021 * sign
    bench.stops("its stop would end 1400 increments", position=[200 * sign])  # 2000 of the ramp, 200 of the lag


def test_a_stop_in_csv_begins_with_the_speed_that_was_asked_for():
    bench = Bench(mode=CSV, high=1000, braking=1000.0)
    bench.axes.asked_speed[:] = 1000.0  # 500 by the ramp, 10 before it begins
    bench.see(position=[1000 + SLACK - 510])
    bench.stops("its stop would end 51 increments", position=[1000 + SLACK - 509])


@pytest.mark.parametrize(("mode", "name", "speed"), [(TQ, "asked_current", 100.0), (PV, None, 100.0)])
def test_what_the_integral_holds_of_an_axis_that_speeds_up_adds_to_its_way(mode, name, speed):
    bench = Bench(mode=mode, high=1000, braking=1000.0, windup=2.0)
    if name:
        bench.axes.asked_current[:] = 50
    bench.see(position=[0])
    bench.axes.clock, bench.axes.velocity = 1.01, np.array([speed])
    way = 5 + 1 + 100  # ramp, latency, 2 increments for each of 50 counts
    bench.see(position=[1000 + SLACK - way], current=[50])
    bench.stops("its stop would end 51 increments", position=[1000 + SLACK - way + 1], current=[50])


@pytest.mark.parametrize(("mode", "given", "stops"), [(HM, False, False), (HM, True, True), (CSV, False, True)])
def test_homing_is_exempt_from_the_drives_own_travel_alone(mode, given, stops):
    bench = Bench(mode=mode, low=-1000, high=1000, given=given)
    if stops:
        bench.stops("position or 607Dh", position=[2000])
    else:
        bench.see(position=[2000])


def test_an_axis_that_homes_does_not_hide_one_that_does_not():
    bench = Bench(axes=2, mode=(HM, CSV), low=-1000, high=1000, given=False)
    bench.stops("axis 1: the position is 1000 increments", position=[[3000, 2000]])
    bench.judged[1] = False
    bench.see(position=[[3000, 2000]])


def test_an_axis_that_was_enabled_outside_may_come_back_and_go_no_further_out():
    bench = Bench(low=-1000, high=1000)
    bench.axes.outside[:] = -1  # not seen yet
    bench.see(position=[1500])
    assert bench.axes.outside == 500
    bench.see(position=[1520])  # it settles
    bench.see(position=[1400])
    assert bench.axes.outside == 400
    bench.stops("the position is 421 increments", position=[1421])
    bench.see(position=[900])
    assert bench.axes.outside == 0
    bench.stops("the position is 400 increments", position=[1400])


# --- following error ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", [PP, CSP])
def test_a_following_error_in_modes_that_follow(mode):
    bench = Bench(mode=mode, following=100)
    bench.see(position=[50], demand=[150])
    bench.see(position=[150], demand=[50])
    bench.stops(
        "the following error is 101, and its limit is 100; .*following_error or 6065h", position=[0], demand=[101]
    )
    bench.stops("is 101", position=[101, 0], demand=[0, 0])


@pytest.mark.parametrize("mode", [PV, CSV, HM, TQ])
def test_no_following_error_in_other_modes(mode):
    Bench(mode=mode, following=100).see(position=[0], demand=[5000])


def test_a_following_error_across_the_end_of_32_bits():
    bench = Bench(mode=CSP, following=100)
    bench.see(position=[2**31 - 50], demand=[-(2**31) + 50])
    bench.stops("is 101", position=[2**31 - 50], demand=[-(2**31) + 51])


def test_the_mode_is_asked_for_only_where_it_matters():
    bench, asked = Bench(mode=CSP, following=100, axes=2), []
    bench.judging._modes = lambda: asked.append(1) or bench.axes.mode
    bench.see(position=[[0, 0]], demand=[[100, 100]])
    assert not asked
    bench.judged[1] = False
    bench.see(position=[[0, 0]], demand=[[0, 5000]])
    assert not asked


# --- current ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1, -1])
def test_a_current_a_quarter_above_its_limit_for_ten_cycles(sign):
    bench = Bench(current=400, user=Limits(oscillation=False))
    bench.see(current=[500 * sign] * 100)
    bench.see(current=[501 * sign] * (CURRENT_CYCLES - 1))
    bench.see(current=[500 * sign])  # in between
    bench.see(current=[501 * sign] * (CURRENT_CYCLES - 1) + [0])
    bench.see(current=[501 * sign] * (CURRENT_CYCLES - 1))
    bench.stops(f"axis 0: the current is {501 * sign} for 10 cycles, and its limit is 400", current=[501 * sign])


def test_each_axis_has_its_own_count_and_one_that_is_not_judged_has_none():
    bench = Bench(axes=2, current=400, user=Limits(oscillation=False))
    for k in range(3 * CURRENT_CYCLES):
        bench.see(current=[[501, 0] if k % 2 else [0, 501]])
    bench.judged[1] = False
    for _ in range(3 * CURRENT_CYCLES):
        bench.see(current=[[0, 501]])
    bench.judged[1] = True
    bench.see(current=[[0, 501]] * (CURRENT_CYCLES - 1))
    bench.stops("axis 1", current=[[0, 501]])


@pytest.mark.parametrize(("amplitude", "limit", "oscillation", "stops"), [
    (201, 400, True, True), (200, 400, True, False), (201, 400, False, False), (201, NO_LIMIT, True, False),
])  # fmt: skip
def test_a_current_that_swings_past_plus_and_minus_half_its_limit(amplitude, limit, oscillation, stops):
    bench = Bench(current=limit, user=Limits(oscillation=oscillation))
    swings = [[amplitude], [-amplitude]] * SWINGS
    bench.see(current=swings[:SWINGS])  # the first is no swing
    if stops:
        bench.stops("axis 0 oscillates: its current swung 8 times past plus and minus 200 within 100 cycles; lower",
                    current=swings[SWINGS])  # fmt: skip
        bench.see(current=swings[:SWINGS])  # counted anew
    else:
        bench.see(current=swings)


def test_swings_of_an_axis_that_is_not_judged_are_not_counted():
    bench = Bench(axes=2, current=400)
    bench.judged[0] = False
    bench.see(current=[[300, 0], [-300, 0]] * 20)
    bench.judged[0] = True
    bench.see(current=[[300, 0], [-300, 0]] * (SWINGS // 2))
    bench.stops("axis 0 oscillates", current=[[300, 0]])
