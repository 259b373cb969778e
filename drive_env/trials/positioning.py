"""The positioning move of trials: planned for a machine, started on drives, and evaluated.

Every profile takes 60 ms and every trial 250 ms, so that all axes have the same windows, whatever their load.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.devices import Device
from drive_env.dictionary.units import split_unit
from drive_env.drives import motion
from drive_env.drives.interface import CYCLE, Drives
from drive_env.drives.speeds import per_increment
from drive_env.motors import Motor
from mechanics.arrays import Floats, Integers, Mask

if TYPE_CHECKING:
    from mechanics.load import Load


# In communication cycles: the profile, the end of the window in which it settles, and the trial.
PROFILE, SETTLED, TRIAL = 60, 150, 250
QUIET = (PROFILE + SETTLED) // 2  # first cycle of the window for the ripple
WINDOW = 100  # cycles of a trend
COUNTED_RAMP = "pps^2"  # unit of ramps in increments per second squared
WATCH = 25  # cycles between two checks of the current in a trial
ACCELERATION_SHARE = 0.4  # of the rated torque
SPEED_SHARE, TRAVEL_SHARE = 0.5, 0.4  # of the rated speed at the profile's peak, of the room
ABOUT_AS_LONG = 0.9  # of the room backwards: with at least this much room forwards, the move goes forwards
BAND, BAND_COUNTS = 0.01, 3.0  # of the move, and of the encoder: the larger one is the settling band


class Move(NamedTuple):
    """A positioning move: 607Ah from rest at 0, its speed and ramp, and its scales, each of shape (num_axes,).

    share: Run current during the move over the rated one, for a stepper that is to be overloaded.
    """

    distance: Integers  # inc, with its sign
    velocity: Integers  # pps
    acceleration: Integers  # pps^2
    increments: Floats  # per radian
    counts: float  # of the encoder per radian
    share: Floats | float = 1.0

    @property
    def least_error(self) -> float:
        """Integral of |error| in a load step at an error of half a count: the least that can be seen [rad s]."""
        return 0.5 / self.counts * (TRIAL - SETTLED) * CYCLE


def highest_ramp(device: Device) -> float:
    """Return the greatest acceleration that a drive accepts by its dictionary [inc/s^2]; inf if it counts in rpm.

    Controllers of steppers have 16-bit registers for it; others accept more than any motor can do.
    """
    key = (cia402.PROFILE_ACCELERATION, 0)
    number, base = split_unit(device.bindings[key].unit)
    high = device.new_dictionary().find(key).high
    return math.inf if base != COUNTED_RAMP or high is None else high * number


def plan_move(
    motor: Motor,
    inertia: ArrayLike,
    scaler: ArrayLike,
    reach: ArrayLike,
    highest: float = math.inf,
    share: ArrayLike = ACCELERATION_SHARE,
) -> Move:
    """Plan a triangular move of 60 ms with 0.4 of the rated torque, or less if speed or travel limit it.

    Args:
        motor: The motor.
        inertia: Total inertia at the rotor [kg*m^2], shape (num_axes,).
        scaler: 2058h, increments per revolution.
        reach: Signed angle that the rotor may turn [rad].
        highest: Greatest acceleration that the drive accepts [inc/s^2], see `highest_ramp`.
        share: Share of the rated torque that accelerates, (num_axes,) or one for all.
    """
    J, to = np.asarray(inertia, float), np.asarray(reach, float)
    time = PROFILE * CYCLE
    angle = np.asarray(share, float) * motor.rated_torque / J * time**2 / 4.0
    angle = np.minimum(angle, SPEED_SHARE * motor.rated_speed * time / 2.0)
    increments = np.broadcast_to(np.asarray(scaler, float), angle.shape) / (2.0 * math.pi)
    angle = np.minimum(angle, (highest * time**2 / 4.0 - 1.0) / increments)
    angle = np.copysign(np.minimum(angle, TRAVEL_SHARE * np.abs(to)), to)
    distance = np.rint(angle * increments).astype(np.int64)
    # Rounded up, so that the profile ends in time.
    acceleration = np.ceil(np.maximum(4.0 * np.abs(distance) / time**2, 1.0)).astype(np.int64)
    velocity = np.ceil(2.0 * np.maximum(np.abs(distance), 1) / time).astype(np.int64) + 1
    return Move(distance, velocity, acceleration, increments, motor.encoder_counts / (2.0 * math.pi))


def longer_way(low: ArrayLike, high: ArrayLike) -> Floats:
    """Return the signed angle that rotors may turn to the side with more room [rad]; forwards if both are similar.

    So axes of a machine near the middle of their travel always move in the same direction: the load of a joint depends
    on the directions of the others in its arm.

    Args:
        low: Signed angle that they may turn backwards, at most 0.
        high: Signed angle that they may turn forwards.
    """
    down, up = np.asarray(low, float), np.asarray(high, float)
    return np.where(up >= ABOUT_AS_LONG * -down, up, down)


def reach(load: str | Path | Load) -> Floats:
    """Return the signed angle that each rotor of a load may turn from the start, to the side with more room [rad]."""
    from mechanics.loads import find_load
    from mechanics.shaft import one, way

    found = way(one(find_load(load)))
    return longer_way(found.low, found.high)


def power_up(drives: Drives, where: Mask | None = None) -> None:
    """Enable switched-off drives in pp, in a fixed number of milliseconds."""
    motion.select_mode(drives, "pp", where)
    for word in cia402.ENABLING:
        drives.advance(CYCLE)
        drives.write(cia402.CONTROLWORD, word, where=where)
    drives.advance(2 * CYCLE)


def write_profile(drives: Drives, move: Move, where: Mask | None = None) -> None:
    """Write the speed and the ramps of a move."""
    for name, value in (
        (cia402.PROFILE_VELOCITY, move.velocity),
        (cia402.PROFILE_ACCELERATION, move.acceleration),
        (cia402.PROFILE_DECELERATION, move.acceleration),
    ):
        # Rounded up for drives that count in rpm, so that the profile ends in time.
        drives.write(name, np.ceil(value * per_increment(drives, name)).astype(np.int64), where=where)


def start(drives: Drives, target: Integers, where: Mask | None = None) -> None:
    """Start a move to a position [inc]; an axis that is not enabled does not move."""
    drives.write(cia402.TARGET_POSITION, target, where=where)
    drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION, where=where)  # bit 4 must rise
    drives.write(cia402.CONTROLWORD, cia402.ENABLE_OPERATION | cia402.NEW_SET_POINT, where=where)


def move_terms(
    position: Floats,
    current: Floats,
    move: Move,
    t_0: ArrayLike,
    rated_current: float,
    target: Integers,
    sign: Integers,
) -> tuple[Floats, Floats, Floats]:
    """Return t_s/t_0, n and os of a move, each of shape (num_axes,).

    Args:
        position: 6064h from the set-point on, one row per ms, shape (SETTLED or more, num_axes).
        current: Demanded current [A], same shape.
        move: The move.
        t_0: Four times the sum of the small time constants [s].
        rated_current: Rated current of the motor, peak i_q [A].
        target: Target [inc], shape (num_axes,).
        sign: Direction, 1 or -1.
    """
    size = np.maximum(np.abs(move.distance), 1).astype(float)
    width = np.maximum(BAND * size, BAND_COUNTS / move.counts * move.increments)
    error = wrapped(target - position[:SETTLED])
    settling = 1.0 + np.minimum(1.0, np.abs(error[PROFILE:]) / width).sum(axis=0) * CYCLE / np.asarray(t_0)
    ripple = np.sqrt(np.mean(np.diff(current[QUIET:SETTLED], axis=0) ** 2, axis=0)) / rated_current
    beyond = np.maximum((-error * sign).max(axis=0), 0.0) / size
    return settling, ripple, beyond


def swing(current: Floats, rated_current: float) -> Floats:
    """Return the largest RMS increment of the current from ms to ms in any 25 ms, over the rated one, (num_axes,).

    Args:
        current: Current of a move from its start [A], (cycles, num_axes) with a whole number of 25 ms.
        rated_current: Rated current of the motor, peak i_q [A].
    """
    windows = current.reshape(-1, WATCH, current.shape[1])
    return np.asarray(np.sqrt(np.mean(np.diff(windows, axis=1) ** 2, axis=1)).max(axis=0) / rated_current)


def resting_swing(current: Floats, rated_current: float) -> Floats:
    """Return the RMS of the current about its trend at the end of a move, over the rated one, (num_axes,).

    The trend is a straight line in each tenth of a second, so that a slow approach to the target, as of coupled axes
    that work against each other, does not count, nor an integrator that slowly brings the axis to the next count.

    Args:
        current: Current of a move from its start, before any load step [A], (SETTLED cycles or more, num_axes).
        rated_current: Rated current of the motor, peak i_q [A].
    """
    late = current[QUIET:]
    parts = np.array_split(late, max(round(len(late) / WINDOW), 1))
    return np.asarray(np.concatenate([_without_trend(part) for part in parts]).std(axis=0) / rated_current)


def _without_trend(values: Floats) -> Floats:
    time = np.arange(len(values)) - (len(values) - 1) / 2.0
    apart = values - values.mean(axis=0)
    return np.asarray(apart - np.outer(time, time @ apart) / (time @ time))


def wrapped(increments: Floats | Integers) -> Floats:
    """Return differences of positions without the wrap of their counter at 2^31."""
    return (np.asarray(increments, float) + 2.0**31) % 2.0**32 - 2.0**31
