"""The machines that tuners are compared on: a public part in a TOML file, and a part drawn from a seed.

A suite is a file of `suites/`, or your own: tables of machines, one per load and motor, and the loads and motors of the
drawn part. Paths in it are relative to the file. The name of a machine determines its noise: it behaves the same
whatever other machines are opened with it.
"""

from __future__ import annotations

import math
import tomllib
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drive_env.devices import find_device
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.emulator.inertia_check import MisfitWarning
from drive_env.motors import find_motor
from drive_env.randomisation.random_machines import laws_of, shipped
from mechanics.loads import MODEL_ENDINGS, find_load
from mechanics.reading.untrusted import read_toml
from mechanics.shaft import one, way
from tuning.linked_axes import are_linked
from tuning.runs.inputs import files_of, is_path, is_shipped, taken
from tuning.target import Target
from tuning.toml_tables import ExperimentError, as_table, as_value, check_keys, kind_of

SHIPPED = Path(__file__).parent / "suites"
FRICTION = "stribeck"
_TRIES = 50  # draws until the motor can move the machine
_GROUP = ("load", "motor", "friction", "supply", "travel", "parameters")
_SUPPLY = "supply.voltage"  # key of the supply voltage in a set of distributions


@dataclass(frozen=True)
class SuiteMachine:
    """A machine of a suite.

    Attributes:
        name: Its name in the suite.
        device, load, motor: Their names.
        parameters: True parameters that differ from the defaults, by the names of `drives.machine.parameters` [SI].
        supply: Supply voltage [V].
        friction: Model of the load's friction, as in EmulatedDrives.
        travel: How far the rotor may turn to each side of its first angle [rev]; inf is the load's own travel.
    """

    name: str
    device: str
    load: str
    motor: str
    parameters: Mapping[str, float]
    supply: float
    friction: str = FRICTION
    travel: float = math.inf

    @property
    def kind(self) -> tuple[str, str, str, str]:
        """The fields that must be equal in machines emulated in one set of drives."""
        return self.device, self.load, self.motor, self.friction


def suite_input(name: str) -> str:
    """Return a shipped suite's name unchanged, else an `Input` of the file and all it names; raises as `taken`."""
    if not is_path("suite", name):
        return name
    named = [one for what, place in _own_names(Path(name)) for one in files_of(what, place)]
    found: str = taken("suite", name, named)
    return found


def _own_names(path: Path) -> list[tuple[str, Path]]:
    """Return the paths in a suite's file, each with its kind (device, motor or load); raises as `load_suite`."""
    table = _read(path)
    rows = [row for row in table.get("group", []) if isinstance(row, dict)]
    found = [("device", table.get("device")), *((what, row.get(what)) for row in rows for what in ("motor", "load"))]
    for row in table.get("generated", []):
        pairs = row.get("groups", []) if isinstance(row, dict) else []
        found += [("motor", pair[1]) for pair in pairs if isinstance(pair, list) and len(pair) == 2]
    named = [(what, _located(what, name, path.parent)) for what, name in found if isinstance(name, str)]
    return [(what, place) for what, place in named if place is not None]


def suite_names() -> list[str]:
    """Return the names of the shipped suites."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def load_suite(name_or_path: str | Path = "public", seed: int | None = None, count: int | None = None) -> tuple[
    SuiteMachine, ...
]:  # fmt: skip
    """Return the machines of a suite: its public part, and with a seed also its drawn part.

    Args:
        name_or_path: Name of a shipped suite, or path of a TOML file.
        seed: Seed of the drawn part; None omits it.
        count: Greatest number of machines, taken from all loads and motors in turn.

    Raises:
        ExperimentError: For an unknown suite, key, name or number; the message lists the known ones.
    """
    path = _path(name_or_path)
    table = _read(path)
    where = path.name
    check_keys(where, table, ["device", "group", "generated"], optional=("generated", "group"))
    device = _named("device", as_value(f"{where}: device", table["device"], "str"), path.parent)
    machines: list[SuiteMachine] = []
    for row in table.get("group", []):
        machines += _group(where, device, as_table(f"{where}: group", row), path.parent)
    if seed is not None:
        machines += _generated(f"{where}: generated", device, table.get("generated", []), seed, path.parent)
    if not machines:
        raise ExperimentError(f"{where}: it has no machine; add a [[group]], or [[generated]] and a seed")
    names = [machine.name for machine in machines]
    for name in names:
        if names.count(name) > 1:
            raise ExperimentError(
                f"{where}: two machines are named {name!r}; put machines of one load and motor into one group"
            )
    return tuple(machines) if count is None else _spread(machines, count)


def groups(machines: Sequence[SuiteMachine]) -> list[list[int]]:
    """Return the indices of machines that can be emulated in one set of drives, in the order of the first of each."""
    found: dict[tuple[str, str, str, str], list[int]] = {}
    for k, machine in enumerate(machines):
        found.setdefault(machine.kind, []).append(k)
    return list(found.values())


def open_group(machines: Sequence[SuiteMachine], num_threads: int | None = None) -> Target:
    """Open machines of one kind as one target.

    Raises:
        ValueError: If they are of several kinds, or one is impossible.
    """
    if len({machine.kind for machine in machines}) != 1:
        kinds = ", ".join(sorted({f"{machine.load} on {machine.motor}" for machine in machines}))
        raise ValueError(
            f"machines emulated in one set of drives have one load and one motor, not {kinds}; open them separately"
        )
    device, load, motor, friction = machines[0].kind
    defaults = _defaults(device, load, motor)
    names = sorted({name for machine in machines for name in machine.parameters})
    columns = {name: np.array([m.parameters.get(name, defaults[name]) for m in machines]) for name in names}
    drives = EmulatedDrives(
        device, load, motor, len(machines), parameters=columns, friction=friction, num_threads=num_threads
    )
    axes = drives.load.num_axes
    supply = np.repeat([machine.supply for machine in machines], axes)
    # The noise of a machine depends on its name only, not on the machines opened with it.
    drives.machine.seed_noise(np.array([1.0 + zlib.crc32(machine.name.encode()) % (2**32 - 2) for machine in machines]))
    drives.machine.supply = supply
    drives.machine.reset()  # charges the link from the supply
    alone = one(drives.load)
    own, turns = way(alone), np.repeat([machine.travel for machine in machines], axes)
    return Target(
        drives,
        drives.device,
        drives.motor,
        supply,
        np.maximum(np.tile(own.low, len(machines)), -2.0 * math.pi * turns),
        np.minimum(np.tile(own.high, len(machines)), 2.0 * math.pi * turns),
        speed=drives.motor.rated_speed,
        current=drives.motor.rated_current,
        axes_per_machine=axes,
        linked=are_linked(alone),
        machine=load,
    )


# --- reading ----------------------------------------------------------------------------------------------------------
def _path(name_or_path: str | Path) -> Path:
    if isinstance(name_or_path, Path) or str(name_or_path).endswith(".toml"):
        path = Path(name_or_path)
        if not path.is_file():
            raise ExperimentError(
                f"there is no file {path} of machines; the suites that ship are {', '.join(suite_names())}"
            )
        return path
    if name_or_path not in suite_names():
        raise ExperimentError(
            f"no suite is named {name_or_path!r}; there are {', '.join(suite_names())}, or give a .toml"
        )
    return SHIPPED / f"{name_or_path}.toml"


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except OSError as error:
        raise ExperimentError(f"cannot read the suite {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ExperimentError(f"{path} is not TOML: {error}") from error


def _located(what: str, name: str, folder: Path) -> Path | None:
    """Resolve a path that is relative to the suite's file; None for a name that is not a path."""
    return folder / name if is_path(what, str(folder / name)) and not is_shipped(what, name) else None


def _named(what: str, name: str, folder: Path) -> str:
    """Return a shipped name unchanged; for the path of a file, an `Input` with its content; raises ExperimentError."""
    try:
        return name if (place := _located(what, name, folder)) is None else taken(what, place)
    except ValueError as error:
        raise ExperimentError(str(error)) from None


def _stem(load: str, motor: str) -> str:
    """Return the part of a machine's name, and so of its seed, for load and motor; of files without their folder."""
    return "-".join(Path(name).stem if name.endswith((".toml", *MODEL_ENDINGS)) else name for name in (load, motor))


def _group(where: str, device: str, row: dict[str, Any], folder: Path) -> list[SuiteMachine]:
    """Return the machines of a table with one column per machine; paths are relative to the folder."""
    check_keys(f"{where}: group", row, list(_GROUP), optional=("friction", "travel"))
    names = {key: as_value(f"{where}: {key}", row[key], "str") for key in ("load", "motor")}
    stem = _stem(*names.values())
    load, motor = (_named(key, name, folder) for key, name in names.items())
    where = f"{where}: {stem}"
    friction = as_value(f"{where}: friction", row.get("friction", FRICTION), "str")
    known = _checked_defaults(where, device, load, motor)
    supply = _numbers(f"{where}: supply", row["supply"])
    count = len(supply)
    travel = _numbers(f"{where}: travel", row.get("travel", [math.inf] * count), count)
    columns = {}
    for name, values in as_table(f"{where}: parameters", row["parameters"]).items():
        if name not in known:
            raise ExperimentError(f"{where}: machines have no parameter {name!r}; they have {', '.join(known)}")
        columns[name] = _numbers(f"{where}: {name}", values, count)
    for k, (volts, turns) in enumerate(zip(supply, travel, strict=True)):
        if not volts > 0.0 or not turns > 0.0:
            raise ExperimentError(
                f"{where}: supply {volts:g} V and travel {turns:g} rev of machine {k} must be above 0"
            )
    return [
        SuiteMachine(
            f"{stem}-{k}", device, load, motor, {name: values[k] for name, values in columns.items()}, supply[k],
            friction, travel[k],
        )
        for k in range(count)
    ]  # fmt: skip


def _numbers(where: str, value: Any, count: int | None = None) -> list[float]:
    """Check an array of numbers; `count` is its length, None for any."""
    if not isinstance(value, list) or not value:
        raise ExperimentError(f"{where} = {value!r} must be an array of numbers, one per machine")
    if count is not None and len(value) != count:
        raise ExperimentError(f"{where} has {len(value)} numbers for {count} machines; give one per machine")
    return [item if item == math.inf else as_value(where, item, "float") for item in value]


def _checked_defaults(where: str, device: str, load: str, motor: str) -> dict[str, float]:
    try:
        return _defaults(device, load, motor)
    except ValueError as error:
        raise ExperimentError(f"{where}: {error}") from error


@cache
def _defaults(device: str, load: str, motor: str) -> dict[str, float]:
    """Return the default of every parameter of a machine; cached, since it takes a load's compilation."""
    find_motor(motor), find_load(load)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)  # of the default machine, which may not be in the suite
        with EmulatedDrives(device, load, motor, num_threads=1) as drives:
            return {name: float(value[0]) for name, value in drives.machine.parameters.items()}


def _spread(machines: Sequence[SuiteMachine], count: int) -> tuple[SuiteMachine, ...]:
    """Choose `count` machines from the groups in turn; their order stays."""
    if count < 1:
        raise ExperimentError(f"count must be 1 or more, not {count}")
    members = groups(machines)
    turns = [(turn, k) for group in members for turn, k in enumerate(group)]
    chosen = sorted(k for _, k in sorted(turns)[:count])
    return tuple(machines[k] for k in chosen)


# --- drawing ----------------------------------------------------------------------------------------------------------
def _generated(where: str, device: str, tables: Any, seed: int, folder: Path) -> list[SuiteMachine]:
    """Draw the machines for a seed; one that its motor cannot move is drawn again."""
    if seed < 0:
        raise ExperimentError(f"seed must be 0 or more, not {seed}")
    if not isinstance(tables, list):
        raise ExperimentError(f"{where} is {kind_of(tables)}; write one table [[generated]] for machines of a kind")
    machines: list[SuiteMachine] = []
    for table in tables:
        check_keys(where, as_table(where, table), ["count", "groups"])
        count = as_value(f"{where}: count", table["count"], "int")
        pairs = table["groups"]
        if not isinstance(pairs, list) or not pairs or any(not isinstance(p, list) or len(p) != 2 for p in pairs):
            raise ExperimentError(f"{where}: groups must be an array of [load, motor]")
        # Numbered across tables: adding a table changes no machine of the tables before it.
        first = len(machines)
        for k in range(count):
            load, motor = pairs[k % len(pairs)]
            machines.append(_draw(where, device, load, _named("motor", motor, folder), seed, first + k))
    return machines


def _draw(where: str, device: str, load: str, motor: str, seed: int, number: int) -> SuiteMachine:
    """Draw machine `number` of a seed; it does not depend on the number of machines drawn."""
    defaults = _checked_defaults(where, device, load, motor)
    if load not in shipped():
        raise ExperimentError(f"{where}: load {load!r} has no distributions; there are {', '.join(shipped())}")
    laws = laws_of(load, find_device(device), defaults)
    rng = np.random.default_rng((seed, number))
    known = defaults | {_SUPPLY: find_motor(motor).voltage}
    for _ in range(_TRIES):
        drawn = laws.draw(rng, known)
        supply = drawn.pop(_SUPPLY, known[_SUPPLY])
        if _sound(device, load, motor, drawn):
            return SuiteMachine(f"seed{seed}-{number:02d}-{_stem(load, motor)}", device, load, motor, drawn, supply)
    raise ExperimentError(
        f"{where}: {_TRIES} draws of {load!r} gave no machine that {motor!r} can move; choose a stronger motor"
    )


def _sound(device: str, load: str, motor: str, parameters: Mapping[str, float]) -> bool:
    """Return whether the motor can move the machine, and the machine can be simulated."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", MisfitWarning)
        try:
            EmulatedDrives(device, load, motor, parameters=parameters, num_threads=1).close()
        except (MisfitWarning, ValueError):
            return False
    return True
