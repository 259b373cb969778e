"""Position increments per revolution: the value of one object, or computed from several.

Servo drives have one object for it (Role.POSITION_SCALE). Steppers count microsteps: full steps per revolution times
two to the power of the resolution. CiA 402 has the encoder's resolution (608Fh), and feed constant over gear ratio
(6092h, 6091h), each a fraction of two objects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from mechanics.arrays import Floats

# Allowed position units per revolution: with fewer no position could be held, with more 32 bits hold fewer than 8
# turns.
COARSEST, FINEST = 100.0, float(2**28)
TURN_INSIDE = 2.0**32  # increments per revolution of drives with internal positions of 64 bits


class PositionScale(NamedTuple):
    """The objects of a scale, and the function from their values to increments per revolution, of any shape."""

    keys: tuple[Key, ...]
    increments: Callable[[Sequence[Floats]], Floats]


def position_scale(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return the position scale of a drive with these roles; None if it has none of the roles."""
    if Role.POSITION_SCALE in roles:
        return PositionScale((roles[Role.POSITION_SCALE],), lambda values: values[0])
    inside = (Role.POSITION_NUMERATOR, Role.POSITION_DIVISOR)
    if all(role in roles for role in inside):
        return PositionScale(tuple(roles[role] for role in inside), _units_of_turn)
    if Role.FULL_STEPS in roles and Role.MICROSTEPS in roles:
        return PositionScale((roles[Role.FULL_STEPS], roles[Role.MICROSTEPS]), _microsteps)
    for parts, increments in ((_GEARED_FEED, _per_motor_turn), (_FEED, _quotient), (_RESOLUTION, _quotient)):
        if all(part in roles for part in parts):
            return PositionScale(tuple(roles[part] for part in parts), increments)
    return None


def is_scale(units: float) -> bool:
    """Return whether positions can be counted in this number of units per revolution."""
    return COARSEST <= units <= FINEST


_RESOLUTION = (Role.ENCODER_INCREMENTS, Role.ENCODER_TURNS)
_FEED = (Role.FEED, Role.FEED_TURNS)
_GEARED_FEED = (*_FEED, Role.GEAR_MOTOR, Role.GEAR_SHAFT)


def _quotient(values: Sequence[Floats]) -> Floats:
    number, turns = values
    return number / turns


def _per_motor_turn(values: Sequence[Floats]) -> Floats:
    units, turns, motor, shaft = values
    return units / turns * shaft / motor


def velocity_ratio(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return the objects that give the rpm of a velocity unit, with the function of their values; or None."""
    return _ratio(roles, (Role.VELOCITY_NUMERATOR, Role.VELOCITY_DIVISOR))


def set_point_ratio(roles: Mapping[Role, Key]) -> PositionScale | None:
    """Return the same for the velocity units of a target velocity of vl (604Bh); None without 604Bh."""
    return _ratio(roles, (Role.SET_POINT_NUMERATOR, Role.SET_POINT_DIVISOR))


def _ratio(roles: Mapping[Role, Key], parts: tuple[Role, Role]) -> PositionScale | None:
    return PositionScale(tuple(roles[role] for role in parts), _quotient) if roles.keys() >= set(parts) else None


def _units_of_turn(values: Sequence[Floats]) -> Floats:
    numerator, divisor = values
    return TURN_INSIDE * divisor / numerator


def _microsteps(values: Sequence[Floats]) -> Floats:
    full_steps, exponent = values
    return full_steps * np.exp2(exponent)
