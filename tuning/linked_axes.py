"""Whether the axes of a machine are coupled mechanically: its user knows that, its drives cannot measure it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from mechanics.shaft import POSES, pose_of, way

if TYPE_CHECKING:
    from mechanics.packed import PackedLoad


def are_linked(load: PackedLoad) -> bool:
    """Return whether turning one axis with the others at rest strains a spring between them."""
    turning = way(load).joints
    strain = np.einsum("ad,de,ae->a", turning, load.plant.stiffness[..., 0], turning)
    return load.num_axes > 1 and bool(np.any(strain > 0.0))


APART = 0.01  # greatest ratio of coupling inertia to the mean of the two axes' own at which they count as independent


def are_independent(load: PackedLoad) -> bool:
    """Return whether each axis moves independently: no spring and no inertia couples it with another, in any pose.

    True for the axes of a portal; false for the joints of an arm, which accelerate one another, and for a gantry's
    ends.
    """
    if load.num_axes == 1:
        return True
    if are_linked(load):
        return False
    turning = way(load).joints
    model, data = load.model, load.template.scratch
    generator = np.random.default_rng(0)
    for pose in range(POSES if load.varying else 1):
        share = generator.random(load.num_dofs) if pose else np.full(load.num_dofs, 0.5)
        data.qpos.reshape(load.copies, -1)[:] = load.start + pose_of(load, share)
        mujoco.mj_forward(model, data)
        inertia = np.einsum("ad,cde,be->cab", turning, load.template.inertia(data), turning)
        own = np.sqrt(np.einsum("caa->ca", inertia))
        coupling = np.abs(inertia / (own[:, :, None] * own[:, None, :]))
        if np.any(coupling[:, ~np.eye(load.num_axes, dtype=bool)] > APART):
            return False
    return True
