"""What a program is about to write or play, held against the limits: at a limit it goes out, beyond it does not."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.held_objects import CURRENT_LIMIT, HeldObjects

from drive_env import Limits, SafetyError
from drive_env.safety.axes import Axes
from drive_env.safety.commands import Commands
from drive_env.safety.lending import Lending
from drive_env.safety.limits_in_force import LimitsInForce

TURN = 65536
PP, PV, TQ, HM, CSP, CSV, CST = 1, 3, 4, 6, 8, 9, 10
WORD, MODE, TARGET, OFFSET = (0x6040, 0), (0x6060, 0), (0x607A, 0), (0x60B0, 0)
SPEED, SPEED_OFFSET, TORQUE, TORQUE_OFFSET = (0x60FF, 0), (0x60B1, 0), (0x6071, 0), (0x60B2, 0)
PROFILE, SWITCH, ZERO, BRAKING = (0x6081, 0), (0x6099, 1), (0x6099, 2), (0x6085, 0)
POSITION, DEMAND, VELOCITY, OPTIONS = (0x6064, 0), (0x6062, 0), (0x606C, 0), (0x60F2, 0)
RESOLUTION, TURNS = (0x608F, 1), (0x608F, 2)
EVERYTHING = (WORD, MODE, TARGET, OFFSET, SPEED, SPEED_OFFSET, TORQUE, TORQUE_OFFSET, PROFILE, SWITCH, ZERO, POSITION,
              DEMAND, VELOCITY, CURRENT_LIMIT)  # fmt: skip
TRAVEL = Limits(position=(-1000, 1000))
FAST = Limits(velocity=500.0, current=400.0)
NEW, RELATIVE = 0x1F, 0x5F  # controlwords that start a move


class Bench:
    """Commands of two axes, and their drives."""

    def __init__(self, limits=None, mode=CSP, values=None, lacks=(), **options):
        there = dict.fromkeys(EVERYTHING, 0) | {BRAKING: 200 * TURN, RESOLUTION: TURN, TURNS: 1} | (values or {})
        self.drives = HeldObjects({key: value for key, value in there.items() if key not in lacks}, 2, **options)
        self.axes = Axes(self.drives)
        self.limits = LimitsInForce(limits or Limits(), self.drives, self.axes, Lending(self.drives))
        self.axes.mode[:] = mode
        self.asked = 0
        self.commands = Commands(self.drives, self.axes, self.limits, self._modes)
        self.limits.bounds()

    def _modes(self):
        self.asked += 1
        return self.axes.mode

    def entry(self, key):
        return self.drives.entries[key]

    def write(self, key, value, where=(True, True)):
        raw = np.broadcast_to(np.asarray(value, np.int64), (2,))
        self.commands.check_write(self.entry(key), raw, np.array(where))
        self.commands.note(key, raw, np.array(where))

    def play(self, **rows):
        keys = {"word": WORD, "mode": MODE, "target": TARGET, "offset": OFFSET, "speed": SPEED, "torque": TORQUE,
                "speed_offset": SPEED_OFFSET, "profile": PROFILE, "resolution": RESOLUTION}  # fmt: skip
        played = {
            self.entry(keys[name]): np.broadcast_to(np.array(values, np.int64)[:, None], (len(values), 2))
            for name, values in rows.items()
        }
        self.commands.check_play(played, played.get(self.entry(WORD)))
        return played

    def refuses(self, match, key, value, where=(True, True)):
        with pytest.raises(SafetyError, match=match):
            self.write(key, value, where)


# --- one value ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("key", "limit", "remedy"),
    [
        (SPEED, 500, r"Limits\(velocity=\.\.\.\)"), (PROFILE, 500, r"Limits\(velocity"), (SWITCH, 500, "Limits"),
        (ZERO, 500, "Limits"), (SPEED_OFFSET, 500, "Limits"), (TORQUE, 400, r"Limits\(current=\.\.\.\)"),
        (TORQUE_OFFSET, 400, r"Limits\(current"), (CURRENT_LIMIT, 400, r"Limits\(current"),
    ],
)  # fmt: skip
def test_a_magnitude_at_its_limit_and_beyond(key, limit, remedy, sign):
    bench = Bench(FAST)
    bench.write(key, sign * limit)
    bench.refuses(
        f"axis 1: .* = {sign * (limit + 1)} is beyond the limit {limit}; nothing was sent. Choose less, or raise "
        + remedy,
        key, [0, sign * (limit + 1)],
    )  # fmt: skip
    bench.write(key, [0, sign * (limit + 1)], (True, False))  # that axis is not written


@pytest.mark.parametrize(("first", "second"), [(SPEED, SPEED_OFFSET), (SPEED_OFFSET, SPEED)])
def test_set_points_that_add_up_are_held_together_whoever_came_first(first, second):
    bench = Bench(FAST)
    bench.write(first, [300, -300])
    bench.write(second, [200, -200])
    bench.refuses("axis 0: .* = 501 is beyond the limit 500", second, [201, 0])
    bench.refuses("axis 0: .* = 501 is beyond", second, [501 - 300, 0])
    bench.write(second, [-500, 0])
    bench.refuses("beyond the limit 500", second, [-501, 0])  # by itself, though their sum is less
    bench.drives.values[first][:] = 0
    bench.commands.forget(first)
    bench.write(second, 500)  # nobody knows what the drive has: it is read


def test_what_was_written_to_one_axis_is_the_others_not():
    bench = Bench(FAST)
    bench.write(SPEED, 300, (True, False))
    bench.write(SPEED_OFFSET, [200, 500])
    bench.refuses("axis 1: .* = 501", SPEED_OFFSET, [0, 501])
    bench.commands.forget()
    bench.write(SPEED_OFFSET, 500)


@pytest.mark.parametrize(
    ("values", "limits", "remedy"),
    [
        ({(0x607F, 0): 500}, Limits(), "the drive's own limit, 607Fh"),
        ({BRAKING: 500}, Limits(), "the quick stop's ramp, 6085h: no axis may be faster than it stops within 1 s"),
        ({}, Limits(), r"Limits\(velocity=...\): this drive has no limit of its own; 6,000 rpm is used"),
    ],
)
def test_whose_limit_of_speed_it_is(values, limits, remedy):
    Bench(limits, PV, values).refuses(remedy, SPEED, 100 * TURN + 1)


@pytest.mark.parametrize(("own", "limits", "limit", "remedy"), [
    (300, Limits(), 300, "the drive's own limit, 2003h"), (300, Limits(current=400.0), 400, r"Limits\(current"),
])  # fmt: skip
def test_whose_limit_of_current_it_is(own, limits, limit, remedy):
    bench = Bench(limits, values={CURRENT_LIMIT: own})
    bench.write(TORQUE, limit)
    bench.refuses(remedy, TORQUE, limit + 1)
    bench = Bench(limits, values={CURRENT_LIMIT: own})
    if limits.current is None:
        bench.write(CURRENT_LIMIT, 10**6)  # the drive's own is the program's to raise


def test_a_drive_without_a_current_limit_takes_any_torque():
    Bench(lacks=(CURRENT_LIMIT,)).write(TORQUE, 2**15 - 1)


# --- positions ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("mode", "target", "offset"), [(CSP, False, False), (PP, True, True), (CSV, True, True)])
def test_a_place_beyond_the_travel_counts_in_csp_when_it_is_written(mode, target, offset, sign):
    """In pp it is looked at when the move is started; in other modes it commands nothing."""
    bench = Bench(TRAVEL, mode)
    bench.write(TARGET, 1000 * sign)
    for key, goes in ((TARGET, target), (OFFSET, offset)):
        bench.commands.forget()
        if goes:
            bench.write(key, 1001 * sign)
        else:
            bench.refuses(
                f"would lead to {1001 * sign}, beyond the limits -1000 to 1000; .* or widen", key, 1001 * sign
            )


def test_target_and_offset_of_csp_add_up():
    bench = Bench(TRAVEL)
    bench.write(TARGET, 600)
    bench.write(OFFSET, 400)
    bench.refuses("axis 0: .* would lead to 1001", OFFSET, 401)
    bench.refuses("would lead to 1001", TARGET, 601)
    bench.write(TARGET, -1400)


@pytest.mark.parametrize("word", [NEW, RELATIVE])
def test_a_move_is_held_against_its_travel_when_it_is_started(word):
    bench = Bench(TRAVEL, PP, {TARGET: (300, 301), DEMAND: 700})
    both = np.array([True, True])
    if word == NEW:
        bench.commands.check_start(np.array([word] * 2), both)
        bench.drives.values[TARGET][:] = (0, 1001)
    with pytest.raises(SafetyError, match=r"axis 1: .* would lead to 1001, beyond the limits"):
        bench.commands.check_start(np.array([word] * 2), both)
    bench.commands.check_start(np.array([word] * 2), np.array([True, False]))
    bench.commands.check_start(np.array([word, 0x0F]), both)  # no new set-point
    bench.commands.check_start(np.array([word, word & ~0x08]), both)  # it does not enable
    bench.axes.mode[1] = PV
    bench.commands.check_start(np.array([word] * 2), both)


@pytest.mark.parametrize(
    ("options", "position", "goes"), [(0, 900, True), (1, 900, False), (2, 900, False), (4, 900, True)]
)
def test_a_relative_move_goes_on_from_the_target_before_the_demand_or_where_the_axis_is(options, position, goes):
    """60F2h, bits 0 and 1: with any of them set the actual position counts, too."""
    bench = Bench(TRAVEL, PP, {TARGET: 200, OPTIONS: options, POSITION: position, DEMAND: 0})
    bench.limits._of_rotors = bench.limits._capture()
    bench.axes.rotor.place(np.array([0, 0]), np.full(2, float(TURN)), np.zeros(2))
    bench.limits.forget()
    words, both = np.array([RELATIVE] * 2), np.array([True, True])
    bench.axes.mode[:] = PP
    limits = bench.limits.bounds()
    limits.low[:], limits.high[:] = -1000, 1000
    bench.limits.latest = limits
    if goes:
        bench.commands.check_start(words, both)
    else:
        with pytest.raises(SafetyError, match="would lead to 1100"):
            bench.commands.check_start(words, both)
    bench.axes.aim = {0: 900}  # the move before leads there
    with pytest.raises(SafetyError, match=r"axis 0: .* would lead to 1100"):
        bench.commands.check_start(words, both)


def test_where_moves_lead_is_noted_when_they_are_started():
    bench = Bench(TRAVEL, (PP, PP))
    both = np.array([True, True])
    bench.commands.note_start(np.array([NEW, NEW]), both)
    assert bench.axes.aim == {}  # nobody knows the target
    bench.write(TARGET, [100, 50])
    bench.axes.position[:] = (7, 8)
    bench.commands.note_start(np.array([NEW, RELATIVE]), both)
    assert bench.axes.aim == {0: 100, 1: 58}
    bench.commands.note_start(np.array([RELATIVE, RELATIVE]), both)
    assert bench.axes.aim == {0: 200, 1: 108}
    bench.commands.note_start(np.array([0x0F, 0x13]), both)  # no set-point; not enabled
    bench.commands.note_start(np.array([NEW, NEW]), np.array([False, False]))
    bench.axes.mode[:] = PV
    bench.commands.note_start(np.array([NEW, NEW]), both)
    assert bench.axes.aim == {0: 200, 1: 108}


# --- rows -----------------------------------------------------------------------------------------------------------
def test_rows_of_csp_are_held_with_their_offset():
    bench = Bench(TRAVEL)
    bench.play(target=[0, 1000, -1000])
    bench.play(target=[500, 600], offset=[500, 400])
    for rows in ({"target": [0, 1001]}, {"offset": [0, -1001]}, {"target": [500, 600], "offset": [500, 401]}):
        with pytest.raises(SafetyError, match=r"would lead to -?1001"):
            bench.play(**rows)
    bench.commands.note(OFFSET, np.array([300, 300]), np.array([True, True]))
    bench.play(target=[700])
    with pytest.raises(SafetyError, match="would lead to 1001"):
        bench.play(target=[701])
    with pytest.raises(SafetyError, match="would lead to 1302, beyond"):  # the first row that is wrong
        bench.play(target=[0, 1002, 1500, 0])
    bench.play(target=[])
    bench.axes.mode[:] = PP
    bench.play(target=[1000])  # in pp the target alone
    with pytest.raises(SafetyError, match="would lead to 1001"):
        bench.play(target=[1001])


def test_rows_of_relative_moves_add_up_as_bit_4_rises():
    bench = Bench(TRAVEL, PP)
    low = 0x4F
    bench.play(word=[RELATIVE, low, RELATIVE], target=[500, 0, 500])
    bench.play(word=[RELATIVE, RELATIVE, RELATIVE], target=[600, 600, 600])  # it rises once
    with pytest.raises(SafetyError, match="would lead to 1001"):
        bench.play(word=[RELATIVE, low, RELATIVE], target=[500, 0, 501])
    with pytest.raises(SafetyError, match="would lead to 1001"):
        bench.play(word=[NEW, 0x0F, RELATIVE, low], target=[1001, 0, 0, 0])
    bench.drives.values[TARGET][:] = 1001  # no row has the target: the drive has it
    with pytest.raises(SafetyError, match="would lead to 1001"):
        bench.play(word=[RELATIVE])
    Bench(None, PP).play(word=[RELATIVE], target=[10**6])


def test_rows_of_set_points_that_add_up():
    bench = Bench(FAST, CSV)
    bench.play(speed=[500, -500, 300], speed_offset=[0, 0, 200])
    with pytest.raises(SafetyError, match=r"axis 0: .* = 501 is beyond"):
        bench.play(speed=[500, -500, 300], speed_offset=[0, 0, 201])
    with pytest.raises(SafetyError, match=r"axis 0: .* = 502 is beyond"):  # the first row that is wrong
        bench.play(speed=[0, 502, 999])
    bench.commands.note(SPEED_OFFSET, np.array([200, 0]), np.array([True, True]))
    with pytest.raises(SafetyError, match=r"axis 0: .* = 501 is beyond"):
        bench.play(speed=[301])


def test_what_changes_the_scale_is_not_played_and_not_written_to_an_axis_that_may_turn():
    bench = Bench(TRAVEL)
    with pytest.raises(SafetyError, match="changes the scale of positions, and is not played; write it"):
        bench.play(resolution=[TURN])
    bench.write(RESOLUTION, TURN)
    bench.axes.assumed[1] = True
    bench.refuses("changes the scale of positions, and the axis is enabled; nothing was sent", RESOLUTION, TURN)
    bench.write(RESOLUTION, TURN, (True, False))


@pytest.mark.parametrize(("limits", "goes"), [(TRAVEL, False), (FAST, True)])
def test_what_turns_positions_round_is_not_written_with_limits_of_places(limits, goes):
    bench = Bench(limits)
    bench.drives.description.hints.turns_positions_round = (PROFILE,)
    if goes:
        bench.write(PROFILE, 5)
    else:
        bench.refuses("turns positions round, and Limits.position=.... hold for the present direction", PROFILE, 5)


# --- speeds that a drive has already ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("mode", "values", "names"),
    [
        (PV, {SPEED: (0, 501)}, "60FFh"),
        (CSV, {SPEED: (0, -501)}, "60FFh"),
        (CSV, {SPEED: (500, 300), SPEED_OFFSET: (0, 201)}, "60FFh.* [+] .*60B1h"),
    ],
)
def test_an_axis_whose_drive_has_too_high_a_speed_for_its_mode_is_not_enabled(mode, values, names):
    bench = Bench(FAST, mode, values)
    both = np.array([True, True])
    with pytest.raises(SafetyError, match=f"axis 1: its drive has .*{names}.* = -?501, beyond the limit 500; nothing"):
        bench.commands.check_modes(both)
    bench.commands.check_modes(np.array([True, False]))
    bench.commands.check_modes(np.array([False, False]))
    bench.commands.check_modes(both, np.array([PP, PP]))  # it does not turn by that in pp
    with pytest.raises(SafetyError, match="axis 1"):
        bench.commands.check_modes(both, np.array([[PP, PP], [mode, mode]]))  # rows of modes
    bench.commands.check_modes(
        both, played={bench.entry(SPEED): np.zeros((1, 2))}
    )  # rows, which are checked themselves


@pytest.mark.parametrize(("mode", "key"), [(PP, PROFILE), (HM, SWITCH), (HM, ZERO)])
def test_a_move_is_not_started_at_a_speed_beyond_the_limit(mode, key):
    bench = Bench(FAST, mode, {key: (501, 0)})
    both = np.array([True, True])
    bench.commands.check_modes(both)  # it is enabled, and stands
    with pytest.raises(SafetyError, match=r"axis 0: its drive has .* = 501, beyond the limit 500"):
        bench.commands.check_start(np.array([NEW, NEW]), both)
    with pytest.raises(SafetyError, match="axis 0: its drive has"):
        bench.commands.check_played_starts(np.array([[0x0F, 0x0F], [NEW, NEW]]), {})
    bench.commands.check_played_starts(np.array([[0x0F, NEW], [0x0F, 0x0F]]), {})
    bench.commands.check_played_starts(np.array([[NEW, NEW]]), {bench.entry(key): np.zeros((1, 2))})


@pytest.mark.parametrize("mode", [TQ, CSP, CST])
def test_modes_without_a_limit_of_speed_want_a_quick_stop_from_6000_rpm_within_a_second(mode):
    both = np.array([True, True])
    Bench(None, mode, {BRAKING: 100 * TURN}).commands.check_modes(both)
    slow = Bench(None, mode, {BRAKING: (100 * TURN, 100 * TURN - 1)})
    with pytest.raises(
        SafetyError, match=rf"axis 1: .* 6085h = {100 * TURN - 1} is too slow .* at {100 * TURN} or more"
    ):
        slow.commands.check_modes(both)
    slow.commands.check_modes(np.array([True, False]))
    slow.commands.check_modes(both, np.array([PV, PV]))
    Bench(None, mode, {BRAKING: 1}, units={0x6085: ""}).commands.check_modes(both)  # in no unit that we know
    Bench(None, mode, lacks=(BRAKING,)).commands.check_modes(both)
    Bench(None, mode, {BRAKING: 1, RESOLUTION: 1}).commands.check_modes(both)  # the scale is not known


@pytest.mark.parametrize(("axis_speed", "by_drive", "refused"), [(0, 500, False), (0, 501, True), (0, -501, True)])
def test_an_axis_that_coasts_too_fast_is_not_enabled(axis_speed, by_drive, refused):
    bench = Bench(FAST, PV, {VELOCITY: (0, by_drive)})
    both = np.array([True, True])
    bench.commands.check_turning(np.array([True, False]))
    if not refused:
        bench.commands.check_turning(both)
        return
    with pytest.raises(
        SafetyError, match="axis 1: it turns though it is off, 501 by 606Ch, beyond the limit 500; it was"
    ):
        bench.commands.check_turning(both)


def test_a_ramp_that_would_not_stop_an_axis_from_its_speed_within_a_second_is_refused():
    bench = Bench(None, PV)
    bench.axes.live[:] = True
    bench.axes.velocity[:] = (500.0, -500.0)
    bench.write(BRAKING, 500)
    bench.refuses(r"axis 0: .* = 499 would not stop it within 1 s from its 500 pps; nothing was sent", BRAKING, 499)
    bench.axes.live[:] = False
    bench.write(BRAKING, 499)


def test_each_axis_has_a_ramp_of_its_own_for_its_own_speed():
    bench = Bench(None, PV)
    bench.axes.live[:] = True
    bench.axes.velocity[:] = (50.0, -500.0)
    bench.write(BRAKING, [50, 500])
    bench.refuses(r"axis 1: .* = 499 would not stop it", BRAKING, [50, 499])
    bench.refuses(r"axis 0: .* = 49 would not stop it", BRAKING, [49, 500])


@pytest.mark.parametrize(
    ("mode", "value", "refused"), [(CSP, 100 * TURN, False), (CSP, 100 * TURN - 1, True), (PV, 5, False)]
)
def test_a_ramp_too_slow_for_a_mode_without_a_limit_of_speed_is_refused_while_it_is_on(mode, value, refused):
    bench = Bench(None, mode)
    bench.axes.assumed[0] = True
    if refused:
        bench.refuses("axis 0: nothing limits the speed in ip, csp, tq or cst", BRAKING, value)
    else:
        bench.write(BRAKING, value)
    bench.axes.assumed[0] = False
    bench.write(BRAKING, value)


def test_a_ramp_slower_than_the_speed_that_the_drive_has_is_refused():
    bench = Bench(None, PV, {SPEED: (500, 0)})
    bench.axes.assumed[:] = True
    bench.write(BRAKING, 500)
    bench.refuses("axis 0: its drive has .* = 500, beyond the limit 499", BRAKING, 499)


def test_a_mode_is_held_against_an_axis_that_may_turn():
    bench = Bench(FAST, PP, {SPEED: (501, 501)})
    bench.write(MODE, PV)
    bench.axes.assumed[1] = True
    bench.refuses("axis 1: its drive has", MODE, PV)
    with pytest.raises(SafetyError, match="axis 0: its drive has"):
        bench.play(mode=[PP, PV])  # other rows may enable


@pytest.mark.parametrize(
    ("scale", "limits", "goes"), [(50, TRAVEL, True), (49, TRAVEL, False), (49, FAST, True), (1, TRAVEL, False)]
)
def test_a_travel_that_is_told_too_coarsely_is_not_watched(scale, limits, goes):
    """A fiftieth of a turn is the slack of a travel: it must be an increment at least."""
    bench = Bench(limits, PV, {RESOLUTION: scale})
    both = np.array([True, True])
    if goes:
        bench.commands.check_modes(both)
        return
    with pytest.raises(SafetyError, match=rf"axis 0: a revolution has {scale} increments \(608Fh\), .* Set 50 or more"):
        bench.commands.check_modes(both)
