"""The content of a slave's EEPROM, made from its device's data (ETG.1000.6, 5.4; ETG.2010)."""

from __future__ import annotations

import struct
import unicodedata
from pathlib import Path

from drive_env.devices import Device, find_device
from drive_env.devices.ethercat import ClockMode, EtherCatBehaviour
from drive_env.ethercat.object_descriptions import WRITE, ObjectDescription, describe
from drive_env.ethercat.sii_interface import CONFIGURATION, checksum
from drive_env.node import mapping
from drive_env.node.process_image import ASSIGNMENTS, INPUTS, OUTPUTS

STRINGS, GENERAL, FMMU, SYNC_MANAGERS, INPUT_PDO, OUTPUT_PDO, CLOCK = 10, 30, 40, 41, 50, 51, 60  # categories
PDI_CONTROL, PDI_CONFIGURATION, SYNC_PULSE = 0x0C05, 0x0000, 0x0064  # SPI slave; pulses of 1 us
COE, FOE = 0x04, 0x08  # mailbox protocols
COE_ENABLED = 0x01
# Bits of the CoE details, by the names of ETG.2000.
COE_DETAILS = {"SdoInfo": 0x02, "PdoAssign": 0x04, "PdoConfig": 0x08, "PdoUpload": 0x10, "CompleteAccess": 0x20}
MANDATORY, FIXED_CONTENT = 0x0001, 0x0010  # of a PDO
NOT_ASSIGNED = 0xFF  # sync manager of a PDO that is not assigned at first
KINDS = (1, 2, 3, 4)
FMMU_KINDS = (1, 2, 3)  # outputs, inputs, state of the mailbox
BEFORE_CATEGORIES = 0x80  # bytes


def identity(device: Device) -> tuple[int, int, int]:
    """Return vendor, product code and revision number, those of 1018h."""
    dictionary = device.new_dictionary()
    values = [dictionary.find((0x1018, sub)).default for sub in (1, 2, 3)]
    vendor, product, revision = (value if isinstance(value, int) else 0 for value in values)
    return vendor, product, revision


def described(device: Device) -> Device:
    """Return the device that describes this one's EEPROM and description file: itself, or the one named in its data."""
    other = "" if device.ethercat is None else device.ethercat.described_as
    return find_device(other) if other else device


def title(device: Device) -> str:
    """Return maker and name of a device."""
    return device.title.partition(",")[0]


def mapped(objects: dict[int, ObjectDescription], direction: int) -> list[tuple[int, list[int]]]:
    """Return the mapping objects assigned by the factory to a direction, with the factory's entries of each."""
    return [(index, _numbers(objects, index)) for index in _numbers(objects, direction)]


def not_assigned(objects: dict[int, ObjectDescription], direction: int) -> list[tuple[int, list[int]]]:
    """Return the other mapping objects that a master can choose in Pre-Op, in the form of `mapped`."""
    assigned = _numbers(objects, direction)
    others = [index for index in objects if index in ASSIGNMENTS[direction] and index not in assigned]
    return [(index, _numbers(objects, index)) for index in others]


def _numbers(objects: dict[int, ObjectDescription], index: int) -> list[int]:
    values = [entry.default for entry in objects[index].entries]
    found = [value if isinstance(value, int) else 0 for value in values]
    return found[1 : found[0] + 1]


def is_fixed(one: ObjectDescription) -> bool:
    """Return whether a mapping object is ready-made: its entries are read-only."""
    return not one.entries[0].access & WRITE


def coe_attributes(behaviour: EtherCatBehaviour, objects: dict[int, ObjectDescription]) -> tuple[str, ...]:
    """Return the features of a device's CoE server, as ETG.2000 names them."""
    mappings = [one for index, one in objects.items() if any(index in indices for indices in ASSIGNMENTS.values())]
    configures = mappings and not all(map(is_fixed, mappings))
    return (*behaviour.coe, *(("PdoConfig",) if configures else ()))


def type_of(device: Device) -> str:
    """Return the device's order code."""
    assert device.ethercat is not None, "it is asked for devices with EtherCAT"
    return device.ethercat.order or Path(device.name).stem.upper()


def image_size(objects: dict[int, ObjectDescription], direction: int) -> int:
    """Return the length of the factory's image of a direction [bytes]."""
    return sum(mapping.parse(raw)[2] for _, raws in mapped(objects, direction) for raw in raws) // 8


class _Strings:
    """Strings of the EEPROM, counted from 1; in ASCII, since masters read other letters differently, or not at all."""

    def __init__(self) -> None:
        self.all: list[bytes] = []

    def number(self, text: str) -> int:
        plain = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
        encoded = "".join(plain).encode("ascii", "replace")[:255]
        if encoded not in self.all:
            if len(self.all) == 255:
                return 0
            self.all.append(encoded)
        return self.all.index(encoded) + 1

    def content(self) -> bytes:
        return bytes((len(self.all),)) + b"".join(bytes((len(one),)) + one for one in self.all)


def sii_content(device: Device, serial: int = 0, alias: int = 0) -> bytes:
    """Return the whole EEPROM, padded with FFh.

    Raises:
        ValueError: For a device without EtherCAT, or one whose content is longer than its EEPROM.
    """
    behaviour, device = device.ethercat, described(device)
    if behaviour is None:
        raise ValueError(f"{device.name} has no EtherCAT; its data (device.toml) have no table [ethercat]")
    objects = describe(device)
    strings = _Strings()
    rest = _general(device, behaviour, objects, strings) + _category(FMMU, bytes(FMMU_KINDS).ljust(4, b"\0"))
    rest += _sync_managers(behaviour, image_size(objects, OUTPUTS), image_size(objects, INPUTS))
    for category, direction, manager in ((INPUT_PDO, INPUTS, 3), (OUTPUT_PDO, OUTPUTS, 2)):
        rest += _category(category, _pdos(behaviour, objects, direction, manager, strings))
    if behaviour.clocks:
        rest += _category(CLOCK, b"".join(_mode(one, strings) for one in behaviour.clocks))
    content = _head(device, behaviour, serial, alias) + _category(STRINGS, strings.content()) + rest + b"\xff\xff"
    if len(content) > behaviour.eeprom:
        raise ValueError(f"the EEPROM of {device.name} has {behaviour.eeprom} bytes; its content takes {len(content)}")
    return content.ljust(behaviour.eeprom, b"\xff")


def configuration(alias: int = 0) -> bytes:
    """Return the first words, which the controller reads, with their CRC."""
    words = struct.pack("<7H", PDI_CONTROL, PDI_CONFIGURATION, SYNC_PULSE, 0, alias, 0, 0)
    return words + struct.pack("<H", checksum(words.ljust(CONFIGURATION, b"\0")))


def bootstrap(behaviour: EtherCatBehaviour) -> bytes:
    """Return words 0014h to 0017h: the mailboxes in Bootstrap, 0 without it."""
    if behaviour.bootstrap_receive is None or behaviour.bootstrap_send is None:
        return bytes(8)
    return struct.pack("<4H", *behaviour.bootstrap_receive, *behaviour.bootstrap_send)


def _head(device: Device, behaviour: EtherCatBehaviour, serial: int, alias: int) -> bytes:
    mailboxes = struct.pack("<4H", *behaviour.receive, *behaviour.send)
    head = configuration(alias) + struct.pack("<4I", *identity(device), serial) + bytes(8)
    head += bootstrap(behaviour) + mailboxes + struct.pack("<H", COE | (FOE if behaviour.has_foe else 0))
    return head.ljust(BEFORE_CATEGORIES - 4, b"\0") + struct.pack("<2H", behaviour.eeprom // 128 - 1, 1)


def _category(number: int, content: bytes) -> bytes:
    words = (len(content) + 1) // 2
    return struct.pack("<2H", number, words) + content.ljust(2 * words, b"\0")


def _general(
    device: Device, behaviour: EtherCatBehaviour, objects: dict[int, ObjectDescription], strings: _Strings
) -> bytes:
    name = strings.number(title(device))
    order = strings.number(type_of(device))
    group = strings.number("Drives")
    details = COE_ENABLED | sum(COE_DETAILS.get(name, 0) for name in coe_attributes(behaviour, objects))
    # Group, image, order and name; reserved; CoE, FoE, EoE; SoE, DS402, SysMan; flags; current; group; ports.
    content = struct.pack("<4B", group, 0, order, name) + bytes(
        (0, details, behaviour.has_foe, 0, 0, device.num_axes, 0, 0)
    )
    content += struct.pack("<hBBH", 0, 0, 0, 0x0011)  # two ports, both MII
    return _category(GENERAL, content.ljust(32, b"\0"))


def _sync_managers(behaviour: EtherCatBehaviour, outputs: int, inputs: int) -> bytes:
    places = (behaviour.receive, behaviour.send, (behaviour.outputs, outputs), (behaviour.inputs, inputs))
    rows = [
        struct.pack("<HHBBBB", start, length, control, 0, 1 if length else 0, kind)
        for (start, length), control, kind in zip(places, behaviour.controls, KINDS, strict=True)
    ]
    return _category(SYNC_MANAGERS, b"".join(rows))


def _pdos(
    behaviour: EtherCatBehaviour, objects: dict[int, ObjectDescription], direction: int, manager: int, strings: _Strings
) -> bytes:
    content = b""
    rows = [(manager, *one) for one in mapped(objects, direction)]
    for number, index, raws in [*rows, *((NOT_ASSIGNED, *one) for one in not_assigned(objects, direction))]:
        name = strings.number(objects[index].name)
        rule = behaviour.pdos.get(index)
        flags = 0
        if rule is not None:
            flags = (MANDATORY if rule.mandatory else 0) | (FIXED_CONTENT if is_fixed(objects[index]) else 0)
        content += struct.pack("<HBBBBH", index, len(raws), number, 0, name, flags)
        for raw in raws:
            mapped_index, sub, bits = mapping.parse(raw)
            name, kind = (0, 0) if not mapped_index else _named(entry_of(objects, (mapped_index, sub)), strings)
            content += struct.pack("<HBBBBH", mapped_index, sub, name, kind, bits, 0)
    return content


def _named(entry: tuple[str, int], strings: _Strings) -> tuple[int, int]:
    return strings.number(entry[0]), entry[1]


def entry_of(objects: dict[int, ObjectDescription], key: tuple[int, int]) -> tuple[str, int]:
    """Return name and data type of an entry."""
    found = objects[key[0]]
    entry = next(one for one in found.entries if one.sub == key[1])
    name = found.name if len(found.entries) == 1 else f"{found.name} {entry.name}"
    return name, entry.data_type


def _mode(one: ClockMode, strings: _Strings) -> bytes:
    times = (one.cycle0, one.shift0, one.shift1, one.factor1, one.activation, one.factor0)
    return struct.pack("<IiihHhBB4s", *times, strings.number(one.name), strings.number(one.title), bytes(4))
