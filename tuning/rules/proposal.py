"""The proposal of a rule: raw integers of the device's gains, the wanted values, and notes on those that differ."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from drive_env.devices.gains import Part, check_linear_model, si_scales

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gain_set import Gain
    from drive_env.loops.linear_model import Plant
    from drive_env.motors import Motor

COARSE = 0.05  # relative rounding error of a gain from which on a note is added


class Proposal(NamedTuple):
    """Gains that a rule proposes.

    gains: Raw integers in the order of the device's gain set.
    wanted: Unrounded raw value of the rule by the gain's name.
    notes: Values that no integer represents well, and limits that were reached; for users.
    """

    gains: tuple[int, ...]
    wanted: Mapping[str, float]
    notes: tuple[str, ...]


Rule = Callable[["Device", "Motor", "Plant"], Proposal]


class Workbench:
    """Converts a rule's controllers to integers, the inner loops first, and returns each rounded gain in SI units.

    A rule designs a loop, rounds its gains here, and designs the next loop around the rounded one: integration time and
    outer loop follow the bandwidth that was reached, not the wanted one.

    Loop names are "current", "velocity" and "position", as in a device's gain set.

    Args:
        device: The drive.
        plant: The axis.

    Raises:
        ValueError: If the drive has no linear model of its loops.
    """

    def __init__(self, device: Device, plant: Plant) -> None:
        check_linear_model(device)
        self._rows = {(row.loop, row.part): row for row in device.gains.rows}
        self.scales = si_scales(device, plant.supply)
        self._wanted: dict[str, float] = {}
        self._raw: dict[Part, int] = {}
        self._notes: list[str] = []

    def p(self, loop: str, value: float) -> float:
        """Set a proportional gain [V/A, A*s/rad, 1/s] of a loop; return its rounded value."""
        return self._take((loop, "P"), value)

    def time(self, loop: str, value: float) -> float:
        """Set an integration time [s] of the current or velocity loop, infinity for none; return its rounded value."""
        inverse = self._take((loop, "I"), 1.0 / value)
        return 1.0 / inverse if inverse else math.inf

    def raw(self, part: Part, value: int) -> float:
        """Set a gain to an integer that the rule has found itself; return the gain in SI units, an I gain in 1/s."""
        self._wanted[self._rows[part].name] = float(value)
        self._raw[part] = value
        return self.si(part, value)

    def si(self, part: Part, value: float) -> float:
        """Convert a raw gain to SI units, an I gain to 1/s."""
        return float(self.scales[part].value(value))

    def row(self, part: Part) -> Gain:
        """Return a gain of the device's set."""
        return self._rows[part]

    def integer(self, part: Part, value: float) -> int:
        """Convert a value [SI, an I gain in 1/s] to the nearest integer of a gain, at least 1."""
        return min(max(round(float(self.scales[part].raw(value))), 1), self._rows[part].highest)

    def note(self, text: str) -> None:
        """Add a note to the proposal."""
        self._notes.append(text)

    def so_far(self, more: Mapping[Part, int] | None = None) -> tuple[int, ...]:
        """Return the gains set so far, overridden by `more`, in the device's order; the lowest value for others."""
        found = self._raw | dict(more or {})
        return tuple(found.get(part, row.lowest) for part, row in self._rows.items())

    def proposal(self) -> Proposal:
        """Return the proposal with the gains set so far."""
        return Proposal(self.so_far(), dict(self._wanted), tuple(self._notes))

    def _take(self, part: Part, value: float) -> float:
        gain, wanted = self._rows[part], float(self.scales[part].raw(value))
        self._wanted[gain.name] = wanted
        raw = 0 if wanted == 0.0 else self.integer(part, value)
        self._raw[part] = raw
        title, highest = gain.title, gain.highest
        if wanted > highest + 0.5:
            self.note(
                f"{title} would have to be {wanted:.0f}, and no integer above {highest} exists: "
                f"{100.0 * highest / wanted:.0f} % of it is reached"
            )
        elif 0.0 < wanted < 0.5:
            self.note(f"{title} would have to be {wanted:.2g}, and 1 is the least: {1.0 / wanted:.1f} times as much")
        elif raw and abs(raw / wanted - 1.0) > COARSE:
            self.note(f"{title} would have to be {wanted:.2f}; no integer comes nearer than {raw}, "
                      f"{100.0 * abs(raw / wanted - 1.0):.0f} % off")  # fmt: skip
        return float(self.scales[part].value(raw))
