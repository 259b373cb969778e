"""Counts the moves of an axis as an observer of the machine would.

A move is a commanded motion from standstill to standstill. In pp each set-point is one (bit 4 of the controlword
rises).
In the other modes it begins when a target starts to change and ends when the target has rested for 20 ms: there and
back
without a stop is one move, and so is a frequency response, however many records it takes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats, Integers, Mask

REST = 20  # cycles at rest that end a move
SLOW, WEAK = 0.002, 0.02  # as a share of greatest speed and current: smaller commands only hold the position
CONTROLWORD, SET_POINT = (cia402.CONTROLWORD, 0), 0x10
POSITIONS, SPEEDS, TORQUES = (
    ((cia402.TARGET_POSITION, 0), (cia402.POSITION_OFFSET, 0)),
    ((cia402.TARGET_VELOCITY, 0), (cia402.VELOCITY_OFFSET, 0)),
    ((cia402.TARGET_TORQUE, 0), (cia402.TORQUE_OFFSET, 0)),
)


class MoveCounter:
    """Counts moves from written objects and played rows.

    Args:
        speed: Greatest speed of the axes [inc/s], shape (num_axes,).
        current: Greatest torque that may be commanded [counts].
        per_increment: Counts of a velocity per increment per second.

    Attributes:
        moves: Number of moves of each axis so far, shape (num_axes,).
    """

    def __init__(self, speed: Floats, current: Floats | float, per_increment: Floats | float = 1.0) -> None:
        count = len(speed)
        self.moves = np.zeros(count, np.int64)
        self._slow: dict[Key, Floats] = {
            **dict.fromkeys(POSITIONS, SLOW * speed * CYCLE),
            **dict.fromkeys(SPEEDS, SLOW * speed * per_increment),
            **dict.fromkeys(TORQUES, np.full(count, WEAK * current)),
        }
        self._word = np.zeros(count, np.int64)
        self._standing: dict[Key, Integers] = {}  # last commanded value of each target
        self._running = {key: np.zeros(count, bool) for key in SPEEDS}  # axes whose commanded speed is not 0
        self._played: frozenset[Key] = frozenset()  # targets played in the last passed time
        self._still = np.full(count, REST)  # cycles since the target last moved

    def written(self, key: Key, value: ArrayLike, where: Mask) -> None:
        """Count moves started by an object written on the axes where the mask is true."""
        values = np.broadcast_to(np.asarray(value, np.int64), self.moves.shape)
        if key == CONTROLWORD:
            self.moves += where & (values & SET_POINT != 0) & (self._word & SET_POINT == 0)
            self._word = np.where(where, values, self._word)
        elif key in self._slow:
            before = self._standing.get(key, np.zeros_like(values))
            if key in SPEEDS:
                runs = np.abs(values) > self._slow[key]
                self._begin(where & runs & ~self._moving())
                self._running[key] = np.where(where, runs, self._running[key])
            elif key in TORQUES:
                self._begin(where & (np.abs(values - before) > self._slow[key]))
            self._standing[key] = np.where(where, values, before)

    def passed(self, cycles: int, play: Mapping[Key, ArrayLike] | None = None) -> Mask:
        """Count moves in passed time with played rows of objects; return the axes that they move, shape (num_axes,)."""
        count = len(self.moves)
        moving = np.zeros((cycles, count), bool)
        played = {key: rows for key, rows in (play or {}).items() if key in self._slow}
        for key, rows in played.items():
            values = np.asarray(rows, np.int64)
            values = np.broadcast_to(values if values.ndim == 2 else values[:, None], (cycles, count))
            before = self._standing.get(key, values[0])
            if key in SPEEDS:
                away = values
                self._running[key] = np.abs(values[-1]) > self._slow[key]
            elif key in TORQUES:  # a constant torque, for example against gravity, does not move the axis
                away = values - before
            else:  # the first row can only be compared with a row before it if one was played
                away = np.diff(values, axis=0, prepend=(before if key in self._played else values[0])[None])
            moving |= np.abs(away) > self._slow[key]
            self._standing[key] = values[-1]
        self._played = frozenset(played)
        driven = np.asarray(moving.any(axis=0))
        # A commanded speed stays in effect until another is written.
        for key, runs in self._running.items():
            if key not in played:
                moving |= runs
        for axis in range(count):
            at = np.flatnonzero(moving[:, axis])
            if at.size == 0:
                self._still[axis] += cycles
                continue
            rests = np.diff(at, prepend=-1) - 1  # cycles at rest before each
            rests[0] += self._still[axis]
            self.moves[axis] += np.count_nonzero(rests >= REST)
            self._still[axis] = cycles - 1 - at[-1]
        return driven

    def _moving(self) -> Mask:
        return np.asarray(np.any([*self._running.values()], axis=0))

    def _begin(self, axes: Mask) -> None:
        """Count a move of each axis whose target was written after a rest."""
        self.moves += axes & (self._still >= REST)
        self._still = np.where(axes, 0, self._still)
