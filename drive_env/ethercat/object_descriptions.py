"""Descriptions of objects for EtherCAT, made from an EDS: names, types, access (ETG.1000.6, 5.6.3; ETG.2000)."""

from __future__ import annotations

from dataclasses import dataclass

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from drive_env.devices import Device
from drive_env.dictionary.entries import INTEGER_TYPES, read_eds
from drive_env.ethercat.ethercat_objects import ethercat_objects

VARIABLE, ARRAY, RECORD = 7, 8, 9  # object codes
PDO_MAPPING_TYPE, IDENTITY_TYPE = 0x0021, 0x0023  # records of the standard
UNSIGNED8 = datatypes.UNSIGNED8
# Bits of an entry's access: read and write in Pre-Op, Safe-Op, Op; mappable to outputs and inputs; stored; a setting.
READ, WRITE, WRITE_PRE_OP, MAPS_OUTPUT, MAPS_INPUT, BACKUP, SETTING = 0x07, 0x38, 0x08, 0x40, 0x80, 0x100, 0x200
IMAGE = range(0x1C00, 0x1C34)
MAPPINGS = (range(0x1600, 0x1800), range(0x1A00, 0x1C00))
# Names of the basic types as ETG.2000 writes them.
TYPE_NAMES = {
    datatypes.BOOLEAN: "BOOL", datatypes.INTEGER8: "SINT", datatypes.INTEGER16: "INT", datatypes.INTEGER32: "DINT",
    datatypes.INTEGER64: "LINT", datatypes.UNSIGNED8: "USINT", datatypes.UNSIGNED16: "UINT",
    datatypes.UNSIGNED32: "UDINT", datatypes.UNSIGNED64: "ULINT",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class EntryDescription:
    """A sub-index: type of CiA 301, length [bits], access, name, default, minimum and maximum (None for a text)."""

    sub: int
    data_type: int
    bits: int
    access: int
    name: str
    default: int | str
    low: int | None
    high: int | None

    @property
    def type_name(self) -> str:
        """Type as ETG.2000 writes it."""
        return TYPE_NAMES.get(self.data_type, f"STRING({self.bits // 8})")


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """An object: its name, object code, type, and its sub-indices in their order."""

    index: int
    name: str
    code: int
    data_type: int
    entries: tuple[EntryDescription, ...]

    @property
    def last(self) -> int:
        """Highest sub-index."""
        return self.entries[-1].sub


def describe(device: Device) -> dict[int, ObjectDescription]:
    """Return the objects that a device has on EtherCAT, by index, in ascending order."""
    behaviour = device.ethercat
    assert behaviour is not None, "it is asked for devices with EtherCAT"
    items = {item.index: item for item in read_eds(device.eds).values() if behaviour.has(item.index, item.name)}
    return {index: _object(item) for index, item in sorted((items | ethercat_objects(device)).items())}


def _object(item: ODVariable | ODArray | ODRecord) -> ObjectDescription:
    if isinstance(item, ODVariable):
        entry = _entry(item)
        return ObjectDescription(item.index, item.name, VARIABLE, entry.data_type, (entry,))
    entries = tuple(_entry(member) for member in sorted(item.values(), key=lambda one: one.subindex))
    code = ARRAY if isinstance(item, ODArray) else RECORD
    if any(item.index in one for one in MAPPINGS):
        kind = PDO_MAPPING_TYPE
    elif item.index == 0x1018:
        kind = IDENTITY_TYPE
    else:
        kind = entries[-1].data_type if code == ARRAY else 0
    return ObjectDescription(item.index, item.name, code, kind, entries)


def _entry(variable: ODVariable) -> EntryDescription:
    kind = variable.data_type or UNSIGNED8
    number = INTEGER_TYPES.get(kind)
    if number is None:
        text = str(variable.default or "")
        return EntryDescription(
            variable.subindex, kind, 8 * len(text), _access(variable), variable.name, text, None, None
        )
    bits, low, high = number
    low = low if variable.min is None else int(variable.min)
    high = high if variable.max is None else int(variable.max)
    default = int(variable.default or 0)
    return EntryDescription(variable.subindex, kind, bits, _access(variable), variable.name, default, low, high)


def _access(variable: ODVariable) -> int:
    kind = variable.access_type
    reads, writes = kind != "wo", kind not in ("ro", "const")
    is_image = variable.index in IMAGE or any(variable.index in one for one in MAPPINGS)
    bits = (READ if reads else 0) | ((WRITE_PRE_OP if is_image else WRITE) if writes else 0)
    if variable.pdo_mappable:
        bits |= (MAPS_OUTPUT if writes and kind != "rwr" else 0) | (MAPS_INPUT if reads and kind != "rww" else 0)
    elif reads and writes and variable.index >= 0x2000:
        bits |= SETTING
    return bits
