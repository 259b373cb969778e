"""The meter between a tuner and drives: time, moves and violations as counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drive_env import motion
from drive_env.gains import GAIN_OBJECTS, write_gains
from tuning.drive_audit import KINDS, MeteredDrives
from tuning.identify.identification import identify
from tuning.target import emulated

TRAVEL, FAST, SHAKE, TRIP = range(len(KINDS))
TURN = 65536


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=2, travel=(-math.pi, math.pi)) as made:
        yield made


@pytest.fixture
def meter(target):
    return MeteredDrives(target)


def move(drives, position, where=None, seconds=0.2):
    """Move in pp, fast, and wait."""
    motion.start_move(drives, position, where=where)
    drives.advance(seconds)


def test_the_machine_is_hidden_and_the_rest_is_the_drives_own(target, meter):
    assert meter.machine is None
    assert meter.num_axes == 2
    np.testing.assert_array_equal(meter.read(0x6064), target.drives.read(0x6064))
    motion.enable(meter, mode="pp")
    trace = meter.record([0x6064, (0x2041, 3)], 0.02, period=0.005)
    assert trace[0x6064].shape == (4, 2) and trace[(0x2041, 3)].shape == (4, 2)


def test_time_counts_until_an_axis_is_last_written_to(meter):
    motion.enable(meter, mode="pp")
    began = meter.elapsed
    meter.advance(0.1)
    meter.write(0x6081, 100_000, where=np.array([True, False]))
    meter.record([0x6064], 0.05)
    assert meter.elapsed == pytest.approx(began + 0.15)
    assert meter.seconds == pytest.approx([began + 0.1, began])


def test_moves_are_those_that_an_engineer_counts(meter):
    motion.enable(meter, mode="pp")
    assert meter.moves.tolist() == [0, 0]
    move(meter, 1000)
    move(meter, 0, where=np.array([False, True]))
    assert meter.moves.tolist() == [1, 2]
    motion.select_mode(meter, "csv")
    there_and_back = np.repeat([0, 300_000, -300_000, 0], 20)
    for part in np.split(there_and_back, 8):  # in however many records
        meter.record([0x606C], 0.01, play={0x60FF: part})
    assert meter.moves.tolist() == [2, 3]
    began = meter.elapsed
    meter.record([0x606C], 0.1, play={0x60FF: np.stack([np.zeros(100, int), np.full(100, 90_000)], axis=1)})
    assert meter.moves.tolist() == [2, 4]
    assert meter.seconds[0] <= began < meter.seconds[1]  # an axis that rests meanwhile is not in use


def test_an_identification_is_a_dozen_moves_or_two(target):
    meter = MeteredDrives(target)
    identify(replace(target, drives=meter))
    assert np.all((meter.moves >= 5) & (meter.moves <= 40))


def test_leaving_the_travel_counts_each_time(meter):
    motion.enable(meter, mode="pp")
    first = np.array([True, False])
    move(meter, int(0.4 * TURN))
    assert meter.violations.sum() == 0
    for _ in range(2):
        move(meter, int(0.7 * TURN), first)
        move(meter, 0, first)
    assert meter.violations[TRAVEL].tolist() == [2, 0]
    assert meter.violations.sum() == 2


def test_too_fast_is_a_fifth_beyond_the_limit(target):
    slow = MeteredDrives(replace(target, speed=50.0, low=np.full(2, -math.inf), high=np.full(2, math.inf)))
    motion.enable(slow, mode="pv")
    for speed, violations in ((45.0, 0), (80.0, 1)):
        slow.write(0x60FF, int(speed / (2.0 * math.pi) * TURN))
        slow.advance(0.4)
        assert slow.violations[FAST].tolist() == [violations, violations]


def test_an_oscillation_that_nobody_stops_counts_once(target):
    meter = MeteredDrives(target)
    motion.enable(meter, mode="pp")
    calm = np.stack([meter.read(name) for name in GAIN_OBJECTS], axis=1)
    wild = calm.copy()
    wild[0] = (4021, 1573, 30_000, 3000, 30_000)
    write_gains(meter, wild)
    move(meter, 2000, seconds=0.3)
    assert meter.violations[SHAKE].tolist() == [1, 0]
    write_gains(meter, calm)
    meter.advance(0.2)
    assert meter.violations[SHAKE].tolist() == [1, 0]


def test_an_oscillation_that_is_stopped_in_time_does_not_count(target):
    meter = MeteredDrives(target)
    motion.enable(meter, mode="pp")
    calm = np.stack([meter.read(name) for name in GAIN_OBJECTS], axis=1)
    write_gains(meter, np.tile([4021, 1573, 30_000, 3000, 30_000], (2, 1)))
    move(meter, 2000, seconds=0.04)
    write_gains(meter, calm)
    meter.advance(0.3)
    assert meter.violations[SHAKE].tolist() == [0, 0]


def test_what_is_played_may_shake_the_axis(target):
    meter = MeteredDrives(replace(target, low=np.full(2, -math.inf), high=np.full(2, math.inf)))
    motion.enable(meter, mode="cst")
    square = np.where(np.arange(300) // 2 % 2, 2500, -2500)  # mA, every 2 ms the other way
    trace = meter.record([0x6077], 0.3, play={0x6071: square})
    assert np.sqrt(np.mean(np.diff(trace[0x6077] * 1e-3, axis=0) ** 2)) > 0.4 * target.motor.rated_current
    assert meter.violations[SHAKE].tolist() == [0, 0]


def test_a_trip_counts_when_it_happens(meter):
    motion.enable(meter, mode="pp")
    meter.write("Following error window", np.array([TURN, 10]))
    move(meter, int(0.3 * TURN))
    assert meter.violations[TRIP].tolist() == [0, 1]
