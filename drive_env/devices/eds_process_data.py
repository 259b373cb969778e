"""Repairs an EDS' process data with which a node could not start: COB-IDs, mapped objects, lengths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from canopen.objectdictionary import ODVariable

from drive_env.cia402 import Key
from drive_env.dictionary.eds_file import Section, object_section
from drive_env.dictionary.entries import INTEGER_TYPES

RPDOS, TPDOS = range(0x1400, 0x1600), range(0x1800, 0x1A00)
TO_MAPPING = 0x200
PREDEFINED = {0x1400 + k: 0x200 + 0x100 * k for k in range(4)} | {0x1800 + k: 0x180 + 0x100 * k for k in range(4)}
OFF = 0x80000000  # bit 31 of a PDO's COB-ID
LONGEST = 64  # bits


def repair_process_data(sections: dict[str, Section], types: Mapping[Key, ODVariable]) -> Iterator[tuple[str, str]]:
    """Give PDOs without a COB-ID that of the predefined set, or 0; lengths become those of the mapped objects.

    An impossible mapping is emptied.

    Returns:
        The place, and the repair.
    """
    for index in [*RPDOS, *TPDOS]:
        cob_id = types.get((index, 1))
        name = object_section(index, 1)
        if cob_id is not None and not cob_id.default:
            given = PREDEFINED.get(index)
            sections[name]["DefaultValue"] = f"0x{OFF:X}" if given is None else f"$NODEID+0x{given:X}"
            yield f"[{name}]", "has no COB-ID: " + ("off" if given is None else "that of the predefined connection set")
        mapping = index + TO_MAPPING
        count = types.get((mapping, 0))
        if cob_id is None or count is None or not count.default:
            continue
        entries = [types.get((mapping, sub)) for sub in range(1, int(count.default) + 1)]
        raws = [one.default if one is not None and isinstance(one.default, int) else None for one in entries]
        wrong = _wrong_mapping(raws, types)
        for sub, raw in enumerate(raws if not wrong else (), 1):
            assert raw is not None, "nothing is wrong"
            bits = len(types[raw >> 16, raw >> 8 & 0xFF])
            if bits != raw & 0xFF:
                name, right = object_section(mapping, sub), f"0x{raw & ~0xFF | bits:08X}"
                sections[name]["DefaultValue"] = right
                yield f"[{name}]", f"0x{raw:08X} is read as {right}, by the length of what it maps"
        if wrong:
            sections[object_section(mapping, 0)]["DefaultValue"] = "0"
            yield f"[{mapping:04X}]", f"{wrong}: nothing is mapped"


def _wrong_mapping(raws: list[int | None], types: Mapping[Key, ODVariable]) -> str:
    """Return why objects cannot be mapped, "" if they can; lengths are the objects' own."""
    length = 0
    for sub, raw in enumerate(raws, 1):
        if raw is None:
            return f"sub-index {sub} is missing"
        index, place = raw >> 16, raw >> 8 & 0xFF
        target = types.get((index, place))
        if target is None:
            return f"{index:04X}h:{place:02X} does not exist"
        if len(target) != raw & 0xFF and (target.data_type not in INTEGER_TYPES or len(target) % 8):
            return f"{index:04X}h:{place:02X} has {len(target)} bits, not {raw & 0xFF}"
        length += len(target)
    return f"{length} bits are more than {LONGEST}" if length > LONGEST else ""
