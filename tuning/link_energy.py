"""The energy that a motion feeds back into a drive's DC link, and how much the link takes until the drive trips.

A stop feeds back the kinetic energy. A weight that moves down feeds back during the whole motion, since the motor only
holds it: power -K_t i omega with i = holding + (J domega/dt) / K_t, less the losses of the winding. The holding current
is measured at the motor, so it contains the losses of the transmission. A supply may be unable to take the energy back.
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


LINK_SHARE = 0.8  # share of the link's energy that is used: the supply voltage may be higher than entered
SLOWER = 0.9  # factor by which speed and ramp of moves that would overcharge the link are reduced repeatedly


def link_energy(target: Target) -> Floats:
    """Return the energy that each DC link can take from its supply voltage to overvoltage [J], shape (num_axes,).

    Computed with the least capacitance of the device class. The axes of a drive share its link and may brake together.
    """
    device = target.device
    square = np.maximum(device.overvoltage**2 - target.supply**2, 1.0)
    return np.asarray(0.5 * device.stage["dc_capacitance"].low * square / device.num_axes)


def fed_back(
    motor: Motor, speed: Floats, step: float, inertia: ArrayLike, holding: ArrayLike, friction: ArrayLike = 0.0
) -> Floats:
    """Return the greatest energy that a motion has fed into the DC link at any time [J], shape (num_axes,).

    Energy that the motor draws later empties the link first. The direction of the weight is unknown: the worse counts.

    Args:
        motor: Motor of each axis.
        speed: Speed of the rotors [rad/s], shape (rows, num_axes).
        step: Time between rows [s].
        inertia: Total inertia [kg*m^2], shape (num_axes,) or one value for all.
        holding: Current that holds the axis [A], shape as `inertia`. The part of it caused by dry friction at rest also
            acts in motion, so `friction` must not contain it again.
        friction: Least current that dry friction takes in motion [A], shape as `inertia`.
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
    """Return the reach for which moves of trials must be planned so that they do not overcharge the DC link.

    Args:
        target: The drives.
        inertia: Total inertia [kg*m^2], shape (num_axes,) or one value for all.
        holding: Current that holds the axis [A], shape as `inertia`.
        reach: Signed angle that the rotors may turn [rad], shape (num_axes,).
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
    """Return the factor (at most 1) on speed and ramp at which moves do not overcharge the DC link, shape (num_axes,).

    Args:
        target: The drives.
        inertia: Total inertia [kg*m^2], shape (num_axes,) or one value for all.
        holding: Current that a weight takes [A], shape as `inertia`.
        friction: Least current that dry friction takes [A], shape as `inertia`.
        way: Length of the moves [rad], not negative, shape (num_axes,).
        speed: Profile speed [rad/s], shape (num_axes,).
        ramp: Profile acceleration [rad/s^2], shape (num_axes,).
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
    """Return which axes' moves would overcharge the DC link, shape (num_axes,); arguments as in `bearable_speed`."""
    way, speed, ramp = (np.maximum(row, 1e-9) for row in (way, speed, ramp))
    rise = np.minimum(speed / ramp, np.sqrt(way / ramp))
    end = rise + way / (ramp * rise)
    t = np.arange(1, int(np.ceil(end.max() / CYCLE)) + 1)[:, None] * CYCLE
    profile = ramp * np.clip(np.minimum(t, end - t), 0.0, rise)
    most = fed_back(target.motor, profile, CYCLE, inertia, holding, friction)
    return np.asarray(most > LINK_SHARE * link_energy(target))
