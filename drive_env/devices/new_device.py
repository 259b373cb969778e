"""A device's folder from a vendor's EDS or ESI: dictionary, bindings, roles, gains, class values, open questions.

All data of the file are used. Data that it lacks and the emulator needs become class values, or objects of the
emulator's own in a free part of the manufacturer's area; each is listed. An object of the EDS without effect here can
still be read and written, and is listed, too.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Any, NamedTuple

from canopen.objectdictionary import ODVariable

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices import find_device
from drive_env.devices.commissioning import STANDARD as STANDARD_RULE
from drive_env.devices.commissioning import beyond_limits
from drive_env.devices.dcf_values import COMMUNICATION, take_stored_values, with_defaults
from drive_env.devices.eds_process_data import RPDOS, TPDOS, repair_process_data
from drive_env.devices.new_images import EtherCatPart, ethercat_part
from drive_env.devices.standard_objects import (
    BY_THEMSELVES,
    GAINS,
    HOMING_METHODS,
    MOTOR,
    NEEDED,
    QUICK_STOP_OPTIONS,
    STANDARD,
    TORQUE,
    WITHOUT_EFFECT,
    OwnObject,
)
from drive_env.devices.variants import TYPES
from drive_env.devices.vendor_esi import read_esi
from drive_env.devices.vendor_units import vendor_units
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.drive_eds import axes_of, other_widths, read_types
from drive_env.dictionary.eds_file import EdsFile, Section, object_section, parse_eds, place_of
from drive_env.dictionary.eds_values import number_of
from drive_env.dictionary.entries import INTEGER_TYPES, EdsText, eds_file
from drive_env.dictionary.roles import VL_FACTORS
from drive_env.dictionary.units import find_unit
from drive_env.whole_file import files_to_be, write_whole

if TYPE_CHECKING:
    from drive_env.firmware.common.modes import Mode
    from drive_env.motors import Motor

Types = Mapping[Key, ODVariable]

TEMPLATE = Path(__file__).parent / "template.toml"
CLASS_VALUES = "no EDS has them: class values of a 24 to 48 V stage"
AS_THE_STANDARD = "no EDS has them: the standard's way; `quirks` and `canopen` of the file formats name what may differ"
LIST_NAME, EDS_NAME = "to_fill_in.md", "drive.eds"
# Place of the emulator's own objects: the first block of the manufacturer's area that the EDS leaves free.
OWN_BLOCKS = range(0x5F00, 0x1FFF, -0x100)
OWN_PER_AXIS = 0x10
OWN_TITLES = ("Emulator: gains", "Emulator: motor", "Emulator: what the EDS lacks")
STORE, RESTORE = 0x1010, 0x1011
SYNC_ID = 0x1005
CONSUMER_HEARTBEAT, GUARD_TIME, ERROR_BEHAVIOUR = 0x1016, 0x100C, 0x1029
STORE_ALL, STORE_COMMUNICATION, STORE_PROFILE = 1, 2, 3  # sub-indices of 1010h (CiA 301); higher ones are the maker's
TRANSMISSION_TYPES = ["0...240", 254, 255]


# Object that shows a mode is supported, for a drive without 6502h.
MODE_NEEDS = {
    cia402.PP: cia402.TARGET_POSITION,
    cia402.VL: cia402.VL_TARGET_VELOCITY,
    cia402.PV: cia402.TARGET_VELOCITY,
    cia402.HM: cia402.HOMING_METHOD,
    cia402.CSP: cia402.TARGET_POSITION,
    cia402.CSV: cia402.TARGET_VELOCITY,
    cia402.CST: cia402.TARGET_TORQUE,
}

# Object that a mode follows; homing uses one of the emulator's own if the drive has none.
MODE_TARGETS = {
    cia402.PP: (cia402.TARGET_POSITION, 0),
    cia402.VL: (cia402.VL_TARGET_VELOCITY, 0),
    cia402.PV: (cia402.TARGET_VELOCITY, 0),
    cia402.TQ: (cia402.TARGET_TORQUE, 0),
    cia402.IP: (cia402.INTERPOLATION_DATA, 1),
    cia402.CSP: (cia402.TARGET_POSITION, 0),
    cia402.CSV: (cia402.TARGET_VELOCITY, 0),
    cia402.CST: (cia402.TARGET_TORQUE, 0),
}


# Limits: a default outside an object's own limits becomes the widest of these; for other objects the nearest.
WIDEST = {(index, 0): "max" for index in (cia402.FOLLOWING_WINDOW, cia402.MAX_TORQUE, cia402.MAX_CURRENT,
          cia402.MAX_PROFILE_VELOCITY, cia402.MAX_MOTOR_SPEED)}  # fmt: skip
WIDEST |= {(cia402.POSITION_LIMITS, 1): "min", (cia402.POSITION_LIMITS, 2): "max"}


class Note(NamedTuple):
    """A line of the list: the subject, and the reason."""

    what: str
    why: str


class NewDevice(NamedTuple):
    """The written folder.

    Attributes:
        folder: The folder.
        fill_in: Values that a person must fill in or check.
        modes: The drive's modes of operation, and their support here.
        without_effect: Objects that are stored and have no effect here.
        repairs: Repairs of the EDS.
    """

    folder: Path
    fill_in: tuple[Note, ...]
    modes: tuple[Note, ...]
    without_effect: tuple[Note, ...]
    repairs: tuple[Note, ...]

    def text(self) -> str:
        """Return the list as Markdown."""
        titles = (
            ("Fill in or check", self.fill_in), ("Modes of operation and homing", self.modes),
            ("Stored, without an effect in the emulator", self.without_effect), ("Put right in the EDS", self.repairs),
        )  # fmt: skip
        lines = [f"# {self.folder.name}: what its EDS does not say", ""]
        for title, notes in titles:
            lines += [
                f"## {title}",
                "",
                *(f"- {note.what}: {note.why}" for note in notes),
                *([] if notes else ["nothing"]),
                "",
            ]
        return "\n".join(lines)


def new_device(
    eds: Path | None,
    folder: Path,
    motor: Motor,
    *,
    velocity_unit: str = "",
    acceleration_unit: str = "",
    esi: Path | None = None,
    product: str = "",
    on_ethercat: bool = False,
) -> NewDevice:
    """Write the folder of a device that its EDS or ESI describes; return it with the notes for a person.

    Args:
        eds: The vendor's EDS; None if its ESI has the dictionary.
        folder: The folder to create.
        motor: Motor to whose rated current thousandths refer.
        velocity_unit: Unit of speeds, "rpm", "pps", "0.1 rpm" ..., if the file names none.
        acceleration_unit: Unit of accelerations, likewise.
        esi: The vendor's ESI, for a device on EtherCAT with its images and identity; None without one.
        product: Name of the device in an ESI with several.
        on_ethercat: Whether to make a device on EtherCAT from an EDS alone.

    Raises:
        ValueError: For a file that does not describe a CiA 402 drive, a folder that exists, or an unknown unit.
        RuntimeError: For a drive that could not be moved in any mode.
    """
    if folder.exists():
        raise ValueError(f"{folder} exists already, and is not overwritten; choose another folder with --out")
    if eds is not None and not eds.is_file():
        raise ValueError(f"there is no EDS at {eds}; give the path of the drive's .eds file")
    for unit in (velocity_unit, acceleration_unit):
        if unit:
            find_unit(unit)
    part = None
    if esi is not None:
        part = ethercat_part(eds, read_esi(esi, product), str(esi))
    elif eds is None:
        raise ValueError("no file is given; name the drive's EDS, its ESI, or both: --eds drive.eds --esi drive.xml")
    elif on_ethercat:
        part = ethercat_part(eds, None, str(eds))
    source = eds if part is None else part.eds
    assert source is not None, "an EDS, or what was made of an ESI"
    draft = _Draft(source, (esi or eds or folder).name, motor, velocity_unit, acceleration_unit, part)
    made = draft.made(folder)
    try:
        with files_to_be({folder / name: text for name, text in draft.files(folder).items()}):
            pass
        device = find_device.__wrapped__(str(folder))  # not cached: a person will edit these files
        limited = beyond_limits(device, motor, draft.stored_values())
        notes = tuple(Note(f"{_text(key)} of drive.eds", why) for key, why in limited.items())
        made = made._replace(fill_in=(*notes, *made.fill_in))
        write_whole(folder / LIST_NAME, made.text())
    except BaseException:
        rmtree(folder, ignore_errors=True)  # an existing folder would be refused the next time
        raise
    return made


class _Draft:
    """The device of one EDS in progress; `part` is its part for EtherCAT, None on CAN."""

    def __init__(
        self,
        eds: Path | EdsText,
        name: str,
        motor: Motor,
        velocity_unit: str,
        acceleration_unit: str,
        part: EtherCatPart | None,
    ) -> None:
        self._eds, self._name, self._motor, self._part = eds, name, motor, part
        self._file: EdsFile = eds_file(eds)
        try:
            self._types: Types = read_types(eds)
        except Exception as error:  # the reader raises any exception for a broken line
            raise ValueError(f"{eds} cannot be read as an EDS: {error}") from error
        self._axes = axes_of(eds, self._types)
        for index in (cia402.CONTROLWORD, cia402.MODE):
            if (index, 0) not in self._types:
                raise ValueError(f"{eds} describes no drive that could be enabled: it has no {index:04X}h")
        self._sections: dict[str, Section] = {name: dict(row) for name, row in self._file.sections.items()}
        self._fill_in: list[Note] = []
        self._told_of_modes: list[Note] = []
        self._changes: list[Note] = []
        self._stored = take_stored_values(eds, self._sections)
        self._sections.pop("DeviceComissioning", None)
        self._leave_out_own_objects()
        self._units = vendor_units(with_defaults(self._types, self._stored), velocity_unit, acceleration_unit)
        self._base = self._free_block()
        self._modes = self._supported_modes()
        self._bindings = self._standard_bindings()
        self._roles: dict[str, Key] = dict(self._units.scale) | self._vl_factors()
        self._own: list[tuple[Key, OwnObject]] = []
        self._take_current_limit()
        self._add_own_objects()
        self._correct_defaults()
        if part is None:
            self._changes += [Note(*row) for row in repair_process_data(self._sections, self._types)]
            self._drop_wrong_process_data()
            self._tell_of_communication()
        else:
            self._fill_in += [Note(*row) for row in part.class_values]
            self._changes += [Note(*row) for row in part.changes]
        self._tell_of_units()
        self._drop_twinless()
        self._check_stored_values()
        self._fill_in += [
            Note(f"{index:04X}h", f"has {bits} bits in the EDS and {usual} in CiA 402: taken as the EDS has it")
            for (index, _), bits, usual in other_widths(self._types)
        ]

    def made(self, folder: Path) -> NewDevice:
        repairs = [Note(one.where, one.what) for one in self._file.repairs]
        return NewDevice(
            folder,
            tuple(self._fill_in + self._class_values()),
            tuple(self._told_of_modes),
            tuple(self._without_effect()),
            tuple(repairs + self._changes),
        )

    def files(self, folder: Path) -> dict[str, str]:
        """Return the folder's files."""
        stored = "".join(f'"{name}" = {raw}\n' for name, raw in self.stored_values().items())
        head = "# What the drive of the DCF was commissioned with; the rest follows from the motor.\n\n"
        return {
            **({"commissioning.toml": f'{head}rule = "{STANDARD_RULE}"\n\n[objects]\n{stored}'} if stored else {}),
            "device.toml": self._device_toml(folder),
            EDS_NAME: parse_eds(EdsFile(self._sections, ()).text()).text(),
            "bindings.toml": self._bindings_toml(),
            "roles.toml": "# Which object plays which part.\n\n"
            + "".join(f'{name} = "{_text(key)}"\n' for name, key in self._roles.items()),
            "gains.toml": self._gains_toml(),
        }

    def stored_values(self) -> dict[str, int]:
        """Return the values of a DCF by the objects' names in a folder's files."""
        return {_text(key): raw for key, raw in self._stored.items()}

    # --- what the file says of one drive ------------------------------------------------------------------------------
    def _leave_out_own_objects(self) -> None:
        """Remove the emulator's own objects from the file of an exported folder: they are made anew."""
        own = {
            place[0]
            for name, row in self._sections.items()
            if (place := place_of(name)) is not None and row.get("ParameterName", "") in OWN_TITLES
        }
        wiring = {index for index in own if self._sections[object_section(index)]["ParameterName"] == OWN_TITLES[1]}
        self._types = {key: one for key, one in self._types.items() if key[0] not in own}
        self._stored = {key: raw for key, raw in self._stored.items() if key[0] not in wiring}
        for name in [name for name in self._sections if (place_of(name) or (0, 0))[0] in own]:
            del self._sections[name]

    def _drop_wrong_process_data(self) -> None:
        """Restore the defaults of PDOs whose values in a DCF are impossible."""
        told = list(repair_process_data(copy.deepcopy(self._sections), with_defaults(self._types, self._stored)))
        known = {note.what for note in self._changes}
        for where, why in told:
            index, _ = place_of(where.strip("[]")) or (0, 0)
            of_pdo = {index, index + 0x200, index - 0x200} & {key[0] for key in self._stored}
            if where not in known and of_pdo:
                self._stored = {key: raw for key, raw in self._stored.items() if key[0] not in of_pdo}
                self._changes.append(Note(where, f"the DCF's values are not taken: {why}"))

    def _check_stored_values(self) -> None:
        """Remove values of a DCF that their objects cannot hold here."""
        allowed = {(cia402.HOMING_METHOD, 0): {0, *self._homing_methods()}, (cia402.QUICK_STOP_OPTION, 0):
                   set(QUICK_STOP_OPTIONS)}  # fmt: skip
        for key, raw in list(self._stored.items()):
            variable = self._types.get(key)
            low, high = (None, None) if variable is None else (variable.min, variable.max)
            possible = raw in allowed.get((cia402.of_first_axis(key[0]), key[1]), (raw,))
            possible &= raw > 0 or key not in self._units.scale.values()
            possible &= not {object_section(*key), object_section(key[0])}.isdisjoint(self._sections)
            if not possible or (low is not None and raw < low) or (high is not None and raw > high):
                del self._stored[key]
                self._changes.append(Note(f"[{_text(key)}]", f"ParameterValue={raw} is not possible here: not taken"))
        if self._stored:
            why = "hold whatever the motor; the rest follows from it"
            self._fill_in.append(Note(f"commissioning.toml, {len(self._stored)} values of the DCF", why))

    # --- what the drive has ---------------------------------------------------------------------------------------
    def _default(self, index: int, sub: int = 0) -> int:
        found = self._types.get((index, sub))
        return found.default if found is not None and isinstance(found.default, int) else 0

    def _supported_modes(self) -> list[int]:
        """Return the numbers of the modes that both drive and emulator support."""
        from drive_env.firmware.common.modes import MODES  # imports the compiler

        bits = self._default(cia402.SUPPORTED_MODES)
        here = [mode for mode in MODES if mode.supported_bit is not None]
        if bits == 0:
            found = [mode for mode in here if (MODE_NEEDS.get(mode.number, -1), 0) in self._types]
            found = [mode for mode in found if self._is_within_6060h(mode)]
            listed = ", ".join(mode.abbreviation for mode in found)
            self._fill_in.append(
                Note(
                    f'[values] "{cia402.MODE:04X}:0" of device.toml',
                    f"6502h tells no modes: {listed} by the objects that it has",
                )
            )
        else:
            found = [mode for mode in here if mode.supported_bit is not None and bits >> mode.supported_bit & 1]
            known = {mode.supported_bit for mode in here}
            found = [mode for mode in found if self._has_target(mode) and self._is_within_6060h(mode)]
            others = [bit for bit in range(16) if bits >> bit & 1 and bit not in known]
            self._told_of_modes += [
                Note(f"mode {bit + 1}", "6502h has it, and the emulator does not: 6060h refuses it") for bit in others
            ]
        methods = self._homing_methods()
        numbers = [mode.number for mode in found if mode.number != cia402.HM or methods]
        names = [mode.abbreviation for mode in found if mode.number in numbers]
        if not numbers:
            why = "".join(f"; {note.what}: {note.why}" for note in self._told_of_modes)
            raise RuntimeError(
                f"{self._name}: the drive would have no mode of operation that works here{why}; nothing was written. "
                "Complete a copy of the file: 6502h with the drive's modes, the target of one (6042h for vl, 60FFh for "
                "pv, 607Ah for pp), and limits of 6060h that have its number"
            )
        self._told_of_modes.insert(0, Note("taken", ", ".join(names)))
        if cia402.HM in numbers:
            self._told_of_modes.append(
                Note("homing methods", ", ".join(map(str, methods)) + " of 6098h; others are refused")
            )
            self._told_of_modes += [
                Note(
                    f"homing method {one}",
                    f"60E3h has it, and the emulator does not: {_why_not(one)}; 6098h refuses it",
                )
                for one in sorted(self._listed_methods() - set(methods))
            ]
        return numbers

    def _is_within_6060h(self, mode: Mode) -> bool:
        """Return whether the limits of 6060h include a mode; note one that they exclude."""
        variable = self._types[cia402.MODE, 0]
        low = -128 if variable.min is None else variable.min
        high = 127 if variable.max is None else variable.max
        if low <= mode.number <= high:
            return True
        why = f"6060h takes {low} to {high} alone by its limits, and refuses it"
        self._told_of_modes.append(Note(f"mode {mode.number}, {mode.abbreviation}", why))
        return False

    def _has_target(self, mode: Mode) -> bool:
        """Return whether the drive has the object that a mode of 6502h follows; note a mode without it."""
        key = MODE_TARGETS.get(mode.number)
        variable = None if key is None else self._types.get(key)
        if key is not None and (variable is None or variable.data_type not in INTEGER_TYPES):
            why = f"6502h has it, and the EDS no {key[0]:04X}h:{key[1]:02X} that is an integer: 6060h refuses it"
            self._told_of_modes.append(Note(f"mode {mode.number}, {mode.abbreviation}", why))
            return False
        if mode.number == cia402.IP:
            why = "60C1h:01 is followed as csp follows 607Ah, without waiting for bit 4 of the controlword"
            self._told_of_modes.append(Note("ip", why))
        return True

    def _homing_methods(self) -> list[int]:
        """Return the homing methods that both support: within 6098h's limits, and in 60E3h if that lists any."""
        variable = self._types.get((cia402.HOMING_METHOD, 0))
        low = -128 if variable is None or variable.min is None else variable.min
        high = 127 if variable is None or variable.max is None else variable.max
        listed = self._listed_methods()
        return [one for one in HOMING_METHODS if low <= one <= high and (not listed or one in listed)]

    def _listed_methods(self) -> set[int]:
        """Return the methods that 60E3h lists."""
        return {self._default(cia402.HOMING_METHODS, sub) for sub in range(1, 255)} - {0}

    def _standard_bindings(self) -> dict[Key, Binding]:
        found = {}
        for row in STANDARD:
            variable = self._types.get((row.index, row.sub))
            if variable is not None and variable.data_type in INTEGER_TYPES:
                found[row.index, row.sub] = row.__class__(
                    row.index, row.sub, row.field, self._unit(row.unit), row.part, row.event
                )
        return found

    def _unit(self, name: str) -> str:
        factors = self._vl_factors()
        by_dimension = "velocity unit" if "velocity_numerator" in factors else "rpm"
        return {
            "velocity": self._units.velocity,
            "acceleration": self._units.acceleration,
            "torque": self._units.torque,
            "vl velocity": by_dimension,
            "vl target": "set-point unit" if "set_point_numerator" in factors else by_dimension,
        }.get(name, name)

    def _vl_factors(self) -> dict[str, Key]:
        """Return the objects of the factors of vl that the drive has, by role."""
        return {role.name.lower(): key for role, key in VL_FACTORS.items() if key in self._types}

    def _take_current_limit(self) -> None:
        """Bind 6072h as the current limit of a drive without 6073h: by its rated torque it is equivalent."""
        limit, torque = (cia402.MAX_CURRENT, 0), (cia402.MAX_TORQUE, 0)
        if limit not in self._bindings and torque in self._types:
            self._bindings[torque] = Binding(*torque, "i_max", self._unit(TORQUE))
        for key in (limit, torque):
            if key in self._bindings:
                self._roles["current_limit"] = key
                return

    # --- missing objects ------------------------------------------------------------------------------------------
    def _free_block(self) -> int:
        used = {index for index, _ in self._types}
        for base in OWN_BLOCKS:
            if not used & set(range(base, base + OWN_PER_AXIS * self._axes)):
                return base
        raise ValueError(f"{self._eds} leaves no room in 2000h to 5FFFh for the emulator's own objects")

    def _add_own_objects(self) -> None:
        fields = {row.field for row in self._bindings.values()}
        if self._units.scale:
            fields.add("position_scaler")
        others = [
            row
            for row in NEEDED
            if not {row.field, row.unless} & fields
            and (not row.modes or any(mode in self._modes for mode in row.modes))
        ]
        for offset, (title, rows) in enumerate(zip(OWN_TITLES, (GAINS, MOTOR, others), strict=True)):
            for sub, row in enumerate(rows, 1):
                key = (self._base + offset, sub)
                self._own.append((key, row))
                self._bindings[key] = Binding(*key, row.field, self._unit(row.unit))
            for axis in range(self._axes if rows else 0):
                self._write_own(self._base + offset + axis * OWN_PER_AXIS, title, rows)
        told = self._units.increments
        for key, row in self._own:
            if row.role:
                self._roles[row.role] = key
            if row.field == "position_scaler" and told:
                why = f"{told} units a turn by {self._units.sources['position']}, which no object has"
            else:
                why = row.why
            if why:
                self._fill_in.append(
                    Note(f"{_text(key)} {row.name}", f"the EDS has {why}: an object of the emulator's own")
                )
        own = f"{self._base:04X}h and {self._base + 1:04X}h"
        why = (
            "gains and motor: the emulator's own, which the real drive has elsewhere; their values follow from --motor"
        )
        self._fill_in.append(Note(own, why))

    def _write_own(self, index: int, title: str, rows: Sequence[OwnObject]) -> None:
        told = self._units.increments
        self._sections[object_section(index)] = {"ParameterName": title, "ObjectType": "0x9"}
        self._sections[object_section(index, 0)] = {
            "ParameterName": "Highest sub-index", "DataType": f"0x{TYPES['u8']:04X}", "AccessType": "const",
            "DefaultValue": str(len(rows)),
        }  # fmt: skip
        for sub, row in enumerate(rows, 1):
            unit = self._unit(row.unit)
            section = {"ParameterName": row.name, "DataType": f"0x{TYPES[row.kind]:04X}", "AccessType": row.access}
            shown = {} if unit == "raw" else {"Unit": _shown(unit)}
            default = (told or round(self._motor.encoder_counts)) if row.field == "position_scaler" else 0
            self._sections[object_section(index, sub)] = section | {"DefaultValue": str(default)} | shown

    def _correct_defaults(self) -> None:
        """Correct factory values that the emulator cannot have, and add units to bound objects."""
        for key, binding in self._bindings.items():
            row = self._section(key)
            if binding.unit != "raw" and not row.get("Unit"):
                row["Unit"] = _shown(binding.unit)
        for index, allowed, instead in (
            (cia402.QUICK_STOP_OPTION, QUICK_STOP_OPTIONS, 2), (cia402.MODE, (0, *self._modes), 0),
        ):  # fmt: skip
            if (index, 0) in self._types and self._default(index) not in allowed:
                self._changes.append(
                    Note(f"[{index:04X}]", f"DefaultValue={self._default(index)} is not possible here: it is {instead}")
                )
                self._section((index, 0))["DefaultValue"] = str(instead)
        exponent = (cia402.INTERPOLATION_PERIOD, 2)
        if exponent in self._types and self._types[exponent].default is None:
            self._section(exponent)["DefaultValue"] = "-3"
            self._changes.append(Note(f"[{_text(exponent)}]", "has no default: -3, milliseconds"))
        self._correct_scale()
        self._correct_defaults_beyond_limits()
        self._correct_factors()
        for key, variable in self._types.items():
            if isinstance(variable.default, int) and variable.default >= 1 << 63:
                self._section(key)["DefaultValue"] = "0"
                self._changes.append(Note(f"[{_text(key)}]", "the emulator keeps 63 bits: its default is 0"))

    def _correct_defaults_beyond_limits(self) -> None:
        """Correct the factory value of an object (0 if the file has none) to one that its own limits allow."""
        for key, variable in self._types.items():
            if key[0] in COMMUNICATION or variable.data_type not in INTEGER_TYPES or key in self._units.scale.values():
                continue
            raw = variable.default if isinstance(variable.default, int) else 0
            _, low, high = INTEGER_TYPES[variable.data_type]
            low = low if variable.min is None else variable.min
            high = high if variable.max is None else variable.max
            if low <= raw <= high:
                continue
            end = WIDEST.get((cia402.of_first_axis(key[0]), key[1]))
            value = min(max(raw, low), high) if end is None else {"min": low, "max": high}[end]
            self._section(key)["DefaultValue"] = str(value)
            was = "none" if variable.default is None else str(raw)
            self._changes.append(Note(f"[{_text(key)}]", f"default {was} lies outside {low} to {high}: {value}"))

    def _correct_scale(self) -> None:
        """Prevent 0 in objects of the position scale, which divide."""
        keys = list(self._units.scale.values())
        lacking = any(self._default(*key) <= 0 for key in keys)
        for k, key in enumerate(keys):
            row = self._section(key)
            row["LowLimit"] = str(max(number_of(row.get("LowLimit", "")) or 0, 1))
            value = round(self._motor.encoder_counts) if k == 0 else 1
            if lacking and self._default(*key) != value:
                row["DefaultValue"] = str(value)
                why = "with the others makes no scale of positions"
                self._changes.append(
                    Note(f"[{_text(key)}]", f"DefaultValue={self._default(*key)} {why}: it is {value}")
                )

    def _correct_factors(self) -> None:
        """Require at least 1 in the factors of vl: 0 would divide, and negative ones would reverse directions."""
        for key in self._vl_factors().values():
            row = self._section(key)
            row["LowLimit"] = str(max(number_of(row.get("LowLimit", "")) or 0, 1))
            if self._default(*key) < 1:
                row["DefaultValue"] = "1"
                self._changes.append(
                    Note(f"[{_text(key)}]", f"DefaultValue={self._default(*key)} is not possible here: it is 1")
                )

    def _section(self, key: Key) -> Section:
        name = object_section(*key)
        return self._sections[name] if name in self._sections else self._sections[object_section(key[0])]

    def _drop_twinless(self) -> None:
        """Remove objects of further axes that the first axis lacks: their meaning cannot be derived."""
        for index, sub in list(self._types):
            first = cia402.of_first_axis(index)
            if self._axes > 1 and first != index and (first, sub) not in self._types and index in cia402.PROFILE_AREAS:
                self._sections.pop(object_section(index, sub), None)
                self._sections.pop(object_section(index), None)
                self._changes.append(
                    Note(f"[{_text((index, sub))}]", "was left out: the first axis has no such object")
                )

    def _tell_of_communication(self) -> None:
        if (SYNC_ID, 0) not in self._types:
            self._fill_in.append(Note(f"{SYNC_ID:04X}h", "the EDS has none: SYNC is taken as 080h, as CiA 301 has it"))
        indices = {index for index, _ in self._types}
        if not {CONSUMER_HEARTBEAT, GUARD_TIME} & indices:
            self._fill_in.append(
                Note(
                    f"{CONSUMER_HEARTBEAT:04X}h and {GUARD_TIME:04X}h",
                    "the EDS has neither: the drive does not notice when its master dies, and goes on with what it was "
                    "last told. Only jog, move and home with --no-watchdog move it, or Limits(silence=None) in Python; "
                    "keep the emergency stop at hand",
                )
            )
        fixed = [f"{index:04X}h" for index in sorted(indices) if self._is_fixed_pdo(index)]
        if fixed:
            self._fill_in.append(
                Note(", ".join(fixed), "sub-index 1 can only be read: masters take them as they stand, or go by SDO")
            )

    def _is_fixed_pdo(self, index: int) -> bool:
        cob_id = self._types.get((index, 1))
        is_pdo = index in RPDOS or index in TPDOS
        return is_pdo and cob_id is not None and cob_id.access_type in ("ro", "const")

    def _tell_of_units(self) -> None:
        units = self._units
        for quantity, unit in (
            ("velocity", units.velocity),
            ("acceleration", units.acceleration),
            ("torque", units.torque),
        ):
            where = units.sources[quantity]
            if not where:
                why = "the EDS tells no unit known here: the standard's, or what fits the others; read the manual"
                self._fill_in.append(Note(f"unit of {quantity} in bindings.toml, {_shown(unit)}", why))
        self._fill_in += [Note(*row) for row in units.notes]
        if units.scale and min(self._default(*key) for key in units.scale.values()) <= 0:
            self._fill_in.append(
                Note(units.sources["position"], "has no factory value: the counts of the motor's encoder")
            )

    def _class_values(self) -> list[Note]:
        base = f"base of thousandths: {self._motor.rated_current:g} A peak of {self._motor.name}"
        return [
            Note("[current] rated of device.toml", base),
            Note("[rates], [current], [supply], [temperature], [stage] of device.toml", CLASS_VALUES),
            Note("[quirks] and [canopen] of device.toml", AS_THE_STANDARD),
            Note("[emergencies] of device.toml", "codes of CiA 402; the maker's table may have others"),
        ]

    def _without_effect(self) -> Iterable[Note]:
        own = {index for (index, _), _ in self._own}
        scale = {index for index, _ in self._roles.values()}
        bound = {index for index, _ in self._bindings}
        for index in sorted({index for index, _ in self._types}):
            first = cia402.of_first_axis(index)
            if first in bound | own | scale or first in BY_THEMSELVES or index < 0x2000:
                continue
            yield Note(f"{index:04X}h", WITHOUT_EFFECT.get(first, "nothing here reads it"))

    # --- files ----------------------------------------------------------------------------------------------------
    def _device_toml(self, folder: Path) -> str:
        text = TEMPLATE.read_text(encoding="utf-8")
        info, current = self._sections.get("DeviceInfo", {}), self._motor.rated_current
        title = " ".join(filter(None, (info.get("VendorName"), info.get("ProductName")))) or Path(self._name).stem
        head = (
            f"# Made from {self._name} by drive-env new; {LIST_NAME} lists what a person must fill in.\n"
            f"name = {_quoted(folder.name)}\ntitle = {_quoted(title)}\neds = {_quoted(EDS_NAME)}\n"
            f'firmware = "servo"\naxes = {self._axes}\n'
        )
        if self._axes > 1:
            text = text.replace("axis_offsets = []", self._axis_offsets())
        text = text.replace(
            "[current]  # A of peak i_q\n",
            f"[current]  # A of peak i_q\nrated = {current:.6g}  # base of thousandths: {self._motor.name}\n",
        )
        if info.get("LSS_Supported", "0") not in ("", "0"):
            text += "\n[canopen.services]\nlss = true\n"
        return f"{head}{text}\n{self._tables()}" + ("" if self._part is None else f"\n{self._part.toml()}")

    def _axis_offsets(self) -> str:
        rows = [
            (cia402.PROFILE_AREAS.start, cia402.SINGLE_DEVICE_TYPE, cia402.AXIS_OFFSET),
            (self._base, self._base + OWN_PER_AXIS - 1, OWN_PER_AXIS),
        ]
        listed = "".join(f"    {{ first = 0x{a:04X}, last = 0x{b:04X}, step = 0x{c:X} }},\n" for a, b, c in rows)
        return f"axis_offsets = [\n{listed}]"

    def _tables(self) -> str:
        values: dict[str, list[Any]] = {f"{cia402.MODE:04X}:0": [0, *self._modes]}
        if (cia402.QUICK_STOP_OPTION, 0) in self._types:
            values[f"{cia402.QUICK_STOP_OPTION:04X}:0"] = [*QUICK_STOP_OPTIONS]
        method = next((key for key, row in self._bindings.items() if row.field == "homing_method"), None)
        if method is not None:
            values[_text(method)] = [0, *self._homing_methods()]
        for index, sub in self._types:
            if sub == 2 and (0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00):
                values[_text((index, sub))] = [*TRANSMISSION_TYPES]
            if index == ERROR_BEHAVIOUR and sub > 0:
                values[_text((index, sub))] = [0, 1, 2]
        stored = sorted(sub for index, sub in self._types if index == STORE and sub > 0)
        services = [
            _text((index, sub)) for index in (STORE, RESTORE) for i, sub in self._types if i == index and sub > 0
        ]
        lines = ["[values]  # objects that know a few values only"]
        lines += [f'"{key}" = [{", ".join(map(_toml, row))}]' for key, row in values.items()]
        lines += ["", "[unsupported]  # without a node on a bus"]
        lines += [f"objects = [{', '.join(map(_quoted, services))}]", "", "[canopen.store_groups]  # CiA 301, 1010h"]
        motors = [f"motor {axis}" for axis in range(self._axes)] + ["module"]
        groups = {
            STORE_ALL: ["bus", "communication", "profile", *motors],
            STORE_COMMUNICATION: ["bus", "communication"],
            STORE_PROFILE: ["profile"],
        }
        lines += [f"{sub} = [{', '.join(map(_quoted, groups.get(sub, motors)))}]" for sub in stored]
        return "\n".join(lines) + "\n"

    def _bindings_toml(self) -> str:
        lines = ["# Objects and the fields of the drive record that they are, in their units.", ""]
        for key, row in self._bindings.items():
            parts = [f'field = "{row.field}"']
            parts += [f'unit = "{row.unit}"'] if row.unit != "raw" else []
            parts += [f'event = "{row.event}"'] if row.event else []
            lines.append(f'"{_text(key)}" = {{ {", ".join(parts)} }}')
        return "\n".join(lines) + "\n"

    def _gains_toml(self) -> str:
        lines = ["# Gains of the emulator's own cascade; the real drive has its own.", "", 'cascade = "pi"', ""]
        for key, row in self._own[: len(GAINS)]:
            loop, part = row.name.lower().split()
            lines += ["[[gain]]", f'name = "{"torque" if loop == "current" else loop}_{part}"', f'title = "{row.name}"',
                      f'object = "{_text(key)}"', "highest = 1_000_000", f'loop = "{loop}"', f'part = "{part.upper()}"',
                      ""]  # fmt: skip
        return "\n".join(lines)


def _why_not(method: int) -> str:
    """Return why the emulator lacks a homing method that an EDS lists."""
    if method < 0:
        return "negative numbers are the maker's own methods"
    if method in HOMING_METHODS:
        return "it lies outside 6098h's limits"
    return "the standard has none of that number"


def _text(key: Key) -> str:
    return f"{key[0]:04X}:{key[1]}"


def _shown(unit: str) -> str:
    """Return a unit as written in the EDS: a position's unit is an increment, whatever its limits mean."""
    return "inc" if unit in ("counter", "position window", "position limit") else unit


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _toml(value: int | str) -> str:
    return str(value) if isinstance(value, int) else _quoted(value)
