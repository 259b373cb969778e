"""What a tuner is: a function of a target and a random generator, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mechanics.arrays import Floats, Integers, Mask
from tuning.target import Target


class Outcome(NamedTuple):
    """What a tuner did, of every axis.

    gains: Raw integers in the order of the device's gain set, shape (num_axes, gains).
    drive_seconds: Time on the drive [s], (num_axes,).
    moves: Moves and other excitations, (num_axes,).
    aborts: What had to be stopped, (num_axes,).
    violations: How often it left its limits, (num_axes,).
    notes: What there is to say, one text per axis; "" is nothing.
    accepted: Axes whose gains the tuner vouches for, (num_axes,); None is all.
    """

    gains: Integers
    drive_seconds: Floats
    moves: Integers
    aborts: Integers
    violations: Integers
    notes: tuple[str, ...]
    accepted: Mask | None = None


Tuner = Callable[[Target, np.random.Generator], Outcome]
