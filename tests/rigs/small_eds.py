"""An EDS of a few rows, for a drive of a test."""

from __future__ import annotations

import re

from drive_env.dictionary.drive_eds import read_types
from drive_env.dictionary.entries import EdsText, ObjectDictionary
from drive_env.fieldbus.description import CIA_402, Description
from rigs import TESTS

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


FOLDER = TESTS / "data" / "eds"


def entry(index="6081", name="Profile velocity", kind="0x7", data_type="0x0007", access="rw", **more):
    """Return the section of an object."""
    rows = {"ParameterName": name, "ObjectType": kind, "DataType": data_type, "AccessType": access} | more
    return f"[{index}]\n" + "".join(f"{key}={value}\n" for key, value in rows.items() if value is not None) + "\n"


def put(text, section, **values):
    """Return an EDS with values of a section changed."""
    head, rest = text.split(f"[{section}]\n", 1)
    body, mark, tail = rest.partition("\n[")
    for key, value in values.items():
        body, done = re.subn(rf"(?m)^{key}=.*$", f"{key}={value}", body)
        body = body if done else f"{key}={value}\n{body}"
    return f"{head}[{section}]\n{body}{mark}{tail}"


EDS = """
[FileInfo]
FileName=some.eds
[DeviceInfo]
VendorName=somebody
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[OptionalObjects]
SupportedObjects={count}
{numbers}
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
{objects}
"""
TYPES = {"u8": "0x0005", "u16": "0x0006", "u32": "0x0007", "i8": "0x0002", "i16": "0x0003", "i32": "0x0004",
         "f32": "0x0008", "text": "0x0009", "u24": "0x0016", "bool": "0x0001", "i64": "0x0015",
         "octets": "0x000A"}  # fmt: skip


def eds_of(folder, *rows):
    """An EDS with objects: index, type, access."""
    numbers = "\n".join(f"{k}=0x{index:04X}" for k, (index, *_) in enumerate(rows, 1))
    objects = "\n".join(
        f"[{index:04X}]\nParameterName=object {index:04X}\nObjectType=0x7\n"
        f"DataType={TYPES[kind]}\nAccessType={access}\n"
        for index, kind, access in rows
    )
    path = folder / "some.eds"
    path.write_text(EDS.format(count=len(rows), numbers=numbers, objects=objects), encoding="utf-8")
    return path
