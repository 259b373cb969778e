"""The run that `drive-env render` films: one TOML, checked, with set-points that suit the load and the motor."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env import cia402
from drive_env.default_device import DEFAULT_DEVICE
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.drives import motion
from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from drive_env.emulator.inside import Inside
    from drive_env.pictures.recording import Recorder, Recording


DEFAULT = Path(__file__).parent / "demonstration.toml"
TARGETS = {
    "pp": (cia402.TARGET_POSITION, 0),
    "pv": (cia402.TARGET_VELOCITY, 0),
    "csv": (cia402.TARGET_VELOCITY, 0),
    "cst": (cia402.TARGET_TORQUE, 0),
}
TO_SI = {"pp": 2.0 * math.pi, "pv": math.pi / 30.0, "csv": math.pi / 30.0, "cst": 1.0}
UNITS = {"pp": "turns", "pv": "rpm", "csv": "rpm", "cst": "A"}
PROFILE_VELOCITY = (cia402.PROFILE_VELOCITY, 0)
# Chosen shares of travel, speed, current and torque: large enough to be seen, and no limit is reached.
TRAVEL_SHARE, SPEED_SHARE, CURRENT_SHARE, LOAD_SHARE = 0.8, 0.5, 0.2, 0.3
LONGEST_MOVE = 1.0  # s at profile velocity
HINGE, HINGE_OF_MANY, SLIDE = 2.0 * math.pi, math.pi / 4.0, 0.3  # moves where nothing limits them [rad, rad, m]
MAX_TIME, MAX_PIXELS = 60.0, 4096
LOOK = 0.05  # s of the film before anything moves
AFTER_FAULT = 0.2  # s of the film after a fault


class DemonstrationError(ValueError):
    """An impossible run; the message is one line with key, value, limit and remedy."""


@dataclass(frozen=True)
class PictureFormat:
    """Size [pixels] and pace of the film; `slow` seconds of film show one second of run; None: by its duration."""

    width: int = 960
    height: int = 540
    frames_per_second: float = 25.0
    slow: float | None = None


@dataclass(frozen=True)
class Demonstration:
    """The run of a film, in the units of demonstration.toml; for None a value is chosen that suits load and motor."""

    device: str = DEFAULT_DEVICE
    motor: str = "qbl4208"
    load: str = "two_mass"
    seed: int = 0
    mode: str = "pp"
    setpoints: tuple[float | tuple[float, ...], ...] | None = None
    hold: float = 0.2
    longest: float = 5.0
    load_torque: float | None = None
    load_time: float = 0.4
    objects: Mapping[str, int] = field(default_factory=dict)
    picture: PictureFormat = field(default_factory=PictureFormat)


def load_demonstration(config: str | Path | None = None, **overrides: Any) -> Demonstration:
    """Return the run of a TOML file, by default the one that ships, checked.

    Args:
        config: The file.
        overrides: Values of device, motor, load, seed or the picture's `slow` instead of the file's; None: the file's.

    Raises:
        DemonstrationError: If the file cannot be read, or a value is impossible.
    """
    path = DEFAULT if config is None else Path(config)
    try:
        data = read_toml(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise DemonstrationError(f"cannot read the run {path}: {reason}; give --config a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise DemonstrationError(
            f"{path} is not valid TOML: {error}; compare it with drive-env render --show-config"
        ) from None
    read = _read(data)
    slow = overrides.pop("slow", None)
    if slow is not None:
        read = replace(read, picture=replace(read.picture, slow=float(slow)))
    chosen = replace(read, **{key: value for key, value in overrides.items() if value is not None})
    _check(chosen)
    return chosen


def perform(demonstration: Demonstration, progress: Callable[[float], None] | None = None) -> Recording:
    """Run one emulated machine through the demonstration and return the recording.

    A drive that ends in fault, or that does not reach a set-point, is no error: the recording shows it.

    Raises:
        DemonstrationError: If a name does not exist, or the drive refuses an object or a set-point.
    """
    from drive_env.emulator.emulated_drives import EmulatedDrives
    from drive_env.pictures.recording import Recorder

    tell = progress or (lambda share: None)
    tell(0.0)
    row = demonstration
    try:
        drives = EmulatedDrives(row.device, row.load, row.motor, 1, row.seed, num_threads=1)
    except (ValueError, OSError) as error:
        raise DemonstrationError(str(error)) from None
    with drives:
        recorder = Recorder(drives)
        try:
            for name, value in row.objects.items():
                drives.write(name, value)
            setpoints = _setpoints(row, drives)
            torque = _load_torque(row, drives)
            _drive(recorder, row, setpoints, torque, tell)
        except ObjectAccessError as error:
            raise DemonstrationError(f"the drive refuses the run: {error}") from None
        except (RuntimeError, TimeoutError) as error:
            causes = ", ".join(message.name.replace("_", " ") for message in drives.emergencies())
            recorder.mark(f"{error}".split(";")[0] + (f": {causes}" if causes else ""))
            recorder.advance(AFTER_FAULT)
        return recorder.recording()


def _drive(recorder: Recorder, row: Demonstration, setpoints: list[Floats], torque: float, tell: Any) -> None:
    from drive_env.pictures.recording import to_raw

    drives, target = recorder.drives, TARGETS[row.mode]
    steps = len(setpoints) + 2.0
    recorder.mark("enable")
    recorder.advance(LOOK)
    motion.enable(recorder, mode=row.mode)
    tell(1.0 / steps)
    for k, values in enumerate(setpoints, 1):
        numbers = ", ".join(f"{value:.4g}" for value in dict.fromkeys(values.tolist()))
        recorder.mark(f"{row.mode}: to {numbers} {UNITS[row.mode]}")
        raw = to_raw(drives, target, TO_SI[row.mode] * values)
        if row.mode == "pp":
            motion.start_move(recorder, raw)
        else:
            drives.write(target, raw)
        if row.mode in ("pp", "pv"):
            recorder.advance(CYCLE)  # bit 10 falls in the cycle after the set-point
            motion.wait_for(recorder, cia402.TARGET_REACHED, row.longest, f"set-point {k}")
        recorder.advance(row.hold)
        tell((1.0 + k) / steps)
    if torque:
        recorder.mark(f"load pushes with {torque:.3g} {drives.load.disturbance_unit}".replace("*", "·"))
        drives.machine.load_torque = torque
        recorder.advance(row.load_time)
        recorder.mark("load lets go")
        drives.machine.load_torque = 0.0
        recorder.advance(row.load_time)
    tell(1.0)


# --- what suits -------------------------------------------------------------------------------------------------------
def _setpoints(row: Demonstration, drives: EmulatedDrives) -> list[Floats]:
    """Return the set-points in the mode's unit, each of shape (num_axes,)."""
    if row.setpoints is not None:
        given = []
        for value in row.setpoints:
            if isinstance(value, tuple) and len(value) != drives.num_axes:
                raise DemonstrationError(
                    f"setpoints: {list(value)} has {len(value)} numbers; load {drives.load.name!r} has "
                    f"{drives.num_axes} axes: give one number, or one per axis"
                )
            given.append(np.broadcast_to(np.asarray(value, float), (drives.num_axes,)))
        return given
    reach, limited = _reach(drives)  # rad of the motors
    rest = np.zeros(drives.num_axes)
    if row.mode == "pp":
        return [reach / TO_SI["pp"], rest]
    if row.mode == "cst":
        current = np.full(drives.num_axes, CURRENT_SHARE * drives.motor.rated_current)
        return [current, -current, rest]
    speed = np.full(drives.num_axes, SPEED_SHARE * drives.motor.rated_speed)
    if limited:
        # There and back: within half of the reach, getting to speed and holding it.
        speed = np.sign(reach) * np.minimum(speed, 0.5 * np.abs(reach) / (row.hold + 0.2))
        return [speed / TO_SI[row.mode], -speed / TO_SI[row.mode], rest]
    return [speed / TO_SI[row.mode]]


def _reach(drives: EmulatedDrives) -> tuple[Floats, bool]:
    """Return how far each motor may turn from rest for a move [rad], with its sign, and whether anything limits it."""
    from drive_env.pictures.recording import from_raw
    from mechanics.shaft import way

    speed = from_raw(drives, PROFILE_VELOCITY, drives.read(PROFILE_VELOCITY))
    found = way(drives.inside.groups[0].load)
    reach, limited = np.empty(drives.num_axes), False
    for axis, (low, high) in enumerate(zip(found.low, found.high, strict=True)):
        end = TRAVEL_SHARE * (high if high >= -low else low)
        limited |= math.isfinite(end)
        hinge = HINGE if drives.num_axes == 1 else HINGE_OF_MANY
        free = (SLIDE if found.linear[axis] else hinge) / abs(found.position[axis])
        reach[axis] = math.copysign(min(abs(end), free, LONGEST_MOVE * speed[axis]), end)
    return reach, limited


def _load_torque(row: Demonstration, drives: EmulatedDrives) -> float:
    if row.load_torque is not None:
        return row.load_torque
    if row.mode == "cst":
        return 0.0  # nothing would hold against it
    return -LOAD_SHARE * rated_load_torque(drives.inside)


def rated_load_torque(inside: Inside) -> float:
    """Return the torque on the load [N*m; N on what moves in a line] that takes the rated torque of a motor."""
    from mechanics.shaft import way

    packed = inside.groups[0].load
    # The disturbance's speed per speed of each rotor; the axis that feels it most.
    lever = np.abs(way(packed).joints @ packed.plant.disturbance[:, 0])
    return inside.motor.rated_torque / float(lever.max())


# --- the TOML ---------------------------------------------------------------------------------------------------------
def _read(data: Mapping[str, Any]) -> Demonstration:
    values = _values("the run", data, Demonstration)
    if "setpoints" in values:
        values["setpoints"] = _read_setpoints(values["setpoints"])
    for name, value in values.get("objects", {}).items():
        if type(value) is not int:
            raise DemonstrationError(f"objects: {name} = {value!r} is not a whole number; give the integer on the wire")
    if "picture" in values:
        values["picture"] = PictureFormat(**_values("picture", values["picture"], PictureFormat))
    return Demonstration(**values)


def _values(where: str, table: Any, kind: type) -> dict[str, Any]:
    """Return a table's values, each of the type of the dataclass's field."""
    types = {f.name: str(f.type) for f in fields(kind)}
    values = {}
    for key, value in table.items():
        if key not in types:
            raise DemonstrationError(f"{where}: key {key!r} is unknown; there are {', '.join(types)}")
        wanted = types[key].removesuffix(" | None")
        if wanted == "float" and type(value) is int:
            value = float(value)
        right = {
            "str": ("a text", str),
            "int": ("a whole number", int),
            "float": ("a number", float),
            "Mapping[str, int]": ("a table", dict),
            "PictureFormat": ("a table", dict),
        }.get(wanted)
        if right and (type(value) is not right[1] or (isinstance(value, float) and not math.isfinite(value))):
            raise DemonstrationError(f"{where}: {key} = {value!r} must be {right[0]}")
        values[key] = value
    return values


def _read_setpoints(given: Any) -> tuple[float | tuple[float, ...], ...]:
    def number(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DemonstrationError(f"setpoints: {value!r} is not a finite number; give numbers, or arrays of numbers")
        return float(value)

    if not isinstance(given, list) or not given:
        raise DemonstrationError(f"setpoints = {given!r} must be an array with at least one number")
    return tuple(tuple(map(number, v)) if isinstance(v, list) else number(v) for v in given)


def _check(row: Demonstration) -> None:
    if row.mode not in TARGETS:
        raise DemonstrationError(f"mode = {row.mode!r} cannot be filmed; there are {', '.join(TARGETS)}")
    if not 0 <= row.seed < 2**63:
        raise DemonstrationError(f"seed = {row.seed} lies outside 0...2^63 - 1; give a whole number in it")
    for key in ("hold", "longest", "load_time"):
        value = getattr(row, key)
        if not 0.0 <= value <= MAX_TIME or abs(round(value * 1e3) - value * 1e3) > 1e-6:
            raise DemonstrationError(f"{key} = {value:g} s must be whole milliseconds within 0...{MAX_TIME:g} s")
    picture = row.picture
    for key, least in (("width", 640), ("height", 360)):
        value = getattr(picture, key)
        if not least <= value <= MAX_PIXELS or value % 2:
            raise DemonstrationError(
                f"picture: {key} = {value} pixels must be an even number within {least}...{MAX_PIXELS}"
            )
    if not 1.0 <= picture.frames_per_second <= 100.0:
        raise DemonstrationError(
            f"picture: frames_per_second = {picture.frames_per_second:g} lies outside 1...100; choose it within"
        )
    if picture.slow is not None and not 0.1 <= picture.slow <= 1000.0:
        raise DemonstrationError(
            f"slow = {picture.slow:g} lies outside 0.1...1000; 1 is real time, 4 four times slower"
        )
