"""The thread that watches while the program does something else, and the signals that end a program."""

from __future__ import annotations

import signal
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from drive_env.fieldbus.errors import BusError
from drive_env.safety import signals
from drive_env.safety import supervisor as module
from drive_env.safety.supervisor import PERIOD, SWITCH_INTERVAL, Supervisor


# --- the thread -------------------------------------------------------------------------------------------------------
class Turns:
    """Turns of a supervisor: what each raises, by its number; ended after the last."""

    def __init__(self, *raises):
        self.raises, self.count, self.failed, self.threads = raises, 0, 0, []
        self.supervisor = Supervisor(self.turn, self.fail)
        self.waits = []
        self.supervisor._wake = SimpleNamespace(wait=self.waits.append, clear=lambda: None, set=lambda: None)

    def turn(self):
        self.count += 1
        assert self.count < 100, "it goes on without end"
        if self.count == len(self.raises):
            self.supervisor._ended.set()
        if self.raises[self.count - 1] is not None:
            raise self.raises[self.count - 1]

    def fail(self):
        self.failed += 1


def test_a_turn_is_taken_every_four_milliseconds_until_it_is_ended(monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    turns = Turns(None, None, None)
    turn, takes = turns.turn, iter((0.0, 0.001, 0.5))
    turns.supervisor._turn = lambda: (setattr(clock, "now", clock.now + next(takes)), turn())
    turns.supervisor._run()
    assert PERIOD == 0.004
    assert turns.waits == pytest.approx([0.004, 0.003, 0.0005])  # what a turn took is not waited for again
    assert turns.failed == 0


def test_a_bus_that_is_gone_is_told_once_and_again_after_it_came_back(caplog):
    gone, other = BusError("the bus is gone"), BusError("another matter")
    turns = Turns(gone, gone, other, None, gone, gone)
    turns.supervisor._run()
    assert [record.getMessage() for record in caplog.records] == [
        "the bus is gone", "another matter", "the bus is gone"
    ]  # fmt: skip
    assert (turns.count, turns.failed) == (6, 0)


def test_anything_else_ends_the_watch(caplog):
    turns = Turns(None, ValueError("a mistake"), None)
    turns.supervisor._run()
    assert (turns.count, turns.failed) == (2, 1)
    assert "the drives cannot be monitored any more; they stop by their own watchdogs" in caplog.text


def test_it_is_a_thread_of_its_own_that_wakes_and_ends_at_once():
    before, came, seen = sys.getswitchinterval(), threading.Semaphore(0), []
    sys.setswitchinterval(0.004)
    try:
        supervisor = Supervisor(lambda: (seen.append(supervisor.is_this_thread()), came.release()), lambda: None)
        supervisor.start()
        assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL, abs=2e-6)
        assert came.acquire(timeout=20.0)
        supervisor.wake()
        assert came.acquire(timeout=20.0)
        assert not supervisor.is_this_thread() and set(seen) == {True}
        assert supervisor._thread.daemon
        began = time.monotonic()
        supervisor.close()
        assert not supervisor._thread.is_alive() and time.monotonic() - began < 1.9
        assert sys.getswitchinterval() == pytest.approx(0.004, abs=2e-6)
        supervisor.close()  # it is over
    finally:
        sys.setswitchinterval(before)


def test_a_turn_that_hangs_is_waited_for_two_seconds():
    supervisor, waits = Supervisor(lambda: None, lambda: None), []
    supervisor._thread = SimpleNamespace(is_alive=lambda: True, join=waits.append)
    supervisor.close()
    assert waits == [2.0]


def test_a_shorter_switch_interval_of_the_program_stays():
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0001)
    try:
        supervisor = Supervisor(lambda: None, lambda: None)
        supervisor.start()
        assert sys.getswitchinterval() == pytest.approx(0.0001, abs=2e-6)
        supervisor.close()
    finally:
        sys.setswitchinterval(before)


def test_it_may_end_itself():
    ended = []
    supervisor = Supervisor(lambda: (supervisor.close(), ended.append(1)), lambda: None)
    before = sys.getswitchinterval()
    supervisor.start()
    supervisor._thread.join(20.0)
    sys.setswitchinterval(before)
    assert ended == [1]


# --- signals ----------------------------------------------------------------------------------------------------------
class Guarded:
    """What hears of signals."""

    def __init__(self, under_way=False):
        self.under_way, self.heard = under_way, []

    def interrupt(self):
        self.heard.append("interrupt")
        return self.under_way

    def carry_on(self):
        self.heard.append("carry on")


@pytest.fixture
def handlers():
    """What SIGTERM did before, to be set by a test; everything is as it was afterwards."""
    numbers = [getattr(signal, name) for name in signals.NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    ones = []
    yield SimpleNamespace(guard=lambda *made: [(ones.append(one), signals.guard(one)) for one in made])
    for one in ones:
        signals.release(one)
    for number, handler in before.items():
        signal.signal(number, handler)
    assert not signals._guarded and not signals._before


def test_all_hear_before_what_the_program_does_about_a_signal(handlers):
    first, second, did = Guarded(), Guarded(), []
    signal.signal(signal.SIGTERM, lambda number, frame: did.append((number, list(first.heard))))
    handlers.guard(first, second)
    signals._handle(signal.SIGTERM, None)
    assert did == [(signal.SIGTERM, ["interrupt"])]
    assert first.heard == second.heard == ["interrupt", "carry on"]


def test_a_signal_while_a_stop_is_under_way_does_nothing_more(handlers):
    first, second, did = Guarded(), Guarded(under_way=True), []
    signal.signal(signal.SIGTERM, lambda number, frame: did.append(number))
    handlers.guard(first, second)
    signals._handle(signal.SIGTERM, None)
    assert did == [] and first.heard == second.heard == ["interrupt"]


def test_a_signal_that_ends_a_process_ends_it_by_an_exception(handlers):
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    handlers.guard(Guarded())
    with pytest.raises(SystemExit) as ended:
        signals._handle(signal.SIGTERM, None)
    assert ended.value.code == 128 + signal.SIGTERM == 143


def test_the_last_one_that_is_released_gives_the_signals_back(handlers):
    def own(number, frame):
        pass

    signal.signal(signal.SIGTERM, own)
    first, second = Guarded(), Guarded()
    handlers.guard(first, second, first)
    assert signal.getsignal(signal.SIGTERM) is signals._handle and signals._guarded == [first, second]
    signals.release(second)
    signals.release(second)  # once more
    assert signal.getsignal(signal.SIGTERM) is signals._handle
    signals.release(first)
    assert signal.getsignal(signal.SIGTERM) is own and signals._before == {}


def test_what_the_program_set_meanwhile_stays(handlers):
    one = Guarded()
    handlers.guard(one)

    def own(number, frame):
        pass

    signal.signal(signal.SIGTERM, own)
    signals.release(one)
    assert signal.getsignal(signal.SIGTERM) is own


def test_another_thread_takes_no_signals(handlers):
    one, before = Guarded(), signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=signals.guard, args=(one,))
    thread.start()
    thread.join()
    assert signals._guarded == [] and signal.getsignal(signal.SIGTERM) is before
    handlers.guard(one)
    thread = threading.Thread(target=signals.release, args=(one,))
    thread.start()
    thread.join()
    assert signals._guarded == [] and signal.getsignal(signal.SIGTERM) is signals._handle
    signals.release(one)  # it gives them back
    assert signal.getsignal(signal.SIGTERM) is before
