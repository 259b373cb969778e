"""Margins of both outer loops of an axis by its measured velocity loop, for any gains."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drive_env.loops.margins import Margins, margins

if TYPE_CHECKING:
    from tuning.auto.stages import Basis
    from tuning.response.measured_loop import MeasuredLoop
    from tuning.target import Target

Integers = NDArray[np.int64]

# Greatest |1/(1+L)| that a loop may have, and what gains are lowered to where that can be: it leaves 19 degrees and
# 3.5 dB at least, where 4 leaves 14 and 2.5. The baseline rule has up to 3; with 2.3 it was lowered on a mere inertia.
SENSITIVITY, SOUGHT = 4.0, 3.0
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


def first_far_enough(peaks: Iterable[float]) -> int | None:
    """Return which of some gains to take by their Ms: the first within what is sought, else within what is allowed.

    Args:
        peaks: Ms of the gains, in the order in which they are preferred.

    Returns:
        Its number; None if none is allowed.
    """
    allowed = None
    for number, ms in enumerate(peaks):
        if ms <= SOUGHT:
            return number
        if allowed is None and ms <= SENSITIVITY:
            allowed = number
    return allowed
