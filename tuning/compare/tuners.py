"""The tuners by name: each finds gains for a target by using its drives only.

A foreign tuner, for example a trained agent, registers in the entry-point group `drive_env.tuners`: a function of a
`Target` and a random generator that returns an `Outcome`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env.devices.gains import has_linear_model
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.dynamics import DEFAULT
from mechanics.arrays import Integers
from tuning.outcome import Outcome, Tuner
from tuning.search.optimise import Settings, optimise
from tuning.search.samplers import check_installed
from tuning.search.trial_bench import TrialBench
from tuning.target import Target, timed

if TYPE_CHECKING:
    from drive_env.loops.linear_model import Plant
    from tuning.rules.proposal import Proposal

ENTRY_POINTS = "drive_env.tuners"


class TunerKind(NamedTuple):
    """A tuner of the registry: its name, a line of description, and its factory.

    slow: Runs only if it is named.
    searches: `make` takes the number of trials.
    asked: `make` takes the dynamics, and the tuner keeps them.
    """

    name: str
    meaning: str
    make: Callable[..., Tuner]
    slow: bool = False
    searches: bool = False
    asked: bool = False


class MissingTunerError(ValueError):
    """The tuner does not exist, or lacks a package; the message has the remedy."""


def tuner_rows() -> dict[str, TunerKind]:
    """Return tuners by name: our own, rules, and those of other packages; MissingTunerError for a name used twice."""
    rows = {row.name: row for row in _OWN}
    rows |= {name: TunerKind(name, f"rule {name}", partial(RuleTuner, name)) for name in _rules()}
    rows |= {row.name: row for row in _AFTER}
    for entry in sorted(importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        distribution = entry.dist.name if entry.dist else "an unknown package"
        if entry.name in rows:
            raise MissingTunerError(
                f"{distribution} registers a tuner {entry.name!r}, and there is one of that name; rename it or "
                f"uninstall {distribution}"
            )
        rows[entry.name] = TunerKind(entry.name, f"from {distribution}", partial(_load, entry))
    return rows


def find_tuner(name: str, trials: int | None = None, dynamics: str = DEFAULT) -> Tuner:
    """Look up a tuner by name.

    Args:
        name: Name of the tuner.
        trials: Number of trials of a search; its own number by default. Ignored for tuners without search.
        dynamics: Requirements on the loops, for tuners that accept them.

    Raises:
        MissingTunerError: For an unknown name, listing the known ones, or a missing package.
    """
    rows = tuner_rows()
    if name not in rows:
        raise MissingTunerError(f"no tuner is named {name!r}; there are {', '.join(rows)}")
    row = rows[name]
    options: dict[str, Any] = {"dynamics": dynamics} if row.asked else {}
    if row.searches and trials is not None:
        options["trials"] = trials
    return row.make(**options)


# --- tuners without a search ------------------------------------------------------------------------------------------
def _factory(target: Target, rng: np.random.Generator) -> Outcome:
    """Keep the gains that the drive was commissioned with."""
    return _outcome(target, read_gains(target.drives))


def _baseline(target: Target, rng: np.random.Generator) -> Outcome:
    """Write the baseline rule's gains for the inertia that is identified in two moves."""
    with timed(target) as (watched, clock):
        bench = TrialBench(watched)
        bench.identify()
        bench.leave(bench.rule)
    return _outcome(target, bench.rule, clock.seconds, moves=bench.moves)


class RuleTuner:
    """A rule of `tuning.rules.rules_by_name` as a tuner: identify, compute, write.

    The identification does not depend on the rule: for several rules on the same machines, identify once and call
    `propose` of each.
    """

    def __init__(self, name: str) -> None:
        self._rule = _rules()[name]

    def __call__(self, target: Target, rng: np.random.Generator) -> Outcome:
        """Tune a target."""
        before = read_gains(target.drives)
        plants, seconds = identify_all(target)
        outcome = self.propose(target, plants, before, seconds)
        write_gains(target.drives, outcome.gains)
        return outcome

    def propose(self, target: Target, plants: Sequence[Plant | str], before: Integers, seconds: float = 0.0) -> Outcome:
        """Compute gains for axes' models; an axis without a model keeps its gains, and its note has the reason."""
        gains, notes = before.copy(), []
        for axis, plant in enumerate(plants):
            if isinstance(plant, str):
                notes.append(f"no proposal: {plant}")
                continue
            proposal = self._rule(target.device, target.motor, plant)
            gains[axis] = proposal.gains
            notes.append("; ".join(proposal.notes))
        return _outcome(target, gains, seconds, notes=tuple(notes))


def identify_all(target: Target) -> tuple[list[Plant | str], float]:
    """Identify a target; return the models of its axes as in `identified_plants`, and the drive time [s]."""
    from tuning.compare.side_by_side import identified_plants

    with timed(target) as (watched, clock):
        _, plants = identified_plants(watched, lambda what, share: None)
    return plants, clock.seconds


def _rules() -> Mapping[str, Callable[..., Proposal]]:
    from tuning.rules.rules_by_name import RULES

    return RULES


def _auto(dynamics: str) -> Tuner:
    return partial(importlib.import_module("tuning.auto.one_button").tune, dynamics=dynamics)


# --- searches ---------------------------------------------------------------------------------------------------------
def search_tuner(target: Target, rng: np.random.Generator, dynamics: str | None = None, **settings: Any) -> Outcome:
    """Search gains by trials that keep the dynamics by the model, of drives with a linear one.

    `settings` are fields of `optimise.Settings`.
    """
    kept = dynamics if has_linear_model(target.device) else None
    found = optimise(target, Settings(seed=int(rng.integers(2**31)), dynamics=kept, **settings))
    notes = tuple(note for note in found.notes for _ in range(target.axes_per_machine))
    return _outcome(target, found.gains, found.drive_seconds, moves=found.moves, aborts=found.aborts, notes=notes)


def _search(sampler: str, trials: int, safe: bool = False, dynamics: str = DEFAULT) -> Tuner:
    try:
        check_installed(sampler)
    except ValueError as error:
        raise MissingTunerError(str(error)) from None
    return partial(search_tuner, sampler=sampler, trials=trials, safe=safe, dynamics=dynamics)


def _searching(name: str, meaning: str, sampler: str, trials: int, safe: bool = False) -> TunerKind:
    """Return the row of a search."""
    make = partial(_search, sampler, trials=trials, safe=safe)
    return TunerKind(name, meaning, make, searches=True, asked=True)


def _load(entry: importlib.metadata.EntryPoint) -> Tuner:
    try:
        found: Tuner = entry.load()
    except Exception as error:  # a foreign module may raise anything when it is imported
        raise MissingTunerError(f"the tuner {entry.name!r} of {entry.value} cannot be loaded: {error}") from error
    if not callable(found):
        raise MissingTunerError(f"the tuner {entry.name!r} of {entry.value} is not a function but {found!r}")
    return found


_OWN = (
    TunerKind("factory", "the gains of the motor's commissioning preset", lambda: _factory),
    TunerKind("baseline", "the baseline rule, with the inertia measured in two moves", lambda: _baseline),
)
_AFTER = (
    TunerKind("auto", "drive-tune auto: identify, design on twins, try, verify, correct", _auto, asked=True),
    _searching("random", "20 trials drawn at random", "random", 20),
    _searching("grid", "the baseline rule and a grid of 27 trials", "grid", 28)._replace(searches=False),
    _searching("tpe", "20 trials by tree-structured Parzen estimators", "tpe", 20),
    _searching("tpe-safe", "20 trials by TPE from safe gains, in small steps", "tpe", 20, safe=True),
    _searching("cmaes", "20 trials by CMA-ES", "cmaes", 20),
    _searching("gp", "12 trials by a Gaussian process", "gp", 12)._replace(slow=True),
    _searching("gp-safe", "12 trials by a Gaussian process from safe gains, in small steps", "gp", 12,
               safe=True)._replace(slow=True),
)  # fmt: skip


def _outcome(target: Target, gains: Integers, seconds: float = 0.0, **counted: Any) -> Outcome:
    """Return an outcome with gains, drive time and the given counts; all other counts are 0."""
    count = target.num_axes
    rest = dict.fromkeys(("moves", "aborts", "violations"), np.zeros(count, np.int64)) | {"notes": ("",) * count}
    return Outcome(gains, np.full(count, seconds), **(rest | counted))
