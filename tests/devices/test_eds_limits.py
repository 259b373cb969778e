"""Objects that have no limits in the EDS: rows have values that a node takes over SDO and values that it refuses.

The others, at the ends of their ranges: test_eds_and_node.py and test_conformance_sdo.py, for every device.
"""

from __future__ import annotations

from typing import NamedTuple

import pytest
from canopen.objectdictionary import ODVariable
from rigs.canopen_wire import Wire

from drive_env.devices import find_device
from drive_env.dictionary.aborts import CANNOT_BE_STORED, NO_SUCH_OBJECT, VALUE_RANGE
from drive_env.dictionary.entries import read_eds

EDS = find_device("tmcm1636").eds
WRITABLE = {
    (entry.index, entry.subindex): entry
    for item in read_eds(EDS).values()
    for entry in ([item] if isinstance(item, ODVariable) else item.values())
    if entry.access_type in ("rw", "wo")
}
LIMITED = {key: entry for key, entry in WRITABLE.items() if entry.min is not None}
OFF = 0xC000_0000
DWORD = 0xFFFF_FFFF
MAPPED = {False: (0x6040_0010, 0x6060_0008, 0x607A_0020), True: (0x6041_0010, 0x6061_0008, 0x6064_0020)}  # by direction
SAVE, LOAD = 0x6576_6173, 0x6461_6F6C


class Rule(NamedTuple):
    """Objects without limits: what they take, what they refuse, and with which abort code."""

    keys: tuple[tuple[int, int], ...]
    takes: tuple[int, ...]
    refuses: tuple[int, ...]
    code: int


RULES = (
    # Reserved (CiA 301, table 41): 001h to 07Fh, 101h to 180h, 581h to 5FFh, 601h to 67Fh, 6E0h to 6FFh, 701h to 7FFh.
    Rule(((0x1005, 0),), (0x80, 0x700), (0, 0x7F, 0x701, 0x4000_0080, DWORD), VALUE_RANGE),
    Rule(((0x1014, 0),), (0x80, 0x700, 0x8000_0000), (0, 0x7F, 0x701, 0x4000_0080, DWORD), VALUE_RANGE),
    Rule(
        tuple((first + k, 1) for first in (0x1400, 0x1800) for k in range(4)),
        (0x4000_0080, 0x4000_0700, OFF), (0, 0x7F, 0x701, 0x6000_0200, DWORD), VALUE_RANGE,
    ),
    Rule(
        tuple((0x1600 + k, sub) for k in range(4) for sub in (1, 2, 3)),
        (0, 0x6040_0010, 0x60FF_0020), (1, 0x1FFF_FFFF, DWORD), NO_SUCH_OBJECT,
    ),
    Rule(
        tuple((0x1A00 + k, sub) for k in range(4) for sub in (1, 2, 3)),
        (0, 0x6041_0010, 0x60FD_0020), (1, 0x1FFF_FFFF, DWORD), NO_SUCH_OBJECT,
    ),
    Rule((*((0x1010, sub) for sub in (1, 2, 3, 4)), (0x2706, 0)), (SAVE,), (0, LOAD, DWORD), CANNOT_BE_STORED),
    Rule(tuple((0x1011, sub) for sub in (1, 2, 3, 4)), (LOAD,), (0, SAVE, DWORD), CANNOT_BE_STORED),
    Rule(((0x5FFF, 0),), (0x1234_5678,), (0, 0x1234_5679, DWORD), VALUE_RANGE),
)  # fmt: skip


def prepare(drives, key):
    """Return a node that has just booted, with what the manual wants before this object is written."""
    drives.machine.reset()
    wire = Wire(drives)
    index = key[0]
    if index == 0x1014:
        assert wire.download(0x1014, 0, 0x8000_0085, 4) == 0
    elif 0x1400 <= index < 0x1C00:
        communication = index & ~0x200
        assert wire.download(communication, 1, OFF | 0x200, 4) == 0
        if index != communication:  # a mapping: its entries first, then their number
            assert wire.download(index, 0, 0, 1) == 0
            for k, raw in enumerate(MAPPED[index >= 0x1A00], 1):
                assert wire.download(index, k, raw, 4) == 0
    return wire


def test_every_object_that_can_be_written_is_in_one_of_the_tables():
    ruled = [key for rule in RULES for key in rule.keys]
    assert len(ruled) == len(set(ruled))
    assert set(WRITABLE) - set(LIMITED) == set(ruled)
    assert len(LIMITED) > 80


@pytest.mark.every(7)
@pytest.mark.parametrize(
    ("key", "rule"),
    [(key, rule) for rule in RULES for key in rule.keys],
    ids=lambda x: "" if isinstance(x, Rule) else f"{x[0]:04X}:{x[1]}",
)
def test_what_has_no_limits_takes_what_its_rule_says(drives, key, rule):
    for raw in rule.takes:
        assert prepare(drives, key).download(*key, raw, 4) == 0, f"{raw:08X}h"
    for raw in rule.refuses:
        assert prepare(drives, key).download(*key, raw, 4) == rule.code, f"{raw:08X}h"
