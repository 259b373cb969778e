"""The experiment of a sweep: one TOML file, checked key by key before anything runs."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.devices import Device, find_device
from drive_env.devices.gain_set import LOAD_ANGLE, PID_ON_RAMP, ClosedLoop
from drive_env.devices.gains import loop_scales
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.dictionary.position_scale import PositionScale, position_scale, velocity_ratio
from drive_env.drives.speeds import per_increment_of
from drive_env.motors import find_motor
from mechanics.arrays import Integers
from mechanics.loads import find_load
from mechanics.reading.untrusted import read_toml
from tuning.runs.inputs import Input, as_kept, found_again, inputs_in, table_of, taken
from tuning.runs.metrics import TRACKING, combined_of, metric_names
from tuning.toml_tables import ExperimentError as ExperimentError
from tuning.toml_tables import as_table, as_value, check_keys, kind_of, read_table, toml, toml_lines

DEFAULT = Path(__file__).parent / "sweep.toml"
OPEN_LOOP = Path(__file__).parent / "open_loop_sweep.toml"  # for drives without loops
CLOSED_LOOPS = {  # for steppers that can close a loop, by its kind
    LOAD_ANGLE: Path(__file__).parent / "closed_loop_sweep.toml",
    PID_ON_RAMP: Path(__file__).parent / "pid_sweep.toml",
}
MAX_POINTS = 4_194_304  # the table then takes 1 GB of memory
MAX_PER_POINT = 64  # machines per point: a shard of 64 points then has about 4,000
MAX_DURATION = 60.0  # s
MIN_SAMPLES = 20  # in each of the two windows; with fewer, ringing cannot be detected
TARGET_VELOCITY, ACCELERATION = (cia402.TARGET_VELOCITY, 0), (cia402.PROFILE_ACCELERATION, 0)
_INDEX = re.compile(r"(?:0x)?([0-9a-f]{4})h?:(?:0x)?([0-9a-f]{1,2})h?", re.IGNORECASE)
_SPACINGS = ("lin", "log")
_NAMES = ("device", "motor", "load")  # their values may be paths
_PAIRS = (("velocity_rpm", "velocity_pps"), ("acceleration_rpm_per_s", "acceleration_pps2"))


@dataclass(frozen=True)
class SweptObject:
    """One axis of the grid: an object and its raw values from low to high, both included."""

    object: str
    low: int
    high: int
    count: int
    spacing: str

    def values(self) -> Integers:
        """Return the raw values in ascending order; values that are equal after rounding count once."""
        spaced = np.geomspace if self.spacing == "log" else np.linspace
        raw = np.rint(spaced(self.low, self.high, self.count)).astype(np.int64)
        return np.unique(np.clip(raw, self.low, self.high))


@dataclass(frozen=True)
class Excitation:
    """The excitation of every point; exactly one of each pair of units is set. Times [s] from the recording's start."""

    velocity_time: float
    load_torque: float  # N*m on the load
    load_time: float
    duration: float
    sampling_period: float
    velocity_rpm: float | None = None
    velocity_pps: float | None = None
    acceleration_rpm_per_s: float | None = None
    acceleration_pps2: float | None = None

    def raw_velocity(self, entry: Entry, position_scaler: int, ratio: float = 1.0) -> int:
        """Convert the step to raw units of 60FFh, with the position scaler [inc/rev] and the rpm per velocity unit."""
        return _raw(self.velocity_rpm, self.velocity_pps, entry, position_scaler, ratio)

    def raw_acceleration(self, entry: Entry, position_scaler: int, ratio: float = 1.0) -> int:
        """Convert the profile acceleration to raw units of 6083h."""
        return _raw(self.acceleration_rpm_per_s, self.acceleration_pps2, entry, position_scaler, ratio)


@dataclass(frozen=True)
class MetricChoice:
    """The metric of the ranking, and its weights if it is a combined one."""

    name: str
    weights: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """All settings of a sweep: a run with equal settings gives identical results.

    Attributes:
        machines: Number of machines that try each point. One is the default machine; several are drawn by the seed
            within their parameters' ranges, and the worst of them counts.
        versions: Versions recorded by an earlier run.
    """

    device: str
    motor: str
    load: str
    seed: int
    sweep: tuple[SweptObject, ...]
    excitation: Excitation
    metric: MetricChoice
    machines: int = 1
    versions: Mapping[str, str] = field(default_factory=dict)

    def points(self, first: int = 0, last: int | None = None) -> Integers:
        """Return the points of the grid from `first` to before `last`, by default all, shape (points, objects).

        The last object varies fastest.
        """
        numbers = np.unravel_index(np.arange(first, self.size() if last is None else last), self.shape())
        return np.stack([swept.values()[own] for swept, own in zip(self.sweep, numbers, strict=True)], axis=1)

    def shape(self) -> tuple[int, ...]:
        """Return the number of values of each object."""
        return tuple(len(swept.values()) for swept in self.sweep)

    def size(self) -> int:
        """Return the number of points."""
        return math.prod(self.shape())

    def with_inputs(self) -> Experiment:
        """Return the experiment with the content of the user's files instead of their paths.

        Raises:
            ValueError: If a file cannot be read, as in `inputs.taken`.
        """
        return replace(self, **{name: taken(name, getattr(self, name)) for name in _NAMES})

    def inputs(self) -> list[Input]:
        """Return the user's files that `with_inputs` has read."""
        return inputs_in([getattr(self, name) for name in _NAMES])

    def to_toml(self, versions: Mapping[str, str]) -> str:
        """Write the experiment as TOML, with the places of inputs in a run's folder, and the versions that ran it."""
        lines = [f"{name} = {toml(as_kept(getattr(self, name)))}" for name in (*_NAMES, "seed", "machines")]
        for swept in self.sweep:
            lines += ["", "[[sweep]]", *toml_lines(swept)]
        lines += ["", "[excitation]", *toml_lines(self.excitation)]
        lines += ["", "[metric]", f"name = {toml(self.metric.name)}"]
        if self.metric.weights:
            weights = ", ".join(f"{name} = {toml(weight)}" for name, weight in self.metric.weights.items())
            lines.append(f"weights = {{ {weights} }}")
        lines += table_of(self.inputs())
        if versions:
            lines += ["", "[versions]", *(f"{json.dumps(k)} = {toml(v)}" for k, v in versions.items())]
        return "\n".join(lines) + "\n"


class Resolved(NamedTuple):
    """A checked experiment with its names resolved: device, swept entries, and raw integers to write."""

    device: Device
    entries: tuple[Entry, ...]
    position_scaler: int  # inc/rev
    velocity: int  # in units of 60FFh
    acceleration: int  # in units of 6083h
    velocity_ratio: float = 1.0  # rpm per velocity unit
    loop: ClosedLoop | None = None  # closed loop of the drives, if swept gains act only in it


def load_experiment(
    config: str | Path | None = None, *, closed_loop: str | None = None, **overrides: Any
) -> Experiment:
    """Read and check an experiment from a TOML file, by default the shipped one.

    Args:
        config: The file.
        closed_loop: Without a file, use the shipped one for steppers with a closed loop of this kind.
        overrides: device, motor, load, seed or machines instead of the file's; None keeps the file's. The shipped
            experiment sweeps the same gains of any device, over the same range in its units, with the device's usual
            motor if its own does not fit the device.

    Raises:
        ExperimentError: For an invalid key or value; the message has the limit and the remedy.
    """
    path = shipped_experiment(overrides.get("device"), closed_loop=closed_loop) if config is None else Path(config)
    try:
        data = read_toml(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ExperimentError(f"cannot read the experiment {path}: {reason}; give --config a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise ExperimentError(
            f"{path} is not valid TOML: {error}; compare it with drive-tune sweep --show-config"
        ) from None
    inputs = data.pop("inputs", {})
    written = _parse(data)
    try:
        written = replace(
            written, **{name: found_again(getattr(written, name), inputs, path.parent) for name in _NAMES}
        )
    except ValueError as error:
        raise ExperimentError(str(error)) from None
    experiment = replace(written, **{key: value for key, value in overrides.items() if value is not None})
    if path == DEFAULT and config is None and experiment.device != written.device:
        experiment = replace(experiment, sweep=_same_gains(written, experiment.device))
    if config is None and overrides.get("device") is not None and overrides.get("motor") is None:
        device = find_device(experiment.device)
        if experiment.motor not in device.motors:
            experiment = replace(experiment, motor=device.default_motor)
    resolve(experiment)
    return experiment


def shipped_experiment(device: str | None, *, closed_loop: str | None = None) -> Path:
    """Return the shipped experiment for a device; None selects the default device.

    Raises:
        ExperimentError: For an unknown device, or one without the requested closed loop.
    """
    if device is None:
        return CLOSED_LOOPS[closed_loop] if closed_loop else DEFAULT
    try:
        known = find_device(device).gains
    except ValueError as error:
        raise ExperimentError(str(error)) from None
    if closed_loop and known.loop_of_kind(closed_loop) is None:
        raise ExperimentError(
            f"{device} has no loop to close ({closed_loop}): its gains.toml has no such [[closed_loop]]; leave "
            "--closed-loop and --pid out"
        )
    if closed_loop:
        return CLOSED_LOOPS[closed_loop]
    return OPEN_LOOP if known.is_open_loop else DEFAULT


def resolve(experiment: Experiment) -> Resolved:
    """Resolve an experiment's names, and check its values against the device.

    Raises:
        ExperimentError: For an unknown name, or a value beyond its limits.
    """
    try:
        device, motor = find_device(experiment.device), find_motor(experiment.motor)
        find_load(experiment.load)
        preset = device.preset(motor)
    except ValueError as error:
        raise ExperimentError(str(error)) from None
    if not 0 <= experiment.seed < 2**63:
        raise ExperimentError(f"seed = {experiment.seed} lies outside 0...2^63 - 1; give a whole number in it")
    if not 1 <= experiment.machines <= MAX_PER_POINT:
        raise ExperimentError(
            f"machines = {experiment.machines} for each point lies outside 1...{MAX_PER_POINT}; give a number in it"
        )
    dictionary = device.new_dictionary()
    entries = tuple(_swept_entry(device, dictionary, k, swept) for k, swept in enumerate(experiment.sweep, 1))
    _check_grid(experiment, entries)
    loop = _loop_of(device, experiment.sweep, entries)
    _check_metric(experiment.metric, device, loop)
    _check_times(experiment.excitation, 1.0 / device.communication_rate)
    scaler = _position_scale(device, dictionary, preset)
    ratio = _velocity_ratio(device, dictionary, preset)
    velocity = experiment.excitation.raw_velocity(dictionary.find(TARGET_VELOCITY), scaler, ratio)
    acceleration = experiment.excitation.raw_acceleration(dictionary.find(ACCELERATION), scaler, ratio)
    for key, raw, target in (("velocity", velocity, TARGET_VELOCITY), ("acceleration", acceleration, ACCELERATION)):
        entry = dictionary.find(target)
        assert entry.low is not None and entry.high is not None, "both are numbers"
        if not entry.low <= raw <= entry.high:
            raise ExperimentError(
                f"excitation: {key} is {raw} as {entry.label}, outside {entry.low}...{entry.high}; lower it"
            )
    if velocity == 0 or acceleration <= 0:
        raise ExperimentError(
            f"excitation: velocity is {velocity} and acceleration {acceleration} as raw integers; a step needs a "
            "velocity other than 0 and an acceleration above 0"
        )
    return Resolved(device, entries, scaler, velocity, acceleration, ratio, loop)


def _loop_of(device: Device, sweep: tuple[SweptObject, ...], entries: tuple[Entry, ...]) -> ClosedLoop | None:
    """Return the closed loop of a sweep: that of a gain's name, or the first of a swept object; None if open."""
    known = device.gains
    try:
        loop = known.loop_of([swept.object for swept in sweep])
    except ValueError as error:
        raise ExperimentError(f"sweep: {error}") from None
    if loop is not None:
        return loop
    own = {known.names[known.keys.index((entry.index, entry.sub))] for entry in entries}
    return next((each for each in known.closed_loops if not own.isdisjoint(each.gains.values())), None)


def _position_scale(device: Device, dictionary: ObjectDictionary, preset: Mapping[str, int]) -> int:
    """Return the increments per revolution of a drive that was commissioned with a preset."""
    scale = position_scale(device.roles)
    if scale is None:
        raise ExperimentError(f"{device.name} does not say how many increments a turn has, in its roles.toml")
    return int(_made(scale, dictionary, preset))


def _velocity_ratio(device: Device, dictionary: ObjectDictionary, preset: Mapping[str, int]) -> float:
    """Return the rpm per velocity unit of a drive commissioned with a preset; 1 for a drive without such a unit."""
    scale = velocity_ratio(device.roles)
    return 1.0 if scale is None else _made(scale, dictionary, preset)


def _made(scale: PositionScale, dictionary: ObjectDictionary, preset: Mapping[str, int]) -> float:
    """Compute a scale from a preset, with defaults for objects that it lacks."""
    given = {dictionary.find(name).label: value for name, value in preset.items()}
    entries = [dictionary.find(key) for key in scale.keys]
    values = [np.array([given.get(entry.label, entry.default)], float) for entry in entries]
    return float(scale.increments(values)[0])


def _same_gains(experiment: Experiment, name: str) -> tuple[SweptObject, ...]:
    """Return the swept gains for another device: the same part of the same loop; ExperimentError if it has none."""
    try:
        device = find_device(name)
    except ValueError as error:
        raise ExperimentError(str(error)) from None
    own, dictionary = find_device(experiment.device), find_device(experiment.device).new_dictionary()
    scales, theirs, found = loop_scales(own), loop_scales(device), []
    for number, swept in enumerate(experiment.sweep, 1):
        entry = _swept_entry(own, dictionary, number, swept)
        k = own.gains.keys.index((entry.index, entry.sub))
        gain = own.gains.rows[k]
        column = device.gains.column(gain.loop, gain.part)
        if column is None:
            raise ExperimentError(
                f"{name} has no {gain.part} of the {gain.loop} loop, which the default experiment sweeps; give "
                f"--config a file that sweeps some of {', '.join(device.gains.names)}"
            )
        other = device.gains.rows[column]
        if other.key == gain.key and theirs[column] == scales[k]:
            found.append(swept)
            continue
        ends = theirs[column].raw(scales[k].value([swept.low, swept.high]))
        low, high = sorted(min(max(round(end), 1), other.highest) for end in ends.tolist())
        found.append(replace(swept, object=other.name, low=low, high=high))
    return tuple(found)


def gain_objects(device: Device, dictionary: ObjectDictionary) -> list[Entry]:
    """Return the entries that a sweep can vary: the writable gains."""
    return [
        entry
        for entry in dictionary
        if entry.access not in ("ro", "const") and (entry.index, entry.sub) in device.gains.keys
    ]


def label(entry: Entry) -> str:
    """Format index and sub-index as in tables, e.g. `2042h:01`."""
    return f"{entry.index:04X}h:{entry.sub:02X}"


# --- checks -----------------------------------------------------------------------------------------------------------
def _swept_entry(device: Device, dictionary: ObjectDictionary, number: int, swept: SweptObject) -> Entry:
    where = f"sweep {number}"
    match, known, gains = _INDEX.fullmatch(swept.object.strip()), device.gains, gain_objects(device, dictionary)
    by_name = known.keys[known.columns([swept.object])[0]] if swept.object in known.searched else swept.object
    try:
        entry = dictionary.find((int(match[1], 16), int(match[2], 16)) if match else by_name)
    except ObjectAccessError as error:
        raise ExperimentError(
            f"{where}: object: {str(error).rsplit(' (abort code', 1)[0]}; gains of {device.name} are "
            f"{', '.join(known.searched)}"
        ) from None
    if entry not in gains:
        raise ExperimentError(
            f"{where}: object = {swept.object!r} is {entry.label}, no writable gain; gains of {device.name} are "
            f"{', '.join(label(gain) for gain in gains)}"
        )
    assert entry.low is not None and entry.high is not None, "gains are numbers"
    for key, value in (("low", swept.low), ("high", swept.high)):
        if not entry.low <= value <= entry.high:
            raise ExperimentError(
                f"{where}: {key} = {value} lies outside the range {entry.low}...{entry.high} of {entry.label}; "
                "choose it within"
            )
    if swept.low > swept.high:
        raise ExperimentError(f"{where}: low = {swept.low} is above high = {swept.high}; swap them")
    if swept.count < 1:
        raise ExperimentError(f"{where}: count = {swept.count} is below 1; give the number of values")
    if swept.count > MAX_POINTS:
        raise ExperimentError(f"{where}: count = {swept.count} is above the limit of {MAX_POINTS} points; lower it")
    if swept.spacing not in _SPACINGS:
        raise ExperimentError(f"{where}: spacing = {swept.spacing!r} is unknown; there are {', '.join(_SPACINGS)}")
    if swept.spacing == "log" and swept.low <= 0:
        raise ExperimentError(f"{where}: low = {swept.low} has no logarithm; use low = 1 or spacing = 'lin'")
    return entry


def _check_grid(experiment: Experiment, entries: tuple[Entry, ...]) -> None:
    if not entries:
        raise ExperimentError("nothing is swept; add at least one table [[sweep]]")
    for k, entry in enumerate(entries):
        if entry in entries[:k]:
            raise ExperimentError(f"sweep {k + 1}: {entry.label} is swept already; remove one of the two tables")
    points = experiment.size()
    if points > MAX_POINTS:
        product = " x ".join(map(str, experiment.shape()))
        raise ExperimentError(f"the grid has {product} = {points} points; the limit is {MAX_POINTS}: lower a count")


def _check_metric(metric: MetricChoice, device: Device, loop: ClosedLoop | None) -> None:
    if metric.name not in (known := metric_names(device, loop)):
        raise ExperimentError(f"metric: name = {metric.name!r} is unknown; there are {', '.join(known)}")
    wanted = combined_of(device, loop).weights if metric.name == TRACKING.name else {}
    if set(metric.weights) != set(wanted):
        needed = f"the weights {', '.join(wanted)}" if wanted else "no weights"
        raise ExperimentError(
            f"metric: {metric.name} takes {needed}; weights has {', '.join(metric.weights) or 'none'}"
        )
    for name, weight in metric.weights.items():
        if weight < 0.0:
            raise ExperimentError(f"metric: weight {name} = {weight:g} is negative; give 0 or more")
    if wanted and not any(metric.weights.values()):
        raise ExperimentError("metric: all weights are 0, so that all points are equal; give one above 0")


def _check_times(excitation: Excitation, cycle: float) -> None:
    period, duration = excitation.sampling_period, excitation.duration
    if period < cycle or not _is_multiple(period, cycle):
        raise ExperimentError(
            f"excitation: sampling_period = {period:g} s is not a whole number of communication cycles of {cycle:g} s; "
            f"use {max(1, round(period / cycle)) * cycle:g} s"
        )
    if not 0.0 < duration <= MAX_DURATION:
        raise ExperimentError(f"excitation: duration = {duration:g} s lies outside 0...{MAX_DURATION:g} s; change it")
    for key in ("velocity_time", "load_time", "duration"):
        value = getattr(excitation, key)
        if not _is_multiple(value, period):
            raise ExperimentError(
                f"excitation: {key} = {value:g} s is not a whole number of sampling periods of {period:g} s; "
                f"use {round(value / period) * period:g} s"
            )
    if not 0.0 <= excitation.velocity_time < excitation.load_time < duration:
        raise ExperimentError(
            f"excitation: velocity_time = {excitation.velocity_time:g} s, load_time = {excitation.load_time:g} s and "
            f"duration = {duration:g} s must follow each other, from 0 s on"
        )
    windows = (("load_time", excitation.velocity_time, excitation.load_time),
               ("duration", excitation.load_time, duration))  # fmt: skip
    for key, start, end in windows:
        if round((end - start) / period) < MIN_SAMPLES:
            raise ExperimentError(
                f"excitation: {key} = {end:g} s leaves {round((end - start) / period)} samples after {start:g} s; at "
                f"least {MIN_SAMPLES} are needed: use {start + MIN_SAMPLES * period:g} s or more"
            )


def _is_multiple(value: float, unit: float) -> bool:
    return abs(round(value / unit) * unit - value) < 1e-9


def _raw(in_rpm: float | None, in_pps: float | None, entry: Entry, position_scaler: int, ratio: float) -> int:
    """Convert a speed in rpm or pps, or an acceleration in rpm/s or pps^2, to the object's units."""
    value = in_rpm * position_scaler / 60.0 if in_rpm is not None else in_pps
    assert value is not None, "the parser lets exactly one through"
    return round(value * per_increment_of(entry.unit, position_scaler, ratio))


def _default_weights(name: str, sweep: tuple[SweptObject, ...]) -> Mapping[str, float]:
    """Return the weights of the combined metric; a servo's for invalid names, which `resolve` reports later."""
    try:
        device = find_device(name)
        dictionary = device.new_dictionary()
        entries = tuple(_swept_entry(device, dictionary, k, swept) for k, swept in enumerate(sweep, 1))
        return combined_of(device, _loop_of(device, sweep, entries)).weights
    except (ValueError, ExperimentError):
        return TRACKING.weights


# --- the TOML ---------------------------------------------------------------------------------------------------------
def _parse(data: Mapping[str, Any]) -> Experiment:
    """Convert TOML data to an experiment; checks keys and types, but neither names nor limits."""
    check_keys("the experiment", data, [f.name for f in fields(Experiment)], optional={"machines", "versions"})
    tables = data["sweep"]
    if not isinstance(tables, list):
        raise ExperimentError(f"sweep is {kind_of(tables)}; write one table [[sweep]] per object")
    sweep = tuple(SweptObject(**read_table(f"sweep {k}", table, SweptObject)) for k, table in enumerate(tables, 1))
    pairs = {name for pair in _PAIRS for name in pair}
    excitation = read_table("excitation", data["excitation"], Excitation, optional=pairs)
    for first, second in _PAIRS:
        if (first in excitation) == (second in excitation):
            found = "both" if first in excitation else "none"
            raise ExperimentError(f"excitation: needs {first} or {second}; it has {found}")
    metric = as_table("metric", data["metric"])
    check_keys("metric", metric, ["name", "weights"], optional={"weights"})
    given = as_table("metric: weights", metric.get("weights", {}))
    name = as_value("metric: name", metric["name"], "str")
    own = _default_weights(str(data["device"]), sweep)
    combined = dict(own) if name == TRACKING.name and not given else {}
    weights = combined | {key: as_value(f"metric: weight {key}", value, "float") for key, value in given.items()}
    versions = as_table("versions", data.get("versions", {}))
    return Experiment(
        **{name: as_value(name, data[name], "str") for name in ("device", "motor", "load")},
        seed=as_value("seed", data["seed"], "int"),
        sweep=sweep,
        excitation=Excitation(**excitation),
        metric=MetricChoice(name, weights),
        machines=as_value("machines", data.get("machines", 1), "int"),
        versions={key: as_value(f"versions: {key}", value, "str") for key, value in versions.items()},
    )
