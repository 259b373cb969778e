"""Variants: devices that differ from another device in a few rows of data.

A variant's `device.toml` names the device that it is a variant of (`variant_of`) and holds the differences: values
under the same keys as there, and two tables. `[groups]` has records and arrays, `[objects]` entries by "index:sub",
with their differences from the device's EDS; a new entry has all keys:

    name, access, default, low, high, unit, mappable as in the EDS; limits are optional type u8 ... u32, i8 ... i32,
    text, bytes, domain field its field of the drive record, in `unit`; without one it is a stored value
"""

from __future__ import annotations

import configparser
import dataclasses
import io
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.devices.services import OPTIONAL_EMERGENCIES
from drive_env.dictionary import units
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import EdsText, ObjectDictionary
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

FAMILIES = ("stepper",)  # each has a file beside `DEFAULTS`
DEFAULTS = Path(__file__).parent / "defaults.toml"

# Data types of CiA 301, table 44; codes of object types of CiA 306.
TYPES = {
    "i8": 0x02, "i16": 0x03, "i32": 0x04, "u8": 0x05, "u16": 0x06, "u32": 0x07,
    "text": 0x09, "bytes": 0x0A, "domain": 0x0F,
}  # fmt: skip
VARIABLE, GROUPS = "0x7", {"array": "0x8", "record": "0x9"}
# Keys of a row, and their keys in the EDS.
_KEYS = {"name": "ParameterName", "access": "AccessType", "default": "DefaultValue", "low": "LowLimit",
         "high": "HighLimit", "unit": "Unit"}  # fmt: skip
_MAKERS = range(0x2000, cia402.PROFILE_AREAS.start)
_LISTS = (("MandatoryObjects", (0x1000, 0x1001, 0x1018)), ("ManufacturerObjects", _MAKERS))
_FACTORY_SCALE = 65536.0  # increments per revolution if a preset has no value


def parse_key(text: str) -> Key:
    """Return index and sub-index of "2042:5"."""
    index, sub = text.split(":")
    return int(index, 16), int(sub)


def device_data(folder: Path) -> dict[str, Any]:
    """Return a folder's `device.toml`, completed by its family's file (`like`) and `defaults.toml`.

    A variant's is returned unchanged.

    Raises:
        ValueError: If it cannot be read, or names an unknown family.
    """
    own = read_toml(folder / "device.toml")
    if "variant_of" in own:
        return own
    data = read_toml(DEFAULTS)
    if like := own.get("like"):
        if like not in FAMILIES:
            raise ValueError(f"like = {like!r} names no family of devices; there are {', '.join(FAMILIES)}")
        data = merged(data, read_toml(DEFAULTS.with_name(f"{like}.toml")))
    return merged(data, own)


def merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return a device's data with a variant's: tables are merged, all other values replaced."""
    result = dict(base)
    for name, value in own.items():
        before = base.get(name)
        result[name] = merged(before, value) if isinstance(before, Mapping) and isinstance(value, Mapping) else value
    return result


def own_variant(path: Path, devices: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the data of a variant in the user's own file: a power stage's limits, rates, and optionally objects.

    Args:
        path: The file; it names the device that it is a variant of.
        devices: Data of the known devices, by name.

    Raises:
        ValueError: If the file cannot be read, or has data that a variant cannot have, with the remedy.
    """
    try:
        own = read_toml(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a TOML file: {error}") from None
    of = str(own.get("variant_of"))
    if of not in devices or "variant_of" in devices[of]:
        bases = [name for name, data in devices.items() if "variant_of" not in data]
        raise ValueError(f"{path}: variant_of is {of!r}; it names the device that differs a little: {', '.join(bases)}")
    base = devices[of]
    base = _with_optional_rows(base)
    for table, value in own.items():
        if table in ("name", "title", "variant_of", "objects", "groups"):
            continue
        _check_like(f"{path}: {table}", value, base.get(table), base)
    whole = merged(devices[of], own)
    supply, current = whole["supply"], whole["current"]
    if not supply["undervoltage"] < supply["overvoltage"]:
        raise ValueError(
            f"{path}: supply.undervoltage = {supply['undervoltage']:g} V must lie below supply.overvoltage = "
            f"{supply['overvoltage']:g} V"
        )
    _check_currents(path, current, base["current"])
    try:
        check_rates(whole["rates"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return {"title": f"{base['title']}, {path.stem}", "objects": {}, "groups": {}} | own | {"name": str(path)}


def _check_currents(path: Path, current: Mapping[str, float], base: Mapping[str, float]) -> None:
    """Raise ValueError for currents [A] in another order than those of the base.

    A drive that measures its currents cannot see an overcurrent beyond its range; one whose bridges detect shorts, as
    in stepper drives, has its threshold above its largest current.
    """
    measures = base["overcurrent"] <= base["full_scale"]
    names, meanings = (
        (("nominal", "overcurrent", "full_scale"), "continuous current, overcurrent threshold, measuring range")
        if measures
        else (("nominal", "full_scale", "overcurrent"), "continuous current, largest current, short detection")
    )
    if sorted(values := [current[name] for name in names]) != values:
        told = [f"{name} = {value:g} A" for name, value in zip(names, values, strict=True)]
        raise ValueError(f"{path}: current.{told[0]}, {told[1]} and {told[2]} must come in this order: {meanings}")


def _with_optional_rows(base: Mapping[str, Any]) -> dict[str, Any]:
    """Return a device's data with the rows that it lacks and a variant may have, filled in from similar rows."""
    emergencies, canopen = base["emergencies"], base["canopen"]
    more = dict.fromkeys(OPTIONAL_EMERGENCIES, emergencies["fault_reset"])
    objects = {"serial_number": "1018:4", **canopen["objects"]}
    return {**base, "emergencies": {**more, **emergencies}, "canopen": {**canopen, "objects": objects}}


def check_rates(rates: Mapping[str, float]) -> None:
    """Raise ValueError for rates [Hz] that are not whole multiples of each other, from the fastest to the slowest."""
    chain = [rates[name] for name in ("current", "velocity", "supervision", "communication")]
    if any(slow <= 0 or fast % slow for fast, slow in itertools.pairwise(chain)):
        raise ValueError(
            f"rates = {chain} Hz of current loop, velocity loop, supervision and communication; each must be a whole "
            "multiple of the next"
        )


def _check_like(where: str, value: Any, known: Any, base: Mapping[str, Any]) -> None:
    """Raise ValueError unless a value has the type of the device's data there; numbers must be above 0."""
    if known is None:
        name = where.rsplit(" ", 1)[-1]
        raise ValueError(f"{where} is nothing that a device has{did_you_mean(name, base)}")
    if isinstance(known, Mapping):
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} is a table of {', '.join(known)}")
        for key, inner in value.items():
            _check_like(f"{where}.{key}", inner, known.get(key), known)
    elif isinstance(known, bool):
        if not isinstance(value, bool):
            raise ValueError(f"{where} = {value!r} must be true or false")
    elif isinstance(known, int | float):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise ValueError(f"{where} = {value!r} must be a number above 0")
    elif not isinstance(value, type(known)):
        raise ValueError(f"{where} = {value!r} must be as {known!r} is")


def compose_eds(name: str, base: str, data: Mapping[str, Any]) -> EdsText:
    """Return the EDS of a variant: the device's text with the variant's rows.

    Args:
        name: Name of the file that it would be.
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
    """Return a device's bindings with those of a variant's rows, in the units named there."""
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
        entries: The variant's entries.
        before: The device's bindings.
        after: The variant's bindings.
    """
    keys = {name: (entry.index, entry.sub) for name in preset for entry in [entries.find(name)]}
    scale = next((float(preset[name]) for name, key in keys.items() if key == (0x2058, 0)), _FACTORY_SCALE)
    context = units.Context(scale, 1.0)
    result = {}
    for name, raw in preset.items():
        key = keys[name]
        if key in before and before[key].unit != after[key].unit:
            si = raw * units.find_unit(before[key].unit).factor(context)
            raw = round(si / units.find_unit(after[key].unit).factor(context))
        result[name] = raw
    return result


def _section(eds: configparser.RawConfigParser, index: int, sub: int) -> str:
    """Return the name of an entry's section; a variable is in its object's section."""
    top = f"{index:04X}"
    is_group = top in eds and eds[top]["ObjectType"] in GROUPS.values()
    return f"{top}sub{sub:X}" if is_group else top


def _eds(row: Mapping[str, Any]) -> dict[str, str]:
    found = {_KEYS[key]: str(value) for key, value in row.items() if key in _KEYS}
    if "type" in row:
        found["DataType"] = f"0x{TYPES[row['type']]:04X}"
    if "mappable" in row:
        found["PDOMapping"] = str(int(row["mappable"]))
    return found


def _count(eds: configparser.RawConfigParser) -> None:
    """Update the lists of objects, and the number of sub-indices of each, to the sections."""
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
