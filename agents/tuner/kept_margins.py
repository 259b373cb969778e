"""The check of gains against the required margins on the identified plant; computed, never learned."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.devices.gains import cascade_columns
from mechanics.arrays import Integers, Mask
from tuning.auto.correction import LOWERED
from tuning.auto.loop_margins import MEASURED
from tuning.auto.loop_model import LoopModel, loop_models

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import Basis


# In the order of increasing reduction.
NEAREST = LOWERED[np.abs(np.log(LOWERED)).sum(axis=1).argsort(kind="stable")]


class KeptMargins(NamedTuple):
    """Checks any gains against the required dynamics, by the loops of the identified machines.

    models: Loops of each machine, and its axes. dynamics: The required dynamics. calm: Slow gains, raw, (num_axes,
    count), for machines on which no lowered gains keep the dynamics.
    """

    models: list[tuple[LoopModel, Integers]]
    dynamics: Dynamics
    calm: Integers

    @classmethod
    def of(cls, bench: AutoBench, basis: Basis) -> KeptMargins:
        """Return the margins of a run's identified axes."""
        return cls(
            loop_models(bench.target, basis.identified, None, bench.going, bench.dynamics), bench.dynamics, basis.calm
        )

    def kept(self, gains: Integers) -> Mask:
        """Return the axes whose gains keep the dynamics within the model's uncertainty, (num_axes,).

        Args:
            gains: Raw, (num_axes, count).
        """
        keep = np.ones(len(gains), bool)
        for model, axes in self.models:
            keep[axes] = model.slack(self.dynamics, gains[axes][None])[0] >= -MEASURED
        return keep

    def lowered(self, gains: Integers) -> Integers:
        """Return gains that keep the dynamics: the given ones, or the nearest with less velocity P, I and position P.

        Args:
            gains: Raw, (num_axes, count).
        """
        result, keep = gains.copy(), self.kept(gains)
        for model, axes in self.models:
            if keep[axes].all():
                continue
            columns = cascade_columns(model.device)[2:]
            every = model.device.gains.scaled(gains[axes], NEAREST[:, None], columns)
            good = model.slack(self.dynamics, every) >= 0.0
            result[axes] = every[good.argmax()] if good.any() else self.calm[axes]
        return result
