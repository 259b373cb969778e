"""What makes an EDS that of a CiA 402 drive: its axes, and objects that are integers of the standard's length."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from canopen.objectdictionary import ODVariable

from drive_env import cia402
from drive_env.dictionary.entries import INTEGER_TYPES, EdsText, read_eds

Key = tuple[int, int]

# Objects whose integers are taken apart bit by bit, or tell where an axis is and goes: their length [bits] by CiA 402.
_BITS = {
    8: (cia402.MODE, cia402.MODE_DISPLAY),
    16: (cia402.CONTROLWORD, cia402.STATUSWORD, cia402.TORQUE_ACTUAL, cia402.TARGET_TORQUE, cia402.QUICK_STOP_OPTION),
    32: (cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TARGET_POSITION, cia402.TARGET_VELOCITY),
}
KINDS: dict[Key, int] = {(index, 0): bits for bits, indices in _BITS.items() for index in indices}
MOST_AXES = 8


def read_types(path: Path | EdsText) -> dict[Key, ODVariable]:
    """Return every entry of an EDS as python-canopen has it."""
    types = {}
    for item in read_eds(path).values():
        for variable in [item] if isinstance(item, ODVariable) else item.values():
            types[variable.index, variable.subindex] = variable
    return types


def axes_of(path: Path, types: Mapping[Key, ODVariable]) -> int:
    """Return how many axes an EDS describes.

    Raises:
        ValueError: If it is that of no CiA 402 drive, or has an object that decides what a drive does with another
            type than the standard's.
    """
    axes = sum((cia402.STATUSWORD + cia402.AXIS_OFFSET * axis, 0) in types for axis in range(MOST_AXES))
    if axes == 0:
        raise ValueError(f"{path} describes no CiA 402 drive: it has no statusword 6041h")
    for axis in range(axes):
        for (index, sub), bits in KINDS.items():
            variable = types.get((index + cia402.AXIS_OFFSET * axis, sub))
            found = None if variable is None else INTEGER_TYPES.get(variable.data_type or 0)
            if variable is not None and (found is None or found[0] != bits):
                said = "of no integer type" if found is None else f"an integer of {found[0]} bits"
                raise ValueError(
                    f"{path}: {variable.index:04X}h {variable.name} is {said} ({variable.data_type or 0:04X}h), and "
                    f"CiA 402 has it with {bits} bits; correct its DataType"
                )
    return axes
