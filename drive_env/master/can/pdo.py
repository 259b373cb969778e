"""PDOs of one node: which exist, how objects are mapped to them, and how they are restored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from drive_env.canopen.frames import EXTENDED, IDENTIFIER, INVALID, RPDO, TPDO
from drive_env.cia402 import Key
from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, ObjectAccessError
from drive_env.dictionary.access import fits_pdo
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.description import Description
from drive_env.fieldbus.errors import BusError, RefusedError
from drive_env.fieldbus.link import ObjectClient
from drive_env.fieldbus.tidying import Tidying
from drive_env.master.can.borrowed_identifiers import BorrowedIdentifiers
from drive_env.master.can.mapping import PDO_BITS, Slots, pack
from drive_env.master.packing import Member

# Transmission types of a TPDO (CiA 301, table 74): at each SYNC; at a SYNC in any way.
SYNC_EVERY, WITH_SYNC = 1, range(241)
SYNCHRONOUS = (1, 0)  # types of an RPDO that waits for SYNC; some drives accept only one of them


class Direction(NamedTuple):
    """RPDOs go into the drive, TPDOs come out of it."""

    name: str
    verb: str
    communication: int  # index of PDO 1's communication parameter
    mapping: int
    identifiers: tuple[int, ...]  # default identifiers of PDO 1 to 4, without the node


INTO_DRIVE = Direction("RPDO", "played", 0x1400, 0x1600, RPDO)
OUT_OF_DRIVE = Direction("TPDO", "recorded", 0x1800, 0x1A00, TPDO)


class RemotePdo(NamedTuple):
    """A PDO in use: its identifier, its length in bytes, its members."""

    label: str
    can_id: int
    length: int
    members: tuple[Member, ...]


class _Before(NamedTuple):
    """A PDO as it was found, with all mapping entries that we overwrite, also those beyond the number in use."""

    number: int
    cob_id: int
    kind: int
    in_use: int
    mapping: tuple[int, ...]


def is_mappable(description: Description, entry: Entry, direction: Direction) -> bool:
    """Return whether the EDS allows an object in PDOs of this direction."""
    carried = fits_pdo(entry, direction is OUT_OF_DRIVE)
    return bool(carried and entry.bits and entry.bits % 8 == 0) and description.is_number(entry)


def mappable_names(description: Description, direction: Direction) -> str:
    """Return the mappable objects of a direction as a list for messages."""
    known = description.dictionary
    return ", ".join(entry.label for entry in known if is_mappable(description, entry, direction)) or "none"


def check_mappable(description: Description, entries: Sequence[Entry], direction: Direction) -> None:
    """Raise ObjectAccessError 06040041h for an object that no PDO of this direction can carry."""
    for entry in entries:
        if not is_mappable(description, entry, direction):
            raise ObjectAccessError(
                CANNOT_BE_MAPPED,
                f"{entry.label} cannot be {direction.verb}: no {direction.name} of {description.name} carries it; they "
                f"carry {mappable_names(description, direction)}. Read or write it instead",
            )


def _numbers(description: Description, direction: Direction) -> list[int]:
    """Return the PDOs of a direction whose mapping has entries."""
    known = description.dictionary
    indices = {entry.index for entry in known}
    mapped = {entry.index for entry in known if entry.sub > 0}
    return [
        number
        for number in range(0x200)
        if direction.communication + number in indices and direction.mapping + number in mapped
    ]


def stands(description: Description, direction: Direction, number: int) -> bool:
    """Return whether a PDO is fixed: its identifier, mapping or (for a TPDO) type is read-only by the EDS."""
    communication, mapping = direction.communication + number, direction.mapping + number
    kind = [(communication, 2)] if direction is OUT_OF_DRIVE else []
    keys = [key for key in ((communication, 1), (mapping, 0), (mapping, 1), *kind) if description.has(key)]
    return any(description.dictionary.find(key).access in ("ro", "const") for key in keys)


def slots(description: Description, direction: Direction, axis: int) -> Slots:
    """Return the PDOs that an axis may use: the node's remappable ones, in equal shares."""
    known = description.dictionary
    there = [one for one in _numbers(description, direction) if not stands(description, direction, one)]
    share = len(there) // description.num_axes
    mine = tuple(there[axis * share : (axis + 1) * share])
    if not mine:
        return Slots((), 0)
    rooms = []
    for number in mine:
        mapping = [entry for entry in known if entry.index == direction.mapping + number]
        limit = next((entry.high for entry in mapping if entry.sub == 0), None)
        rooms.append(min(max(entry.sub for entry in mapping), PDO_BITS // 8, limit if limit else PDO_BITS))
    return Slots(mine, min(rooms))


def plan(description: Description, entries: Sequence[Entry], direction: Direction) -> list[list[Entry]] | None:
    """Return the entries of each PDO of axis 0, or None if they do not fit; other axes are alike."""
    if not entries:
        return []
    return pack(entries, slots(description, direction, 0), keep_order=direction is INTO_DRIVE)


def too_many(description: Description, entries: Sequence[Entry], direction: Direction) -> ObjectAccessError:
    """Return the error for objects that do not fit into the PDOs."""
    room = slots(description, direction, 0)
    bits = sum(entry.bits or 0 for entry in entries)
    standing = sum(stands(description, direction, number) for number in _numbers(description, direction))
    of_those = "is played" if direction is INTO_DRIVE else "is wanted, at every SYNC (type 1)"
    besides = f"; of {standing} that can only be read those are used of which all {of_those}" if standing else ""
    return ObjectAccessError(
        PDO_LENGTH_EXCEEDED,
        f"{len(entries)} objects of {bits} bits do not fit: {description.name} has {len(room.numbers)} "
        f"{direction.name}s for an axis, each with at most {room.entries} objects of {PDO_BITS} bits "
        f"together{besides}; take fewer at a time of {mappable_names(description, direction)}",
    )


class PdoConfiguration:
    """The PDOs of one node, configured over SDO and restored on demand.

    Args:
        node: Node-ID.
        sdo: The node's SDO client.
        description: Its device.
        borrowed: Gives identifiers to PDOs of further axes that have none.
    """

    def __init__(self, node: int, sdo: ObjectClient, description: Description, borrowed: BorrowedIdentifiers) -> None:
        self._node = node
        self._sdo = sdo
        self._description = description
        self._borrowed = borrowed
        self._before: dict[tuple[str, int], _Before] = {}
        self._silenced: dict[int, int] = {}  # TPDO -> its COB-ID as it was found
        self._quiet: set[int] = set()  # TPDOs found not to go with SYNC
        self._standing: dict[str, tuple[RemotePdo, ...]] = {}
        self._types: dict[int, int] = {}  # fixed TPDO whose type alone was changed -> its type as found

    def configure(self, groups: Sequence[Sequence[Entry]], direction: Direction) -> list[RemotePdo]:
        """Map entries of all axes, each group to a PDO that goes with SYNC, and return these PDOs.

        PDOs of this direction that we had mapped and no longer need are restored. Other TPDOs that go with SYNC, as the
        factory's may, are switched off meanwhile: the SYNCs are ours, and each unwanted frame delays the next one by
        0.1 ms.

        Raises:
            ObjectAccessError: If the drive refuses; BusError if it gives the PDO no identifier.
        """
        pdos = []
        used = set()
        for axis in range(self._description.num_axes):
            numbers = slots(self._description, direction, axis).numbers
            for number, group in zip(numbers, groups, strict=False):
                pdos.append(self._map(direction, number, axis, group))
                used.add((direction.name, number))
        for key in [key for key in self._before if key[0] == direction.name and key not in used]:
            self._put_back(direction, self._before[key])
            del self._before[key]
        if direction is OUT_OF_DRIVE:
            self._silence({pdo for _, pdo in used})
        return pdos

    def standing(self, direction: Direction) -> tuple[RemotePdo, ...]:
        """Return the fixed PDOs, as the drive has them, that are on and that our cycles can use.

        A TPDO must go with every SYNC; it is set to that type if its type is writable.
        """
        if direction.name not in self._standing:
            numbers = [
                one for one in _numbers(self._description, direction) if stands(self._description, direction, one)
            ]
            found = [self._as_it_stands(direction, number) for number in numbers]
            self._standing[direction.name] = tuple(one for one in found if one is not None)
        return self._standing[direction.name]

    def _as_it_stands(self, direction: Direction, number: int) -> RemotePdo | None:
        """Return a PDO as the drive has it; None if it is off or our cycles cannot use it."""
        before = self._look(direction, number)
        if before.cob_id & (INVALID | EXTENDED) or not before.in_use:
            return None
        further = self._description.of_further_axes()
        members, start = [], 0
        for raw in before.mapping:
            key, size = (raw >> 16, raw >> 8 & 0xFF), (raw & 0xFF) // 8
            if self._description.has(key):
                entry, axis = further.get(key, (self._description.dictionary.find(key), 0))
                if entry.bits != raw & 0xFF or not size:
                    return None
                members.append(Member(entry, axis, start, size))
            elif direction is INTO_DRIVE or raw % 8:
                return None
            start += size
        kind = direction.communication + number, 2
        if direction is OUT_OF_DRIVE and before.kind != SYNC_EVERY:
            if self._description.dictionary.find(kind).access in ("ro", "const"):
                return None
            self._types[number] = before.kind
            self._put(*kind, SYNC_EVERY, 1, self._sdo.write)
        label = f"{direction.name} {number + 1} of node {self._node}"
        return RemotePdo(label, before.cob_id & IDENTIFIER, start, tuple(members))

    def before(self, key: Key) -> int | None:
        """Return the value that an object had before it was changed here; None if it was not changed."""
        (index, sub), number = key, key[0] & 0x1FF
        for direction in (INTO_DRIVE, OUT_OF_DRIVE):
            found = self._before.get((direction.name, number))
            if index == direction.mapping + number and found is not None:
                return dict(enumerate((found.in_use, *found.mapping))).get(sub)
            if index == direction.communication + number and found is not None:
                return {1: found.cob_id, 2: found.kind}.get(sub)
        if index == OUT_OF_DRIVE.communication + number:
            return {1: self._silenced, 2: self._types}.get(sub, {}).get(number)
        return None

    def restore(self) -> None:
        """Restore every PDO as found.

        Raises:
            BusError: If not all of them could be restored.
        """
        found, self._before = self._before, {}
        tidying = Tidying()
        for (name, _), before in found.items():
            tidying.step(partial(self._put_back, INTO_DRIVE if name == INTO_DRIVE.name else OUT_OF_DRIVE, before))
        silenced, self._silenced = self._silenced, {}
        for number, cob_id in silenced.items():
            tidying.step(partial(self._put, OUT_OF_DRIVE.communication + number, 1, cob_id, 4, self._sdo.put_back))
        types, self._types = self._types, {}
        for number, kind in types.items():
            tidying.step(partial(self._put, OUT_OF_DRIVE.communication + number, 2, kind, 1, self._sdo.put_back))
        self._standing.clear()
        tidying.end()

    def forget(self) -> None:
        """Forget the configuration found: the node was reset and has its own again."""
        self._before.clear()
        self._silenced.clear()
        self._quiet.clear()
        self._standing.clear()
        self._types.clear()

    def _silence(self, used: set[int]) -> None:
        """Switch off the TPDOs that go with SYNC, except those in use."""
        direction = OUT_OF_DRIVE
        for axis in range(self._description.num_axes):
            for number in slots(self._description, direction, axis).numbers:
                if number in used or number in self._silenced or number in self._quiet:
                    continue
                cob_id = self._read(direction.communication + number, 1)
                kind = self._read(direction.communication + number, 2)
                if cob_id & INVALID or kind not in WITH_SYNC:
                    self._quiet.add(number)
                    continue
                self._silenced[number] = cob_id
                self._put(direction.communication + number, 1, cob_id | INVALID, 4, self._sdo.write)

    def _map(self, direction: Direction, number: int, axis: int, group: Sequence[Entry]) -> RemotePdo:
        label = f"{direction.name} {number + 1} of node {self._node}"
        before = self._before.get((direction.name, number)) or self._look(direction, number)
        before = self._look_further(direction, before, len(group))
        self._before[direction.name, number] = before
        if direction is OUT_OF_DRIVE:
            self._silenced.pop(number, None)
        can_id = before.cob_id & IDENTIFIER or self._usual_identifier(direction, number, axis)
        if can_id == 0 or before.cob_id & EXTENDED:
            raise BusError(
                f"{label} has no 11-bit identifier ({before.cob_id:08X}h in "
                f"{direction.communication + number:04X}h:01); give it a free one with `drive-env set`"
            )
        members = []
        start = 0
        mapping = []
        for entry in group:
            index, sub = self._description.key(entry, axis)
            size = (entry.bits or 0) // 8
            mapping.append(index << 16 | sub << 8 | size * 8)
            members.append(Member(entry, axis, start, size))
            start += size
        cob_id = before.cob_id & ~(INVALID | IDENTIFIER) | can_id
        own = self._description.hints.rpdo_type
        kinds = dict.fromkeys((own, *SYNCHRONOUS)) if direction is INTO_DRIVE else (SYNC_EVERY,)
        self._write_all(direction, number, cob_id, (*kinds,), mapping, len(mapping), self._sdo.write)
        return RemotePdo(label, can_id, start, tuple(members))

    def _usual_identifier(self, direction: Direction, number: int, axis: int) -> int:
        """Return the default or borrowed identifier of a PDO that has none; 0 for a fifth PDO of an axis."""
        usual = direction.identifiers
        if number < len(usual):
            return usual[number] + self._node
        place = slots(self._description, direction, axis).numbers.index(number)
        if axis == 0 or place >= len(usual):
            return 0
        return usual[place] + self._borrowed.node_of(self._node, axis)

    def _look(self, direction: Direction, number: int) -> _Before:
        communication, mapping = direction.communication + number, direction.mapping + number
        count = self._read(mapping, 0)
        silenced = self._silenced.get(number) if direction is OUT_OF_DRIVE else None
        return _Before(
            number,
            self._read(communication, 1) if silenced is None else silenced,
            self._read(communication, 2),
            count,
            tuple(self._read(mapping, sub) for sub in range(1, count + 1)),
        )

    def _look_further(self, direction: Direction, before: _Before, entries: int) -> _Before:
        """Return a PDO as found, with at least this many of its mapping entries, since ours overwrite them."""
        more = range(len(before.mapping) + 1, entries + 1)
        found = tuple(self._read(direction.mapping + before.number, sub) for sub in more)
        return before._replace(mapping=before.mapping + found)

    def _put_back(self, direction: Direction, before: _Before) -> None:
        if direction is OUT_OF_DRIVE:
            self._quiet.discard(before.number)
        # Entries that are not in use are parameters, too: a backup contains them.
        self._write_all(
            direction, before.number, before.cob_id, (before.kind,), before.mapping, before.in_use, self._sdo.put_back
        )

    def _write_all(
        self,
        direction: Direction,
        number: int,
        cob_id: int,
        kinds: tuple[int, ...],
        mapping: Sequence[int],
        count: int,
        write: Callable[[int, int, bytes, str, float], None],
    ) -> None:
        """Remap in the order that CiA 301 demands: off, no entries, entries, their number, on.

        The first transmission type that the drive accepts is used.
        """
        put = partial(self._put, write=write)
        communication = direction.communication + number
        put(communication, 1, cob_id | INVALID, 4)
        for place, kind in enumerate(() if self._is_fixed(direction, number) else kinds, 1):
            try:
                put(communication, 2, kind, 1)
                break
            except RefusedError:
                if place == len(kinds):
                    raise
        put(direction.mapping + number, 0, 0, 1)
        for sub, value in enumerate(mapping, 1):
            put(direction.mapping + number, sub, value, 4)
        put(direction.mapping + number, 0, count, 1)
        put(communication, 1, cob_id, 4)

    def _is_fixed(self, direction: Direction, number: int) -> bool:
        """Return whether the type of an RPDO is read-only: it then acts on arrival, just before SYNC."""
        kind = (direction.communication + number, 2)
        known = self._description
        return direction is INTO_DRIVE and known.has(kind) and known.dictionary.find(kind).access in ("ro", "const")

    def _put(
        self, index: int, sub: int, value: int, size: int, write: Callable[[int, int, bytes, str, float], None]
    ) -> None:
        label = f"{index:04X}h:{sub:02X} = {value:X}h"
        write(index, sub, value.to_bytes(size, "little"), label, self._description.answer_timeout)

    def _read(self, index: int, sub: int) -> int:
        label = f"{index:04X}h:{sub:02X}"
        return int.from_bytes(self._sdo.read(index, sub, label, self._description.answer_timeout), "little")
