"""The result of auto: the outcome of each axis, and the drive time."""

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
    """The outcome of one axis.

    Attributes:
        before, after: Raw gains, in the order of the device's gain set.
        reason: Why it was rejected; "" if all checks passed, with or without reservations.
        reservations: Checks that were impossible or are close to a limit; with any of them the certificate says
            "accepted with reservations".
        notes: Further remarks.
        identified: The identification; None without one.
        plant: The axis model built from it; None if that was impossible.
        twin: Robust cost on the twin of the gains that were found; nan without any.
        proof: J by measured terms of the accepted gains; nan if none passed a trial.
        verified: How the gains were verified; "" if they were not.
        margins: Measured margins of the outer loops, "velocity" and "position"; empty if not measured.
        at_least: Lower bounds of margins that were not measured, by the same names.
        slack: Relative slack of the measured loops to the dynamics; nan if not measured.
        overshoot: Overshoot of a set-point step in csp, over the step; nan if not made.
        corrections: Replaced gains, in their order.
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
        """Whether all checks passed, with or without reservations."""
        return not self.reason

    @property
    def verdict(self) -> str:
        """The entry of `tuning.certificate.certificate.VERDICTS` that applies to the axis."""
        return verdict(self.accepted, self.reservations)


class Result(NamedTuple):
    """The result of a run of auto: the axes, and what it took.

    drive_seconds, moves, aborts, violations: Counts of each axis, (num_axes,).
    shown: A recorded move with the new gains; None without one.
    earlier: A recorded move with the gains before; None without one.
    response: Frequency response of the velocity loop; None without one.
    loaded: Responses to a load step, of emulated machines.
    dynamics: Requirements on the loops.
    file: The snapshot that restores the state before.
    kept: Whether drives on a bus stored the gains.
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
        """Axes with gains that passed, new ones or those before, shape (num_axes,)."""
        return np.array([axis.accepted for axis in self.axes])


def collect(bench: AutoBench, identified: IdentifiedAxes, recorded: RecordedGains, file: Path, kept: bool) -> Result:
    """Collect the result of a run from the bench and the record of the final gains."""
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
