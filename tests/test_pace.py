"""When SYNCs go out by the clock: in the drives' rhythm, which one late action does not shift."""

from __future__ import annotations

import pytest

from drive_env.master import pace as module
from drive_env.master.pace import LockstepPace, RealTimePace, Timing
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
