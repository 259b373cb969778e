"""Corrections of stiffness, damping and torque, mode by mode, that make the staggered step exact for elastic loads.

The leapfrog applies a step's torque as an impulse in its middle. A mode of angular frequency w then oscillates at
asin(w h / 2) / (h / 2), is excited by 1/cos(x), x = w h / 2, while torque held over the step excites it by sin(x)/x,
and ignores when within the step the torque acted. Written in the modes of M q'' + C q' + K q = f, with P' M P = 1 and K
P = M P w^2, these are all factors, which give matrices for the compiled step.

A mode q'' + 2 d q' + w^2 q = f has over one step an exact solution, (q, q')+ = E (q, q') + g f. The step, where MuJoCo
takes the half b = d h of the damping at the step's end, is

    (1 + b) v+ = (1 - a) v - h k Q + h s f,    Q+ = Q + h v+.

It is exact, v = q' at the step's end and Q = alpha q + beta q' in the middle of the next, with 1 - a = (1 + b) det E, k
= (1 + b) det(1 - E) / h^2, s = (1 + b) g_2 / h, alpha = -h E_21 / det(1 - E) and beta = h - h (1 - E_11) / det(1 - E).
Without damping k is (w sin(x)/x)^2, s sin(2x)/2x, alpha x/tan(x) and beta h/2. If damping couples modes, each is
corrected for its own damping: exact are dampers in proportion to the springs, as those of one shaft.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mechanics.arrays import Complex, Floats


class Corrections(NamedTuple):
    """Matrices of each copy; D degrees of freedom, A axes."""

    phase: Floats  # (C, D) w h / 2 of each mode
    coupling: Floats  # (C, D, D) damping by which modes with springs act on others [1/s]
    shapes: Floats  # (C, D, D) modes as columns
    stiffness: Floats  # (C, D, D) in place of K
    damping: Floats  # (C, D, D) to add to the half of C that acts at the step's start
    held: Floats  # (C, D, D) force to add per force held over the step
    held_moment: Floats  # (C, D, A) force to add per first moment of an axis's torque [1/s]
    kick: Floats  # (C, A, D) displacement per first moment, to be multiplied by h
    # Angle of an axis at the step's end, to add per displacement there in the leapfrog, and per speed [s].
    ends: Floats  # (C, A, D)
    ends_of_speed: Floats  # (C, A, D)
    begin: Floats  # (C, D, D) displacement in the leapfrog's form, per displacement at rest


def corrections(inertia: Floats, stiffness: Floats, damping: Floats, axes: Floats, h: float) -> Corrections:
    """Return the corrections for copies with an inertia matrix each.

    Args:
        inertia: M, shape (C, D, D).
        stiffness: Of the joints' springs, shape (C, D).
        damping: Of the joints, shape (C, D).
        axes: Force on each degree of freedom per torque of an axis, shape (A, D).
        h: Step [s].
    """
    lower = np.linalg.cholesky(inertia)
    inverse = np.linalg.inv(lower)
    spring = np.zeros_like(inertia)
    index = np.arange(stiffness.shape[1])
    spring[:, index, index] = stiffness
    squares, vectors = np.linalg.eigh(inverse @ spring @ np.swapaxes(inverse, 1, 2))
    shapes = np.swapaxes(inverse, 1, 2) @ vectors  # P
    weighted = lower @ vectors  # M P
    w = np.sqrt(np.maximum(squares, 0.0))
    through = np.swapaxes(shapes, 1, 2)  # P', from force to modes
    driven = through @ axes.T
    into_modes = np.swapaxes(weighted, 1, 2)  # from displacement to modes
    # A motion without a spring has nothing to correct.
    sprung = w * h > 1e-4
    lost = through @ (damping[:, :, None] * shapes)  # P' C P
    d = np.where(sprung, 0.5 * lost[:, index, index], 0.0)
    coupling = np.where(sprung[:, :, None], lost, 0.0)
    coupling[:, index, index] = 0.0
    mode = _mode(w, d, h)
    end = 1.0 + d * h  # what MuJoCo's half of the damping takes
    alpha = np.where(sprung, mode.alpha, 1.0)
    beta = np.where(sprung, mode.beta, 0.5 * h)
    held = weighted @ ((end * mode.held - 1.0)[:, :, None] * through)
    moment = weighted @ ((end * mode.late_speed)[:, :, None] * driven)
    # The leapfrog's error of displacement for torque late in the step.
    kick = shapes @ ((alpha * mode.late + (h - beta) * mode.late_speed)[:, :, None] * driven)
    corrected = weighted @ ((end * mode.stiffness)[:, :, None] * into_modes)
    # Rounding must not tie a freely turning rotor to its angle at the start.
    corrected[np.abs(corrected) < 1e-12 * np.abs(corrected).max(axis=(1, 2), keepdims=True)] = 0.0
    begun = (1.0 - end * np.exp(-2.0 * d * h)) / h - d
    ends = axes @ shapes @ ((1.0 / alpha - 1.0)[:, :, None] * into_modes)
    ends_of_speed = axes @ shapes @ (((0.5 * h - beta) / alpha)[:, :, None] * into_modes)
    begin = np.eye(len(index)) + shapes @ ((alpha - 1.0)[:, :, None] * into_modes)
    return Corrections(
        0.5 * h * w, coupling, shapes, corrected, weighted @ (begun[:, :, None] * into_modes), held, moment,
        np.ascontiguousarray(np.swapaxes(kick, 1, 2)), ends, ends_of_speed, begin,
    )  # fmt: skip


class _Mode(NamedTuple):
    """The exact step of each mode, shape (C, D); see the top of the file."""

    stiffness: Floats  # det(1 - E) / h^2 [1/s^2]
    held: Floats  # g_2 / h
    alpha: Floats
    beta: Floats  # [s]
    late: Floats  # displacement that a torque late in the step has not made yet, per h and first moment
    late_speed: Floats  # speed that it has kept, per h and first moment [1/s]


def _mode(w: Floats, d: Floats, h: float) -> _Mode:
    """Return the exact step of q'' + 2 d q' + w^2 q = f, w and d in [1/s]; beta is of modes with a spring alone."""
    root = np.sqrt((w * w - d * d).astype(complex))  # imaginary where the mode creeps back
    fast = d + np.where(w < d, np.abs(root), 1j * root)  # the rates of decay; their product is w^2
    slow = np.divide(w * w, fast, out=np.zeros_like(fast), where=fast != 0.0)

    def after_a_blow(t: float) -> tuple[Floats, Floats]:
        """Return displacement per t, and speed, at a time after a blow of 1."""
        displacement = (np.exp(-slow * t) * _decayed((fast - slow) * t)).real
        return displacement, 0.5 * (np.exp(-fast * t) + np.exp(-slow * t)).real - d * t * displacement

    held, speed = after_a_blow(h)
    late, late_speed = after_a_blow(0.5 * h)
    kept = (_decayed(fast * h) * _decayed(slow * h)).real  # det(1 - E) / (w h)^2
    e_11 = speed + 2.0 * d * h * held
    return _Mode(
        stiffness=w * w * kept,
        held=held,
        alpha=held / kept,
        beta=h - h * (1.0 - e_11) / (np.where(w * h > 0.0, (w * h) ** 2, 1.0) * kept),
        late=late_speed,
        late_speed=0.5 * h * w * w * late + 2.0 * d * late_speed,
    )


def _decayed(x: Complex) -> Complex:
    """Return (1 - exp(-x)) / x."""
    return np.where(x == 0.0, 1.0, -np.expm1(-x) / np.where(x == 0.0, 1.0, x))
