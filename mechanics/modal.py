"""What makes the staggered step exact for elastic loads: corrections of stiffness and torque, mode by mode.

The leapfrog takes a step's torque as an impulse in its middle. A mode of angular frequency w then oscillates at
asin(w h / 2) / (h / 2), is excited by 1/cos(x), x = w h / 2, where torque that is held over the step excites it by
sin(x)/x, and does not know when within the step the torque came. Written in the modes of M q'' + K q = f, with
P' M P = 1 and K P = M P w^2, all three are factors, and give matrices that the compiled step multiplies by.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Corrections(NamedTuple):
    """Matrices of each copy; D degrees of freedom, A axes."""

    phase: Floats  # (C, D) w h / 2 of each mode
    shapes: Floats  # (C, D, D) modes as columns
    stiffness: Floats  # (C, D, D) in place of K
    held: Floats  # (C, D, D) force to add per force held over the step
    held_moment: Floats  # (C, D, A) force to add per first moment of an axis's torque [1/s]
    kick: Floats  # (C, A, D) displacement per first moment, to be multiplied by h


def corrections(inertia: Floats, stiffness: Floats, axes: Floats, h: float) -> Corrections:
    """Return the corrections for copies with an inertia matrix each.

    Args:
        inertia: M, shape (C, D, D).
        stiffness: Of the joints' springs, shape (C, D).
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
    x = 0.5 * h * w
    through = np.swapaxes(shapes, 1, 2)  # P', from force to modes
    driven = through @ axes.T
    sinc = np.sinc(x / np.pi)  # sin(x)/x; numpy's has pi in it
    held = weighted @ ((np.sinc(2.0 * x / np.pi) - 1.0)[:, :, None] * through)
    moment = weighted @ ((w * np.sin(x))[:, :, None] * driven)
    kick = shapes @ ((1.0 / sinc)[:, :, None] * driven)
    corrected = weighted @ (((w * sinc) ** 2)[:, :, None] * np.swapaxes(weighted, 1, 2))
    # Rounding must not tie a rotor that is free to turn for ever to its angle at the start.
    corrected[np.abs(corrected) < 1e-12 * np.abs(corrected).max(axis=(1, 2), keepdims=True)] = 0.0
    return Corrections(x, shapes, corrected, held, moment, np.ascontiguousarray(np.swapaxes(kick, 1, 2)))
