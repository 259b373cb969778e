"""Objects that EtherCAT requires and that an EDS lists differently or not at all: 1C00h, images, 1C32h and 1C33h.

A master reads the use of each sync manager in 1C00h, an image's content in its mapping object (ETG.1000.6, 5.6.7.4),
and a slave's synchronisation in 1C32h and 1C33h (ETG.1020, 22). They exist only on EtherCAT.
"""

from __future__ import annotations

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from drive_env.devices import Device
from drive_env.devices.image_rows import TYPES, FixedImage
from drive_env.dictionary.entries import ObjectDictionary, written_objects
from drive_env.node.process_image import SYNC_MANAGER_TYPES, SYNCHRONISATION

U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
USES = (1, 2, 3, 4)  # of sync managers 0 to 3: mailbox receive and send, process data outputs and inputs
NANOSECOND = 1e-9  # s
# Synchronisation types (1C32h:01, 1C33h:01) and the bits of supported ones (:04): with the sync manager, with SYNC0;
# only some slaves support SYNC1.
WITH_OUTPUTS, WITH_SYNC0, WITH_SYNC1, INPUTS_WITH_OUTPUTS = 1, 2, 3, 0x22
SUPPORTED, SUPPORTED_SYNC1 = 0x02 | 0x04, 0x08
TYPE, CYCLE_TIME, SUPPORTED_TYPES, LEAST_CYCLE, CALC_TIME, MISSED, TOO_SHORT, SYNC_ERROR = 1, 2, 4, 5, 6, 11, 12, 32
# Sub-index, name, data type, access (ETG.1020, tables 61 and 62); of the optional ones only those that are used here.
ROWS = (
    (TYPE, "Synchronization type", U16, "rw"),
    (CYCLE_TIME, "Cycle time", U32, "rw"),
    (SUPPORTED_TYPES, "Synchronization types supported", U16, "ro"),
    (LEAST_CYCLE, "Minimum cycle time", U32, "ro"),
    (CALC_TIME, "Calc and copy time", U32, "ro"),
    (MISSED, "SM-event missed", U16, "ro"),
    (TOO_SHORT, "Cycle time too small", U16, "ro"),
    (SYNC_ERROR, "Sync error", datatypes.BOOLEAN, "ro"),
)


def ethercat_objects(device: Device) -> dict[int, ODArray | ODRecord]:
    """Return the objects that a device has on EtherCAT in addition to those of its EDS or instead of them, by index."""
    assert device.ethercat is not None, "it is asked for devices with EtherCAT"
    dictionary = device.new_dictionary()
    found = {index: _image(index, image, dictionary) for index, image in device.images.items()}
    found |= written_objects(device.eds, device.ethercat.writable)
    if not dictionary.has(SYNC_MANAGER_TYPES):
        found[SYNC_MANAGER_TYPES] = _object(
            ODArray("Sync manager type", SYNC_MANAGER_TYPES),
            [(0, "Number", U8, "ro", len(USES))]
            + [(k, f"Sync manager {k - 1}", U8, "ro", use) for k, use in enumerate(USES, 1)],
        )
    for index, name in zip(SYNCHRONISATION, ("outputs", "inputs"), strict=True):
        found[index] = _synchronisation(device, index, name)
    return found


def entries_on_ethercat(device: Device, entries: ObjectDictionary) -> ObjectDictionary:
    """Return a device's dictionary as EtherCAT has it."""
    assert device.ethercat is not None, "a device without EtherCAT has no such dictionary"
    return entries.only(device.ethercat.has).including(ethercat_objects(device).values())


def _object(
    item: ODArray | ODRecord, rows: list[tuple[int, str, int, str, int]] | tuple[tuple[int, str, int, str, int], ...]
) -> ODArray | ODRecord:
    for sub, name, kind, access, default in rows:
        member = ODVariable(name, item.index, sub)
        member.data_type, member.access_type, member.default = kind, access, default
        member.pdo_mappable = False
        item.add_member(member)
    return item


def _image(index: int, image: FixedImage, dictionary: ObjectDictionary) -> ODArray | ODRecord:
    """Return the mapping object of a ready-made image; reserved and foreign fields have no index (ETG.1000.6)."""
    mapped = []
    for field in image.fields:
        bits = TYPES[field.type][1]
        if field.key is not None and not field.is_name:
            own = dictionary.find(field.key).bits or 0
            mapped.append(field.key[0] << 16 | field.key[1] << 8 | own)
            bits -= own
        if bits:
            mapped.append(bits)
    name = f"{'Outputs' if image.is_output else 'Inputs'} {index:04X}h"
    return _object(
        ODRecord(name, index),
        [(0, "Number of entries", U8, "ro", len(mapped))]
        + [(k, f"Entry {k}", U32, "ro", raw) for k, raw in enumerate(mapped, 1)],
    )


def _synchronisation(device: Device, index: int, name: str) -> ODArray | ODRecord:
    assert device.ethercat is not None, "see entries_on_ethercat"
    shortest = round(device.ethercat.shortest_cycle / NANOSECOND)
    is_outputs = index == SYNCHRONISATION[0]
    defaults = {
        TYPE: WITH_OUTPUTS if is_outputs else INPUTS_WITH_OUTPUTS,
        CYCLE_TIME: round(1.0 / device.communication_rate / NANOSECOND),
        SUPPORTED_TYPES: SUPPORTED | (SUPPORTED_SYNC1 if device.ethercat.uses_sync1 else 0),
        LEAST_CYCLE: shortest,
    }
    rows = [(sub, text, kind, access, defaults.get(sub, 0)) for sub, text, kind, access in ROWS]
    return _object(ODRecord(f"Synchronization of {name}", index), [(0, "Number", U8, "ro", ROWS[-1][0]), *rows])
