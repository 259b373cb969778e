"""The watch over the drives: how old a sample may be, what is stopped, and how long a stop is waited for."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.safety import watch as module
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
            return result

        return act

    def stop_for(what, remedy):
        done.stopped.append(what)
        raise SafetyError(what)

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
    watch.booted, watch._is_restart_told = set(), False
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
    stop_of(watch, over_after=cycles)
    watch.await_stop()
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
    """2 s of ramp, 0.4 s without a sample, 0.6 s of voltage-off, and 2 s for what a computer does besides."""
    watch, _ = watch_of()
    stop_of(watch)
    watch.await_stop()
    assert clock.now - BEGUN == pytest.approx(5.0, abs=0.01)
    assert "a stop is not over after 5 s" in caplog.text


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
    ("live", "age", "polls"),
    [(True, 0.0079, 0), (True, 0.0081, 1), (False, 0.0149, 0), (False, 0.0151, 1)],
)
def test_drives_are_looked_at_after_8_ms_and_after_15_where_all_are_off(clock, live, age, polls):
    watch, done = watch_of(age=age)
    watch._axes.may_turn[:] = live
    watch._look()
    assert (done.polls, done.looks) == (polls, 0)


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
        with pytest.raises(SafetyError, match=r"axis 2 could not be seen for 0\.20 s"):
            watch._look_after()
    else:
        watch._look_after()
        assert done.stopped == []


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
    watch._missed = 3
    with pytest.raises(SafetyError, match="a node sends no process data any more: it left operational"):
        watch._look_after()
    watch._look_after()
    assert (done.started, len(done.stopped)) == (1, 1)


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
