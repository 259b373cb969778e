"""An EDS of a few rows, for a drive of a test."""

from __future__ import annotations

from drive_env.dictionary.drive_eds import read_types
from drive_env.dictionary.entries import EdsText, ObjectDictionary
from drive_env.fieldbus.description import CIA_402, Description

I8, I16, I32, U8, U16, U32, TEXT, I64 = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09, 0x15


def small_eds(objects, arrays):
    """Return the text of an EDS.

    Args:
        objects: Index, name, type, access, whether a PDO can carry it.
        arrays: Index, access and number of entries (UNSIGNED32) of records, and the most of sub-index 0, or None.
            An access "rw/ro" is that of sub-index 0 and of the entries.
    """
    lines = ["[DeviceInfo]", "VendorName=Test", "[OptionalObjects]", f"SupportedObjects={len(objects) + len(arrays)}"]
    lines += [f"{k}=0x{one[0]:04X}" for k, one in enumerate((*objects, *arrays), 1)]
    for index, name, kind, access, pdo in objects:
        lines += [f"[{index:04X}]", f"ParameterName={name}", *_variable(kind, access, pdo)]
    for index, access, count, most in arrays:
        lines += [f"[{index:04X}]", f"ParameterName=Record {index:X}", "ObjectType=9", f"SubNumber={count + 1}"]
        for sub in range(count + 1):
            lines += [f"[{index:04X}sub{sub:X}]", f"ParameterName=Entry {sub} of {index:X}"]
            lines += _variable(U32 if sub else U8, access.split("/")[-1 if sub else 0], 0)
            lines += [f"HighLimit={most}"] if most and not sub else []
    return EdsText("small.eds", "\n".join(lines) + "\n")


def _variable(kind, access, pdo):
    return ["ObjectType=7", f"DataType=0x{kind:04X}", f"AccessType={access}", f"PDOMapping={pdo}"]


def described(eds, num_axes, hints=CIA_402):
    """Return what a master knows of a drive with this EDS, whose answers take 0.5 s at most."""
    return Description("small", ObjectDictionary(eds), num_axes, None, hints, timeout=0.5, _types=read_types(eds))
