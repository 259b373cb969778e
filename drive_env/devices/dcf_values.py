"""Values of a DCF (CiA 306): those that one drive was commissioned with, in addition to its EDS' defaults."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path

from canopen.objectdictionary import ODVariable

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.drive_eds import read_types
from drive_env.dictionary.eds_file import Section, place_of
from drive_env.dictionary.eds_values import number_of
from drive_env.dictionary.entries import INTEGER_TYPES, EdsText
from drive_env.dictionary.standard_types import COMMANDS

COMMUNICATION = range(0x1000, 0x2000)


def take_stored_values(eds: Path | EdsText, sections: Mapping[str, Section]) -> dict[Key, int]:
    """Remove the values of a DCF from its sections; return those of writable objects that are not commands.

    A COB-ID that contains the DCF's node-ID is left out: it follows the actual node-ID.

    Args:
        eds: The file.
        sections: Its sections, from which ParameterValue is removed.
    """
    texts = {
        (place[0], max(place[1], 0)): row.pop("ParameterValue")
        for name, row in sections.items()
        if "ParameterValue" in row and (place := place_of(name)) is not None
    }
    if not texts:
        return {}
    node_id = number_of(sections.get("DeviceComissioning", {}).get("NodeID", "")) or 1
    types = read_types(eds, node_id)
    found = {}
    for key in texts.keys() & types.keys():
        variable = types[key]
        is_number = variable.data_type in INTEGER_TYPES and isinstance(variable.value, int)
        is_parameter = variable.access_type in ("rw", "rwr", "rww") and cia402.of_first_axis(key[0]) not in COMMANDS
        if is_number and is_parameter and not (key[0] in COMMUNICATION and variable.value == variable.default):
            found[key] = int(variable.value)
    return dict(sorted(found.items()))


def with_defaults(types: Mapping[Key, ODVariable], values: Mapping[Key, int]) -> dict[Key, ODVariable]:
    """Return entries, some of them with other defaults."""
    changed = {key: copy.copy(types[key]) for key in values.keys() & types.keys()}
    for key, variable in changed.items():
        variable.default = values[key]
    return {**types, **changed}
