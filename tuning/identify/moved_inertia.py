"""The inertia that an axis pushes while all axes of its machine accelerate alike, as in the moves of an identification.

`mechanics.shaft` says what an axis sees that turns alone; where axes are coupled the two differ.
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

LEAST_SHARE = 0.2  # of the inertia of an axis that turns alone: what others take off it is taken for no more than that


def moved_inertia(load: PackedLoad) -> Floats:
    """Return total inertia, rotors and load [kg*m^2], of every copy's axes where the load starts, (copies, axes).

    With B the ways of the axes and M the joints' mass matrix, tau = B M B^T alpha: for accelerations that are alike,
    the rows of B M B^T summed.
    """
    turning = way(load).joints
    at_axes = np.einsum("ad,cde,be->cab", turning, load.mass_matrix(), turning)
    alone = np.einsum("caa->ca", at_axes)
    return np.asarray(np.maximum(at_axes.sum(axis=2), LEAST_SHARE * alone))


def true_inertia(target: Target) -> Floats:
    """Return the inertia of emulated axes as a perfect identification finds it: over the true K_t, times the nominal.

    The axes of a machine move together: an axis pushes its own inertia, and what the others' acceleration puts on it.
    """
    moved = np.concatenate([moved_inertia(group.load) for group in emulated_of(target.drives).inside.groups])
    share = machine_of(target.drives).parameters["motor.psi_m"] / target.motor.psi_m
    return np.asarray(moved.reshape(-1) / np.repeat(share, target.axes_per_machine))
