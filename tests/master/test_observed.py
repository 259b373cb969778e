"""Drives that somebody looks at: what observers are told, and what the caller sees of them, which is nothing."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.drives.interface import Observer, bus_of, machine_of
from drive_env.drives.observed import ObservedDrives

POSITION, CURRENT = 0x6064, 0x6077


class Log(Observer):
    """Notes what it is told."""

    def __init__(self, name, log, objects=(), every=None, hides=False):
        self.name, self.log, self.objects, self.every, self.hides_machine = name, log, objects, every, hides

    def patience(self):
        return self.every

    def written(self, below, name, value, where):
        self.log.append((self.name, "written", name, value))

    def passes(self, duration):
        self.log.append((self.name, "passes", duration))

    def passed(self, below, duration, trace, asked, play):
        rows = None if play is None else [len(values) for values in play.values()]
        self.log.append((self.name, "passed", round(duration * 1e3), len(trace), tuple(asked), rows))


@pytest.fixture
def drives():
    with EmulatedDrives("tmcm1636", "inertia", num_machines=2, num_threads=1) as made:
        motion.enable(made, mode="csv")
        yield made


def test_without_a_wish_of_its_own_an_observer_is_told_once_of_each_call(drives):
    log = []
    seen = ObservedDrives(drives, Log("a", log), Log("b", log))
    seen.write(0x60FF, 1000)
    seen.advance(0.01)
    seen.record([POSITION], 0.02)
    assert log == [
        ("a", "written", 0x60FF, 1000), ("b", "written", 0x60FF, 1000), ("a", "passes", 0.01), ("b", "passes", 0.01),
        ("a", "passes", 0.02), ("b", "passes", 0.02),
        ("a", "passed", 20, 20, (POSITION,), None), ("b", "passed", 20, 20, (POSITION,), None),
    ]  # fmt: skip


def test_who_wants_an_object_recorded_sees_time_that_is_only_advanced(drives):
    log = []
    ObservedDrives(drives, Log("a", log, [CURRENT])).advance(0.03)
    assert log == [("a", "passes", 0.03), ("a", "passed", 30, 30, (), None)]


def test_the_most_impatient_observer_decides_when_all_look(drives):
    log = []
    seen = ObservedDrives(drives, Log("a", log, every=25), Log("b", log, every=10))
    seen.record([POSITION], 0.024, play={0x60FF: np.zeros(24, int)})
    assert [entry for entry in log if entry[1] == "passed" and entry[0] == "a"] == [
        ("a", "passed", 10, 10, (POSITION,), [10]),
        ("a", "passed", 10, 10, (POSITION,), [10]),
        ("a", "passed", 4, 4, (POSITION,), [4]),
    ]


def test_what_is_recorded_in_parts_is_what_is_recorded_at_once():
    traces = []
    for observers in ((), (Log("a", [], [CURRENT], every=7),)):
        with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as made:
            seen = ObservedDrives(made, *observers)
            motion.enable(seen, mode="csv")
            traces.append(seen.record([POSITION, CURRENT], 0.1, play={0x60FF: np.arange(100) * 1000}))
    for name in (POSITION, CURRENT):
        np.testing.assert_array_equal(traces[0][name], traces[1][name])
    np.testing.assert_allclose(traces[0].t, traces[1].t)


def test_an_observer_may_hide_the_machine_and_nothing_else(drives):
    hidden = ObservedDrives(ObservedDrives(drives, Log("a", [])), Log("b", [], hides=True))
    assert hidden.machine is None and drives.machine is not None
    assert (hidden.num_axes, hidden.device, hidden.time_waits) == (2, drives.device, True)
    assert [observer.name for observer in hidden.observers] == ["a", "b"]
    with pytest.raises(ValueError, match="these drives have no emulated machine; use EmulatedDrives"):
        machine_of(hidden)
    with pytest.raises(ValueError, match="these drives are not on a bus; use open_drives"):
        bus_of(hidden)
