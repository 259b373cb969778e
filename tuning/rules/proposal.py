"""The proposal of a rule: raw integers of the device's gains, the wanted values, and those that no integer reaches."""

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

COARSE = 0.05  # a gain that an integer misses by more than this share is worth a note


class Proposal(NamedTuple):
    """Gains that a rule proposes.

    gains: Raw integers in the order of the device's gain set.
    wanted: Raw value that the rule asked for, by the gain's name, before it became an integer.
    notes: What no integer reaches, and which limits were met; for people.
    """

    gains: tuple[int, ...]
    wanted: Mapping[str, float]
    notes: tuple[str, ...]


Rule = Callable[["Device", "Motor", "Plant"], Proposal]


class Workbench:
    """Turns a rule's controllers into integers, the inner loops first, and returns each integer's real value.

    A rule designs a loop, takes its gains here, and designs the next loop around what it got: the integration time and
    the outer loop follow the bandwidth that is reached, not the one that was wanted.

    Loops are "current", "velocity" and "position", as in a device's gain set.

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
        """Take a proportional gain [V/A, A*s/rad, 1/s] of a loop; return the value after rounding to an integer."""
        return self._take((loop, "P"), value)

    def time(self, loop: str, value: float) -> float:
        """Take an integration time [s], infinite for none, of the current or velocity loop; return it as rounded."""
        inverse = self._take((loop, "I"), 1.0 / value)
        return 1.0 / inverse if inverse else math.inf

    def raw(self, part: Part, value: int) -> float:
        """Take an integer that a rule searched itself; return it in SI, of an I 1/s."""
        self._wanted[self._rows[part].name] = float(value)
        self._raw[part] = value
        return self.si(part, value)

    def si(self, part: Part, value: float) -> float:
        """Return a raw gain in SI units, of an I 1/s."""
        return float(self.scales[part].value(value))

    def row(self, part: Part) -> Gain:
        """Return a gain of the device's set."""
        return self._rows[part]

    def integer(self, part: Part, value: float) -> int:
        """Return the integer of a gain that is nearest to a value [SI], of an I [1/s]; 1 at least."""
        return min(max(round(float(self.scales[part].raw(value))), 1), self._rows[part].highest)

    def note(self, text: str) -> None:
        """Add a note to the proposal."""
        self._notes.append(text)

    def so_far(self, more: Mapping[Part, int] | None = None) -> tuple[int, ...]:
        """Return the gains taken so far, and more, in the device's order; 1 for a gain that is not taken yet."""
        found = self._raw | dict(more or {})
        return tuple(found.get(part, 1) for part in self._rows)

    def proposal(self) -> Proposal:
        """Return the proposal of the gains taken."""
        return Proposal(tuple(self._raw[part] for part in self._rows), dict(self._wanted), tuple(self._notes))

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
