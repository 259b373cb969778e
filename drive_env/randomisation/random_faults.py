"""Random faults: the probability that an episode has one, and which, when, for how long and how badly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from drive_env.drives.interface import CYCLE
from drive_env.faults.schedule import Order
from drive_env.faults.table import FAULTS

Range = tuple[float, float]


@dataclass(frozen=True)
class RandomFaults:
    """The distribution of faults in a set of distributions.

    probability: Of an episode that it has a fault, 0...1.
    names: The possible faults, with equal probability.
    at: Earliest and latest begin, from the episode's start [s].
    duration: Shortest and longest [s]; None: until the episode ends.
    ranges: Low and high of a fault's parameter by "fault.parameter"; the others have their defaults.
    """

    probability: float
    names: tuple[str, ...]
    at: Range = (0.0, 1.0)
    duration: Range | None = None
    ranges: Mapping[str, Range] = field(default_factory=dict)

    def draw(self, chance: Callable[[str], float], width: float) -> Order | None:
        """Return the fault of an episode, or None.

        Args:
            chance: Returns the random number 0...1 of a name.
            width: Width of the curriculum, 0...1, by which the probability is multiplied.
        """
        if chance("faults") >= self.probability * width:
            return None
        row = FAULTS[self.names[int(chance("faults.name") * len(self.names))]]
        begin = _cycles(self.at, chance("faults.at"))
        duration = None
        if self.duration is not None and not row.once:
            duration = max(_cycles(self.duration, chance("faults.duration")), CYCLE)
        given = {}
        for key, parameter in row.parameters.items():
            low, high = self.ranges.get(f"{row.name}.{key}", (parameter.default, parameter.default))
            share = chance(f"faults.{row.name}.{key}")
            if isinstance(parameter.default, int):
                given[key] = float(min(int(low + share * (high - low + 1)), int(high)))
            else:
                given[key] = low + share * (high - low)
        return Order(row.name, begin, duration=duration, parameters=given)

    def table(self) -> dict[str, Any]:
        """Return this distribution as a TOML table."""
        found: dict[str, Any] = {"probability": self.probability, "names": list(self.names), "at": list(self.at)}
        if self.duration is not None:
            found["duration"] = list(self.duration)
        return found | ({"ranges": {key: list(ends) for key, ends in self.ranges.items()}} if self.ranges else {})


def check_ranges(where: str, faults: RandomFaults) -> None:
    """Raise ValueError for an impossible probability, time or range."""
    if not 0.0 <= faults.probability <= 1.0:
        raise ValueError(f"{where}: probability must lie in 0...1, not {faults.probability:g}")
    for name, ends in (("at", faults.at), ("duration", faults.duration)):
        if ends is not None and not 0.0 <= ends[0] <= ends[1]:
            raise ValueError(
                f"{where}: {name} must be [shortest, longest] of 0 s or more, not [{ends[0]:g}, {ends[1]:g}]"
            )
    for key, (low, high) in faults.ranges.items():
        name, _, parameter = key.partition(".")
        if name not in faults.names or parameter not in FAULTS[name].parameters:
            known = [f"{one}.{key}" for one in faults.names for key in FAULTS[one].parameters]
            raise ValueError(f"{where}: ranges: there is no {key!r}; there are {', '.join(known) or 'none'}")
        limits = FAULTS[name].parameters[parameter]
        if not limits.low <= low <= high <= limits.high:
            raise ValueError(
                f"{where}: ranges: {key} must be [low, high] within {limits.low:g}...{limits.high:g} {limits.unit}, "
                f"not [{low:g}, {high:g}]"
            )


def _cycles(ends: Range, share: float) -> float:
    """Return a time [s] drawn between two, rounded to whole cycles."""
    return round((ends[0] + share * (ends[1] - ends[0])) / CYCLE) * CYCLE
