"""Inertia of an open-loop stepper by the free swing of its rotor in the field, after a quarter of a full step.

A ramp of a light load turns the rotor by less in its field than detent torque and friction do, and says nothing of the
inertia. The free swing does: T_hold is the data sheet's at the current that flows, and

    J d2x/dt2 = T_hold sin(n_p (d - x)) - c dx/dt - T_c sign(dx/dt),   f = sqrt(n_p T_hold / J) / 2 pi for small swings

with d the field and x the rotor. Detent torque adds 4 n_p T_d cos(4 n_p x) to the stiffness: the swing is measured in
two places half a full step apart, where that has opposite signs, and the mean of both stiffnesses is without it,
wherever the full steps are. Frequency and dry friction are those whose swing, from the demand that was recorded, is
nearest to the encoder's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drive_env.motors import Motor
from mechanics.arrays import Floats

LENGTH = 100  # samples of a swing, one per ms
SUBSTEPS = 10  # of the integration, in a ms
SPACING = 1.03  # from one frequency of the grid to the next
LEAST_INERTIA, MOST_INERTIA = 0.8, 300.0  # rotors, as `momentum_balance` has them
STIFFNESS = 2.0  # by how much detent torque raises or lowers the stiffness at most
FRICTION = (0.01, 0.02, 0.04, 0.07, 0.12)  # of the holding torque
START = (-1.0, 0.0, 1.0)  # where dry friction had left the rotor before, of how far it can hold it from the field
_PAIRS = np.array([(friction, start) for friction in FRICTION for start in START]).T
EXPLAINED = 0.85  # of the variance of a swing, that its fit must explain


class FreeSwing(NamedTuple):
    """Results of free swings, (num_axes,) each: the inertia [kg m^2], and the least share of variance explained."""

    inertia: Floats
    explained: Floats


def inertia_of_swings(demand: Floats, position: Floats, held: Floats, age: float, motor: Motor) -> FreeSwing:
    """Return the inertia that swings in two places half a full step apart say.

    Args:
        demand: Of the rotor [rad], from the set-point on, a row per ms, (places, samples, num_axes).
        position: The encoder's, as long.
        held: Holding torque at the current that flows [N m], (num_axes,).
        age: How old an encoder's count is [s].
        motor: The motor.
    """
    fits = [_fit(motor, d, x, held, age) for d, x in zip(demand, position, strict=True)]
    square = np.mean([omega**2 for omega, _ in fits], axis=0)
    explained = np.min([share for _, share in fits], axis=0)
    return FreeSwing(motor.n_p * held / square, explained)


def _fit(motor: Motor, demand: Floats, position: Floats, held: Floats, age: float) -> tuple[Floats, Floats]:
    """Return the angular frequency of small swings [rad/s], and the share of the variance that it explains."""
    axes = demand.shape[1]
    stiff = motor.n_p * float(np.mean(held)) / motor.inertia
    low, high = np.sqrt(stiff / MOST_INERTIA / STIFFNESS), np.sqrt(stiff / LEAST_INERTIA * STIFFNESS)
    grid = np.exp(np.arange(np.log(low), np.log(high), np.log(SPACING)))
    field = motor.n_p * (demand - demand[0])
    seen = motor.n_p * (position - position[0])
    errors = np.stack([_errors(motor, grid, field[:, k], seen[:, k], held[k], age) for k in range(axes)])
    least = np.min(errors, axis=2)  # over frictions and starts
    best = np.clip(least.argmin(axis=1), 1, len(grid) - 2)
    each = np.arange(axes)
    before, here, after = (least[each, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    shift = np.where(bend > 0.0, np.clip(0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), -0.5, 0.5), 0.0)
    whole = np.maximum(seen.var(axis=0), 1e-12)
    return grid[best] * SPACING**shift, 1.0 - here / whole


def _errors(motor: Motor, omega: Floats, field: Floats, seen: Floats, held: float, age: float) -> Floats:
    """Return the variance of the difference between swings of frequencies and the samples, (omega, _PAIRS)."""
    dt = 0.001 / SUBSTEPS
    square = omega[:, None] ** 2
    drag = motor.viscous * square / (motor.n_p * held)
    share_held, start = _PAIRS
    friction = square * share_held
    angle = np.tile(start * share_held, (len(omega), 1))
    speed = np.zeros_like(angle)
    late = round(age / dt)
    total, total_square = np.zeros((2, *angle.shape))
    for n in range(1, len(field)):
        for k in range(1, SUBSTEPS + 1):
            share = k / SUBSTEPS
            at = (1.0 - share) * field[n - 1] + share * field[n]
            speed = speed + dt * (square * np.sin(at - angle) - drag * speed)
            speed -= np.clip(speed, -dt * friction, dt * friction)
            angle = angle + dt * speed
            if k == SUBSTEPS - late:
                difference = angle - seen[n]
        total += difference
        total_square += difference**2
    count = len(field) - 1
    return np.asarray(total_square / count - (total / count) ** 2)
