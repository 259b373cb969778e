"""The watch over the drives: how old a sample may be, what is stopped, and how long a stop is waited for."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.held_objects import HeldObjects

from drive_env import Limits, cia402
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.errors import BusError
from drive_env.safety import watch as module
from drive_env.safety.axes import Axes
from drive_env.safety.errors import SafetyError
from drive_env.safety.watch import BLIND, MISSED, MOST_STOP_CYCLES, Watch

BEGUN = 1000.0  # s


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on only while somebody sleeps."""
    clock = SimpleNamespace(now=BEGUN, slept=[])

    def sleep(seconds):
        assert len(clock.slept) < 100_000, "it waits without end"
        clock.slept.append(seconds)
        clock.now += seconds

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now, sleep=sleep))
    return clock


def watch_of(
    axes=1, *, time_waits=False, is_supervised=True, polled=True, answers=True, stall=1.0, age=0.0, nodes=(7,)
):
    """A watch over axes that are live, and what it does."""
    done = SimpleNamespace(words=[], stopped=[], begun=[], polls=0, looks=0, started=0, cycles=0, holds=0)

    def count(name, result=None):
        def act(*_):
            setattr(done, name, getattr(done, name) + 1)
            assert getattr(done, name) < 10_000, f"{name} without end"
            return result

        return act

    def stop_for(what, remedy):
        done.stopped.append(what)
        raise SafetyError(f"{what}; {remedy}")

    drives = SimpleNamespace(
        nodes=nodes, num_axes=axes, time_waits=time_waits, must_start=count("started"),
        description=SimpleNamespace(dictionary=SimpleNamespace(find=lambda key: key)),
        write_raw=lambda entry, axis, word: done.words.append((axis, word)),
        link=SimpleNamespace(wording=SimpleNamespace(operational="operational")),
    )  # fmt: skip
    known = SimpleNamespace(
        may_turn=np.ones(axes, bool), seen=np.full(axes, BEGUN - age), lost=set(), epoch=3, is_armed=True,
        in_flight=np.ones(axes, bool), lock=contextlib.nullcontext(),
    )  # fmt: skip
    stops = SimpleNamespace(
        current=None, stop_for=stop_for, judged=lambda: known.may_turn.copy(), hold=count("holds"),
        begin=lambda mask, holds: done.begun.append((np.flatnonzero(mask).tolist(), holds)),
    )  # fmt: skip

    watch = Watch.__new__(Watch)
    watch._drives, watch._axes, watch._stops, watch._known = drives, known, stops, drives.description.dictionary
    watch._limits = SimpleNamespace(user=SimpleNamespace(stall=stall))
    watch._watchdogs = SimpleNamespace(take_rival=lambda: "")
    watch._poll = count("polls", polled)
    watch.looks = SimpleNamespace(
        ask_unsampled=lambda: None, ask=count("looks", answers), watched=lambda: [], is_short=False
    )
    watch._supervisor = SimpleNamespace(is_this_thread=lambda: True) if is_supervised else None
    watch._pass_cycle = count("cycles")
    watch._missed, watch._alive, watch._pending = 0, BEGUN, None
    watch.booted, watch._told_of = set(), set()
    return watch, done


def stop_of(watch, axes=(0,), over_after=None):
    """A stop that is over when it has been looked at so often; never if not said."""
    looked = [0]

    class Stop:
        @property
        def is_over(self):
            looked[0] += 1
            return over_after is not None and looked[0] > over_after

    stop = Stop()
    stop.axes = dict.fromkeys(axes)
    watch._stops.current = stop
    return stop


# --- how long a stop is waited for --------------------------------------------------------------------------------
@pytest.mark.parametrize("cycles", [0, 1, 40])
def test_in_lockstep_a_stop_takes_the_cycles_that_it_needs(clock, cycles):
    watch, done = watch_of(time_waits=True)
    stop = stop_of(watch, over_after=cycles)
    watch.await_stop()
    assert done.words == [] and watch._stops.current is stop  # what it holds stays held
    assert (done.cycles, done.holds, clock.slept) == (cycles, cycles, [])


def test_in_lockstep_a_stop_without_end_is_given_up_after_five_thousand_cycles(clock):
    watch, done = watch_of(time_waits=True)
    stop_of(watch)
    watch.await_stop()
    assert done.cycles == MOST_STOP_CYCLES == 5000


def test_a_lockstep_that_takes_long_is_no_stop_without_end(clock):
    """Time waits there: what a cycle takes of the computer's says nothing."""
    watch, _ = watch_of(time_waits=True)
    stop_of(watch, over_after=30)
    watch._pass_cycle = lambda: setattr(clock, "now", clock.now + 10.0)
    watch.await_stop()
    assert clock.now == BEGUN + 300.0


def test_a_stop_is_waited_for_as_long_as_all_its_grades_take(clock, caplog):
    """0.5 s to a set-point, 2 s of ramp, 0.4 s unseen, 0.6 s of voltage-off, 2 s for what a computer does besides."""
    watch, _ = watch_of()
    stop_of(watch)
    watch.await_stop()
    assert clock.now - BEGUN == pytest.approx(5.5, abs=0.01)
    assert "a stop is not over after 5.5 s" in caplog.text


def test_who_waits_for_a_stop_does_not_stall(clock):
    watch, _ = watch_of()
    watch._supervisor = SimpleNamespace(is_this_thread=lambda: False)
    stop_of(watch, over_after=1000)
    watch.await_stop()
    assert watch._alive == pytest.approx(clock.now, abs=0.01)
    assert len(clock.slept) == 1000


def test_without_anybody_who_goes_on_with_it_a_stop_is_not_waited_for(clock):
    watch, done = watch_of(is_supervised=False)
    stop_of(watch)
    watch.await_stop()
    assert (clock.slept, done.cycles) == ([], 0)


def test_another_stop_in_its_place_is_not_waited_for(clock):
    watch, done = watch_of(time_waits=True)
    stop_of(watch)
    watch._pass_cycle = lambda: stop_of(watch)
    watch.await_stop()
    assert done.holds == 1


@pytest.mark.parametrize("ends", [False, True])
def test_what_was_stopped_is_switched_off_at_the_end_but_for_what_is_lost(clock, ends):
    watch, done = watch_of(3)
    watch._axes.lost = {1}
    stop = stop_of(watch, (2, 0, 1), over_after=0)
    watch.await_stop(ends=ends)
    if ends:
        assert done.words == [(0, cia402.DISABLE_VOLTAGE), (2, cia402.DISABLE_VOLTAGE)]
        assert watch._axes.in_flight.tolist() == [False, True, False]
        assert watch._stops.current is None and watch._axes.epoch == 4  # samples from before tell nothing of it
    else:
        assert done.words == [] and watch._stops.current is stop and watch._axes.epoch == 3


# --- how old a sample may be --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("live", "age", "polls"), [(True, 0.0079, 0), (True, 0.0081, 1), (False, 0.0149, 0), (False, 0.0151, 1)]
)
def test_drives_are_looked_at_after_8_ms_and_after_15_where_all_are_off(clock, live, age, polls):
    watch, done = watch_of(age=age)
    watch._axes.may_turn[:] = live
    watch._look()
    assert (done.polls, done.looks) == (polls, 0)


@pytest.mark.parametrize(("live", "asked"), [(True, [1]), (False, [])])
def test_what_no_sample_carries_is_asked_for_of_axes_that_are_live(clock, live, asked):
    watch, _ = watch_of()
    seen = []
    watch.looks.ask_unsampled = lambda: seen.append(1)
    watch._axes.may_turn[:] = live
    watch._look()
    assert seen == asked


def test_cycles_of_the_program_that_bring_no_sample_are_not_waited_for_at_any_time_of_the_clock(clock):
    watch, done = watch_of(polled=None)
    clock.now, watch._axes.seen[:] = 0.03, 0.01
    watch._look()
    assert done.looks == 1


def test_the_oldest_sample_counts(clock):
    watch, done = watch_of(3)
    watch._axes.seen[1] -= 0.01
    watch._look()
    assert done.polls == 1


@pytest.mark.parametrize(
    ("polled", "answers", "age", "looks", "missed"),
    [
        (True, True, 0.1, 0, 0),  # samples came
        (None, True, 0.0159, 0, 1),  # the program's own cycles are under way, and may bring them
        (None, True, 0.0161, 1, 1),  # they bring none: asked, though no SYNC was missed
        (False, True, 0.1, 1, 2),  # a SYNC was, by a node that answers: it left operational
        (False, False, 0.1, 1, 1),  # a node that answers nothing is blind, which is told of otherwise
    ],
)
def test_a_sync_without_samples_counts_where_the_node_answers(clock, polled, answers, age, looks, missed):
    watch, done = watch_of(polled=polled, answers=answers, age=age)
    watch._missed = 1
    watch._look()
    assert (done.looks, watch._missed) == (looks, missed)


# --- what is stopped ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("age", "stops"), [(0.199, False), (0.201, True)])
def test_an_axis_that_cannot_be_seen_for_a_fifth_of_a_second_is_stopped(clock, age, stops):
    assert BLIND == 0.2
    watch, done = watch_of(3)
    watch._axes.seen[2] -= age
    if stops:
        with pytest.raises(
            SafetyError, match=r"axis 2 could not be seen for 0\.20 s.*whether another master has stopped it"
        ):
            watch._look_after()
    else:
        watch._look_after()
        assert done.stopped == []


def test_of_several_axes_that_cannot_be_seen_the_first_is_named(clock):
    watch, _ = watch_of(3)
    watch._axes.seen -= (0.0, 0.3, 0.5)
    with pytest.raises(SafetyError, match=r"axis 1 could not be seen for 0\.30 s"):
        watch._look_after()


def test_an_axis_that_is_off_need_not_be_seen(clock):
    watch, _ = watch_of(2, age=0.5)
    watch._axes.seen[0] = BEGUN
    watch._axes.may_turn[1] = False
    watch._look_after()
    watch._axes.may_turn[:] = False
    watch._missed, watch.booted, watch._alive = MISSED, {0}, 0.0
    watch._look_after()


def test_three_syncs_in_a_row_without_samples_stop_once_and_have_the_node_started(clock):
    watch, done = watch_of()
    watch._missed = 2
    watch._look_after()
    for missed in (3, 4):
        watch._missed = missed
        with pytest.raises(SafetyError, match="a node sends no process data any more: it left operational"):
            watch._look_after()
        assert watch._missed == 0
        watch._look_after()
    assert (done.started, len(done.stopped)) == (2, 2)


def test_a_node_that_restarts_is_told_of_once_by_its_number(clock):
    watch, _ = watch_of(3, nodes=(4, 5, 9))
    watch.note_restart(2)
    watch.note_restart(0)
    with pytest.raises(SafetyError, match="node 4, 9 has restarted by itself"):
        watch._look_after()
    watch._look_after()
    watch.note_restart(1)
    with pytest.raises(SafetyError, match="node 4, 5, 9"):
        watch._look_after()


def test_another_master_has_the_watchdogs_set_anew(clock):
    watch, _ = watch_of()
    watch._watchdogs.take_rival = lambda: "two programs send heartbeats"
    with pytest.raises(SafetyError, match="two programs send heartbeats"):
        watch._look_after()
    assert not watch._axes.is_armed


@pytest.mark.parametrize(
    ("stall", "pause", "stops"), [(1.0, 0.99, False), (1.0, 1.01, True), (0.1, 0.11, True), (None, 1e6, False)]
)
def test_a_program_that_stalls_is_stopped_in_its_place_and_told(clock, stall, pause, stops):
    watch, done = watch_of(2, stall=stall)
    watch._axes.may_turn[0] = False
    watch._alive = BEGUN - pause
    watch._look_after()
    assert done.begun == ([([1], True)] if stops else [])
    if stops:
        with pytest.raises(SafetyError, match=rf"made no call for {pause:.2f} s .* the limit is {stall:g} s"):
            watch.raise_pending()
    watch.raise_pending()  # told once


# --- samples, the supervisor's turns, and what it is told -------------------------------------------------------------
STATUS, POSITION, VELOCITY, CURRENT, SHOWN_MODE = (0x6041, 0), (0x6064, 0), (0x606C, 0), (0x6077, 0), (0x6061, 0)
GATE = (0x2303, 0)
OFF, ENABLED = 0x0240, 0x0637


class Bench:
    """A watch over two axes that are off, made as the envelope makes it; its stops and judging list what they do."""

    def __init__(self, *, time_waits=True, gated=False, lacks=(), polled=(True,)):
        self.done, self.polled = [], list(polled)
        values = {STATUS: OFF, POSITION: (70, 80), VELOCITY: 0, CURRENT: 0, SHOWN_MODE: (8, 9), GATE: 0}
        drives = HeldObjects({key: value for key, value in values.items() if key not in lacks}, 2)
        drives.time_waits, drives.sampled_entries = time_waits, list
        drives.description.answer_timeout = 0.5
        drives.link = SimpleNamespace(watch=None, wording=SimpleNamespace(check_samples="check the cable"))
        for name in ("start", "must_start", "pass_cycle"):
            setattr(drives, name, self._lists(name))
        find = drives.description.dictionary.find
        drives.description.dictionary.find = lambda key: find(GATE if key is Role.MODE_GATE else key)
        if gated:
            drives.device = SimpleNamespace(mode_gate={8: 5})
        self.drives, self.axes = drives, Axes(drives)
        self.axes.place(np.zeros(2, np.int64), np.full(2, 1000.0))
        self.stops = SimpleNamespace(
            current=None, judged=lambda: self.axes.live.copy(), hold=self._lists("hold"), step=self._lists("step"),
            begin=lambda mask, holds: self.done.append(("begin", mask.tolist(), holds)), stop_for=self._stop_for,
        )  # fmt: skip
        self.watchdogs = SimpleNamespace(
            keep=self._lists("keep"), cease=self._lists("cease"), end=self._lists("end"), take_rival=lambda: ""
        )
        limits = SimpleNamespace(user=Limits(stall=None), forget=self._lists("forget"))
        self.watch = Watch(drives, self.axes, limits, self.stops, self.watchdogs, self._lists("prepare"), self._poll)
        self.judging = self.watch._judging
        self.watch._judging = SimpleNamespace(
            judge=lambda rows, judged: self.done.append(("judge", listed(rows), judged.tolist())),
            judge_heard=lambda rows, judged: self.done.append(("heard", judged.tolist())),
        )
        self.asked = []
        self.watch.looks.watched = lambda: [drives.entries[key] for key in (STATUS, POSITION)]
        self.watch.looks.ask = lambda entries: self.asked.append([entry.index for entry in entries])

    def _lists(self, name):
        return lambda *arguments: self.done.append((name, *arguments))

    def _poll(self):
        self.done.append(("poll",))
        assert len(self.done) < 1000, "it polls without end"
        return self.polled.pop(0) if len(self.polled) > 1 else self.polled[0]

    def _stop_for(self, what, remedy):
        self.done.append(("stop_for", what, remedy))
        raise SafetyError(f"{what}; {remedy}")

    def supervised(self, is_this_thread=False):
        """Have a supervisor; return how often it was woken."""
        woken = []
        self.watch._supervisor = SimpleNamespace(
            is_this_thread=lambda: is_this_thread, wake=lambda: woken.append(1), close=lambda: woken.append("closed")
        )
        return woken

    def names(self):
        return [what[0] for what in self.done]

    def asked_for(self, name):
        return [what[1:] for what in self.done if what[0] == name]


def listed(rows):
    return {key: np.asarray(row).tolist() for key, row in rows.items()}


def rows_of(**rows):
    keys = {"status": STATUS, "position": POSITION, "current": CURRENT}
    return {keys[name]: np.array(row, np.int64).reshape(-1, 2) for name, row in rows.items()}


def test_samples_of_lockstep_let_its_time_pass_and_are_judged():
    bench = Bench()
    rows = rows_of(status=[[ENABLED, OFF]] * 3, position=[[1, 2], [3, 4], [5, 6]])
    bench.watch.observe(rows, 0)
    assert bench.axes.clock == pytest.approx(0.003)
    assert bench.axes.position.tolist() == [5, 6] and bench.axes.live.tolist() == [True, False]
    assert bench.done == [("judge", listed(rows), [True, False])]
    bench.watch.observe({}, 0)
    assert bench.axes.clock == pytest.approx(0.003)


def test_samples_of_a_real_bus_let_no_time_pass_and_step_no_stop():
    bench = Bench(time_waits=False)
    bench.stops.current = object()
    bench.watch.observe(rows_of(position=[[1, 2]]), 0, np.array([False, True]))
    assert bench.axes.clock == 0.0 and bench.axes.position.tolist() == [0, 2]
    assert bench.names() == ["judge"]


def test_a_stop_in_lockstep_goes_on_with_each_sample():
    bench = Bench()
    bench.stops.current = object()
    bench.watch.observe(rows_of(position=[[1, 2]]), 0)
    assert bench.names() == ["hold", "step", "judge"]


@pytest.mark.parametrize(("time_waits", "where", "short", "asks"), [
    (True, None, True, True), (True, None, False, False), (True, [True, False], True, False),
    (False, None, True, False),
])  # fmt: skip
def test_in_lockstep_what_no_sample_carries_is_asked_for_with_it(time_waits, where, short, asks):
    bench = Bench(time_waits=time_waits)
    more = {CURRENT: np.array([[5, 6]])}
    bench.watch.looks = SimpleNamespace(is_short=short, with_unsampled=lambda rows: {**rows, **more})
    bench.watch.observe(rows_of(position=[[1, 2]]), 0, None if where is None else np.array(where))
    assert (CURRENT in bench.asked_for("judge")[0][0]) == asks


def test_what_the_supervisor_had_to_do_is_told_in_the_programs_thread_once():
    bench = Bench(time_waits=False)
    bench.watch._pending = SafetyError("it was stopped")
    bench.supervised(is_this_thread=True)
    bench.watch.observe(rows_of(position=[[1, 2]]), 0)
    bench.supervised()
    with pytest.raises(SafetyError, match="it was stopped"):
        bench.watch.observe(rows_of(position=[[1, 2]]), 0)
    assert bench.names() == ["judge"]
    bench.watch.observe(rows_of(position=[[1, 2]]), 0)
    assert bench.names() == ["judge", "judge"]


@pytest.mark.parametrize("gated", [True, False])
@pytest.mark.parametrize(
    ("before", "status", "heard"),
    [
        ((ENABLED, OFF), (OFF, OFF), [True, False]),  # it was live until now
        ((OFF, OFF), (OFF, ENABLED), [False, True]),  # it is now
        ((ENABLED, ENABLED), (ENABLED, ENABLED), [True, True]),
        ((OFF, OFF), (OFF, OFF), [False, False]),
    ],
)
def test_axes_of_a_gated_drive_that_were_live_before_or_by_samples_must_take_commands(before, status, heard, gated):
    bench = Bench(gated=gated)
    bench.watch.observe(rows_of(status=[before]), 0)
    bench.done.clear()
    bench.watch.observe(rows_of(status=[status]), 0)
    assert bench.asked_for("heard") == ([(heard,)] if gated else [])


@pytest.mark.parametrize("gated", [True, False])
@pytest.mark.parametrize(("status", "heard", "judged"), [
    (OFF, [False, True], [False, False]), (ENABLED, [False, True], [False, True]),
])  # fmt: skip
def test_what_one_axis_answers_is_judged_of_it_alone(gated, status, heard, judged):
    bench = Bench(gated=gated)
    bench.watch.observe(rows_of(status=[[ENABLED, ENABLED]], position=[[10, 20]]), 0)
    bench.done.clear()
    bench.watch._observe_axis(rows_of(status=[[0, status]], position=[[0, 25]], current=[[0, 5]]), 0,
                              np.array([False, True]))  # fmt: skip
    assert bench.axes.position.tolist() == [10, 25] and bench.axes.status.tolist() == [ENABLED, status]
    # of the other one, what was seen last; nothing is known of its current
    rows = {STATUS: [[ENABLED, status]], POSITION: [[10, 25]], CURRENT: [[0, 5]]}
    assert bench.asked_for("judge") == [(rows, judged)]
    assert bench.asked_for("heard") == ([(heard,)] if gated else [])


def test_an_axis_that_is_live_by_its_answer_must_take_commands_and_another_axis_need_not():
    bench = Bench(gated=True)
    bench.watch._observe_axis(rows_of(status=[[0, ENABLED]]), 0, np.array([False, True]))
    assert bench.asked_for("heard") == [([False, True],)]
    bench.watch._observe_axis(rows_of(status=[[OFF, 0]]), 0, np.array([True, False]))
    assert bench.asked_for("heard")[1] == ([False, False],)


@pytest.mark.parametrize("gated", [True, False])
def test_of_a_gated_drive_alone_it_is_judged_whether_it_takes_commands(gated):
    bench = Bench(gated=gated)
    bench.axes.clock = 10.0
    said = pytest.raises(SafetyError, match=r"axis 1 has ceased to take commands .* 2303h:00 .* does not fit")
    with said if gated else contextlib.nullcontext():
        bench.judging.judge_heard({STATUS: np.array([[0x0637, 0x0437]])}, np.array([True, True]))


def test_a_new_zero_has_the_limits_read_again():
    bench = Bench()
    bench.axes.take = lambda rows, epoch, where: True
    bench.watch.observe(rows_of(position=[[1, 2]]), 0)
    assert bench.names() == ["forget", "judge"]


@pytest.mark.parametrize(("lacks", "asked"), [((), [0x6041, 0x6064, 0x606C]), ((VELOCITY,), [0x6041, 0x6064])])
def test_whether_an_axis_is_live_is_asked_for(lacks, asked):
    bench = Bench(lacks=lacks)
    assert bench.watch.look_for_live() is False
    assert bench.asked == [asked]
    bench.axes.assumed[1] = True

    def ask(entries):
        raise SafetyError("beyond a limit")

    bench.watch.looks.ask = ask
    assert bench.watch.look_for_live() is True


@pytest.mark.parametrize(("lacks", "asked"), [((), [0x6041, 0x6064, 0x606C, 0x6077]),
                                               ((CURRENT,), [0x6041, 0x6064, 0x606C])])  # fmt: skip
@pytest.mark.parametrize("silent", [False, True])
def test_a_cycle_of_lockstep_counts_as_100_ms_where_nobody_answers(lacks, asked, silent, caplog):
    bench = Bench(lacks=lacks)

    def pass_cycle():
        if silent:
            raise BusError("nobody answers")

    bench.drives.pass_cycle = pass_cycle
    bench.watch._pass_cycle()
    assert bench.axes.clock == pytest.approx(0.101 if silent else 0.001)
    assert ("nobody answers" in caplog.text) == silent
    assert bench.asked == [asked] and bench.names() == []
    bench.stops.current = object()
    bench.watch._pass_cycle()
    assert bench.names() == ["step"]


def test_a_fresh_watch_counts_three_syncs_without_samples_and_has_been_told_nothing(clock):
    bench = Bench(time_waits=False, polled=(False,))
    bench.axes.live[:] = True
    bench.watch.looks.ask = lambda entries: True
    bench.watch.looks.ask_unsampled = lambda: None
    for _ in range(2):
        bench.axes.seen[:] = clock.now - 0.01
        bench.watch._look()
        bench.watch._look_after()
    bench.watch._look()
    bench.drives.link.wording.operational = "operational"
    with pytest.raises(SafetyError, match="it left operational"):
        bench.watch._look_after()
    bench.stops.current = SimpleNamespace(is_over=False)
    assert not bench.watch.is_told_to_end


# --- the first look ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("time_waits", [True, False])
def test_every_axis_is_seen_before_anything_moves(clock, time_waits):
    bench = Bench(time_waits=time_waits)
    sampled = []
    bench.watch.looks.sampled = sampled.append
    bench.watch.first_look()
    assert bench.axes.position.tolist() == [70, 80] and bench.axes.status.tolist() == [OFF, OFF]
    assert sampled == [[]]
    assert bench.names() == ([] if time_waits else ["prepare", "poll"])


@pytest.mark.parametrize(("lacks", "told"), [((POSITION,), "no 6064h:"), ((STATUS,), "no 6041h:"),
                                             ((POSITION, STATUS), "no 6064h, 6041h:")])  # fmt: skip
def test_what_an_eds_lacks_that_must_be_seen_is_told_of(lacks, told):
    bench = Bench(lacks=lacks)
    with pytest.raises(SafetyError, match=rf"the EDS has {told} the drives cannot be monitored; complete the EDS"):
        bench.watch.first_look()
    bench.drives.is_dry = True
    bench.watch.first_look()  # it looks at nothing


@pytest.mark.parametrize(("polled", "starts"), [((True,), 0), ((None,), 0), ((False, False, True), 2)])
def test_a_node_without_samples_is_started_until_it_sends_some(clock, polled, starts):
    bench = Bench(time_waits=False, polled=polled)
    bench.watch._prove_operational()
    assert bench.names().count("start") == bench.names().count("must_start") == starts


def test_a_node_that_sends_no_samples_for_as_long_as_an_answer_takes_is_not_moved(clock):
    clock.now = 0.0
    bench = Bench(time_waits=False, polled=(False,))
    poll = bench.watch._poll
    bench.watch._poll = lambda: (setattr(clock, "now", clock.now + 0.25), poll())[1]
    with pytest.raises(SafetyError, match=r"a node sends no process data at SYNC.*check the cable"):
        bench.watch._prove_operational()
    assert bench.names().count("poll") == 3 and bench.names().count("start") == 2  # 0.25, 0.5 and 0.75 s


# --- the thread -------------------------------------------------------------------------------------------------------
@pytest.fixture
def threads(monkeypatch):
    """Supervisors that run no thread: whether each was started and closed."""
    made = []

    class Thread:
        def __init__(self, turn, fail):
            self.turn, self.fail, self.state = turn, fail, "made"
            made.append(self)

        def start(self):
            self.state = "started"

        def close(self):
            self.state = "closed"

        def is_this_thread(self):
            return False

    monkeypatch.setattr(module, "Supervisor", Thread)
    return made


def test_the_thread_is_started_once_and_ended(clock, threads):
    bench = Bench(time_waits=False)
    bench.watch._missed = 2
    assert not bench.watch.is_supervised
    clock.now += 7.0
    bench.watch.begin()
    assert bench.watch.is_supervised and bench.watch._missed == 0 and bench.watch._alive == clock.now
    bench.watch.begin()
    assert [thread.state for thread in threads] == ["started"]
    bench.axes.is_armed, bench.stops.current = True, object()
    bench.watch.tell_to_end = None
    bench.watch._told_at, bench.watch._asked = clock.now, "why"
    bench.watch.end()
    assert [thread.state for thread in threads] == ["closed"] and not bench.watch.is_supervised
    assert not bench.axes.is_armed and bench.stops.current is None and bench.names() == ["end"]
    assert not bench.watch.is_told_to_end and bench.watch._asked is None
    bench.watch.end()
    assert bench.names() == ["end", "end"]


def test_where_time_waits_no_thread_is_needed(clock, threads):
    bench = Bench()
    bench.watch.begin()
    assert threads == [] and not bench.watch.is_supervised


def test_only_the_program_is_alive_by_its_calls(clock):
    bench = Bench(time_waits=False)
    assert bench.watch._alive == BEGUN
    clock.now += 1.0
    bench.supervised(is_this_thread=True)
    bench.watch.alive()
    assert bench.watch._alive == BEGUN
    bench.supervised()
    bench.watch.alive()
    assert bench.watch._alive == clock.now


@pytest.mark.parametrize(("lacks", "is_supervisor", "modes"), [((), False, [8, 9]), ((), True, [0, 0]),
                                                               ((SHOWN_MODE,), False, [0, 0])])  # fmt: skip
def test_the_mode_is_asked_for_by_the_program_alone(lacks, is_supervisor, modes):
    bench = Bench(lacks=lacks)
    bench.supervised(is_supervisor)
    assert bench.watch.modes().tolist() == bench.axes.mode.tolist() == modes


TURN = ["keep", "obey", "hold", "look", "go on", "look after"]


def turn_of(bench, **fails):
    """Have the parts of a turn listed; those that are given fail."""
    done = []

    def part(name):
        def act():
            done.append(name)
            if name in fails:
                raise fails[name]

        return act

    bench.watchdogs.keep, bench.watch._obey_signal, bench.stops.hold = part("keep"), part("obey"), part("hold")
    bench.watch._look, bench.watch._go_on_stopping, bench.watch._look_after = (
        part("look"), part("go on"), part("look after"),
    )  # fmt: skip
    return done


def test_a_turn_looks_and_stops_in_this_order_once_every_axis_was_seen(clock):
    bench = Bench()
    done = turn_of(bench)
    bench.watch._turn()
    assert done == ["keep"]
    bench.watch._limits.user = Limits(stall=1.0)
    clock.now += 1.5  # for which the program made no call: the drives are to stop by themselves
    bench.watch._turn()
    assert done == ["keep"]
    bench.watch.first_look()
    bench.watch._turn()
    assert done[1:] == TURN


def test_what_fails_in_a_turn_keeps_nothing_else_from_being_done(caplog):
    bench = Bench()
    done = turn_of(bench, keep=BusError("the bus is gone"), look=SafetyError("too fast"))
    bench.watch.first_look()
    with pytest.raises(BusError, match="the bus is gone"):
        bench.watch._turn()
    assert done == TURN and "too fast" in caplog.text
    with pytest.raises(SafetyError, match="too fast"):
        bench.watch.raise_pending()


def test_a_stop_goes_on_with_each_turn():
    bench = Bench()
    bench.watch._go_on_stopping()
    assert bench.names() == []
    bench.stops.current = object()
    bench.watch._go_on_stopping()
    assert bench.names() == ["step"]


# --- what it is told --------------------------------------------------------------------------------------------------
def test_a_signal_stops_what_may_turn_and_wakes_the_thread(clock):
    bench = Bench(time_waits=False)
    bench.watch._obey_signal()
    assert bench.done == [] and not bench.watch.is_told_to_end
    bench.watch.tell_to_end()  # without a thread
    woken = bench.supervised()
    bench.watch.tell_to_end()
    assert woken == [1]
    bench.watch._obey_signal()
    assert bench.done == []  # nothing may turn
    bench.axes.assumed[1] = True
    bench.watch._obey_signal()
    assert bench.done == [("begin", [False, True], False)]
    bench.watch.forget_signal()
    bench.watch._obey_signal()
    assert len(bench.done) == 1


def test_a_signal_counts_for_100_ms_and_until_its_stop_is_over(clock):
    clock.now = 0.0
    bench = Bench(time_waits=False)
    bench.watch.tell_to_end()
    for now, current, told in (
        (0.0999, None, True), (0.1, None, False), (0.1, False, True), (0.1, True, False), (9.0, False, True),
    ):  # fmt: skip
        clock.now = now
        bench.stops.current = None if current is None else SimpleNamespace(is_over=current)
        assert bench.watch.is_told_to_end is told
    bench.watch.forget_signal()
    bench.stops.current = SimpleNamespace(is_over=False)
    assert bench.watch.is_told_to_end is False


@pytest.mark.parametrize("told", [True, False])
def test_a_program_that_goes_on_after_a_signal_is_told_that_it_stopped_the_drives(clock, told):
    bench = Bench(time_waits=False)
    if told:
        bench.watch.tell_to_end()
    bench.watch.carry_on()
    with pytest.raises(SafetyError, match="since a signal ended the program") if told else contextlib.nullcontext():
        bench.watch.raise_pending()


def test_another_thread_has_what_is_live_stopped_once(clock):
    bench = Bench(time_waits=False)
    bench.axes.assumed[0] = True
    bench.watch.ask_to_stop("a button")  # without a thread nothing is live
    bench.watch._obey_signal()
    woken = bench.supervised()
    bench.watch.ask_to_stop("a button")
    assert woken == [1]
    with pytest.raises(SafetyError, match="a button"):
        bench.watch._obey_signal()
    assert bench.done == [("stop_for", "a button", "enable them again to go on")]
    bench.watch._obey_signal()
    bench.axes.assumed[0] = False
    bench.watch.ask_to_stop("a button")
    bench.watch._obey_signal()
    bench.axes.assumed[0] = True
    bench.watch._obey_signal()  # what is enabled later is not meant
    assert len(bench.done) == 1


def test_a_watch_that_fails_leaves_what_may_turn_to_the_watchdogs():
    bench = Bench(time_waits=False)
    bench.axes.assumed[1] = True
    bench.watch._fail()
    assert bench.done == [("begin", [False, True], False), ("cease",)] and bench.axes.lost == {1}
    with pytest.raises(SafetyError, match="the drives cannot be monitored any more, and stop by their own watchdogs"):
        bench.watch.raise_pending()
