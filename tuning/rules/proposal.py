"""What a rule proposes: raw integers of the cascade, what was wanted, and what no integer reaches."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from drive_env.dictionary.units import RPM
from drive_env.gains import RAW_MAX, Gains

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.motors import Motor
    from tuning.response.linear_model import Plant

COARSE = 0.05  # a gain that an integer misses by more than this share is worth a note


class Proposal(NamedTuple):
    """Gains that a rule proposes.

    gains: Raw integers.
    wanted: Raw value that the rule asked for, by the gain's name, before it became an integer.
    notes: What no integer reaches, and which limits were met; for people.
    """

    gains: Gains
    wanted: Mapping[str, float]
    notes: tuple[str, ...]


Rule = Callable[["Device", "Motor", "Plant"], Proposal]


class Workbench:
    """Turns a rule's controllers into integers, the inner loops first, and tells what each integer really is.

    A rule designs a loop, takes its gains here, and designs the next loop around what it got: the integration time and
    the outer loop follow the bandwidth that is reached, not the one that was wanted.

    Args:
        device: The drive.
        plant: The axis.
    """

    def __init__(self, device: Device, plant: Plant) -> None:
        self._titles = dict(zip(device.gains.names, device.gains.titles, strict=True))
        per_ampere = 256.0 * device.current_full_scale / plant.supply  # Q8.8, duty of the supply per full scale
        self._raw_per_si = {
            "torque_p": per_ampere,  # V/A
            "torque_i": 65536.0 / device.current_rate,  # 1/s, of the integration time's inverse
            "velocity_p": 256.0 * RPM * 32768.0 / device.current_full_scale,  # A*s/rad
            "velocity_i": 65536.0 / device.velocity_rate,  # 1/s
            "position_p": 4096.0 * 2.0 * math.pi / 65536.0 / RPM,  # 1/s
        }
        self._wanted: dict[str, float] = {}
        self._raw: dict[str, int] = {}
        self._notes: list[str] = []

    def p(self, loop: str, value: float) -> float:
        """Take a proportional gain [V/A, A*s/rad, 1/s] of "torque", "velocity" or "position"; return what it became."""
        return self._take(f"{loop}_p", value)

    def time(self, loop: str, value: float) -> float:
        """Take an integration time [s], infinite for none, of "torque" or "velocity"; return what it became."""
        inverse = self._take(f"{loop}_i", 1.0 / value)
        return 1.0 / inverse if inverse else math.inf

    def raw(self, name: str, value: int) -> float:
        """Take an integer that a rule searched itself; return it in SI, of an I 1/s."""
        self._wanted[name] = float(value)
        self._raw[name] = value
        return value / self._raw_per_si[name]

    def si(self, name: str, value: float) -> float:
        """Return what a raw gain means in SI, of an I 1/s."""
        return value / self._raw_per_si[name]

    def note(self, text: str) -> None:
        """Say something to whoever reads the proposal."""
        self._notes.append(text)

    def proposal(self) -> Proposal:
        """Return what was taken."""
        return Proposal(Gains(**self._raw), dict(self._wanted), tuple(self._notes))

    def _take(self, name: str, value: float) -> float:
        wanted = value * self._raw_per_si[name]
        self._wanted[name] = wanted
        raw = 0 if wanted == 0.0 else min(max(round(wanted), 1), RAW_MAX)
        self._raw[name] = raw
        title = self._titles[name]
        if wanted > RAW_MAX + 0.5:
            self.note(
                f"{title} would have to be {wanted:.0f}, and no integer above {RAW_MAX} exists: "
                f"{100.0 * RAW_MAX / wanted:.0f} % of it is reached"
            )
        elif 0.0 < wanted < 0.5:
            self.note(f"{title} would have to be {wanted:.2g}, and 1 is the least: {1.0 / wanted:.1f} times as much")
        elif raw and abs(raw / wanted - 1.0) > COARSE:
            self.note(f"{title} would have to be {wanted:.2f}; no integer comes nearer than {raw}, "
                      f"{100.0 * abs(raw / wanted - 1.0):.0f} % off")  # fmt: skip
        return raw / self._raw_per_si[name]
