"""The EtherCAT Slave Information (ESI) of a device: the XML by which configurators know it (ETG.2000)."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from drive_env.devices import Device
from drive_env.devices.ethercat import COE_ATTRIBUTES, ClockMode, PdoRule
from drive_env.dictionary.entries import read_eds
from drive_env.ethercat.object_descriptions import (
    ARRAY,
    MAPS_INPUT,
    MAPS_OUTPUT,
    VARIABLE,
    WRITE,
    EntryDescription,
    ObjectDescription,
    describe,
)
from drive_env.ethercat.sii_content import (
    bootstrap,
    coe_attributes,
    configuration,
    described,
    entry_of,
    identity,
    image_size,
    is_fixed,
    mapped,
    not_assigned,
    title,
    type_of,
)
from drive_env.node import mapping
from drive_env.node.process_image import INPUTS, OUTPUTS

LOCALE_ENGLISH = "1033"
DRIVE_PROFILE = "402"
GROUP = "Drives"
MANAGERS = ("MBoxOut", "MBoxIn", "Outputs", "Inputs")


def esi_text(device: Device) -> str:
    """Return the ESI of a device, as `drive-env export esi` writes it; ValueError for one without EtherCAT."""
    if device.ethercat is None:
        raise ValueError(f"{device.name} has no EtherCAT; its data (device.toml) have no table [ethercat]")
    device = described(device)
    vendor, _, _ = identity(device)
    root = ET.Element("EtherCATInfo", Version="1.6")
    maker = ET.SubElement(root, "Vendor")
    _text(maker, "Id", _hex(vendor, 8))
    _text(maker, "Name", str(read_eds(device.eds).device_information.vendor_name))
    descriptions = ET.SubElement(root, "Descriptions")
    group = ET.SubElement(ET.SubElement(descriptions, "Groups"), "Group")
    _text(group, "Type", GROUP)
    _text(group, "Name", GROUP, LcId=LOCALE_ENGLISH)
    _device(ET.SubElement(descriptions, "Devices"), device)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _device(parent: ET.Element, device: Device) -> None:
    behaviour = device.ethercat
    assert behaviour is not None, "it was looked at before"
    objects = describe(device)
    _, product, revision = identity(device)
    one = ET.SubElement(parent, "Device", Physics="YY")
    _text(one, "Type", type_of(device), ProductCode=_hex(product, 8), RevisionNo=_hex(revision, 8))
    _text(one, "Name", title(device), LcId=LOCALE_ENGLISH)
    _text(one, "GroupType", GROUP)
    profile = ET.SubElement(one, "Profile")
    _text(profile, "ProfileNo", DRIVE_PROFILE)
    dictionary = ET.SubElement(profile, "Dictionary")
    _types(ET.SubElement(dictionary, "DataTypes"), objects)
    _objects(ET.SubElement(dictionary, "Objects"), objects)
    for name in ("Outputs", "Inputs", "MBoxState"):
        _text(one, "Fmmu", name)
    sizes = (behaviour.receive.length, behaviour.send.length, image_size(objects, OUTPUTS), image_size(objects, INPUTS))
    starts = (behaviour.receive.start, behaviour.send.start, behaviour.outputs, behaviour.inputs)
    for name, size, start, control in zip(MANAGERS, sizes, starts, behaviour.controls, strict=True):
        places = {"DefaultSize": str(size), "StartAddress": _hex(start), "ControlByte": _hex(control, 2), "Enable": "1"}
        _text(one, "Sm", name, **places)
    for tag, direction, manager in (("RxPdo", OUTPUTS, 2), ("TxPdo", INPUTS, 3)):
        _pdos(one, device, objects, tag, direction, manager)
    mailbox = ET.SubElement(one, "Mailbox")
    known = coe_attributes(behaviour, objects)
    told = [name for name in COE_ATTRIBUTES if name in known or name != "PdoUpload"]
    ET.SubElement(mailbox, "CoE", {name: str(int(name in known)) for name in told})
    if behaviour.has_foe:
        ET.SubElement(mailbox, "FoE")
    if behaviour.clocks:
        clock = ET.SubElement(one, "Dc")
        for mode in behaviour.clocks:
            _clock(ET.SubElement(clock, "OpMode"), mode)
    eeprom = ET.SubElement(one, "Eeprom")
    _text(eeprom, "ByteSize", str(behaviour.eeprom))
    _text(eeprom, "ConfigData", configuration()[:14].hex())
    if behaviour.bootstrap_receive is not None:
        _text(eeprom, "BootStrap", bootstrap(behaviour).hex())


def _clock(parent: ET.Element, mode: ClockMode) -> None:
    _text(parent, "Name", mode.name)
    _text(parent, "Desc", mode.title)
    _text(parent, "AssignActivate", _hex(mode.activation))
    for name, cycle, factor, shift in (
        ("Sync0", mode.cycle0, mode.factor0, mode.shift0),
        ("Sync1", mode.cycle1, mode.factor1, mode.shift1),
    ):
        if cycle or factor or shift:
            _text(parent, f"CycleTime{name}", str(cycle), **({"Factor": str(factor)} if factor else {}))
            _text(parent, f"ShiftTime{name}", str(shift))


def _types(parent: ET.Element, objects: dict[int, ObjectDescription]) -> None:
    """Write the data types of the objects: basic types, and one type for each object with sub-indices."""
    basic = {entry.type_name: entry.bits for one in objects.values() for entry in one.entries}
    for name, bits in sorted(basic.items()):
        row = ET.SubElement(parent, "DataType")
        _text(row, "Name", name)
        _text(row, "BitSize", str(bits))
    for one in objects.values():
        if one.code == VARIABLE:
            continue
        row = ET.SubElement(parent, "DataType")
        _text(row, "Name", _type_of(one))
        places, size = _places(one)
        _text(row, "BitSize", str(size))
        for entry, at in places:
            sub = ET.SubElement(row, "SubItem")
            _text(sub, "SubIdx", str(entry.sub))
            _text(sub, "Name", entry.name)
            _text(sub, "Type", entry.type_name)
            _text(sub, "BitSize", str(entry.bits))
            _text(sub, "BitOffs", str(at))
            _flags(sub, entry)


def _places(one: ObjectDescription) -> tuple[list[tuple[EntryDescription, int]], int]:
    """Return the entries with their first bit, and the total bits: sub-index 0 has 16 in complete access."""
    places, at = [], 0
    for entry in one.entries:
        places.append((entry, at))
        at += 16 if entry.sub == 0 else entry.bits
    return places, at


def _objects(parent: ET.Element, objects: dict[int, ObjectDescription]) -> None:
    for one in objects.values():
        row = ET.SubElement(parent, "Object")
        _text(row, "Index", _hex(one.index))
        _text(row, "Name", one.name)
        first = one.entries[0]
        _text(row, "Type", first.type_name if one.code == VARIABLE else _type_of(one))
        _text(row, "BitSize", str(first.bits if one.code == VARIABLE else _places(one)[1]))
        info = ET.SubElement(row, "Info")
        if one.code == VARIABLE:
            _info(info, first)
        else:
            for entry in one.entries:
                sub = ET.SubElement(info, "SubItem")
                _text(sub, "Name", entry.name)
                _info(ET.SubElement(sub, "Info"), entry)
        if one.code == VARIABLE:
            _flags(row, first)


def _info(parent: ET.Element, entry: EntryDescription) -> None:
    """Write the default, and the limits unless they are the type's."""
    if isinstance(entry.default, str):
        _text(parent, "DefaultString", entry.default)
        return
    for tag, value in (("MinValue", entry.low), ("MaxValue", entry.high), ("DefaultValue", entry.default)):
        if value is not None:
            _text(parent, tag, str(value))


def _flags(parent: ET.Element, entry: EntryDescription) -> None:
    flags = ET.SubElement(parent, "Flags")
    writes = entry.access & WRITE
    reads = entry.access & ~WRITE & 0x07
    where = {} if not writes or writes == WRITE else {"WriteRestrictions": "PreOP"}
    _text(flags, "Access", ("rw" if reads else "wo") if writes else "ro", **where)
    maps = ("R" if entry.access & MAPS_OUTPUT else "") + ("T" if entry.access & MAPS_INPUT else "")
    if maps:
        _text(flags, "PdoMapping", maps)


def _pdos(
    parent: ET.Element, device: Device, objects: dict[int, ObjectDescription], tag: str, direction: int, manager: int
) -> None:
    """Write the images of a direction; unless stated otherwise, those not assigned together exclude each other."""
    assert device.ethercat is not None, "it was looked at before"
    assigned, rules = mapped(objects, direction), device.ethercat.pdos
    rows, together = [*assigned, *not_assigned(objects, direction)], dict(assigned)
    for index, raws in rows:
        pdo = ET.SubElement(parent, tag)
        if is_fixed(objects[index]):
            pdo.set("Fixed", "1")
        if rules.get(index, PdoRule()).mandatory:
            pdo.set("Mandatory", "1")
        if index in together:
            pdo.set("Sm", str(manager))
        others = [other for other, _ in rows if other != index and not (index in together and other in together)]
        _text(pdo, "Index", _hex(index))
        _text(pdo, "Name", objects[index].name)
        for other in rules[index].exclude if index in rules else others:
            _text(pdo, "Exclude", _hex(other))
        for raw in raws:
            mapped_index, sub, bits = mapping.parse(raw)
            entry = ET.SubElement(pdo, "Entry")
            _text(entry, "Index", _hex(mapped_index))
            if not mapped_index:  # reserved
                _text(entry, "BitLen", str(bits))
                continue
            name, kind = entry_of(objects, (mapped_index, sub))
            _text(entry, "SubIndex", str(sub))
            _text(entry, "BitLen", str(bits))
            _text(entry, "Name", name)
            _text(entry, "DataType", _basic_name(objects, (mapped_index, sub), kind))


def _basic_name(objects: dict[int, ObjectDescription], key: tuple[int, int], kind: int) -> str:
    entry = next(one for one in objects[key[0]].entries if one.sub == key[1])
    assert entry.data_type == kind, "both are of the same entry"
    return entry.type_name


def _type_of(one: ObjectDescription) -> str:
    return f"DT{one.index:04X}{'ARR' if one.code == ARRAY else ''}"


def _text(parent: ET.Element, tag: str, text: str, **attributes: str) -> None:
    ET.SubElement(parent, tag, attributes).text = text


def _hex(value: int, digits: int = 4) -> str:
    return f"#x{value:0{digits}X}"
