"""The dictionary of an ESI (`Profile/Dictionary` of ETG.2000) as the sections of an EDS.

Types defined in the file are resolved to basic ones. Entries without a known type are left out and listed; the EDS
reader checks the values.
"""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import NamedTuple

from canopen.objectdictionary import datatypes

from drive_env.devices.vendor_esi import LONGEST_TEXT, U8, U16, number, one_line, text_of
from drive_env.dictionary.eds_file import MOST_ENTRIES, MOST_SUB, RECORD, VAR, Repair, Section, object_section

TYPES = {
    "BOOL": datatypes.BOOLEAN, "BIT": datatypes.BOOLEAN, "SINT": datatypes.INTEGER8, "INT": datatypes.INTEGER16,
    "INT24": datatypes.INTEGER24, "DINT": datatypes.INTEGER32, "LINT": datatypes.INTEGER64,
    "USINT": datatypes.UNSIGNED8, "UINT": datatypes.UNSIGNED16, "UINT24": datatypes.UNSIGNED24,
    "UDINT": datatypes.UNSIGNED32, "ULINT": datatypes.UNSIGNED64, "BYTE": datatypes.UNSIGNED8,
    "WORD": datatypes.UNSIGNED16, "DWORD": datatypes.UNSIGNED32, "LWORD": datatypes.UNSIGNED64,
    "BITARR8": datatypes.UNSIGNED8, "BITARR16": datatypes.UNSIGNED16, "BITARR32": datatypes.UNSIGNED32,
    "REAL": datatypes.REAL32, "LREAL": datatypes.REAL64,
}  # fmt: skip
_TEXT = re.compile(r"(STRING|OCTET_STRING|UNICODE_STRING)\s*(\(\d+\))?$")
_ARRAY_OF = re.compile(r"ARRAY\s*\[[^\]]*\]\s*OF\s+\w+$")
TEXTS = {"STRING": datatypes.VISIBLE_STRING, "OCTET_STRING": datatypes.OCTET_STRING,
         "UNICODE_STRING": datatypes.UNICODE_STRING}  # fmt: skip
FLOATS = {datatypes.REAL32: "<f", datatypes.REAL64: "<d"}
DEEPEST_TYPE = 8  # nesting of types
FIRST_OBJECT = 0x1000  # below are the numbers of data types
FLAGS = {"": "ro", "ro": "ro", "rw": "rw", "wo": "wo"}


class _Member(NamedTuple):
    """A sub-index of an object: its name, type and flags."""

    sub: int
    name: str
    type: str
    flags: ET.Element | None


def dictionary_sections(dictionary: ET.Element) -> tuple[dict[str, Section], list[Repair]]:
    """Return the objects of a dictionary as the sections of an EDS, and the omitted entries.

    Raises:
        ValueError: For text in place of a number, a number beyond its range, or more entries than an EDS may have.
    """
    return _Dictionary(dictionary).sections()


class _Dictionary:
    """One reading of one dictionary."""

    def __init__(self, dictionary: ET.Element) -> None:
        self._objects = dictionary.findall("Objects/Object")
        self._types = {text_of(one, "Name"): one for one in reversed(dictionary.findall("DataTypes/DataType"))}
        self._basic_of: dict[str, int | None] = {}
        self._members_of: dict[str, list[_Member]] = {}
        self._sections: dict[str, Section] = {}
        self._left_out: list[Repair] = []

    def sections(self) -> tuple[dict[str, Section], list[Repair]]:
        for k, one in enumerate(self._objects, 1):
            index = number(one.findtext("Index"), f"Dictionary, object {k}/Index", 0, U16)
            if index < FIRST_OBJECT:
                continue
            name = object_section(index)
            if name in self._sections:
                self._left_out.append(Repair(f"[{name}]", "stands twice: the first counts"))
                continue
            self._object(index, one)
            if len(self._sections) + len(self._left_out) > MOST_ENTRIES:
                raise ValueError(
                    f"its dictionary has more than {MOST_ENTRIES} entries; leave out those that you do not need"
                )
        return self._sections, self._left_out

    def _object(self, index: int, one: ET.Element) -> None:
        name, kind = object_section(index), text_of(one, "Type")
        title = text_of(one, "Name") or f"Object {name}h"
        info = one.find("Info")
        if self._basic(kind) is not None:
            found = self._value(kind, title, one.find("Flags"), info, f"[{name}]")
            self._sections[name] = found | {"ObjectType": f"0x{VAR:X}"}
            return
        if kind not in self._members_of:
            self._members_of[kind] = list(self._members(kind, f"Dictionary, {name}h"))
        members = self._members_of[kind]
        if not members:
            self._left_out.append(Repair(f"[{name}]", f"was left out: its type {kind!r} is not known here"))
            return
        infos = [] if info is None else info.findall("SubItem")
        named = {text_of(sub, "Name"): sub.find("Info") for sub in infos}
        self._sections[name] = {"ParameterName": title, "ObjectType": f"0x{RECORD:X}"}
        for k, member in enumerate(members):
            at = object_section(index, member.sub)
            if self._basic(member.type) is None:
                self._left_out.append(Repair(f"[{at}]", f"was left out: its type {member.type!r} is not known here"))
                continue
            own = infos[k].find("Info") if len(infos) == len(members) else named.get(member.name)
            flags = one.find("Flags") if member.flags is None else member.flags
            self._sections[at] = self._value(member.type, member.name, flags, own, f"[{at}]")

    # --- types ------------------------------------------------------------------------------------------------------
    def _basic(self, kind: str) -> int | None:
        """Return a type's data type of CiA 301; None if it has sub-indices or is unknown."""
        if kind not in self._basic_of:
            self._basic_of[kind] = self._look_up(kind)
        return self._basic_of[kind]

    def _look_up(self, kind: str) -> int | None:
        for _ in range(DEEPEST_TYPE):
            plain = kind.upper()
            if plain in TYPES:
                return int(TYPES[plain])
            if found := _TEXT.match(plain):
                return int(TEXTS[found[1]])
            if _ARRAY_OF.match(plain):
                return int(datatypes.OCTET_STRING)
            row = self._types.get(kind)
            if row is None or row.find("SubItem") is not None or row.find("ArrayInfo") is not None:
                return None
            kind = text_of(row, "BaseType")
        return None

    def _members(self, kind: str, what: str) -> Iterator[_Member]:
        """Return the sub-indices of a type; empty if the type is unknown."""
        row = self._types.get(kind)
        seen: set[int] = set()
        for item in [] if row is None else row.findall("SubItem"):
            name, of, flags = text_of(item, "Name"), text_of(item, "Type"), item.find("Flags")
            array = self._types.get(of)
            bounds = None if array is None else array.find("ArrayInfo")
            if array is not None and bounds is not None:
                first = number(bounds.findtext("LBound") or "1", f"{what}, {of}/ArrayInfo/LBound", 1, MOST_SUB)
                count = number(bounds.findtext("Elements"), f"{what}, {of}/ArrayInfo/Elements", 1, MOST_SUB - first + 1)
                base = text_of(array, "BaseType")
                found = [_Member(sub, f"{name} {sub}".strip(), base, flags) for sub in range(first, first + count)]
            elif item.find("SubIdx") is None:
                continue  # unused bits between two sub-indices
            else:
                sub = number(item.findtext("SubIdx"), f"{what}, {kind}/SubItem {name}/SubIdx", 0, U8)
                found = [_Member(sub, name or f"Sub-index {sub}", of, flags)]
            for member in found:
                if member.sub not in seen:
                    seen.add(member.sub)
                    yield member

    # --- values -----------------------------------------------------------------------------------------------------
    def _value(self, kind: str, title: str, flags: ET.Element | None, info: ET.Element | None, where: str) -> Section:
        data_type = self._basic(kind)
        assert data_type is not None, "only what has a type is written"
        access, maps = self._access(flags, where)
        row = {"ParameterName": title, "DataType": f"0x{data_type:04X}", "AccessType": access, "PDOMapping": maps}
        for key, tags in (
            ("DefaultValue", ("DefaultValue", "DefaultString", "DefaultData")),
            ("LowLimit", ("MinValue", "MinData")),
            ("HighLimit", ("MaxValue", "MaxData")),
        ):
            if info is None:
                break
            for tag in tags:
                if text := one_line(info.findtext(tag)):
                    plain = text if tag == "DefaultString" else text.replace("#x", "0x")
                    row[key] = _from_data(text, data_type) if tag.endswith("Data") else plain
                    break
        return row

    def _access(self, flags: ET.Element | None, where: str) -> tuple[str, str]:
        """Return access and mapping as in an EDS: `rww` for objects of outputs only, `rwr` of inputs only."""
        told = "" if flags is None else text_of(flags, "Access").lower()
        if told not in FLAGS:
            self._left_out.append(Repair(where, f"Access {told[:LONGEST_TEXT]!r} is read as ro"))
        access = FLAGS.get(told, "ro")
        maps = "" if flags is None else text_of(flags, "PdoMapping").upper()
        if access == "rw" and maps in ("R", "T"):
            access = "rww" if maps == "R" else "rwr"
        return access, "1" if set(maps) & set("RT") else "0"


def _from_data(text: str, data_type: int) -> str:
    """Return the value of bytes in hexadecimal, lowest first; "" for other text."""
    try:
        data = bytes.fromhex(text)
    except ValueError:
        return ""
    if data_type in FLOATS:
        layout = struct.Struct(FLOATS[data_type])
        return repr(layout.unpack(data)[0]) if len(data) == layout.size else ""
    if data_type in TEXTS.values():
        return one_line(data.rstrip(b"\0").decode("latin-1"))
    return str(int.from_bytes(data, "little"))
