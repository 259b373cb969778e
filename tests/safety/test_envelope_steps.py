"""What the envelope has its parts do for each write, play, reset and stop, in which order, and for which axes."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.held_objects import CURRENT_LIMIT, HeldObjects

from drive_env import Limits, SafetyError, cia402
from drive_env.dictionary.roles import Role
from drive_env.safety import envelope as module
from drive_env.safety.axes import Axes
from drive_env.safety.envelope import Envelope, swinging_allowed
from drive_env.safety.objects import SET_POINTS

WORD, STATUS, MODE, STORE, GATE = (0x6040, 0), (0x6041, 0), (0x6060, 0), (0x1010, 1), (0x2303, 0)
TARGET, SPEED, PROFILE, OFFSET, RESOLUTION = (0x607A, 0), (0x60FF, 0), (0x6081, 0), (0x607C, 0), (0x608F, 1)
QUICK, SLOW, FAST, HOMING, WINDOW = (0x605A, 0), (0x6084, 0), (0x6083, 0), (0x609A, 0), (0x6065, 0)
PRODUCER = (0x100F, 0)  # below 1010h
OBJECTS = (PRODUCER, WORD, STATUS, MODE, STORE, GATE, TARGET, SPEED, PROFILE, OFFSET, RESOLUTION, QUICK, SLOW, FAST,
           HOMING, WINDOW, CURRENT_LIMIT)  # fmt: skip
OFF, ENABLED = 0x0240, 0x0637
ENABLE, DISABLE, SHUTDOWN, STOP = 0x0F, 0x07, 0x06, 0x02
BOTH, FIRST, SECOND, NONE = (True, True), (True, False), (False, True), (False, False)


class Part:
    """A part of the envelope: what it is asked to do is listed, and what it answers is given."""

    def __init__(self, done):
        self._done, self.answers, self.current = done, {}, None

    def __getattr__(self, name):
        def act(*arguments, **named):
            listed = [np.asarray(a).tolist() if isinstance(a, np.ndarray) else a for a in arguments]
            self._done.append((name, *listed, *named.values()))
            answer = self.answers.get(name)
            if isinstance(answer, Exception):
                raise answer
            return answer() if callable(answer) else answer

        return act


class Bench:
    """An envelope of two axes whose parts list what they are asked for."""

    def __init__(self, **has):
        self.done = []
        drives = HeldObjects(dict.fromkeys(OBJECTS, 0) | has.pop("values", {}), 2)
        role = drives.description.role
        drives.description.role = lambda part: GATE if part is Role.MODE_GATE else role(part)
        for name in ("start", "must_start", "forget"):
            setattr(drives, name, lambda *a, name=name: self.done.append((name, *a)))
        self.drives, self.axes = drives, Axes(drives)
        self.stops, self.watch, self.commands, self.lending, self.watchdogs = (Part(self.done) for _ in range(5))
        self.limits = Part(self.done)
        self.limits.user = Limits()
        self.watch.booted, self.watch.is_supervised, self.watch.is_told_to_end = set(), False, False
        self.stops.answers |= {"cuts": lambda: np.array(NONE), "slow_ramps": lambda: np.array(BOTH),
                               "may_ramp_slowly": lambda: np.array(NONE)}  # fmt: skip
        self.watch.answers |= {"look_for_live": lambda: True, "modes": lambda: np.array([8, 9])}
        self.limits.answers["bounds"] = lambda: SimpleNamespace(rest=np.array([10.0, 10.0]))
        made = self.envelope = Envelope.__new__(Envelope)
        made._drives, made._known, made._axes = drives, drives.description.dictionary, self.axes
        made._stops, made._watch, made._commands = self.stops, self.watch, self.commands
        made._lending, made._watchdogs, made._limits = self.lending, self.watchdogs, self.limits
        made._checked_stop, made._is_closing, made._disabling = None, False, np.zeros(2, bool)
        made._of_further_axes, made._played, made._set_points = {}, {}, frozenset(SET_POINTS)

    def entry(self, key):
        return self.drives.entries[key]

    def names(self):
        return [what[0] for what in self.done]

    def asked(self, name):
        """Return what a part was asked for."""
        return [what[1:] for what in self.done if what[0] == name]

    def is_ready(self):
        """Have everything armed already, and both axes live."""
        self.axes.is_armed, self.axes.live = True, np.array(BOTH)
        return self

    def before(self, key, value=0, where=BOTH):
        raw = np.broadcast_to(np.asarray(value, np.int64), (2,))
        self.envelope.before_write(self.entry(key), raw, np.array(where))

    def after(self, key, value=0, where=BOTH):
        raw = np.broadcast_to(np.asarray(value, np.int64), (2,))
        self.envelope.after_write(self.entry(key), raw, np.array(where))

    def play(self, **rows):
        keys = {"word": WORD, "speed": SPEED, "profile": PROFILE, "slow": SLOW}
        played = {
            self.entry(keys[name]): np.array([np.broadcast_to(row, (2,)) for row in values], np.int64)
            for name, values in rows.items()
        }
        self.envelope.before_play(played)


@pytest.fixture(autouse=True)
def guarded(monkeypatch):
    """Signals are not taken over."""
    told = []
    monkeypatch.setattr(
        module,
        "signals",
        SimpleNamespace(guard=lambda one: told.append("guard"), release=lambda one: told.append("release")),
    )
    return told


# --- one value ----------------------------------------------------------------------------------------------------
def test_a_write_is_checked_after_the_stop_that_is_under_way():
    bench = Bench().is_ready()
    bench.before(PROFILE, 5)
    assert bench.names() == ["await_stop", "check_not_held", "check_write", "keep_ramps"]
    assert bench.asked("check_write") == [(bench.entry(PROFILE), [5, 5], [True, True])]


@pytest.mark.parametrize(("key", "word"), [(TARGET, False), (WORD, True)])
def test_a_further_axis_is_not_written_by_its_own_index(key, word):
    bench = Bench()
    bench.envelope._of_further_axes = {key: (bench.entry(SPEED), 1)}
    with pytest.raises(SafetyError, match=r"is 60FFh:00 .* of axis 1 of a node.*nothing was sent. Write 60FFh"):
        bench.before(key)
    with pytest.raises(SafetyError, match="of axis 1 of a node"):
        bench.envelope.before_play({bench.entry(key): np.zeros((1, 2), np.int64)})
    assert "check_write" not in bench.names()


@pytest.mark.parametrize(("key", "noted"), [(MODE, True), (GATE, True), (TARGET, False)])
def test_when_a_mode_was_written_is_noted_before_and_after(key, noted):
    bench = Bench().is_ready()
    bench.drives.time_waits, bench.axes.clock = True, 5.0
    bench.before(key, where=SECOND)
    assert (bench.axes.mode_written == 5.0).tolist() == ([False, True] if noted else [False, False])
    bench.axes.clock = 6.0
    bench.after(key, where=SECOND)
    assert (bench.axes.mode_written == 6.0).tolist() == ([False, True] if noted else [False, False])


@pytest.mark.parametrize("key", [SLOW, FAST, HOMING])
def test_a_ramp_by_which_an_axis_is_being_disabled_is_not_written(key):
    bench = Bench().is_ready()
    bench.after(WORD, [ENABLE, DISABLE])
    bench.before(key, where=FIRST)
    with pytest.raises(SafetyError, match=r"is the ramp by which axis 1 is being disabled.*Wait until it is off"):
        bench.before(key)
    bench.envelope._disabling[:] = True
    with pytest.raises(SafetyError, match="by which axis 0 is being disabled"):
        bench.before(key)
    bench.envelope._disabling[:] = SECOND
    bench.watch.answers["look_for_live"] = lambda: False
    bench.before(key)
    bench.watch.answers["look_for_live"] = lambda: True
    bench.axes.live[1] = False
    bench.before(key)
    bench.axes.live[1] = True
    bench.before(PROFILE)  # no ramp
    bench.after(WORD, ENABLE)  # it is enabled again
    bench.before(key)


def test_what_is_stored_is_the_drives_own_and_nothing_is_while_an_axis_is_live():
    bench = Bench().is_ready()
    with pytest.raises(SafetyError, match=r"limits and the watchdog .* an axis is enabled.*Disable it first"):
        bench.before(STORE)
    assert not bench.asked("give_back")
    bench.watch.answers["look_for_live"] = False
    bench.before(STORE)
    assert bench.asked("give_back") == [({0, 1},)] and bench.names()[-2:] == ["give_up", "end"]
    bench.axes.is_armed, bench.axes.live = False, np.array(NONE)  # as the end of watching leaves them
    bench.done.clear()
    bench.before(STORE)
    assert not bench.asked("give_back")
    bench = Bench().is_ready()
    bench.drives.link.process.before = lambda node, key: 0 if key == PRODUCER else None  # as if it were mapped over
    with pytest.raises(SafetyError, match=r"limits and the watchdog .* an axis is enabled.*Disable it first"):
        bench.before(PRODUCER)


def test_who_writes_a_scale_has_the_rotors_keep_their_place():
    bench = Bench()
    bench.before(RESOLUTION)
    assert bench.names()[-1] == "keep_place"
    bench.after(RESOLUTION)
    assert bench.names()[-1] == "place"
    bench.envelope.after_failed_write(bench.entry(RESOLUTION))
    assert bench.names()[-2:] == ["forget", "place_again"]
    bench.before(PROFILE)
    assert bench.names().count("keep_place") == 1


@pytest.mark.parametrize(("key", "forgets"), [(WINDOW, True), (SLOW, True), (OFFSET, True), (CURRENT_LIMIT, True),
                                              (PROFILE, False), (MODE, False)])  # fmt: skip
def test_a_drives_own_limit_is_read_again_after_it_was_written_or_not(key, forgets):
    bench = Bench()
    bench.after(key)
    assert bench.names() == (["forget"] if forgets else [])
    bench.done.clear()
    bench.envelope.after_failed_write(bench.entry(key))
    assert bench.done == [("forget", key), *([("forget",)] if forgets else [])]


@pytest.mark.parametrize(("key", "is_armed", "lent"), [(OFFSET, True, True), (OFFSET, False, False),
                                                       (WINDOW, True, False)])  # fmt: skip
def test_a_home_offset_moves_the_software_limits_that_are_lent(key, is_armed, lent):
    bench = Bench()
    bench.axes.is_armed = is_armed
    bench.after(key)
    assert bench.asked("lend") == ([()] if lent else [])


def test_what_was_written_is_noted_for_the_axes_that_it_was_written_to():
    bench = Bench()
    bench.after(MODE, 8, FIRST)
    assert bench.axes.mode.tolist() == [8, 0]
    bench.after(SPEED, 7, SECOND)
    assert bench.done == [("note", SPEED, [7, 7], [False, True])]


def test_other_objects_of_communication_are_no_store():
    bench = Bench().is_ready()
    bench.before(PRODUCER)
    bench.after(PRODUCER)
    bench.envelope.after_failed_write(bench.entry(PRODUCER))
    assert "give_back" not in bench.names() and "lend" not in bench.names()


# --- values that are lent -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("key", "value", "done"),
    [
        (QUICK, 3, [("pass_on", QUICK, 1, 3)]),  # a ramp of its own: now and afterwards
        (QUICK, 0, [("settle", QUICK, 1, 0), ("lend", QUICK, 1, 2), ("forget",), ("lend",)]),
        (QUICK, 5, [("settle", QUICK, 1, 5), ("lend", QUICK, 1, 6), ("forget",), ("lend",)]),
        (WINDOW, 3, [("settle", WINDOW, 1, 3), ("forget",), ("lend",)]),
    ],
)
def test_a_value_for_an_object_that_has_another_one_meanwhile(key, value, done):
    bench = Bench()
    assert bench.envelope.write_lent(bench.entry(key), 1, value) is False
    assert bench.done == [("is_lent", key, 1)]
    bench.lending.answers["is_lent"] = True
    bench.done.clear()
    assert bench.envelope.write_lent(bench.entry(key), 1, value) is True
    assert bench.done[1:] == done


def test_what_a_program_sees_is_its_own():
    bench = Bench()
    bench.watchdogs.answers["own"], bench.lending.answers["own"] = 4, 5
    assert bench.envelope.own(bench.entry(WINDOW), 1, 3) == 5
    assert bench.done == [("own", bench.entry(WINDOW), 1, 3), ("own", WINDOW, 1, 4)]


# --- controlwords ---------------------------------------------------------------------------------------------------
def test_before_an_axis_is_enabled_everything_is_ready_and_it_counts_as_live():
    bench = Bench()
    bench.before(WORD, [ENABLE, ENABLE], FIRST)
    assert bench.axes.is_armed and bench.axes.may_turn.tolist() == [True, False]
    names = bench.names()
    order = ["await_stop", "start", "check_start", "check_modes", "check_turning", "check", "cuts"]
    assert [name for name in names if name in order] == order
    assert bench.asked("check_modes") == [([True, False],)]
    assert bench.asked("check_turning") == [([True, False],)]
    assert bench.asked("check_start") == [([ENABLE, ENABLE], [True, False])]


def test_an_axis_that_is_live_is_neither_asked_for_its_speed_nor_for_its_watchdog():
    bench = Bench().is_ready()
    bench.before(WORD, ENABLE)
    assert bench.asked("check_turning") == [([False, False],)] and "check" not in bench.names()
    bench.axes.live[1] = False
    bench.before(WORD, ENABLE)
    assert bench.asked("check_turning")[1] == ([False, True],) and "check" in bench.names()


@pytest.mark.parametrize(("word", "where", "arms"), [(SHUTDOWN, BOTH, True), (ENABLE, BOTH, True), (0x00, BOTH, False),
                                                     (0x80, BOTH, False), (ENABLE, NONE, False)])  # fmt: skip
def test_a_controlword_that_leads_on_makes_ready(word, where, arms):
    bench = Bench()
    bench.before(WORD, word, where)
    assert ("start" in bench.names()) == arms
    assert bench.axes.may_turn.any() == (word == ENABLE and where == BOTH)


def test_a_node_that_has_restarted_is_armed_anew_before_it_is_enabled():
    bench = Bench()
    bench.axes.is_armed = True
    bench.watchdogs.answers["check"] = lambda: setattr(bench.axes, "is_armed", False)
    bench.before(WORD, ENABLE)
    assert bench.names().count("must_start") == 1 and bench.axes.is_armed
    assert bench.names().count("set") == 1


@pytest.mark.parametrize(("cuts", "speed", "velocity", "stopped"), [
    (FIRST, 11.0, 0.0, FIRST), (FIRST, 10.0, -10.0, NONE), (FIRST, 5.0, 0.0, NONE),
    (FIRST, 0.0, -11.0, FIRST), (BOTH, -11.0, 0.0, BOTH), (NONE, 11.0, 0.0, NONE),
])  # fmt: skip
def test_what_turns_is_braked_before_its_voltage_is_cut(cuts, speed, velocity, stopped):
    bench = Bench().is_ready()
    bench.axes.speed[:], bench.axes.velocity[:] = speed, velocity
    bench.stops.answers["cuts"] = lambda: np.array(cuts)
    bench.before(WORD, 0)
    assert bench.asked("begin") == ([(list(stopped), False)] if any(stopped) else [])
    assert bench.names().count("await_stop") == (2 if any(stopped) else 1)


@pytest.mark.parametrize("why", ["dry", "nothing is live", "axis is off"])
def test_what_does_not_turn_needs_no_brake(why):
    bench = Bench().is_ready()
    bench.axes.speed[:] = 100.0
    bench.stops.answers["cuts"] = lambda: np.array(FIRST)
    if why == "dry":
        bench.drives.is_dry = True
    elif why == "nothing is live":
        bench.watch.answers["look_for_live"] = False
    else:
        bench.axes.live[:] = SECOND
    bench.before(WORD, 0)
    assert not bench.asked("begin")


def test_what_somebody_else_has_enabled_is_armed_before_it_is_braked():
    bench = Bench()
    bench.axes.live[:] = True
    bench.axes.speed[:] = 100.0
    bench.stops.answers["cuts"] = lambda: np.array(FIRST)
    bench.before(WORD, 0)
    assert bench.names().index("set") < bench.names().index("begin")


@pytest.mark.parametrize(
    ("words", "cuts", "slow", "live", "braked"),
    [
        ((DISABLE, DISABLE), NONE, FIRST, BOTH, FIRST),
        ((DISABLE, DISABLE), NONE, BOTH, SECOND, SECOND),
        ((DISABLE, DISABLE), NONE, BOTH, BOTH, BOTH),
        ((ENABLE, DISABLE), NONE, BOTH, BOTH, SECOND),
        ((DISABLE, DISABLE), BOTH, BOTH, BOTH, NONE),  # it cuts: braked otherwise
        ((DISABLE, DISABLE), NONE, NONE, BOTH, NONE),
        ((ENABLE, STOP), NONE, BOTH, BOTH, NONE),
    ],
)
def test_an_axis_that_its_disabling_would_let_run_on_is_quick_stopped(words, cuts, slow, live, braked, caplog):
    bench = Bench().is_ready()
    bench.axes.live[:] = live
    bench.stops.answers |= {"cuts": lambda: np.array(cuts), "slow_ramps": lambda: np.array(slow)}
    bench.axes.speed[:] = 100.0
    bench.before(WORD, words)
    expected = [(list(braked), False)] if any(braked) else []
    assert [what for what in bench.asked("begin") if what != (list(cuts), False)] == expected
    told = f'axis {int(np.argmax(braked))}: by the ramp of "disable operation" (6084h)'
    assert (told in caplog.text) == any(braked)
    if any(braked):
        assert "for longer than 1 s: it is quick-stopped" in caplog.text


def test_a_ramp_of_axes_that_are_all_off_is_not_looked_at():
    bench = Bench().is_ready()
    bench.watch.answers["look_for_live"] = False
    bench.before(WORD, DISABLE)
    assert "slow_ramps" not in bench.names()


def test_after_an_enabling_controlword_a_signal_is_forgotten_and_a_hold_ended():
    bench = Bench()
    bench.axes.in_flight[:] = True
    bench.stops.current = bench.envelope._checked_stop = object()
    before = bench.axes.epoch
    bench.after(WORD, [ENABLE, STOP], BOTH)
    assert bench.axes.epoch == before + 1 and not bench.axes.in_flight.any()
    assert bench.done == [("note_start", [ENABLE, STOP], [True, True]), ("forget_signal",),
                          ("note_running", [True, False]), ("end_hold", 0)]  # fmt: skip
    assert bench.stops.current is None


def test_a_controlword_that_enables_nothing_leaves_a_stop_as_it_is():
    bench = Bench()
    bench.axes.in_flight[:] = True
    stop = bench.stops.current = object()
    bench.after(WORD, [ENABLE, STOP], SECOND)
    assert bench.stops.current is stop and bench.axes.in_flight.tolist() == [True, False]
    assert bench.names() == ["note_start"]


def test_an_axis_that_was_stopped_between_the_check_and_the_frame_is_stopped_anew():
    bench = Bench()
    bench.before(WORD, [ENABLE, STOP])
    bench.stops.current = object()  # begun by the supervisor
    bench.done.clear()
    bench.after(WORD, [ENABLE, STOP])
    assert bench.asked("begin") == [([True, False], True)] and bench.stops.current is None
    assert not bench.asked("end_hold")


# --- rows ---------------------------------------------------------------------------------------------------------
def test_no_rows_are_no_command():
    bench = Bench()
    bench.play()
    assert bench.names() == ["await_stop"]


def test_rows_that_enable_are_checked_as_a_controlword_is():
    bench = Bench()
    stop = bench.stops.current = object()
    bench.play(word=[SHUTDOWN, (ENABLE, DISABLE)], speed=[0, 0])
    assert bench.names().count("check_not_held") == 2
    assert [row[1] for row in bench.asked("check_play")] == [[[SHUTDOWN] * 2, [ENABLE, DISABLE]]]
    assert bench.asked("check_modes")[0][0] == [True, False]
    assert bench.asked("check_turning") == [([True, False],)]
    assert len(bench.asked("check_played_starts")) == 1 and "check" in bench.names()
    assert bench.axes.may_turn.tolist() == [True, False]
    assert bench.envelope._checked_stop is stop


@pytest.mark.parametrize(("rows", "arms"), [({"profile": [5]}, False), ({"speed": [5]}, True), ({"word": [0]}, True)])
def test_rows_of_controlwords_or_set_points_make_ready(rows, arms):
    bench = Bench()
    bench.play(**rows)
    assert ("start" in bench.names()) == arms
    assert not bench.axes.may_turn.any() and not bench.asked("check_modes")


def test_rows_that_take_the_voltage_after_they_enabled_are_refused():
    bench = Bench().is_ready()
    bench.stops.answers["cuts"] = lambda: np.array([NONE, SECOND, SECOND])
    with pytest.raises(SafetyError, match=r"axis 1: these rows take the voltage away after they have enabled it"):
        bench.play(word=[ENABLE, (ENABLE, 0), (ENABLE, 0)])
    bench.stops.answers["cuts"] = lambda: np.array([NONE, BOTH, NONE])
    with pytest.raises(SafetyError, match="axis 0: these rows take"):  # the first that is wrong
        bench.play(word=[ENABLE, 0, 0])
    bench.stops.answers["cuts"] = lambda: np.array([NONE, SECOND, SECOND])
    bench.axes.speed[:] = 100.0
    bench.play(word=[(ENABLE, STOP), (ENABLE, 0), (ENABLE, 0)])  # the other axis is enabled
    assert bench.asked("begin") == [([False, True], False)]


@pytest.mark.parametrize(
    ("rows", "slow", "refused"),
    [
        ({"word": [ENABLE, (ENABLE, DISABLE), STOP]}, SECOND, 1),
        ({"word": [ENABLE, (ENABLE, DISABLE), STOP]}, FIRST, None),
        ({"word": [ENABLE, (ENABLE, DISABLE), STOP]}, NONE, None),
        ({"word": [ENABLE, (ENABLE, DISABLE), STOP], "slow": [5, 5, 5]}, NONE, 1),  # rows change the ramp
        ({"word": [ENABLE, DISABLE, STOP]}, BOTH, 0),  # the first that is wrong
        ({"word": [(STOP, DISABLE)]}, BOTH, None),  # before it is enabled
        ({"word": [ENABLE, STOP, STOP]}, BOTH, None),
    ],
)
def test_rows_that_disable_by_a_slow_ramp_after_they_enabled_are_refused(rows, slow, refused):
    bench = Bench().is_ready()
    count = len(rows["word"])
    bench.stops.answers |= {"cuts": lambda: np.zeros((count, 2), bool), "may_ramp_slowly": lambda: np.array(slow)}
    if refused is not None:
        with pytest.raises(SafetyError, match=rf"axis {refused}: these rows disable operation after they have enabled"):
            bench.play(**rows)
    else:
        bench.play(**rows)


def test_rows_that_disable_what_would_run_on_stop_it_first():
    bench = Bench().is_ready()
    bench.stops.answers["cuts"] = lambda: np.zeros((1, 2), bool)
    bench.axes.speed[:] = 100.0
    bench.play(word=[(ENABLE, DISABLE)])
    assert bench.asked("begin") == [([False, True], False)]


# --- resets and restarts --------------------------------------------------------------------------------------------
def test_before_a_reset_the_axes_of_the_node_are_at_rest_and_off():
    bench = Bench().is_ready()
    bench.axes.speed[:] = 100.0
    bench.envelope.before_reset([1])
    assert bench.asked("begin") == [([False, True], False)] and bench.names().count("await_stop") == 2
    assert bench.drives.log == [(WORD, 1, cia402.DISABLE_VOLTAGE)]
    assert bench.axes.live.tolist() == [True, False]
    bench.envelope.before_reset([1])
    assert len(bench.drives.log) == 1  # it is off


@pytest.mark.parametrize("is_placed", [True, False])
def test_after_a_reset_nothing_is_known_of_the_node(is_placed):
    bench = Bench().is_ready()
    if is_placed:
        bench.axes.place(np.zeros(2, np.int64), np.ones(2))
    bench.watch.booted, bench.axes.aim, before = {0, 1}, {0: 5}, bench.axes.epoch
    bench.envelope.after_reset([1])
    assert bench.done[:3] == [("forget", 1), ("forget", {1}), ("forget",)]
    assert bench.watch.booted == {0} and bench.axes.aim == {} and bench.axes.epoch == before + 1
    assert not bench.axes.is_armed and bench.axes.live.all()
    assert bench.names()[3:] == (["forget", "place"] if is_placed else ["forget"])


@pytest.mark.parametrize(("armed", "supervised", "live", "ours"), [
    (False, False, False, False), (True, False, False, True), (False, True, False, True), (False, False, True, True),
])  # fmt: skip
def test_what_is_ours_is_what_was_armed_watched_or_may_turn(armed, supervised, live, ours):
    bench = Bench()
    bench.axes.is_armed, bench.watch.is_supervised, bench.axes.live[1] = armed, supervised, live
    bench.envelope.restarted(1)
    assert bench.done == ([("note_restart", 1)] if ours else [])
    bench.done.clear()
    bench.envelope.close()
    assert ("give_up" in bench.names()) == ours
    assert bench.names()[-1] == "end"


def test_a_node_that_restarted_is_told_of_at_the_next_call():
    bench = Bench().is_ready()
    bench.envelope.enter()
    assert bench.names() == ["alive", "raise_pending"]
    bench.done.clear()
    bench.watch.booted = {1, 0}
    bench.stops.answers["stop_for"] = SafetyError("told")
    with pytest.raises(SafetyError, match="told"):
        bench.envelope.enter()
    assert bench.done[:2] == [("alive",), ("forget", [0, 1])]
    assert bench.asked("stop_for")[0][0] == "node 1, 2 has restarted by itself"
    assert bench.names()[-2:] == ["look_for_live", "stop_for"] and not bench.watch.booted


def test_a_node_is_lost_with_any_of_its_axes():
    bench = Bench()
    assert not bench.envelope.has_lost(0)
    bench.axes.lost.add(1)
    assert (bench.envelope.has_lost(0), bench.envelope.has_lost(1)) == (False, True)


# --- stops --------------------------------------------------------------------------------------------------------
def test_a_stop_of_what_nobody_here_has_armed_does_nothing():
    bench = Bench()
    bench.envelope.stop("why")
    assert bench.done == []


@pytest.mark.parametrize("live", [True, False])
def test_what_is_live_is_stopped_and_switched_off(live, caplog):
    bench = Bench().is_ready()
    bench.watch.answers["look_for_live"] = lambda: (bench.done.append(("closing", bench.envelope._is_closing)), live)[1]
    bench.envelope.stop("the program ends")
    assert ("closing", True) in bench.done and not bench.envelope._is_closing
    assert bench.asked("begin") == ([([True, True], False)] if live else [])
    assert bench.asked("await_stop") == ([(True,)] if live else [])
    assert ("stopping the drives: the program ends" in caplog.text) == live


def test_closing_stops_gives_up_and_ends_the_watch(guarded):
    bench = Bench().is_ready()
    bench.envelope.close()
    names = bench.names()
    assert names.index("begin") < names.index("give_up") < names.index("end")
    assert guarded == ["release"] and not bench.envelope._is_closing


def test_who_fails_while_it_stops_is_not_uninterruptible_for_ever():
    bench = Bench()
    with contextlib.suppress(ValueError), bench.envelope._uninterrupted():
        with bench.envelope._uninterrupted():
            pass
        assert bench.envelope._is_closing
        raise ValueError
    assert not bench.envelope._is_closing


@pytest.mark.parametrize(("closing", "told", "live", "under_way"), [
    (True, False, True, True), (False, True, True, True), (False, False, False, False), (False, False, True, False),
])  # fmt: skip
def test_a_signal_begins_a_stop_once(closing, told, live, under_way):
    bench = Bench()
    bench.envelope._is_closing, bench.watch.is_told_to_end, bench.axes.live[1] = closing, told, live
    assert bench.envelope.interrupt() is under_way
    assert bench.names() == (["tell_to_end"] if live and not under_way else [])


def test_what_is_passed_to_the_watch():
    bench = Bench()
    bench.envelope.carry_on()
    bench.envelope.stop_at_once("why")
    bench.envelope.observe({}, 3, None)
    assert bench.done == [("carry_on",), ("ask_to_stop", "why"), ("observe", {}, 3, None)]
    assert bench.envelope.epoch == bench.axes.epoch == 0
    bench.envelope.limits = other = Limits(velocity=5.0)
    assert bench.envelope.limits is bench.limits.user is other


def test_limits_of_another_number_of_axes_are_refused():
    bench = Bench()
    with pytest.raises(ValueError, match="velocity has 3 values for 2 axes"):
        bench.envelope.change(Limits(velocity=(1.0, 2.0, 3.0)))
    assert bench.done == []
    bench.envelope.change(limits := Limits(velocity=5.0))
    assert bench.done == [("change", limits)]


# --- arming -------------------------------------------------------------------------------------------------------
def test_making_ready_has_watchdogs_and_limits_before_every_axis_is_seen(guarded):
    bench = Bench()
    bench.before(SPEED)
    expected = ["start", "bounds", "modes", "set", "begin", "lend", "make_sure_of_ramps", "first_look"]
    assert [name for name in bench.names() if name in expected] == expected
    assert bench.axes.mode.tolist() == [8, 9] and bench.axes.is_armed and guarded == ["guard"]
    bench.done.clear()
    bench.before(SPEED)  # it is ready: what left operational meanwhile is started all the same
    assert [name for name in bench.names() if name in expected] == ["start"]


def test_a_dry_run_sets_no_watchdog():
    bench = Bench()
    bench.drives.is_dry = True
    bench.before(SPEED)
    assert "set" not in bench.names() and bench.axes.is_armed


def test_drives_that_cannot_be_watched_are_stopped_and_given_back(guarded):
    bench = Bench()
    bench.axes.live[:] = True
    bench.watch.answers["first_look"] = SafetyError("not seen")
    bench.watch.answers["look_for_live"] = lambda: (bench.done.append(("closing", bench.envelope._is_closing)), True)[1]
    with pytest.raises(SafetyError, match="not seen"):
        bench.before(WORD, SHUTDOWN)
    names = bench.names()
    assert names.index("first_look") < names.index("give_up") < names.index("end")
    assert ("closing", True) in bench.done and not bench.axes.is_armed and guarded == ["release"]


def test_an_axis_that_could_not_be_proved_off_keeps_all_from_being_armed():
    bench = Bench()
    bench.axes.lost |= {1, 0}
    with pytest.raises(SafetyError, match=r"axis 0 could not be confirmed to be off.*open the drives again"):
        bench.before(SPEED)
    assert "start" not in bench.names()


@pytest.mark.parametrize(("statuses", "where", "arms"), [
    ((OFF, ENABLED), BOTH, True), ((OFF, ENABLED), FIRST, False), ((OFF, OFF), BOTH, False),
    ((ENABLED, OFF), FIRST, True),
])  # fmt: skip
def test_an_axis_that_somebody_else_has_enabled_is_armed_before_it_is_changed(statuses, where, arms):
    bench = Bench(values={STATUS: statuses})
    bench.before(PROFILE, where=where)
    assert bench.axes.is_armed == arms


def test_a_new_envelope_is_idle_and_has_its_drives_mapped_and_polled(guarded):
    """Made as drives on a bus make it, of parts that are the real ones."""
    bench, done = Bench(), []
    drives = bench.drives
    drives.link = SimpleNamespace(watch=SimpleNamespace(end=lambda: done.append("end")))
    drives.description.of_further_axes = dict
    drives.prepare_watch = lambda envelope: done.append(("prepare", envelope))
    drives.poll = lambda envelope: done.append(("poll", envelope)) or True
    with pytest.raises(ValueError, match="current has 3 values for 2 axes"):
        Envelope(Limits(current=(1.0, 2.0, 3.0)), drives)
    envelope = Envelope(limits := Limits(current=5.0), drives)
    assert envelope.limits is limits and envelope.epoch == 0
    assert envelope.interrupt() is False  # nothing may turn
    envelope._watch._prepare()
    assert envelope._watch._poll() is True
    assert done == [("prepare", envelope), ("poll", envelope)]
    envelope.close()
    assert done[2:] == ["end"] and guarded == ["release"]  # nothing was ours
    assert not envelope._disabling.any() and envelope._disabling.shape == (2,)


# --- swings that are meant ------------------------------------------------------------------------------------------
def test_swings_are_allowed_for_a_while_and_other_limits_stay():
    envelope = SimpleNamespace(limits=Limits(velocity=5.0))
    before = envelope.limits
    with contextlib.suppress(ValueError), swinging_allowed(SimpleNamespace(safety=envelope)):
        assert not envelope.limits.oscillation and envelope.limits.velocity == 5.0
        raise ValueError
    assert envelope.limits is before
    with swinging_allowed(SimpleNamespace(safety=None)):
        pass
