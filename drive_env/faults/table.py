"""The table of faults: names, parameters, and the reactions of drive and master."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

OWN = "servo"  # the firmware whose reactions the rows describe
STEPS = {
    "end": "Remove the cause",
    "start_node": "Start the node (NMT)",
    "reset_node": "Reset the node, which aligns the commutation",
    "reset_fault": "Reset the fault",
    "home": "Home again: counts are wrong",
}
GROUPS = ("sensor", "motor", "supply", "load", "bus", "node")


@dataclass(frozen=True)
class FaultParameter:
    """A parameter of a fault: default, lowest and highest value, unit, and meaning."""

    default: float
    low: float
    high: float
    unit: str
    meaning: str

    @property
    def range(self) -> str:
        """Range of allowed values as text; a share (unit "1") is given without unit."""
        return f"{self.low:g} to {self.high:g}" + ("" if self.unit == "1" else f" {self.unit}")


@dataclass(frozen=True)
class FaultRow:
    """A fault; table.toml explains each field. `emergency` is None if the drive does not detect the fault.

    The reaction described is that of `OWN` firmware; `on_firmware` returns that of another.
    """

    name: str
    group: str
    title: str
    physics: str
    drive: str
    master: str
    test: str
    recovery: str = ""
    emergency: int | None = None
    detection: float | None = None
    once: bool = False
    parameters: Mapping[str, FaultParameter] = field(default_factory=dict)
    steps: Sequence[str] = ("end", "reset_fault")
    on: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def way_back(self) -> str:
        """The steps that end the fault, as sentences, followed by `recovery`."""
        return " ".join([*(f"{STEPS[step]}." for step in self.steps), self.recovery]).strip()

    def on_firmware(self, name: str) -> FaultRow | None:
        """Return the row with the reaction of another firmware; None if the table has no reaction for it."""
        if name == OWN:
            return self
        if name not in self.on:
            return None
        found = replace(self, **self.on[name])
        return replace(found, emergency=found.emergency or None)


def _rows() -> dict[str, FaultRow]:
    tables = read_toml(Path(__file__).parent / "table.toml")
    return {
        name: FaultRow(
            name, **{**table, "parameters": {k: FaultParameter(**p) for k, p in table.get("parameters", {}).items()}}
        )
        for name, table in tables.items()
    }


FAULTS = _rows()


def find_fault(name: str) -> FaultRow:
    """Look up the row of a fault.

    Raises:
        ValueError: If the name is unknown; the message lists the known ones.
    """
    if name not in FAULTS:
        raise ValueError(f"no fault is named {name!r}; there are {', '.join(FAULTS)}{did_you_mean(name, FAULTS)}")
    return FAULTS[name]


def names_of(chosen: str) -> tuple[str, ...]:
    """Return the names of a group's faults, or the one fault of that name.

    Raises:
        ValueError: If it is neither a group nor a fault.
    """
    if chosen in GROUPS:
        return tuple(row.name for row in FAULTS.values() if row.group == chosen)
    if chosen not in FAULTS:
        known = (*GROUPS, *FAULTS)
        raise ValueError(
            f"no fault or group is named {chosen!r}; there are {', '.join(known)}{did_you_mean(chosen, known)}"
        )
    return (chosen,)


def checked_parameters(row: FaultRow, given: Mapping[str, float]) -> dict[str, float]:
    """Check parameters of a fault and fill in defaults.

    Raises:
        ValueError: If the fault has no such parameter, or a value is outside its range.
    """
    for name, value in given.items():
        if name not in row.parameters:
            known = ", ".join(row.parameters) or "none"
            raise ValueError(f"fault {row.name} has no parameter {name!r}; it has {known}")
        limits = row.parameters[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"fault {row.name}: {name} must be a finite number, not {value!r}")
        if not limits.low <= value <= limits.high:
            raise ValueError(f"fault {row.name}: {name}={value:g} must be {limits.range}")
        if isinstance(limits.default, int) and value != int(value):
            raise ValueError(f"fault {row.name}: {name}={value:g} must be a whole number")
    return {name: float(given.get(name, limits.default)) for name, limits in row.parameters.items()}
