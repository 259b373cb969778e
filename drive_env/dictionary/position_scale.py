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
    """The objects that say a scale, and what their values make: the increments of a revolution, of any shape."""

    keys: tuple[Key, ...]
    increments: Callable[[Sequence[Floats]], Floats]


def position_scale(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return what a drive with these roles counts positions in; None of one that does not say."""
    if Role.POSITION_SCALE in roles:
        return PositionScale((roles[Role.POSITION_SCALE],), lambda values: values[0])
    inside = (Role.TURN_INSIDE, Role.POSITION_NUMERATOR, Role.POSITION_DIVISOR)
    if all(role in roles for role in inside):
        return PositionScale(tuple(roles[role] for role in inside), _units_of_turn)
    if Role.FULL_STEPS in roles and Role.MICROSTEPS in roles:
        return PositionScale((roles[Role.FULL_STEPS], roles[Role.MICROSTEPS]), _microsteps)
    return None


def velocity_ratio(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return the objects that say the rpm of a velocity unit, and what they make of it; None of other drives."""
    parts = (Role.VELOCITY_NUMERATOR, Role.VELOCITY_DIVISOR)
    if not all(role in roles for role in parts):
        return None
    return PositionScale(tuple(roles[role] for role in parts), lambda values: values[0] / values[1])


def _units_of_turn(values: Sequence[Floats]) -> Floats:
    turn, numerator, divisor = values
    return turn * divisor / numerator


def _microsteps(values: Sequence[Floats]) -> Floats:
    full_steps, exponent = values
    return full_steps * np.exp2(exponent)
