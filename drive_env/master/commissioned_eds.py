"""EDS and DCF of a drive as it is commissioned (CiA 306): its own EDS, with the values that its parameters have now.

An EDS has them as defaults, a DCF as values of one node (ParameterValue, DeviceComissioning). Commands, services and
set-points are not parameters: they stay as in the EDS.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drive_env.cia402 import Key
from drive_env.dictionary.eds_file import EdsFile, object_section
from drive_env.dictionary.eds_values import number_of
from drive_env.dictionary.entries import EdsText, ObjectDictionary, eds_file
from drive_env.drives.interface import Drives, device_of
from drive_env.master.parameters import command, read_parameters

CAN_KBIT = 1000  # kbit/s, unless another bit rate is given


def commissioned_values(drives: Drives, node: int = 0, axis: int | None = None) -> dict[Key, int]:
    """Return the present parameters of a node, by the index of each of its axes.

    Args:
        drives: Emulated, or on a bus.
        node: Number of the node, from 0; emulated drives count as one node.
        axis: The one axis, from 0, whose parameters are returned besides the node's; None: all.
    """
    bus = drives.bus
    if bus is not None:
        known, found = bus.description, dict[Key, int]()
        for one in range(known.num_axes) if axis is None else [axis]:
            values = read_parameters(bus, node * known.num_axes + one)
            found |= {known.key(known.dictionary.find(key), one): value for key, value in values.items()}
        if axis is None:
            return found
        further = known.of_further_axes()  # the EDS lists them all, and each is read by its own index, too
        return {key: value for key, value in found.items() if key not in further or further[key][1] == axis}
    device = device_of(drives)
    found = {}
    for entry in device.new_dictionary():
        own, base = device.locate(entry.index)
        is_parameter = entry.access in ("rw", "rwr", "rww") and entry.bits is not None
        if axis not in (None, own) and not device.is_shared(entry.index):
            continue
        if is_parameter and own < drives.num_axes and not command(base, device.master):
            found[entry.index, entry.sub] = int(np.asarray(drives.read((base, entry.sub)))[own])
    return found


def own_bit_rate(drives: Drives) -> int | None:
    """Return the bit rate that a node on a bus reports [kbit/s]; None for a device without such an object."""
    key = None if drives.device is None else drives.device.canopen.objects.get("active_bit_rate")
    return None if key is None else int(drives.read(key)[0])


def commissioned_eds(
    eds: Path | EdsText, values: Mapping[Key, int], name: str, *, node_id: int | None = None, bit_rate: int = CAN_KBIT
) -> str:
    """Return the text of an EDS, or of a DCF, with values.

    Args:
        eds: The drive's own EDS.
        values: Index and sub-index -> integer.
        name: Name of the file.
        node_id: The node-ID makes it a DCF; None: an EDS.
        bit_rate: Bit rate of the bus [kbit/s], in a DCF.
    """
    file = eds_file(eds, node_id or 1)
    sections = {title: dict(row) for title, row in file.sections.items()}
    defaults = {(entry.index, entry.sub): entry.default for entry in ObjectDictionary(eds, node_id or 1)}
    for key, value in values.items():
        row = sections.get(object_section(*key)) or sections.get(object_section(key[0]))
        if row is None or key not in defaults:
            continue
        if node_id is not None:
            row["ParameterValue"] = str(value)
        elif defaults[key] != value:  # a default that contains the node-ID keeps that form
            row["DefaultValue"] = str(value)
    info = sections.setdefault("FileInfo", {})
    if node_id is not None:
        info["LastEDS"] = info.get("FileName", "")
        before = sections.get("DeviceComissioning", {})
        sections["DeviceComissioning"] = {
            "NodeID": str(node_id), "NodeName": before.get("NodeName", f"node {node_id}"), "Baudrate": str(bit_rate),
            "NetNumber": before.get("NetNumber", "0"), "NetworkName": before.get("NetworkName", ""),
            "CANopenManager": before.get("CANopenManager", "0"),
        }  # fmt: skip
    info["FileName"] = name
    info["FileRevision"] = str((number_of(info.get("FileRevision", "0")) or 0) + 1)
    return EdsFile(sections, ()).text()
