"""Margins by model in a search: models of identified axes judge gains before a drive gets them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drive_env.drives.interface import axis_number
from drive_env.drives.raw_gains import read_gains
from drive_env.loops.linear_model import Plant
from drive_env.safety.envelope import swinging_allowed
from mechanics.arrays import Floats, Integers, Mask
from tuning.auto.identified import identified_plant
from tuning.auto.loop_model import loop_models
from tuning.auto.stages import IdentifiedAxes
from tuning.identify.quick_identification import identify_briefly

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.target import Target


class ModelMargins:
    """The models of the machines' loops.

    Args:
        target: The target; its drives are identified here, which takes about 4 s of drive time per axis of a machine.
        dynamics: Requirements on the loops.
        where: Axes of whole machines to identify, shape (num_axes,).

    Attributes:
        before: Raw gains that the drives had, shape (num_axes, count).

    Raises:
        RuntimeError: If an axis cannot be identified, or its wiring is wrong.
    """

    def __init__(self, target: Target, dynamics: Dynamics, where: Mask) -> None:
        self.dynamics = dynamics
        self.before = read_gains(target.drives)
        with swinging_allowed(target.drives):
            found = identify_briefly(target, where)
        plants: list[Plant | None] = [None] * target.num_axes
        for k in map(int, np.flatnonzero(where)):
            plants[k], wrong = identified_plant(target, k, found[k])
            if wrong:
                number = axis_number(target.drives, k)
                raise RuntimeError(f"axis {number}: no margins can be kept without a model of its loops: {wrong}")
        identified = IdentifiedAxes(tuple(found), tuple(plants))
        self._models = loop_models(target, identified, None, where, dynamics)

    def slack(self, gains: Integers, axes: slice) -> float:
        """Return the slack of a machine to the dynamics, relative: 0 if a constraint is only just kept.

        Args:
            gains: Raw gains of its axes, shape (axes_per_machine, count).
            axes: Indices of these axes.
        """
        return min(float(model.slack(self.dynamics, gains[None, own - axes.start])[0])
                   for model, own in self._models if axes.start <= own[0] < axes.stop)  # fmt: skip

    def margins(self, gains: Integers) -> Floats:
        """Return phase margin [degrees], gain margin [dB] and Ms of velocity and position loop.

        Args:
            gains: Raw gains, shape (num_axes, count).

        Returns:
            Shape (num_axes, 2, 3); nan for an axis that was not identified.
        """
        found = np.full((len(gains), 2, 3), np.nan)
        for model, own in self._models:
            for k, loops in zip(own, model.margins(gains[own]), strict=True):
                found[k] = [(one.phase_deg, one.gain_db, one.ms) for one in loops.values()]
        return found
