"""What the stages of auto hand on to each other; it is never changed, the next stage makes its own of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from tuning.auto.bench import LOOK_BACK_TIME
from tuning.auto.twin import Known, known_of
from tuning.link_energy import trial_reach

if TYPE_CHECKING:
    from drive_env.loops.linear_model import Plant
    from drive_env.loops.margins import Margins
    from tuning.auto.bench import AutoBench
    from tuning.auto.proving import Shown
    from tuning.certificate.certificate import StepResponse
    from tuning.identify.estimate import Identification
    from tuning.response.measured_loop import AtLeast, MeasuredLoop

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class IdentifiedAxes:
    """What was identified of each axis.

    Attributes:
        found: The identification, None where there was none.
        plants: The axis model made of it, None where that was not possible.
    """

    found: tuple[Identification | None, ...]
    plants: tuple[Plant | None, ...]

    @property
    def doubtful(self) -> tuple[bool, ...]:
        """Whether the model of an axis, and so its digital twins, is of an axis as it is not."""
        return tuple(one is not None and bool(one.doubt) for one in self.found)

    def known(self, axis: int) -> tuple[Plant, Identification]:
        """Return model and identification of an axis that goes on."""
        plant, found = self.plants[axis], self.found[axis]
        assert plant is not None and found is not None, "an axis in the run has both"
        return plant, found

    def twins(self, axes: Iterable[int], reach: Floats) -> list[Known]:
        """Return the data of the digital twins of axes; `reach` is how far rotors may turn [rad], (num_axes,)."""
        return [known_of(*self.known(axis), float(reach[axis])) for axis in axes]


@dataclass(frozen=True)
class Basis:
    """What the search for gains starts from, and what is fallen back on.

    Attributes:
        identified: The axes.
        before: Raw gains of the drives before the run, (num_axes, count).
        reference: Those of the baseline rule, likewise.
        fallbacks: What is tried when the twin's gains fail, (3, num_axes, count): the baseline rule's; those before, or
            the soft rule's; and those that are slow enough for any load, with which what is stopped goes on.
        unsafe: Why an axis must not be moved with the gains before, "" where it may.
    """

    identified: IdentifiedAxes
    before: Integers
    reference: Integers
    fallbacks: Integers
    unsafe: tuple[str, ...]

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
        return trial_reach(bench.target, inertia, self.held()[0], bench.reach())

    def look_back_time(self, bench: AutoBench) -> Floats:
        """Return the time that a move with the gains before takes [s], 0 where none is made, (num_axes,)."""
        safe = bench.whole_machines(np.array([not why for why in self.unsafe]))
        return np.where(safe, LOOK_BACK_TIME, 0.0)


@dataclass(frozen=True)
class Candidates:
    """What the search on digital twins found.

    Attributes:
        gains: The best on all twins, raw, (num_axes, count).
        others: The best for the axis exactly as identified, and for less friction, (2, num_axes, count).
        cost: Robust cost of the best on all twins, (num_axes,); nan where nothing was searched.
    """

    gains: Integers
    others: Integers
    cost: Floats


@dataclass(frozen=True)
class TriedGains:
    """What trials on the drives left of the gains that were found.

    Attributes:
        gains: The best, raw, (num_axes, count).
        spare: The second best that passed a trial, likewise; zeros where none did.
        proof: J by measured terms of the best, (num_axes,); nan where there is none.
        verified: How they were verified, in words; "" where they were not.
        cost: Robust cost on digital twins of what was found on these, (num_axes,); nan where nothing was.
    """

    gains: Integers
    spare: Integers
    proof: Floats
    verified: tuple[str, ...]
    cost: Floats

    @staticmethod
    def only(gains: Integers) -> TriedGains:
        """Return gains of which nothing is known, (num_axes, count)."""
        n = len(gains)
        return TriedGains(gains, np.zeros_like(gains), np.full(n, np.nan), ("",) * n, np.full(n, np.nan))

    def with_gains(self, axis: int, gains: Integers) -> Self:
        """Return this with other gains of an axis, shape (count,), beside which nothing is second best."""
        here = (np.arange(len(self.gains)) == axis)[:, None]
        return replace(self, gains=np.where(here, gains, self.gains), spare=np.where(here, 0, self.spare))


@dataclass(frozen=True)
class RuleTried:
    """What the baseline rule's gains have shown in the same trial and move as those found.

    Attributes:
        gains: The rule's, or lower ones where an axis did not pass with these, (num_axes, count).
        lowered: Where that is so, (num_axes,).
        where: Axes on which they were tried, (num_axes,).
        passed: Axes on whose machines they passed, stood at rest and are not too near to instability, (num_axes,).
        cost: J by measured terms of the trial, (num_axes,).
    """

    gains: Integers
    lowered: Mask
    where: Mask
    passed: Mask
    cost: Floats

    def title(self, axis: int) -> str:
        """Return what messages call the gains of an axis."""
        return f"the gains of the baseline rule{', lowered,' if self.lowered[axis] else ''}"


@dataclass(frozen=True)
class RecordedGains(TriedGains):
    """What moves and frequency responses showed of the gains, which were lowered where they had to be.

    Attributes:
        shown: A recorded move with the gains, None if none was made.
        eased: How often the gains of an axis were lowered because it shook at rest, (num_axes,).
        response: The velocity loop's, None if none was measured.
        unseen: Axes without a usable frequency response, (num_axes,).
        proven: The gains whose trial `proof` is of, (num_axes, count).
        rule: What the baseline rule's gains have shown, None where they were not tried.
        earlier: A recorded move with the gains before, None if none was made.
        kept: Axes that keep the gains before, which were better, (num_axes,).
        won: Axes whose gains, found on twins, were better than the rule's on the drive and on the twins, (num_axes,).
        loaded: Response to a load step, of emulated machines, by axis.
    """

    shown: Shown | None
    eased: Integers
    response: MeasuredLoop | None
    unseen: Mask
    proven: Integers
    rule: RuleTried | None = None
    earlier: Shown | None = None
    kept: Mask = field(default_factory=lambda: np.zeros(0, bool))
    won: Mask = field(default_factory=lambda: np.zeros(0, bool))
    loaded: Mapping[int, StepResponse] = field(default_factory=dict)

    @classmethod
    def of(cls, tried: TriedGains) -> RecordedGains:
        """Return gains that were tried, and nothing recorded yet."""
        known = {one.name: getattr(tried, one.name) for one in fields(TriedGains)}
        n = len(tried.gains)
        none = np.zeros(n, bool)
        eased = np.zeros(n, np.int64)
        return cls(
            **known, shown=None, eased=eased, response=None, unseen=none, proven=tried.gains, kept=none, won=none
        )

    def with_move(self, shown: Shown) -> RecordedGains:
        """Return this with a later move of some axes in place of theirs."""
        return replace(self, shown=shown if self.shown is None else self.shown.replaced(shown))


@dataclass(frozen=True)
class Verdict:
    """What the final gains are worth, by axis.

    Attributes:
        margins: Of the outer loops as measured, "velocity" and "position"; nothing where nothing was.
        at_least: Lower bounds of margins that were not measured, likewise.
        verified: How the gains were verified, in words; "" where they were not.
    """

    margins: tuple[Mapping[str, Margins], ...]
    at_least: tuple[Mapping[str, AtLeast], ...]
    verified: tuple[str, ...]
