"""Margins of both outer loops of an axis by its measured velocity loop, for any gains."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tuning.response.margins import Margins, margins

if TYPE_CHECKING:
    from tuning.auto.stages import Basis
    from tuning.response.measured_loop import MeasuredLoop
    from tuning.target import Target

Integers = NDArray[np.int64]

SENSITIVITY = 4.0  # greatest |1/(1+L)| that a measured loop may have
CALMED = {"velocity": ("velocity", "position"), "position": ("position",)}  # whose P is lowered for a loop


def judged_loops(target: Target) -> tuple[str, ...]:
    """Return the loops whose margins a measured velocity loop gives; of linked axes only the velocity loop."""
    return ("velocity",) if target.linked else tuple(CALMED)


def margins_with(basis: Basis, response: MeasuredLoop, gains: Integers, k: int) -> dict[str, Margins]:
    """Return the margins of both outer loops of an axis, by its measured velocity loop."""
    f, velocity, position, trusted = response.loops(gains, k, plant=basis.identified.plants[k])
    found = {"velocity": margins(f, velocity, trusted), "position": margins(f, position, trusted)}
    # A phase of -180 degrees that was not reached may lie above the frequencies looked at.
    return {loop: one if math.isfinite(one.gain_db) else one._replace(gain_db=math.nan) for loop, one in found.items()}


def sensitivity(target: Target, basis: Basis, response: MeasuredLoop, gains: Integers, k: int) -> float:
    """Return Ms of the outer loops of an axis by its measured velocity loop, the greater."""
    found = margins_with(basis, response, gains, k)
    return max(found[loop].ms for loop in judged_loops(target))
