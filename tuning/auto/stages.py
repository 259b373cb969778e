"""The immutable results of the stages of auto, and that of the run; a stage makes new ones from earlier ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env.trials.positioning import longer_way
from mechanics.arrays import Floats, Integers, Mask, Texts
from tuning.certificate.certificate import verdict
from tuning.lateness import late_first
from tuning.link_energy import trial_reach

if TYPE_CHECKING:
    from drive_env.loops.dynamics import Dynamics
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import Shown
    from tuning.certificate.certificate import Correction, StepResponse
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import AtLeast, MeasuredLoop


@dataclass(frozen=True)
class IdentifiedAxes:
    """The identification of each axis.

    Attributes:
        found: The identification; None without one.
        plants: The axis model built from it; None if that was impossible.
    """

    found: tuple[Identification | None, ...]
    plants: tuple[Plant | None, ...]

    def known(self, axis: int) -> tuple[Plant, Identification]:
        """Return model and identification of an axis in the run."""
        plant, found = self.plants[axis], self.found[axis]
        assert plant is not None and found is not None, "an axis in the run has both"
        return plant, found


@dataclass(frozen=True)
class Basis:
    """The data from which the search for gains starts, with fallback gains.

    Attributes:
        identified: The axes.
        before: Raw gains of the drives before the run, (num_axes, count).
        reference: Gains of the baseline rule, (num_axes, count).
        calm: Gains slow enough for any load, for axes that were stopped, (num_axes, count).
        unsafe: Why an axis must not be moved with the gains before, "" if it may, (num_axes,).
    """

    identified: IdentifiedAxes
    before: Integers
    reference: Integers
    calm: Integers
    unsafe: Texts

    def held(self) -> tuple[Floats, Floats]:
        """Return the current of a weight, and the least current of dry friction [A], 0 if unknown, (num_axes,) each."""
        found = [None if one is None else one.estimates for one in self.identified.found]
        weight = np.array([0.0 if one is None else one["offset"].value for one in found])
        friction = np.array([0.0 if one is None else one["coulomb"].low for one in found])
        return np.nan_to_num(weight), np.maximum(np.nan_to_num(friction), 0.0)

    def trial_reach(self, bench: AutoBench) -> Floats:
        """Return the reach for which to plan moves that do not overcharge the DC link [rad], (num_axes,)."""
        motor, plants = bench.target.motor, self.identified.plants
        inertia = np.array([motor.inertia if plant is None else plant.inertia for plant in plants])
        return trial_reach(bench.target, inertia, self.held()[0], longer_way(*bench.room()))


@dataclass(frozen=True)
class RecordedGains:
    """Gains of all axes, with results of trials, a move, a frequency response and a load step.

    Attributes:
        gains: Raw, (num_axes, count).
        proof: J by measured terms of their trial, (num_axes,); nan without one.
        verified: How they were verified, (num_axes,); "" if they were not.
        cost: Robust cost on the digital twins, (num_axes,); nan if unknown.
        failed: Why the gains of each axis are rejected: a failed move, or no rest; "" if they may stay.
        swing: Current at rest without measurement noise, over the rated one (RMS), (num_axes,).
        unseen: Why each axis has no usable frequency response; "" if it has one.
        slack: Relative slack of the measured loops to the dynamics, (num_axes,); nan if not measured.
        overshoot: Overshoot of a set-point step in csp, over the step, (num_axes,); nan if not made.
        kept: Axes that keep the gains before, (num_axes,).
        most: Velocity P half way to gains that were stopped in a trial, raw, (num_axes,); infinite without any.
        shown: A recorded move; None without one.
        earlier: A recorded move with the gains before; None without one.
        response: Frequency response of the velocity loop; None without one.
        loaded: Responses to a load step, of emulated machines, by axis.
        margins: Measured margins of the outer loops, "velocity" and "position", by axis; empty if not measured.
        at_least: Lower bounds of margins that were not measured, by axis and loop.
    """

    gains: Integers
    proof: Floats
    verified: Texts
    cost: Floats
    failed: Texts
    swing: Floats
    unseen: Texts
    slack: Floats
    overshoot: Floats
    kept: Mask
    most: Floats
    shown: Shown | None = None
    earlier: Shown | None = None
    response: MeasuredLoop | None = None
    loaded: Mapping[int, StepResponse] = field(default_factory=dict)
    margins: Mapping[int, Mapping[str, Margins]] = field(default_factory=dict)
    at_least: Mapping[int, Mapping[str, AtLeast]] = field(default_factory=dict)

    @staticmethod
    def only(gains: Integers) -> RecordedGains:
        """Return a record of gains without any results, (num_axes, count)."""
        n = len(gains)
        unknown, nothing = np.full(n, np.nan), np.full(n, "", object)
        return RecordedGains(
            gains, unknown, nothing, unknown, nothing, np.zeros(n), nothing, unknown, unknown, np.zeros(n, bool),
            np.full(n, np.inf),
        )  # fmt: skip

    def mixed(self, other: RecordedGains, where: Mask) -> RecordedGains:
        """Replace all data of some axes, (num_axes,), by those of another record."""
        names = ("proof", "verified", "cost", "failed", "swing", "unseen", "slack", "overshoot", "kept", "most")
        values: dict[str, Any] = {name: np.where(where, getattr(other, name), getattr(self, name)) for name in names}
        shown, response = self.shown, self.response
        if other.shown is not None:
            moved = other.shown._replace(where=where & other.shown.where)
            shown = moved if shown is None else shown.replaced(moved)
        if other.response is not None:
            response = other.response if response is None else response.replaced(other.response, where)
        loaded = {k: one for k, one in self.loaded.items() if not where[k]}
        loaded |= {k: one for k, one in other.loaded.items() if where[k]}
        gains = np.where(where[:, None], other.gains, self.gains)
        return replace(self, **values, gains=gains, shown=shown, response=response, loaded=loaded)


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
