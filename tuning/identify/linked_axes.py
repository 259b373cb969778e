"""Whether the axes of a machine pull at one thing, as those of a gantry do: a user sees it, a drive does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mechanics.shaft import way

if TYPE_CHECKING:
    from mechanics.packed import PackedLoad


def are_linked(load: PackedLoad) -> bool:
    """Return whether turning one axis, the others at rest, strains a spring that joins them."""
    turning = way(load).joints
    strain = np.einsum("ad,de,ae->a", turning, load.plant.stiffness[..., 0], turning)
    return load.num_axes > 1 and bool(np.any(strain > 0.0))
