"""How many increments of position a revolution has: one object says it, or two whose values make it.

A servo drive has an object of its own for it (Role.POSITION_SCALE). A stepper counts microsteps: full steps of a turn,
times two to the power of the resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.dictionary.roles import Role

Floats = NDArray[np.float64]
Key = tuple[int, int]


class PositionScale(NamedTuple):
    """The objects that say it, and the increments of a revolution that their values make, of any shape."""

    keys: tuple[Key, ...]
    increments: Callable[[Sequence[Floats]], Floats]


def position_scale(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return what a drive with these roles counts positions in; None of one that does not say."""
    if Role.POSITION_SCALE in roles:
        return PositionScale((roles[Role.POSITION_SCALE],), lambda values: values[0])
    if Role.FULL_STEPS in roles and Role.MICROSTEPS in roles:
        return PositionScale((roles[Role.FULL_STEPS], roles[Role.MICROSTEPS]), _microsteps)
    return None


def _microsteps(values: Sequence[Floats]) -> Floats:
    full_steps, exponent = values
    return full_steps * np.exp2(exponent)
