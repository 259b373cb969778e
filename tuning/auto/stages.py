"""What the stages of auto hand on to each other; it is never changed, the next stage makes its own of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env.trials.positioning import longer_way
from mechanics.arrays import Floats, Integers, Mask, Texts
from tuning.link_energy import trial_reach

if TYPE_CHECKING:
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import Shown
    from tuning.certificate.certificate import StepResponse
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import AtLeast, MeasuredLoop


@dataclass(frozen=True)
class IdentifiedAxes:
    """What was identified of each axis.

    Attributes:
        found: The identification, None where there was none.
        plants: The axis model made of it, None where that was not possible.
    """

    found: tuple[Identification | None, ...]
    plants: tuple[Plant | None, ...]

    def known(self, axis: int) -> tuple[Plant, Identification]:
        """Return model and identification of an axis that goes on."""
        plant, found = self.plants[axis], self.found[axis]
        assert plant is not None and found is not None, "an axis in the run has both"
        return plant, found


@dataclass(frozen=True)
class Basis:
    """What the search for gains starts from, and what is fallen back on.

    Attributes:
        identified: The axes.
        before: Raw gains of the drives before the run, (num_axes, count).
        reference: Those of the baseline rule, likewise.
        calm: Those that are slow enough for any load, with which what is stopped goes on, likewise.
        unsafe: Why an axis must not be moved with the gains before, "" where it may, (num_axes,).
    """

    identified: IdentifiedAxes
    before: Integers
    reference: Integers
    calm: Integers
    unsafe: Texts

    def held(self) -> tuple[Floats, Floats]:
        """Return the currents that a weight takes, and dry friction at least [A], 0 where not known, (num_axes,)."""
        found = [None if one is None else one.estimates for one in self.identified.found]
        weight = np.array([0.0 if one is None else one["offset"].value for one in found])
        friction = np.array([0.0 if one is None else one["coulomb"].low for one in found])
        return np.nan_to_num(weight), np.maximum(np.nan_to_num(friction), 0.0)

    def trial_reach(self, bench: AutoBench) -> Floats:
        """Return for what reach moves are planned that do not overcharge the DC link [rad], (num_axes,)."""
        motor, plants = bench.target.motor, self.identified.plants
        inertia = np.array([motor.inertia if plant is None else plant.inertia for plant in plants])
        return trial_reach(bench.target, inertia, self.held()[0], longer_way(*bench.room()))


@dataclass(frozen=True)
class RecordedGains:
    """Gains of all axes, and what is known of them: from trials, a move, a frequency response and a load step.

    Attributes:
        gains: Raw, (num_axes, count).
        proof: J by measured terms of their trial, (num_axes,); nan where there is none.
        verified: How they were verified, in words, (num_axes,); "" where they were not.
        cost: Robust cost on the digital twins, (num_axes,); nan where it is not known.
        failed: Of each axis, why its gains cannot stay: it failed the move, or does not come to rest; "" if they can.
        swing: Of its current at rest without the noise of its measurement, over the rated one (RMS), (num_axes,).
        unseen: Of each axis, why it has no usable frequency response; "" where it has one.
        slack: How far the measured loops keep the dynamics, relative, (num_axes,); nan where they were not measured.
        overshoot: Of a step of the set-point in csp, over the step, (num_axes,); nan where none was made.
        kept: Axes that keep the gains before, (num_axes,).
        most: Velocity P halfway to gains that were stopped in a trial, raw, (num_axes,); infinite where none were.
        shown: A recorded move, None if none was made.
        earlier: A recorded move with the gains before, None if none was made.
        response: The velocity loop's, None if none was measured.
        loaded: Response to a load step, of emulated machines.
        margins: Of the outer loops as measured, "velocity" and "position", by axis; nothing where nothing was.
        at_least: Lower bounds of margins that were not measured, likewise.
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
        """Return gains of which nothing is known, (num_axes, count)."""
        n = len(gains)
        unknown, nothing = np.full(n, np.nan), np.full(n, "", object)
        return RecordedGains(
            gains, unknown, nothing, unknown, nothing, np.zeros(n), nothing, unknown, unknown, np.zeros(n, bool),
            np.full(n, np.inf),
        )  # fmt: skip

    def mixed(self, other: RecordedGains, where: Mask) -> RecordedGains:
        """Return this with all that another one has of some axes, (num_axes,)."""
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
