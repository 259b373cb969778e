"""Motion programmes, drawn per environment: smooth moves from point to point, or a sine, within an axis' limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Integers, Mask

EXCITATIONS = ("moves", "sine")
# Of a minimum-jerk move, 10 s^3 - 15 s^4 + 6 s^5: peaks of speed and acceleration per distance.
_PEAK_SPEED, _PEAK_ACCELERATION = 1.875, 5.7735
_SHORTEST = 0.05  # s, of a move
_LONGEST_PAUSE = 0.15  # s between two moves
_PACE = (0.5, 1.0)  # share of the axis' capability at which a move is driven


class Reach(NamedTuple):
    """Limits of a programme for each axis of a machine, shape (axes,): [rad], [rad/s], [rad/s^2] at the rotor."""

    distance: Floats
    speed: Floats
    acceleration: Floats


class Programme(Saved):
    """A programme for each environment: all axes of an environment move in unison, from rest at the start.

    Args:
        num_envs: Number of environments.
        cycles: Length [cycles].
        preview: Further known cycles after it.
        cycle: Communication cycle [s].
    """

    STATE = ("_table",)

    def __init__(self, num_envs: int, cycles: int, preview: int, cycle: float) -> None:
        self._cycle = cycle
        # Position, speed and acceleration of every environment as shares of the axes' distance [1, 1/s, 1/s^2].
        self._table = np.zeros((3, num_envs, cycles + preview + 1))

    def draw(self, excitation: str, reach: Reach, rngs: Sequence[np.random.Generator], where: Mask) -> None:
        """Draw new programmes for the environments where the mask is true."""
        t = np.arange(self._table.shape[2], dtype=np.float64) * self._cycle
        kind = {"moves": _moves, "sine": _sine}[excitation]
        for lane in map(int, np.flatnonzero(where)):
            self._table[:, lane] = kind(t, reach, rngs[lane])

    def rows(self, start: Integers, cycles: Integers, reach: Reach) -> tuple[Floats, Floats, Floats]:
        """Return position [rad], velocity [rad/s] and acceleration [rad/s^2], each (cycles, num_envs * axes).

        Args:
            start: The environments' present cycle, shape (num_envs,).
            cycles: Cycles from there on, shape (n,).
            reach: The axes' limits.
        """
        last = self._table.shape[2] - 1
        at = np.minimum(start[None, :] + cycles[:, None], last)
        shares = self._table[:, np.arange(len(start))[None, :], at]
        position, velocity, acceleration = (shares[..., None] * reach.distance).reshape(3, len(cycles), -1)
        return position, velocity, acceleration


def _quickest(distance: float, reach: Reach) -> float:
    """Return the shortest time of a move over a share of the axes' distance [s]."""
    way = distance * reach.distance
    by_speed = _PEAK_SPEED * way / reach.speed
    by_acceleration = np.sqrt(_PEAK_ACCELERATION * way / reach.acceleration)
    return float(max(np.max(by_speed), np.max(by_acceleration), _SHORTEST))


def _moves(t: Floats, reach: Reach, rng: np.random.Generator) -> Floats:
    found = np.zeros((3, len(t)))
    place, now = 0.0, float(rng.uniform(0.0, 0.05))
    while now < t[-1]:
        target, pace, pause = rng.uniform(-1.0, 1.0), rng.uniform(*_PACE), rng.uniform(0.0, _LONGEST_PAUSE)
        way, duration = target - place, _quickest(abs(target - place), reach) / pace
        first, last = np.searchsorted(t, (now, now + duration))
        last += 1
        s = np.clip((t[first:last] - now) / duration, 0.0, 1.0)
        found[0, first:last] += way * (s * s * s) * (10.0 - 15.0 * s + 6.0 * s**2)
        found[1, first:last] += way / duration * 30.0 * s**2 * (1.0 - s) ** 2
        found[2, first:last] += way / duration**2 * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
        found[0, last:] += way
        place, now = target, now + duration + pause
    return found


def _sine(t: Floats, reach: Reach, rng: np.random.Generator) -> Floats:
    """Return 1/2 (1 - cos): from rest, and back to the start with every period."""
    size, pace = rng.uniform(0.1, 1.0) * rng.choice((-1.0, 1.0)), rng.uniform(*_PACE)
    way = 0.5 * abs(size) * reach.distance
    w = pace * float(np.min(np.minimum(reach.speed / way, np.sqrt(reach.acceleration / way))))
    return np.stack(
        [0.5 * size * (1.0 - np.cos(w * t)), 0.5 * size * w * np.sin(w * t), 0.5 * size * w * w * np.cos(w * t)]
    )
