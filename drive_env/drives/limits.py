"""Limits of a program on drives of a bus, as given by the user."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mechanics.arrays import Floats

PerAxis = float | Sequence[float | None]

NO_LIMIT = 2**62  # beyond what any object holds
LEAST_SILENCE, MOST_SILENCE = 0.02, 65.535  # s; 1016h counts whole milliseconds in 16 bits
DEFAULT_SPEED = 100.0  # rev/s of the rotor (6,000 rpm), for a drive without a limit of its own


@dataclass(frozen=True)
class Limits:
    """The limits of a program, in the drive's units; None takes the drive's own limit.

    Each limit is one number for all axes, or a sequence with one per axis, of which None takes the drive's own.

    Attributes:
        position: Lowest and highest position [unit of 6064h]; infinite: no limit. It is converted to a rotor position
            when the drives are opened, and stays there when scale or zero change (2058h, 608Fh, homing); it also holds
            in homing. The drive's own limits are 607Dh, from which homing is exempt.
        velocity: Highest speed either way [unit of 606Ch]; the drive's is 607Fh, if it has one, else 6,000 rpm of the
            rotor. It is converted to a rotor speed at the present scale, and does not change with the scale. No axis
            may be faster than its quick stop (6085h) can stop within a second.
        current: Highest current or torque either way [unit of 6077h]; the drive's is its current limit.
        following_error: Largest distance of demand and position in pp and csp; the drive's is 6065h. It is converted to
            an angle of the rotor, too.
        oscillation: Quick-stop an axis whose current oscillates.
        stall: Longest pause between two calls while an axis is enabled [s]; None: no limit.
        silence: Silence of this process after which the drive stops by itself [s]. None leaves the drives' watchdogs
            off: it is for drives without a heartbeat consumer (1016h) and life guarding (100Ch), with you at the
            emergency stop.
    """

    position: tuple[PerAxis | None, PerAxis | None] | None = None
    velocity: PerAxis | None = None
    current: PerAxis | None = None
    following_error: PerAxis | None = None
    oscillation: bool = True
    stall: float | None = 1.0
    silence: float | None = 0.5

    def __post_init__(self) -> None:
        if self.position is not None:
            if len(self.position) != 2:
                raise ValueError(f"position limits are lowest and highest, not {self.position}")
            low, high = np.broadcast_arrays(_values(self.position[0], -math.inf), _values(self.position[1], math.inf))
            if np.isnan(low).any() or np.isnan(high).any() or not np.all(low < high):
                raise ValueError(f"position limits are lowest and highest, not {self.position}")
        for name in ("velocity", "current", "following_error"):
            if not np.all(_values(getattr(self, name), 1.0) > 0):
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)}; None takes the drive's own limit")
        if self.stall is not None and not (math.isfinite(self.stall) and self.stall > 0.0):
            raise ValueError(f"stall must be above 0 s, not {self.stall}; None is for any")
        if self.silence is not None and not LEAST_SILENCE <= self.silence <= MOST_SILENCE:
            raise ValueError(
                f"silence = {self.silence} s is impossible: a drive counts it in milliseconds, and this computer can "
                f"guarantee {LEAST_SILENCE:g} s at best; choose {LEAST_SILENCE:g} to {MOST_SILENCE:g} s"
            )

    def check_axes(self, num_axes: int) -> None:
        """Raise ValueError for a sequence that is not one value per axis."""
        low, high = (None, None) if self.position is None else self.position
        given = {"position": low, "position's upper end": high}
        for name, value in (given | {n: getattr(self, n) for n in ("velocity", "current", "following_error")}).items():
            if (count := np.size(value)) not in (1, num_axes):  # type: ignore[arg-type]
                raise ValueError(f"{name} has {count} values for {num_axes} axes; give one for all, or one each")


def given(value: PerAxis | None, num_axes: int) -> Floats:
    """Return the user's limit of each axis, shape (num_axes,); nan where the drive's own limit holds."""
    return np.broadcast_to(_values(value, math.nan), (num_axes,)).astype(float)


def _values(value: PerAxis | None, absent: float) -> Floats:
    if value is None or np.ndim(value) == 0:  # type: ignore[arg-type]
        return np.asarray(absent if value is None else value, float)
    return np.array([absent if one is None else one for one in value], np.float64)  # type: ignore[union-attr]
