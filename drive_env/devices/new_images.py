"""A new device on EtherCAT: its dictionary with images, and the table `ethercat` of its data.

The images are those of the ESI, or those of the EDS' mapping objects (1600h and 1A00h on); if neither can move the
drive in a cyclic mode, it gets images for csp, csv and cst. Objects that belong only to CAN are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from canopen.objectdictionary import ODVariable, datatypes

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices.eds_process_data import RPDOS, TPDOS
from drive_env.devices.esi_dictionary import TYPES as ESI_TYPES
from drive_env.devices.esi_dictionary import dictionary_sections
from drive_env.devices.ethercat import MEMORY, EtherCatBehaviour, Place
from drive_env.devices.vendor_esi import CLASS_CYCLE, CLASS_EEPROM, MOST_ENTRIES, RX_PDOS, TX_PDOS, VendorEsi, one_line
from drive_env.dictionary.drive_eds import axes_of, read_types
from drive_env.dictionary.eds_file import UNSIGNED, EdsFile, Section, object_section, parse_eds, place_of
from drive_env.dictionary.eds_values import number_of
from drive_env.dictionary.entries import INTEGER_TYPES, EdsText, eds_file

ASSIGNMENTS = {True: 0x1C12, False: 0x1C13}  # the objects that sync managers 2 and 3 carry
SYNC_MANAGER_TYPES = 0x1C00
IDENTITY = 0x1018
# SYNC, emergencies, heartbeat, guarding, error behaviour, SDO channels and PDOs of CANopen.
ONLY_ON_CAN = (
    range(0x1005, 0x1008), range(0x100C, 0x100E), range(0x1012, 0x1018), range(0x1019, 0x101A), range(0x1028, 0x102A),
    range(0x1200, 0x1300), RPDOS, TPDOS,
)  # fmt: skip
WIDTHS = (8, 16, 32, 64)  # bits of objects that an image carries
LONGEST_GAP = 64  # bits
ROOM = 8  # entries of an axis that our mapping objects hold
ALWAYS_SHOWN = ("name", "title", "activation")  # keys of a clock's row
SMALLEST_EEPROM, BESIDE_IMAGES, CLOCK_ROW = 2048, 600, 24  # bytes; a name, type and group of 100 letters each in it
BUFFERS = 3  # of a sync manager with process data
# Images for a drive without any: by mode, the object that is followed.
OWN_SET = (("csp", cia402.TARGET_POSITION), ("csv", cia402.TARGET_VELOCITY), ("cst", cia402.TARGET_TORQUE),
           ("vl", cia402.VL_TARGET_VELOCITY))  # fmt: skip
SHOWN = (cia402.STATUSWORD, cia402.MODE_DISPLAY, cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL,
         cia402.VL_VELOCITY_ACTUAL)  # fmt: skip
CLASS_LAYOUT = EtherCatBehaviour(
    Place(0x1000, 256), Place(0x1100, 256), 0x1200, 0x1800, CLASS_CYCLE, CLASS_EEPROM, Place(0x1000, 256),
    Place(0x1100, 256),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Pdo:
    """A mapping object to be written: `raws` are its entries, `room` the number that it can hold."""

    index: int
    name: str
    is_output: bool
    is_fixed: bool
    raws: tuple[int, ...]
    room: int

    @property
    def keys(self) -> set[Key]:
        """Return the mapped objects."""
        return {(raw >> 16, raw >> 8 & 0xFF) for raw in self.raws if raw >> 16}

    @property
    def size(self) -> int:
        """Return the length of the mapped data [bytes]."""
        return sum(raw & 0xFF for raw in self.raws) // 8


class EtherCatPart(NamedTuple):
    """A new device's part for EtherCAT.

    Attributes:
        eds: Its dictionary, with images.
        behaviour: The table `ethercat`.
        class_values: Values that a person must check, with reasons.
        changes: Repairs and omissions: place, and change.
    """

    eds: EdsText
    behaviour: EtherCatBehaviour
    class_values: tuple[tuple[str, str], ...]
    changes: tuple[tuple[str, str], ...]

    def toml(self) -> str:
        """Return the table of device.toml."""
        one = self.behaviour
        lines = ["[ethercat]", *(f"{name} = [0x{place.start:04X}, {place.length}]" for name, place in (
            ("receive", one.receive), ("send", one.send), ("bootstrap_receive", one.bootstrap_receive),
            ("bootstrap_send", one.bootstrap_send)) if place is not None)]  # fmt: skip
        lines += [f"outputs = 0x{one.outputs:04X}", f"inputs = 0x{one.inputs:04X}"]
        lines += [f"shortest_cycle = {one.shortest_cycle:g}  # s", f"eeprom = {one.eeprom}  # bytes"]
        lines += [f"order = {_quoted(one.order)}"] if one.order else []
        lines += [f"controls = [{', '.join(f'0x{control:02X}' for control in one.controls)}]"]
        lines += [f"coe = [{', '.join(map(_quoted, one.coe))}]", f"has_foe = {str(one.has_foe).lower()}"]
        lines += ["clocks = ["]
        for mode in one.clocks:
            shown = {key: value for key, value in mode._asdict().items() if value or key in ALWAYS_SHOWN}
            rows = [f"{key} = {_quoted(value) if isinstance(value, str) else value}" for key, value in shown.items()]
            lines.append(f"    {{ {', '.join(rows)} }},")
        lines += ["]", "", "[ethercat.pdos]"] if one.pdos else ["]"]
        for index, rule in one.pdos.items():
            exclude = ", ".join(f"0x{other:04X}" for other in rule.exclude)
            lines.append(f"{index:04X} = {{ mandatory = {str(rule.mandatory).lower()}, exclude = [{exclude}] }}")
        return "\n".join(lines) + "\n"


def ethercat_part(eds: Path | None, esi: VendorEsi | None, source: str) -> EtherCatPart:
    """Return a new device's dictionary with images, and its table `ethercat`.

    Args:
        eds: The EDS; None for the ESI's dictionary.
        esi: The ESI; None for an EDS alone.
        source: The file or files, for messages.

    Raises:
        ValueError: For an ESI without a dictionary and without an EDS beside it, one that does not describe a drive, or
            images that are too long for a slave.
    """
    return _Maker(eds, esi, source).part()


class _Maker:
    """A device in progress."""

    def __init__(self, eds: Path | None, esi: VendorEsi | None, source: str) -> None:
        self._esi, self._source = esi, source
        self._changes: list[tuple[str, str]] = []
        self._class_values: list[tuple[str, str]] = []
        if esi is not None:
            self._changes += esi.unread
        if eds is not None:
            whole: Path | EdsText = eds
            file = eds_file(eds)
        else:
            assert esi is not None, "one of both is given"
            file = self._of_dictionary(esi)
            whole = EdsText(f"{source}, its dictionary as an EDS", file.text())
        self._axes = axes_of(whole, read_types(whole))
        self._changes += [(one.where, one.what) for one in file.repairs]
        self._sections: dict[str, Section] = {name: dict(row) for name, row in file.sections.items()}
        self._drop_can()
        self._read_types()

    def _read_types(self) -> None:
        self._types: Mapping[Key, ODVariable] = read_types(EdsText(self._source, EdsFile(self._sections, ()).text()))

    def part(self) -> EtherCatPart:
        pdos = self._of_esi(self._esi) if self._esi is not None else self._of_eds()
        assigned = {is_output: self._assigned(is_output, pdos) for is_output in (True, False)}
        for is_output in (True, False):
            if not self._serves(is_output, assigned[is_output]):
                own = self._own_set(is_output, pdos)
                pdos, assigned[is_output] = [*own, *pdos], own[:1]
        behaviour = self._behaviour(pdos)
        self._check_places(behaviour, assigned)
        self._write(pdos, assigned, behaviour)
        text = EdsFile(self._sections, ()).text()
        eds = EdsText(self._source, parse_eds(text).text())
        return EtherCatPart(eds, behaviour, tuple(self._class_values), tuple(self._changes))

    # --- the dictionary ---------------------------------------------------------------------------------------------
    def _of_dictionary(self, esi: VendorEsi) -> EdsFile:
        if esi.dictionary is None:
            raise ValueError(
                f"{self._source} has no dictionary (Profile/Dictionary), and nothing else says which objects the drive "
                "has; give its EDS beside it: --eds drive.eds"
            )
        try:
            sections, left_out = dictionary_sections(esi.dictionary)
        except ValueError as error:
            raise ValueError(f"{self._source}: {error}") from None
        self._changes += left_out
        return parse_eds(EdsFile({"DeviceInfo": {}, **sections}, ()).text())

    def _drop_can(self) -> None:
        found = set()
        for name in list(self._sections):
            place = place_of(name)
            if place is not None and any(place[0] in indices for indices in ONLY_ON_CAN):
                del self._sections[name]
                found.add(place[0])
        if found:
            listed = ", ".join(f"{index:04X}h" for index in sorted(found))
            self._changes.append((listed, "left out: of CAN, and the device is on EtherCAT"))

    # --- images -----------------------------------------------------------------------------------------------------
    def _of_esi(self, esi: VendorEsi) -> list[_Pdo]:
        added: set[Key] = set()
        for pdo in esi.pdos:
            for entry in pdo.entries:
                key = (entry.index, entry.sub)
                if entry.index and key not in self._types and key not in added and entry.bits in WIDTHS:
                    self._add(key, entry.bits, entry.name, entry.type, is_output=pdo.is_output)
                    added.add(key)
        if added:
            self._read_types()
        return [
            self._pdo(
                pdo.index,
                pdo.name,
                pdo.is_output,
                pdo.is_fixed,
                [(one.index, one.sub, one.bits) for one in pdo.entries],
            )
            for pdo in esi.pdos
        ]

    def _add(self, key: Key, bits: int, name: str, type_name: str, *, is_output: bool) -> None:
        index, sub = key
        kind = ESI_TYPES.get(type_name.upper())
        if kind is None or INTEGER_TYPES.get(kind, (0, 0, 0))[0] != bits:
            kind = next(kind for kind, width in UNSIGNED.items() if width == bits)
        row = {"ParameterName": name or f"Object {index:04X}h:{sub:02X}", "DataType": f"0x{kind:04X}",
               "AccessType": "rww" if is_output else "ro", "PDOMapping": "1"}  # fmt: skip
        if sub:
            group = self._sections.setdefault(
                object_section(index), {"ParameterName": f"Object {index:04X}h", "ObjectType": "0x9"}
            )
            if number_of(group.get("ObjectType", "7")) == 7:
                self._changes.append((f"[{index:04X}]", f"has no sub-index {sub}, which an image names: a gap there"))
                return
            first = {"ParameterName": "Highest sub-index", "DataType": "0x0005", "AccessType": "ro"}
            self._sections.setdefault(object_section(index, 0), first | {"DefaultValue": str(sub)})
            group.pop("SubNumber", None)
            self._sections[object_section(index, sub)] = row
        else:
            self._sections[object_section(index)] = row | {"ObjectType": "0x7"}
        self._changes.append((f"[{index:04X}:{sub}]", "is in an image and not in the dictionary: it was added"))

    def _of_eds(self) -> list[_Pdo]:
        found = []
        for indices, is_output in ((RX_PDOS, True), (TX_PDOS, False)):
            for index in indices:
                head = self._types.get((index, 0))
                if head is None:
                    continue
                count = int(head.default or 0)
                entries = [self._types.get((index, sub)) for sub in range(1, count + 1)]
                raws = [int(one.default or 0) for one in entries if one is not None and isinstance(one.default, int)]
                is_fixed = head.access_type in ("ro", "const")
                name = one_line(self._sections[object_section(index)].get("ParameterName"))
                rows = [(raw >> 16, raw >> 8 & 0xFF, raw & 0xFF) for raw in raws if raw & 0xFF]
                found.append(self._pdo(index, name, is_output, is_fixed, rows))
        return found

    def _pdo(
        self, index: int, name: str, is_output: bool, is_fixed: bool, rows: Sequence[tuple[int, int, int]]
    ) -> _Pdo:
        """Return a mapping object of entries: index, sub-index and bits of each; impossible entries become gaps."""
        raws: list[int] = []
        at = 0
        for mapped, sub, bits in rows:
            why = self._why_a_gap(mapped, sub, bits, at, is_output=is_output)
            if why == "":
                raws.append(mapped << 16 | sub << 8 | bits)
            else:
                if mapped and why:
                    self._changes.append(
                        (f"[{index:04X}]", f"{mapped:04X}h:{sub:02X} {why}: its {bits} bits are a gap")
                    )
                raws += [LONGEST_GAP] * (bits // LONGEST_GAP) + ([bits % LONGEST_GAP] if bits % LONGEST_GAP else [])
            at += bits
        if at % 8:
            self._changes.append((f"[{index:04X}]", f"has {at} bits, and a gap of {-at % 8} up to whole bytes"))
            raws.append(-at % 8)
        if len(raws) > MOST_ENTRIES:
            raise ValueError(
                f"{self._source}: {index:04X}h has {len(raws)} entries; a mapping object lists {MOST_ENTRIES} at most"
            )
        known = sum((index, sub) in self._types for sub in range(1, MOST_ENTRIES + 1))
        return _Pdo(index, name, is_output, is_fixed, tuple(raws), max(known, len(raws)))

    def _why_a_gap(self, index: int, sub: int, bits: int, at: int, *, is_output: bool) -> str | None:
        """Return why an image cannot carry an object, "" if it can; None for a gap of the file itself."""
        variable = self._types.get((index, sub))
        if index == 0 or (variable is None and index < 0x20):  # CANopen's dummies are data types
            return None
        if variable is None:
            return "does not exist"
        width = INTEGER_TYPES.get(variable.data_type or 0, (0, 0, 0))[0]
        if width not in WIDTHS:
            return "is no integer of whole bytes"
        if width != bits:
            return f"has {width} bits"
        if at % 8:
            return "begins within a byte"
        row = self._sections.get(object_section(index, sub)) or self._sections[object_section(index)]
        access = row.get("AccessType", "ro")
        if access == "const" or (is_output and access == "ro") or (not is_output and access == "wo"):
            return f"can only be {'written' if access == 'wo' else 'read'}"
        row["PDOMapping"] = "1"
        if access == ("rwr" if is_output else "rww"):
            row["AccessType"] = "rw"
        return ""

    def _assigned(self, is_output: bool, pdos: Sequence[_Pdo]) -> list[_Pdo]:
        """Return the images that a sync manager carries initially."""
        mine = {pdo.index: pdo for pdo in pdos if pdo.is_output == is_output}
        if self._esi is not None:
            return [mine[pdo.index] for pdo in self._esi.pdos if pdo.index in mine and pdo.is_assigned]
        count = self._types.get((ASSIGNMENTS[is_output], 0))
        if count is not None:
            subs = [self._types.get((ASSIGNMENTS[is_output], sub)) for sub in range(1, int(count.default or 0) + 1)]
            return [mine[one.default] for one in subs if one is not None and one.default in mine]
        whole = [pdo for pdo in mine.values() if self._essential(is_output) <= pdo.keys]
        if whole:
            return whole[:1]
        found: list[_Pdo] = []
        taken: set[Key] = set()
        for pdo in mine.values():  # of CANopen's PDOs, those that together have each object once
            if pdo.keys and not pdo.keys & taken:
                found.append(pdo)
                taken |= pdo.keys
        return found

    def _essential(self, is_output: bool) -> set[Key]:
        """Return the objects that an image needs so that every axis can follow a position."""
        indices = (cia402.CONTROLWORD, cia402.TARGET_POSITION) if is_output else SHOWN[::2][:2]
        return {
            (index + axis * cia402.AXIS_OFFSET, 0)
            for axis in range(self._axes)
            for index in indices
            if (index, 0) in self._types or index == cia402.CONTROLWORD
        }

    def _serves(self, is_output: bool, assigned: Sequence[_Pdo]) -> bool:
        """Return whether images command every axis by a cyclic target of any mode, or show every axis' position."""
        found = {key for pdo in assigned for key in pdo.keys}
        word = cia402.CONTROLWORD if is_output else cia402.STATUSWORD
        shown = cia402.POSITION_ACTUAL if (cia402.POSITION_ACTUAL, 0) in self._types else cia402.VL_VELOCITY_ACTUAL
        places = [target for _, target in OWN_SET] if is_output else [shown]
        steps = [axis * cia402.AXIS_OFFSET for axis in range(self._axes)]
        return all((word + step, 0) in found and any((one + step, 0) in found for one in places) for step in steps)

    def _own_set(self, is_output: bool, pdos: Sequence[_Pdo]) -> list[_Pdo]:
        """Return images of our own: outputs for csp, csv and cst, or inputs."""
        lacking = "a controlword or a cyclic target" if is_output else "6041h or 6064h (6044h without that)"
        if self._esi is not None:
            manager = 2 if is_output else 3
            raise ValueError(
                f"{self._source}: the images of sync manager {manager} lack {lacking} of an axis, so that no master "
                f'could move it; set Sm="{manager}" at those that carry it, or take its EDS alone '
                "(--eds drive.eds --fieldbus ethercat)"
            )
        modes = [(f"Outputs {mode}", (cia402.CONTROLWORD, cia402.MODE, target)) for mode, target in OWN_SET
                 if (target, 0) in self._types]  # fmt: skip
        free = [index for index in (RX_PDOS if is_output else TX_PDOS) if index not in [pdo.index for pdo in pdos]]
        own = []
        for index, (name, indices) in zip(free, modes if is_output else [("Inputs", SHOWN)], strict=False):
            pdo = self._pdo(index, name, is_output, False, self._entries_of_axes(indices))
            own.append(replace(pdo, room=max(pdo.room, ROOM * self._axes)))
        if not own:
            raise ValueError(f"{self._source} has no target (607Ah, 60FFh, 6071h, 6042h): no master could move it")
        told = ", ".join(f"{pdo.index:04X}h {pdo.name}" for pdo in own)
        there = [pdo for pdo in pdos if pdo.is_output == is_output]
        why = f"has no images that carry {lacking} of each axis" if there else "has no images"
        self._class_values.append((told, f"the EDS {why}: images of the emulator's own"))
        return own

    def _entries_of_axes(self, indices: Iterable[int]) -> list[tuple[int, int, int]]:
        """Return entries of every axis, aligned to their length, with gaps between."""
        rows: list[tuple[int, int, int]] = []
        at = 0
        for axis in range(self._axes):
            for first in indices:
                index = first + axis * cia402.AXIS_OFFSET
                variable = self._types.get((index, 0))
                if variable is None:
                    continue
                bits = INTEGER_TYPES[variable.data_type or datatypes.UNSIGNED8][0]
                even = min(bits, 16)
                if at % even:
                    rows.append((0, 0, even - at % even))
                    at += even - at % even
                rows.append((index, 0, bits))
                at += bits
        return rows

    # --- what is written --------------------------------------------------------------------------------------------
    def _behaviour(self, pdos: Sequence[_Pdo]) -> EtherCatBehaviour:
        one = CLASS_LAYOUT if self._esi is None else self._esi.behaviour
        if self._esi is None:
            why = "no EDS has them: sync managers, clocks and EEPROM are class values"
            self._class_values.append(("[ethercat] of device.toml", why))
        else:
            why = f"no ESI has it: {1e6 * CLASS_CYCLE:g} us, a class value"
            self._class_values.append(("[ethercat] shortest_cycle of device.toml", why))
            assigned = {pdo.index for pdo in self._esi.pdos if pdo.is_assigned}
            names = [f"{index:04X}h" for index, rule in one.pdos.items() if rule.mandatory and index not in assigned]
            if names:
                self._changes.append((", ".join(names), "Mandatory and without Sm: it is not assigned"))
        needed = self._eeprom(pdos, one)
        if needed > one.eeprom:
            self._changes.append(("Eeprom/ByteSize", f"{one.eeprom} bytes are too few for all images: {needed}"))
            one = one._replace(eeprom=needed)
        return one

    def _eeprom(self, pdos: Sequence[_Pdo], one: EtherCatBehaviour) -> int:
        """Return an EEPROM size [bytes] that holds all images: a power of two, as of EEPROM chips."""
        texts = {pdo.name for pdo in pdos} | {mode.name for mode in one.clocks} | {mode.title for mode in one.clocks}
        for index, sub in {key for pdo in pdos for key in pdo.keys}:
            sections = (object_section(index), object_section(index, sub))
            parts = [self._sections[name]["ParameterName"] for name in sections if name in self._sections]
            texts.add(" ".join(parts))
        content = BESIDE_IMAGES + sum(len(text) + 1 for text in texts) + CLOCK_ROW * len(one.clocks)
        content += sum(8 + 8 * len(pdo.raws) for pdo in pdos)
        size = SMALLEST_EEPROM
        while size < content:
            size *= 2
        return size

    def _check_places(self, one: EtherCatBehaviour, assigned: Mapping[bool, Sequence[_Pdo]]) -> None:
        """Raise ValueError for sync managers that overlap or exceed the memory."""
        sizes = [BUFFERS * sum(pdo.size for pdo in assigned[is_output]) for is_output in (True, False)]
        places = [("MBoxOut", *one.receive), ("MBoxIn", *one.send), ("Outputs", one.outputs, sizes[0]),
                  ("Inputs", one.inputs, sizes[1])]  # fmt: skip
        for k, (name, start, length) in enumerate(places):
            if start + length > MEMORY[1]:
                raise ValueError(
                    f"{self._source}: {name} takes {length} bytes from {start:04X}h on ({BUFFERS} buffers of images); "
                    f"the memory ends at {MEMORY[1]:04X}h; lower its start, or assign fewer images"
                )
            for other, first, size in places[:k]:
                if length and size and start < first + size and first < start + length:
                    raise ValueError(
                        f"{self._source}: {name} takes {length} bytes from {start:04X}h on, and {other} {size} from "
                        f"{first:04X}h on; images take {BUFFERS} buffers each. Correct StartAddress, or assign fewer"
                    )

    def _write(
        self, pdos: Sequence[_Pdo], assigned: Mapping[bool, Sequence[_Pdo]], behaviour: EtherCatBehaviour
    ) -> None:
        """Write mapping objects, assignments and identity into the dictionary, replacing existing ones."""
        gone = {SYNC_MANAGER_TYPES, *ASSIGNMENTS.values(), *RX_PDOS, *TX_PDOS}
        for name in list(self._sections):
            place = place_of(name)
            if place is not None and place[0] in gone:
                del self._sections[name]
        uses = [1, 2, 3, 4]
        self._record(SYNC_MANAGER_TYPES, "Sync manager type", "0x0005", "ro", uses, len(uses))
        for pdo in pdos:
            self._record(pdo.index, pdo.name, "0x0007", "ro" if pdo.is_fixed else "rw", pdo.raws, pdo.room)
        access = "rw" if "PdoAssign" in behaviour.coe else "ro"
        for is_output, index in ASSIGNMENTS.items():
            name = f"Assignment of {'outputs' if is_output else 'inputs'}"
            room = max(sum(pdo.is_output == is_output for pdo in pdos), 1)
            self._record(index, name, "0x0006", access, [pdo.index for pdo in assigned[is_output]], room)
        self._write_identity()

    def _record(self, index: int, name: str, data_type: str, access: str, values: Sequence[int], room: int) -> None:
        self._sections[object_section(index)] = {"ParameterName": name, "ObjectType": "0x9"}
        first = {"ParameterName": "Number of entries", "DataType": "0x0005", "AccessType": access}
        self._sections[object_section(index, 0)] = first | {"DefaultValue": str(len(values)), "PDOMapping": "0"}
        for sub in range(1, room + 1):
            value = values[sub - 1] if sub <= len(values) else 0
            self._sections[object_section(index, sub)] = {
                "ParameterName": f"Entry {sub}", "DataType": data_type, "AccessType": access,
                "DefaultValue": f"0x{value:X}", "PDOMapping": "0",
            }  # fmt: skip

    def _write_identity(self) -> None:
        """Set vendor, product and revision in 1018h to those of the ESI, or of [DeviceInfo] if the EDS lacks them."""
        info = self._sections.setdefault("DeviceInfo", {})
        if self._esi is not None:
            info |= _device_info(self._esi)
        names = ("Vendor-ID", "Product code", "Revision number", "Serial number")
        told = (info.get(key) for key in ("VendorNumber", "ProductNumber", "RevisionNumber"))
        numbers = [number_of(text or "") or 0 for text in told]
        self._sections.setdefault(object_section(IDENTITY), {"ParameterName": "Identity object", "ObjectType": "0x9"})
        first = {"ParameterName": "Highest sub-index", "DataType": "0x0005", "AccessType": "ro", "DefaultValue": "4"}
        self._sections.setdefault(object_section(IDENTITY, 0), first)
        for sub, (name, value) in enumerate(zip(names, [*numbers, 0], strict=True), 1):
            before = self._types.get((IDENTITY, sub))
            row = {"ParameterName": name, "DataType": "0x0007", "AccessType": "ro"}
            section = self._sections.setdefault(object_section(IDENTITY, sub), row)
            found = before.default if before is not None and isinstance(before.default, int) else None
            if found == value or (found and (self._esi is None or sub == 4)):
                continue
            section["DefaultValue"] = f"0x{value:X}"
            section.pop("LowLimit", None)
            section.pop("HighLimit", None)
            if found is not None and self._esi is not None and sub < 4:
                self._changes.append((f"[{IDENTITY:04X}:{sub}]", f"{found:X}h, and {value:X}h in the ESI: {value:X}h"))
        self._sections[object_section(IDENTITY)].pop("SubNumber", None)


def _device_info(esi: VendorEsi) -> Section:
    return {"VendorName": esi.maker, "VendorNumber": str(esi.vendor), "ProductName": esi.name,
            "ProductNumber": str(esi.product), "RevisionNumber": str(esi.revision)}  # fmt: skip


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
