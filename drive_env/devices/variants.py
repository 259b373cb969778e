"""Variants: devices that are another device but for a few rows of data.

A variant's `device.toml` names the device that it is a variant of (`variant_of`) and holds what differs: values under
the same keys as there, and two tables. `[groups]` has records and arrays, `[objects]` entries, "index:sub" with what
differs of the device's EDS; an entry that the device lacks has all of it:

    name, type (u8 ... i32), access, default, low, high, unit, mappable   as the EDS has them; limits may be left out
    field     field of the drive record that it is, in `unit`; without one a value that is stored
"""

from __future__ import annotations

import configparser
import dataclasses
import io
from collections.abc import Mapping
from typing import Any

from drive_env.dictionary import units
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import EdsText, ObjectDictionary

Key = tuple[int, int]

# Data types of CiA 301, table 44; codes of object types of CiA 306.
TYPES = {"i8": 0x02, "i16": 0x03, "i32": 0x04, "u8": 0x05, "u16": 0x06, "u32": 0x07}
VARIABLE, GROUPS = "0x7", {"array": "0x8", "record": "0x9"}
# Keys of a row, and those of the EDS.
_KEYS = {"name": "ParameterName", "access": "AccessType", "default": "DefaultValue", "low": "LowLimit",
         "high": "HighLimit", "unit": "Unit"}  # fmt: skip
_LISTS = (("MandatoryObjects", (0x1000, 0x1001, 0x1018)), ("ManufacturerObjects", range(0x2000, 0x6000)))
_FACTORY_SCALE = 65536.0  # increments of a revolution where a preset says nothing else


def parse_key(text: str) -> Key:
    """Return index and sub-index of "2042:5"."""
    index, sub = text.split(":")
    return int(index, 16), int(sub)


def merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return a device's data with a variant's in their place; tables are merged, everything else is replaced."""
    result = dict(base)
    for name, value in own.items():
        before = base.get(name)
        result[name] = merged(before, value) if isinstance(before, Mapping) and isinstance(value, Mapping) else value
    return result


def compose_eds(name: str, base: str, data: Mapping[str, Any]) -> EdsText:
    """Return the EDS of a variant: the device's text with the variant's rows.

    Args:
        name: Of the file that it would be.
        base: The device's EDS.
        data: The variant's own data.
    """
    eds = configparser.RawConfigParser(comment_prefixes=(";",))
    eds.optionxform = str  # type: ignore[assignment,method-assign]
    eds.read_string(base)
    eds["Comments"]["Line2"] = "Decisions stand in both devices' data."
    eds["Comments"]["Line1"] = f"Object dictionary of {data['variant_of']} with what differs in {data['name']}."
    eds["FileInfo"].update(FileName=name, Description=data["title"])
    for index, group in data["groups"].items():
        eds[index] = {"ParameterName": group["name"], "ObjectType": GROUPS[group["type"]]}
    for text, row in data["objects"].items():
        section = _section(eds, *parse_key(text))
        before = dict(eds[section]) if eds.has_section(section) else {"ObjectType": VARIABLE, "PDOMapping": "0"}
        eds[section] = before | _eds(row)
    _count(eds)
    out = io.StringIO()
    eds.write(out, space_around_delimiters=False)
    return EdsText(name, out.getvalue())


def variant_bindings(base: Mapping[Key, Binding], rows: Mapping[str, Mapping[str, Any]]) -> dict[Key, Binding]:
    """Return a device's bindings with what a variant's rows bind, and in the units that they name."""
    bindings = dict(base)
    for text, row in rows.items():
        key = parse_key(text)
        unit = row.get("unit") or "raw"
        if "field" in row:
            bindings[key] = Binding(*key, row["field"], unit)
        elif "unit" in row and key in bindings:
            bindings[key] = dataclasses.replace(bindings[key], unit=unit)
    return bindings


def converted_preset(
    preset: Mapping[str, int], entries: ObjectDictionary, before: Mapping[Key, Binding], after: Mapping[Key, Binding]
) -> dict[str, int]:
    """Return a device's preset in the units of a variant, rounded.

    Args:
        preset: Object name -> raw value.
        entries: Of the variant.
        before: The device's bindings.
        after: The variant's.
    """
    keys = {name: (entry.index, entry.sub) for name in preset for entry in [entries.find(name)]}
    scale = next((float(preset[name]) for name, key in keys.items() if key == (0x2058, 0)), _FACTORY_SCALE)
    context = units.Context(scale, 1.0)
    result = {}
    for name, raw in preset.items():
        key = keys[name]
        if key in before and before[key].unit != after[key].unit:
            si = units.one_from_od(before[key].unit, raw, units.factor_of_one(before[key].unit, context))
            raw = round(si / units.factor_of_one(after[key].unit, context))
        result[name] = raw
    return result


def _section(eds: configparser.RawConfigParser, index: int, sub: int) -> str:
    """Return the name of an entry's section; a variable is its own."""
    top = f"{index:04X}"
    is_group = top in eds and eds[top]["ObjectType"] in GROUPS.values()
    return f"{top}sub{sub:X}" if is_group else top


def _eds(row: Mapping[str, Any]) -> dict[str, str]:
    """Return a row's keys as the EDS has them."""
    found = {_KEYS[key]: str(value) for key, value in row.items() if key in _KEYS}
    if "type" in row:
        found["DataType"] = f"0x{TYPES[row['type']]:04X}"
    if "mappable" in row:
        found["PDOMapping"] = str(int(row["mappable"]))
    return found


def _count(eds: configparser.RawConfigParser) -> None:
    """Bring the lists of objects, and the number of sub-indices of each, in line with the sections."""
    indices = sorted(int(name, 16) for name in eds.sections() if len(name) == 4 and _is_hexadecimal(name))
    listed: set[int] = set()
    for group, members in _LISTS:
        chosen = [index for index in indices if index in members]
        listed |= set(chosen)
        _list(eds, group, chosen)
    _list(eds, "OptionalObjects", [index for index in indices if index not in listed])
    for index in indices:
        if eds[f"{index:04X}"]["ObjectType"] in GROUPS.values():
            subs = [name for name in eds.sections() if name.startswith(f"{index:04X}sub")]
            eds[f"{index:04X}"]["SubNumber"] = f"0x{len(subs):X}"


def _list(eds: configparser.RawConfigParser, group: str, indices: list[int]) -> None:
    eds[group] = {"SupportedObjects": str(len(indices))} | {
        str(k): f"0x{index:04X}" for k, index in enumerate(indices, 1)
    }


def _is_hexadecimal(text: str) -> bool:
    return all(letter in "0123456789ABCDEF" for letter in text)
