"""What is asked for, since no PDO carries it: those that answer are seen in time, whoever else is silent."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.held_objects import HeldObjects

from drive_env.dictionary.entries import Entry
from drive_env.drives.limits import NO_LIMIT
from drive_env.safety import looks as module
from drive_env.safety.looks import Looks

NODES, AXES = 6, 2
ANSWER = 0.0005  # s of an answer
IN_TIME = 0.020  # s between two looks at an axis: docs/safety.md


@pytest.fixture
def bench(monkeypatch):
    """Six nodes of two axes, a clock that goes on while somebody waits for an answer, and when which axis was seen."""
    clock, silent, seen = SimpleNamespace(now=100.0), set(), {}
    entry = Entry(0x6064, 0, "Position actual value", 32, "ro", -(2**31), 2**31 - 1, 0, "inc", True, signed=True)

    class Client:
        def __init__(self, node):
            self.node = node

        def ask(self, index, sub, timeout):
            clock.now += timeout if self.node in silent else ANSWER
            return None if self.node in silent else b"\0\0\0\0"

    description = SimpleNamespace(
        num_axes=AXES, dictionary=None, key=lambda entry, part: (entry.index + 0x800 * part, entry.sub),
        decode=lambda entry, data: int.from_bytes(data, "little"),
    )  # fmt: skip
    drives = SimpleNamespace(
        description=description, nodes=tuple(range(1, NODES + 1)), num_axes=NODES * AXES, time_waits=False, sdo=Client
    )
    axes = SimpleNamespace(now=lambda: clock.now, epoch=0)

    def observe(rows, epoch, where):
        assert set(rows) == {(0x6064, 0)} and where.sum() == 1
        seen.setdefault(int(np.flatnonzero(where)[0]), []).append(clock.now)

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    looks = Looks(drives, axes, None, observe)
    looks.watched = lambda: [entry]
    looks.sampled(())

    def look_for(seconds):
        end = clock.now + seconds
        while clock.now < end:
            looks.ask_unsampled()
            clock.now += 0.001  # the supervisor's turn

    return SimpleNamespace(look_for=look_for, silent=silent, seen=seen, looks=looks, entry=entry)


@pytest.mark.parametrize("silent", [set(), {0}, {3}, {0, 2, 4}, {1, 2, 3, 4, 5}])
def test_silent_nodes_hold_nobody_up(bench, silent):
    bench.silent |= silent
    bench.look_for(0.2)  # it is noticed who is
    bench.seen.clear()
    bench.look_for(1.0)
    answering = {axis for axis in range(NODES * AXES) if axis // AXES not in silent}
    assert set(bench.seen) == answering
    assert max(np.diff(times).max() for times in bench.seen.values()) <= IN_TIME


def test_who_answers_again_is_seen_again(bench):
    bench.silent |= {0, 1, 2}
    bench.look_for(0.5)
    bench.seen.clear()
    bench.silent.clear()
    bench.look_for(0.2)
    assert all(len(bench.seen[axis]) >= 3 for axis in range(NODES * AXES))
    assert bench.looks.ask([bench.entry])


def test_whether_all_came_is_said(bench):
    assert bench.looks.ask([bench.entry])
    bench.silent.add(5)
    assert not bench.looks.ask([bench.entry])
    assert not bench.looks.ask([bench.entry])  # without asking it


# --- what is watched, and what of it no sample carries ----------------------------------------------------------------
STATUS, POSITION, VELOCITY, CURRENT, DEMAND = (0x6041, 0), (0x6064, 0), (0x606C, 0), (0x6077, 0), (0x6062, 0)
ALL = (STATUS, POSITION, VELOCITY, CURRENT, DEMAND)


def looks_of(current=NO_LIMIT, following=NO_LIMIT, *, travel=False, time_waits=True, lacks=()):
    """Looks at two axes, their drives, and their limits."""
    drives = HeldObjects({key: (k, 10 + k) for k, key in enumerate(ALL) if key not in lacks}, 2)
    drives.time_waits = time_waits
    limits = SimpleNamespace(
        current=np.array([NO_LIMIT, current]), following=np.array([NO_LIMIT, following]), has_position=travel
    )
    axes = SimpleNamespace(clock=5.0, now=lambda: axes.clock, epoch=0, velocity_object=VELOCITY)
    return Looks(drives, axes, SimpleNamespace(bounds=lambda: limits), lambda *seen: None), drives, axes, limits


def indices(entries):
    return [(entry.index, entry.sub) for entry in entries]


@pytest.mark.parametrize(
    ("current", "following", "travel", "lacks", "watched"),
    [
        (NO_LIMIT, NO_LIMIT, False, (), [STATUS, POSITION, VELOCITY]),
        (400, NO_LIMIT, False, (), [STATUS, POSITION, CURRENT, VELOCITY]),  # the most important first
        (NO_LIMIT, 100, False, (), [STATUS, POSITION, VELOCITY, DEMAND]),
        (400, 100, False, (), [STATUS, POSITION, CURRENT, VELOCITY, DEMAND]),
        (400, 100, False, (CURRENT, VELOCITY), [STATUS, POSITION, DEMAND]),
        (NO_LIMIT, NO_LIMIT, True, (), [STATUS, POSITION, VELOCITY, DEMAND]),  # where csp leads tells whether it stays
    ],
)
def test_what_no_limit_needs_is_not_watched(current, following, travel, lacks, watched):
    looks, _, _, limits = looks_of(current, following, travel=travel, lacks=lacks)
    found = looks.watched()
    assert indices(found) == watched
    limits.current = np.array([NO_LIMIT, NO_LIMIT])
    assert looks.watched() is found  # while limits are these
    looks._limits.bounds = lambda: SimpleNamespace(current=np.array([NO_LIMIT]), following=np.array([NO_LIMIT]),
                                                   has_position=False)  # fmt: skip
    assert looks.watched() is not found


@pytest.mark.parametrize(
    ("chosen", "asked"),
    [
        ((STATUS, POSITION, CURRENT, VELOCITY, DEMAND), []),
        ((STATUS, POSITION, CURRENT, VELOCITY), [POSITION, DEMAND]),  # a following error is told by both of a moment
        ((STATUS, CURRENT, VELOCITY, DEMAND), [POSITION]),
        ((STATUS, CURRENT, VELOCITY), [POSITION, DEMAND]),
        ((STATUS, POSITION, VELOCITY, DEMAND), [CURRENT]),
    ],
)
def test_what_comes_with_no_sync_is_asked_for(chosen, asked):
    looks, drives, _, _ = looks_of(400, 100)
    assert not looks.is_short
    looks.sampled([drives.entries[key] for key in chosen])
    assert looks.is_short == bool(asked)
    seen = []
    looks.ask = lambda entries: seen.append(indices(entries))
    looks.ask_unsampled()
    assert seen == ([asked] if asked else [])


def test_what_no_sample_carries_is_asked_for_every_10_ms(monkeypatch):
    looks, drives, _, _ = looks_of(400)
    clock, seen = SimpleNamespace(now=0.0), []
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    looks.sampled([drives.entries[STATUS]])
    looks.ask = lambda entries: seen.append(clock.now)
    for clock.now in (0.0, 0.0099, 0.01, 0.0199, 0.02, 0.05, 0.0599):
        looks.ask_unsampled()
    assert seen == [0.0, 0.01, 0.02, 0.05]


def test_in_lockstep_it_comes_with_the_samples_every_10_ms():
    looks, drives, axes, _ = looks_of(400)
    looks.sampled([drives.entries[STATUS]])
    rows = {STATUS: np.array([[7, 8], [9, 10]])}
    found = looks.with_unsampled(rows)
    assert {key: row.tolist() for key, row in found.items()} == {
        STATUS: [[7, 8], [9, 10]], POSITION: [[1, 11]] * 2, CURRENT: [[3, 13]] * 2, VELOCITY: [[2, 12]] * 2
    }  # fmt: skip
    axes.clock = 5.0075
    assert looks.with_unsampled(rows) is rows  # two cycles later 9.5 ms have passed
    axes.clock = 5.0085
    assert looks.with_unsampled(rows) is not rows
    axes.clock = 6.0
    assert {key: row.tolist() for key, row in looks.with_unsampled({}).items()}[POSITION] == [[1, 11]]
    looks, drives, axes, _ = looks_of(400)
    looks.sampled([drives.entries[STATUS]])
    axes.clock = 0.0
    assert looks.with_unsampled(rows) is not rows  # the first time at once
    axes.clock = 0.0085
    assert looks.with_unsampled({}) == {}
    axes.clock = 0.0095
    assert looks.with_unsampled({}) != {}


@pytest.mark.parametrize(("time_waits", "usual", "again"), [(True, 0.7, 0.7), (False, 0.015, 0.010)])
def test_how_long_an_answer_is_waited_for(time_waits, usual, again):
    """Where time waits, nothing runs on meanwhile; else a node that was silent before gets less."""
    looks, drives, axes, _ = looks_of(time_waits=time_waits)
    drives.description.answer_timeout = 0.7
    asked = []
    looks._ask_node = lambda node, entries, timeout: asked.append((node, timeout)) or True
    assert looks.ask([]) is True
    looks._silent = {1: axes.clock}
    assert looks.ask([]) is False
    looks._silent = {0: axes.clock + 1.0, 1: axes.clock}
    looks.ask([])
    looks._silent = {0: axes.clock, 1: axes.clock}
    looks.ask([])  # one of them at a time
    assert asked == [(0, usual), (1, usual), (0, usual), (1, again), (1, again), (0, again)]


def test_who_is_silent_is_not_asked_for_50_ms_and_then_after_the_others():
    looks, drives, axes, _ = looks_of()
    looks._ask_axis = lambda node, axis, entries, timeout: {}
    assert not looks._ask_node(0, [drives.entries[STATUS]], 0.1)
    assert looks._silent == {0: pytest.approx(5.05)}
    assert not looks._ask_node(1, [drives.entries[STATUS]], 0.1)
    axes.clock = 6.0
    assert not looks._ask_node(0, [drives.entries[STATUS]], 0.1)
    assert list(looks._silent) == [1, 0]
    looks._ask_axis = lambda node, axis, entries, timeout: {STATUS: np.zeros((1, 2), np.int64)}
    assert looks._ask_node(1, [drives.entries[STATUS]], 0.1)
    assert list(looks._silent) == [0]
