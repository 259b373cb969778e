"""Reads an EDS as makers write it: its sections, with corrections of its mistakes.

CiA 306 defines the format of an EDS; real ones have stray lines, other spellings of numbers and names, duplicate
sections, lists with wrong counts, sub-objects without their object. Nothing is invented here: unreadable entries are
left out, and each repair is listed. Of duplicate sections or keys the first counts, as with the functions of Windows by
which most tools read an EDS.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

from canopen.objectdictionary import datatypes

from drive_env import cia402
from drive_env.dictionary.eds_values import (
    ACCESS,
    LEGAL_ACCESS,
    NODE_ID,
    OBJECT_TYPES,
    TYPE_NAMES,
    float_of,
    is_plain,
    is_plain_float,
    node_id_sum,
    number_of,
)
from drive_env.dictionary.standard_types import STANDARD_TYPES
from mechanics.reading.untrusted import UntrustedFileError

VARIABLES, GROUPS = (2, 7), (8, 9)  # ObjectType: DOMAIN, VAR; ARRAY, RECORD
VAR, RECORD = 7, 9
SIGNED = {getattr(datatypes, f"INTEGER{bits}"): bits for bits in (8, 16, 24, 32, 40, 48, 56, 64)}
UNSIGNED = {getattr(datatypes, f"UNSIGNED{bits}"): bits for bits in (8, 16, 24, 32, 40, 48, 56, 64)}
UNSIGNED |= {datatypes.BOOLEAN: 1}
FLOATS = (datatypes.REAL32, datatypes.REAL64)
HEADERS = ("FileInfo", "DeviceInfo", "DeviceComissioning", "DummyUsage", "Comments", "MandatoryObjects",
           "OptionalObjects", "ManufacturerObjects")  # fmt: skip
LISTS = HEADERS[-3:]
MANDATORY, MANUFACTURER = (0x1000, 0x1001, 0x1018), range(0x2000, cia402.PROFILE_AREAS.start)
KEYS = {
    key.lower(): key
    for key in ("ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "LowLimit", "HighLimit",
                "PDOMapping", "SubNumber", "ParameterValue", "CompactSubObj", "ObjFlags", "Unit", "Factor",
                "Description", "Denotation", "SupportedObjects", "NrOfEntries", "Lines", "FileName", "FileVersion",
                "FileRevision", "EDSVersion", "VendorName", "VendorNumber", "ProductName", "ProductNumber",
                "RevisionNumber", "OrderCode", "NodeID", "NodeName", "Baudrate", "NetNumber", "NetworkName",
                "SimpleBootUpMaster", "SimpleBootUpSlave", "Granularity", "DynamicChannelsSupported", "GroupMessaging",
                "NrOfRXPDO", "NrOfTXPDO", "LSS_Supported", "CompactPDO")
}  # fmt: skip
_DEVICE_NUMBERS = ("VendorNumber", "ProductNumber", "RevisionNumber", "SimpleBootUpMaster", "SimpleBootUpSlave",
                   "Granularity", "DynamicChannelsSupported", "GroupMessaging", "NrOfRXPDO", "NrOfTXPDO",
                   "LSS_Supported")  # fmt: skip
_OBJECT = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?$", re.IGNORECASE)
_MEMBER = re.compile(
    r"(?:0x)?([0-9A-Fa-f]{4})h?[\s_]*sub[\s_]*(?:index)?[\s_]*(?:0x)?([0-9A-Fa-f]{1,2})h?$", re.IGNORECASE
)
_COMPACT = re.compile(r"([0-9A-Fa-f]{4})(Name|Value)$", re.IGNORECASE)

MOST_ENTRIES = 20_000  # sections, including those that CompactSubObj replaces: no known drive's file has a tenth of it
MOST_SUB = 254  # highest sub-index (CiA 301)
MOST_LINES = 300_000  # an entry has some ten
LONGEST_NAME = 200  # letters of a section's name
LONGEST_LINE = 1_000  # letters: CiA 306 allows 255; each may be repeated in 254 members, and in messages

VALUE_KEYS = ("DataType", "AccessType", "DefaultValue", "LowLimit", "HighLimit", "PDOMapping")  # of entries with values
MEMBER_KEYS = (*VALUE_KEYS, "ParameterValue", "ObjFlags", "Unit", "Factor", "Description")  # of members, too

# Least and greatest value that an object's standard format needs: CiA 301's COB-IDs, whose bit 31 switches a service
# off and whose bit 30 makes a device produce SYNC, and watched node-IDs above their times in ms (1016h).
FORMATS = (
    ((0x1005,), 0, (1, 0x400007FF)), ((0x1014,), 0, (1, 0x800007FF)), ((0x1016,), None, (0, 0x007FFFFF)),
    ((*range(0x1400, 0x1600), *range(0x1800, 0x1A00)), 1, (1, 0x800007FF)),
)  # fmt: skip
_FORMAT_OF = {index: (sub, ends) for indices, sub, ends in FORMATS for index in indices}

Section = dict[str, str]


class Repair(NamedTuple):
    """A correction of a file: the place (a section, or a line), and the mistake."""

    where: str
    what: str


class EdsFile(NamedTuple):
    """An EDS: its sections in order, each in the format of CiA 306, and the corrections."""

    sections: dict[str, Section]
    repairs: tuple[Repair, ...]

    def text(self) -> str:
        """Return it as the text of a file."""
        lines = []
        for name, section in self.sections.items():
            lines += [f"[{name}]", *(f"{key}={value}" for key, value in section.items()), ""]
        return "\n".join(lines)


def object_section(index: int, sub: int | None = None) -> str:
    """Return the name of an object's section, or of a sub-object's."""
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"


def place_of(name: str) -> tuple[int, int] | None:
    """Return index and sub-index of a section, sub-index -1 for an object as a whole; None for other sections."""
    if len(name) > LONGEST_NAME:
        return None
    if found := _OBJECT.match(name):
        return int(found[1], 16), -1
    if found := _MEMBER.match(name):
        return int(found[1], 16), int(found[2], 16)
    return None


def place_of_line(line: str) -> tuple[int, int] | None:
    """Return index and sub-index of a line that begins an object's section; None for other lines."""
    found = _section_of(line)
    return None if found is None else place_of(found[0])


def _section_of(line: str) -> tuple[str, bool] | None:
    """Return the name of the section that a line begins, and whether its bracket is closed; None for other lines."""
    line = line.strip()
    name, is_closed, _ = line[1:].partition("]")
    return (name.strip(), bool(is_closed)) if line.startswith("[") else None


@lru_cache(maxsize=16)
def parse_eds(text: str, node_id: int = 1) -> EdsFile:
    """Read an EDS and correct its mistakes.

    Args:
        text: The text of the file.
        node_id: Replaces the node-ID in sums that CiA 306 does not allow.

    Raises:
        UntrustedFileError: If it has more than MOST_ENTRIES or MOST_LINES.
    """
    return _Repairer(text, node_id).file()


class _Repairer:
    """One reading of one text."""

    def __init__(self, text: str, node_id: int) -> None:
        self._node_id = node_id
        self._repairs: list[Repair] = []
        self._sections: dict[str, Section] = {}
        self._read(text)

    def file(self) -> EdsFile:
        """Return the file."""
        self._expand_compact_objects()
        self._add_missing_objects()
        places = {name: place for name in self._sections if (place := place_of(name)) is not None}
        for name, (index, sub) in sorted(places.items(), key=lambda row: row[1]):
            self._repair_entry(name, index, sub)
        self._drop_limits_of_zero()
        self._drop_entries_without_type(places)
        self._repair_headers()
        kept = {name: place for name, place in places.items() if name in self._sections}
        self._count(sorted(index for index, sub in kept.values() if sub < 0))
        ordered = [name for name in HEADERS if name in self._sections]
        ordered += [name for name in self._sections if name not in ordered and name not in kept]
        ordered += sorted(kept, key=lambda name: kept[name])
        return EdsFile({name: self._sections[name] for name in ordered}, tuple(self._repairs))

    def _tell(self, where: str, what: str) -> None:
        self._repairs.append(Repair(where, what))

    # --- lines ----------------------------------------------------------------------------------------------------
    def _read(self, text: str) -> None:
        section: Section | None = None
        name = ""
        is_second = False
        lines = text.lstrip("\ufeff").replace("\0", "").splitlines()
        if len(lines) > MOST_LINES:
            raise UntrustedFileError(
                f"the EDS has {len(lines)} lines, and {MOST_LINES} are read; leave out those that you do not need"
            )
        for number, raw in enumerate(lines, 1):
            line = raw.strip()
            if len(line) > LONGEST_LINE:
                self._tell(f"line {number}", f"{len(line)} letters: what follows the first {LONGEST_LINE} was left out")
                line = line[:LONGEST_LINE]
            if not line or line.startswith(";"):
                continue
            if line.startswith(("#", "//")):
                self._tell(f"line {number}", "a comment that does not begin with ';' was left out")
            elif found := _section_of(line):
                name = self._section_name(found[0], number, is_closed=found[1])
                is_second = name in self._sections
                if is_second:
                    self._tell(f"[{name}]", "stands twice: the first counts, the second only adds what that lacks")
                section = self._sections.setdefault(name, {})
                self._check_number()
            elif section is None or ("=" not in line and ":" not in line):
                self._tell(f"line {number}", f"{line[:40]!r} is neither a section nor a value, and was left out")
            else:
                self._take_value(section, name, line, is_second=is_second)

    def _section_name(self, name: str, number: int, *, is_closed: bool) -> str:
        place = place_of(name)
        if place is not None:
            canonical = object_section(place[0], None if place[1] < 0 else place[1])
        else:
            canonical = next((known for known in HEADERS if known.lower() == name.lower()), name)
            if name.lower() == "devicecommissioning":
                canonical = "DeviceComissioning"  # as CiA 306 spells it
        if canonical.lower() != name.lower() or not is_closed:
            self._tell(f"line {number}", f"section [{name}{']' if is_closed else ''} is read as [{canonical}]")
        return canonical

    def _take_value(self, section: Section, name: str, line: str, *, is_second: bool) -> None:
        mark = "=" if "=" in line else ":"
        key, value = (part.strip() for part in line.split(mark, 1))
        value = re.sub(r"\s;.*$", "", " " + value).strip()  # python-canopen and most readers end a value there
        key = KEYS.get(key.replace(" ", "").lower(), key)
        if key != "ParameterName" and (cut := re.sub(r"\s//.*$", "", " " + value).strip()) != value:
            self._tell(f"[{name}]", f"a comment behind {key} was left out")
            value = cut
        if key not in section:
            section[key] = value
        elif section[key] != value:
            again = "" if is_second else "stands twice: "
            self._tell(f"[{name}]", f"{again}{key}={section[key]} counts, not {value}")

    def _check_number(self) -> None:
        if len(self._sections) > MOST_ENTRIES:
            raise UntrustedFileError(
                f"the EDS describes more than {MOST_ENTRIES} entries (CompactSubObj stands for as many as it says); "
                "leave out those that you do not need"
            )

    # --- objects --------------------------------------------------------------------------------------------------
    def _expand_compact_objects(self) -> None:
        """Write out the members of an array that is described only once (CompactSubObj)."""
        for name in [name for name, row in self._sections.items() if "CompactSubObj" in row]:
            place, row = place_of(name), self._sections[name]
            text = row.pop("CompactSubObj")
            count = number_of(text) or 0
            if place is None or count == 0:
                continue
            if not 0 < count <= MOST_SUB:
                self._tell(f"[{name}]", f"CompactSubObj={text} must be 1 to {MOST_SUB}")
                continue
            texts = {kind: self._sections.pop(f"{place[0]:04X}{kind}", {}) for kind in ("Name", "Value")}
            member = {key: row[key] for key in MEMBER_KEYS if key in row}
            first = {"ParameterName": "Number of entries", "DataType": "0x5", "AccessType": "ro"}
            self._sections.setdefault(object_section(place[0], 0), first | {"DefaultValue": str(count)})
            for sub in range(1, count + 1):
                named = {"ParameterName": texts["Name"].get(str(sub), f"{row.get('ParameterName', '')} {sub}".strip())}
                if value := texts["Value"].get(str(sub)):
                    named["ParameterValue" if "DeviceComissioning" in self._sections else "DefaultValue"] = value
                self._sections.setdefault(object_section(place[0], sub), member | named)
            self._check_number()
            for key in VALUE_KEYS:
                row.pop(key, None)
            row["ObjectType"] = row.get("ObjectType", str(GROUPS[0]))

    def _add_missing_objects(self) -> None:
        """Add missing objects to sub-objects, and give objects with sub-objects a type that allows them."""
        members: dict[int, list[int]] = {}
        for name in self._sections:
            place = place_of(name)
            if place is not None and place[1] >= 0:
                members.setdefault(place[0], []).append(place[1])
        for index, subs in members.items():
            name = object_section(index)
            if name not in self._sections:
                self._tell(f"[{name}]", "is missing, though its sub-objects are there: it was added")
                self._sections[name] = {"ParameterName": f"Object {name}h", "ObjectType": str(RECORD)}
            row = self._sections[name]
            kind = self._object_type(name, row)
            if kind not in GROUPS:
                self._tell(f"[{name}]", f"has sub-objects, so that ObjectType={row.get('ObjectType', '')} cannot be: "
                                        "it is read as a record")  # fmt: skip
                row["ObjectType"] = str(RECORD)
            counted = number_of(row.get("SubNumber", "")) if "SubNumber" in row else len(subs)
            if counted != len(subs):
                self._tell(f"[{name}]", f"SubNumber={row['SubNumber']}, and there are {len(subs)} sub-objects")
            if kind not in GROUPS and 0 not in subs and "DataType" in row:
                self._move_value_to_sub_0(name, row)
                subs.append(0)
            row["SubNumber"] = str(len(subs))

    def _move_value_to_sub_0(self, name: str, row: Section) -> None:
        """Move the value of an object with sub-objects to its sub-index 0, where CiA 301 has a value."""
        own = {key: row.pop(key) for key in VALUE_KEYS if key in row}
        self._sections[f"{name}sub0"] = {"ParameterName": row.get("ParameterName", "")} | own
        self._tell(f"[{name}]", "has a DataType beside its sub-objects: that of sub-index 0, which was added")

    def _object_type(self, name: str, row: Section) -> int:
        text = row.get("ObjectType")
        if text is None:
            return VAR
        kind = OBJECT_TYPES.get(text.upper(), number_of(text))
        if kind is None or kind not in OBJECT_TYPES.values():
            self._tell(f"[{name}]", f"ObjectType={text} is not one of CiA 306")
            kind = VAR
        row["ObjectType"] = f"0x{kind:X}"
        return kind

    def _repair_entry(self, name: str, index: int, sub: int) -> None:
        row = self._sections[name]
        if not row.get("ParameterName"):
            row["ParameterName"] = f"Object {index:04X}h" if sub < 0 else f"Sub-index {sub}"
            self._tell(f"[{name}]", f"has no name, and is called {row['ParameterName']}")
        kind = self._object_type(name, row) if sub < 0 else VAR
        if kind in GROUPS and sub < 0:
            return
        self._repair_type(name, row, index, sub)
        self._repair_access(name, row, index)
        if "PDOMapping" in row:
            row["PDOMapping"] = "1" if number_of(row["PDOMapping"]) else "0"
        data_type = number_of(row.get("DataType", ""))
        if data_type in SIGNED or data_type in UNSIGNED:
            assert data_type is not None, "None is no type"
            self._repair_numbers(name, row, data_type)
        elif data_type in FLOATS:
            self._repair_floats(name, row)
        for key in ("DefaultValue", "LowLimit", "HighLimit", "ParameterValue"):
            if row.get(key) == "":
                del row[key]

    def _repair_type(self, name: str, row: Section, index: int, sub: int) -> None:
        text = row.get("DataType", "")
        kind = TYPE_NAMES.get(text.upper().replace(" ", ""), number_of(text))
        if kind is None:
            kind = self._missing_type(index, sub)
            if kind is not None:
                self._tell(f"[{name}]", f"has no DataType: {kind:04X}h is taken, as CiA has it")
        elif text.upper() in TYPE_NAMES or not is_plain(text):
            self._tell(f"[{name}]", f"DataType={text} is read as {kind:04X}h")
        if kind is not None:
            row["DataType"] = f"0x{kind:04X}"

    def _missing_type(self, index: int, sub: int) -> int | None:
        """Return the only possible type of an entry; None if it cannot be inferred."""
        if sub == 0:
            return int(datatypes.UNSIGNED8)
        if index in STANDARD_TYPES:
            return STANDARD_TYPES[index][0]
        return int(datatypes.UNSIGNED32) if 0x1000 <= index < 0x1004 else None

    def _repair_access(self, name: str, row: Section, index: int) -> None:
        text = row.get("AccessType", "").lower().strip()
        access = ACCESS.get(text)
        if access is None:
            access = STANDARD_TYPES[index][1] if index in STANDARD_TYPES else "ro"
            self._tell(f"[{name}]", f"AccessType={text or '(missing)'} is read as {access}")
        elif text not in LEGAL_ACCESS:
            self._tell(f"[{name}]", f"AccessType={text} is read as {access}")
        row["AccessType"] = access

    def _repair_numbers(self, name: str, row: Section, data_type: int) -> None:
        bits = SIGNED.get(data_type) or UNSIGNED[data_type]
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if data_type in SIGNED else (0, (1 << bits) - 1)
        for key in ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit"):
            text = row.get(key, "")
            if text == "":
                continue
            by_node = node_id_sum(text)
            if by_node is not None:
                row[key] = by_node.text(self._node_id)
                if row[key].replace(" ", "") != text.replace(" ", "") and not _is_known_sum(text):
                    self._tell(f"[{name}]", f"{key}={text} is read as {row[key]}")
                continue
            number = number_of(text)
            value = None if number is None else _in_range(number, bits, low, high)
            if value is None:
                self._tell(f"[{name}]", f"{key}={text} is no value of its type, and was left out")
                del row[key]
                continue
            if not is_plain(text):
                self._tell(f"[{name}]", f"{key}={text} is read as {value}")
            row[key] = str(value)
        self._check_limits(name, row)
        self._check_format(name, row)

    def _repair_floats(self, name: str, row: Section) -> None:
        for key in ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit"):
            text = row.get(key, "")
            if text == "":
                continue
            value = float_of(text)
            if value is None:
                self._tell(f"[{name}]", f"{key}={text} is no value of its type, and was left out")
                del row[key]
            elif not is_plain_float(text):
                self._tell(f"[{name}]", f"{key}={text} is read as {value!r}")
                row[key] = repr(value)

    def _check_limits(self, name: str, row: Section) -> None:
        lowest, highest = (number_of(row[key]) if key in row else None for key in ("LowLimit", "HighLimit"))
        if lowest is not None and highest is not None and lowest > highest:
            self._tell(f"[{name}]", f"LowLimit={lowest} and HighLimit={highest} were left out: they leave no range")
            del row["LowLimit"], row["HighLimit"]

    def _check_format(self, name: str, row: Section) -> None:
        """Remove limits that exclude values which the standard's format of the object needs."""
        index, sub = place_of(name) or (0, 0)
        of_sub, (least, greatest) = _FORMAT_OF.get(index, (-1, (0, 0)))
        is_it = max(sub, 0) == of_sub or (of_sub is None and sub > 0)
        if index not in _FORMAT_OF or not is_it or row["AccessType"] in ("ro", "const"):
            return
        given = {key: row[key] for key in ("LowLimit", "HighLimit") if key in row}
        low, high = number_of(given.get("LowLimit", "0")), number_of(given.get("HighLimit", str(greatest)))
        if low is None or high is None or low > least or high < greatest:
            told = " and ".join(f"{key}={text}" for key, text in given.items())
            self._tell(f"[{name}]", f"{told} left out: CiA 301's values of it reach from {least} to {greatest:X}h")
            for key in given:
                del row[key]

    def _drop_limits_of_zero(self) -> None:
        """Remove limits that are both 0, if the file shows that its tool writes missing limits as 0."""
        zero = [row for row in self._sections.values() if row.get("LowLimit") == row.get("HighLimit") == "0"]
        if any(row.get("DefaultValue", "0") != "0" or row.get("PDOMapping") == "1" for row in zero):
            self._tell("the file", f"has both limits 0 at {len(zero)} objects: they are read as none")
            for row in zero:
                del row["LowLimit"], row["HighLimit"]

    def _drop_entries_without_type(self, places: dict[str, tuple[int, int]]) -> None:
        for name, (index, sub) in places.items():
            row = self._sections[name]
            is_group = sub < 0 and number_of(row.get("ObjectType", "7")) in GROUPS
            if "DataType" in row or is_group:
                continue
            if sub < 0 and number_of(row.get("ObjectType", "7")) == VARIABLES[0]:
                row["DataType"] = f"0x{datatypes.DOMAIN:04X}"
                continue
            self._tell(f"[{name}]", f"was left out: nothing says which type {index:04X}h has")
            del self._sections[name]

    # --- what is no object ----------------------------------------------------------------------------------------
    def _repair_headers(self) -> None:
        self._sections.setdefault("DeviceInfo", {})
        dummies = self._sections.get("DummyUsage")
        if dummies is not None:
            used = {key: number_of(value) or 0 for key, value in dummies.items()}
            self._sections["DummyUsage"] = {f"Dummy{k:04d}": str(used.get(f"Dummy{k:04d}", 0)) for k in range(1, 8)}
        comments = self._sections.get("Comments")
        if comments is not None:
            lines = [value for key, value in comments.items() if key.lower().startswith("line") and key != "Lines"]
            if number_of(comments.get("Lines", "")) != len(lines):
                self._tell("[Comments]", f"has {len(lines)} lines, not Lines={comments.get('Lines', '')}")
            rows = {f"Line{k}": line for k, line in enumerate(lines, 1)}
            self._sections["Comments"] = {"Lines": str(len(lines))} | rows
        for name, keys in (("DeviceInfo", _DEVICE_NUMBERS), ("DeviceComissioning", ("NodeID", "Baudrate"))):
            row = self._sections.get(name, {})
            for key in [key for key in row if key in keys or key.lower().startswith("baudrate")]:
                number = number_of(row[key])
                if number is None:
                    if row[key]:
                        self._tell(f"[{name}]", f"{key}={row[key]} is not a number, and was left out")
                    del row[key]
                else:
                    row[key] = str(number)

    def _count(self, indices: list[int]) -> None:
        """Write the lists of objects anew, and report wrong ones."""
        there = set(indices)
        for title in LISTS:
            listed = self._sections.get(title)
            if listed is None:
                continue
            rows = [number_of(value) for key, value in listed.items() if key.isdigit()]
            if number_of(listed.get("SupportedObjects", "")) != len(rows):
                count = listed.get("SupportedObjects", "(missing)")
                self._tell(f"[{title}]", f"lists {len(rows)} objects, and counts {count}")
            absent = [f"{row:04X}h" for row in rows if row is not None and row not in there]
            if absent:
                self._tell(f"[{title}]", f"lists {', '.join(absent)}, which no section describes: absent")
        groups: dict[str, list[int]] = {title: [] for title in LISTS}
        for index in indices:
            groups[LISTS[0] if index in MANDATORY else LISTS[2] if index in MANUFACTURER else LISTS[1]].append(index)
        for title, members in groups.items():
            rows_of = {str(k): f"0x{index:04X}" for k, index in enumerate(members, 1)}
            self._sections[title] = {"SupportedObjects": str(len(members))} | rows_of


def _is_known_sum(text: str) -> bool:
    """Return whether a sum with the node-ID is written as CiA 306 allows: in either order, in upper case."""
    plain = re.sub(r"\s", "", text)
    return re.fullmatch(rf"(\{NODE_ID}(\+0x[0-9A-Fa-f]+|\+\d+)?|(0x[0-9A-Fa-f]+|\d+)\+\{NODE_ID})", plain) is not None


def _in_range(number: int, bits: int, low: int, high: int) -> int | None:
    """Return a number in the range of its type, also from two's complement or -1 for all bits; None if out of range."""
    if low <= number <= high:
        return number
    if low < 0 and high < number < 1 << bits:
        return number - (1 << bits)
    if low == 0 and -(1 << bits - 1) <= number < 0:
        return number + (1 << bits)
    return None
