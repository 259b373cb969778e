"""Process data as one packed image in each direction, and the objects of its mapping (ETG.1000.6, 5.6.7.4).

Sync manager 2 carries what the master sends (outputs), sync manager 3 what the drive answers (inputs). 1C12h and 1C13h
name the mapping objects of each, and those name the objects, which follow each other without gaps. An image is not
limited to the 8 bytes of a CAN frame. Some devices have ready-made images (`fixed_images.py`) and no mapping objects:
1C12h and 1C13h name one of these. Entries can be changed while their number is 0 (1600h:00), assignments while theirs
is (1C12h:00). A mapping may stay assigned meanwhile: some masters remove the assignment first, others only write it
last. An entry without an object (0000h:00) is a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from drive_env.devices import Device
from drive_env.dictionary.aborts import SUB_INDEX_ZERO_IN_USE, VALUE_RANGE, WRONG_STATE, ObjectAccessError
from drive_env.dictionary.access import check_allowed, check_limits, check_writable
from drive_env.dictionary.entries import Entry, ObjectDictionary
from drive_env.dictionary.roles import Role
from drive_env.node import mapping
from drive_env.node.axis import ObjectPort
from drive_env.node.fixed_images import PackedFields
from drive_env.node.process_data import MappedObjects

SYNC_MANAGER_TYPES = 0x1C00
OUTPUTS, INPUTS = 0x1C12, 0x1C13  # the objects that sync managers 2 and 3 carry
SYNCHRONISATION = (0x1C32, 0x1C33)  # of both
ASSIGNMENTS = {OUTPUTS: range(0x1600, 0x1800), INPUTS: range(0x1A00, 0x1C00)}  # and the mappings that each can carry


class ImageObjects:
    """The objects of a process image, and the image that they define; for use after `connect`.

    Args:
        device: The device.
        entries: Its dictionary.
        may_change: Returns whether the image may be changed now; on EtherCAT only in pre-operational.

    Raises:
        ValueError: For a device without sync managers.
    """

    def __init__(self, device: Device, entries: ObjectDictionary, may_change: Callable[[], bool]) -> None:
        missing = [index for index in ASSIGNMENTS if not entries.has(index)]
        if missing:
            raise ValueError(
                f"{device.name} has no process image: its dictionary lacks {missing[0]:04X}h; its process data are PDOs"
            )
        self._may_change = may_change
        self._allowed = device.allowed_values
        self._entries = entries
        self._roles = device.roles
        carried = {direction: [i for i in indices if entries.has(i)] for direction, indices in ASSIGNMENTS.items()}
        # CANopen's PDOs, which the device may have too, each have a communication parameter 200h below their mapping.
        self._mappings = {
            index: direction
            for direction, indices in carried.items()
            for index in indices
            if not entries.has(index - 0x200)
        }
        self._fixed = device.images
        owned = {SYNC_MANAGER_TYPES, *ASSIGNMENTS, *SYNCHRONISATION, *self._mappings}
        self._factory = {(entry.index, entry.sub): _number(entry) for entry in entries if entry.index in owned}
        self._values = dict(self._factory)

    def connect(self, port: Callable[[int, int], ObjectPort]) -> None:
        """Connect the mapped objects to their ports in the node's dictionary, by index and sub-index."""
        self._port_of = port
        self._configure()

    # --- the image --------------------------------------------------------------------------------------------------
    @property
    def output_size(self) -> int:
        """Length of the output image, from the master [bytes]."""
        return self._images[OUTPUTS].size

    @property
    def input_size(self) -> int:
        """Length of the input image, from the drive [bytes]."""
        return self._images[INPUTS].size

    def write_outputs(self, data: bytes) -> bool:
        """Apply the master's outputs; an object that does not accept its value keeps the old one.

        Returns:
            Whether each accepted its value.

        Raises:
            ValueError: For data of another length than the image; a sync manager never passes such on.
        """
        image = self._images[OUTPUTS]
        if len(data) != image.size:
            raise ValueError(f"outputs have {image.size} bytes as they are mapped, not {len(data)}")
        return image.write(data)

    def read_inputs(self) -> bytes:
        """Return the present input image, which the drive sends."""
        return self._images[INPUTS].pack()

    def restart(self) -> None:
        """Restore the factory's image, as a device does at power-on."""
        self._values.update(self._factory)
        for direction, role in ((OUTPUTS, Role.OUTPUT_IMAGE), (INPUTS, Role.INPUT_IMAGE)):
            key = self._roles.get(role)
            if key is not None:  # a register of the device selects the image at power-on
                raw = self._port_of(*key).read()
                assert isinstance(raw, int), "the number of an image"
                self._values[direction, 1] = raw
        self._configure()

    # --- the objects ------------------------------------------------------------------------------------------------
    def owns(self, entry: Entry) -> bool:
        """Return whether an object is one of the image's."""
        return (entry.index, entry.sub) in self._values

    def port(self, entry: Entry) -> ObjectPort:
        """Return the port of one of the image's objects."""
        key = (entry.index, entry.sub)

        def write(raw: int) -> None:
            self._values[key] = raw
            self._configure()

        return ObjectPort(entry, lambda: self._values[key], partial(self._check, entry), write)

    def write_whole(self, index: int, raws: Sequence[int]) -> None:
        """Replace an object's sub-indices from 1 on; if it is refused, they are unchanged.

        Raises:
            ObjectAccessError: As for single writes, with the number of entries set to 0 before and to their number
                after.
        """
        before = dict(self._values)
        try:
            for sub, raw in ((0, 0), *enumerate(raws, 1), (0, len(raws))):
                port = self.port(self._find(index, sub))
                check_writable(port.entry)
                port.check(raw)
                self._values[index, sub] = raw
        except ObjectAccessError:
            self._values = before
            raise
        self._configure()

    def writes_whole(self, index: int) -> bool:
        """Return whether an object's number of entries can be written, as of a mapping or an assignment."""
        return index in ASSIGNMENTS or index in self._mappings

    def mapped(self, direction: int) -> list[tuple[int, list[int]]]:
        """Return the mapping objects of `OUTPUTS` or `INPUTS`, with the entries of each as integers.

        A ready-made image has no mapping object, and so no entries.
        """
        return [
            (index, [self._values[index, sub] for sub in range(1, self._values.get((index, 0), 0) + 1)])
            for index in self._assigned(direction)
        ]

    # --- inside -----------------------------------------------------------------------------------------------------
    def _configure(self) -> None:
        self._images = {direction: self._image(direction) for direction in ASSIGNMENTS}

    def _image(self, direction: int) -> MappedObjects | PackedFields:
        ready_made = next((self._fixed[index] for index in self._assigned(direction) if index in self._fixed), None)
        if ready_made is not None:
            return PackedFields(ready_made.fields, self._port_of)
        raws = [raw for _, mapped in self.mapped(direction) for raw in mapped]
        return MappedObjects(
            [raw if mapping.is_gap(raw) else self._port_of(raw >> 16, raw >> 8 & 0xFF) for raw in raws]
        )

    def _assigned(self, direction: int) -> list[int]:
        return [self._values[direction, sub] for sub in range(1, self._values[direction, 0] + 1)]

    def _check(self, entry: Entry, raw: int) -> None:
        check_limits(entry, raw)
        allowed = self._allowed.get((entry.index, entry.sub))
        if allowed is not None:
            check_allowed(entry, np.array([raw]), allowed)
        if not self._may_change():
            raise ObjectAccessError(WRONG_STATE, f"{entry.label} can only be written in pre-operational")
        if entry.index in ASSIGNMENTS:
            self._check_assignment(entry, raw)
        elif entry.index in self._mappings:
            self._check_mapping(entry, raw)

    def _check_assignment(self, entry: Entry, raw: int) -> None:
        direction = entry.index
        self._check_sub_index(entry)
        for index in [self._values[direction, sub] for sub in range(1, raw + 1)] if entry.sub == 0 else [raw]:
            if not self._can_carry(direction, index):
                numbers = [one for one in {**self._mappings, **self._fixed} if self._can_carry(direction, one)]
                known = ", ".join(f"{one:04X}h" for one in numbers)
                raise ObjectAccessError(VALUE_RANGE, f"{entry.label} cannot be {index:04X}h; there is {known}")

    def _can_carry(self, direction: int, index: int) -> bool:
        fixed = self._fixed.get(index)
        return fixed.is_output == (direction == OUTPUTS) if fixed else self._mappings.get(index) == direction

    def _check_mapping(self, entry: Entry, raw: int) -> None:
        self._check_sub_index(entry)
        is_count = entry.sub == 0
        raws = [self._values[entry.index, sub] for sub in range(1, raw + 1)] if is_count else [raw] if raw else []
        for mapped in raws:
            if not mapping.is_gap(mapped):
                mapping.check_mappable(entry, mapped, self._mappings[entry.index] == INPUTS, self._find)
        if is_count:
            mapping.check_gaps(entry, raws)

    def _check_sub_index(self, entry: Entry) -> None:
        count = self._values[entry.index, 0]
        if entry.sub != 0 and count != 0:
            raise ObjectAccessError(
                SUB_INDEX_ZERO_IN_USE, f"{entry.label} is one of {count} in use; set sub-index 0 to 0 before"
            )

    def _find(self, index: int, sub: int) -> Entry:
        return self._entries.find((index, sub))


def _number(entry: Entry) -> int:
    assert isinstance(entry.default, int), "objects of the image are numbers"
    return entry.default
