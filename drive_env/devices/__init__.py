"""The devices: one folder each, with the object dictionary (EDS), its bindings and its behaviour as data."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from drive_env import cia402
from drive_env.devices.drive_quirks import DriveQuirks, drive_quirks_of
from drive_env.devices.ethercat import EtherCatBehaviour, ethercat_of
from drive_env.devices.gain_set import GainSet, load_gain_set
from drive_env.devices.image_rows import FixedImage, fixed_images
from drive_env.devices.own_folder import BINDINGS, bindings_of, check_scale, is_own_folder, naming, own_data
from drive_env.devices.services import NodeQuirks, NodeServices, node_quirks_of, services_of
from drive_env.devices.variants import (
    check_rates,
    compose_eds,
    converted_preset,
    device_data,
    merged,
    own_variant,
    parse_key,
    variant_bindings,
)
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import EdsText, ObjectDictionary, eds_text
from drive_env.dictionary.parts import Part, parts_of
from drive_env.dictionary.roles import Role
from drive_env.firmware import checked_firmware, default_motor, find_firmware, motor_kinds
from drive_env.motors import EXTRA_LOW_VOLTAGE, KINDS, MOTORS, Motor, is_extra_low, motors_of
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.firmware.cycle import Firmware

FOLDER = Path(__file__).parent
STANDARD_COMMISSIONING = "standard"
OF_INDICES = ("timeouts", "commands", "addresses")  # tables of `master` whose keys are indices
HIGHEST, MASK = "highest", "mask"  # the object's highest value; the value's low bits by the mask of its highest value


class StageParameter(NamedTuple):
    """An imperfection of the power stage: default, randomisation range, value of a perfect stage, unit, source."""

    default: float
    low: float
    high: float
    ideal: float
    unit: str
    source: str


AXIS = -1  # placeholder of the additional byte that has the axis' number


class EmergencyCode(NamedTuple):
    """Emergency code and the five additional bytes; `AXIS` for a byte with the number of the node's axis."""

    code: int
    extra: tuple[int, ...]

    def of_axis(self, axis: int) -> EmergencyCode:
        """Return it with the bytes for an axis of the node; unchanged if no byte has the axis."""
        return EmergencyCode(self.code, tuple(axis if byte == AXIS else byte for byte in self.extra))

    @property
    def tells_axis(self) -> bool:
        """Whether a byte has the number of the axis."""
        return AXIS in self.extra

    def axis_told(self, extra: tuple[int, ...], num_axes: int) -> int | None:
        """Decode the axis number from the emergency's bytes; 0 if they carry none, None if not this emergency's."""
        told = {sent for byte, sent in zip(self.extra, extra, strict=True) if byte == AXIS} or {0}
        axis = min(told)
        return axis if axis < num_axes and self.of_axis(axis).extra == extra else None


class AxisOffset(NamedTuple):
    """A range of indices of axis 0, and the step from each to the same object of the next axis."""

    first: int
    last: int
    step: int


class CanopenBehaviour(NamedTuple):
    """Behaviour of a device on a CANopen bus; times in s.

    Attributes:
        sdo_timeout: Time after which the server aborts a transfer.
        boot_time: From an NMT reset to the boot-up message, in real time.
        sdo_time: From an SDO request to its answer, in real time.
        store_time: The same for a request that stores or restores parameters (1010h, 1011h).
        frames_per_cycle: Frames that the firmware handles in a communication cycle of 1 ms, in real time.
        receive_buffer: Frames that may wait for the firmware; further ones are lost.
        inhibit_unit: Unit of a TPDO's inhibit time.
        event_unit: Unit of a TPDO's event timer.
        error_behaviour: Value of 1029h -> NMT state that the node enters, or "stay".
        objects: Role -> object of the module, not of an axis.
        save_signature: Value that 1010h requires.
        load_signature: Value that 1011h requires.
        bootloader_signature: Value that the bootloader's object requires.
        store_groups: Sub-index of 1010h and 1011h -> sections that it stores and restores.
        services: Optional services of the node.
        quirks: Deviations from the standard.
    """

    sdo_timeout: float
    boot_time: float
    sdo_time: float
    store_time: float
    frames_per_cycle: int
    receive_buffer: int
    inhibit_unit: float
    event_unit: float
    error_behaviour: dict[int, str]
    objects: dict[str, tuple[int, int]]
    save_signature: int
    load_signature: int
    bootloader_signature: int
    store_groups: dict[int, tuple[str, ...]]
    services: NodeServices = NodeServices()
    quirks: NodeQuirks = NodeQuirks()


class MasterHints(NamedTuple):
    """Facts about a device that a master needs in addition to its EDS; times in s.

    Attributes:
        rpdo_type: Transmission type of an RPDO that waits for SYNC.
        timeout: Longest wait for an answer.
        timeouts: Index -> longest wait, for slow objects.
        turns_positions_round: Objects that change the direction of positions.
        unchecked_motion: Objects of the maker that change speeds, ramps, increments per revolution or commutation,
            while a master checks only those of CiA 402.
        commands: Index -> name, for the device's own writable objects that are not parameters.
        addresses: Index -> description, for objects that a backup contains but that are never restored: after its next
            reset the node would have another address, or be mute.
    """

    rpdo_type: int
    timeout: float
    timeouts: dict[int, float]
    turns_positions_round: tuple[tuple[int, int], ...] = ((cia402.POLARITY, 0),)
    unchecked_motion: tuple[tuple[int, int], ...] = ()
    commands: Mapping[int, str] = MappingProxyType({})
    addresses: Mapping[int, str] = MappingProxyType({})


class Device(NamedTuple):
    """All data of a device; rates in Hz, otherwise SI."""

    name: str
    title: str
    num_axes: int
    eds: Path | EdsText
    bindings: dict[tuple[int, int], Binding]
    current_rate: float
    velocity_rate: float
    supervision_rate: float
    communication_rate: float
    current_full_scale: float
    duty_limit: float
    overcurrent: float
    undervoltage: float
    overvoltage: float
    highest_supply: float
    warning_temperature: float
    error_temperature: float
    nominal_current: float
    overload_time: float
    standstill: float
    write_states: dict[tuple[int, int], str]
    allowed_values: dict[tuple[int, int], tuple[int, ...]]
    unsupported: dict[tuple[int, int], str]
    refuses_same_mode: bool
    emergencies: dict[str, EmergencyCode]
    stage: dict[str, StageParameter]
    presets: Path
    axis_offsets: tuple[AxisOffset, ...]
    canopen: CanopenBehaviour
    master: MasterHints
    roles: dict[Role, tuple[int, int]]
    gains: GainSet
    firmware_name: str
    variant_of: str = ""
    images: Mapping[int, FixedImage] = MappingProxyType({})  # ready-made process images of EtherCAT, by number
    quirks: DriveQuirks = DriveQuirks()
    rated_current: float = math.nan  # [A] of peak i_q, to which thousandths of the rated current or torque refer
    commissioning: str = ""  # "standard": presets follow from the motor's data by the rule for any CiA 402 drive
    ethercat: EtherCatBehaviour | None = None
    about: str = ""  # text on its page in addition to its data
    parts: Mapping[tuple[int, int], Part] = MappingProxyType({})  # objects that show a part of another
    shared_values: frozenset[tuple[int, int]] = frozenset()  # one value for all axes of a node, written by any of them
    kept_bits: Mapping[tuple[int, int], int] = MappingProxyType({})  # bits that are stored of a written value
    num_outputs: int = 4
    without_effect: Mapping[tuple[int, int], str] = MappingProxyType({})  # key of the first axis -> reason
    moved: Mapping[str, str] = MappingProxyType({})  # name or index in an earlier version -> its replacement
    mode_gate: Mapping[int, int] = MappingProxyType({})  # mode of operation -> the manufacturer's mode that it needs
    # Handling of process data above an object's range, `HIGHEST` or `MASK`; other objects keep their value.
    beyond_range: Mapping[tuple[int, int], str] = MappingProxyType({})

    @property
    def cycle(self) -> float:
        """Communication cycle [s]."""
        return 1.0 / self.communication_rate

    @property
    def firmware(self) -> Firmware:
        """The drive's firmware; composed at the first access, compiled at its first use."""
        return find_firmware(self.firmware_name)

    @property
    def motors(self) -> dict[str, Motor]:
        """The catalogue's motors that it can turn, by name: those of a fitting kind and voltage class."""
        return motors_of(motor_kinds(self.firmware_name), self.highest_supply)

    @property
    def default_motor(self) -> str:
        """The default motor of its machines: its firmware's, or the first one that fits."""
        usual, known = default_motor(self.firmware_name), self.motors
        return usual if usual in known else next(iter(known), usual)

    def check_motor(self, motor: Motor) -> None:
        """Raise ValueError, listing the motors that it turns, for one of another kind or voltage class."""
        kinds = motor_kinds(self.firmware_name)
        if motor.kind not in kinds:
            raise ValueError(
                f"{self.name} turns {' and '.join(KINDS[kind] for kind in kinds)} motors; {motor.name} is a "
                f"{KINDS[motor.kind]} motor: take {', '.join(self.motors)}, or a device that turns it"
            )
        if is_extra_low(motor.voltage) != is_extra_low(self.highest_supply):
            side = "above" if is_extra_low(self.highest_supply) else "up to"
            raise ValueError(
                f"{self.name} is built for {self.highest_supply:g} V; {motor.name} is a motor for {motor.voltage:g} V, "
                f"{side} the {EXTRA_LOW_VOLTAGE:g} V between their classes: take {', '.join(self.motors)}, or a device "
                "that turns it"
            )

    def supply_of(self, motor: Motor) -> float:
        """Return the default supply voltage [V] for a motor: the motor's own, limited to the device's highest."""
        return min(motor.voltage, self.highest_supply)

    def torque_of(self, motor: Motor) -> float:
        """Return the torque [N m] of a motor on it: the rated one, or that of its largest current."""
        if self.current_full_scale >= motor.rated_current:
            return motor.rated_torque
        return motor.torque(self.current_full_scale)

    def new_dictionary(self, node_id: int = 1) -> ObjectDictionary:
        """Return the object dictionary of a node of this device."""
        return ObjectDictionary(self.eds, node_id, self.roles, self.moved)

    def locate(self, index: int) -> tuple[int, int]:
        """Return the axis that an object belongs to, and the index of the same object of axis 0."""
        for offset in self.axis_offsets:
            axis, above = divmod(index - offset.first, offset.step)
            if 0 <= axis < self.num_axes and offset.first + above <= offset.last:
                return axis, offset.first + above
        return 0, index

    def is_of_module(self, emergency: str) -> bool:
        """Return whether an emergency concerns all axes of a node: it names none, although others of the device do."""
        row = self.emergencies.get(emergency)
        return row is not None and not row.tells_axis and any(one.tells_axis for one in self.emergencies.values())

    def is_shared(self, index: int) -> bool:
        """Return whether the axes of a node share an object; false for a drive with one axis."""
        ranges = self.axis_offsets
        return bool(ranges) and not any(
            one.first <= index - axis * one.step <= one.last for one in ranges for axis in range(self.num_axes)
        )

    def preset(self, motor: Motor) -> dict[str, int]:
        """Return the commissioning preset of a motor: object name -> raw value, in the order of writing.

        That is the file for a motor of the catalogue, otherwise the result of the device's rule for the motor's data.

        Raises:
            ValueError: For a motor that the drive cannot turn, or for which the user's own device has no preset.
        """
        self.check_motor(motor)
        path = self.presets / f"{motor.name}.toml"
        written_for = find_device(self.variant_of or self.name)
        preset: dict[str, int]
        if path.exists() and MOTORS.get(motor.name) == motor and self._scales_gains_as(written_for):
            preset = dict(read_toml(path)["objects"])
        elif (table := self.presets.parent / "commissioning.toml").exists():
            preset = importlib.import_module("drive_env.devices.commissioning").preset(self, motor, read_toml(table))
        elif self.commissioning == STANDARD_COMMISSIONING:
            preset = importlib.import_module("drive_env.devices.commissioning").standard_preset(self, motor)
        else:
            raise ValueError(
                f"{self.name} has no preset for a {motor.name}; write {path} with [objects], name = integer, or take a "
                f"motor that it has one for: {', '.join(sorted(one.stem for one in self.presets.glob('*.toml')))}"
            )
        if not self.variant_of:
            return preset
        before = find_device(self.variant_of).bindings
        return converted_preset(preset, self.new_dictionary(), before, self.bindings)

    def _scales_gains_as(self, other: Device) -> bool:
        """Return whether the raw integers of gains have the same meaning on both."""
        mine, its = (
            (one.current_full_scale, one.current_rate, one.velocity_rate, one.nominal_current) for one in (self, other)
        )
        return mine == its


def device_names() -> list[str]:
    """Return the names of the known devices."""
    return sorted(path.parent.name for path in FOLDER.glob("*/device.toml"))


def devices_of(kind: int, vendor: int | None, product: int | None) -> list[str]:
    """Return the names of the known devices with a node's identity, several where it does not tell them apart.

    Args:
        kind: Its 1000h; a device and its variants, which are one product, are identified by it.
        vendor: Its 1018h:01.
        product: Its 1018h:02.
    """
    found = []
    for name in device_names():
        dictionary = find_device(name).new_dictionary()
        if (vendor, product) == tuple(dictionary.find((0x1018, sub)).default for sub in (1, 2)):
            found.append((dictionary.find(0x1000).default != kind, name))
    return [name for differs, name in sorted(found) if differs == min(found)[0]]


@cache
def find_device(name: str) -> Device:
    """Return a device by its name, or the user's own by its path: a variant's TOML file, or a device's folder.

    Raises:
        ValueError: For an unknown name, listing the known ones, or a file or folder that does not describe a device.
    """
    folder = FOLDER / name
    if name not in device_names() and is_own_folder(name):
        return _own_device(Path(name))
    if name.endswith(".toml"):
        own = own_variant(Path(name), {known: device_data(FOLDER / known) for known in device_names()})
    elif name in device_names():
        own = device_data(folder)
    else:
        near = did_you_mean(name, device_names())
        raise ValueError(
            f"no device is named {name!r}; there are {', '.join(device_names())}{near}; or give the path of a "
            "variant's .toml file, or of a folder with a device of your own"
        )
    data = own
    if "variant_of" in own:
        base = find_device(own["variant_of"])
        folder = FOLDER / base.name
        data = merged(device_data(folder), own)
        eds: Path | EdsText = compose_eds(f"{name}.eds", eds_text(base.eds), own)
        bindings = variant_bindings(base.bindings, own["objects"])
    else:
        eds, bindings = folder / data["eds"], bindings_of(folder, data)
    return _device(data, folder, eds, bindings, _roles(folder, data), load_gain_set(folder / "gains.toml"))


def _own_device(folder: Path) -> Device:
    """Return the user's own device in a folder; ValueError names the file and its mistake."""
    with naming(folder / "device.toml"):
        data = own_data(folder)
        eds = folder / data["eds"]
    with naming(folder / BINDINGS):
        bindings = bindings_of(folder, data)
    with naming(folder / "roles.toml"):
        roles = _roles(folder, data)
    with naming(folder / "gains.toml"):
        gains = load_gain_set(folder / "gains.toml")
        if missing := [f"{index:04X}h:{sub:02X}" for index, sub in gains.keys if (index, sub) not in bindings]:
            raise ValueError(f"{', '.join(missing)} is not a gain: {BINDINGS} binds it to nothing")
    with naming(folder / "device.toml"):
        device = _device(data, folder, eds, bindings, roles, gains)
    with naming(eds):
        dictionary = device.new_dictionary()
        for key in bindings:
            dictionary.find(key)
        check_scale(roles, dictionary)
    return device


def _device(
    data: Mapping[str, Any],
    folder: Path,
    eds: Path | EdsText,
    bindings: dict[tuple[int, int], Binding],
    roles: dict[Role, tuple[int, int]],
    gains: GainSet,
) -> Device:
    check_rates(data["rates"])
    return Device(
        name=data["name"],
        title=data["title"],
        num_axes=data["axes"],
        eds=eds,
        bindings=bindings,
        current_rate=data["rates"]["current"],
        velocity_rate=data["rates"]["velocity"],
        supervision_rate=data["rates"]["supervision"],
        communication_rate=data["rates"]["communication"],
        current_full_scale=data["current"]["full_scale"],
        duty_limit=data["current"]["duty_limit"],
        overcurrent=data["current"]["overcurrent"],
        undervoltage=data["supply"]["undervoltage"],
        overvoltage=data["supply"]["overvoltage"],
        highest_supply=data["supply"].get("highest", data["supply"]["overvoltage"]),
        warning_temperature=data["temperature"]["warning"],
        error_temperature=data["temperature"]["error"],
        nominal_current=data["current"]["nominal"],
        overload_time=data["current"]["overload_time"],
        standstill=data["motion"]["standstill"],
        write_states={parse_key(text): state for text, state in data["states"].items()},
        allowed_values=allowed_values(data),
        unsupported=_unsupported(data["unsupported"]),
        refuses_same_mode=data["quirks"]["refuses_same_mode"],
        emergencies={name: _emergency(row) for name, row in data["emergencies"].items()},
        stage={n: StageParameter(**row) for n, row in data["stage"].items()},
        presets=folder / "presets",
        axis_offsets=tuple(AxisOffset(**row) for row in data["axis_offsets"]),
        canopen=_canopen(data["canopen"]),
        master=_master(data["master"]),
        roles=roles,
        gains=gains,
        firmware_name=checked_firmware(data["firmware"]),
        variant_of=data.get("variant_of", ""),
        images=fixed_images(folder) | fixed_images(FOLDER / data["name"]),
        quirks=drive_quirks_of(data),
        rated_current=data["current"].get("rated", data["current"]["nominal"]),
        commissioning=data.get("commissioning", ""),
        ethercat=ethercat_of(data.get("ethercat")),
        about=data.get("about", "").strip(),
        parts=parts_of({parse_key(text): row for text, row in data.get("parts", {}).items()}, parse_key),
        without_effect={parse_key(text): why for text, why in data.get("without_effect", {}).items()},
        moved=data.get("moved", {}),
        kept_bits={parse_key(text): int(mask) for text, mask in data.get("kept_bits", {}).items()},
        shared_values=frozenset(parse_key(text) for text in data.get("shared_values", [])),
        num_outputs=data.get("outputs", 4),
        mode_gate={int(mode): needed for mode, needed in data.get("mode_gate", {}).items()},
        beyond_range=_beyond_range(data.get("beyond_range", {})),
    )


def _roles(folder: Path, data: Mapping[str, Any]) -> dict[Role, tuple[int, int]]:
    rows: dict[str, str] = data.get("roles", {}) | read_toml(folder / "roles.toml")
    return {Role[name.upper()]: parse_key(text) for name, text in rows.items()}


def allowed_values(data: Mapping[str, Any]) -> dict[tuple[int, int], tuple[int, ...]]:
    """Return the allowed values of each object that has only a few, from a device's data."""
    rows: dict[str, list[int | str]] = dict(data["values"])
    if data["quirks"]["strict_transmission_types"]:
        rows |= data["strict_transmission_types"]
    return {parse_key(text): tuple(value for item in items for value in _values(item)) for text, items in rows.items()}


def _beyond_range(rows: Mapping[str, str]) -> dict[tuple[int, int], str]:
    for text, rule in rows.items():
        if rule not in (HIGHEST, MASK):
            raise ValueError(f"beyond_range: {text} = {rule!r} must be {HIGHEST!r} or {MASK!r}")
    return {parse_key(text): rule for text, rule in rows.items()}


def _unsupported(data: Mapping[str, Any]) -> dict[tuple[int, int], str]:
    """Return the objects whose write is refused, each with the reason; "" if it depends on the node's services."""
    reasons = {parse_key(text): reason for text, reason in data.get("reasons", {}).items()}
    return {**dict.fromkeys(map(parse_key, data["objects"]), ""), **reasons}


def _emergency(row: Mapping[str, Any]) -> EmergencyCode:
    """Return the row of an emergency: five bytes, with "axis" for the number of the axis."""
    found = tuple(AXIS if byte == "axis" else byte for byte in row["bytes"])
    if len(found) != 5 or any(not isinstance(byte, int) or not AXIS <= byte <= 255 for byte in found):
        raise ValueError(f'bytes = {row["bytes"]} of an emergency are five of 0 to 255, or "axis" in place of one')
    return EmergencyCode(row["code"], found)


def _values(item: int | str) -> Sequence[int]:
    """Return a single value as a list, or all values of a range such as "0...240"."""
    if isinstance(item, int):
        return (item,)
    first, last = item.split("...")
    return range(int(first), int(last) + 1)


def _canopen(data: Mapping[str, Any]) -> CanopenBehaviour:
    rows = {name: data[name] for name in CanopenBehaviour._fields}
    rows |= {
        "error_behaviour": {int(value): state for value, state in data["error_behaviour"].items()},
        "objects": {role: parse_key(text) for role, text in data["objects"].items()},
        "store_groups": {int(sub): tuple(sections) for sub, sections in data["store_groups"].items()},
        "services": services_of(data),
        "quirks": node_quirks_of(data),
    }
    return CanopenBehaviour(**rows)


def _master(data: Mapping[str, Any]) -> MasterHints:
    by_index = {name: {int(index, 16): row for index, row in data[name].items()} for name in OF_INDICES}
    turns, unchecked = (
        tuple(parse_key(text) for text in data[name]) for name in ("turns_positions_round", "unchecked_motion")
    )
    return MasterHints(
        data["rpdo_type"], data["timeout"], turns_positions_round=turns, unchecked_motion=unchecked, **by_index
    )
