"""A bus from a TOML file: its drives with their loads, nodes, bit rate and faults. Every key has a default."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drive_env.bus.faults import Faults
from drive_env.bus.wire import BIT_RATE, Wire
from drive_env.bus.world import World
from drive_env.default_device import DEFAULT_DEVICE
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:  # MuJoCo takes long to import
    from drive_env.emulator.emulated_drives import EmulatedDrives

NO_MOTOR = "none"  # refused with a remedy: every machine has a motor


class BusConfigError(ValueError):
    """An invalid bus; the message has key, value, limit and remedy."""


@dataclass(frozen=True)
class Machine:
    """One emulated machine: device, load, motor and the identifiers of its nodes.

    `motor` is by default the device's usual one. Without `commissioned` the drives have their factory values. Axes of
    the last node that the load does not need have no motor connected. `parameters` are true machine parameters [SI]
    that replace defaults, as for EmulatedDrives; `ideal` means a power stage, encoder and bearings without
    imperfections. `on_ethercat` are numbers of devices, from 0 in the order of the axes, that are slaves of an EtherCAT
    master instead of CAN nodes.
    """

    device: str = DEFAULT_DEVICE
    load: str = "two_mass"
    motor: str | None = None
    nodes: tuple[int, ...] = (1,)
    commissioned: bool = True
    ideal: bool = False
    parameters: Mapping[str, float] = field(default_factory=dict)
    on_ethercat: tuple[int, ...] = ()

    @property
    def motor_name(self) -> str:
        """Name or file of the motor."""
        from drive_env.devices import find_device

        return self.motor or find_device(self.device).default_motor


@dataclass(frozen=True)
class Bus:
    """The whole configuration of a bus.

    `bit_rate` [bit/s]; `seed` of everything random; `store` the folder of the nodes' saved parameters, relative to the
    file; `machines` the machines; `faults` those of the wire. If some devices are on EtherCAT, `ethercat_interface` and
    `ethercat_channel` connect them, like `--interface` and `--channel` of a bus that is all EtherCAT.
    """

    bit_rate: int = BIT_RATE
    seed: int = 0
    store: str | None = None
    machines: tuple[Machine, ...] = (Machine(),)
    faults: Faults = field(default_factory=Faults)
    ethercat_interface: str = "ethercat-udp"
    ethercat_channel: str | None = None

    @property
    def has_both(self) -> bool:
        """Whether some devices are on EtherCAT and others on CAN."""
        return any(row.on_ethercat for row in self.machines)


def load_bus(path: Path) -> Bus:
    """Return the bus that a file describes.

    Raises:
        BusConfigError: For a file that cannot be read or an invalid key or value.
    """
    try:
        data = read_toml(path)
    except OSError as error:
        raise BusConfigError(f"cannot read the bus {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BusConfigError(f"{path} is not a TOML file: {error}") from None
    values = _values(str(path), data, Bus)
    if not values.get("machines"):
        raise BusConfigError(f"{path}: there are no machines; add a table [[machines]] as in examples/bus.toml")
    if values.get("store") is not None:
        values["store"] = str(path.parent / values["store"])
    return Bus(**values)


def build_world(bus: Bus, *, lockstep: bool, own_wire: bool = True) -> World:
    """Return the world of a bus, its nodes not switched on yet.

    Args:
        bus: The configuration.
        lockstep: Time advances by SYNC.
        own_wire: Whether frames take the time of the modelled wire; false on an interface with a wire of its own.

    Raises:
        BusConfigError: If the bus is impossible.
    """
    check_seed(bus)
    try:
        wire = Wire(bus.bit_rate, instant=lockstep or not own_wire, faults=bus.faults, seed=bus.seed)
        world = World(lockstep=lockstep, wire=wire)
        store = store_folder(bus)
        for k, row in enumerate(bus.machines):
            check_devices(row)
            world.add(build_drives(bus, k), row.nodes, store, row.on_ethercat)
    except (ValueError, OSError) as error:
        raise BusConfigError(str(error)) from None
    return world


def build_drives(bus: Bus, k: int) -> EmulatedDrives:
    """Return the emulated drives of machine `k` of a bus; ValueError if they are impossible."""
    from drive_env.emulator.emulated_drives import EmulatedDrives

    row = bus.machines[k]
    if row.motor == NO_MOTOR:
        raise ValueError(
            "motor none: every machine has a motor; name it, and for a drive with factory values add --factory "
            "(in a file: commissioned = false)"
        )
    return EmulatedDrives(
        row.device, row.load, row.motor, commissioned=row.commissioned, seed=bus.seed, first_machine=k,
        ideal=row.ideal, parameters=row.parameters, num_threads=1,
    )  # fmt: skip


def check_devices(row: Machine) -> None:
    """Raise ValueError if a machine's `on_ethercat` names devices that it lacks."""
    from drive_env.devices import find_device
    from mechanics.loads import find_load

    if not row.on_ethercat:
        return
    device, axes = find_device(row.device), find_load(row.load).num_axes
    number = -(-axes // device.num_axes)
    if len(set(row.on_ethercat)) < len(row.on_ethercat) or not set(row.on_ethercat) <= set(range(number)):
        raise ValueError(
            f"on_ethercat = {list(row.on_ethercat)}: load {row.load!r} takes {number} of {row.device}; name each "
            f"at most once, 0 to {number - 1}"
        )
    if device.ethercat is None:
        raise ValueError(f"on_ethercat = {list(row.on_ethercat)}: {row.device} has no EtherCAT; take a device that has")


def check_seed(bus: Bus) -> None:
    """Raise BusConfigError for an invalid seed."""
    if bus.seed < 0:
        raise BusConfigError(f"seed = {bus.seed} must be 0 or more")


def store_folder(bus: Bus) -> Path | None:
    """Make and return the folder of the nodes' stores, None if they are in memory; BusConfigError if it cannot be."""
    if bus.store is None:
        return None
    path = Path(bus.store)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BusConfigError(f"the store {path} cannot be made: {error.strerror}; choose another folder") from None
    return path


# Keys with structured values, and their readers.
def _machines(where: str, value: Any) -> tuple[Machine, ...]:
    if not isinstance(value, list):
        raise BusConfigError(f"{where} must be tables [[machines]], not {value!r}")
    return tuple(Machine(**_values(f"{where}[{k}]", row, Machine)) for k, row in enumerate(value))


def _faults(where: str, value: Any) -> Faults:
    try:
        return Faults(**_values(where, value, Faults))
    except BusConfigError:
        raise
    except ValueError as error:
        raise BusConfigError(str(error)) from None


def _whole_numbers(where: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or any(type(one) is not int for one in value):
        raise BusConfigError(f"{where} = {value!r} must be a list of whole numbers, as [1, 2]")
    return tuple(value)


def _numbers(where: str, value: Any) -> dict[str, float]:
    if not isinstance(value, dict):
        raise BusConfigError(f"{where} = {value!r} must be a table of numbers")
    return {key: _scalar(f"{where}.{key}", one, float) for key, one in value.items()}


_READERS = {
    "machines": _machines, "faults": _faults, "nodes": _whole_numbers, "on_ethercat": _whole_numbers,
    "only": _whole_numbers, "parameters": _numbers,
}  # fmt: skip
_SCALARS: dict[str, type] = {"str": str, "str | None": str, "int": int, "float": float, "bool": bool}
_MEANINGS: dict[type, str] = {str: "a text", int: "a whole number", float: "a number", bool: "true or false"}


def _values(where: str, table: Any, kind: type) -> dict[str, Any]:
    """Return a table's values by the fields of a dataclass."""
    if not isinstance(table, dict):
        raise BusConfigError(f"{where} = {table!r} must be a table")
    known = {f.name: f for f in fields(kind)}
    result = {}
    for key, value in table.items():
        if key not in known:
            raise BusConfigError(f"{where}: key {key!r} is unknown; there are {', '.join(known)}")
        place = f"{where}: {key}"
        reader = _READERS.get(key)
        result[key] = reader(place, value) if reader else _scalar(place, value, _SCALARS[str(known[key].type)])
    return result


def _scalar(where: str, value: Any, kind: type) -> Any:
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise BusConfigError(f"{where} = {value!r} must be {_MEANINGS[kind]}")
    return value
