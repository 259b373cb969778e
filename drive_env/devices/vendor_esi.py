"""A maker's EtherCAT Slave Information (ESI, ETG.2000): one device of it, as far as it is supported here.

The file is not trusted: text in place of a number, or a number beyond its range, ends reading with place, value and
range. Unsupported data (EoE, modules, commands at start-up) are listed and ignored.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from drive_env.devices.ethercat import (
    COE_ATTRIBUTES,
    CONTROLS,
    LEAST_MAILBOX,
    MEMORY,
    ClockMode,
    EtherCatBehaviour,
    PdoRule,
    Place,
)
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import UntrustedFileError, parse_xml, read_bytes

MANAGERS = ("MBoxOut", "MBoxIn", "Outputs", "Inputs")  # of a drive with CoE: sync managers 0 to 3
ROLE = 0x0F  # bits of a control byte: kind and direction
RX_PDOS, TX_PDOS = range(0x1600, 0x1800), range(0x1A00, 0x1C00)
MOST_PDOS, MOST_ENTRIES = 254, 254  # that 1C12h and a mapping object can list
MOST_IN_ALL, MOST_MODES = 4_000, 32  # entries of all images, operation modes of clocks
MOST_BITS = 8 * 1486  # of an entry: a frame's data
MOST_EEPROM = 1 << 20  # bytes
NOT_HERE = ("EoE", "AoE", "SoE", "VoE")
U8, U16, U32, U64, I16, I32 = 0xFF, 0xFFFF, 0xFFFFFFFF, (1 << 64) - 1, 0x7FFF, 0x7FFFFFFF
LONGEST_TEXT = 100  # letters of a name
CLASS_EEPROM, CLASS_CYCLE = 4096, 250e-6  # bytes, s: values that no ESI has


@dataclass(frozen=True, slots=True)
class EsiEntry:
    """An entry of an image: its object, index 0 for a gap; length [bits]; name and type as in the file."""

    index: int
    sub: int
    bits: int
    name: str
    type: str


@dataclass(frozen=True, slots=True)
class EsiPdo:
    """An image, or part of one: its mapping object, whether it is sent to the drive, assigned, ready-made."""

    index: int
    name: str
    is_output: bool
    is_assigned: bool
    is_fixed: bool
    rule: PdoRule
    entries: tuple[EsiEntry, ...]


class VendorEsi(NamedTuple):
    """A device of an ESI.

    Attributes:
        vendor, product, revision: Its identity.
        maker, name: Its names for people.
        behaviour: Its mailboxes, sync managers and clocks.
        pdos: Its images.
        dictionary: `Profile/Dictionary`; None if the file has none.
        unread: Ignored data of the file, with reasons.
    """

    vendor: int
    product: int
    revision: int
    maker: str
    name: str
    behaviour: EtherCatBehaviour
    pdos: tuple[EsiPdo, ...]
    dictionary: ET.Element | None
    unread: tuple[tuple[str, str], ...]


def read_esi(path: Path, product: str = "") -> VendorEsi:
    """Return a device of an ESI.

    Args:
        path: The file.
        product: Selects one of several devices: its type, its product code, or "code:revision".

    Raises:
        ValueError: For a file that is not an ESI, does not describe a drive with CoE, or has several devices if
            `product` selects none.
    """
    if not path.is_file():
        raise ValueError(f"there is no ESI at {path}; give the path of the drive's .xml file")
    try:
        root = parse_xml(read_bytes(path))
        if root.tag != "EtherCATInfo":
            raise ValueError(
                f"it is no ESI: its outermost element is <{root.tag[:LONGEST_TEXT]}>, and an ESI's <EtherCATInfo>"
            )
        return _Reader(root).device(product)
    except UntrustedFileError as error:
        raise ValueError(f"{error}" if str(path) in str(error) else f"{path}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def number(text: str | None, what: str, low: int, high: int) -> int:
    """Parse a number of ETG.2000, decimal, or #x and hexadecimal; ValueError names its place and range."""
    plain = (text or "").strip()
    try:
        if len(plain) > LONGEST_TEXT:
            raise ValueError
        value = int(plain[2:], 16) if plain[:2].lower() in ("#x", "0x") else int(plain)
    except ValueError:
        raise ValueError(
            f"{what} is {plain[:LONGEST_TEXT]!r}, which is not a number; write it as {low} or #x{low:X}"
        ) from None
    if not low <= value <= high:
        raise ValueError(f"{what} is {plain}; it must be {low} to {high}")
    return value


def text_of(parent: ET.Element, tag: str) -> str:
    """Return the text of a child on one line, in English if there are several; "" without it."""
    found = parent.findall(tag)
    best = next((one for one in found if one.get("LcId") in ("1033", None)), found[0] if found else None)
    return "" if best is None else one_line(best.text)


def one_line(text: str | None) -> str:
    """Return a text without line ends and other control characters, limited to the length of a name."""
    words = "".join(letter if letter.isprintable() else " " for letter in (text or "")[: 10 * LONGEST_TEXT]).split()
    return " ".join(words)[:LONGEST_TEXT]


def is_set(element: ET.Element | None, name: str) -> bool:
    """Return whether an attribute is true."""
    return element is not None and element.get(name, "0").strip().lower() in ("1", "true")


def _check_number(found: int, what: str, most: int) -> None:
    if found > most:
        raise ValueError(f"it has {found} {what}; {most} are read. Leave out those that you do not need")


class _Reader:
    """One reading of one file."""

    def __init__(self, root: ET.Element) -> None:
        self._root = root
        self._unread: list[tuple[str, str]] = []

    def device(self, product: str) -> VendorEsi:
        """Return the device that a text selects, the only one for ""; ValueError for none, or an unfit one."""
        maker = self._root.find("Vendor")
        if maker is None:
            raise ValueError("it has no <Vendor>, by which masters know a device; add one with its Id")
        one = self._chosen(product)
        kind = one.find("Type")
        assert kind is not None, "only devices with a type are chosen from"
        pdos = tuple(self._pdos(one))
        name = text_of(one, "Name") or one_line(kind.text)
        self._tell_of_unread(one)
        return VendorEsi(
            number(maker.findtext("Id"), "Vendor/Id", 0, U32),
            number(kind.get("ProductCode"), "Type/@ProductCode", 0, U32),
            number(kind.get("RevisionNo", "0"), "Type/@RevisionNo", 0, U32),
            text_of(maker, "Name"),
            name,
            self._behaviour(one, one_line(kind.text), pdos),
            pdos,
            one.find("Profile/Dictionary"),
            tuple(self._unread),
        )

    def _chosen(self, product: str) -> ET.Element:
        devices = [one for one in self._root.findall("Descriptions/Devices/Device") if one.find("Type") is not None]
        if not devices:
            raise ValueError("it describes no device: it has no Descriptions/Devices/Device with a Type")
        names = []
        for one in devices:
            kind = one.find("Type")
            assert kind is not None, "see above"
            code = number(kind.get("ProductCode", "0"), "Type/@ProductCode", 0, U32)
            revision = number(kind.get("RevisionNo", "0"), "Type/@RevisionNo", 0, U32)
            names.append((one_line(kind.text), f"#x{code:X}", f"#x{code:X}:#x{revision:X}"))
        listed = ", ".join(f"{name} ({whole})" for name, _, whole in names[:20]) + (", ..." if names[20:] else "")
        wanted = product.strip().lower().replace("0x", "#x")
        found = [k for k, row in enumerate(names) if not wanted or wanted in [one.lower() for one in row]]
        if len(found) == 1:
            return devices[found[0]]
        if found:
            raise ValueError(
                f"it describes {len(found)} devices{f' {product}' if wanted else ''}: {listed}; name one with "
                "--product, by its type or by code:revision"
            )
        near = did_you_mean(product, [name for name, _, _ in names])
        raise ValueError(f"it describes no device {product!r}{near}; --product may be {listed}")

    # --- sync managers, mailbox, clocks -----------------------------------------------------------------------------
    def _behaviour(self, one: ET.Element, order: str, pdos: tuple[EsiPdo, ...]) -> EtherCatBehaviour:
        coe = one.find("Mailbox/CoE")
        if coe is None:
            raise ValueError(
                "it has no Mailbox/CoE: a drive here has its objects by CoE; one that has them by SoE or by process "
                "data alone cannot be made"
            )
        managers = one.findall("Sm")
        names = [one_line(manager.text) for manager in managers]
        if [name.lower() for name in names] != [name.lower() for name in MANAGERS]:
            raise ValueError(
                f"its sync managers are {', '.join(names[:8]) or 'none'}; a drive here has {', '.join(MANAGERS)}, in "
                "this order"
            )
        places, controls = [], []
        for k, (name, manager) in enumerate(zip(MANAGERS, managers, strict=True)):
            what = f"Sm {name}"
            start = number(manager.get("StartAddress"), f"{what}/@StartAddress", MEMORY[0], MEMORY[1] - 1)
            control = number(manager.get("ControlByte", str(CONTROLS[k])), f"{what}/@ControlByte", 0, U8)
            if control & ROLE != CONTROLS[k] & ROLE:
                raise ValueError(
                    f"{what}/@ControlByte is {control:02X}h; as {name} its lower four bits must be "
                    f"{CONTROLS[k] & ROLE:X}h"
                )
            length = 0
            if k < 2:
                size = manager.get("DefaultSize") or manager.get("MinSize")
                length = number(size, f"{what}/@DefaultSize", LEAST_MAILBOX, MEMORY[1] - start)
            places.append(Place(start, length))
            controls.append(control)
        eeprom = one.find("Eeprom")
        size = None if eeprom is None else eeprom.findtext("ByteSize")
        receive, send = self._bootstrap(eeprom)
        attributes = tuple(name for name in COE_ATTRIBUTES if name != "PdoConfig" and is_set(coe, name))
        return EtherCatBehaviour(
            places[0],
            places[1],
            places[2].start,
            places[3].start,
            CLASS_CYCLE,
            -(-number(size, "Eeprom/ByteSize", 128, MOST_EEPROM) // 128) * 128 if size else CLASS_EEPROM,
            receive,
            send,
            order=order,
            controls=tuple(controls),
            coe=attributes,
            has_foe=one.find("Mailbox/FoE") is not None,
            clocks=tuple(self._clocks(one)),
            pdos={pdo.index: pdo.rule for pdo in pdos},
        )

    def _bootstrap(self, eeprom: ET.Element | None) -> tuple[Place | None, Place | None]:
        text = "" if eeprom is None else "".join((eeprom.findtext("BootStrap") or "").split())
        if not text or not text.strip("0"):
            return None, None
        try:
            data = bytes.fromhex(text)
        except ValueError:
            data = b""
        if len(data) < 8:
            raise ValueError(
                f"Eeprom/BootStrap is {text[:LONGEST_TEXT]!r}; it must be 16 hexadecimal digits, or be left out"
            )
        words = [int.from_bytes(data[k : k + 2], "little") for k in range(0, 8, 2)]
        places = (Place(words[0], words[1]), Place(words[2], words[3]))
        for start, length in places:
            if length < LEAST_MAILBOX or not MEMORY[0] <= start <= MEMORY[1] - length:
                raise ValueError(
                    f"Eeprom/BootStrap has a mailbox of {length} bytes at {start:04X}h; it must have {LEAST_MAILBOX} "
                    f"bytes or more between {MEMORY[0]:04X}h and {MEMORY[1]:04X}h"
                )
        return places

    def _clocks(self, one: ET.Element) -> Iterator[ClockMode]:
        _check_number(len(one.findall("Dc/OpMode")), "Dc/OpMode", MOST_MODES)
        for k, mode in enumerate(one.findall("Dc/OpMode"), 1):
            what = f"Dc/OpMode {k}"
            values = []
            for sync, most in (("0", U32), ("1", I32)):
                cycle, shift = mode.find(f"CycleTimeSync{sync}"), mode.findtext(f"ShiftTimeSync{sync}")
                time = "0" if cycle is None else (cycle.text or "0")
                factor = "0" if cycle is None else cycle.get("Factor", "0")
                values += [
                    number(time, f"{what}/CycleTimeSync{sync}", 0, most),
                    number(factor, f"{what}/CycleTimeSync{sync}/@Factor", -I16 - 1, I16),
                    number(shift or "0", f"{what}/ShiftTimeSync{sync}", -I32 - 1, I32),
                ]
            activation = number(mode.findtext("AssignActivate") or "0", f"{what}/AssignActivate", 0, U16)
            yield ClockMode(text_of(mode, "Name") or f"mode {k}", text_of(mode, "Desc"), activation, *values)

    def _tell_of_unread(self, one: ET.Element) -> None:
        mailbox = one.find("Mailbox")
        assert mailbox is not None, "a device without CoE is refused before"
        for name in NOT_HERE:
            if mailbox.find(name) is not None:
                self._unread.append((f"Mailbox/{name}", "the emulator has no such protocol"))
        if mailbox.find("CoE/InitCmd") is not None:
            self._unread.append(
                ("Mailbox/CoE/InitCmd", "writes of a configurator at start-up: the drive has none by itself")
            )
        if one.find("Slots") is not None:
            self._unread.append(("Slots", "modules are not read: images are those of the device itself"))
        if one.find("Profile/DictionaryFile") is not None and one.find("Profile/Dictionary") is None:
            self._unread.append(("Profile/DictionaryFile", "a dictionary in another file is not read"))

    # --- images -----------------------------------------------------------------------------------------------------
    def _pdos(self, one: ET.Element) -> Iterator[EsiPdo]:
        coe, known = one.find("Mailbox/CoE"), set()
        for tag, indices, manager in (("RxPdo", RX_PDOS, 2), ("TxPdo", TX_PDOS, 3)):
            rows = one.findall(tag)
            _check_number(len(rows), tag, MOST_PDOS)
            _check_number(sum(len(row.findall("Entry")) for row in rows), f"entries of {tag}", MOST_IN_ALL)
            for k, row in enumerate(rows, 1):
                index = number(row.findtext("Index"), f"{tag} {k}/Index", indices.start, indices.stop - 1)
                what = f"{tag} {index:04X}h"
                if index in known:
                    raise ValueError(f"{what} stands twice; leave one of them")
                known.add(index)
                sm = row.get("Sm")
                if sm is not None and number(sm, f"{what}/@Sm", 0, U8) != manager:
                    raise ValueError(f"{what}/@Sm is {sm}; {tag} lie in sync manager {manager}")
                _check_number(len(row.findall("Exclude")), f"Exclude of {what}", MOST_PDOS)
                exclude = tuple(number(x.text, f"{what}/Exclude", 0, U16) for x in row.findall("Exclude"))
                yield EsiPdo(
                    index,
                    text_of(row, "Name") or f"{tag} {index:04X}h",
                    tag == "RxPdo",
                    sm is not None,
                    is_set(row, "Fixed") or not is_set(coe, "PdoConfig"),
                    PdoRule(is_set(row, "Mandatory"), exclude),
                    tuple(self._entries(row, what)),
                )

    def _entries(self, row: ET.Element, what: str) -> Iterator[EsiEntry]:
        entries = row.findall("Entry")
        if len(entries) > MOST_ENTRIES:
            raise ValueError(f"{what} has {len(entries)} entries; a mapping object lists {MOST_ENTRIES} at most")
        for k, entry in enumerate(entries, 1):
            place = f"{what}, entry {k}"
            index = number(entry.findtext("Index"), f"{place}/Index", 0, U16)
            sub = number(entry.findtext("SubIndex") or "0", f"{place}/SubIndex", 0, U8)
            bits = number(entry.findtext("BitLen"), f"{place}/BitLen", 1, MOST_BITS)
            yield EsiEntry(index, sub, bits, text_of(entry, "Name"), text_of(entry, "DataType"))
