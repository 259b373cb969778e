"""The result of auto: what became of each axis, and the drive time it took."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuning.certificate.certificate import verdict

if TYPE_CHECKING:
    from tuning.auto.proving import Shown
    from tuning.certificate.certificate import StepResponse
    from tuning.identify.estimate import Identification
    from tuning.response.linear_model import Plant
    from tuning.response.margins import Margins
    from tuning.response.measured_loop import AtLeast, MeasuredLoop

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass
class AxisRun:
    """The state of one axis so far.

    Attributes:
        reason: Why it stopped; "" while it goes on.
        reservations: Checks that could not be made or are near a limit; with any of them the certificate is not a plain
            accept.
        notes: Further remarks.
        before, after: Raw gains, in the order of the device's gain set.
        identified: The identification, None before it.
        plant: The axis model made of it, None where that was not possible.
        twin: Robust cost on the twin of the gains that were found.
        proof: J by measured terms of the gains that were taken; nan before.
        verified: How the gains were verified, in words; "" where they were not.
        margins: Of the outer loops as measured, "velocity" and "position"; nothing where nothing was.
        at_least: Lower bounds of margins that were not measured, likewise.
        eased: How often its gains were lowered because it shook at rest.
        is_kept: Whether the gains before were better and are kept.
    """

    before: tuple[int, ...]
    after: tuple[int, ...]
    reason: str = ""
    reservations: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    identified: Identification | None = None
    plant: Plant | None = None
    twin: float = np.nan
    proof: float = np.nan
    verified: str = ""
    margins: dict[str, Margins] = field(default_factory=dict)
    at_least: dict[str, AtLeast] = field(default_factory=dict)
    eased: int = 0
    is_kept: bool = False

    @property
    def accepted(self) -> bool:
        """Whether all checks passed, with reservations or without."""
        return not self.reason

    @property
    def verdict(self) -> str:
        """Which of `tuning.certificate.certificate.VERDICTS` it is."""
        return verdict(self.accepted, self.reservations)


class Result(NamedTuple):
    """The result of a run of auto: the axes, and what it took.

    drive_seconds, moves, aborts and violations: Of each axis, (num_axes,). shown: A recorded move with the new gains,
    None if none was made. earlier: One with those before, likewise. response: The velocity loop's, likewise.
    loaded: Response to a load step, of emulated machines.
    file: The snapshot that brings everything back. kept: Whether drives on a bus stored the gains.
    """

    axes: tuple[AxisRun, ...]
    drive_seconds: Floats
    moves: Integers
    aborts: Integers
    violations: Integers
    shown: Shown | None
    earlier: Shown | None
    response: MeasuredLoop | None
    loaded: dict[int, StepResponse]
    file: Path
    kept: bool

    @property
    def accepted(self) -> Mask:
        """Which axes have gains that passed, new ones or those before, shape (num_axes,)."""
        return np.array([axis.accepted for axis in self.axes])
