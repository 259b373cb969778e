"""The interface of tuners: a function of a target and a random generator that returns an `Outcome`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mechanics.arrays import Floats, Integers, Mask
from tuning.target import Target


class Outcome(NamedTuple):
    """The result of a tuner for all axes.

    gains: Raw integers in the order of the device's gain set, shape (num_axes, gains).
    drive_seconds: Time on the drive [s], shape (num_axes,).
    moves: Number of moves and other excitations, shape (num_axes,).
    aborts: Number of trials and moves that had to be stopped, shape (num_axes,).
    violations: Number of violations of limits, shape (num_axes,).
    notes: One text per axis, "" without a note.
    accepted: Axes whose gains the tuner guarantees, shape (num_axes,); None means all.
    reserved: Accepted axes with reservations: not every check could be made or passed, (num_axes,); None means none.
    """

    gains: Integers
    drive_seconds: Floats
    moves: Integers
    aborts: Integers
    violations: Integers
    notes: tuple[str, ...]
    accepted: Mask | None = None
    reserved: Mask | None = None


Tuner = Callable[[Target, np.random.Generator], Outcome]
