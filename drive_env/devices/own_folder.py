"""A device's folder, shipped or the user's own: it is all data.

    device.toml rates, limits, causes, behaviour on a bus; missing keys are those of defaults.toml *.eds its dictionary;
    device.toml names it bindings.toml "index:sub" = { field, unit, part, event }: the field of the drive record of each
    object roles.toml the object of each role gains.toml its gains, and the cascade that they belong to
    commissioning.toml optional: values for a motor, by a rule (commissioning.py) presets/ <motor>.toml for each motor
    with other values

Nothing in the folder is executed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drive_env.cia402 import Key
from drive_env.devices.variants import device_data, parse_key
from drive_env.dictionary.bindings import Binding
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.dictionary.position_scale import COARSEST, FINEST, is_scale, position_scale
from drive_env.dictionary.roles import Role
from drive_env.dictionary.units import UNITS, find_unit
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

BINDINGS = "bindings.toml"


def is_own_folder(name: str) -> bool:
    """Return whether a name is the path of a device's folder."""
    return (Path(name) / "device.toml").is_file()


def own_data(folder: Path) -> dict[str, Any]:
    """Return the data of a device in a folder; its name is the folder's path.

    Raises:
        ValueError: If it cannot be read, or is a variant of another device.
    """
    data = device_data(folder)
    if "variant_of" in data:
        raise ValueError(
            f"variant_of = {data['variant_of']!r} is for a file alone: give the path of this file as the device"
        )
    return data | {"name": str(folder)}


def bindings_of(folder: Path, data: Mapping[str, Any]) -> dict[Key, Binding]:
    """Return the bindings of a folder's `bindings.toml` and of its family, in the order of their objects.

    Raises:
        ValueError: For an unknown unit, with a similar name.
    """
    rows: dict[str, dict[str, Any]] = data.get("bindings", {}) | read_toml(folder / BINDINGS)
    bindings = {}
    for text, row in sorted(rows.items(), key=lambda row: parse_key(row[0])):
        bindings[parse_key(text)] = binding = Binding(*parse_key(text), **row)
        try:
            find_unit(binding.unit)
        except ValueError:
            raise ValueError(f"{text} has no unit {binding.unit!r}{did_you_mean(binding.unit, UNITS)}") from None
    return bindings


def check_scale(roles: Mapping[Role, Key], dictionary: ObjectDictionary) -> None:
    """Raise ValueError for factory values that give no scale of positions."""
    scale = position_scale(roles)
    if scale is None:
        return
    for key in scale.keys:
        if not isinstance(dictionary.find(key).default, int):
            raise ValueError(
                f"{dictionary.find(key).label} counts positions and is not an integer; correct its DataType: 0x7 "
                "(UNSIGNED32)"
            )
    values = [dictionary.find(key).default for key in scale.keys]
    with np.errstate(divide="ignore", invalid="ignore"):
        units = float(scale.increments([np.array(float(value)) for value in values]))
    if not is_scale(units) and values != [0]:  # the emulator's own object that is 0 is set by the commissioning
        told = ", ".join(
            f"{dictionary.find(key).label} = {value}" for key, value in zip(scale.keys, values, strict=True)
        )
        raise ValueError(
            f"the factory values of {told} make {units:g} units of position in a turn, and {COARSEST:g} to "
            f"{FINEST:.0f} are possible; correct their DefaultValue, or make the folder anew with drive-env new"
        )


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn any error in a device's file into a ValueError that names the file."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a TOML file: {error}") from None
    except KeyError as error:
        raise ValueError(
            f"{path} lacks or does not know {error}; every key is explained in drive_env/devices/defaults.toml, or "
            f"where the TMCM-1636 has it, in drive_env/devices/tmcm1636/{path.name}"
        ) from None
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
