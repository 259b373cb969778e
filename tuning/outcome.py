"""A tuner: a function of a target and a random generator, and its result."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mechanics.arrays import Floats, Integers, Mask
from tuning.target import Target


class Outcome(NamedTuple):
    """The result of a tuner, of every axis.

    gains: Raw integers in the order of the device's gain set, shape (num_axes, gains).
    drive_seconds: Time on the drive [s], (num_axes,).
    moves: Moves and other excitations, (num_axes,).
    aborts: Trials and moves that had to be stopped, (num_axes,).
    violations: How often it left its limits, (num_axes,).
    notes: One text per axis, "" for none.
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
