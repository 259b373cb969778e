"""The variables of a drive's FMU, as rows; its parameters are the drive's objects and its load's numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.roles import Role
from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.master.parameters import command

INPUT, OUTPUT, PARAMETER = "input", "output", "parameter"
INTEGER, LARGE, REAL, BOOLEAN = "integer", "large", "real", "boolean"  # LARGE: beyond signed 32 bits
AXIS, MACHINE, SUPPLY, NODE = "axis", "machine", "supply", "node"
INT32 = range(-(2**31), 2**31)
FIRST_OF_DEVICE = 0x2000  # objects below are those of communication
_IDENTIFIER = re.compile(r"[A-Za-z_]\w*")


class VariableRow(NamedTuple):
    """Variables of one kind.

    Attributes:
        name: Name in the FMU, after the axis: `axis0.statusword`; without an axis if there is only one.
        causality: INPUT, OUTPUT or PARAMETER.
        kind: INTEGER, LARGE, REAL or BOOLEAN.
        source: The object (index and sub-index, or a role); a text names an attribute or parameter of the machines, or
            the kind of a switch.
        unit: "" if it has none; for objects the dictionary's.
        meaning: Description in one line.
        of: Owner of each variable: an AXIS, a MACHINE, the axes of one SUPPLY, or those of one NODE.
    """

    name: str
    causality: str
    kind: str
    source: Key | Role | str
    unit: str
    meaning: str
    of: str = AXIS


class FmuVariable(NamedTuple):
    """A variable: its name, its row, and its axes."""

    name: str
    row: VariableRow
    axes: tuple[int, ...]


def _object(name: str, causality: str, source: int | Role, meaning: str) -> VariableRow:
    return VariableRow(name, causality, INTEGER, (source, 0) if isinstance(source, int) else source, "", meaning)


# Objects that a drive lacks are left out. Inputs are applied in this order, so that targets precede the controlword.
ROWS = (
    _object("drive_mode", INPUT, Role.MODE_GATE, "the drive's own mode, which a mode of operation needs"),
    _object("mode_of_operation", INPUT, cia402.MODE, "mode of operation"),
    _object("target_position", INPUT, cia402.TARGET_POSITION, "target position"),
    _object("target_velocity", INPUT, cia402.TARGET_VELOCITY, "target velocity"),
    _object("target_torque", INPUT, cia402.TARGET_TORQUE, "target torque"),
    _object("vl_target_velocity", INPUT, cia402.VL_TARGET_VELOCITY, "target velocity of vl"),
    _object("controlword", INPUT, cia402.CONTROLWORD, "controlword"),
    VariableRow("load_torque", INPUT, REAL, "load_torque", "", "on the load, in the direction of turning", MACHINE),
    VariableRow("supply_voltage", INPUT, REAL, "supply", "V", "open-circuit voltage of the supply", SUPPLY),
    VariableRow("enable_input", INPUT, BOOLEAN, "enable_input", "", "the drive's enable input is closed"),
    VariableRow("left_switch", INPUT, BOOLEAN, "left", "", "left limit switch is held pressed from outside"),
    VariableRow("right_switch", INPUT, BOOLEAN, "right", "", "right limit switch is held pressed from outside"),
    VariableRow("home_switch", INPUT, BOOLEAN, "home", "", "home switch is held pressed from outside"),
    _object("statusword", OUTPUT, cia402.STATUSWORD, "statusword"),
    _object("mode_display", OUTPUT, cia402.MODE_DISPLAY, "mode of operation that is active"),
    _object("position_actual_value", OUTPUT, cia402.POSITION_ACTUAL, "measured position"),
    _object("position_demand_value", OUTPUT, cia402.POSITION_DEMAND, "demanded position"),
    _object("velocity_actual_value", OUTPUT, cia402.VELOCITY_ACTUAL, "measured velocity"),
    _object("velocity_demand_value", OUTPUT, cia402.VELOCITY_DEMAND, "demanded velocity"),
    _object("vl_velocity_actual_value", OUTPUT, cia402.VL_VELOCITY_ACTUAL, "measured velocity of vl"),
    _object("vl_velocity_demand", OUTPUT, cia402.VL_VELOCITY_DEMAND, "demanded velocity of vl"),
    _object("torque_actual_value", OUTPUT, cia402.TORQUE_ACTUAL, "measured current or torque"),
    _object("torque_demand_value", OUTPUT, cia402.TORQUE_DEMAND, "demanded current or torque"),
    _object("digital_inputs", OUTPUT, cia402.DIGITAL_INPUTS, "levels of the inputs"),
    VariableRow("rotor_angle", OUTPUT, REAL, "rotor_angle", "rad", "true angle of the rotor"),
    VariableRow("rotor_speed", OUTPUT, REAL, "rotor_speed", "rad/s", "true speed of the rotor"),
    VariableRow("motor_torque", OUTPUT, REAL, "motor_torque", "N*m", "true torque of the motor on its rotor"),
    VariableRow("emergency_code", OUTPUT, INTEGER, "code", "", "code of the last emergency message, 0: none"),
    VariableRow("emergency_count", OUTPUT, INTEGER, "count", "", "emergency messages so far"),
)  # fmt: skip
SWITCHES = ("left", "right", "home")
WRITTEN = ("drive_mode", "mode_of_operation")  # written when they change: an RPDO with a repeated mode is ignored
EMERGENCIES = ("code", "count")


def variables_of(drives: EmulatedDrives, *, is_bare: bool) -> list[FmuVariable]:
    """Return the variables of drives, in the order of their value references.

    Args:
        drives: Emulated drives: the axes of one node, or of as many nodes as a machine of several axes needs.
        is_bare: Whether the shafts have no load, so that their load torque is the shaft torque.
    """
    groups, rows = _groups(drives), []
    known = drives.inside.objects.entries
    for row in ROWS:
        if row.source == "load_torque":
            unit = drives.load.disturbance_unit
            row = row._replace(unit=unit)
            if is_bare:
                row = row._replace(name="shaft_torque", meaning="of the mechanics outside, in the direction of turning")
        if isinstance(row.source, str):
            rows.append(row)
        elif known.has(row.source):
            rows.append(_of_entry(row, known.find(row.source)))
    rows += _parameters(drives)
    found = [
        FmuVariable(row.name if len(groups[row.of]) == 1 else f"axis{axes[0]}.{row.name}", row, axes)
        for row in rows
        for axes in groups[row.of]
    ]
    assert len({one.name for one in found}) == len(found), "names tell variables apart"
    return found


def _groups(drives: EmulatedDrives) -> Mapping[str, list[tuple[int, ...]]]:
    """Return the groups of axes that share a variable, by owner."""
    axes = range(drives.num_axes)

    def by(numbers: Iterator[int]) -> list[tuple[int, ...]]:
        sets: dict[int, tuple[int, ...]] = {}
        for axis, number in zip(axes, numbers, strict=True):
            sets[number] = (*sets.get(number, ()), axis)
        return list(sets.values())

    return {
        AXIS: [(axis,) for axis in axes],
        MACHINE: by(axis // drives.load.num_axes for axis in axes),
        SUPPLY: by(iter(drives.machine.links.tolist())),
        NODE: by(axis // drives.device.num_axes for axis in axes),
    }


def _of_entry(row: VariableRow, entry: Entry) -> VariableRow:
    """Return a row completed by the dictionary's data of its object."""
    assert entry.low is not None and entry.high is not None, "numbers alone are variables"
    fits = entry.low in INT32 and (entry.high in INT32 or row.causality == OUTPUT)
    return row._replace(
        kind=INTEGER if fits else LARGE, unit=entry.unit, meaning=f"{row.meaning} ({entry.index:04X}h:{entry.sub:02X})"
    )


def _parameters(drives: EmulatedDrives) -> Iterator[VariableRow]:
    """Yield the parameters to set before the simulation begins: effective ones of the drive, and those of the load."""
    device, objects = drives.device, drives.inside.objects
    for entry in device.new_dictionary():
        key = entry.index, entry.sub
        axis, base = device.locate(entry.index)
        acts = key in drives.codes or key in objects.scale_keys
        is_parameter = entry.access in ("rw", "rwr", "rww") and not command(base, device.master)
        if axis == 0 and acts and is_parameter and entry.index >= FIRST_OF_DEVICE and entry.bits is not None:
            row = VariableRow(_quoted(entry.name), PARAMETER, INTEGER, key, "", "parameter of the drive")
            yield _of_entry(row._replace(of=NODE if device.is_shared(entry.index) else AXIS), entry)
    for name, parameter in drives.machine.parameter_rows.items():
        if name.startswith("load."):
            meaning = next(one.meaning for one in drives.load.parameters if f"load.{one.name}" == name)
            yield VariableRow(name, PARAMETER, REAL, name, parameter.unit, f"of the load: {meaning}", MACHINE)


def _quoted(name: str) -> str:
    """Return a dictionary's name in FMI's structured form, in quotation marks if it is not an identifier."""
    parts = name.replace("'", "").replace("\\", "").split(".")
    return ".".join(part if _IDENTIFIER.fullmatch(part) else f"'{part}'" for part in parts)
