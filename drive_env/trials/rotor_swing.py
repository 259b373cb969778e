"""Inertia of an open-loop stepper from the free swing of its rotor in the field, after a quarter of a full step.

A ramp of a light load turns the rotor by less in its field than detent torque and friction do, and does not show the
inertia. The free swing does: with the data sheet's T_hold at the present current,

    J d2x/dt2 = T_hold sin(n_p (d - x)) - c dx/dt - T_c sign(dx/dt),   f = sqrt(n_p T_hold / J) / 2 pi for small swings

with the field's angle d and the rotor's x. Detent torque adds 4 n_p T_d cos(4 n_p x) to the stiffness: the swing is
measured at two positions half a full step apart, where this term has opposite signs, and cancels in the mean of both
stiffnesses, independent of the positions of the full steps. Frequency and dry friction are fitted: the swing simulated
from the recorded demand must match the encoder's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drive_env.motors import Motor
from mechanics.arrays import Floats

LENGTH = 100  # samples of a swing, one per ms
SUBSTEPS = 10  # of the integration per ms
SPACING = 1.03  # ratio of neighbouring frequencies of the grid
LEAST_INERTIA, MOST_INERTIA = 0.8, 300.0  # rotors, as in `momentum_balance`
STIFFNESS = 2.0  # greatest factor by which detent torque changes the stiffness
FRICTION = (0.01, 0.02, 0.04, 0.07, 0.12)  # dry friction over the holding torque
START = (-1.0, 0.0, 1.0)  # initial angle of the rotor over the largest at which dry friction can hold it
_PAIRS = np.array([(friction, start) for friction in FRICTION for start in START]).T
EXPLAINED = 0.85  # least share of a swing's variance that a valid fit explains


class FreeSwing(NamedTuple):
    """The results of free swings, (num_axes,) each: the inertia [kg m^2], and the least share of variance explained."""

    inertia: Floats
    explained: Floats


def inertia_of_swings(demand: Floats, position: Floats, held: Floats, age: float, motor: Motor) -> FreeSwing:
    """Return the inertia from swings at two positions half a full step apart.

    Args:
        demand: Demand for the rotor [rad], from the set-point on, one row per ms, (positions, samples, num_axes).
        position: Position by the encoder [rad], same shape.
        held: Holding torque at the present current [N m], (num_axes,).
        age: Age of an encoder's count [s].
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
    least = np.min(errors, axis=2)  # over frictions and initial angles
    best = np.clip(least.argmin(axis=1), 1, len(grid) - 2)
    each = np.arange(axes)
    before, here, after = (least[each, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    shift = np.where(bend > 0.0, np.clip(0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), -0.5, 0.5), 0.0)
    whole = np.maximum(seen.var(axis=0), 1e-12)
    return grid[best] * SPACING**shift, 1.0 - here / whole


def _errors(motor: Motor, omega: Floats, field: Floats, seen: Floats, held: float, age: float) -> Floats:
    """Return the variance of the difference between simulated swings and the samples, (omega, _PAIRS)."""
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
