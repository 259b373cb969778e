"""The result of auto: what became of each axis, and the drive time it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mechanics.arrays import Floats, Integers, Mask
from tuning.certificate.certificate import verdict
from tuning.lateness import late_first

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import Shown
    from tuning.auto.stages import IdentifiedAxes, RecordedGains
    from tuning.certificate.certificate import Correction, StepResponse
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import AtLeast, MeasuredLoop


@dataclass(frozen=True)
class AxisResult:
    """What became of one axis.

    Attributes:
        before, after: Raw gains, in the order of the device's gain set.
        reason: Why it was rejected; "" where all checks passed, with reservations or without.
        reservations: Checks that could not be made or are near a limit; with any of them the certificate is not a plain
            accept.
        notes: Further remarks.
        identified: The identification, None where there was none.
        plant: The axis model made of it, None where that was not possible.
        twin: Robust cost on the twin of the gains that were found; nan where none were.
        proof: J by measured terms of the gains that were taken; nan where none passed a trial.
        verified: How the gains were verified, in words; "" where they were not.
        margins: Of the outer loops as measured, "velocity" and "position"; nothing where nothing was.
        at_least: Lower bounds of margins that were not measured, likewise.
        slack: How far the measured loops keep the dynamics, relative; nan where they were not measured.
        overshoot: Of a step of the set-point in csp, over the step; nan where none was made.
        corrections: Gains that gave way to others, in their order.
        is_kept: Whether the gains before were better and are kept.
    """

    before: tuple[int, ...]
    after: tuple[int, ...]
    reason: str = ""
    reservations: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    identified: Identification | None = None
    plant: Plant | None = None
    twin: float = np.nan
    proof: float = np.nan
    verified: str = ""
    margins: Mapping[str, Margins] = field(default_factory=dict)
    at_least: Mapping[str, AtLeast] = field(default_factory=dict)
    slack: float = np.nan
    overshoot: float = np.nan
    corrections: tuple[Correction, ...] = ()
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
    loaded: Response to a load step, of emulated machines. dynamics: What the loops were to keep.
    file: The snapshot that brings everything back. kept: Whether drives on a bus stored the gains.
    """

    axes: tuple[AxisResult, ...]
    drive_seconds: Floats
    moves: Integers
    aborts: Integers
    violations: Integers
    shown: Shown | None
    earlier: Shown | None
    response: MeasuredLoop | None
    loaded: Mapping[int, StepResponse]
    dynamics: Dynamics
    file: Path
    kept: bool

    @property
    def accepted(self) -> Mask:
        """Which axes have gains that passed, new ones or those before, shape (num_axes,)."""
        return np.array([axis.accepted for axis in self.axes])


def collect(bench: AutoBench, identified: IdentifiedAxes, recorded: RecordedGains, file: Path, kept: bool) -> Result:
    """Return the result of a run: of the axes that were accepted with their gains."""
    axes = []
    for k, journal in enumerate(bench.journals):
        before = bench.before[k]
        after = before if journal.reason else recorded.gains[k]
        axes.append(
            AxisResult(
                tuple(map(int, before)), tuple(map(int, after)), late_first(bench.target.drives, journal.reason),
                tuple(journal.reservations), tuple(journal.notes),
                identified.found[k], identified.plants[k],
                float(recorded.cost[k]), float(recorded.proof[k]), recorded.verified[k], recorded.margins.get(k, {}),
                recorded.at_least.get(k, {}), float(recorded.slack[k]), float(recorded.overshoot[k]),
                tuple(journal.corrections), bool(recorded.kept[k]),
            )
        )  # fmt: skip
    ground, none = getattr(bench, "ground", None), np.zeros(bench.target.num_axes, np.int64)
    moves, aborts, violations = (none,) * 3 if ground is None else (ground.moves, ground.aborts, ground.violations)
    return Result(
        tuple(axes), bench.spent, moves, aborts, violations, recorded.shown, recorded.earlier, recorded.response,
        recorded.loaded, bench.dynamics, file, kept,
    )  # fmt: skip
