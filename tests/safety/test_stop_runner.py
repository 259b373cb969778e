"""Which axes are stopped, by which ramps, and what is said of those that are held or lost."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.held_objects import HeldObjects

from drive_env import SafetyError, cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety.axes import Axes
from drive_env.safety.lending import Lending
from drive_env.safety.stop_runner import StopRunner
from drive_env.safety.stopping import Phase

STATUS, POSITION, VELOCITY, WORD = (0x6041, 0), (0x6064, 0), (0x606C, 0), (0x6040, 0)
QUICK, DISABLE, HALT, FAULT = (0x605A, 0), (0x605C, 0), (0x605D, 0), (0x605E, 0)
SLOW, FAST, HOMING = (0x6084, 0), (0x6083, 0), (0x609A, 0)
PP, PV, HM = 1, 3, 6
MODE, GATE, REMOTE = (0x6060, 0), (0x2303, 0), 0x0200
OFF, ENABLED, STOPPING = 0x0240, 0x0637, 0x0617
OPTIONS = {QUICK: 2, DISABLE: 1, HALT: 1, FAULT: 2}


def runner_of(values=None, count=2, *, bounds=None, latest=True, ranges=None, **options):
    """A runner over axes that are enabled, what it sent, and its drives."""
    there = dict.fromkeys((STATUS, POSITION, VELOCITY, WORD), 0) | OPTIONS | (values or {})
    drives = HeldObjects(there, count, **options)
    drives.time_waits, drives.sent, drives.asked, drives.started = True, [], [], 0

    def start():
        drives.started += 1

    def ask(node, index, sub, timeout):
        drives.asked.append((node, index))
        value = drives.values[index, sub][node]
        return None if value == 99 else int(value).to_bytes(2, "little")

    drives.sdo = lambda node: SimpleNamespace(
        command=lambda index, sub, data: drives.sent.append((node, int.from_bytes(data, "little"))),
        ask=lambda index, sub, timeout: ask(node, index, sub, timeout),
    )
    drives.start, drives.must_start = start, lambda: None
    drives.description.key = lambda entry, part: (entry.index, entry.sub)
    drives.description.encode = lambda entry, value: int(value).to_bytes(2, "little")
    drives.description.decode = lambda entry, data: int.from_bytes(data, "little")
    drives.description.answer_timeout = 0.1
    axes = Axes(drives)
    axes.place(np.zeros(count, np.int64), np.full(count, 1000.0))
    axes.live[:], axes.status[:], axes.mode[:], axes.clock = True, ENABLED, PP, 10.0
    full = {
        "low": -NO_LIMIT,
        "high": NO_LIMIT,
        "braking": 1000.0,
        "rest": 10.0,
        "current": 400,
        "settled": 20.0,
        "slack": 50.0,
        "lag": 0.0,
        "slowing": 0.0,
    } | (bounds or {})
    found = SimpleNamespace(**{name: np.full(count, value) for name, value in full.items()})
    limits = SimpleNamespace(bounds=lambda: found, latest=found if latest else None)
    ceased = []
    lending = Lending(drives)
    runner = StopRunner(drives, axes, limits, lending, lambda: ceased.append(1))
    return SimpleNamespace(runner=runner, drives=drives, axes=axes, lending=lending, ceased=ceased)


def see(bench, status, speed=0.0, seconds=0.001, axis=None):
    """Let time pass, have axes seen, and step."""
    bench.axes.clock += seconds
    where = slice(None) if axis is None else axis
    bench.axes.seen[where], bench.axes.status[where], bench.axes.speed[where] = bench.axes.clock, status, speed
    bench.runner.step()


# --- options of stops ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("key", "own", "has"), [
    (QUICK, 0, 2), (QUICK, 1, 2), (QUICK, 2, 2), (QUICK, 3, 3), (QUICK, 5, 6), (QUICK, 6, 6),
    (DISABLE, 0, 1), (DISABLE, 1, 1), (HALT, 0, 1), (HALT, 1, 1), (HALT, 2, 2),
    (FAULT, 0, 2), (FAULT, 1, 2), (FAULT, 2, 2),
])  # fmt: skip
def test_what_would_coast_or_ramp_as_a_profile_does_ramps_by_6085h_meanwhile(key, own, has):
    bench = runner_of({key: (own, OPTIONS[key])})
    bench.runner.make_sure_of_ramps()
    assert bench.drives.values[key].tolist() == [has, OPTIONS[key]]
    assert bench.lending.is_lent(key, 0) == (own != has)


def test_a_drive_whose_quick_stop_coasts_is_not_moved_and_other_options_are_told(caplog):
    bench = runner_of({QUICK: 0}, takes={QUICK: lambda value: None})
    with pytest.raises(SafetyError, match=r"axis 0: its quick stop lets it coast .605Ah = 0.*write 605Ah = 2"):
        bench.runner.make_sure_of_ramps()
    bench = runner_of({QUICK: 1}, takes={QUICK: lambda value: None})
    bench.runner.make_sure_of_ramps()  # its profile's ramp is one
    bench = runner_of({DISABLE: (1, 0)}, takes={DISABLE: lambda value: None})
    bench.runner.make_sure_of_ramps()
    assert "axis 1: 605Ch:00 object 605Ch = 0 lets it coast" in caplog.text


def test_a_drive_without_options_ramps():
    bench = runner_of()
    for key in OPTIONS:
        bench.drives.entries.pop(key)
    bench.runner.make_sure_of_ramps()
    bench.runner.keep_ramps(SLOW, np.array([0]), np.array([True, True]))
    assert not bench.drives.log


@pytest.mark.parametrize(("raw", "where", "lent"), [
    (0, (True, True), [True, True]), (0, (True, False), [True, False]), (2, (True, True), [False, False]),
    ((0, 2), (True, True), [True, False]), ((1, 5), (True, True), [True, True]),
])  # fmt: skip
def test_an_option_that_is_about_to_be_written_is_for_afterwards(raw, where, lent):
    bench = runner_of()
    bench.runner.keep_ramps(QUICK, np.array(raw), np.array(where))
    assert [bench.lending.is_lent(QUICK, axis) for axis in (0, 1)] == lent
    bench.drives.log.clear()
    bench.runner.keep_ramps(QUICK, np.array(raw), np.array(where))  # it is lent already
    assert not bench.drives.log


def test_an_option_that_a_drive_lacks_does_not_hide_the_others():
    bench = runner_of({HALT: 0, FAULT: (0, 1)})
    del bench.drives.entries[QUICK]
    bench.runner.make_sure_of_ramps()
    assert bench.drives.values[HALT].tolist() == [1, 1]
    assert bench.drives.values[FAULT].tolist() == [2, 2]


def test_an_option_that_coasts_is_not_written_where_no_other_is_taken():
    bench = runner_of(takes={QUICK: lambda value: None})
    with pytest.raises(SafetyError, match=r"axis 1: 605Ah:00 object 605Ah = 0 would let it coast.*nothing was sent"):
        bench.runner.keep_ramps(QUICK, np.array([2, 0]), np.array([True, True]))
    bench.runner.keep_ramps(QUICK, np.array([2, 1]), np.array([True, True]))


def test_an_axis_that_is_enabled_anew_has_its_quick_stop_option_again():
    bench = runner_of({QUICK: (2, 1)})
    for axis, held in ((0, 6), (1, 5)):
        bench.lending.lend(QUICK, axis, held)
        bench.runner.end_hold(axis)
    assert bench.drives.values[QUICK].tolist() == [2, 2]  # 1 is the profile's ramp: 2 meanwhile
    assert not bench.lending.is_lent(QUICK, 0) and bench.lending.is_lent(QUICK, 1)
    bench.drives.log.clear()
    bench.runner.end_hold(0)
    assert not bench.drives.log


# --- what takes the voltage away ----------------------------------------------------------------------------------
@pytest.mark.parametrize(("words", "options", "cuts"), [
    ([0, 0], (1, 1), [True, True]), ([6, 0xF], (1, 1), [True, False]), ([7, 7], (1, 1), [False, False]),
    ([7, 7], (0, 1), [True, False]), ([0xF, 0xF], (0, 0), [False, False]), ([2, 2], (0, 0), [False, False]),
])  # fmt: skip
def test_what_cuts_the_voltage_by_the_option_that_each_axis_has(words, options, cuts):
    bench = runner_of({DISABLE: options})
    assert bench.runner.cuts(np.array(words)).tolist() == cuts


def test_a_drive_whose_eds_has_no_option_that_coasts_is_not_asked():
    bench = runner_of({DISABLE: 0})
    entry = bench.drives.entries[DISABLE]
    for low, cuts in ((1, False), (0, True), (-1, True), (None, True)):
        bench.drives.entries[DISABLE] = SimpleNamespace(index=entry.index, sub=0, low=low)
        assert bench.runner.cuts(np.array([7, 7])).tolist() == [cuts, cuts]
    del bench.drives.entries[DISABLE]
    assert bench.runner.cuts(np.array([7, 7])).tolist() == [False, False]


@pytest.mark.parametrize(
    ("values", "mode", "ramp"),
    [
        ({}, PP, np.inf),
        ({SLOW: 500}, PP, 500.0),
        ({SLOW: 0}, PP, 0.0),
        ({SLOW: 500, FAST: 300}, PP, 500.0),
        ({SLOW: 500, FAST: 300}, PV, 300.0),  # some drives have one ramp for both ways in pv
        ({SLOW: 500, FAST: 700}, PV, 500.0),
        ({SLOW: 500, HOMING: 200}, HM, 200.0),
        ({SLOW: 500, HOMING: 200}, PV, 500.0),
        ({SLOW: 500, HOMING: 0}, HM, 500.0),  # it has none of its own
    ],
)
def test_disable_operation_ramps_by_the_least_that_its_mode_may_have(values, mode, ramp):
    bench = runner_of(values, bounds={"braking": 400.0})
    bench.axes.mode[:] = mode
    assert bench.runner.may_ramp_slowly().tolist() == [ramp < 400.0] * 2
    found = bench.runner._disabling_ramp()
    assert found.tolist() == [ramp, ramp]


@pytest.mark.parametrize(("braking", "slowly"), [(499.0, False), (500.0, False), (501.0, True)])
def test_a_ramp_as_steep_as_a_quick_stop_is_not_slow(braking, slowly):
    assert runner_of({SLOW: 500}, bounds={"braking": braking}).runner.may_ramp_slowly().tolist() == [slowly] * 2


def test_a_ramp_in_an_unknown_unit_is_not_known():
    bench = runner_of({SLOW: 500}, units={SLOW[0]: ""})
    assert bench.runner._disabling_ramp().tolist() == [np.inf, np.inf]
    bench = runner_of({SLOW: 60}, units={SLOW[0]: "rpm/s"})
    np.testing.assert_allclose(bench.runner._disabling_ramp(), [1000.0, 1000.0])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("speed", "position", "slow"),
    [
        (500.0, 0, False),  # stands after a second
        (500.5, 0, True),
        (100.0, 989, False),  # 10 increments by the ramp, 1 before it begins
        (100.0, 990, True),
        (-100.0, 990, False),
    ],
)
def test_a_ramp_that_leaves_the_travel_or_takes_longer_than_a_second_is_slow(speed, position, slow, sign):
    bench = runner_of({SLOW: 500}, bounds={"low": -1000, "high": 1000})
    bench.axes.position[:] = position * sign
    for name in ("speed", "velocity"):  # whichever is faster
        setattr(bench.axes, name, np.array([speed * sign, 0.0]))
        setattr(bench.axes, "velocity" if name == "speed" else "speed", np.zeros(2))
        assert bench.runner.slow_ramps().tolist() == [slow, False]
    assert not runner_of({SLOW: 1000}, bounds={"low": 0, "high": 0}).runner.slow_ramps().any()  # as a quick stop


# --- stops --------------------------------------------------------------------------------------------------------
def test_a_stop_sends_a_quick_stop_and_its_error_says_what_and_what_to_do():
    bench = runner_of()
    bench.axes.live[1] = False
    with pytest.raises(SafetyError, match=r"^too fast: the drives were quick-stopped; go slower$"):
        bench.runner.stop_for("too fast", "go slower")
    assert bench.drives.sent == [(0, cia402.QUICK_STOP)]
    assert list(bench.runner.current.axes) == [0] and bench.runner.current.axes[0].holds
    assert bench.runner.judged().tolist() == [False, False]


def test_what_was_told_to_hold_is_released_by_a_stop_that_does_not():
    bench = runner_of()
    bench.runner.begin(np.array([True, True]), holds=True)
    first = dict(bench.runner.current.axes)
    bench.runner.begin(np.array([True, False]), holds=True)  # it goes on
    assert bench.runner.current.axes == first and all(one.holds for one in first.values())
    bench.runner.begin(np.array([True, False]), holds=False)
    assert [one.holds for one in first.values()] == [False, True]


def test_an_axis_that_moved_again_after_it_stood_is_stopped_anew_and_one_that_is_off_too():
    bench = runner_of()
    bench.runner.begin(np.array([True, True]), holds=True)
    for _ in range(30):
        see(bench, STOPPING, axis=0)
    for _ in range(3):
        see(bench, OFF, axis=1)
    assert [one.phase for one in bench.runner.current.axes.values()] == [Phase.REST, Phase.OFF]
    before = dict(bench.runner.current.axes)
    bench.runner.begin(np.array([True, True]), holds=True)
    assert all(bench.runner.current.axes[axis] is not before[axis] for axis in (0, 1))
    assert all(one.phase is Phase.RAMP for one in bench.runner.current.axes.values())


@pytest.mark.parametrize(
    ("current", "mean", "held"),
    [(400, 12.0, False), (400, 12.5, True), (400, -12.5, True), (400, -12.0, False), (NO_LIMIT, 1e6, False)],
)
def test_an_axis_at_rest_is_held_only_under_a_weight(current, mean, held, caplog):
    """A drive that is held in quick stop active may not watch over its master."""
    bench = runner_of(count=1, bounds={"current": current})
    bench.runner.begin(np.array([True]), holds=True)
    bench.axes.mean_current[:] = mean
    for _ in range(30):
        see(bench, STOPPING)
    assert bench.runner.current.axes[0].phase is Phase.REST
    rested = bench.runner.current.axes[0].rests_for(bench.axes.clock)
    see(bench, STOPPING, seconds=0.0599 - rested)
    assert bench.runner.current.axes[0].phase is Phase.REST
    for _ in range(5):
        see(bench, STOPPING)
    assert bench.runner.current.axes[0].phase is (Phase.REST if held else Phase.CUT)
    told = f"axis 0 is held in quick stop active: it takes a current of {int(mean)} at rest"
    assert caplog.text.count(told) == (1 if held else 0)


def test_limits_that_nobody_has_read_yet_are_no_limits():
    bench = runner_of(count=1, latest=False)
    bench.axes.speed[:] = -500.0
    bench.runner.begin(np.array([True]), holds=True)
    one = bench.runner.current.axes[0]
    assert (one._first, one._deceleration, one._rest) == (500.0, 0.0, 0.0)
    bench = runner_of(count=1)
    bench.axes.speed[:], bench.axes.velocity[:] = 400.0, -500.0
    bench.runner.begin(np.array([True]), holds=True)
    one = bench.runner.current.axes[0]
    assert (one._first, one._deceleration, one._rest) == (500.0, 1000.0, 10.0)


@pytest.mark.parametrize(("option", "held"), [(1, 5), (2, 6), (5, 5), (6, 6), (3, 3)])
def test_a_quick_stop_that_would_end_off_ends_in_quick_stop_active(option, held):
    bench = runner_of({QUICK: option}, count=1)
    bench.runner.hold()
    assert not bench.drives.asked  # nothing is stopped
    bench.runner.begin(np.array([True]), holds=True)
    bench.runner.hold()
    bench.runner.hold()
    assert bench.drives.asked == [(0, 0x605A)]  # once for a stop
    assert bench.drives.values[QUICK] == held


def test_who_is_switched_off_anyway_or_does_not_answer_is_not_held():
    bench = runner_of({QUICK: (2, 2)})
    bench.runner.begin(np.array([True, True]), holds=False)
    bench.runner.hold()
    assert not bench.drives.asked
    bench = runner_of({QUICK: (99, 2)})  # 99: no answer
    bench.runner.begin(np.array([True, True]), holds=True)
    bench.runner.hold()
    bench.runner.hold()
    assert bench.drives.asked == [(0, 0x605A), (1, 0x605A), (0, 0x605A)]
    assert bench.drives.values[QUICK].tolist() == [99, 6]


def test_one_axis_that_need_not_be_held_does_not_hide_the_next():
    bench = runner_of({QUICK: (1, 1)})
    bench.runner.begin(np.array([True, False]), holds=False)
    bench.runner.begin(np.array([False, True]), holds=True)
    bench.runner.hold()
    assert bench.drives.values[QUICK].tolist() == [1, 5]


def test_a_node_that_is_not_seen_any_more_is_woken_five_times_a_second_and_given_up(caplog):
    bench = runner_of(count=1)
    bench.runner.begin(np.array([True]), holds=False)
    for _ in range(1200):
        bench.axes.clock += 0.001
        bench.runner.step()
    assert "axis 0: its position was not received for 0.4 s; its voltage is switched off" in caplog.text
    assert "axis 0 does not answer, and is left to its watchdog" in caplog.text
    # not seen for 0.4 s, and given up 0.6 s later
    assert bench.drives.started in (3, 4)
    assert bench.axes.lost == {0} and bench.ceased == [1]
    assert not bench.runner.judged().any()


def test_an_axis_that_stays_in_its_phase_does_not_hide_the_next_that_is_lost(caplog):
    bench = runner_of()
    bench.runner.begin(np.array([True, True]), holds=True)
    for _ in range(1200):
        bench.axes.mean_current[0] = 400  # the first stands, held under a weight; nothing comes of the second
        see(bench, STOPPING, axis=0)
    assert bench.axes.lost == {1} and bench.ceased == [1]
    assert "axis 1 does not answer, and is left to its watchdog" in caplog.text


def test_who_enables_an_axis_again_has_it_judged_again():
    bench = runner_of(count=1)
    assert bench.runner.judged().all()
    bench.runner.begin(np.array([True]), holds=True)
    for _ in range(30):
        see(bench, STOPPING)
    assert not bench.runner.judged().any()
    bench.axes.status[:] = ENABLED
    assert bench.runner.judged().all()
    bench.axes.live[:] = False
    assert not bench.runner.judged().any()


def test_the_mode_that_an_axis_is_asked_for_says_which_own_mode_lets_it_hear_a_stop():
    """Another master has taken an axis from pp to csp, and its D-Mode fits neither: that of csp is written."""
    bench = runner_of({MODE: (8, 99), GATE: 0})
    known = bench.drives.description.dictionary
    known.find = lambda key: bench.drives.entries[GATE if key is Role.MODE_GATE else key]
    bench.drives.device = SimpleNamespace(mode_gate={PP: 3, 8: 5})
    bench.drives.sdo = lambda node, sdo=bench.drives.sdo: SimpleNamespace(
        ask=sdo(node).ask,
        command=lambda index, sub, data: bench.drives.sent.append((node, index, int.from_bytes(data, "little"))),
    )
    bench.axes.status[:] = ENABLED & ~REMOTE
    bench.runner.begin(np.array([True, True]), holds=False)
    assert {sent for sent in bench.drives.sent if sent[1] == GATE[0]} == {(0, GATE[0], 3), (1, GATE[0], 3)}
    bench.runner.hold()
    assert (0, MODE[0]) in bench.drives.asked and (1, MODE[0]) in bench.drives.asked
    bench.drives.sent.clear()
    for _ in range(100):
        see(bench, ENABLED & ~REMOTE)
    own = {sent for sent in bench.drives.sent if sent[1] == GATE[0]}
    assert own == {(0, GATE[0], 5), (1, GATE[0], 3)}, "the second does not answer: as it was seen last"
    assert {sent[1] for sent in bench.drives.sent} == {GATE[0], WORD[0]}, "by turns with the controlword"
