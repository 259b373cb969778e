"""A repeated call of record takes the short way, and says what the long way says."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, ObjectAccessError, motion

CHANGING = [0x6041, 0x6061, 0x6062, 0x6064, 0x606C, 0x6077, 0x60FD, (0x2041, 3), (0x2041, 4), (0x2042, 4), (0x2043, 2)]


@pytest.fixture
def pair():
    """Two equal sets of drives in csv: one that forgets what it has prepared, one that does not."""
    options = {"num_machines": 3, "seed": 2, "randomise": True, "num_threads": 1}
    with EmulatedDrives(**options) as long, EmulatedDrives(**options) as short:
        for drives in (long, short):
            motion.enable(drives, mode="csv")
        yield long, short


def both(pair, *arguments, **named):
    long, short = pair
    long._prepared.clear()
    return long.record(*arguments, **named), short.record(*arguments, **named)


def assert_equal(traces, names):
    for name in names:
        assert traces[0][name].dtype == traces[1][name].dtype == np.int64
        assert np.array_equal(traces[0][name], traces[1][name]), name
    assert np.array_equal(traces[0].t, traces[1].t)


def test_the_integers_are_the_same_cycle_by_cycle(pair):
    rng = np.random.default_rng(0)
    for k in range(300):
        cycles = 1 + k % 3
        targets = rng.integers(-2_000_000, 2_000_000, (cycles, 3) if k % 2 else cycles)
        traces = both(pair, CHANGING, cycles * 1e-3, play={0x60FF: targets})
        assert_equal(traces, CHANGING)
    assert len(pair[1]._prepared) == 1


def test_every_number_that_can_be_recorded_is_the_same(pair):
    names = []
    for entry in pair[0].device.new_dictionary():
        if entry.bits is not None and entry.access != "wo":
            names.append((entry.index, entry.sub))
    for _ in range(3):
        for drives in pair:
            drives.write(0x60FF, 500_000)
        for name in names:
            assert_equal(both(pair, [name], 0.001), [name])


def test_a_new_scale_is_seen(pair):
    for scaler in (65536, 1000, 7, 65536):
        for drives in pair:
            drives.write(0x2058, scaler)
        for _ in range(2):
            assert_equal(both(pair, [0x6064, 0x606C], 0.002, play={0x60FF: [100, 200]}), [0x6064, 0x606C])
    assert np.any(pair[1].read(0x6064) != 0)


def test_a_scale_of_some_axes_and_a_reset_are_seen(pair):
    for drives in pair:
        drives.record([0x6064], 0.001)
        drives.write(0x2058, 1000, where=np.array([False, True, False]))
    assert_equal(both(pair, [0x6064], 0.02), [0x6064])
    for drives in pair:
        drives.reset_node()
    assert_equal(both(pair, [0x6064], 0.02), [0x6064])
    for drives in pair:
        motion.enable(drives, mode="csv")
        drives.write(0x60FF, 300_000)
    assert_equal(both(pair, [0x6064], 0.02), [0x6064])


def test_a_reset_that_leaves_the_scales_alone_keeps_what_is_prepared(pair):
    drives = pair[1]
    drives.record(0x6064, 0.001)
    prepared = dict(drives._prepared)
    drives.machine.reset()
    drives.record(0x6064, 0.001)
    assert len(prepared) == 1 and drives._prepared == prepared
    drives.write(0x2058, 1000)
    drives.machine.reset()  # 65536 again
    drives.record(0x6064, 0.001)
    assert drives._prepared.keys() == prepared.keys() and drives._prepared != prepared


def test_counters_go_on_past_the_end_of_their_type():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        motion.enable(drives, mode="cst")
        drives.write(0x2058, 2**31 - 1)
        drives.record([0x6064], 0.001)
        drives.write(0x6071, 1000)
        found = drives.record([0x6064], 0.3)[0x6064]
        assert found.min() < -(2**30) and found.max() > 2**30


@pytest.mark.parametrize(
    ("play", "error", "message"),
    [
        ({0x60FF: [2**31]}, ObjectAccessError, "0609 0031h"),
        ({0x60FF: [-(2**31) - 1]}, ObjectAccessError, "0609 0032h"),
        ({0x60FF: [0.5]}, ObjectAccessError, "0607 0010h"),
        ({0x60FF: [True]}, ObjectAccessError, "0607 0010h"),
        ({0x60FF: [1, 2]}, ValueError, r"shape \(1,\) or \(1, 3\)"),
        ({0x60FF: np.full((1, 3), 2**63, np.uint64)}, ObjectAccessError, "0609 0031h"),
    ],
)
def test_what_is_refused_stays_refused(pair, play, error, message):
    drives = pair[1]
    for _ in range(2):
        drives.record([0x6064], 0.001, play={0x60FF: [0]})
    before = drives.read(0x60FF)
    with pytest.raises(error, match=message):
        drives.record([0x6064], 0.001, play=play)
    assert np.array_equal(drives.read(0x60FF), before)


def test_few_calls_are_kept():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        for k in range(200):
            drives.record([0x6064] * (k + 1), 0.001)
        assert len(drives._prepared) == 64
