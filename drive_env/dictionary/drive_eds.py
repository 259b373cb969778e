"""Checks that an EDS is of a CiA 402 drive: its axes, and objects that must be integers of the standard's width."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import UNSIGNED8

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.eds_file import place_of_line
from drive_env.dictionary.entries import INTEGER_TYPES, EdsText, eds_text, read_eds
from drive_env.dictionary.standard_types import STANDARD_TYPES

# Objects whose bits are interpreted, or that give an axis' position or target: their width [bits] by CiA 402. A drive
# may have wider ones; words and positions with fewer bits would lack some that a master uses.
_NEEDED = (cia402.CONTROLWORD, cia402.STATUSWORD, cia402.POSITION_ACTUAL, cia402.TARGET_POSITION)
_BITS = {
    8: (cia402.MODE, cia402.MODE_DISPLAY),
    16: (cia402.CONTROLWORD, cia402.STATUSWORD, cia402.TORQUE_ACTUAL, cia402.TARGET_TORQUE, cia402.QUICK_STOP_OPTION),
    32: (cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TARGET_POSITION, cia402.TARGET_VELOCITY),
}
KINDS: dict[Key, int] = {(index, 0): bits for bits, indices in _BITS.items() for index in indices}
MOST_AXES = 8
LONGEST = 32  # bits that one SDO frame carries: stopping and watching a moving axis must not wait for a second one


def read_types(path: Path | EdsText, node_id: int = 1) -> dict[Key, ODVariable]:
    """Return every entry of an EDS as python-canopen has it."""
    types = {}
    for item in read_eds(path, node_id).values():
        for variable in [item] if isinstance(item, ODVariable) else item.values():
            types[variable.index, variable.subindex] = variable
    return types


def _check_values(path: Path | EdsText, types: Mapping[Key, ODVariable]) -> None:
    """Raise ValueError for an object whose sub-index 0 is missing, or a count of sub-indices instead of a value."""
    for index in sorted({index for index, sub in types if sub > 0}):
        axis, first = divmod(index - cia402.PROFILE_AREAS.start, cia402.AXIS_OFFSET)
        bits = KINDS.get((cia402.PROFILE_AREAS.start + first, 0)) if 0 <= axis < MOST_AXES else None
        head = types.get((index, 0))
        if bits is None or (head is not None and head.data_type != UNSIGNED8):
            continue
        subs = ", ".join(f"{sub:02X}" for one, sub in types if one == index and sub > 0)
        found = "has no sub-index 0" if head is None else f"counts them at sub-index 0 ({head.name}, UNSIGNED8)"
        raise ValueError(
            f"{path}{_line_of(path, index)}: {index:04X}h has sub-indices {subs} and {found}, where CiA 402 has the "
            f"value itself, {bits} bits; make [{index:04X}] one object with ObjectType=0x7 and that DataType, without "
            "sub-objects. A drive that has the value at another sub-index is no CiA 402 drive, and cannot be driven"
        )


def _line_of(path: Path | EdsText, index: int) -> str:
    """Return ", line n" of an object's first section in an EDS; "" if it has no section."""
    found = (place and place[0] == index for place in map(place_of_line, eds_text(path).splitlines()))
    return next((f", line {number}" for number, is_it in enumerate(found, 1) if is_it), "")


def axes_of(path: Path | EdsText, types: Mapping[Key, ODVariable]) -> int:
    """Return the number of axes that an EDS describes.

    Raises:
        ValueError: If it does not describe a CiA 402 drive, or an object that controls a drive is not an integer, or
            too short.
    """
    _check_values(path, types)
    axes = sum((cia402.STATUSWORD + cia402.AXIS_OFFSET * axis, 0) in types for axis in range(MOST_AXES))
    if axes == 0:
        raise ValueError(f"{path} describes no CiA 402 drive: it has no statusword 6041h")
    for axis in range(axes):
        for (index, sub), bits in KINDS.items():
            variable = types.get((index + cia402.AXIS_OFFSET * axis, sub))
            found = None if variable is None else INTEGER_TYPES.get(variable.data_type or 0)
            if variable is None or (found is not None and _is_long_enough(index, found[0], bits)):
                continue
            said = "of no integer type" if found is None else f"an integer of {found[0]} bits"
            least = bits if index in _NEEDED else 8
            raise ValueError(
                f"{path}{_line_of(path, variable.index)}: {variable.index:04X}h {variable.name} is {said} "
                f"({variable.data_type or 0:04X}h), and CiA 402 has it with {bits} bits; a drive needs an integer of "
                f"{least} to {LONGEST} to be commanded and watched. If its manual says so, too, it cannot be driven"
            )
    return axes


def _is_long_enough(index: int, bits: int, usual: int) -> bool:
    return bits <= LONGEST and (bits >= usual or index not in _NEEDED)


def other_widths(types: Mapping[Key, ODVariable]) -> Iterator[tuple[Key, int, int]]:
    """Yield the first axis' standard objects with another width in an EDS: its bits, and the standard's."""
    for index, (kind, _) in STANDARD_TYPES.items():
        for (one, sub), variable in types.items():
            found, usual = INTEGER_TYPES.get(variable.data_type or 0), INTEGER_TYPES[kind]
            is_value = one == index and (sub > 0) == any((index, k) in types for k in range(1, 255))
            if is_value and found is not None and found[0] != usual[0]:
                yield (index, sub), found[0], usual[0]
