"""Places of objects in the images of a slave, and the images that a device can have (ETG.1000.6, 5.6.7.4)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices.image_rows import TYPES
from drive_env.dictionary.aborts import CANNOT_BE_MAPPED, PDO_LENGTH_EXCEEDED, ObjectAccessError
from drive_env.dictionary.entries import Entry
from drive_env.fieldbus.description import Description
from drive_env.master.packing import Member
from drive_env.node.mapping import is_gap

OUTPUTS, INPUTS = 0x1C12, 0x1C13  # the objects that sync managers 2 and 3 carry
MAPPINGS = {OUTPUTS: range(0x1600, 0x1800), INPUTS: range(0x1A00, 0x1C00)}
FIRST_PDO = {OUTPUTS: 0x1600, INPUTS: 0x1A00}  # of a device whose data name none
# Objects that command a drive and show its state, mapped if there is room.
ESSENTIAL = {
    OUTPUTS: (cia402.CONTROLWORD,),
    INPUTS: (cia402.STATUSWORD, cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL),
}
USUAL_ENTRIES = 8  # that a mapping object holds if the EDS does not list them


class ImageLayout(NamedTuple):
    """One image.

    Attributes:
        pdo: Mapping object assigned to the sync manager.
        members: Objects of the axes and their places; an object of the whole node is listed for each axis.
        size: Length [bytes].
        mapped: Mapping entries to be written; None for a ready-made image.
        more: Further assigned mapping objects of a ready-made image in several parts.
    """

    pdo: int
    members: tuple[Member, ...]
    size: int
    mapped: tuple[int, ...] | None
    more: tuple[int, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Return the entries that every axis has in the image."""
        axes = {member.axis for member in self.members}
        of_axes: dict[Entry, set[int]] = {}
        for member in self.members:
            of_axes.setdefault(member.entry, set()).add(member.axis)
        return tuple(entry for entry, found in of_axes.items() if found == axes)

    def places(self, description: Description) -> dict[Key, tuple[int, int]]:
        """Return first byte and length of each object of the node."""
        return {description.key(m.entry, m.axis): (m.start, m.size) for m in self.members}


class ImagePlanner:
    """Finds images of a device that carry wanted entries.

    Args:
        description: The device. Its ready-made images are those of its data.
    """

    def __init__(self, description: Description) -> None:
        self._description = description
        known = description.dictionary
        # If the EDS lists a further axis' object, too, the first axis' entry counts.
        self._by_key = {(entry.index, entry.sub): (entry, 0) for entry in known} | {
            key: (entry, axis) for key, (entry, axis) in description.of_further_axes().items()
        }
        images = {} if description.device is None else description.device.images
        self._ready_made: dict[int, list[ImageLayout]] = {OUTPUTS: [], INPUTS: []}
        for pdo, image in images.items():
            fields = [(None if one.is_name else one.key, TYPES[one.type][1]) for one in image.fields]
            self._ready_made[OUTPUTS if image.is_output else INPUTS].append(self._of_fields(pdo, fields))

        for direction, indices in MAPPINGS.items() if description.device is not None else ():
            for entry in known:
                if entry.sub == 0 and entry.index in indices and self._is_ready_made(entry.index):
                    subs = range(1, int(entry.default) + 1)
                    raws = [int(known.find((entry.index, sub)).default) for sub in subs]
                    self._ready_made[direction].append(self._of_raws([entry.index], raws))

    def parsed(self, direction: int, pdos: Sequence[int], mapped: Sequence[int]) -> ImageLayout | None:
        """Return the image of a slave's mapping objects; None if it is not the same for every axis.

        An image with a read-only mapping object is ready-made, and stays unchanged; so do several if one of them is.
        """
        for layout in self._ready_made[direction]:
            if [layout.pdo] == list(pdos):
                return layout
        if any(map(self._is_ready_made, pdos)):
            return self._of_raws(pdos, mapped)
        if len(pdos) > 1:
            return None
        objects = [raw for raw in mapped if not is_gap(raw)]
        entries = []
        for raw in objects:
            found = self._by_key.get((raw >> 16, raw >> 8 & 0xFF))
            if found is None or found[0].bits != raw & 0xFF:
                return None
            entries.append(found[0])
        layout = self.free(pdos[0], tuple(dict.fromkeys(entries)))
        if layout.mapped != tuple(objects):
            return None
        return layout if len(objects) == len(mapped) else self._of_raws(pdos, mapped)._replace(mapped=tuple(mapped))

    def plan(self, direction: int, wanted: Sequence[Entry], current: ImageLayout) -> ImageLayout:
        """Return an image with the wanted entries of every axis; the current one if it has them.

        Raises:
            ObjectAccessError: 06040042h if they do not fit into one image.
        """
        if set(wanted) <= set(current.entries):
            return current
        if current.mapped is None:
            return self._find_ready_made(direction, wanted, current)
        room = self._room(current.pdo)
        layout = self.free(current.pdo, wanted)
        if len(layout.mapped or ()) > room:
            raise ObjectAccessError(
                PDO_LENGTH_EXCEEDED,
                f"{len(wanted)} objects of {self._description.num_axes} axes are more than the {room} that the process "
                f"image {current.pdo:04X}h takes; record or play fewer at a time",
            )
        return self._filled(direction, layout, current.entries)

    def completed(self, direction: int, current: ImageLayout) -> ImageLayout:
        """Return an image with the usual command and state entries added, as far as there is room."""
        return current if current.mapped is None else self._filled(direction, current, ())

    def free(self, pdo: int, entries: Iterable[Entry]) -> ImageLayout:
        """Return the freely mapped image that carries entries of every axis, axis by axis."""
        known = self._description
        places: dict[Key, int] = {}
        members, mapped, start = [], [], 0
        for axis in range(known.num_axes):
            for entry in entries:
                key, bits = known.key(entry, axis), entry.bits or 0
                if key not in places:
                    places[key] = start
                    mapped.append(key[0] << 16 | key[1] << 8 | bits)
                    start += bits // 8
                members.append(Member(entry, axis, places[key], bits // 8))
        return ImageLayout(pdo, tuple(members), start, tuple(mapped))

    def carried(self, direction: int) -> set[Entry]:
        """Return the entries that are in ready-made images."""
        return {entry for layout in self._ready_made[direction] for entry in layout.entries}

    # --- inside -----------------------------------------------------------------------------------------------------
    def _find_ready_made(self, direction: int, wanted: Sequence[Entry], current: ImageLayout) -> ImageLayout:
        """Return the first ready-made image that has the wanted entries; ObjectAccessError 06040041h if none has."""
        others = self._ready_made[direction]
        for layout in others:
            if set(wanted) <= set(layout.entries):
                return layout
        known = {entry for layout in (current, *others) for entry in layout.entries}
        missing = next((entry for entry in wanted if entry not in known), None)
        if missing is None:
            names = " and ".join(entry.label for entry in wanted)
            raise ObjectAccessError(CANNOT_BE_MAPPED, f"no ready-made image of this drive has {names} together")
        raise ObjectAccessError(CANNOT_BE_MAPPED, f"{missing.label} is in no image of this drive, for every axis")

    def _of_fields(self, pdo: int, fields: Iterable[tuple[Key | None, int]]) -> ImageLayout:
        """Return the ready-made image of fields: each an object (None if reserved) and its bits."""
        known = self._description
        members, bit = [], 0
        for key, bits in fields:
            found = None if key is None else self._by_key.get(key)
            if found is not None and bit % 8 == 0:
                entry, axis = found
                shared = all(known.key(entry, other) == key for other in range(known.num_axes))
                size = min(bits, entry.bits or 0) // 8
                members += [Member(entry, k, bit // 8, size) for k in (range(known.num_axes) if shared else (axis,))]
            bit += bits
        return ImageLayout(pdo, tuple(members), (bit + 7) // 8, None)

    def _is_ready_made(self, pdo: int) -> bool:
        """Return whether a mapping object is read-only."""
        known = self._description.dictionary
        return known.has((pdo, 1)) and known.find((pdo, 1)).access in ("ro", "const")

    def _of_raws(self, pdos: Sequence[int], mapped: Sequence[int]) -> ImageLayout:
        """Return the ready-made image of mapping entries, in as many parts as there are mapping objects."""
        keys = [((raw >> 16, raw >> 8 & 0xFF) if raw >> 16 else None, raw & 0xFF) for raw in mapped]
        return self._of_fields(pdos[0], keys)._replace(more=tuple(pdos[1:]))

    def _room(self, pdo: int) -> int:
        """Return the number of entries that a mapping object can hold."""
        known = self._description.dictionary
        return sum(known.has((pdo, sub)) for sub in range(1, 255)) or USUAL_ENTRIES

    def _filled(self, direction: int, layout: ImageLayout, others: Sequence[Entry]) -> ImageLayout:
        known, room = self._description.dictionary, self._room(layout.pdo)
        essential = [known.find((index, 0)) for index in ESSENTIAL[direction] if known.has((index, 0))]
        for entry in (*essential, *others):
            if entry not in layout.entries:
                longer = self.free(layout.pdo, (*layout.entries, entry))
                layout = longer if len(longer.mapped or ()) <= room else layout
        return layout


def changed(found: Mapping[int, ImageLayout], wanted: Mapping[int, ImageLayout]) -> list[int]:
    """Return the directions in which two images differ."""
    return [direction for direction, layout in wanted.items() if found.get(direction) != layout]
