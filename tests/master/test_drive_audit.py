"""The audit between a tuner and drives: time, moves and violations as counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import motion
from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from tuning import drive_audit as module
from tuning.drive_audit import KINDS, DriveAudit
from tuning.identify.identification import identify
from tuning.target import emulated

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


def test_a_trip_counts_when_it_happens(under_audit):
    drives, audit = under_audit
    motion.enable(drives, mode="pp")
    drives.write("Following error window", np.array([TURN, 10]))
    move(drives, int(0.3 * TURN))
    assert audit.violations[TRIP].tolist() == [0, 1]


# --- by hand, on recorded signals -------------------------------------------------------------------------------------
POSITION, VELOCITY, CURRENT, STATUS = 0x6064, 0x606C, 0x6077, 0x6041
RATED = 2.0  # A
FIRST = np.array([True, False])


@pytest.fixture
def audit(monkeypatch):
    """An audit of two axes that began at 100 and 200 increments, of a travel of half a turn to each side, 10 rad/s."""
    monkeypatch.setattr(module, "ampere_per_count", lambda drives: 1e-3)
    monkeypatch.setattr(module, "counts_per_ampere", lambda drives: 1e3)
    device = find_device("tmcm1636")
    drives = SimpleNamespace(
        device=device, read=lambda name: np.array([100, 200]) if name == POSITION else np.full(2, TURN)
    )
    target = SimpleNamespace(
        drives=drives, num_axes=2, device=device, low=np.array([-math.pi, -math.inf]), high=np.full(2, math.pi),
        speed=10.0, current=3.0, motor=SimpleNamespace(rated_current=RATED),
    )  # fmt: skip
    return DriveAudit(target)


def passes(audit, cycles=1, *, position=0, velocity=0, current=0, status=0x0637, play=None):
    """Let cycles pass in which the axes have these values: numbers, rows of each, or of each axis."""
    rows = {POSITION: position, VELOCITY: velocity, CURRENT: current, STATUS: status}
    trace = {
        name: np.broadcast_to(np.asarray(value)[..., None] if np.ndim(value) == 1 else value, (cycles, 2))
        for name, value in rows.items()
    }
    trace[POSITION] = trace[POSITION] + np.array([100, 200])
    audit.passed(None, cycles * 1e-3, trace, (), play)


@pytest.mark.parametrize(("away", "outside"), [(34078, [0, 0]), (34079, [1, 1]), (-34078, [0, 0]), (-34079, [1, 0])])
def test_two_hundredths_of_a_turn_beyond_the_travel_are_none_yet(audit, away, outside):
    """Half a turn has 32,768 increments, and 0.02 of a turn 1,310.72; backwards the second axis turns freely."""
    passes(audit, 3, position=[0, away, away])
    assert audit.violations[TRAVEL].tolist() == outside and audit.violations.sum() == sum(outside)


def test_positions_go_over_the_counters_end(audit):
    passes(audit, position=2**32 - 5)
    assert audit.violations.sum() == 0


@pytest.mark.parametrize(("share", "fast"), [(1.19, 0), (1.21, 1), (-1.21, 1), (-1.19, 0)])
def test_a_fifth_beyond_the_speeds_limit_is_too_fast(audit, share, fast):
    passes(audit, velocity=[share * 10.0 / (2.0 * math.pi) * TURN])
    assert audit.violations[FAST].tolist() == [fast, fast] and audit.violations.sum() == 2 * fast


def test_a_violation_counts_when_it_begins_and_again_when_it_begins_anew(audit):
    far, trip = 40_000, 0x0008
    passes(audit, 4, position=[far, far, 0, far], status=[trip, 0, trip, trip])
    assert (audit.violations[TRAVEL].tolist(), audit.violations[TRIP].tolist()) == ([2, 2], [2, 2])
    passes(audit, 2, position=[far, far], status=[trip, trip])  # it goes on
    assert (audit.violations[TRAVEL].tolist(), audit.violations[TRIP].tolist()) == ([2, 2], [2, 2])
    passes(audit)
    passes(audit, position=np.array([[far, 0]]), status=np.array([[0, trip]]))
    assert (audit.violations[TRAVEL].tolist(), audit.violations[TRIP].tolist()) == ([3, 2], [2, 3])
    assert audit.violations.dtype == np.int64 and audit.violations.shape == (4, 2)


def shaking(cycles, share=1.01):
    """A current that changes from cycle to cycle by so much of two fifths of the rated one [mA]."""
    return 1e3 * share * 0.4 * RATED * 0.5 * (-1.0) ** np.arange(cycles)


@pytest.mark.parametrize("pieces", [[100], [25] * 4, [7, 18, 40, 35], [1] * 100, [60, 40]])
def test_an_axis_that_shakes_for_100_ms_oscillates_in_however_many_records(audit, pieces):
    audit._last_current[:] = -shaking(1)[0] * 1e-3  # it shook before
    wave, at = shaking(100), 0
    for count in pieces:
        assert audit.violations[SHAKE].tolist() == [0, 0]
        passes(audit, count, current=np.stack([wave[at : at + count], 0.0 * wave[at : at + count]], axis=1))
        at += count
    assert audit.violations[SHAKE].tolist() == [1, 0] and audit.violations.sum() == 1
    passes(audit, 300, current=shaking(300))
    assert audit.violations[SHAKE].tolist() == [1, 1]  # the first goes on, and counts once


def test_an_oscillation_of_less_than_100_ms_or_two_fifths_does_not_count(audit):
    audit._last_current[:] = -shaking(1)[0] * 1e-3
    passes(audit, 75, current=shaking(75))
    passes(audit, 25, current=np.full(25, shaking(75)[-1]))  # a calm block
    passes(audit, 75, current=shaking(75))
    passes(audit, 25, current=np.full(25, shaking(75)[-1]))
    passes(audit, 400, current=shaking(400, 0.98))
    assert audit.violations.sum() == 0


def test_what_is_played_ends_a_row_of_blocks_and_its_last_current_is_where_the_next_begins(audit):
    play = {0x6071: np.zeros(40)}
    audit._last_current[:] = -shaking(1)[0] * 1e-3
    passes(audit, 80, current=shaking(80))
    passes(audit, 40, current=shaking(40), play=play)
    passes(audit, 95, current=shaking(95))
    assert audit.violations[SHAKE].tolist() == [0, 0]
    passes(audit, 6, current=shaking(96)[-6:] * -1.0)
    assert audit.violations[SHAKE].tolist() == [1, 1]
    passes(audit, 40, current=np.full(40, 9000.0), play=play)
    passes(audit, 100, current=np.full(100, 9000.0))  # no jump
    assert audit.violations[SHAKE].tolist() == [1, 1] and audit._last_current.tolist() == [9.0, 9.0]


def test_an_axis_is_in_use_until_it_is_last_written_to_or_moved_by_what_is_played(audit):
    passes(audit, 100)
    assert (audit.elapsed, audit.seconds.tolist()) == (pytest.approx(0.1), [0.0, 0.0])
    audit.written(None, "Controlword", 0x0F, FIRST)
    assert audit.seconds.tolist() == pytest.approx([0.1, 0.0])
    passes(audit, 50)
    audit.written(None, 0x6040, 0x0F, None)
    assert audit.seconds.tolist() == pytest.approx([0.15, 0.15])
    audit.written(None, 0x6040, 0x1F, FIRST)
    passes(audit, 1)
    assert audit.moves.tolist() == [1, 0]
    passes(audit, 50, play={"Target velocity": np.stack([np.zeros(50), np.full(50, 90_000)], axis=1)})
    assert audit.seconds.tolist() == pytest.approx([0.15, 0.201]) and audit.moves.tolist() == [1, 1]
    assert DriveAudit.hides_machine and DriveAudit.objects == (POSITION, VELOCITY, CURRENT, STATUS)
