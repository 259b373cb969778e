"""The result of commissioning a stepper, axis by axis, and its certificate."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drive_env.devices import find_device
from drive_env.trials.open_loop import unmeasured
from mechanics.arrays import Mask
from tuning.certificate.certificate import HASH, STEPPER_FORMAT, verdict
from tuning.runs.inputs import Input, hashes, write_inputs
from tuning.runs.provenance import versions

CERTIFICATE = "stepper-certificate.json"


@dataclass(frozen=True)
class StepperAxis:
    """The result of one axis; figures are None if they were not measured.

    Attributes:
        before, after: Gains by name.
        reason: Why it was rejected; "" if it was accepted.
        reservations: Properties that could not be proved or are close to a limit.
        figures: Measured values by name with unit.
        settings: Objects other than gains, by "index:sub" (hexadecimal): raw values before and after.
    """

    before: dict[str, int]
    after: dict[str, int]
    reason: str
    reservations: tuple[str, ...]
    figures: dict[str, float | None]
    settings: dict[str, dict[str, int]] = field(default_factory=dict)

    @property
    def accepted(self) -> bool:
        """Whether all checks passed, with or without reservations."""
        return not self.reason

    @property
    def verdict(self) -> str:
        """The entry of `tuning.certificate.certificate.VERDICTS` that applies to the axis."""
        return verdict(self.accepted, self.reservations)


@dataclass(frozen=True)
class StepperResult:
    """The result of a run.

    Attributes:
        axes: Results of the target's axes.
        device, motor, machine: Names of what was commissioned.
        speed: Working speed [rad/s].
        drive_seconds: Time that passed on the drives [s].
        file: File with the state before.
        kept: Whether drives on a bus stored the settings.
        numbers: Number of each axis; its index by default.
        inputs: The user's own files, as in `Target`.
        proved_with_load: Whether load and obstacle were put on the axes: only on emulated machines with independent
            axes.
    """

    axes: tuple[StepperAxis, ...]
    device: str
    motor: str
    machine: str
    speed: float
    drive_seconds: float
    file: Path
    kept: bool
    proved_with_load: bool
    numbers: tuple[int, ...] = ()
    inputs: tuple[Input, ...] = ()

    @property
    def accepted(self) -> Mask:
        """Axes that passed, shape (num_axes,)."""
        return np.array([axis.accepted for axis in self.axes])

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values for JSON."""
        return {
            "device": self.device,
            "motor": self.motor,
            "machine": self.machine,
            "working speed [rad/s]": round(self.speed, 4),
            "drive seconds": round(self.drive_seconds, 3),
            "stored": self.kept,
            "load and obstacle tried": self.proved_with_load,
            "not measured": f"current, load step: {unmeasured(find_device(self.device))}; frequency response, margins: "
            "open loop",
            "axes": [
                {
                    "axis": k,
                    "verdict": axis.verdict,
                    "reason": axis.reason,
                    "reservations": list(axis.reservations),
                    "before": axis.before,
                    "after": axis.after,
                    "settings": axis.settings,
                    "figures": axis.figures,
                }
                for k, axis in zip(self.numbers or range(len(self.axes)), self.axes, strict=True)
            ],
            "versions": versions() | hashes(self.inputs),
        }


def figure(value: float) -> float | None:
    """Round a number for the certificate; None for nan, which means not measured."""
    return float(f"{value:.5g}") if math.isfinite(value) else None


@contextmanager
def certificate_file(result: StepperResult, folder: Path) -> Iterator[Path]:
    """Write the certificate with a hash over its content, completely or not at all; remove it if the block fails."""
    from drive_env.whole_file import content_hash, write_whole

    path = folder / CERTIFICATE
    write_inputs(folder, result.inputs)
    content = {"format": STEPPER_FORMAT} | result.as_dict()
    write_whole(path, json.dumps(content | {HASH: content_hash(content)}, indent=1) + "\n")
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise
