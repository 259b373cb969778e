"""What auto did to axes, and what it cost."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.gains import Gains

if TYPE_CHECKING:
    from tuning.identification import Identification
    from tuning.linear_model import Plant
    from tuning.margins import Margins
    from tuning.measured_loop import MeasuredLoop
    from tuning.proving import Shown

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass
class AxisRun:
    """What became of one axis so far.

    Attributes:
        reason: Why it stopped; "" while it goes on.
        notes: What else there is to say.
        before, after: Raw gains.
        identified: What its signals said, None before.
        plant: What was made of that, None where nothing could be.
        twin: Hidden J that the twin gives the gains it found.
        proof: J by measured terms of the gains that were taken; nan before.
        verified: How the gains were verified, in words; "" where they were not.
        margins: Of the velocity loop as measured, None where nothing was.
        is_kept: Whether the gains before were better, and are the ones after.
    """

    before: Gains
    after: Gains
    reason: str = ""
    notes: list[str] = field(default_factory=list)
    identified: Identification | None = None
    plant: Plant | None = None
    twin: float = np.nan
    proof: float = np.nan
    verified: str = ""
    margins: Margins | None = None
    is_kept: bool = False

    @property
    def accepted(self) -> bool:
        """Whether it got through everything."""
        return not self.reason


class Result(NamedTuple):
    """What auto did: the axes, and its costs.

    drive_seconds, moves, aborts and violations: Of each axis, (num_axes,). shown: A recorded move with the new gains,
    None if none was made. earlier: One with those before, likewise. response: The velocity loop's, likewise.
    file: The snapshot that brings everything back. kept: Whether drives on a bus keep the gains over a power cycle.
    """

    axes: tuple[AxisRun, ...]
    drive_seconds: Floats
    moves: Integers
    aborts: Integers
    violations: Integers
    shown: Shown | None
    earlier: Shown | None
    response: MeasuredLoop | None
    file: Path
    kept: bool

    @property
    def accepted(self) -> Mask:
        """Which axes have gains that passed, new ones or those before, shape (num_axes,)."""
        return np.array([axis.accepted for axis in self.axes])
