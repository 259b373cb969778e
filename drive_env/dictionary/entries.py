"""The entries of a device's object dictionary, read from its EDS, found by index or by name."""

from __future__ import annotations

import copy
import difflib
import io
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import canopen
import numpy as np
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from numpy.typing import ArrayLike

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, NO_SUCH_SUB_INDEX, ObjectAccessError
from drive_env.dictionary.eds_file import EdsFile, parse_eds
from drive_env.dictionary.roles import Role
from mechanics.reading.untrusted import read_bytes

# How callers name an object: index (sub-index 0), (index, sub-index), a role, or CiA's name ("Object.Sub-object" for a
# sub-object), in any case.
ObjectName: TypeAlias = int | tuple[int, int] | str | Role
ObjectNames: TypeAlias = ObjectName | Sequence[ObjectName]
Rows: TypeAlias = Mapping[Any, ArrayLike] | None  # values to play, one for each cycle, by the objects' names

# Width [bits], least and greatest value of each integer type of CiA 301.
_WIDTHS = (8, 16, 24, 32, 40, 48, 56, 64)
INTEGER_TYPES = {
    datatypes.BOOLEAN: (1, 0, 1),
    **{getattr(datatypes, f"INTEGER{bits}"): (bits, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in _WIDTHS},
    **{getattr(datatypes, f"UNSIGNED{bits}"): (bits, 0, 2**bits - 1) for bits in _WIDTHS},
}


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One sub-index with everything that the dictionary says of it. `bits`, `low`, `high` are None for a text.

    Entries are compared by identity, since tables keyed by entry are looked up every millisecond.
    """

    index: int
    sub: int
    name: str
    bits: int | None
    access: str
    low: int | None
    high: int | None
    default: int | str
    unit: str
    pdo_mappable: bool
    signed: bool = False

    @property
    def label(self) -> str:
        """Index and name as a message shows them, e.g. `2042h:01 Velocity Mode Settings.P_Parameter`."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


@dataclass(frozen=True, slots=True)
class EdsText:
    """An EDS without a file: a variant's is composed of its device's and a few rows."""

    name: str
    text: str

    def read_text(self, encoding: str = "utf-8") -> str:
        """Return the text, as a path does."""
        return self.text

    def __str__(self) -> str:
        return self.name


def read_eds(path: Path | EdsText, node_id: int = 1) -> canopen.ObjectDictionary:
    """Return python-canopen's model of an EDS, after correcting deviations from CiA 306.

    The model is cached: copy it before changing it.
    """
    text, name = _source(path)
    return _model(text, name, node_id)


def eds_file(path: Path | EdsText, node_id: int = 1) -> EdsFile:
    """Return the content of an EDS, with the corrections that it needed.

    A file that is not UTF-8 is read as cp1252, which many vendors use; bytes that cp1252 lacks occur only in names and
    comments, where they are shown as unknown.
    """
    return parse_eds(_source(path)[0], node_id)


def eds_text(path: Path | EdsText) -> str:
    """Return the text of an EDS, uncorrected."""
    return _source(path)[0]


def written_objects(path: Path | EdsText, indices: Iterable[int]) -> dict[int, ODArray | ODRecord]:
    """Return objects, by index, as writable ones that an EDS lists as read-only; for a fieldbus that can write them."""
    found = {}
    for index in indices:
        item = found[index] = copy.copy(read_eds(path)[index])  # a deep copy would include the whole dictionary
        members, item.subindices, item.names = list(item.values()), {}, {}
        for member in map(copy.copy, members):
            member.access_type = "rw"
            item.add_member(member)
    return found


def _source(path: Path | EdsText) -> tuple[str, str]:
    return (path.text, path.name) if isinstance(path, EdsText) else (_read_text(path), str(path))


@lru_cache(maxsize=16)  # 0.1 to 1 s each, for every set of drives and every connection
def _model(text: str, name: str, node_id: int) -> canopen.ObjectDictionary:
    source = io.StringIO(parse_eds(text, node_id).text())
    source.name = name if name.lower().endswith((".eds", ".dcf")) else f"{name}.eds"
    return canopen.import_od(source, node_id)


def _read_text(path: Path) -> str:
    raw = read_bytes(path)
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _content(variable: ODVariable) -> str:
    """Return the factory value of a text, domain or float; each byte of text and domain is a character."""
    if variable.data_type in datatypes.FLOAT_TYPES:
        content = struct.pack("<f" if variable.data_type == datatypes.REAL32 else "<d", float(variable.default or 0.0))
        return content.decode("latin-1")
    return variable.default.decode("latin-1") if isinstance(variable.default, bytes) else str(variable.default or "")


@lru_cache(maxsize=32)
def _entries(text: str, name: str, node_id: int) -> tuple[dict[tuple[int, int], Entry], dict[str, tuple[int, int]]]:
    """Return the entries of an EDS, and the key of each name."""
    found = [entry for item in _model(text, name, node_id).values() for entry in _entries_of(item)]
    entries = {(entry.index, entry.sub): entry for entry in found}
    return entries, {entry.name.casefold(): (entry.index, entry.sub) for entry in found}


def _entries_of(item: ODVariable | ODArray | ODRecord) -> list[Entry]:
    """Return the entries of an object of python-canopen's model."""
    if isinstance(item, ODVariable):
        return [_entry(item, item.name)]
    return [_entry(one, f"{item.name}.{one.name}" if one.subindex else item.name) for one in item.values()]


def _entry(variable: ODVariable, name: str) -> Entry:
    kind = INTEGER_TYPES.get(variable.data_type or 0)
    low: int | None
    high: int | None
    default: int | str
    if kind is None:
        bits = low = high = None
        signed = False
        default = _content(variable)
    else:
        bits, low, high = kind
        signed = low < 0
        low = low if variable.min is None else int(variable.min)
        high = high if variable.max is None else int(variable.max)
        default = int(variable.default or 0)
    return Entry(
        variable.index,
        variable.subindex,
        name,
        bits,
        variable.access_type,
        low,
        high,
        default,
        variable.unit,
        bool(variable.pdo_mappable),
        signed,
    )


def _as_key(name: str) -> tuple[int, int] | None:
    """Parse "6081:0", as in the files of a device, to index and sub-index; None for other text."""
    index, colon, sub = name.partition(":")
    is_key = bool(colon) and len(index) == 4 and all(letter in "0123456789abcdefABCDEF" for letter in index)
    return (int(index, 16), int(sub)) if is_key and sub.isdecimal() else None


class ObjectDictionary:
    """All entries of a device, from its EDS.

    Args:
        path: The EDS.
        node_id: Node-ID for defaults that contain it.
        roles: Role -> its object.
        moved: Name or index ("23C5") of a former object -> its replacement, for messages.
    """

    def __init__(
        self,
        path: Path | EdsText,
        node_id: int = 1,
        roles: Mapping[Role, tuple[int, int]] | None = None,
        moved: Mapping[str, str] | None = None,
    ) -> None:
        self._moved = {name.casefold(): to for name, to in (moved or {}).items()}
        self.path = path
        self.roles = dict(roles or {})
        self._entries, self._names = _entries(*_source(path), node_id)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def __len__(self) -> int:
        return len(self._entries)

    def has(self, name: ObjectName) -> bool:
        """Return whether the dictionary has an object of that name or role."""
        if isinstance(name, int):
            name = name, 0
        if type(name) is tuple and len(name) == 2:  # the message of an error tries all of them
            return name in self._entries
        try:
            self.find(name)
        except ObjectAccessError:
            return False
        return True

    def find(self, name: ObjectName) -> Entry:
        """Return the entry of that name.

        Raises:
            ObjectAccessError: 06020000h if there is no such object, 06090011h if it has no such sub-index.
        """
        if type(name) is tuple and name in self._entries:
            return self._entries[name]
        if isinstance(name, Role):
            if name not in self.roles:
                raise ObjectAccessError(NO_SUCH_OBJECT, f"this drive has no {name.value}")
            name = self.roles[name]
        if isinstance(name, str):
            key = self._names.get(name.strip().casefold()) or _as_key(name)
            if key is not None and key not in self._entries:
                return self.find(key)
            if key is None and name.strip().casefold() in self._moved:
                raise ObjectAccessError(NO_SUCH_OBJECT, f"no object is named {name!r} any more{self._instead(name)}")
            if key is None:
                near = difflib.get_close_matches(name.casefold(), self._names, 3, 0.5)
                hint = "; did you mean " + " or ".join(repr(self._entries[self._names[n]].name) for n in near)
                raise ObjectAccessError(
                    NO_SUCH_OBJECT, f"no object is named {name!r}{hint if near else '; see the device EDS'}"
                )
            return self._entries[key]
        index, sub = name if isinstance(name, tuple) and len(name) == 2 else (name, 0)
        if not isinstance(index, (int, np.integer)) or not isinstance(sub, (int, np.integer)):
            raise ObjectAccessError(
                NO_SUCH_OBJECT, f"an object is named by index, (index, sub-index) or name, not {name!r}"
            )
        if (index, sub) in self._entries:
            return self._entries[index, sub]
        subs = [s for i, s in self._entries if i == index]
        if subs:
            raise ObjectAccessError(
                NO_SUCH_SUB_INDEX, f"object {index:04X}h has no sub-index {sub}; the highest is {max(subs)}"
            )
        missing = f"object {index:04X}h does not exist in {self.path.name}"
        raise ObjectAccessError(NO_SUCH_OBJECT, f"{missing}{self._instead(f'{index:04X}')}")

    def _instead(self, name: str) -> str:
        to = self._moved.get(name.strip().casefold())
        return f"; earlier versions had it: write {to}" if to else ""

    def only(self, has: Callable[[int, str], bool]) -> ObjectDictionary:
        """Return the dictionary of only the objects for whose index and name `has` is true."""
        return self._with({key: one for key, one in self._entries.items() if has(one.index, one.name)})

    def including(self, items: Iterable[ODArray | ODRecord]) -> ObjectDictionary:
        """Return the dictionary with objects of python-canopen's model, which replace those of the same index."""
        more = {(one.index, one.sub): one for item in items for one in _entries_of(item)}
        replaced = {index for index, _ in more}
        return self._with({key: one for key, one in self._entries.items() if key[0] not in replaced} | more)

    def _with(self, entries: dict[tuple[int, int], Entry]) -> ObjectDictionary:
        other = copy.copy(self)
        other._entries = entries
        other._names = {one.name.casefold(): key for key, one in entries.items()}
        return other
