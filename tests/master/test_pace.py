"""When SYNCs go out by the clock: in the drives' rhythm, which one late action does not shift."""

from __future__ import annotations

from itertools import pairwise

import pytest

from drive_env.fieldbus.link import Timing
from drive_env.master import pace as module
from drive_env.master.pace import LockstepPace, RealTimePace
from drive_env.master.sampling import run_cycles

CYCLE = 0.001


class Clock:
    """A clock that goes on only while somebody waits, or as a test says."""

    def __init__(self):
        self.now = 5.0

    def perf_counter(self):
        return self.now

    def receive(self, timeout):
        self.now += timeout
        return False


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(module, "time", made)
    return made


def run_of_one_cycle_each(clock, thinking):
    """Return when the SYNCs of runs of one cycle go out, with so much time [ms] before each, in ms since the first."""
    pace, times = RealTimePace(CYCLE), []
    for milliseconds in thinking:
        clock.now += 1e-3 * milliseconds
        pace.begin()
        pace.wait(clock.receive)
        times.append(clock.now)
    return pytest.approx([1e3 * (time - times[0]) for time in times], abs=1e-9)


@pytest.mark.parametrize(
    ("thinking", "times"),
    [
        ([0, 0.2, 0.9, 0.5], [0, 1, 2, 3]),  # a SYNC each millisecond, however long one thinks meanwhile
        ([0, 1.1, 0.3, 0.3], [0, 1.1, 2, 3]),  # a tenth late, and the next ones are in time again
        ([0, 1.4, 1.05, 0.2], [0, 1.4, 2.45, 3]),
        ([0, 1.6, 0.2, 0.2], [0, 1.6, 2.6, 3.6]),  # more than half a cycle: two SYNCs would come too close
        ([0, 7.3, 0.2], [0, 7.3, 8.3]),  # a pause
    ],
)
def test_a_policy_that_is_a_little_late_keeps_the_rhythm(clock, thinking, times):
    assert run_of_one_cycle_each(clock, thinking) == times


def test_within_a_run_a_sync_more_than_a_cycle_late_shifts_the_others(clock):
    pace = RealTimePace(CYCLE)
    pace.begin()
    found = []
    for late in (0, 0.9, 0, 2.5, 0):
        clock.now += 1e-3 * late
        found.append((pace.wait(clock.receive), round(1e3 * (clock.now - 5.0), 6)))
    assert found == [(0, 0), (0, 1), (0, 2), (1, 4.5), (0, 5.5)]
    assert pace.timing == Timing(5, 1, pytest.approx(0.0015))
    pace.begin()
    assert pace.timing.cycles == 0 and pace.total.cycles == 5


@pytest.mark.parametrize(("ahead", "gap"), [(0.4, 1.02), (0.6, 0.98), (0.01, 1.01), (0.99, 0.99), (0.0, 1.0)])
def test_a_sync_is_moved_to_suit_the_drives_clocks_by_a_fiftieth_of_a_cycle_at_most(clock, ahead, gap):
    """`ahead` of a cycle later would suit them: what is more than half a cycle is made up by going earlier."""
    pace, times = RealTimePace(CYCLE, lambda due: ahead * CYCLE), []
    pace.begin()
    for _ in range(5):
        pace.wait(lambda timeout: clock.receive(timeout + 1e-12))  # else what is left may be too little to count
        times.append(clock.now)
    assert [b - a for a, b in pairwise(times)] == pytest.approx([gap * CYCLE] * 4, abs=1e-9)


def test_the_first_set_points_do_not_wait_for_the_sync_they_belong_to(clock):
    """Their frames take time of the bus that a policy has left; later ones go out just before their SYNC."""
    sent = []

    class Sent:
        """A link, and what goes out on it."""

        receive = staticmethod(clock.receive)

        def sync(self):
            self.send("SYNC")

        def send(self, what):
            sent.append((what, round(1e3 * (clock.now - 5.0), 6)))

    pace = RealTimePace(CYCLE)
    pace.begin()
    pace.wait(clock.receive)  # a SYNC at 0
    clock.now += 0.0004  # a policy thinks
    link = Sent()
    run_cycles(link, pace, 2, link, None, 1.0)
    assert sent == [(0, 0.4), ("SYNC", 1.0), (1, 2.0), ("SYNC", 2.0)]


@pytest.mark.parametrize("ahead", [0, 1, 3])
def test_in_lockstep_what_is_looked_at_does_not_depend_on_how_fast_this_computer_is(ahead):
    """A fast emulator's rows come before they are waited for, a slow one's just then: the same chunks are looked at."""

    class Answers:
        """Samples of an emulator that has answered `ahead` more SYNCs than somebody waits for."""

        rows = 0

        def complete(self):
            return min(self.rows + ahead, link.syncs)

        def missing(self, rows, timeout):
            raise AssertionError(f"row {rows} stayed out")

    class Answering:
        """Its link."""

        syncs = 0

        def sync(self):
            self.syncs += 1

        def receive(self, timeout=0.0):
            return False

        def wait(self, done, timeout):
            while not done() and samples.rows < self.syncs:
                samples.rows += 1
            return done()

    link, samples, looked = Answering(), Answers(), []
    run_cycles(link, LockstepPace(), 5, None, samples, 1.0, observe=lambda first, last: looked.append((first, last)))
    assert looked == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]


# --- cycles -----------------------------------------------------------------------------------------------------------
class Line:
    """A link, its outputs and its samples: a sample comes so many SYNCs late; `log` is what went out."""

    def __init__(self, clock=None, delay=0, lost=()):
        self.log, self.delay, self.lost, self.syncs, self.waits, self.clock = [], delay, set(lost), 0, [], clock

    def send(self, row):
        self.log.append(row)

    def sync(self):
        self.syncs += 1
        self.log.append("SYNC")

    def complete(self):
        come = [k for k in range(max(self.syncs - self.delay, 0)) if k not in self.lost]
        return next((k for k, row in enumerate(come) if row != k), len(come))

    def receive(self, timeout=0.0):
        if self.clock is not None:
            self.clock.now += timeout
        return False

    def wait(self, done, timeout):
        self.waits.append(timeout)
        if not done():
            self.delay = 0
        return done()

    def missing(self, rows, timeout):
        return TimeoutError(f"{rows} SYNCs, {timeout} s")


@pytest.mark.parametrize("cycles", [0, 1, 3])
def test_a_row_goes_out_for_each_sync(cycles):
    line = Line()
    run_cycles(line, LockstepPace(), cycles, line, None, 1.0)
    assert line.log == [what for k in range(cycles) for what in (k, "SYNC")]


def test_samples_that_stay_out_are_an_error_with_the_syncs_so_far():
    line = Line(lost=[1])
    with pytest.raises(TimeoutError, match=r"^4 SYNCs, 0.25 s$"):
        run_cycles(line, LockstepPace(), 4, None, line, 0.25)
    assert line.syncs == 4 and line.waits == [0.25] * 4


def test_no_more_syncs_than_the_window_go_out_before_their_samples_are_in():
    """The first that is waited for is that of as many SYNCs ago as fit; at the end all of them are."""
    line, needed = Line(delay=1000), []
    line.wait = lambda done, timeout: needed.append(
        next(k for k in range(100) if (setattr(line, "delay", line.syncs - k), done())[1])
    ) or True  # fmt: skip
    pace = LockstepPace()
    run_cycles(line, pace, 20, None, line, 1.0)
    assert needed == [0] * pace.window + [1, 2, 3] + [20]


def test_each_row_is_looked_at_before_the_next_sync_where_time_waits():
    line, looked = Line(), []
    run_cycles(line, LockstepPace(), 3, line, line, 1.0, observe=lambda *rows: looked.append((*rows, line.syncs)))
    assert looked == [(0, 1, 1), (1, 2, 2), (2, 3, 3)]
    line, looked = Line(), []
    run_cycles(line, LockstepPace(), 0, line, line, 1.0, observe=lambda *rows: looked.append(rows))
    assert not looked


def test_in_real_time_all_that_came_is_looked_at_once(clock):
    line, looked = Line(clock, delay=1), []
    run_cycles(line, RealTimePace(CYCLE), 4, None, line, 1.0, observe=lambda *rows: looked.append((*rows, line.syncs)))
    assert looked == [(0, 1, 2), (1, 2, 3), (2, 4, 4)]


@pytest.mark.parametrize(("cycles", "barriers"), [(15, 0), (16, 1), (40, 2)])
def test_without_samples_the_nodes_catch_up_now_and_then(cycles, barriers):
    line, held = Line(), []
    run_cycles(line, LockstepPace(), cycles, None, None, 1.0, barrier=lambda: held.append(line.syncs))
    assert held == [16 * (k + 1) for k in range(barriers)]


@pytest.mark.parametrize(("skip_missed", "syncs"), [(False, 10), (True, 6)])
def test_cycles_that_passed_while_a_sync_was_late_count_where_the_time_is_kept(clock, skip_missed, syncs):
    line = Line(clock)
    late = iter([0.0, 0.0, 0.0052, *[0.0] * 20])  # 4 whole cycles beyond the one that was due
    pace = RealTimePace(CYCLE)
    wait = pace.wait

    def slow(receive):
        clock.now += next(late)
        return wait(receive)

    pace.wait = slow
    run_cycles(line, pace, 10, None, None, 1.0, **({"skip_missed": True} if skip_missed else {}))
    assert line.syncs == syncs


def test_what_comes_without_end_is_taken_in_for_a_while():
    taken = []
    pace = LockstepPace()
    assert pace.wait(lambda timeout: taken.append(timeout) or True) == 0
    assert taken == [0.0] * 256  # frames of 32 ms on a bus of 1 Mbit/s
    assert (pace.timing, pace.total) == (Timing(1, 0, 0.0), Timing(1, 0, 0.0))
    pace.begin()
    assert (pace.timing, pace.total) == (Timing(0, 0, 0.0), Timing(1, 0, 0.0))
    assert pace.end(taken.append) is None and len(taken) == 256


def test_a_run_ends_when_the_cycle_of_its_last_sync_has_passed(clock):
    pace = RealTimePace(CYCLE)
    pace.begin()
    pace.wait(clock.receive)
    begun = clock.now
    pace.end(clock.receive)
    assert clock.now == pytest.approx(begun + CYCLE)
    clock.now += 0.4 * CYCLE  # half a cycle is no pause
    pace.begin()
    pace.wait(clock.receive)
    assert clock.now == pytest.approx(begun + 1.4 * CYCLE)
