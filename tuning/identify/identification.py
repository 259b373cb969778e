"""Identifies parameters of motor and machine from a drive's own signals, each with a 95 % interval or a reason.

`identify` runs the experiments in an order in which each has the results that it needs, on all axes at the same time,
and restores every drive: off, with its own parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mechanics.arrays import Mask
from tuning.identify.experiments import Experiments
from tuning.identify.identified_axis import Identification, Progress

if TYPE_CHECKING:
    from tuning.target import Target


def identify(target: Target, where: Mask | None = None, *, progress: Progress | None = None) -> list[Identification]:
    """Identify axes; leave the drives off and with their former parameters, also after an error.

    Args:
        target: The axes. They must be off and at rest.
        where: Axes to identify; all by default. The others get no values.
        progress: Called with the present step and the share that is done.

    Returns:
        One identification per axis; a value that could not be identified has the reason instead.

    Raises:
        RuntimeError: If an axis is enabled, or cannot be enabled; ValueError if no axis is chosen.
    """
    axes = np.ones(target.num_axes, bool) if where is None else np.asarray(where, bool)
    if axes.shape != (target.num_axes,) or not axes.any():
        raise ValueError(f"where must choose at least one of {target.num_axes} axes, not shape {axes.shape}")
    return Experiments(target, axes, progress or (lambda what, share: None)).run()
