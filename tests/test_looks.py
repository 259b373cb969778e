"""What is asked for, since no PDO carries it: those that answer are seen in time, whoever else is silent."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env.dictionary.entries import Entry
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
