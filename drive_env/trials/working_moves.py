"""Moves at the working speed in both directions, with load reading and load angle of their steady parts.

Load readings are read by SDO, some milliseconds apart, since stepper drives cannot map them to process data. The
duration of a read in real time is unknown, so the demand shows where an axis is in its profile. An axis that loses
steps is stopped at the next sample, and takes no further part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE, Drives
from drive_env.motors import Motor
from drive_env.trials.open_loop import LOST, TOOTH, OpenLoopTrials
from drive_env.trials.positioning import Move, wrapped, write_profile
from mechanics.arrays import Floats, Integers, Mask

SAMPLE = 4 * CYCLE  # s between two samples
SETTLE = 0.06  # s after the ramp, until the rotor's swing has decayed
STEADY, LEAST_STEADY = 0.3, 0.06  # s at constant speed: wanted, and least
LEAST_STEPS = 20.0  # full steps at constant speed
REST = 0.1  # s at the end of a move
LATE = 0.02  # s, greatest delay of a load reading by SDO after its sample in real time


class Steady(NamedTuple):
    """The steady parts of moves in both directions, each of shape (num_axes,); nan without samples.

    reading, lowest, spread: Mean, lowest value and standard deviation of the load reading.
    angle, settled: Mean load angle against the motion, electrical [rad], and that of the last quarter.
    lost: Steps were lost.
    stopped: The drive went into fault.
    """

    reading: Floats
    lowest: Floats
    spread: Floats
    angle: Floats
    settled: Floats
    lost: Mask
    stopped: Mask

    @property
    def failed(self) -> Mask:
        """Axes that did not complete the moves."""
        return self.lost | self.stopped


@dataclass
class WorkingMoves:
    """Moves axes between where they began and a place in their travel.

    Attributes:
        drives: The drives, enabled by trials.
        motor: Motor of every axis.
        trials: Compensates for lost steps.
        origin: First positions of the axes [inc].
        reach: Signed angle that they may turn [rad].
        acceleration: Of the ramps [rad/s^2].
        increments: Increments per radian.
        age: Age of an encoder's count when it is read [s].
    """

    drives: Drives
    motor: Motor
    trials: OpenLoopTrials
    origin: Integers
    reach: Floats
    acceleration: Floats
    increments: Floats
    age: float

    def steady_time(self, speed: float) -> Floats:
        """Return how long the axes can move at a speed within their reach [s], (num_axes,)."""
        ramps = speed**2 / self.acceleration + speed * SETTLE
        return np.asarray(np.minimum((np.abs(self.reach) - ramps) / speed, STEADY))

    def least_reach(self, speed: float) -> Floats:
        """Return the angle that the axes need to measure at a speed [rad]."""
        steady = max(LEAST_STEADY, LEAST_STEPS * 2.0 * math.pi / (TOOTH * self.motor.n_p) / speed)
        return np.asarray(speed**2 / self.acceleration + speed * (SETTLE + steady))

    def run(
        self,
        speed: float,
        where: Mask,
        look: Callable[[int, float], None] | None = None,
        *,
        until_stopped: bool = False,
    ) -> Steady:
        """Move in both directions at a speed [rad/s].

        Args:
            speed: The speed.
            where: Axes that move.
            look: Called at each sample with 0 on the way out or 1 on the way back, and the time since its beginning
                [s].
            until_stopped: End the move when no axis moves any more.
        """
        count = len(where)
        steady = np.maximum(self.steady_time(speed), LEAST_STEADY)
        way = np.copysign(speed * (steady + SETTLE) + speed**2 / self.acceleration, self.reach)
        distance = np.rint(way * self.increments).astype(np.int64)
        move = Move(
            distance,
            np.ceil(speed * self.increments).astype(np.int64),
            np.ceil(self.acceleration * self.increments).astype(np.int64),
            self.increments,
            1.0,
        )
        write_profile(self.drives, move, where)
        full_step = 2.0 * np.pi * self.increments / (TOOTH * self.motor.n_p)
        lost, stopped = np.zeros((2, count), bool)
        readings: list[Floats] = []
        angles: list[Floats] = []
        ramp = speed / self.acceleration
        for leg, target in enumerate((self.origin + distance, self.origin)):
            shift = self.trials.shift()
            begun = self.drives.read(cia402.POSITION_DEMAND)
            self.trials.go(target, where & ~lost & ~stopped)
            end = 2.0 * float(ramp.max()) + SETTLE + float(steady.max()) + REST
            for k in range(1, math.ceil(end / SAMPLE) + 1):
                demand, actual = self._sample()
                t = k * SAMPLE
                lag = wrapped(demand - actual - shift)
                enabled = cia402.matches(self.drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
                stopped |= where & ~enabled
                # An axis that was stopped by its drive is behind its demand without having lost steps.
                out = where & ~lost & ~stopped & (np.abs(lag) > LOST * full_step)
                if out.any():
                    self.drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.HALT, where=out)
                lost |= out
                if look is not None:
                    look(leg, t)
                if until_stopped and not np.any(where & ~stopped):
                    break
                at, late = (t, 0.0) if self.drives.time_waits else (self._time(demand - begun, speed, ramp), LATE)
                is_steady = where & ~lost & ~stopped & (at > ramp + SETTLE) & (at < ramp + SETTLE + steady - late)
                if is_steady.any():
                    reading = np.asarray(self.drives.read(Role.LOAD_VALUE), float)
                    readings.append(np.where(is_steady, reading, np.nan))
                    along = np.sign(target - self.origin - (distance if leg else 0)) * lag / self.increments
                    angle = (along - speed * self.age) * self.motor.n_p
                    angles.append(np.where(is_steady, angle, np.nan))
        return _steady(readings, angles, lost, stopped)

    def _sample(self) -> tuple[Integers, Integers]:
        """Let time pass, and return demand and encoder at the same time [inc], (num_axes,)."""
        if self.drives.time_waits:
            self.drives.advance(SAMPLE)
            return self.drives.read(cia402.POSITION_DEMAND), self.drives.read(cia402.POSITION_ACTUAL)
        trace = self.drives.record([cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL], SAMPLE)
        return trace[cia402.POSITION_DEMAND][-1], trace[cia402.POSITION_ACTUAL][-1]

    def _time(self, gone: Integers, speed: float, ramp: Floats) -> Floats:
        """Return the time [s] at which a profile's demand has covered a way [inc]; its ramps take `ramp` [s]."""
        way = np.abs(wrapped(gone)) / self.increments
        return np.asarray(np.where(way < 0.5 * speed * ramp, 0.0, way / speed + 0.5 * ramp))


def _steady(readings: list[Floats], angles: list[Floats], lost: Mask, stopped: Mask) -> Steady:
    seen, angle = np.array(readings).reshape(-1, len(lost)), np.array(angles).reshape(-1, len(lost))
    mean, lowest, spread, lag, settled = np.full((5, len(lost)), np.nan)
    for k in range(len(lost)):
        own = seen[~np.isnan(seen[:, k]), k]
        if own.size:
            mean[k], lowest[k], spread[k] = own.mean(), own.min(), own.std()
            sizes = angle[~np.isnan(angle[:, k]), k]
            lag[k], settled[k] = sizes.mean(), sizes[-max(own.size // 4, 1) :].mean()
    return Steady(mean, lowest, spread, lag, settled, lost, stopped)
