"""Moves as an engineer counts them: commanded motions from standstill to standstill, row by row."""

from __future__ import annotations

import numpy as np
import pytest

from tuning.move_counter import MoveCounter

REST = 20  # cycles of standstill that end a move

FAST, STRONG = 1_000_000.0, 5000.0  # pps, mA: what axes may be moved with; 0.2 % and 2 % of it is none yet
POSITION, SPEED, SPEED_OFFSET, TORQUE, WORD = (0x607A, 0), (0x60FF, 0), (0x60B1, 0), (0x6071, 0), (0x6040, 0)
ALL = np.array([True, True])
FIRST = np.array([True, False])


@pytest.fixture
def counter():
    return MoveCounter(np.full(2, FAST), STRONG)


def still(cycles, value=0):
    return np.full(cycles, value)


GO = still(5, 30_000)

PLAYED = [
    # object, rows, moves that they are
    (SPEED, still(100), 0),
    (SPEED, np.concatenate([GO, still(30)]), 1),
    (SPEED, np.concatenate([GO, -GO, GO, still(30)]), 1),  # there and back without a stop
    (SPEED, np.concatenate([GO, still(REST - 1), GO]), 1),  # a stop of 19 ms is none
    (SPEED, np.concatenate([GO, still(REST), GO]), 2),
    (SPEED, still(50, 1999), 0),  # slower than 0.2 %: a correction of the place
    (SPEED, still(50, 2001), 1),
    (SPEED_OFFSET, np.concatenate([GO, still(30), GO]), 2),
    (POSITION, still(100, 777_000), 0),  # a place is no motion
    (POSITION, np.concatenate([still(9), np.arange(20) * 50, still(40, 950), still(5, 0)]), 2),
    (POSITION, np.arange(100) // 2, 0),  # slower than 2 pps per cycle
    (TORQUE, np.concatenate([still(40, 0), still(3, 900), still(40, 0), still(3, -900)]), 2),
    (0x6060, still(40, 8), 0),
]  # fmt: skip


@pytest.mark.parametrize(("key", "rows", "moves"), PLAYED)
@pytest.mark.parametrize("pieces", [1, 4, None], ids=["in one record", "in four", "row by row"])
def test_what_is_played_is_counted_row_by_row(counter, key, rows, moves, pieces):
    for part in np.array_split(rows, pieces or len(rows)):
        counter.passed(len(part), {key: part})
    assert counter.moves.tolist() == [moves, moves]


def test_each_axis_has_its_own(counter):
    both = np.stack([np.concatenate([GO, still(45)]), still(50)], axis=1)
    assert counter.passed(50, {SPEED: both}).tolist() == [True, False]
    assert counter.moves.tolist() == [1, 0]


def test_a_set_point_is_a_rising_bit_4(counter):
    for word, moves in ((0x0F, 0), (0x1F, 1), (0x1F, 1), (0x0F, 1), (0x3F, 2)):
        counter.written(WORD, word, FIRST)
        counter.passed(1)
        assert counter.moves.tolist() == [moves, 0]


def test_a_speed_that_is_written_is_a_move_until_it_is_taken_back(counter):
    counter.written(SPEED, 30_000, FIRST)
    counter.passed(500)
    counter.written(SPEED, -60_000, FIRST)  # another speed: still under way
    counter.passed(500)
    counter.written(SPEED, 0, ALL)
    counter.passed(REST)
    assert counter.moves.tolist() == [1, 0]
    counter.written(SPEED, 30_000, FIRST)
    assert counter.moves.tolist() == [2, 0]


def test_what_holds_a_weight_moves_nothing(counter):
    counter.written(TORQUE, np.array([800, 0]), ALL)  # as it is taken over from csp: one step
    counter.passed(60)
    before = counter.moves.copy()
    held = np.concatenate([still(30, 800), still(4, 2000), still(30, 800)])
    counter.passed(64, {TORQUE: np.stack([held, held - 800], axis=1)})
    assert (counter.moves - before).tolist() == [1, 1]
    counter.passed(60)
    counter.passed(40, {TORQUE: np.tile([800, 0], (40, 1))})
    assert (counter.moves - before).tolist() == [1, 1]
