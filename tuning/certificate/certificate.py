"""The certificate of a tuning: identified values, changes and measurements, with a hash that shows later changes.

The hash is over the content, not the file: other indentation or order of keys gives the same hash. It detects
accidental changes; it is not a signature.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.roles import Role
from drive_env.drives.currents import read_current_limit
from drive_env.whole_file import content_hash
from mechanics.arrays import Floats

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gain_set import Gain
    from drive_env.loops.margins import Margins
    from drive_env.motors import Motor
    from tuning.identify.identified_axis import Identification
    from tuning.response.measured_loop import AtLeast
    from tuning.target import Target

FORMAT = 3
STEPPER_FORMAT = "stepper 1"  # of stepper-certificate.json, written by tuning/stepper/result.py
HASH = "sha256"


VERDICTS = ("accepted", "accepted with reservations", "rejected")


def verdict(accepted: bool, reservations: Sequence[str]) -> str:
    """Return the entry of `VERDICTS` that applies to an axis."""
    return VERDICTS[2] if not accepted else VERDICTS[1] if reservations else VERDICTS[0]


class CertificateError(ValueError):
    """The file is not a certificate; the message has the remedy."""


@dataclass(frozen=True)
class StepResponse:
    """A recorded move of one axis.

    Attributes:
        name: Name of the move, e.g. "velocity step 500 rpm" or "reversal".
        tuned: True if recorded with the new gains, False with those before.
        unit: Unit of `reference` and `actual`.
        t: Sample times [s], shape (n,).
        reference, actual: Set-point and actual value, shape (n,).
        current: Actual current [A, peak i_q], shape (n,).
        figures: Results: name with unit, e.g. "settling [s]", "overshoot [%]", "greatest dip [turns]" -> value; nan for
            one that does not apply. Disturbances exist in the emulator only.
    """

    name: str
    tuned: bool
    unit: str
    t: Floats
    reference: Floats
    actual: Floats
    current: Floats
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FrequencyResponse:
    """The frequency response of an open loop of one axis.

    Attributes:
        name: Name of the loop, e.g. "velocity loop".
        tuned: True if measured with the new gains, False with those before.
        frequency: Frequencies [Hz], shape (n,).
        magnitude_db, phase_deg: Measured open loop, shape (n,).
        coherence: 0 to 1, shape (n,); nan for values of a model.
        margins: Results: name with unit, e.g. "phase margin [deg]" -> value.
        source: Origin of the data, e.g. "multisine over the bus" or "the emulator's trace".
    """

    name: str
    tuned: bool
    frequency: Floats
    magnitude_db: Floats
    phase_deg: Floats
    coherence: Floats
    margins: Mapping[str, float] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True)
class StatedParameter:
    """An identified value with its 95 % confidence interval; nan with the reason if it was not identified."""

    value: float
    low: float
    high: float
    unit: str
    reason: str = ""


KEPT, NEARLY_KEPT, NOT_KEPT, NOT_MEASURED = (
    "kept", "kept within the error of the measurement", "not kept", "not measured",
)  # fmt: skip
SEEN_KEPT = "kept where it was measured"  # a peak may lie where it was not measured


@dataclass(frozen=True)
class Requirement:
    """A requirement of the dynamics, and the value that the axis has.

    Attributes:
        name: Name with unit, e.g. "velocity loop, phase margin [deg]".
        asked: The limit: greatest value for Ms and overshoot, least value for all others.
        found: Measured value; nan if not measured.
        is_bound: True if `found` is a lower bound computed with a model, not a measurement.
        kept: One of `KEPT`, `NEARLY_KEPT`, `SEEN_KEPT`, `NOT_KEPT` and `NOT_MEASURED`.
    """

    name: str
    asked: float
    found: float
    is_bound: bool
    kept: str


TAKEN = "taken"


@dataclass(frozen=True)
class Correction:
    """Gains that were replaced because the drive did not behave as designed.

    Attributes:
        old, new: Raw integers in the order of the device's gain set.
        reason: Behaviour of the drive with the old gains.
        outcome: Result of the new gains; `TAKEN` if they stay.
    """

    old: tuple[int, ...]
    new: tuple[int, ...]
    reason: str
    outcome: str


@dataclass(frozen=True)
class AxisCertificate:
    """The result of one axis.

    Attributes:
        axis: Number of the axis.
        accepted: True if the new gains passed the checks and are in the drive; otherwise it has those before.
        reason: Why it was rejected, or how it was verified; never empty.
        reservations: Properties that could not be checked or are close to a limit.
        identified: Name -> parameter.
        before, after: Raw integers in the order of the device's gain set, of the drive before and now.
        before_si, after_si: The same in SI units, as returned by `si_gains`: name with unit -> value.
        steps: Recorded moves.
        frequency_responses: Open loops.
        dynamics: Name of the requested dynamics, or their numbers.
        requirements: Requirements of these dynamics, and whether they are kept.
        figures: The `CROSSOVERS` of the loops; nan without a crossover.
        corrections: Replaced gains in their order, with reasons.
        notes: Gains limited by the range of integers, other limits reached, and omitted steps.
        hardware_seconds: Time that passed on the drive [s].
        aborts: Number of stopped trials.
    """

    axis: int
    accepted: bool
    reason: str
    reservations: tuple[str, ...]
    identified: Mapping[str, StatedParameter]
    before: tuple[int, ...]
    after: tuple[int, ...]
    before_si: Mapping[str, float]
    after_si: Mapping[str, float]
    steps: tuple[StepResponse, ...] = ()
    frequency_responses: tuple[FrequencyResponse, ...] = ()
    dynamics: str = ""
    requirements: tuple[Requirement, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    corrections: tuple[Correction, ...] = ()
    notes: tuple[str, ...] = ()
    hardware_seconds: float = 0.0
    aborts: int = 0

    @property
    def verdict(self) -> str:
        """The entry of `VERDICTS` that applies to the axis."""
        return verdict(self.accepted, self.reservations)


@dataclass(frozen=True)
class Certificate:
    """A tuning of one or several axes.

    Attributes:
        tuner: Name of the tuner, e.g. "auto".
        device, motor: Their names.
        machine: The emulated load's name, or the bus and its node-IDs.
        supply: Supply voltage as entered [V].
        seed: Seed of everything random.
        envelope: Limits during the tuning: name with unit -> value, e.g. "speed [rad/s]", "travel low [rad]".
        axes: One entry per axis.
        versions: Versions of the packages used, and the hash of each of the user's files.
        created: Date and time of creation [ISO 8601, UTC].
    """

    tuner: str
    device: str
    motor: str
    machine: str
    supply: float
    seed: int
    envelope: Mapping[str, float]
    axes: tuple[AxisCertificate, ...]
    versions: Mapping[str, str]
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def content(self) -> dict[str, Any]:
        """Return the certificate as plain JSON values, without its hash; nan becomes null, infinity a text."""
        found: dict[str, Any] = _plain(self)
        return {"format": FORMAT} | found

    def hash(self) -> str:
        """Return the hash over the content."""
        return content_hash(self.content())

    def to_json(self) -> str:
        """Return the text of the file."""
        return json.dumps(self.content() | {HASH: self.hash()}, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


# --- parts of a certificate from the results of tuners ----------------------------------------------------------------
SI_UNITS = {  # of a gain by its loop and part, in the order of `SiGains`
    ("current", "P"): "V/A",
    ("current", "I"): "s",
    ("velocity", "P"): "A*s/rad",
    ("velocity", "I"): "s",
    ("position", "P"): "1/s",
}
CROSSOVERS = (
    "crossover of the current loop, as designed [Hz]",
    "crossover of the velocity loop, as measured [Hz]",
    "crossover of the position loop, as measured [Hz]",
    "crossover of the position loop over that of the velocity loop",
)
MARGIN_NAMES = {
    "phase_deg": "phase margin [deg]",
    "gain_db": "gain margin [dB]",
    "crossover_hz": "crossover [Hz]",
    "bandwidth_hz": "bandwidth [Hz]",
    "ms": "Ms",
    "phase_hz": "phase margin at [Hz]",
    "gain_hz": "gain margin at [Hz]",
}


def identified(identification: Identification, motor: Motor) -> dict[str, StatedParameter]:
    """Return the identified parameters for a certificate, without assumed values, and the load's inertia ratio.

    The ratio is the identified total inertia less the rotor's, over the rotor's by its data sheet.
    """
    told = identification.estimates if identification.told is None else identification.told
    found = {name: StatedParameter(*estimate) for name, estimate in told.items()}
    if (total := found.get("inertia")) is not None:
        # A measurement error may make the total less than the rotor's.
        value, low, high = (
            float(np.maximum(J / motor.inertia - 1.0, 0.0)) for J in (total.value, total.low, total.high)
        )
        found["inertia_ratio"] = StatedParameter(value, low, high, "1", total.reason)
    return found


def si_gains(device: Device, supply: float, gains: Iterable[int]) -> dict[str, float]:
    """Convert gains of a device's set to SI units, with the units in the names; empty without a PI cascade.

    An I gain is given as its integration time T_i.
    """
    from drive_env.devices.gains import PI, gains_in_si

    if device.gains.cascade != PI:
        return {}
    found = dict(zip(SI_UNITS, gains_in_si(device, supply, tuple(map(int, gains))), strict=True))
    parts = {(gain.loop, gain.part): gain for gain in device.gains.rows}
    return {_si_name(gain): found[part] for part, gain in parts.items() if part in found}


def _si_name(gain: Gain) -> str:
    what = gain.title if gain.part == "P" else f"{gain.title.removesuffix(' I')} T_i"
    return f"{what} [{SI_UNITS[gain.loop, gain.part]}]"


def envelope(target: Target) -> dict[str, float]:
    """Return the limits of a target for each axis."""
    rows = {
        "travel low [rad]": target.low,
        "travel high [rad]": target.high,
        "speed during identification [rad/s]": np.full(target.num_axes, target.speed),
        "current during identification [A]": np.full(target.num_axes, target.current),
    }
    if (limit := target.device.roles.get(Role.CURRENT_LIMIT)) is not None:
        rows[f"current in moves, {limit[0]:04X}h [A]"] = read_current_limit(target.drives)
    names = [""] if target.num_axes == 1 else [f"axis {axis}: " for axis in range(target.num_axes)]
    return {f"{name}{what}": float(row[axis]) for axis, name in enumerate(names) for what, row in rows.items()}


def frequency_response(
    name: str,
    f: ArrayLike,
    open_loop: ArrayLike,
    margins: Margins,
    *,
    tuned: bool,
    at_least: AtLeast | None = None,
    coherence: ArrayLike | None = None,
    source: str = "",
) -> FrequencyResponse:
    """Return the frequency response of an open loop for a certificate.

    `open_loop` is complex, shape (n,), at the frequencies `f` [Hz]; nan means not measured. `at_least` has lower bounds
    of margins that were not measured.
    """
    L = np.asarray(open_loop, complex)
    seen = np.isfinite(L) & (L != 0.0)
    magnitude, phase = np.full(L.shape, np.nan), np.full(L.shape, np.nan)
    magnitude[seen] = 20.0 * np.log10(np.abs(L[seen]))
    phase[seen] = np.degrees(np.unwrap(np.angle(L[seen])))
    return FrequencyResponse(
        name,
        tuned,
        np.asarray(f, float),
        magnitude,
        phase,
        np.full(L.shape, np.nan) if coherence is None else np.asarray(coherence, float),
        {MARGIN_NAMES[key]: float(value) for key, value in margins._asdict().items()} | _bounds(margins, at_least),
        source,
    )


def _bounds(margins: Margins, least: AtLeast | None) -> dict[str, float]:
    """Return lower bounds of the margins that were not measured."""
    found = {} if least is None else least._asdict()
    return {
        MARGIN_NAMES[key].replace(" [", ", at least ["): float(value)
        for key, value in found.items()
        if math.isfinite(value) and not math.isfinite(getattr(margins, key))
    }


def _plain(value: Any) -> Any:
    """Convert a value to plain JSON types."""
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "inf" if value > 0 else "-inf"
    return value
