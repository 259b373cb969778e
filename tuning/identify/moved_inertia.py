"""The inertia that an axis moves if all axes of its machine accelerate equally, as in the moves of an identification.

`mechanics.shaft` computes that of an axis that turns alone; for coupled axes the two differ.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env.drives.interface import machine_of
from drive_env.emulator.emulated_drives import emulated_of
from mechanics.arrays import Floats
from mechanics.shaft import way

if TYPE_CHECKING:
    from mechanics.packed import PackedLoad
    from tuning.target import Target

LEAST_SHARE = 0.2  # of the inertia of an axis that turns alone: lower bound of the result


def moved_inertia(load: PackedLoad) -> Floats:
    """Return total inertia, rotor and load [kg*m^2], of every copy's axes at the load's first position, (copies, axes).

    With the axes' motions B and the joints' mass matrix M, tau = B M B^T alpha: for equal accelerations the result is
    the sum of each row of B M B^T.
    """
    turning = way(load).joints
    at_axes = np.einsum("ad,cde,be->cab", turning, load.mass_matrix(), turning)
    alone = np.einsum("caa->ca", at_axes)
    return np.asarray(np.maximum(at_axes.sum(axis=2), LEAST_SHARE * alone))


def true_inertia(target: Target) -> Floats:
    """Return the inertia of emulated axes that an exact identification gives: over the true K_t, times the nominal.

    The axes of a machine accelerate together: an axis moves its own inertia and the coupling with the others.
    """
    moved = np.concatenate([moved_inertia(group.load) for group in emulated_of(target.drives).inside.groups])
    share = machine_of(target.drives).parameters["motor.psi_m"] / target.motor.psi_m
    return np.asarray(moved.reshape(-1) / np.repeat(share, target.axes_per_machine))
