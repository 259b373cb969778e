"""The energy that a motion feeds back into a drive's DC link, and the link's capacity until the drive cuts its stage.

A stop feeds back the kinetic energy. A weight that goes down feeds back as long as it goes, through a motor that
merely holds it: power -K_t i omega with i = holding + (J domega/dt) / K_t, less what the winding loses. The current
that holds the axis is measured at the motor, and what the transmission loses is in it. A supply may not take it back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.roles import Role
from drive_env.drives.interface import CYCLE
from drive_env.trials.positioning import PROFILE, TRAVEL_SHARE, highest_ramp, plan_move
from mechanics.arrays import Floats, Mask

if TYPE_CHECKING:
    from drive_env.motors import Motor
    from tuning.target import Target


LINK_SHARE = 0.8  # of what the link holds, that is filled: the supply may be higher than what was entered
SLOWER = 0.9  # by which positioning moves are made slower in turn that would overcharge the link


def link_energy(target: Target) -> Floats:
    """Return the energy that each DC link holds above its supply until the stage is cut [J], shape (num_axes,).

    By the least capacitance of the drive's class. The axes of a drive share its link, and may brake at one time.
    """
    device = target.device
    square = np.maximum(device.overvoltage**2 - target.supply**2, 1.0)
    return np.asarray(0.5 * device.stage["dc_capacitance"].low * square / device.num_axes)


def fed_back(
    motor: Motor, speed: Floats, step: float, inertia: ArrayLike, holding: ArrayLike, friction: ArrayLike = 0.0
) -> Floats:
    """Return the most energy that a motion has fed into the DC link at any moment [J], shape (num_axes,).

    What the motor draws afterwards empties the link first. The weight may pull either way: the worse one counts.

    Args:
        motor: What turns each axis.
        speed: Of the rotors [rad/s], shape (rows, num_axes).
        step: From row to row [s].
        inertia: Total inertia [kg*m^2], (num_axes,) or one for all.
        holding: Current that holds the axis [A], alike. What dry friction has in it at rest, it has in motion, too:
            such a one needs no other friction.
        friction: Current that dry friction takes in motion for sure [A], alike.
    """
    K = motor.torque_constant
    before = np.concatenate([np.zeros((1, speed.shape[1])), speed])
    after = np.concatenate([speed, np.zeros((1, speed.shape[1]))])
    mean, accelerating = 0.5 * (before + after), (after - before) / step * np.asarray(inertia, float) / K
    most = np.zeros(speed.shape[1])
    for weight in (np.asarray(holding, float), -np.asarray(holding, float)):
        current = accelerating + weight + np.sign(mean) * np.asarray(friction, float)
        energy = -step * np.cumsum(K * current * mean + motor.copper_resistance * current**2, axis=0)
        emptied = np.minimum(np.minimum.accumulate(energy, axis=0), 0.0)
        most = np.maximum(most, (energy - emptied).max(axis=0))
    return most


def trial_reach(target: Target, inertia: ArrayLike, holding: ArrayLike, reach: Floats) -> Floats:
    """Return the reach for which the moves of trials are planned so that they do not overcharge the DC link.

    Args:
        target: The drives.
        inertia: Total inertia [kg*m^2], (num_axes,) or one for all.
        holding: Current that holds the axis [A], alike.
        reach: How far the rotors may turn, with the sign [rad], (num_axes,).
    """
    T, scale = PROFILE * CYCLE, target.drives.read(Role.POSITION_SCALE)
    move = plan_move(target.motor, np.broadcast_to(inertia, reach.shape), scale, reach, highest_ramp(target.device))
    planned = way = np.abs(move.distance) / move.increments
    while (over := _overcharges(target, inertia, holding, 0.0, way, 2.0 * way / T, 4.0 * way / T**2)).any():
        way = np.where(over, SLOWER * way, way)
    return np.where(way < planned, np.copysign(way / TRAVEL_SHARE, reach), reach)


def bearable_speed(
    target: Target,
    inertia: ArrayLike,
    holding: ArrayLike,
    friction: ArrayLike,
    way: Floats,
    speed: Floats,
    ramp: Floats,
) -> Floats:
    """Return the share of speed and ramp, 1 at most, with which moves do not overcharge the DC link, (num_axes,).

    Args:
        target: The drives.
        inertia: Total inertia [kg*m^2], (num_axes,) or one for all.
        holding: Current that a weight takes [A], alike.
        friction: Current that dry friction takes at least [A], alike.
        way: Of the moves, without their sign [rad], (num_axes,).
        speed: Of the profile [rad/s], alike.
        ramp: Of the profile [rad/s^2], alike.
    """
    share = np.ones(target.num_axes)
    while (over := _overcharges(target, inertia, holding, friction, way, share * speed, share * ramp)).any():
        share = np.where(over, SLOWER * share, share)
    return share


def _overcharges(
    target: Target,
    inertia: ArrayLike,
    holding: ArrayLike,
    friction: ArrayLike,
    way: Floats,
    speed: Floats,
    ramp: Floats,
) -> Mask:
    """Return which axes' moves would overcharge the DC link, (num_axes,); arguments as `bearable_speed` has them."""
    way, speed, ramp = (np.maximum(row, 1e-9) for row in (way, speed, ramp))
    rise = np.minimum(speed / ramp, np.sqrt(way / ramp))
    end = rise + way / (ramp * rise)
    t = np.arange(1, int(np.ceil(end.max() / CYCLE)) + 1)[:, None] * CYCLE
    profile = ramp * np.clip(np.minimum(t, end - t), 0.0, rise)
    most = fed_back(target.motor, profile, CYCLE, inertia, holding, friction)
    return np.asarray(most > LINK_SHARE * link_energy(target))
