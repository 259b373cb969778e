"""Reads an EtherCAT slave's EEPROM by its categories."""

from __future__ import annotations

import struct


def categories(content):
    """Return the content of each category of an EEPROM, by number."""
    found, at = {}, 0x80
    while (number := int.from_bytes(content[at : at + 2], "little")) != 0xFFFF:
        size = 2 * int.from_bytes(content[at + 2 : at + 4], "little")
        found[number] = content[at + 4 : at + 4 + size]
        at += 4 + size
    return found


def pdos(content):
    """Return index, sync manager and entries (index, sub-index, bits) of each PDO of a category."""
    found, at = [], 0
    while at < len(content):
        index, number, manager = struct.unpack_from("<HBB", content, at)
        rows = [struct.unpack_from("<HBBBBH", content, at + 8 * k) for k in range(1, number + 1)]
        found.append((index, manager, [(one[0], one[1], one[4]) for one in rows]))
        at += 8 * (number + 1)
    return found
