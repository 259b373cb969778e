"""The audit between a tuner and drives: time, moves and violations as counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drive_env import motion
from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from drive_env.gains import write_gains
from tuning.drive_audit import KINDS, DriveAudit
from tuning.identify.identification import identify
from tuning.target import emulated

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

TRAVEL, FAST, SHAKE, TRIP = range(len(KINDS))
TURN = 65536


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=2, travel=(-math.pi, math.pi)) as made:
        yield made


def audited(target):
    """Return drives under an audit, and the audit."""
    audit = DriveAudit(target)
    return ObservedDrives(target.drives, audit), audit


@pytest.fixture
def under_audit(target):
    return audited(target)


def move(drives, position, where=None, seconds=0.2):
    """Move in pp, fast, and wait."""
    motion.start_move(drives, position, where=where)
    drives.advance(seconds)


def test_the_machine_is_hidden_and_the_rest_is_the_drives_own(target, under_audit):
    drives, _ = under_audit
    assert drives.machine is None
    assert drives.num_axes == 2
    np.testing.assert_array_equal(drives.read(0x6064), target.drives.read(0x6064))
    motion.enable(drives, mode="pp")
    trace = drives.record([0x6064, (0x2041, 3)], 0.02, period=0.005)
    assert trace[0x6064].shape == (4, 2) and trace[(0x2041, 3)].shape == (4, 2)


def test_time_counts_until_an_axis_is_last_written_to(under_audit):
    drives, audit = under_audit
    motion.enable(drives, mode="pp")
    began = audit.elapsed
    drives.advance(0.1)
    drives.write(0x6081, 100_000, where=np.array([True, False]))
    drives.record([0x6064], 0.05)
    assert audit.elapsed == pytest.approx(began + 0.15)
    assert audit.seconds == pytest.approx([began + 0.1, began])


def test_moves_are_those_that_an_engineer_counts(under_audit):
    drives, audit = under_audit
    motion.enable(drives, mode="pp")
    assert audit.moves.tolist() == [0, 0]
    move(drives, 1000)
    move(drives, 0, where=np.array([False, True]))
    assert audit.moves.tolist() == [1, 2]
    motion.select_mode(drives, "csv")
    there_and_back = np.repeat([0, 300_000, -300_000, 0], 20)
    for part in np.split(there_and_back, 8):  # in however many records
        drives.record([0x606C], 0.01, play={0x60FF: part})
    assert audit.moves.tolist() == [2, 3]
    began = audit.elapsed
    drives.record([0x606C], 0.1, play={0x60FF: np.stack([np.zeros(100, int), np.full(100, 90_000)], axis=1)})
    assert audit.moves.tolist() == [2, 4]
    assert audit.seconds[0] <= began < audit.seconds[1]  # an axis that rests meanwhile is not in use


@pytest.mark.slow
def test_an_identification_is_a_dozen_moves_or_two(target):
    drives, audit = audited(target)
    identify(replace(target, drives=drives))
    assert np.all((audit.moves >= 5) & (audit.moves <= 40))


def test_leaving_the_travel_counts_each_time(under_audit):
    drives, audit = under_audit
    motion.enable(drives, mode="pp")
    first = np.array([True, False])
    move(drives, int(0.4 * TURN))
    assert audit.violations.sum() == 0
    for _ in range(2):
        move(drives, int(0.7 * TURN), first)
        move(drives, 0, first)
    assert audit.violations[TRAVEL].tolist() == [2, 0]
    assert audit.violations.sum() == 2


def test_too_fast_is_a_fifth_beyond_the_limit(target):
    drives, audit = audited(replace(target, speed=50.0, low=np.full(2, -math.inf), high=np.full(2, math.inf)))
    motion.enable(drives, mode="pv")
    for speed, violations in ((45.0, 0), (80.0, 1)):
        drives.write(0x60FF, int(speed / (2.0 * math.pi) * TURN))
        drives.advance(0.4)
        assert audit.violations[FAST].tolist() == [violations, violations]


def test_an_oscillation_that_nobody_stops_counts_once(target):
    drives, audit = audited(target)
    motion.enable(drives, mode="pp")
    calm = np.stack([drives.read(name) for name in GAIN_OBJECTS], axis=1)
    wild = calm.copy()
    wild[0] = (4021, 1573, 30_000, 3000, 30_000)
    write_gains(drives, wild)
    move(drives, 2000, seconds=0.3)
    assert audit.violations[SHAKE].tolist() == [1, 0]
    write_gains(drives, calm)
    drives.advance(0.2)
    assert audit.violations[SHAKE].tolist() == [1, 0]


def test_an_oscillation_that_is_stopped_in_time_does_not_count(target):
    drives, audit = audited(target)
    motion.enable(drives, mode="pp")
    calm = np.stack([drives.read(name) for name in GAIN_OBJECTS], axis=1)
    write_gains(drives, np.tile([4021, 1573, 30_000, 3000, 30_000], (2, 1)))
    move(drives, 2000, seconds=0.04)
    write_gains(drives, calm)
    drives.advance(0.3)
    assert audit.violations[SHAKE].tolist() == [0, 0]


def test_what_is_played_may_shake_the_axis(target):
    drives, audit = audited(replace(target, low=np.full(2, -math.inf), high=np.full(2, math.inf)))
    motion.enable(drives, mode="cst")
    square = np.where(np.arange(300) // 2 % 2, 2500, -2500)  # mA, every 2 ms the other way
    trace = drives.record([0x6077], 0.3, play={0x6071: square})
    assert np.sqrt(np.mean(np.diff(trace[0x6077] * 1e-3, axis=0) ** 2)) > 0.4 * target.motor.rated_current
    assert audit.violations[SHAKE].tolist() == [0, 0]


def test_a_trip_counts_when_it_happens(under_audit):
    drives, audit = under_audit
    motion.enable(drives, mode="pp")
    drives.write("Following error window", np.array([TURN, 10]))
    move(drives, int(0.3 * TURN))
    assert audit.violations[TRIP].tolist() == [0, 1]
